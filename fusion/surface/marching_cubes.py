"""Marching cubes on the sparse blocks, across their borders, with interpolated colours.

The vertices are numbered block by block and in a block layer by layer; in a layer first those on edges along x, then
y, then z, each in the order of voxels. Triangles are in the order of their cells. So nothing depends on which thread is
first.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from fusion.surface.cells import block_numbers, find_cells
from fusion.surface.layers import (
    NONE,
    Cells,
    corners_on,
    launch_over_layers,
    lowest_bit,
    number_of,
    share_of,
    shares_on,
    step_along,
    vertex_number,
    voxel_of,
)
from fusion.surface.marching_cubes_table import EDGE_CORNERS, triangle_table
from fusion.surface.mesh import Mesh
from fusion.surface.vertex_normals import vertex_normals
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxel_average import average_of, color_along
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A mesh on the volume's device, and the cells that it comes from.

    ``vertices`` (n,) vec3 in metres in the world frame, ``triangles`` (m, 3), ``colors`` (n,) vec3ub, ``normals`` (n,)
    vec3 where they were asked for.
    """

    vertices: wp.array
    triangles: wp.array
    colors: wp.array
    normals: wp.array | None
    cells: Cells


@dataclass(frozen=True, kw_only=True)
class CaseTables:
    """The marching cubes table on a device: the triangles of the 256 sign patterns.

    ``counts`` (256,) how many; ``edges`` (256, 3 · most) on which edges their corners are, as 8 · axis + the edge's
    lower corner.
    """

    counts: wp.array
    edges: wp.array


# In C++ for its local arrays: the edges of the eight layers around the cells are looked up once for all of them.
_TRIANGLES_IN_CPP = """
    struct { const wp::uint64 *words; int first[3]; } owners[8];
    for (int corner = 0; corner < 8; ++corner) {
        const int beyond = (corner & 3) | (z == 7 ? corner & 4 : 0);
        const int holder = cells.upper.data[8 * slot + beyond];
        const int layer = 8 * holder + ((z + (corner >> 2)) & 7);
        const wp::uint64 *words = holder < 0 ? nullptr : cells.edges.data + 3 * (size_t)layer;
        owners[corner].words = words;
        int number = holder < 0 ? 0 : cells.starts.data[layer].c[0];
        for (int axis = 0; axis < 3; ++axis) {
            owners[corner].first[axis] = number;
            number += words ? wp::bit_count(words[axis]) : 0;
        }
    }
    int *corner_number = triangles.data + 3 * (size_t)triangle;
    for (wp::uint64 left = active; left != 0; left &= left - 1) {
        const int bit = wp::bit_count((left - 1) & ~left);
        int pattern = 0;
        for (int corner = 0; corner < 4; ++corner) {
            pattern |= (int)((below.c[corner] >> bit) & 1) << corner;
            pattern |= (int)((above.c[corner] >> bit) & 1) << (corner + 4);
        }
        const int corners = 3 * counts.data[pattern];
        if ((share >> bit) & 1) {
            for (int i = 0; i < corners; ++i) {
                const int edge = table.data[pattern * table.shape[1] + i];
                const int x = (bit & 7) + (edge & 1), y = (bit >> 3) + ((edge >> 1) & 1), axis = edge >> 3;
                const auto &owner = owners[(x >> 3) | ((y >> 3) << 1) | (edge & 4)];
                const wp::uint64 before = ((wp::uint64)1 << (8 * (y & 7) + (x & 7))) - 1;
                corner_number[i] = owner.first[axis] + wp::bit_count(owner.words[axis] & before);
            }
        }
        corner_number += corners;
    }
"""


@wp.func_native(_TRIANGLES_IN_CPP)
def emit_triangles(
    cells: Cells,
    slot: int,
    z: int,
    active: wp.uint64,
    share: wp.uint64,
    below: wp.vec4ul,
    above: wp.vec4ul,
    counts: wp.array(dtype=int),
    table: wp.array2d(dtype=int),
    triangle: int,
    triangles: wp.array2d(dtype=int),
) -> None:
    """Write the triangles of those ``active`` cells of a layer that are in ``share``, from number ``triangle`` on."""


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
            a = average_of(voxels, voxel_of(cells, slot, x, y, z))
            b = average_of(voxels, voxel_of(cells, slot, x + step[0], y + step[1], z + step[2]))
            along = a[0] / (a[0] - b[0])
            start = wp.vec3(float(8 * block[0] + x), float(8 * block[1] + y), float(8 * block[2] + z))
            vertices[vertex] = voxel_size * (start + along * wp.vec3(float(step[0]), float(step[1]), float(step[2])))
            colors[vertex] = color_along(a, b, along)
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
    if (cells.active[layer] & share) == NONE:
        return
    slot = layer >> 3
    z = layer & 7
    low = corners_on(cells.inside, cells.upper, slot, z)
    high = corners_on(cells.inside, cells.upper, slot, z + 1)
    emit_triangles(cells, slot, z, cells.active[layer], share, low, high, counts, table, triangle, triangles)


def marching_cubes(
    volume: Volume, *, min_weight: float = 0.0, normals: bool = False, blocks: ArrayLike | None = None
) -> Mesh:
    """Return the zero level of the volume's average distance as a mesh in world coordinates, with colours.

    Vertices are placed by linear interpolation along voxel edges. Where the volume holds no surface the mesh is empty.
    A voxel counts as seen where its weight is over ``min_weight`` (≥ 0). ``normals`` asks for the vertices' normals.
    ``blocks`` (n,) are numbers of blocks: only their cells are meshed, with all vertices of these, at a cost that goes
    with n; a cell belongs to the block of its lowest corner. Raises InputError where there is no such block.
    """
    return mesh_of(extract_surface(volume, min_weight=min_weight, normals=normals, blocks=blocks))


def mesh_of(surface: Surface) -> Mesh:
    """Return a surface as a mesh on the host."""
    return Mesh(
        vertices=surface.vertices.numpy(),
        triangles=surface.triangles.numpy(),
        colors=surface.colors.numpy(),
        normals=None if surface.normals is None else surface.normals.numpy(),
    )


def extract_surface(
    volume: Volume,
    *,
    min_weight: float = 0.0,
    normals: bool = False,
    blocks: ArrayLike | None = None,
    apart: bool = False,
) -> Surface:
    """Do what ``marching_cubes`` does and leave the mesh on the device; blocks meshed ``apart`` share no vertices."""
    assert min_weight >= 0, "an unseen voxel's weight is 0"
    device = volume.device
    tables = _case_tables(str(device.alias))
    meshed = None if blocks is None else block_numbers(volume, blocks)
    cells = find_cells(volume, tables.counts, meshed=meshed, apart=apart, min_weight=min_weight)
    layers = len(cells.starts) - 1
    vertex_total, triangle_total = (int(total) for total in cells.starts[layers:].numpy()[0])
    vertices = wp.empty(vertex_total, dtype=wp.vec3, device=device)
    colors = wp.empty(vertex_total, dtype=wp.vec3ub, device=device)
    triangles = wp.empty((triangle_total, 3), dtype=int, device=device)
    shares = shares_on(device)
    launch_over_layers(
        _emit_vertices,
        dim=shares * layers,
        inputs=[shares, volume.table.blocks, cells, volume.voxels, volume.voxel_size],
        outputs=[vertices, colors],
        device=device,
    )
    launch_over_layers(
        _emit_triangles,
        dim=shares * layers,
        inputs=[shares, cells, tables.counts, tables.edges],
        outputs=[triangles],
        device=device,
    )
    return Surface(
        vertices=vertices,
        triangles=triangles,
        colors=colors,
        normals=vertex_normals(volume, cells, vertices=vertex_total, min_weight=min_weight) if normals else None,
        cells=cells,
    )


@cache
def _case_tables(device: str) -> CaseTables:
    counts, edges = triangle_table()
    packed = np.where(edges < 0, 0, 8 * (edges // 4) + EDGE_CORNERS[edges, 0])
    return CaseTables(
        counts=wp.array(counts, dtype=int, device=device), edges=wp.array(packed, dtype=int, device=device)
    )
