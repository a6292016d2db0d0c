"""The stages of locating a view, one after the other: epipolar rectification, silhouette, depth."""

from collections.abc import Callable, Sequence
from typing import Literal, get_args

from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.pose.combination import combined
from fusion.pose.depth_refinement import refine_with_depth
from fusion.pose.epipolar import EpipolarOptions, Features, rectify
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.refinement import Refinement, Stage
from fusion.pose.silhouette_refinement import refine_with_silhouette

StageName = Literal["nearest", "epipolar", "silhouette", "depth"]
STAGES: tuple[StageName, ...] = get_args(StageName)


def parse_stages(text: str) -> tuple[StageName, ...]:
    """Return the stages of a list such as ``nearest,depth``.

    Raises InputError for an unknown one, one that is named twice, and where the first is not ``nearest``, from which
    all others start.
    """
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in STAGES]
    if unknown or names[0] != "nearest" or len(set(names)) < len(names):
        raise InputError(f"--stages {text}: expected nearest first, then any of {', '.join(STAGES[1:])}, each once")
    return tuple(name for wanted in names for name in STAGES if name == wanted)


def default_stages(*, has_depth: bool, has_color: bool) -> tuple[StageName, ...]:
    """Return the stages that queries with depth, or else with a mask and perhaps colour, are located by."""
    if has_depth:
        return ("nearest", "depth")
    return ("nearest", "epipolar", "silhouette") if has_color else ("nearest", "silhouette")


def refine(
    model: PoseModel,
    query: Query,
    references: Sequence[ReferenceFrame],
    start: Matrix,
    stages: Sequence[StageName],
    *,
    others: Sequence[Matrix] | None = None,
    features: Features = "sift",
) -> list[Refinement]:
    """Run ``stages`` from ``start`` (world_from_camera), each from the pose that the one before it hands on.

    ``references`` are the fused frames nearest to the start: the epipolar stage, whose ``features`` are SIFT, ORB or
    AKAZE, cannot do without, and the others take from them what the model is off by. ``others`` are what else the
    search for the nearest pose has found, None where the start is not from there: the depth stage tries them, too. The
    silhouette's pose is combined with that of the features before it.
    ``nearest`` is what the start came from, and nothing is done for it.
    """
    run: dict[Stage, Callable[[Matrix], Refinement]] = {
        "epipolar": lambda pose: rectify(model, query, references, pose, options=EpipolarOptions(features=features)),
        "silhouette": lambda pose: refine_with_silhouette(model, query, pose, references=references),
        "depth": lambda pose: refine_with_depth(model, query, pose, references=references, others=others),
    }
    results: list[Refinement] = []
    pose = start
    for name in stages:
        if name == "nearest":
            continue
        found = run[name](pose)
        if name == "silhouette" and results and results[-1].stage == "epipolar":
            # Where the outline hardly fixes the pose, the features' stays, and the other way round.
            found = combined(results[-1], found)
        results.append(found)
        pose = found.world_from_camera
    return results
