"""What a view is located against: a volume, its surface, and distances around it, ready on a device."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.devices import Device
from fusion.pose.distance_grid import DistanceGrid, distance_grid
from fusion.pose.model_field import ModelField, interpolated_distances, sample_points
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import Hierarchy, mesh_hierarchy
from fusion.surface.surface_cells import find_surface_cells
from fusion.volume.block_table import BLOCK_SIDE
from fusion.volume.tsdf_volume import Volume

SURFACE_SAMPLES = 8000


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseModel:
    """A reconstruction that views are located in.

    ``mesh`` is the volume's surface with normals, world frame, and ``outline`` what silhouettes are of: the same, or a
    mesh that the volume was made from, whose edges are sharp; ``field`` what kernels read, in the local frame, whose
    origin is at ``origin_world``; ``surface_points``, ``surface_normals`` (n,) vec3, local, lie spread over the
    surface, and so does every beginning of their list. ``centre_world`` and ``diameter`` (metres)
    are those of the surface's box.
    """

    volume: Volume
    mesh: Mesh
    outline: Mesh
    grid: DistanceGrid
    field: ModelField
    origin_world: NDArray[np.float64]
    surface_points: wp.array
    surface_normals: wp.array
    centre_world: NDArray[np.float64]
    diameter: float

    @property
    def device(self) -> Device:
        """Where the model is."""
        return self.volume.device

    @property
    def voxel_size(self) -> float:
        """Of the volume, metres."""
        return self.volume.voxel_size

    @cached_property
    def hierarchy(self) -> Hierarchy:
        """The mesh's, to cast rays at."""
        return mesh_hierarchy(self.mesh, device=self.device)

    @cached_property
    def outline_hierarchy(self) -> Hierarchy:
        """The outline's."""
        return self.hierarchy if self.outline is self.mesh else mesh_hierarchy(self.outline, device=self.device)

    def local(self, world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return poses (…, 4, 4) as local_from_camera."""
        result = np.array(world_from_camera, dtype=np.float64)
        result[..., :3, 3] -= self.origin_world
        return result

    def sample(self, points_world: NDArray[np.floating]) -> tuple[NDArray, NDArray, NDArray]:
        """Return signed distances (n,) in metres, their gradients' directions (n, 3), and their sources (n,).

        The sources are those of ``model_field``; where it is NO_FIELD the others are 0.
        """
        local = (np.asarray(points_world, dtype=np.float64) - self.origin_world).astype(np.float32)
        found = sample_points(self.field, wp.array(local, dtype=wp.vec3, device=self.device)).numpy()
        return found["distance"], found["normal"], found["source"]


def prepare_model(volume: Volume, *, mesh: Mesh | None = None, outline: Mesh | None = None) -> PoseModel:
    """Make a volume ready for locating views in it.

    ``mesh`` is its surface with normals if that is there already, ``outline`` the mesh it was made from, world frame,
    if it was made from one. Raises InputError where the volume has no surface.
    """
    device = volume.device
    if mesh is None or mesh.normals is None:
        mesh = marching_cubes(volume, normals=True)
    if not len(mesh.triangles):
        raise InputError("the volume holds no surface, so nothing can be located in it; reconstruct it again")
    assert mesh.normals is not None
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    block = np.floor((low + high) / 2 / (BLOCK_SIDE * volume.voxel_size)).astype(int)
    origin = BLOCK_SIDE * volume.voxel_size * block
    grid = distance_grid(mesh, device=device)
    chosen = _spread(mesh, SURFACE_SAMPLES)
    return PoseModel(
        volume=volume,
        mesh=mesh,
        outline=mesh if outline is None else outline,
        grid=grid,
        field=_field(volume, grid, origin, BLOCK_SIDE * block),
        origin_world=origin,
        surface_points=wp.array((mesh.vertices[chosen] - origin).astype(np.float32), dtype=wp.vec3, device=device),
        surface_normals=wp.array(mesh.normals[chosen], dtype=wp.vec3, device=device),
        centre_world=(low + high) / 2,
        diameter=float(np.linalg.norm(high - low)),
    )


def _field(volume: Volume, grid: DistanceGrid, origin: NDArray[np.float64], base: NDArray[np.int64]) -> ModelField:
    field = ModelField()
    field.keys = volume.table.keys
    field.numbers = volume.table.numbers
    field.neighbours = find_surface_cells(volume).neighbours
    field.distances = interpolated_distances(volume)
    field.base = wp.vec3i(*base.tolist())
    field.voxels_per_metre = 1 / volume.voxel_size
    field.truncation = volume.truncation
    field.grid = grid.distances
    field.grid_origin = wp.vec3(*(grid.origin_world - origin).tolist())
    field.nodes_per_metre = 1 / grid.spacing
    return field


def _spread(mesh: Mesh, count: int) -> NDArray[np.int64]:
    """Return up to ``count`` vertices, equally many for equal area; each beginning of the list covers the surface.

    The vertices lie block by block, so that the golden section's multiples, taken as quantiles of the area that came
    before, are spread over space.
    """
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    before = np.cumsum(np.bincount(mesh.triangles.ravel(), np.repeat(areas, 3), len(mesh.vertices)))
    quantiles = (np.arange(count) * (5**0.5 - 1) / 2) % 1
    drawn = np.minimum(np.searchsorted(before, quantiles * before[-1], side="right"), len(before) - 1)
    _vertices, first = np.unique(drawn, return_index=True)
    return drawn[np.sort(first)]


def poses_on(device: Device, poses: NDArray[np.float64]) -> tuple[wp.array, wp.array]:
    """Return the rotations and the translations of poses (n, 4, 4) as device arrays, mat33 and vec3."""
    rotations = wp.array(poses[:, :3, :3].astype(np.float32), dtype=wp.mat33, device=device)
    return rotations, wp.array(poses[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)


def as_poses(world_from_camera: Matrix | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return one pose (4, 4), or several (n, 4, 4), as an array of poses."""
    return np.asarray(world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
