"""Numbers over the cases of a trial, and the bars that they are held against."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fusion.evaluation.pose_errors import BOP_PIXELS, BOP_SHARES, average_recall, recall, within
from fusion.pose_benchmark.case_files import CaseResult, PoseErrors

Cases = Sequence[CaseResult]
Unit = Literal["%", "°", "mm", "ms"]
NEAREST_TOLERANCE = 0.1
"""A view whose distance is larger than the least by no more than this share of it is as good as the nearest."""
BOP_WIDTH_PX = 640
"""Width of the images that BOP's bounds on MSPD are for."""


@dataclass(frozen=True, kw_only=True)
class Bar:
    """A number over a trial's cases and what it has to reach, None where it is only told.

    ``measure`` gives the number in ``unit``, None where the cases do not tell it.
    """

    what: str
    unit: Unit
    measure: Callable[[Cases], float | None]
    at_least: float | None = None
    at_most: float | None = None

    def passes(self, value: float) -> bool | None:
        """Tell whether a number reaches the bar, None where there is none."""
        if self.at_least is None and self.at_most is None:
            return None
        return (self.at_least is None or value >= self.at_least) and (self.at_most is None or value <= self.at_most)

    @property
    def wording(self) -> str:
        """The bar in words."""
        if self.at_least is not None:
            return f"≥ {self.at_least:g} {self.unit}"
        return "–" if self.at_most is None else f"≤ {self.at_most:g} {self.unit}"


def _errors(cases: Cases, pick: Callable[[PoseErrors], float | None]) -> list[float]:
    """Return an error of each case, infinite where nothing was found."""
    found = [None if case.errors is None else pick(case.errors) for case in cases]
    return [np.inf if error is None else error for error in found]


def _percent(share: float) -> float:
    return 100 * share


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def median_rotation(**bar: float) -> Bar:
    """Return the median rotation error."""
    return Bar(
        what="median rotation",
        unit="°",
        measure=lambda cases: _finite(float(np.median(_errors(cases, lambda e: e.rotation_deg)))),
        **bar,
    )


def median_fixed_rotation(**bar: float) -> Bar:
    """Return the median rotation error as far as the shape fixes it: of a body of revolution, that of its axis."""
    return Bar(
        what="median rotation that the shape fixes",
        unit="°",
        measure=lambda cases: _finite(float(np.median(_errors(cases, lambda e: e.fixed_rotation_deg)))),
        **bar,
    )


def median_translation(**bar: float) -> Bar:
    """Return the median translation error."""
    return Bar(
        what="median translation",
        unit="mm",
        measure=lambda cases: _finite(1000 * float(np.median(_errors(cases, lambda e: e.translation_m)))),
        **bar,
    )


def within_bounds(*, centimetres: float, degrees: float, **bar: float) -> Bar:
    """Return the share of poses within n cm and n°."""

    def measure(cases: Cases) -> float:
        turned = _errors(cases, lambda e: e.rotation_deg)
        moved = _errors(cases, lambda e: e.translation_m)
        return _percent(within(turned, moved, degrees=degrees, metres=centimetres / 100))

    return Bar(what=f"within {centimetres:g} cm {degrees:g}°", unit="%", measure=measure, **bar)


def add_within(share: float, **bar: float) -> Bar:
    """Return the share of poses whose ADD is less than ``share`` of the diameter."""
    return Bar(what=f"ADD-{share:g}d", unit="%", measure=lambda cases: _in_diameters(cases, "add_m", share), **bar)


def add_s_within(share: float, **bar: float) -> Bar:
    """Return the share of poses whose ADD-S is less than ``share`` of the diameter."""
    return Bar(what=f"ADD-S-{share:g}d", unit="%", measure=lambda cases: _in_diameters(cases, "add_s_m", share), **bar)


def _in_diameters(cases: Cases, name: str, share: float) -> float:
    errors = _errors(cases, lambda e: getattr(e, name))
    return _percent(recall([error / case.diameter_m for error, case in zip(errors, cases, strict=True)], below=share))


def projection_within(pixels: float, **bar: float) -> Bar:
    """Return the share of poses whose mean projection error is less than ``pixels``."""
    return Bar(
        what=f"{pixels:g} px projection",
        unit="%",
        measure=lambda cases: _percent(recall(_errors(cases, lambda e: e.projection_px), below=pixels)),
        **bar,
    )


def nearest_found(**bar: float) -> Bar:
    """Return the share of queries for which the nearest fused view was found, or one as good."""

    def measure(cases: Cases) -> float | None:
        told = [case for case in cases if case.nearest is not None or case.failure is not None]
        if not told:
            return None
        good = [
            case.nearest is not None
            and case.nearest.distance <= (1 + NEAREST_TOLERANCE) * case.nearest.least_distance + 1e-9
            for case in told
        ]
        return _percent(float(np.mean(good)))

    return Bar(what="nearest view found", unit="%", measure=measure, **bar)


def nearest_time(**bar: float) -> Bar:
    """Return the median time of finding the nearest view, at most what a quiet machine needs."""
    return Bar(
        what="time, nearest view",
        unit="ms",
        measure=lambda cases: _median_ms([case.nearest.cost.quiet_s for case in cases if case.nearest is not None]),
        **bar,
    )


def refinement_time(**bar: float) -> Bar:
    """Return the median time of refining a pose, at most what a quiet machine needs."""
    return Bar(
        what="time, refinement",
        unit="ms",
        measure=lambda cases: _median_ms([case.cost.quiet_s for case in cases if case.cost is not None]),
        **bar,
    )


def _median_ms(seconds: list[float]) -> float | None:
    return 1000 * float(np.median(seconds)) if seconds else None


def bop_recalls(*, width_px: int) -> tuple[Bar, Bar, Bar]:
    """Return BOP's average recalls of VSD, MSSD and MSPD; pixels count as in an image 640 wide."""

    def vsd(cases: Cases) -> float:
        # Each τ is held against each of BOP's ten bounds on the share that disagrees.
        values = [case.errors.vsd if case.errors is not None and case.errors.vsd else (1.0,) * 10 for case in cases]
        return _percent(average_recall(np.array(values).ravel(), BOP_SHARES))

    def mssd(cases: Cases) -> float:
        return float(np.mean([_in_diameters(cases, "mssd_m", share) for share in BOP_SHARES]))

    def mspd(cases: Cases) -> float:
        pixels = _errors(cases, lambda e: e.mspd_px)
        return _percent(average_recall(pixels, [bound * width_px / BOP_WIDTH_PX for bound in BOP_PIXELS]))

    return (
        Bar(what="BOP recall, VSD", unit="%", measure=vsd),
        Bar(what="BOP recall, MSSD", unit="%", measure=mssd),
        Bar(what="BOP recall, MSPD", unit="%", measure=mspd),
    )


def said_found() -> Bar:
    """Return the share of poses that were said to be found without reserve."""
    return Bar(
        what="said to be found",
        unit="%",
        measure=lambda cases: _percent(float(np.mean([case.verdict == "found" for case in cases]))),
    )
