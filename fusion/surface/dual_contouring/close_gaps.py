"""Vertices of the trilinear field are moved so that the quads between them pass through the 1-D points.

A vertex begins at the centroid of its cell's 1-D points. There the field itself would lead astray: a trilinear one lies
inside a convex surface, by ever more off the voxels' edges, and planes made of its gradients meet farther off still.
But centroids of points around a bend lie within it, too, and the quads between them within once more. How much is known
at the edges, where a quad should pass through the 1-D point: so a vertex moves by the mean of the gaps there. To second
order that leaves the quads on the points; a sharp edge, which centroids cut off twice, comes back in part.
"""

import warp as wp

from fusion.surface.dual_contouring.cell_table import COUNT_SHIFT
from fusion.surface.dual_contouring.dual_grid import DualGrid, first_vertex
from fusion.surface.dual_contouring.lanes import LANES_IN_CPP
from fusion.surface.dual_contouring.vertices import Vertices
from fusion.surface.layers import (
    NONE,
    below,
    launch_over_layers,
    lowest_bit,
    number_of,
    share_of,
    shares_on,
)
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Gaps go to the cells around their edges, quad by quad, in the order in which they lie in memory. The cells, and those
# beside them that belong to other blocks or layers, are in rows of ten.
_GATHER_IN_CPP = """
    float sums[100][4] = {};  // of the gaps around each cell, and their number
    const wp::uint64 near = active | active << 1 | active << 8 | active << 9;  // where cells' edges of this block are
    for (int corner = 0; corner < 8; ++corner) {
        const int holder = grid.cells.upper.data[8 * slot + ((corner & 3) | (z == 7 ? corner & 4 : 0))];
        if (holder < 0) continue;
        const int layer = 8 * holder + ((z + (corner >> 2)) & 7), beyond_x = corner & 1, beyond_y = (corner >> 1) & 1;
        // Of the blocks beyond, cells have edges in the first column or row.
        const wp::uint64 column = beyond_x ? 0x0101010101010101ull : ~0ull, row = beyond_y ? 0xffull : ~0ull;
        const wp::uint64 asked = corner & 3 ? column & row : near;
        int first = grid.quad_starts.data[layer];
        // Edges along z from the layer above belong to other cells.
        for (int axis = 0; axis < (corner < 4 ? 3 : 2); ++axis) {
            const auto &words = axis == 0 ? grid.complete_x : axis == 1 ? grid.complete_y : grid.complete_z;
            const wp::uint64 complete = words.data[layer];
            for (wp::uint64 left = complete & asked; left != 0; left &= left - 1) {
                const int bit = wp::bit_count((left - 1) & ~left);
                const wp::uint64 before = ((wp::uint64)1 << bit) - 1;
                const wp::vec3 gap = gaps.data[first + wp::bit_count(complete & before)];
                const float add[4] = {gap[0], gap[1], gap[2], 1.0f};
                auto *here = sums + 10 * ((bit >> 3) + 8 * beyond_y + 1) + (bit & 7) + 8 * beyond_x + 1;
                for (int j = 0; j < 4; ++j) here[0][j] += add[j];
                if (axis != 0) for (int j = 0; j < 4; ++j) here[-1][j] += add[j];
                if (axis != 1) for (int j = 0; j < 4; ++j) here[-10][j] += add[j];
                if (axis == 2) for (int j = 0; j < 4; ++j) here[-11][j] += add[j];
            }
            first += wp::bit_count(complete);
        }
    }
"""

_MOVE_IN_CPP = """
    V place[3], sum[3], corner[3], quads;
    int filled = 0, numbers[LANES];
    corner[2] = block_z;
    auto move_lanes = [&]() {
        const V none = 0.0f, one = 1.0f, lowest = LOWEST, highest = HIGHEST;
        V share = one / (quads > none ? quads : one);
        // No farther than within the cell: shortened, a step along a plane stays on it.
        for (int j = 0; j < 3; ++j) {
            const V room = (sum[j] < none ? lowest : highest) - place[j], step = share * sum[j];
            const auto too_far = (step < none ? -step : step) > (room < none ? -room : room);
            const V shorter = room / (too_far ? sum[j] : one);
            share = too_far ? (shorter > none ? shorter : none) : share;
        }
        for (int j = 0; j < 3; ++j) {
            const V moved = place[j] + share * sum[j];
            place[j] = moved < lowest ? lowest : moved > highest ? highest : moved;
            const V point = voxel_size * (corner[j] + place[j]);
            for (int lane = 0; lane < filled; ++lane) {
                places.data[numbers[lane]][j] = lanes_of(place[j])[lane];
                points.data[numbers[lane]][j] = lanes_of(point)[lane];
            }
        }
        filled = 0;
    };
    const wp::uint64 several = grid.several.data[8 * slot + z];
    for (wp::uint64 left = active; left != 0; left &= left - 1, ++vertex) {
        const int bit = wp::bit_count((left - 1) & ~left);
        if ((several >> bit) & 1) {
            vertex += (int)(grid.codes.data[several_cell++] >> COUNT_SHIFT) - 1;
            continue;
        }
        const float *own = sums[10 * ((bit >> 3) + 1) + (bit & 7) + 1];
        for (int j = 0; j < 3; ++j) {
            lanes_of(place[j])[filled] = places.data[vertex][j];
            lanes_of(sum[j])[filled] = own[j];
        }
        lanes_of(quads)[filled] = own[3];
        lanes_of(corner[0])[filled] = block_x + (bit & 7);
        lanes_of(corner[1])[filled] = block_y + (bit >> 3);
        numbers[filled++] = vertex;
        if (filled == LANES) move_lanes();
    }
    if (filled > 0) move_lanes();
"""

_CLOSE_GAPS_IN_CPP = (
    f"const float LOWEST = grid.inset, HIGHEST = 1.0f - grid.inset; constexpr int COUNT_SHIFT = {COUNT_SHIFT};"
    + LANES_IN_CPP
    + _GATHER_IN_CPP
    + _MOVE_IN_CPP
)


@wp.func_native(_CLOSE_GAPS_IN_CPP)
def close_layer(
    grid: DualGrid,
    slot: int,
    z: int,
    active: wp.uint64,
    vertex: int,
    several_cell: int,
    gaps: wp.array(dtype=wp.vec3),
    block_x: float,
    block_y: float,
    block_z: float,
    voxel_size: float,
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
) -> None:
    """Move the vertices of the ``active`` cells of a layer, from numbers ``vertex`` and ``several_cell`` on.

    The layer begins at ``block_x`` … on the lattice.
    """


@wp.kernel
def _close_gaps(
    first: int,
    shares: int,
    grid: DualGrid,
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
        slot,
        z,
        active,
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
    launch_over_layers(
        _close_gaps,
        dim=shares * len(grid.several),
        inputs=[shares, grid, volume.table.blocks, volume.voxel_size, gaps],
        outputs=[places, cells.points],
        device=device,
    )
