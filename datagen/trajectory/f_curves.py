"""Animation curves with keys, evaluated as Blender evaluates its F-curves.

A curve between two keys is a straight line, a step, an easing equation, or a cubic Bézier curve in the plane of time
and value. Automatic handles stand a third of the way to the neighbouring key and are as steep as leaves no jump of
acceleration at any of them, which makes a cubic spline; they are level at the first and the last key, but where the
motion ends as it began the spline runs through the closing key as through any other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.trajectory.easing import ease

Array = NDArray[np.float64]

ON_A_KEY = 1e-4
"""In frames: nearer to a key than this, Blender gives the key's value."""
BISECTIONS = 60
LEFT, RIGHT = 0, 1


@dataclass(frozen=True, kw_only=True)
class KeyedCurves:
    """C curves that have K keys at the same frames.

    ``key_frames`` (K,) increase; ``values`` (K, C); ``interpolation`` and ``easing`` of each key lead to the next one;
    ``handles`` of a key are None (automatic) or (2, C, 2): left and right, for each curve the frame and the value at
    which the handle stands.
    """

    key_frames: Array
    values: Array
    interpolation: tuple[str, ...]
    easing: tuple[str, ...]
    handles: tuple[Array | None, ...]

    @property
    def is_closed(self) -> bool:
        """Whether the curves end as they began; then they repeat before the first key and after the last."""
        return len(self.values) > 2 and np.allclose(self.values[0], self.values[-1], rtol=0, atol=1e-9)

    @property
    def is_smooth_through_its_ends(self) -> bool:
        """Whether the automatic handles of a closed curve join its end to its beginning."""
        return self.is_closed and self.handles[0] is None and self.handles[-1] is None


def evaluate(curves: KeyedCurves, frames: Array) -> Array:
    """Return the values (N, C) at ``frames`` (N,), which need not be whole numbers."""
    if len(curves.key_frames) == 1:
        return np.repeat(curves.values, len(frames), axis=0)
    at = _within_the_keys(curves, np.asarray(frames, dtype=np.float64))
    left, right = bezier_handles(curves)
    segment = np.clip(np.searchsorted(curves.key_frames, at, side="right") - 1, 0, len(curves.key_frames) - 2)
    result = np.empty((len(at), curves.values.shape[1]))
    for i in np.unique(segment):
        chosen = segment == i
        result[chosen] = _between_keys(curves, int(i), at[chosen], right[i], left[i + 1])
    for i, key_frame in enumerate(curves.key_frames):
        result[np.abs(at - key_frame) < ON_A_KEY] = curves.values[i]
    return result


def bezier_handles(curves: KeyedCurves) -> tuple[Array, Array]:
    """Return where the left and the right handles stand, (K, C, 2) each: frame and value."""
    count, components = curves.values.shape
    widths = np.diff(curves.key_frames)
    before, after = np.append(widths[:1], widths), np.append(widths, widths[-1:])
    if curves.is_smooth_through_its_ends:
        before[0], after[-1] = widths[-1], widths[0]
    steepness = np.column_stack([_automatic_steepness(curves, c) for c in range(components)])
    left, right = np.empty((count, components, 2)), np.empty((count, components, 2))
    for side, handles, reach in ((0, left, -before / 3), (1, right, after / 3)):
        handles[..., 0] = (curves.key_frames + reach)[:, None]
        handles[..., 1] = curves.values + steepness * reach[:, None]
        for i, given in enumerate(curves.handles):
            if given is not None:
                handles[i] = given[side]
    return left, right


def _automatic_steepness(curves: KeyedCurves, component: int) -> Array:
    """Return value per frame (K,) of the automatic handles of one curve; 0 where handles are given.

    A row a key says that the second derivative dv²/df² does not jump there. With widths w, rises d and slopes m of two
    segments it is, at the end of the one and at the beginning of the other, for handles at thirds,

        (2 m_before w + 4 m w − 6 d) / w²    and    (6 d − 4 m w − 2 m_after w) / w².

    A given handle at (a, h) from its key has m_before w = 3 h, and as it does not stand at a third of the width, the
    curve's parameter is not proportional to time; this adds 2 m w (1 − 3 a / w) to the first, and takes it from the
    second.
    """
    frames, values = curves.key_frames, curves.values[:, component]
    count, closed = len(frames), curves.is_smooth_through_its_ends
    widths, rises = np.diff(frames), np.diff(values)
    rows, wanted = np.eye(count), np.zeros(count)
    for i in range(count):
        level_end = i in (0, count - 1) and not closed
        if curves.handles[i] is not None or level_end:
            continue
        if closed and i == count - 1:
            rows[i, 0] = -1.0  # the same as at the first key
            continue
        rows[i, i] = 0.0
        # The first key of a closed curve has the last segment before it.
        previous = i - 1 if i else count - 2
        for segment, neighbour, side in ((previous, previous, RIGHT), (i, i + 1, LEFT)):
            width, given = widths[segment], curves.handles[neighbour]
            rows[i, i] += 4 / width
            wanted[i] += 6 * rises[segment] / width**2
            if given is None:
                rows[i, neighbour] += 2 / width
                continue
            towards = 1 if side == RIGHT else -1
            reach = towards * (given[side, component, 0] - frames[neighbour])
            rise = towards * (given[side, component, 1] - values[neighbour])
            # A handle that passes the automatic one of the other key is shortened.
            shorten = min(1.0, width / (reach + width / 3))
            wanted[i] -= 6 * shorten * rise / width**2
            rows[i, i] += 2 * (1 - 3 * shorten * reach / width) / width
    return np.linalg.solve(rows, wanted)


def _within_the_keys(curves: KeyedCurves, frames: Array) -> Array:
    """Return frames between the first key and the last: held there, or repeated where the curves are closed."""
    first, last = curves.key_frames[0], curves.key_frames[-1]
    if not curves.is_closed:
        return np.clip(frames, first, last)
    outside = (frames < first) | (frames > last)
    return np.where(outside, first + np.mod(frames - first, last - first), frames)


def _between_keys(curves: KeyedCurves, i: int, frames: Array, right: Array, left: Array) -> Array:
    """Return values (N, C) between keys ``i`` and ``i`` + 1, whose handles towards each other are (C, 2) each."""
    start, end = curves.key_frames[i], curves.key_frames[i + 1]
    begin, change = curves.values[i], curves.values[i + 1] - curves.values[i]
    name = curves.interpolation[i]
    if name == "constant":
        return np.repeat(begin[None], len(frames), axis=0)
    time = (frames - start) / (end - start)
    if name == "smooth":
        columns = [
            _bezier(time, (right[c] - (start, begin[c])), (left[c] - (end, begin[c] + change[c])), end - start)
            for c in range(len(begin))
        ]
        return begin + np.column_stack([u[1] + u[0] * change[c] for c, u in enumerate(columns)])
    progress = time if name == "linear" else ease(name, curves.easing[i], time)
    return begin + progress[:, None] * change


def _bezier(time: Array, right: Array, left: Array, width: float) -> tuple[Array, Array]:
    """Return what a Bézier curve has at ``time`` (N,) in [0, 1]: the end key's part, and what its handles add.

    ``right`` and ``left`` (2,) are handles as offsets (frame, value) from the first and from the second key. A handle
    that reaches beyond the other key is shortened to it, so that time always runs forwards.
    """
    reaches, additions = [], []
    for offset in (right, left):
        reach = abs(offset[0]) / width
        shorten = 1 / max(reach, 1.0)
        reaches.append(reach * shorten)
        additions.append(offset[1] * shorten)
    u = _parameter_at(time, *reaches)
    first, second, third = 3 * u * (1 - u) ** 2, 3 * u**2 * (1 - u), u**3
    return second + third, first * additions[0] + second * additions[1]


def _parameter_at(time: Array, first_reach: float, second_reach: float) -> Array:
    """Return the parameters (N,) at which a Bézier curve whose handles reach so far comes to ``time`` (N,)."""
    if np.allclose([first_reach, second_reach], 1 / 3, rtol=0, atol=1e-12):
        return time  # automatic handles: the parameter is time itself
    low, high = np.zeros_like(time), np.ones_like(time)
    for _ in range(BISECTIONS):
        u = (low + high) / 2
        early = 3 * u * (1 - u) ** 2 * first_reach + 3 * u**2 * (1 - u) * (1 - second_reach) + u**3 < time
        low, high = np.where(early, u, low), np.where(early, high, u)
    return (low + high) / 2
