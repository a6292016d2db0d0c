"""The coloured points that a dataset's depth images show, in world coordinates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.rigid import transform_points

FARTHEST_VOXEL = 2**20
"""Voxel numbers of three axes, signed, are packed into one 64-bit number."""


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """``points_world`` (N, 3) float64 metres and their ``colors`` (N, 3) uint8 sRGB."""

    points_world: NDArray[np.float64]
    colors: NDArray[np.uint8]


def frame_points(dataset: Dataset, frame_id: int) -> PointCloud:
    """Return a point for each pixel of a frame that has depth."""
    depth = dataset.depth(frame_id)
    seen = depth > 0
    points_camera = dataset.camera.back_project(depth)[seen]
    return PointCloud(
        points_world=transform_points(dataset.world_from_camera(frame_id), points_camera),
        colors=dataset.color(frame_id)[seen],
    )


def dataset_points(
    dataset: Dataset,
    frame_ids: Sequence[int],
    *,
    voxel_size: float | None = None,
    advance: Callable[[], None] = lambda: None,
) -> PointCloud:
    """Return the points of some frames; with ``voxel_size`` (metres) the mean point and colour of each voxel.

    Voxels are averaged as frames are read, so that memory holds them and one frame. Raises InputError where a point
    lies more than ``FARTHEST_VOXEL`` voxels from the origin, and where there are no points at all.
    """
    sums = _VoxelSums(voxel_size) if voxel_size is not None else None
    clouds = []
    for frame_id in frame_ids:
        cloud = frame_points(dataset, frame_id)
        if sums is not None:
            sums.add(cloud)
        else:
            clouds.append(cloud)
        advance()
    if sums is not None:
        clouds.append(sums.means())
    points = np.concatenate([cloud.points_world for cloud in clouds])
    if not len(points):
        raise InputError(f"{dataset.folder}: no pixel of the chosen frames has depth")
    return PointCloud(points_world=points, colors=np.concatenate([cloud.colors for cloud in clouds]))


def write_point_cloud(path: Path, cloud: PointCloud) -> None:
    """Write points and colours atomically as binary PLY, coordinates in single precision."""
    shape = trimesh.PointCloud(cloud.points_world, colors=cloud.colors)
    write_bytes(path, shape.export(file_type="ply"))


class _VoxelSums:
    """Sums of points and colours by voxel, in the order of the voxels' packed numbers."""

    def __init__(self, voxel_size: float) -> None:
        self._size = voxel_size
        self._voxels = np.empty(0, np.int64)
        self._sums = np.empty((0, 7))

    def add(self, cloud: PointCloud) -> None:
        numbers = np.floor(cloud.points_world / self._size)
        if (np.abs(numbers) >= FARTHEST_VOXEL).any():
            farthest = float(np.abs(cloud.points_world).max())
            raise InputError(f"--voxel-size {self._size:g}: too small for points {farthest:.1f} m from the origin")
        x, y, z = (numbers.astype(np.int64) + FARTHEST_VOXEL).T
        values = np.column_stack([cloud.points_world, cloud.colors, np.ones(len(x))])
        voxels = np.concatenate([self._voxels, (x << 42) | (y << 21) | z])
        self._voxels, place = np.unique(voxels, return_inverse=True)
        values = np.concatenate([self._sums, values])
        count = len(self._voxels)
        self._sums = np.column_stack([np.bincount(place, column, minlength=count) for column in values.T])

    def means(self) -> PointCloud:
        count = self._sums[:, 6:]
        return PointCloud(
            points_world=self._sums[:, :3] / count,
            colors=np.rint(self._sums[:, 3:6] / count).astype(np.uint8),
        )
