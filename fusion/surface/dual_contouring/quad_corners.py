"""The corners of quads: the vertices of the four cells around each complete edge, and how far from them the edge is."""

import warp as wp

from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid
from fusion.surface.layers import launch_over_layers

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# In C++ for its local arrays: the active cells of the eight layers around the edges are looked up once for all of them.
_CORNERS_IN_CPP = """
    struct { wp::uint64 active, several; int first, first_several; } owners[8] = {};
    for (int back = 0; back < 8; ++back) {
        const int holder = grid.cells.lower.data[8 * slot + ((back & 3) | (z == 0 ? back & 4 : 0))];
        const int layer = 8 * holder + ((z - (back >> 2)) & 7);
        if (holder < 0) continue;  // none of its cells is beside a complete edge
        owners[back] = {grid.cells.active.data[layer], grid.several.data[layer], grid.vertex_starts.data[layer].c[0],
                        grid.vertex_starts.data[layer].c[1]};
    }
    // The cell's vertex for an edge, as ``vertex_of_edge`` has it.
    auto vertex_of = [&](const auto &owner, int bit, int edge) {
        const wp::uint64 before = ((wp::uint64)1 << bit) - 1;
        int vertex = owner.first + wp::bit_count(owner.active & before);
        if (owner.several) {
            const int several_cell = owner.first_several + wp::bit_count(owner.several & before);
            if (owner.several & before) vertex += grid.more.data[several_cell - 1];
            if ((owner.several >> bit) & 1) vertex += (int)(grid.codes.data[several_cell] >> 4 * edge) & 15;
        }
        return vertex;
    };
    const int layer = 8 * slot + z;
    const bool with_gaps = gaps.shape[0] > 0;
    const wp::uint64 *edges = grid.cells.edges.data + 3 * (size_t)layer;
    int first_edge = grid.cells.starts.data[layer].c[0];
    #pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
        const int second = axis == 2 ? 0 : axis + 1, third = axis == 0 ? 2 : axis - 1;
        const auto &complete = axis == 0 ? grid.complete_x : axis == 1 ? grid.complete_y : grid.complete_z;
        for (wp::uint64 left = complete.data[layer]; left != 0; left &= left - 1, ++quad) {
            const int bit = wp::bit_count((left - 1) & ~left);
            float sum[3] = {0.0f, 0.0f, 0.0f};
            #pragma unroll
            for (int corner = 0; corner < 4; ++corner) {
                // Counter-clockwise about the edge: here, one back along the second axis, along both, along the third.
                const int back_second = corner == 1 || corner == 2, back_third = corner >> 1;
                const int back = back_second << second | back_third << third;
                const int x = (bit & 7) - (back & 1), y = (bit >> 3) - ((back >> 1) & 1);
                const auto &owner = owners[(x < 0) | (y < 0) << 1 | (back & 4)];
                // Which of the cell's edges it is: of the other two axes the lower one counts 1, the higher one 2.
                const int low = second < third ? back_second : back_third;
                const int edge = 4 * axis + low + 2 * (back_second + back_third - low);
                const int vertex = vertex_of(owner, 8 * (y & 7) + (x & 7), edge);
                corners.data[quad][corner] = vertex;
                if (with_gaps) for (int i = 0; i < 3; ++i) sum[i] += places.data[vertex][i];
            }
            if (!with_gaps) continue;
            const wp::uint64 before = ((wp::uint64)1 << bit) - 1;
            // Two of the four cells are one back along each of the other axes.
            sum[axis] -= 4.0f * along.data[first_edge + wp::bit_count(edges[axis] & before)];
            sum[second] -= 2.0f;
            sum[third] -= 2.0f;
            gaps.data[quad] = wp::vec3(-0.25f * sum[0], -0.25f * sum[1], -0.25f * sum[2]);
        }
        first_edge += wp::bit_count(edges[axis]);
    }
"""


@wp.func_native(_CORNERS_IN_CPP)
def find_corners(
    grid: DualGrid,
    slot: int,
    z: int,
    quad: int,
    along: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec4i),
    gaps: wp.array(dtype=wp.vec3),
) -> None:
    """Write the corners and gaps of a layer's quads from number ``quad`` on."""


@wp.kernel
def _find_corners(
    first: int,
    grid: DualGrid,
    along: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec4i),
    gaps: wp.array(dtype=wp.vec3),
) -> None:
    layer = wp.tid() + first
    quad = grid.quad_starts[layer]
    if quad != grid.quad_starts[layer + 1]:
        find_corners(grid, layer >> 3, layer & 7, quad, along, places, corners, gaps)


def quad_corners(
    grid: DualGrid, counts: Counts, along: wp.array, places: wp.array, *, gaps: bool
) -> tuple[wp.array, wp.array]:
    """Return the quads' corners (quads,), numbers of vertices, counter-clockwise about the edge, and ``gaps`` if asked.

    A gap (quads,) leads from the mean of the corners, which lie at ``places``, to the edge's 1-D point, in voxels.
    """
    device = places.device
    corners = wp.empty(counts.quads, dtype=wp.vec4i, device=device)
    found = wp.empty(counts.quads if gaps else 0, dtype=wp.vec3, device=device)
    inputs = [grid, along, places]
    launch_over_layers(_find_corners, dim=len(grid.several), inputs=inputs, outputs=[corners, found], device=device)
    return corners, found
