"""Figure 11: the same volume meshed in different ways, with what each costs and gains."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from fusion.evaluation.sharp_edges import seen_sharp_edges, sharp_edge_error, smooth_error
from fusion.report.close_up import close_up
from fusion.report.mesher_findings import DECIMATED_TO, FLATNESS, Outcome, Outcomes, findings
from fusion.report.panels import (
    Figure,
    Numbers,
    Panel,
    Picture,
    clay_picture,
    duration,
    error_picture,
    errors,
    millimetres,
    percent,
    ratio,
)
from fusion.report.runs import Run, drop_volume, mesh_run, meshed
from fusion.report.subject import Subject
from fusion.report.thin_triangles import THIN_DEG, thin_share
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_operations import decimate

SMOOTH_VOXELS = 2.0
"""From a sharp edge; what is farther counts as smooth."""

COLUMNS = 3


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way of meshing: the name of its files, its title, the changes of the configuration, and of the voxel size."""

    key: str
    title: str
    changes: Mapping[str, object]
    coarser: int = 1


CUBES = {"mesher": "marching-cubes"}
VOLUME = {"mesher": "dual-contouring", "oracle": "volume"}
DEPTH = {"mesher": "dual-contouring", "oracle": "depth"}
WAYS = (
    Way(key="marching-cubes", title="marching cubes", changes=CUBES),
    Way(key="dual-contouring", title="dual contouring of the volume", changes=VOLUME),
    Way(key="dual-contouring-depth", title="dual contouring of the depth images", changes=DEPTH),
    Way(
        key="dual-contouring-depth-merged",
        title=f"dual contouring of the depth images, cells merged where flat to {FLATNESS:g} voxels",
        changes={**DEPTH, "flatness": FLATNESS},
    ),
    Way(key="marching-cubes-coarse", title="marching cubes, voxels twice as large", changes=CUBES, coarser=2),
    Way(
        key="dual-contouring-depth-coarse",
        title="dual contouring of the depth images, voxels twice as large",
        changes=DEPTH,
        coarser=2,
    ),
)
RUNS = len(WAYS)


def meshers(subject: Subject) -> Figure:
    """Mesh the subject's volume in all ways: pictures, close-ups where they differ, and errors beneath each other."""
    outcomes = dict(_outcomes(subject))
    cubes, depth = outcomes["marching-cubes"], outcomes["dual-contouring-depth"]
    near = close_up(subject, cubes.run.mesh, depth.run.mesh)
    panels = []
    for way in WAYS:
        outcome, name = outcomes[way.key], f"mesher-{way.key}"
        mesh = outcome.run.mesh
        pictures = (
            clay_picture(subject, outcome.run, name, extra=_cost(outcome, cubes)),
            Picture(
                name=f"{name}-close",
                image=subject.picture(mesh, camera=near.camera, wires=True),
                caption="close-up",
                numbers=(("across", millimetres(near.width)), (f"under {THIN_DEG:g}°", percent(outcome.thin))),
            ),
            *error_picture(subject, mesh, name, most=subject.voxel_size / 2, numbers=_errors(outcome)),
        )
        panels.append(Panel(title=way.title, pictures=pictures))
    return Figure(
        heading="Fig. 11: marching cubes and dual contouring",
        text="The paper: marching cubes makes a denser and noisier surface, dual contouring a cleaner mesh of fewer "
        "polygons, but is computationally expensive. Here dual contouring goes by the volume, or asks the depth images "
        "that were fused into it, which still have what voxels have rounded. The close-ups show where marching cubes "
        "and dual contouring of the depth images differ most.",
        panels=tuple(panels),
        columns=COLUMNS,
        findings=findings(
            Outcomes(
                cubes=cubes,
                volume=outcomes["dual-contouring"],
                depth=depth,
                merged=outcomes["dual-contouring-depth-merged"],
                coarse_cubes=outcomes["marching-cubes-coarse"],
                coarse_depth=outcomes["dual-contouring-depth-coarse"],
            ),
            on_gpu=subject.device.is_cuda,
        ),
    )


def _outcomes(subject: Subject) -> Iterator[tuple[str, Outcome]]:
    """Yield each way's key and what came of it."""
    assert subject.truth is not None, "only a mesh whose truth is known is held against it"
    truth, spacing = subject.truth.mesh, subject.voxel_size / 2
    made = _meshed(subject)
    edges = seen_sharp_edges(truth, spacing=spacing, observed_by=subject.observers, device=subject.device)
    for key, run in made.items():
        yield (
            key,
            Outcome(
                run=run,
                sharp=sharp_edge_error(run.mesh, edges, device=subject.device),
                smooth=smooth_error(run.mesh, truth, beyond=SMOOTH_VOXELS * subject.voxel_size, device=subject.device),
                thin=thin_share(run.mesh),
                decimated=_decimated_error(subject, run.mesh),
            ),
        )


def _decimated_error(subject: Subject, mesh: Mesh) -> float:
    """Return the chamfer distance, metres, of a mesh decimated to ``DECIMATED_TO`` of its triangles."""
    shape = Mesh(vertices=mesh.vertices, triangles=mesh.triangles)  # colours take longer than all else
    metrics = subject.judge(decimate(shape, round(DECIMATED_TO * len(mesh.triangles)), device=subject.device))
    assert metrics is not None
    return float(metrics["chamfer_m"])


def _meshed(subject: Subject) -> dict[str, Run]:
    """Mesh in each way what is fused once a voxel size; what was made before is read."""
    assert subject.truth is not None
    thresholds = (subject.voxel_size / 2, subject.voxel_size)
    made: dict[str, Run] = {}
    for coarser in sorted({way.coarser for way in WAYS}):
        size = subject.voxel_size * coarser
        lengths = {} if coarser == 1 else {"voxel_size": size, "truncation": 4 * size}
        fused: Run | None = None
        for way in WAYS:
            if way.coarser != coarser:
                continue
            config = subject.config(**lengths, **way.changes)
            folder = subject.folder_of(config, "meshed-")
            before = meshed(subject.dataset, folder, config)
            if before is None:
                fused = fused or subject.reconstruct(keep_volume=True, **lengths)
                before = mesh_run(
                    fused,
                    folder,
                    config,
                    truth=subject.truth.mesh,
                    seen=subject.truth.seen,
                    thresholds=thresholds,
                    device=subject.device,
                )
            made[way.key] = before
            subject.advance()
        if fused is not None:
            drop_volume(fused.folder)
    return made


def _cost(outcome: Outcome, first: Outcome) -> Numbers:
    seconds = outcome.run.mesh_seconds
    times = "" if outcome is first else f", ×{ratio(seconds / first.run.mesh_seconds)}"
    return (("meshing", f"{duration(seconds)}{times}"),)


def _errors(outcome: Outcome) -> Numbers:
    assert outcome.run.record.metrics is not None
    more = [
        (name, millimetres(error))
        for name, error in (("sharp edges", outcome.sharp), ("smooth parts", outcome.smooth))
        if error is not None
    ]
    decimated = (f"decimated to {100 * DECIMATED_TO:.0f} %", millimetres(outcome.decimated))
    return (*errors(outcome.run.record.metrics), *more, decimated)
