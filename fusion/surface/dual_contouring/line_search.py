"""Where an oracle's sign changes along a line, in few questions.

The secant through the last two answers is as good as exact after one or two where the field is smooth. It begins from
an answer outside the surface: inside, fields may end soon (``depth_oracle``). The sign change stays between ``low`` and
``high``, and after some questions every other one is in the middle, so a field that is no distance costs no more than
that.
"""

from functools import cache
from typing import Any

import warp as wp

from fusion.surface.dual_contouring.oracle import is_known

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TOLERANCE = wp.constant(1.0e-3)
"""Voxels: a crossing is known much more exactly than depth images tell."""
_SURE_STEP = wp.constant(4.0e-3)
"""Voxels: a secant's step as short as this is not asked about; it is off by a small part of it."""
_FREE_QUESTIONS = wp.constant(3)
_MOST_QUESTIONS = wp.constant(14)


@wp.func
def line_meets_zero(a: float, b: float, at_a: float, at_b: float) -> float:
    """Return where the line through two answers is 0."""
    return a + (b - a) * at_a / (at_a - at_b)


@wp.func
def next_question(low: float, high: float, at_low: float, at_high: float, secant: float, step: int) -> float:
    """Return where to ask next between two points of different sign: at the ``secant``'s zero if it lies there."""
    if step >= _FREE_QUESTIONS and step % 2 == 1:
        return 0.5 * (low + high)
    if secant > low and secant < high:
        return secant
    margin = 0.02 * (high - low)
    return wp.clamp(line_meets_zero(low, high, at_low, at_high), low + margin, high - margin)


@cache
def line_search(value: Any, state_type: Any) -> Any:
    """Return the function that asks an oracle where its sign changes along a line."""

    @wp.func
    def search(
        state: state_type,
        number: int,
        start: wp.vec3,
        way: wp.vec3,
        first_low: float,
        first_high: float,
        at_first_low: float,
        at_first_high: float,
        first_question: float,
    ) -> float:
        """Return where the sign changes on ``start`` + s · ``way``, between two s; −1 where an answer is not known.

        ``at_first_low`` … are the values there, of different sign, or what they are guessed to be.
        """
        low = first_low
        high = first_high
        at_low = at_first_low
        at_high = at_first_high
        before = wp.where(at_low > 0.0, low, high)
        at_before = wp.max(at_low, at_high)
        s = first_question
        for step in range(_MOST_QUESTIONS):
            answer = value(state, number, start + s * way)
            if not is_known(answer):
                return -1.0
            if wp.abs(answer) < 0.2 * TOLERANCE:
                return s
            secant = line_meets_zero(s, before, answer, at_before)
            if (answer < 0.0) == (at_low < 0.0):
                low = s
                at_low = answer
            else:
                high = s
                at_high = answer
            if wp.abs(secant - s) < _SURE_STEP and secant > low and secant < high:
                return secant
            if high - low < TOLERANCE:
                return 0.5 * (low + high)
            before = s
            at_before = answer
            s = next_question(low, high, at_low, at_high, secant, step)
        return 0.5 * (low + high)

    return search
