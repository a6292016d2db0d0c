"""What stands around a camera's path: the true mesh, or points that the frames saw; and which way is up."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset
from datagen.preview.source import PreviewSource, evenly
from datagen.rigid import Matrix, transform_points

SAMPLED_FRAMES = 16
POINTS = 60_000
FAINT = 0.45
"""Share of a point's own colour; the rest is paper."""
SNAP_DEG = 30.0
STRAY_PERCENT = 1.0


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Points (N, 3) in the plot's axes, metres, their faint colours (N, 3) from 0 to 1, and what they are."""

    points: NDArray[np.float64]
    colors: NDArray[np.float64]
    meaning: str


def plot_from_world(dataset: Dataset, poses: NDArray[np.float64]) -> tuple[Matrix, bool]:
    """Return the rotation that puts z up, and whether the world's z is up already; ``poses`` (N, 4, 4).

    A scene of ours has z up. Elsewhere up is where the cameras' upper sides point on average, taken as one of the
    world's axes where it is within ``SNAP_DEG`` of it.
    """
    up = np.array([0.0, 0.0, 1.0])
    ours = dataset.metadata is not None and "converted_from" not in dataset.metadata.provenance
    mean = -poses[:, :3, 1].mean(axis=0)
    if not ours and np.linalg.norm(mean) > 0.2:
        mean /= np.linalg.norm(mean)
        axis = np.zeros(3)
        axis[np.abs(mean).argmax()] = np.sign(mean[np.abs(mean).argmax()])
        up = axis if axis @ mean >= np.cos(np.radians(SNAP_DEG)) else mean
    rotation = np.eye(4)
    if up[2] < 1 - 1e-9:
        # The first camera's view becomes the plot's y, so that right stays right.
        forward = poses[0, :3, 2] - (poses[0, :3, 2] @ up) * up
        if np.linalg.norm(forward) < 1e-3:
            forward = np.cross(up, poses[0, :3, 0])
        forward /= np.linalg.norm(forward)
        rotation[:3, :3] = [np.cross(forward, up), forward, up]
    return rotation, bool(up[2] >= 1 - 1e-9)


def surroundings(source: PreviewSource, plot_from_world: Matrix) -> Surroundings | None:
    """Return points of the ground-truth mesh, or where there is none of a few frames' depth; None where no depth is.

    Of the mesh only what lies where the frames saw something is kept, so that a floor without end does not make the
    rest tiny.
    """
    points, colors = seen_points(source)
    if len(points) == 0:
        return None
    low, high = np.percentile(points, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    mesh = source.dataset.ground_truth_mesh
    meaning = "points that the frames saw"
    if mesh is not None and mesh.is_file():
        pad = 0.05 * (high - low).max()
        points, colors = _mesh_points(mesh)
        low, high, meaning = low - pad, high + pad, "the true mesh"
    kept = ((points >= low) & (points <= high)).all(axis=1)
    return Surroundings(
        points=transform_points(plot_from_world, points[kept]),
        colors=1 - FAINT * (1 - colors[kept]),
        meaning=meaning,
    )


def seen_points(source: PreviewSource) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return about ``POINTS`` points (N, 3) in the world that some frames saw, and their colours from 0 to 1."""
    dataset = source.dataset
    chosen = evenly(source.frame_ids, SAMPLED_FRAMES)
    pixels = dataset.camera.width * dataset.camera.height * len(chosen)
    step = max(1, round((pixels / POINTS) ** 0.5))
    small: PinholeCamera = dataset.camera.subsampled(step)
    points, colors = [], []
    for frame_id in chosen:
        depth = source.depth(frame_id)[::step, ::step]
        valid = depth > 0
        points.append(transform_points(dataset.world_from_camera(frame_id), small.back_project(depth)[valid]))
        colors.append(dataset.color(frame_id)[::step, ::step][valid] / 255)
    return np.concatenate(points), np.concatenate(colors)


def _mesh_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ``POINTS`` points spread over a mesh, grey and darker where it faces down, so that its shape shows."""
    mesh = trimesh.load(path, force="mesh", process=False)
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    brightness = 0.45 + 0.2 * np.asarray(mesh.face_normals)[faces, 2]
    return np.asarray(points, dtype=np.float64), np.repeat(brightness[:, None], 3, axis=1)
