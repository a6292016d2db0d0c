"""Figure 11: the same volume meshed in different ways, with what each costs and gains."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import transform_points
from fusion.evaluation.evaluate import Observers, SurfaceSamples, seen_truth
from fusion.evaluation.sharp_edges import seen_sharp_edges, sharp_edge_error, smooth_error
from fusion.report.figures import Figure, Panel, Subject, error_panel, mesh_panel
from fusion.report.runs import MeshedRun, Run, drop_volume, mesh_run, meshed
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CLOSER = 5
"""How much larger the close-ups are."""

SMOOTH_VOXELS = 2.0
"""From a sharp edge; what is farther counts as smooth."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way of meshing: the name of its files, its title, the changes of the configuration, and of the voxel size."""

    key: str
    title: str
    changes: dict[str, object]
    coarser: int = 1


WAYS = (
    Way(key="marching-cubes", title="marching cubes", changes={"mesher": "marching-cubes"}),
    Way(
        key="dual-contouring",
        title="dual contouring of the volume",
        changes={"mesher": "dual-contouring", "oracle": "volume"},
    ),
    Way(
        key="dual-contouring-depth",
        title="dual contouring of the depth images",
        changes={"mesher": "dual-contouring", "oracle": "depth"},
    ),
    Way(
        key="dual-contouring-depth-coarse",
        title="of the depth images, voxels twice as large",
        changes={"mesher": "dual-contouring", "oracle": "depth"},
        coarser=2,
    ),
)
RUNS = len(WAYS)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A way, what it made, and its mean errors in metres at the truth's sharp edges and on smooth parts, if any."""

    way: Way
    made: MeshedRun
    sharp: float | None
    smooth: float | None


def meshers(subject: Subject) -> Figure:
    """Mesh the subject's volume in all ways: pictures, close-ups at a sharp edge, and errors beneath each other."""
    outcomes = list(_outcomes(subject))
    first = outcomes[0]
    most = first.made.run.record.voxel_size_m / 2
    camera = _close_up(subject, first.made.run, outcomes[2].made.run)
    whole, near, errors = [], [], []
    for outcome in outcomes:
        result, name, title = outcome.made.run, f"mesher-{outcome.way.key}", outcome.way.title
        whole.append(mesh_panel(subject, result, name, title, extra=_numbers(outcome, first)))
        picture = subject.picture(result.mesh, camera=camera)
        near.append(Panel(name=f"{name}-close", title=f"{title}: {CLOSER} times closer", image=picture))
        error = error_panel(subject, result, f"{name}-error", f"{title}: error", most=most)
        if error is not None:
            errors.append(error)
    return Figure(
        heading="Fig. 11: marching cubes and dual contouring",
        text=_in_words(outcomes),
        panels=(*whole, *near, *errors),
        columns=len(outcomes),
    )


def _outcomes(subject: Subject) -> Iterator[Outcome]:
    assert subject.ground_truth is not None, "only a mesh whose truth is known is held against it"
    assert subject.base.voxel_size is not None
    truth = subject.ground_truth
    made = _meshed(subject)
    record, seen_by = made[0].run.record, _observers(subject, made[0].run)
    edges = seen_sharp_edges(truth, spacing=record.voxel_size_m / 2, observed_by=seen_by, device=subject.device)
    for way, one in zip(WAYS, made, strict=True):
        mesh, beyond = one.run.mesh, SMOOTH_VOXELS * record.voxel_size_m
        yield Outcome(
            way=way,
            made=one,
            sharp=sharp_edge_error(mesh, edges, device=subject.device),
            smooth=smooth_error(mesh, truth, beyond=beyond, device=subject.device),
        )


def _meshed(subject: Subject) -> list[MeshedRun]:
    """Mesh in each way what is fused once a voxel size; what was made before is read."""
    assert subject.ground_truth is not None
    assert subject.base.voxel_size is not None
    made: dict[str, MeshedRun] = {}
    seen = None
    for coarser in sorted({way.coarser for way in WAYS}):
        size = subject.base.voxel_size * coarser
        lengths = {} if coarser == 1 else {"voxel_size": size, "truncation": 4 * size}
        configs = {way.key: subject.config(**lengths, **way.changes) for way in WAYS if way.coarser == coarser}
        folders = {key: subject.folder_of(config, "meshed-") for key, config in configs.items()}
        found = {key: meshed(subject.dataset, folders[key], config) for key, config in configs.items()}
        fused: Run | None = None
        for key, config in configs.items():
            before = found[key]
            if before is None:
                fused = fused or subject.reconstruct(keep_volume=True, **lengths)
                seen = seen or _seen(subject, fused)
                before = mesh_run(
                    fused, folders[key], config, truth=(subject.ground_truth, seen), device=subject.device
                )
            made[key] = before
            subject.advance()
        if fused is not None:
            drop_volume(fused.folder)
    return [made[way.key] for way in WAYS]


def _seen(subject: Subject, fused: Run) -> SurfaceSamples:
    assert subject.ground_truth is not None
    return seen_truth(subject.ground_truth, _observers(subject, fused), device=subject.device)


def _observers(subject: Subject, fused: Run) -> Observers:
    frames = tuple(frame.frame for frame in fused.record.trajectory)
    return Observers(dataset=subject.dataset, frame_ids=frames, depth_max=fused.record.depth_max_m)


def _numbers(outcome: Outcome, first: Outcome) -> tuple[tuple[str, str], ...]:
    seconds = outcome.made.seconds
    text = f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"
    numbers = [("meshing", f"{text}, ×{_short(seconds / first.made.seconds)}")]
    for name, error in (("sharp edges", outcome.sharp), ("smooth parts", outcome.smooth)):
        if error is not None:
            numbers.append((name, f"{1000 * error:.3g} mm"))
    return tuple(numbers)


def _short(ratio: float) -> str:
    """Return a ratio with one decimal where it is small."""
    return f"{ratio:.1f}" if ratio < 10 else f"{ratio:,.0f}"


def _in_words(outcomes: Sequence[Outcome]) -> str:
    """Say what the numbers beneath the pictures say."""
    cubes, volume, depth, coarse = outcomes

    def times(one: Outcome) -> str:
        return _short(one.made.seconds / cubes.made.seconds)

    def vertices(one: Outcome) -> str:
        return f"{100 * len(one.made.run.mesh.vertices) / len(cubes.made.run.mesh.vertices):.0f} %"

    text = (
        "The paper calls dual contouring cleaner and lower in polygons, but expensive. On the same voxels it costs "
        f"{times(volume)} times marching cubes' time if it goes by the volume, {times(depth)} times if it asks the "
        f"depth images, and has {vertices(depth)} of its vertices. On voxels twice as large it has {vertices(coarse)} "
        f"of them, costs {times(coarse)} times marching cubes' time on the small ones, and has "
        f"{_chamfer(coarse) / _chamfer(cubes):.2f} times its chamfer distance. "
    )
    if cubes.sharp and depth.sharp and volume.sharp:
        text += (
            f"Sharp edges of the truth are {cubes.sharp / depth.sharp:.1f} times nearer to the mesh if the depth "
            f"images are asked, {cubes.sharp / volume.sharp:.1f} times if only the volume is, rounded by its voxels. "
        )
    return text + (
        "Time is the processor time of all cores, after the images are decoded. Smooth parts are two voxels and more "
        "from a sharp edge. Close-ups show where marching cubes and dual contouring of the depth images differ most."
    )


def _chamfer(outcome: Outcome) -> float:
    metrics = outcome.made.run.record.metrics
    assert metrics is not None
    return float(metrics["chamfer_m"])


def _close_up(subject: Subject, one: Run, other: Run) -> PinholeCamera:
    """Return the subject's camera, closer to where the errors of two meshes differ most, each up to half a voxel."""
    most = one.record.voxel_size_m / 2
    difference = np.abs(_errors_seen(subject, one.mesh, most) - _errors_seen(subject, other.mesh, most))
    camera = subject.camera
    width, height = camera.width // CLOSER, camera.height // CLOSER
    inside = cv2.boxFilter(difference, -1, (width, height))[height // 2 : -height // 2, width // 2 : -width // 2]
    v, u = divmod(int(np.argmax(inside)), inside.shape[1])
    return replace(
        camera,
        fx=CLOSER * camera.fx,
        fy=CLOSER * camera.fy,
        cx=CLOSER * (camera.cx - (u + width // 2)) + (camera.width - 1) / 2,
        cy=CLOSER * (camera.cy - (v + height // 2)) + (camera.height - 1) / 2,
    )


def _errors_seen(subject: Subject, mesh: Mesh, most: float) -> NDArray[np.float64]:
    """Return for each pixel (height, width) how far what it sees is from the truth, metres up to ``most``."""
    assert subject.ground_truth is not None
    pose = subject.world_from_camera
    depth = cast_rays_at_mesh(mesh, subject.camera, [pose], device=subject.device).depth.numpy()[0]
    errors, hit = np.zeros(depth.shape), depth > 0
    points = transform_points(pose, subject.camera.back_project(depth)[hit])
    errors[hit] = np.minimum(closest_points(subject.ground_truth, points, device=subject.device).distances, most)
    return errors
