"""Locating views: frames of a dataset or single images, in a reconstruction on disk or against a CAD model."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from datagen.atomic_write import write_json
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix
from fusion.devices import Device, load_kernels, resolve_device
from fusion.pose.confidence import assess
from fusion.pose.epipolar import Features
from fusion.pose.located_record import error_fields, pose_fields, refined_record
from fusion.pose.mask_source import MaskChoice, mask_from_depth
from fusion.pose.nearest_pose import find_nearest_pose
from fusion.pose.nearest_silhouette import find_nearest_outline
from fusion.pose.query import Query
from fusion.pose.query_source import QuerySource, SourcedQuery, dataset_queries
from fusion.pose.stages import StageName, default_stages, parse_stages, refine
from fusion.pose.target import Target, is_model_file, open_cad_model, open_reconstruction
from fusion.pose.verdict import Verdict, judge_nearest
from fusion.pose.view_index import ViewIndex, index_views
from fusion.reconstruction_files import (
    POSES_FILE,
    LocatedPose,
    ReconstructionRecord,
    RefinedPose,
    poses_as_json,
    read_record,
)

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.surface.cells",
    "fusion.surface.marching_cubes",
    "fusion.surface.mesh_ray_casting",
    "fusion.surface.vertex_normals",
)


@dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """How views are located.

    ``stages`` are those of ``fusion.pose.stages``, with commas between; None for the nearest pose refined by depth, or
    by the silhouette where the queries have none. ``features`` are the epipolar stage's. ``model_scale`` is metres a
    unit of a CAD model's file, None for 1, and not for reconstructions.
    """

    stages: str | None = None
    features: Features = "sift"
    model_scale: float | None = None
    device: str = "auto"


@dataclass(frozen=True, kw_only=True, eq=False)
class Located:
    """What was found of each query, in order, and what it was located in."""

    results: list[LocatedPose]
    target: Target

    @property
    def poses(self) -> list[LocatedPose]:
        """Those that have a pose: found, or doubtful."""
        return [result for result in self.results if result.world_from_camera is not None]

    @property
    def failures(self) -> dict[int, str]:
        """Why the others were not found, by the query's number."""
        return {result.query: "; ".join(result.reasons) for result in self.results if result.world_from_camera is None}


def locate(
    target: Path,
    dataset: Dataset,
    *,
    frames: str | None = None,
    mask: MaskChoice | None = None,
    stages: str | None = "nearest",
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> Located:
    """Locate frames of a dataset, and write ``poses.json`` into the reconstruction's folder.

    ``target`` is that folder, or a CAD model's file, where nothing is written. ``frames`` is START:STOP:STEP over the
    dataset; without it, all frames are queries, but those that were fused where the reconstruction was made from this
    dataset. ``mask`` says where the object is. A query needs depth; where it has a pose too, the error is given.
    Raises InputError for files that cannot be used.
    """
    source = frames_to_locate(target, dataset, frames=frames, mask=mask)
    located = locate_queries(target, source, LocateOptions(stages=stages, device=device), progress=progress)
    if not is_model_file(target):
        write_poses(target / POSES_FILE, located)
    return located


def frames_to_locate(target: Path, dataset: Dataset, *, frames: str | None, mask: MaskChoice | None) -> QuerySource:
    """Return the queries that a dataset gives: see ``locate``."""
    chosen = None if frames is not None or is_model_file(target) else _held_out(target, read_record(target), dataset)
    return dataset_queries(dataset, frames=frames, chosen=chosen, mask=mask)


def write_poses(path: Path, located: Located) -> None:
    """Write what was found as JSON, atomically."""
    write_json(path, poses_as_json(located.results))


def locate_queries(
    target: Path, source: QuerySource, options: LocateOptions, *, progress: ProgressReporter = silent
) -> Located:
    """Locate queries in a reconstruction's folder or against a CAD model's file; nothing is written.

    Raises InputError for files that cannot be used, stages that the queries have nothing for, and a CAD model whose
    size cannot be meant.
    """
    stages = _stages(options, source)
    device = resolve_device(options.device)
    load_kernels(KERNEL_MODULES, device=device, progress=progress)
    opened = _open(target, source, options, stages, device)
    if source.derive_mask and not source.has_depth:
        raise InputError("--mask derived: it is derived from depth, which the query has none of; give --mask FILE")
    views = index_views(opened.model.mesh, opened.views, source.camera, device=device)
    locator = _Locator(target=opened, views=views, source=source, stages=stages, features=options.features)
    results = []
    advance = progress("locate", len(source.numbers))
    for number in source.numbers:
        results.append(locator.locate(source.read(number)))
        advance()
    return Located(results=results, target=opened)


def _stages(options: LocateOptions, source: QuerySource) -> tuple[StageName, ...]:
    usual = default_stages(has_depth=source.has_depth, has_color=source.has_color)
    stages = usual if options.stages is None else parse_stages(options.stages)
    lacking = {
        "depth": "" if source.has_depth else "depth, which the queries have none of; use nearest,silhouette",
        "epipolar": "" if source.has_color else "colour, which the queries have none of; leave epipolar out",
    }
    for stage in stages:
        if lacking.get(stage):
            raise InputError(f"--stages {options.stages}: {stage} needs {lacking[stage]}")
    return stages


def _open(
    target: Path, source: QuerySource, options: LocateOptions, stages: tuple[StageName, ...], device: Device
) -> Target:
    if is_model_file(target):
        query = source.read(source.numbers[0]).query
        valid = None if query.depth is None else query.valid_depth()
        typical = float(np.median(valid[valid > 0])) if valid is not None and (valid > 0).any() else None
        scale = 1.0 if options.model_scale is None else options.model_scale
        return open_cad_model(
            target, scale=scale, camera=source.camera, typical_depth=typical, device=device, frames_for=stages
        )
    if options.model_scale is not None:
        raise InputError(f"--model-scale: {target} is a reconstruction, which is in metres; it is for CAD models")
    return open_reconstruction(target, device=device, frames_for=stages)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Nearest:
    """The first guess, by depth or by outline: see ``NearestPose`` and ``NearestOutline``."""

    indices: np.ndarray
    score: float | None
    estimate: Matrix
    others: list[Matrix] | None
    ambiguous: bool
    verdict: Verdict


@dataclass(frozen=True, kw_only=True, eq=False)
class _Locator:
    target: Target
    views: ViewIndex
    source: QuerySource
    stages: tuple[StageName, ...]
    features: Features

    @cached_property
    def _refines(self) -> bool:
        return len(self.stages) > 1

    def locate(self, sourced: SourcedQuery) -> LocatedPose:
        """Run the stages for one query."""
        query = self._prepared(sourced.query)
        try:
            nearest = self._nearest(query)
        except InputError as error:
            return LocatedPose(query=sourced.number, verdict="not found", reasons=[str(error)])
        refined = self._refined(query, nearest, sourced.truth) if self._refines else None
        verdict = nearest.verdict if refined is None else Verdict(refined.verdict, tuple(refined.reasons))
        pose = self.target.views[int(nearest.indices[0])]
        numbers = [self.target.numbers[int(i)] for i in nearest.indices]
        gone = verdict.answer == "not found"
        return LocatedPose(
            query=sourced.number,
            verdict=verdict.answer,
            reasons=list(verdict.reasons),
            nearest=numbers[0],
            score=nearest.score,
            nearest_frames=numbers,
            ambiguous=nearest.ambiguous,
            refined=refined,
            **({} if gone else pose_fields(pose)),
            **({} if gone else error_fields(pose, sourced.truth)),
        )

    def _prepared(self, query: Query) -> Query:
        """Return the query without what is too far away, and with the mask that its depth tells if that is wanted."""
        if query.depth is None:
            return query
        depth = np.where(query.depth > self.target.depth_max, 0, query.whole_depth()).astype(np.float32)
        mask = query.mask
        if self.source.derive_mask:
            mask = mask_from_depth(depth, query.camera, self.target.model.diameter)
        return replace(query, depth=depth, mask=mask)

    def _nearest(self, query: Query) -> _Nearest:
        if query.mask is not None and not query.mask.any():
            how = ": no piece of its depth has the model's size" if self.source.derive_mask else ""
            raise InputError(f"the mask is empty{how}")
        if query.depth is None:
            outline = find_nearest_outline(self.views, self.target.model, query)
            return _Nearest(
                indices=outline.indices,
                score=None,
                estimate=outline.estimate,
                others=None,
                ambiguous=outline.ambiguous,
                verdict=judge_nearest(1 - outline.overlap, ambiguous=outline.ambiguous),
            )
        found = find_nearest_pose(self.views, query.depth, mask=query.mask)
        return _Nearest(
            indices=found.indices,
            score=float(found.scores[0]),
            estimate=found.estimate,
            others=list(found.others),
            ambiguous=found.ambiguous,
            verdict=judge_nearest(found.cost, ambiguous=found.ambiguous),
        )

    def _refined(self, query: Query, nearest: _Nearest, truth: Matrix | None) -> RefinedPose:
        references = self.target.references(nearest.estimate, nearest.indices)
        model, others = self.target.model, nearest.others
        results = refine(model, query, references, nearest.estimate, self.stages, others=others, features=self.features)
        return refined_record(results, assess(model, query, results), truth)


def _held_out(folder: Path, record: ReconstructionRecord, dataset: Dataset) -> tuple[int, ...] | None:
    """Return the frames that were not fused, None for all where the reconstruction is of another dataset."""
    if (folder / record.dataset).resolve() != dataset.folder.resolve():
        return None
    fused = {frame.frame for frame in record.trajectory}
    held_out = tuple(frame_id for frame_id in dataset.frame_ids if frame_id not in fused)
    if not held_out:
        raise InputError(
            f"{dataset.folder}: all of its frames were fused, none is left to locate; "
            "choose some with --frames, or reconstruct from every second one with --frames ::2"
        )
    return held_out
