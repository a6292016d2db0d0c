"""One case: a view, spoiled where the trial says so, a start, the stages, and the errors of what they found."""

import hashlib
import json
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError
from datagen.rigid import Matrix, inverse
from fusion.evaluation.pose_errors import (
    average_distance,
    average_nearest_distance,
    mspd,
    mssd,
    projection_error_px,
    rotation_error_deg,
    translation_error,
    visible_surface_discrepancy,
)
from fusion.pose.epipolar import ReferenceFrame
from fusion.pose.evidence import gather_evidence
from fusion.pose.nearest_pose import NearestPose, find_nearest_pose
from fusion.pose.query import Query
from fusion.pose.se3 import log_so3
from fusion.pose.stages import refine
from fusion.pose.verdict import judge
from fusion.pose_benchmark.case_files import CaseResult, Cost, NearestFound, PoseErrors
from fusion.pose_benchmark.perturbations import Perturbation, perturbed
from fusion.pose_benchmark.protocol import Trial
from fusion.pose_benchmark.subjects import Fused, Subject
from fusion.pose_benchmark.views import View, spoiled
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

REFERENCES = 3
"""How many of the nearest fused frames the features are looked for in, as ``fusion locate`` does."""

_Value = TypeVar("_Value")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A query of a subject in a trial; ``repeat`` counts the starts from one frame."""

    subject: Subject
    trial: Trial
    frame: int
    repeat: int
    seed: int

    @property
    def rng(self) -> np.random.Generator:
        """The case's own randomness, the same in whatever order cases are run."""
        names = zlib.crc32(f"{self.subject.name}/{self.trial.name}".encode())
        return np.random.default_rng([self.seed, names, self.frame, self.repeat])

    @property
    def identity(self) -> str:
        """A digest of what the result depends on, but for the program itself."""
        told = [self.subject.identity, self.trial.conditions, self.frame, self.repeat, self.seed]
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """What a case gives to whoever locates: the query, where to start, and the fused frames nearest to that."""

    case: Case
    view: View
    query: Query
    start: Matrix
    nearest: NearestFound | None
    references: tuple[ReferenceFrame, ...]

    @property
    def truth(self) -> Matrix:
        """The query's true world_from_camera."""
        return self.view.world_from_camera


def make_task(case: Case) -> Task:
    """Make a case's query and start; raises InputError where no start can be found."""
    trial, subject, rng = case.trial, case.subject, case.rng
    exact = subject.view(case.frame)
    view = exact if trial.noise is None else spoiled(exact, trial.noise, rng=rng)
    if trial.sees == "mask":
        query = Query(camera=view.camera, mask=view.seen)
    else:
        query = Query(camera=view.camera, depth=view.depth, color=view.color, mask=view.mask)
    task = Task(case=case, view=view, query=query, start=exact.world_from_camera, nearest=None, references=())
    if isinstance(trial.start, Perturbation):
        start = perturbed(exact.world_from_camera, trial.start, pivot_world=subject.centre_world, rng=rng)
        return replace(task, start=start)
    if subject.fused is None:
        raise InputError(f"{subject.name}: was not fused from frames, so that none of them is the nearest")
    if trial.start == "nearest view":
        return replace(task, start=subject.fused.poses[_truly_nearest(subject.fused, exact)])
    found, cost = timed(lambda: find_nearest_pose(subject.fused.index, view.depth, mask=view.mask))  # type: ignore[union-attr]
    return replace(
        task,
        start=found.estimate,
        nearest=_nearest(subject.fused, exact, found, cost),
        references=_references(subject.fused, trial, found),
    )


def timed(work: Callable[[], _Value]) -> tuple[_Value, Cost]:
    """Return what ``work`` returns, and what it cost."""
    processor, wall = time.process_time(), time.perf_counter()
    value = work()
    return value, Cost(processor_s=time.process_time() - processor, wall_s=time.perf_counter() - wall)


def view_distances(fused: Fused, view: View) -> NDArray[np.float64]:
    """Return how far each fused view is from a query, radians: √(θ² + (‖t‖/z)²), z the median depth of what it sees."""
    depth = float(np.median(view.depth[view.seen]))
    pose, others = view.world_from_camera, np.stack(list(fused.poses.values()))
    turns = np.linalg.norm(log_so3(np.swapaxes(others[:, :3, :3], 1, 2) @ pose[:3, :3]), axis=1)
    shifts = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    return np.hypot(turns, shifts / depth)


def _truly_nearest(fused: Fused, exact: View) -> int:
    return fused.frames[int(view_distances(fused, exact).argmin())]


def _nearest(fused: Fused, exact: View, found: NearestPose, cost: Cost) -> NearestFound:
    distances = view_distances(fused, exact)
    return NearestFound(
        frame=fused.frames[found.index],
        distance=float(distances[found.index]),
        least_distance=float(distances.min()),
        ambiguous=found.ambiguous,
        cost=cost,
    )


def _references(fused: Fused, trial: Trial, found: NearestPose) -> tuple[ReferenceFrame, ...]:
    if "epipolar" not in trial.stages:
        return ()
    return tuple(fused.reference(fused.frames[i]) for i in found.indices[:REFERENCES])


def run_case(case: Case) -> CaseResult:
    """Locate a case's view and measure how far off it is; what cannot be located is told, not raised."""
    outline = CaseResult(
        subject=case.subject.name,
        trial=case.trial.name,
        frame=case.frame,
        repeat=case.repeat,
        identity=case.identity,
        diameter_m=case.subject.points.diameter,
        truth=case.subject.view(case.frame).world_from_camera.tolist(),
    )
    try:
        task = make_task(case)
    except InputError as error:
        return outline.model_copy(update={"failure": str(error)})
    results, cost = timed(
        lambda: refine(case.subject.model, task.query, task.references, task.start, case.trial.stages)
    )
    estimate = results[-1].world_from_camera
    verdict = judge(results[-1], gather_evidence(case.subject.model, task.query, estimate))
    ambiguous = task.nearest is not None and task.nearest.ambiguous
    return outline.model_copy(
        update={
            "start": task.start.tolist(),
            "start_errors": pose_errors(task, task.start),
            "estimate": results[-1].world_from_camera.tolist(),
            "errors": pose_errors(task, results[-1].world_from_camera, with_vsd=case.trial.with_vsd),
            "nearest": task.nearest,
            "verdict": "doubtful" if ambiguous and verdict.answer == "found" else verdict.answer,
            "reasons": verdict.reasons,
            "cost": cost,
        }
    )


def pose_errors(task: Task, world_from_camera: Matrix, *, with_vsd: bool = False) -> PoseErrors:
    """Return the errors of a pose that was found for a task's query."""
    subject, truth = task.case.subject, task.truth
    if subject.kind == "room":
        return PoseErrors(
            rotation_deg=rotation_error_deg(world_from_camera, truth),
            translation_m=float(np.linalg.norm(world_from_camera[:3, 3] - truth[:3, 3])),
        )
    found, there, points, camera = inverse(world_from_camera), inverse(truth), subject.points, task.view.camera
    return PoseErrors(
        rotation_deg=rotation_error_deg(found, there),
        translation_m=translation_error(found, there, point_model=subject.centre_world),
        fixed_rotation_deg=_fixed_rotation_deg(subject, found, there),
        add_m=average_distance(found, there, points),
        add_s_m=average_nearest_distance(found, there, points),
        projection_px=_or_none(projection_error_px(found, there, points, camera)),
        mssd_m=mssd(found, there, points),
        mspd_px=_or_none(mspd(found, there, points, camera)),
        vsd=_vsd(task, world_from_camera) if with_vsd else None,
    )


def _fixed_rotation_deg(subject: Subject, estimate: Matrix, truth: Matrix) -> float:
    """Return the angle between two poses, without the turn about the axis of a body of revolution."""
    if subject.revolution_axis is None:
        return rotation_error_deg(estimate, truth)
    found, there = estimate[:3, :3] @ subject.revolution_axis, truth[:3, :3] @ subject.revolution_axis
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(found, there)), found @ there)))


def _vsd(task: Task, world_from_camera: Matrix) -> tuple[float, ...]:
    subject, camera = task.case.subject, task.view.camera
    poses = [world_from_camera, task.truth]
    seen = cast_rays_at_mesh(subject.model.mesh, camera, poses, device=subject.model.device, depth_only=True)
    estimate, truth = seen.depth.numpy()
    return visible_surface_discrepancy(estimate, truth, task.view.depth, camera, diameter=subject.points.diameter)


def _or_none(error: float) -> float | None:
    return error if np.isfinite(error) else None
