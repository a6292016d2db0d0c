"""Vertices of the trilinear field are moved so that the quads between them pass through the 1-D points.

A vertex begins at the centroid of its cell's 1-D points. There the field itself would lead astray: a trilinear one lies
inside a convex surface, by ever more off the voxels' edges, and planes made of its gradients meet farther off still.
But centroids of points around a bend lie within it, too, and the quads between them within once more. How much is known
at the edges, where a quad should pass through the 1-D point: so a vertex moves by the mean of the gaps there. To second
order that leaves the quads on the points; a sharp edge, which centroids cut off twice, comes back in part.
"""

import warp as wp

from fusion.surface.dual_contouring.cell_table import COUNT_SHIFT, CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import DualGrid, first_vertex
from fusion.surface.dual_contouring.qef import INSET
from fusion.surface.dual_contouring.vertices import Vertices
from fusion.surface.layers import (
    NONE,
    below,
    corners_on,
    launch_over_layers,
    lowest_bit,
    number_of,
    share_of,
    shares_on,
)
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# In C++ for its local arrays: the quads of the eight layers around the cells are looked up once for all of them.
_CLOSE_GAPS_IN_CPP = (
    f"constexpr float LOWEST = {INSET}f, HIGHEST = 1.0f - {INSET}f; constexpr int COUNT_SHIFT = {COUNT_SHIFT};"
    + """
    struct { wp::uint64 complete[3]; int first[3]; } owners[8] = {};
    for (int corner = 0; corner < 8; ++corner) {
        const int holder = grid.cells.upper.data[8 * slot + ((corner & 3) | (z == 7 ? corner & 4 : 0))];
        if (holder < 0) continue;
        const int layer = 8 * holder + ((z + (corner >> 2)) & 7);
        auto &owner = owners[corner];
        int number = grid.quad_starts.data[layer];
        for (int axis = 0; axis < 3; ++axis) {
            const auto &complete = axis == 0 ? grid.complete_x : axis == 1 ? grid.complete_y : grid.complete_z;
            owner.complete[axis] = complete.data[layer];
            owner.first[axis] = number;
            number += wp::bit_count(owner.complete[axis]);
        }
    }
    const wp::uint64 several = grid.several.data[8 * slot + z];
    for (wp::uint64 left = active; left != 0; left &= left - 1, ++vertex) {
        const int bit = wp::bit_count((left - 1) & ~left);
        if ((several >> bit) & 1) {
            vertex += (int)(grid.codes.data[odd_cell++] >> COUNT_SHIFT) - 1;
            continue;
        }
        int pattern = 0;
        for (int corner = 0; corner < 4; ++corner) {
            pattern |= (int)((below.c[corner] >> bit) & 1) << corner;
            pattern |= (int)((above.c[corner] >> bit) & 1) << (corner + 4);
        }
        float sum[3] = {0.0f, 0.0f, 0.0f}, quads = 0.0f;
        const int *edges = tables.edges.data + 12 * pattern, crossed = tables.ends.data[5 * pattern + 1];
        for (int i = 0; i < crossed; ++i) {
            const int edge = edges[i], axis = edge >> 2, k = edge & 3;
            const int low = axis == 0 ? k << 1 : axis == 1 ? (k & 1) | ((k & 2) << 1) : k;
            const int x = (bit & 7) + (low & 1), y = (bit >> 3) + ((low >> 1) & 1), at = 8 * (y & 7) + (x & 7);
            const auto &owner = owners[(x >> 3) | ((y >> 3) << 1) | (low & 4)];
            if (!((owner.complete[axis] >> at) & 1)) continue;
            const wp::uint64 before = ((wp::uint64)1 << at) - 1;
            const wp::vec3 gap = gaps.data[owner.first[axis] + wp::bit_count(owner.complete[axis] & before)];
            for (int j = 0; j < 3; ++j) sum[j] += gap[j];
            quads += 1.0f;
        }
        // No farther than within the cell: shortened, a step along a plane stays on it.
        float share = quads > 0.0f ? 1.0f / quads : 0.0f;
        wp::vec3 place = places.data[vertex];
        for (int j = 0; j < 3; ++j) {
            const float room = (sum[j] < 0.0f ? LOWEST : HIGHEST) - place[j];
            if (fabsf(share * sum[j]) > fabsf(room)) share = room / sum[j] > 0.0f ? room / sum[j] : 0.0f;
        }
        for (int j = 0; j < 3; ++j) {
            const float moved = place[j] + share * sum[j];
            place[j] = moved < LOWEST ? LOWEST : moved > HIGHEST ? HIGHEST : moved;
        }
        const wp::vec3 point = wp::vec3(voxel_size * (block_x + (bit & 7) + place[0]),
                                        voxel_size * (block_y + (bit >> 3) + place[1]),
                                        voxel_size * (block_z + place[2]));
        places.data[vertex] = place;
        points.data[vertex] = point;
    }
"""
)


@wp.func_native(_CLOSE_GAPS_IN_CPP)
def close_layer(
    grid: DualGrid,
    tables: CellTables,
    slot: int,
    z: int,
    active: wp.uint64,
    below: wp.vec4ul,
    above: wp.vec4ul,
    vertex: int,
    odd_cell: int,
    gaps: wp.array(dtype=wp.vec3),
    block_x: float,
    block_y: float,
    block_z: float,
    voxel_size: float,
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
) -> None:
    """Move the vertices of the ``active`` cells of a layer, from numbers ``vertex`` and ``odd_cell`` on.

    The layer begins at ``block_x`` … on the lattice.
    """


@wp.kernel
def _close_gaps(
    first: int,
    shares: int,
    grid: DualGrid,
    tables: CellTables,
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    gaps: wp.array(dtype=wp.vec3),
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
) -> None:
    index = wp.tid() + first
    layer = index / shares
    active = grid.cells.active[layer] & share_of(index - layer * shares, shares)
    if active == NONE:
        return
    slot = layer >> 3
    z = layer & 7
    lowest = lowest_bit(active)
    corner = 8 * blocks[number_of(grid.cells, slot)]
    close_layer(
        grid,
        tables,
        slot,
        z,
        active,
        corners_on(grid.cells.inside, grid.cells.upper, slot, z),
        corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1),
        first_vertex(grid, layer, lowest),
        grid.vertex_starts[layer][1] + wp.bit_count(grid.several[layer] & below(lowest)),
        gaps,
        float(corner[0]),
        float(corner[1]),
        float(corner[2] + z),
        voxel_size,
        places,
        points,
    )


def close_gaps(volume: Volume, grid: DualGrid, gaps: wp.array, places: wp.array, cells: Vertices) -> None:
    """Move the ``cells``' vertices, which lie at ``places`` in their cells, and write their points.

    Those of cells with several loops stay where they are, within their hulls.
    """
    device, shares = volume.device, shares_on(volume.device)
    tables = cell_tables(str(device.alias))
    launch_over_layers(
        _close_gaps,
        dim=shares * len(grid.several),
        inputs=[shares, grid, tables, volume.table.blocks, volume.voxel_size, gaps],
        outputs=[places, cells.points],
        device=device,
    )
