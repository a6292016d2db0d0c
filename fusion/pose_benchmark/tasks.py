"""A case's task: a view, spoiled where the trial says so, and where to start."""

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
from datagen.rigid import Matrix
from fusion.pose.nearest_pose import NearestPose, find_nearest_pose
from fusion.pose.nearest_silhouette import NearestOutline, find_nearest_outline
from fusion.pose.query import Query
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.se3 import log_so3
from fusion.pose_benchmark.case_files import Cost, NearestFound
from fusion.pose_benchmark.perturbations import Perturbation, perturbed
from fusion.pose_benchmark.protocol import Trial
from fusion.pose_benchmark.subjects import Fused, Subject
from fusion.pose_benchmark.views import View, spoiled

REFERENCES = 3
"""How many of the nearest fused frames the stages are given, as ``fusion locate`` does."""

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
    """What a case gives to whoever locates: the query, where to start, and the fused frames nearest to that.

    ``others`` are what else the search for the nearest view has found, None where the start is not from there.
    """

    case: Case
    view: View
    query: Query
    start: Matrix
    nearest: NearestFound | None
    references: tuple[ReferenceFrame, ...]
    others: list[Matrix] | None = None

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
    elif trial.sees == "color":
        query = Query(camera=view.camera, mask=view.seen, color=view.color)
    else:
        query = Query(camera=view.camera, depth=view.depth, color=view.color, mask=view.mask)
    task = Task(case=case, view=view, query=query, start=exact.world_from_camera, nearest=None, references=())
    if isinstance(trial.start, Perturbation):
        start = perturbed(exact.world_from_camera, trial.start, pivot_world=subject.centre_world, rng=rng)
        return replace(task, start=start)
    if subject.fused is None:
        raise InputError(f"{subject.name}: was not fused from frames, so that none of them is the nearest")
    if trial.start == "nearest view":
        nearest = np.argsort(view_distances(subject.fused, exact), kind="stable")
        return replace(
            task,
            start=subject.fused.poses[subject.fused.frames[nearest[0]]],
            references=_references(subject.fused, nearest),
        )
    fused = subject.fused
    found, cost = timed(lambda: _found(subject, fused, query))
    return replace(
        task,
        start=found.estimate,
        nearest=_nearest(fused, exact, found, cost),
        references=_references(fused, found.indices),
        others=list(found.others) if isinstance(found, NearestPose) else None,
    )


def _found(subject: Subject, fused: Fused, query: Query) -> NearestPose | NearestOutline:
    """Find the nearest fused view as ``fusion locate`` does: by depth, or by the outline of a mask alone."""
    if query.depth is None:
        return find_nearest_outline(fused.index, subject.model, query)
    return find_nearest_pose(fused.index, query.depth, mask=query.mask)


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


def _nearest(fused: Fused, exact: View, found: NearestPose | NearestOutline, cost: Cost) -> NearestFound:
    distances = view_distances(fused, exact)
    best = int(found.indices[0])
    return NearestFound(
        frame=fused.frames[best],
        distance=float(distances[best]),
        least_distance=float(distances.min()),
        ambiguous=found.ambiguous,
        cost=cost,
    )


def _references(fused: Fused, nearest: NDArray[np.int64]) -> tuple[ReferenceFrame, ...]:
    return tuple(fused.reference(fused.frames[i]) for i in nearest[:REFERENCES])
