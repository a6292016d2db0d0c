"""How far a point is from the model's surface, and in which direction: what a pose is refined by.

Within the truncation band it is the volume's trilinear field with its gradient in closed form; where the field is
saturated or was never observed, the coarse grid of distances. Points are in the model's local frame: the world's axes,
its origin moved near the model, so that float32 keeps its digits.
"""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.layers import step_along
from fusion.surface.ray_traversal import corner_voxel
from fusion.surface.vertex_normals import Field, seen_voxel
from fusion.volume.block_table import BLOCK_VOXELS, find_block
from fusion.volume.trilinear import Corners, gradient_of_terms, trilinear_terms
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import distance_of, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

NO_FIELD, FROM_VOLUME, FROM_GRID = 0, 1, 2
_NO_FIELD = wp.constant(NO_FIELD)
_FROM_VOLUME = wp.constant(FROM_VOLUME)
_FROM_GRID = wp.constant(FROM_GRID)

_VOXELS = wp.constant(BLOCK_VOXELS)

_SATURATED = wp.constant(0.98)
"""A corner's distance, in truncations, from which on it says no more than "far"."""

_LEAST_SLOPE = wp.constant(0.4)
"""Of the field, in metres a metre: a flatter one, behind corners and in slits, tells no direction."""


@wp.struct
class ModelField:
    """A volume and a grid of distances on a device.

    ``keys``, ``numbers`` are the block table's, ``neighbours`` (n, 8) as in ``SurfaceCells``; ``distances``
    (voxels,) in truncations as ``interpolated_distances`` gives them; the local origin is voxel ``base``. ``grid``
    (nx, ny, nz) in metres, its first node at ``grid_origin``, local metres.
    """

    keys: wp.array(dtype=wp.int64)
    numbers: wp.array(dtype=int)
    neighbours: wp.array2d(dtype=int)
    distances: wp.array(dtype=float)
    base: wp.vec3i
    voxels_per_metre: float
    truncation: float
    grid: wp.array3d(dtype=float)
    grid_origin: wp.vec3
    nodes_per_metre: float


@wp.kernel
def _interpolated_distances(
    first: int, field: Field, blocks: wp.array(dtype=wp.vec3i), most: float, distances: wp.array(dtype=float)
) -> None:
    voxel = wp.tid() + first
    number = voxel / _VOXELS
    within = voxel % _VOXELS
    point = 8 * blocks[number] + wp.vec3i(within & 7, (within >> 3) & 7, within >> 6)
    own = wp.where(weight_of(field.voxels, voxel) > 0.0, distance_of(field.voxels, voxel), 1.0)
    distances[voxel] = own
    if wp.abs(own) >= _SATURATED:
        return
    bend = float(0.0)
    for axis in range(3):
        step = step_along(axis)
        after = seen_voxel(field, blocks[number], number, point + step)
        before = seen_voxel(field, blocks[number], number, point - step)
        if after >= 0 and before >= 0:
            ahead = distance_of(field.voxels, after)
            back = distance_of(field.voxels, before)
            if wp.max(wp.abs(ahead), wp.abs(back)) < _SATURATED:
                bend += ahead + back - 2.0 * own
    distances[voxel] = own - wp.clamp(bend / 12.0, -most, most)


def interpolated_distances(volume: Volume) -> wp.array:
    """Return values at the voxels (512 · blocks,), truncations, between which interpolation has the surface in place.

    Across a curved surface a distance bends upwards between two voxels, and the straight line between them lies above
    it by half of a(1 − a) times its second difference: by a twelfth on average, which is taken off at the voxels. So
    what is interpolated neither shrinks a ball nor widens a hollow. 1 where a voxel was not seen.
    """
    count = volume.table.count * BLOCK_VOXELS
    field = Field()
    field.keys = volume.table.keys
    field.numbers = volume.table.numbers
    field.voxels = volume.voxels
    field.min_weight = 0.0
    distances = wp.empty(count, dtype=float, device=volume.device)
    # At edges and in noise the second difference is no curvature: a tenth of a voxel is more than any smooth shape's.
    most = 0.1 * volume.voxel_size / volume.truncation
    launch_in_slabs(
        _interpolated_distances,
        dim=count,
        inputs=[field, volume.table.blocks, most],
        outputs=[distances],
        device=volume.device,
        least_slab=4096,
    )
    return distances


@wp.struct
class FieldSample:
    """``distance`` in metres, negative behind the surface; ``normal`` the unit direction in which it grows.

    ``source`` tells where they are from; NO_FIELD: from nowhere, and both are 0.
    """

    distance: float
    normal: wp.vec3
    source: int


@wp.func
def corners_in_volume(field: ModelField, cell: wp.vec3i) -> tuple[Corners, bool]:
    """Return the average distances at a cell's corners, in truncations, and whether all say where the surface is."""
    v = Corners()
    lattice = field.base + cell
    block = wp.vec3i(lattice[0] >> 3, lattice[1] >> 3, lattice[2] >> 3)
    number = find_block(field.keys, field.numbers, block)
    if number < 0:
        return v, False
    within = wp.vec3i(lattice[0] & 7, lattice[1] & 7, lattice[2] & 7)
    if wp.max(within) < 7:
        # Two cells of three lie within one block.
        low = number * _VOXELS + within[2] * 64 + within[1] * 8 + within[0]
        d = field.distances
        v = Corners(d[low], d[low + 1], d[low + 8], d[low + 9], d[low + 64], d[low + 65], d[low + 72], d[low + 73])
        return v, wp.max(wp.abs(v)) < _SATURATED
    for corner in range(8):
        x = within[0] + (corner & 1)
        y = within[1] + ((corner >> 1) & 1)
        z = within[2] + (corner >> 2)
        if field.neighbours[number, (x >> 3) + 2 * (y >> 3) + 4 * (z >> 3)] < 0:
            return v, False
        voxel = corner_voxel(field.neighbours, number, within, corner)
        v[corner] = field.distances[voxel]
        if wp.abs(v[corner]) >= _SATURATED:
            return v, False
    return v, True


@wp.func
def value_of_terms(k: Corners, at: wp.vec3) -> float:
    """Return the trilinear field with the given terms at a position in the cell."""
    low = k[0] + k[1] * at[0] + (k[2] + k[3] * at[0]) * at[1]
    high = k[4] + k[5] * at[0] + (k[6] + k[7] * at[0]) * at[1]
    return low + high * at[2]


@wp.func
def sample_volume(field: ModelField, point: wp.vec3) -> FieldSample:
    """Return the volume's field at a local point, as a distance along its own gradient."""
    sample = FieldSample()
    scaled = field.voxels_per_metre * point
    cell = wp.vec3i(int(wp.floor(scaled[0])), int(wp.floor(scaled[1])), int(wp.floor(scaled[2])))
    v, known = corners_in_volume(field, cell)
    if not known:
        return sample
    at = scaled - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
    terms = trilinear_terms(v)
    gradient = field.truncation * field.voxels_per_metre * gradient_of_terms(terms, at)
    slope = wp.length(gradient)
    if slope < _LEAST_SLOPE:
        return sample
    # Projective distances grow faster or slower than the distance to the surface does; their zero is the same.
    sample.distance = field.truncation * value_of_terms(terms, at) / slope
    sample.normal = gradient / slope
    sample.source = _FROM_VOLUME
    return sample


@wp.func
def grid_terms(field: ModelField, cell: wp.vec3i) -> Corners:
    """Return the trilinear terms of a cell of the grid."""
    v = Corners()
    for corner in range(8):
        v[corner] = field.grid[cell[0] + (corner & 1), cell[1] + ((corner >> 1) & 1), cell[2] + (corner >> 2)]
    return trilinear_terms(v)


@wp.func
def sample_grid(field: ModelField, point: wp.vec3) -> FieldSample:
    """Return the grid's field at a local point."""
    sample = FieldSample()
    scaled = field.nodes_per_metre * (point - field.grid_origin)
    cell = wp.vec3i(int(wp.floor(scaled[0])), int(wp.floor(scaled[1])), int(wp.floor(scaled[2])))
    for axis in range(3):
        if cell[axis] < 0 or cell[axis] > field.grid.shape[axis] - 2:
            return sample
    at = scaled - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
    terms = grid_terms(field, cell)
    gradient = field.nodes_per_metre * gradient_of_terms(terms, at)
    slope = wp.length(gradient)
    if slope < _LEAST_SLOPE:
        return sample
    sample.distance = value_of_terms(terms, at)
    sample.normal = gradient / slope
    sample.source = _FROM_GRID
    return sample


@wp.func
def sample_field(field: ModelField, point: wp.vec3) -> FieldSample:
    """Return the distance to the model's surface from a local point, from the finest source that knows it."""
    sample = sample_volume(field, point)
    if sample.source == _NO_FIELD:
        sample = sample_grid(field, point)
    return sample


@wp.kernel
def _sample(
    first: int, field: ModelField, points: wp.array(dtype=wp.vec3), samples: wp.array(dtype=FieldSample)
) -> None:
    index = wp.tid() + first
    samples[index] = sample_field(field, points[index])


def sample_points(field: ModelField, points: wp.array) -> wp.array:
    """Return the field's ``FieldSample`` at local points (n,), on their device."""
    samples = wp.empty(len(points), dtype=FieldSample, device=points.device)
    launch_in_slabs(_sample, dim=len(points), inputs=[field, points], outputs=[samples], device=points.device)
    return samples
