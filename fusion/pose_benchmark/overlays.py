"""Pictures of cases: the model's outline over what the query shows, where it was started and where it was found."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.pose.overlay import before_and_after
from fusion.pose_benchmark.case_files import CaseResult
from fusion.pose_benchmark.protocol import Trial
from fusion.pose_benchmark.subjects import Subject
from fusion.pose_benchmark.tasks import Case
from fusion.pose_benchmark.views import spoiled
from fusion.render import resized

MASK_COLOR = (250, 250, 250)
WIDTH_PX = 640


@dataclass(frozen=True, kw_only=True)
class Overlay:
    """A picture (height, 2·width, 3) RGB: the start at left, what was found at right; and words beneath it.

    ``which`` is ``typical`` or ``worst``.
    """

    which: str
    case: CaseResult
    image: NDArray[np.uint8]

    @property
    def caption(self) -> str:
        """Say what is seen."""
        case = self.case
        if case.errors is None or case.start_errors is None:
            return f"{case.title}: {case.failure}"
        before, after = case.start_errors, case.errors
        return (
            f"{case.title}: {before.rotation_deg:.2f}° and {1000 * before.translation_m:.1f} mm at the start, "
            f"{after.rotation_deg:.3f}° and {1000 * after.translation_m:.2f} mm as found; said to be {case.verdict}"
        )


def badness(case: CaseResult) -> float:
    """Return how far off a case is, for sorting: a degree and a centimetre count alike."""
    if case.errors is None:
        return float("inf")
    return float(np.hypot(case.errors.rotation_deg, 100 * case.errors.translation_m))


def overlays(subject: Subject, trial: Trial, cases: Sequence[CaseResult], *, seed: int) -> tuple[Overlay, ...]:
    """Return pictures of a trial's typical case, the median, and of its worst."""
    order = sorted((case for case in cases if case.errors is not None), key=badness)
    if not order:
        return ()
    chosen = {"typical": order[len(order) // 2], "worst": order[-1]}
    return tuple(
        Overlay(which=which, case=case, image=_picture(subject, trial, case, seed=seed))
        for which, case in chosen.items()
    )


def _picture(subject: Subject, trial: Trial, result: CaseResult, *, seed: int) -> NDArray[np.uint8]:
    """Draw a case's start and estimate over what the query shows, and the mask that it was given in white."""
    case = Case(subject=subject, trial=trial, frame=result.frame, repeat=result.repeat, seed=seed)
    view = subject.view(case.frame)
    if trial.noise is not None:
        view = spoiled(view, trial.noise, rng=case.rng)
    # A small query is enlarged, so that the lines are fine.
    scale = max(WIDTH_PX / view.camera.width, 1.0)
    size = (round(scale * view.camera.width), round(scale * view.camera.height))
    image = np.asarray(cv2.resize(view.color, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    if view.mask is not None:
        _draw_border(image, view.mask)
    start, estimate = (np.array(pose) for pose in (result.start, result.estimate))
    return before_and_after(
        image,
        subject.model.mesh,
        resized(view.camera, size),
        start,
        estimate,
        device=subject.model.device,
        titles=("start", "found"),
    )


def _draw_border(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> None:
    large = cv2.resize(mask.astype(np.uint8), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    borders, _hierarchy = cv2.findContours(large, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, borders, -1, MASK_COLOR, 1, cv2.LINE_AA)
