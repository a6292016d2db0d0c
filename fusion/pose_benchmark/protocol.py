"""The protocol: which trials there are for what kind of subject, and what each has to reach."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

from datagen.errors import InputError
from fusion.pose.stages import StageName
from fusion.pose_benchmark.measures import (
    Bar,
    add_s_within,
    add_within,
    bop_recalls,
    median_fixed_rotation,
    median_rotation,
    median_translation,
    nearest_found,
    nearest_time,
    projection_within,
    refinement_time,
    said_found,
    within_bounds,
)
from fusion.pose_benchmark.perturbations import Perturbation
from fusion.pose_benchmark.subjects import Kind, Subject
from fusion.pose_benchmark.views import Noise

STARTS_A_FRAME = 4
"""Of real frames, of which there are few."""
SMALL_ERROR = Perturbation(degrees=10.0, metres=0.04)
LARGE_ERROR = Perturbation(degrees=40.0, metres=0.16)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One part of the protocol.

    ``start``: what ``nearest`` finds and aligns, as ``fusion locate`` does, by the outline where there is no depth; the
    pose of the fused view that is in truth the nearest; or the truth, perturbed. ``stages`` refine it, ``repeats``
    times a frame from different starts. A query is ``depth`` with its colours, a ``mask`` alone, or ``color`` with a
    mask; ``noise`` spoils it. ``with_vsd``: the visible surface discrepancy is told too, for which the model has to be
    rendered.
    """

    name: str
    title: str
    start: Literal["found", "nearest view"] | Perturbation
    stages: tuple[StageName, ...]
    bars: tuple[Bar, ...]
    sees: Literal["depth", "mask", "color"] = "depth"
    noise: Noise | None = None
    repeats: int = 1
    with_vsd: bool = False

    @property
    def conditions(self) -> dict[str, Any]:
        """What decides a case's result, for people and to tell whether a result that is kept is of this trial."""
        told = asdict(self)
        return {name: told[name] for name in ("name", "start", "stages", "sees", "noise")}


def trials_of(kind: Kind, *, width_px: int) -> tuple[Trial, ...]:
    """Return the trials of a kind of subject, whose images are ``width_px`` wide."""
    return {"object": _object_trials, "room": _room_trials, "points": _points_trials}[kind](width_px)


def _object_trials(width_px: int) -> tuple[Trial, ...]:
    bop = bop_recalls(width_px=width_px)
    return (
        _clean_trial(bop),
        *_trials_without_depth(bop),
        _convergence("off-10", SMALL_ERROR, 99),
        _convergence("off-40", LARGE_ERROR, 95),
        _noisy_trial(bop),
    )


def _clean_trial(bop: tuple[Bar, ...]) -> Trial:
    return Trial(
        name="clean",
        with_vsd=True,
        title="clean, from the nearest pose",
        start="found",
        stages=("depth",),
        bars=(
            nearest_found(at_least=99),
            median_rotation(at_most=0.05),
            median_translation(at_most=0.1),
            within_bounds(centimetres=1, degrees=1, at_least=100),
            add_within(0.01, at_least=99),
            nearest_time(at_most=20),
            refinement_time(at_most=150),
            *bop,
            said_found(),
        ),
    )


def _trials_without_depth(bop: tuple[Bar, ...]) -> tuple[Trial, ...]:
    strict = within_bounds(centimetres=1, degrees=1)
    bars = (median_rotation(at_most=0.5), median_translation(at_most=2), strict)
    return (
        Trial(
            name="mask",
            with_vsd=True,
            title="clean, mask alone, from the nearest view",
            start="nearest view",
            stages=("silhouette",),
            sees="mask",
            bars=(*bars, refinement_time(), *bop),
        ),
        Trial(
            name="color",
            title="clean, colour with a mask, from the nearest view",
            start="nearest view",
            stages=("epipolar", "silhouette"),
            sees="color",
            bars=bars,
        ),
        Trial(
            name="outline",
            title="clean, mask alone, from the view that its outline finds",
            start="found",
            stages=("silhouette",),
            sees="mask",
            bars=(
                *(nearest_found(), median_rotation(), median_translation()),
                *(strict, within_bounds(centimetres=5, degrees=5), said_found()),
            ),
        ),
    )


def _noisy_trial(bop: tuple[Bar, ...]) -> Trial:
    return Trial(
        name="noisy",
        with_vsd=True,
        title="Kinect's noise, masks 1 to 2 px off, up to 30 % hidden, from the nearest pose",
        start="found",
        stages=("depth",),
        noise=Noise(),
        bars=(
            nearest_found(at_least=97),
            *(median_rotation(), median_translation()),
            within_bounds(centimetres=1, degrees=1, at_least=90),
            add_within(0.1, at_least=99.9),
            projection_within(5, at_least=99.5),
            refinement_time(),
            *bop,
            said_found(),
        ),
    )


def _convergence(name: str, perturbation: Perturbation, at_least: float) -> Trial:
    return Trial(
        name=name,
        title=f"clean, from {perturbation.degrees:g}° and {100 * perturbation.metres:g} cm off",
        start=perturbation,
        stages=("depth",),
        bars=(
            within_bounds(centimetres=1, degrees=1, at_least=at_least),
            *(median_rotation(), median_translation(), refinement_time()),
        ),
    )


def _room_trials(_width_px: int) -> tuple[Trial, ...]:
    bars = (
        within_bounds(centimetres=5, degrees=5, at_least=99),
        median_rotation(at_most=0.5),
        median_translation(at_most=10),
        refinement_time(),
        said_found(),
    )
    told = (within_bounds(centimetres=5, degrees=5), median_rotation(), median_translation())
    return (
        Trial(
            name="features",
            title="nearest, then features of these frames",
            start="found",
            stages=("epipolar",),
            bars=told,
        ),
        Trial(name="depth", title="nearest, then depth", start="found", stages=("depth",), bars=bars),
    )


def _points_trials(width_px: int) -> tuple[Trial, ...]:
    return (
        Trial(
            name="real",
            with_vsd=True,
            title=f"real frames, from {SMALL_ERROR.degrees:g}° and {100 * SMALL_ERROR.metres:g} cm off",
            start=SMALL_ERROR,
            stages=("depth",),
            repeats=STARTS_A_FRAME,
            bars=(
                add_s_within(0.1, at_least=100),
                median_fixed_rotation(at_most=3),
                median_rotation(),
                median_translation(),
                add_within(0.1),
                projection_within(5),
                *bop_recalls(width_px=width_px),
                said_found(),
            ),
        ),
    )


def chosen_trials(trials: tuple[Trial, ...], names: tuple[str, ...] | None) -> tuple[Trial, ...]:
    """Return the trials that are named, all where ``names`` is None."""
    return tuple(trial for trial in trials if names is None or trial.name in names)


def trials_for(subject: Subject, names: tuple[str, ...] | None, *, width_px: int) -> tuple[Trial, ...]:
    """Return the trials of a subject that are named, all where ``names`` is None, but for those that it cannot have.

    A mask alone tells nothing where all views are full of the model.
    """
    trials = chosen_trials(trials_of(subject.kind, width_px=width_px), names)
    return tuple(trial for trial in trials if trial.sees != "mask" or subject.has_outline)


TRIAL_NAMES: tuple[str, ...] = tuple(
    trial.name for kind in ("object", "room", "points") for trial in trials_of(kind, width_px=640)
)


def parse_trials(text: str | None) -> tuple[str, ...] | None:
    """Return the trials of a list with commas between; raises InputError for one that there is not."""
    if text is None:
        return None
    names = tuple(text.split(","))
    for name in names:
        if name not in TRIAL_NAMES:
            raise InputError(f"--trials {text}: there is no {name!r}; expected some of {', '.join(TRIAL_NAMES)}")
    return names
