"""Marching cubes on the sparse blocks, across their borders, with interpolated colours.

The vertices are numbered block by block and in a block layer by layer; in a layer first those on edges along x, then
y, then z, each in the order of voxels. Triangles are in the order of their cells. So nothing depends on which thread is
first.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError
from fusion.block_table import BLOCK_VOXELS
from fusion.cells import find_cells
from fusion.devices import launch_in_slabs
from fusion.layers import NONE, Cells, below, case_of, corners_on, lowest_bit, number_of
from fusion.marching_cubes_table import EDGE_CORNERS, triangle_table
from fusion.mesh import Mesh
from fusion.volume import Volume
from fusion.voxels import Voxels, VoxelSums, sums_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)
_ALL = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
_CUDA_SHARES = 8


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A mesh on the volume's device, and the cells that it comes from.

    ``vertices`` (n,) vec3 in metres in the world frame, ``triangles`` (m, 3), ``colors`` (n,) vec3ub.
    """

    vertices: wp.array
    triangles: wp.array
    colors: wp.array
    cells: Cells


@dataclass(frozen=True, kw_only=True)
class CaseTables:
    """The marching cubes table on a device: the triangles of the 256 sign patterns.

    ``counts`` (256,) how many; ``edges`` (256, 3 · most) on which edges their corners are, as 8 · axis + the edge's
    lower corner.
    """

    counts: wp.array
    edges: wp.array


@wp.func
def share_of(part: int, shares: int) -> wp.uint64:
    """Return the word of the voxels in one of equal ``shares`` of a layer."""
    if shares == 1:
        return _ALL
    bits = 64 / shares
    return below(bits) << wp.uint64(part * bits)


@wp.func
def step_along(axis: int) -> wp.vec3i:
    """Return the unit step along an axis."""
    return wp.vec3i(int(axis == 0), int(axis == 1), int(axis == 2))


@wp.func
def vertex_number(cells: Cells, layer: int, axis: int, bit: int) -> int:
    """Return the number of the vertex on the edge of a layer's voxel along ``axis``."""
    number = cells.starts[layer][0] + wp.bit_count(cells.edges[layer, axis] & below(bit))
    for before in range(axis):
        number += wp.bit_count(cells.edges[layer, before])
    return number


@wp.func
def voxel_of(cells: Cells, slot: int, x: int, y: int, z: int) -> int:
    """Return the index of the voxel at (x, y, z), each from 0 to 8, seen from a slot."""
    holder = cells.upper[slot, (x >> 3) | ((y >> 3) << 1) | ((z >> 3) << 2)]
    return number_of(cells, holder) * _VOXELS + (z & 7) * 64 + (y & 7) * 8 + (x & 7)


@wp.func
def color_along(a: VoxelSums, b: VoxelSums, along: float) -> wp.vec3ub:
    """Return the colour between two voxels, one without colour left out; black where neither has any."""
    share_a = wp.where(a.color_weight > 0.0, 1.0 - along, 0.0)
    share_b = wp.where(b.color_weight > 0.0, along, 0.0)
    mixed = wp.vec3()
    if share_a > 0.0:
        mixed += share_a / a.color_weight * a.color
    if share_b > 0.0:
        mixed += share_b / b.color_weight * b.color
    if share_a + share_b > 0.0:
        mixed = mixed / (share_a + share_b)
    rounded = wp.vec3ub()
    for channel in range(3):
        rounded[channel] = wp.uint8(wp.clamp(mixed[channel] + 0.5, 0.0, 255.0))
    return rounded


@wp.kernel
def _emit_vertices(
    first: int,
    shares: int,
    blocks: wp.array(dtype=wp.vec3i),
    cells: Cells,
    voxels: Voxels,
    voxel_size: float,
    vertices: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
) -> None:
    index = wp.tid() + first
    layer = index / shares
    if cells.starts[layer][0] == cells.starts[layer + 1][0]:
        return
    slot = layer >> 3
    z = layer & 7
    block = blocks[number_of(cells, slot)]
    for axis in range(3):
        step = step_along(axis)
        left = cells.edges[layer, axis] & share_of(index - layer * shares, shares)
        vertex = vertex_number(cells, layer, axis, lowest_bit(left))
        while left != NONE:
            bit = lowest_bit(left)
            x = bit & 7
            y = bit >> 3
            sums_a = sums_of(voxels, voxel_of(cells, slot, x, y, z))
            sums_b = sums_of(voxels, voxel_of(cells, slot, x + step[0], y + step[1], z + step[2]))
            a = sums_a.distance / sums_a.weight
            b = sums_b.distance / sums_b.weight
            along = a / (a - b)
            start = wp.vec3(float(8 * block[0] + x), float(8 * block[1] + y), float(8 * block[2] + z))
            vertices[vertex] = voxel_size * (start + along * wp.vec3(float(step[0]), float(step[1]), float(step[2])))
            colors[vertex] = color_along(sums_a, sums_b, along)
            vertex += 1
            left = left & (left - wp.uint64(1))


@wp.kernel
def _emit_triangles(
    first: int,
    shares: int,
    cells: Cells,
    counts: wp.array(dtype=int),
    table: wp.array2d(dtype=int),
    triangles: wp.array2d(dtype=int),
) -> None:
    index = wp.tid() + first
    layer = index / shares
    triangle = cells.starts[layer][1]
    if triangle == cells.starts[layer + 1][1]:
        return
    share = share_of(index - layer * shares, shares)
    slot = layer >> 3
    z = layer & 7
    low = corners_on(cells.inside, cells.upper, slot, z)
    high = corners_on(cells.inside, cells.upper, slot, z + 1)
    left = cells.active[layer]
    while left != NONE:
        bit = lowest_bit(left)
        case = case_of(low, high, bit)
        if ((share >> wp.uint64(bit)) & wp.uint64(1)) != NONE:
            for i in range(3 * counts[case]):
                edge = table[case, i]
                x = (bit & 7) + (edge & 1)
                y = (bit >> 3) + ((edge >> 1) & 1)
                top = z + ((edge >> 2) & 1)
                holder = cells.upper[slot, (x >> 3) | ((y >> 3) << 1) | ((top >> 3) << 2)]
                number = vertex_number(cells, 8 * holder + (top & 7), edge >> 3, 8 * (y & 7) + (x & 7))
                triangles[triangle + i / 3, i % 3] = number
        triangle += counts[case]
        left = left & (left - wp.uint64(1))


def marching_cubes(volume: Volume, *, min_weight: float = 0.0, blocks: ArrayLike | None = None) -> Mesh:
    """Return the zero level of the volume's average distance as a mesh in world coordinates, with colours.

    Vertices are placed by linear interpolation along voxel edges. Where the volume holds no surface the mesh is empty.
    A voxel counts as seen where its weight is over ``min_weight``. ``blocks`` (n,) numbers of blocks: mesh only their
    cells, with all vertices of these, at a cost that goes with n; a cell belongs to the block of its lowest corner.
    """
    surface = extract_surface(volume, min_weight=min_weight, blocks=blocks)
    return Mesh(vertices=surface.vertices.numpy(), triangles=surface.triangles.numpy(), colors=surface.colors.numpy())


def extract_surface(volume: Volume, *, min_weight: float = 0.0, blocks: ArrayLike | None = None) -> Surface:
    """Do what ``marching_cubes`` does and leave the mesh on the device."""
    device = volume.device
    tables = _case_tables(str(device.alias))
    cells = find_cells(volume, tables.counts, meshed=_block_numbers(volume, blocks), min_weight=min_weight)
    layers = len(cells.starts) - 1
    vertex_total, triangle_total = (int(total) for total in cells.starts[layers:].numpy()[0])
    surface = Surface(
        vertices=wp.empty(vertex_total, dtype=wp.vec3, device=device),
        triangles=wp.empty((triangle_total, 3), dtype=int, device=device),
        colors=wp.empty(vertex_total, dtype=wp.vec3ub, device=device),
        cells=cells,
    )
    if triangle_total == 0:
        return surface
    shares = _CUDA_SHARES if device.is_cuda else 1
    launch_in_slabs(
        _emit_vertices,
        dim=shares * layers,
        inputs=[shares, volume.table.blocks, cells, volume.voxels, volume.voxel_size],
        outputs=[surface.vertices, surface.colors],
        device=device,
    )
    launch_in_slabs(
        _emit_triangles,
        dim=shares * layers,
        inputs=[shares, cells, tables.counts, tables.edges],
        outputs=[surface.triangles],
        device=device,
    )
    return surface


@cache
def _case_tables(device: str) -> CaseTables:
    counts, edges = triangle_table()
    packed = np.where(edges < 0, 0, 8 * (edges // 4) + EDGE_CORNERS[edges, 0])
    return CaseTables(
        counts=wp.array(counts, dtype=int, device=device), edges=wp.array(packed, dtype=int, device=device)
    )


def _block_numbers(volume: Volume, blocks: ArrayLike | None) -> NDArray[np.int32] | None:
    if blocks is None:
        return None
    numbers = np.unique(np.asarray(blocks, dtype=np.int64).reshape(-1))
    if len(numbers) and not (numbers[0] >= 0 and numbers[-1] < volume.table.count):
        raise InputError(f"block {numbers[[0, -1]].tolist()}: the volume has {volume.table.count} blocks, from 0 on")
    return numbers.astype(np.int32)
