"""1-D points: where the surface crosses the edges between voxels."""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid
from fusion.surface.dual_contouring.oracle import Oracle, is_known, next_question
from fusion.surface.dual_contouring.qef import INSET
from fusion.surface.dual_contouring.rows import ROWS_IN_CPP
from fusion.surface.layers import NONE, Cells, launch_over_layers, lowest_bit, number_of, step_along, voxel_of
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels, distance_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_LOWEST = wp.constant(INSET)
_HIGHEST = wp.constant(1.0 - INSET)
TOLERANCE = wp.constant(1.0e-3)
"""Voxels: a crossing is known as exactly as vertices keep from borders."""
LEAST_GUESS = wp.constant(0.05)
MOST_QUESTIONS = wp.constant(14)


_CROSS_EDGES_IN_CPP = (
    f"constexpr float LOWEST = {INSET}f, HIGHEST = 1.0f - {INSET}f;"
    + ROWS_IN_CPP
    + """
    const bool packed = voxels.packed.shape[0] > 0;
    auto distance = [&](size_t voxel) {
        if (packed) return (float)(short)voxels.packed.data[voxel];
        return voxels.distance_sum.data[voxel] / voxels.weight.data[voxel];
    };
    for (int axis = 0; axis < 3; ++axis) {
        for (wp::uint64 left = cells.edges.data[3 * (8 * (size_t)slot + z) + axis]; left != 0; left &= left - 1) {
            const int bit = wp::bit_count((left - 1) & ~left);
            const int x = (bit & 7) + (axis == 0), y = (bit >> 3) + (axis == 1);
            const size_t on = rows[(x >> 3) | ((y >> 3) << 1) | (axis == 2 ? 4 : 0)] + 8 * (y & 7) + (x & 7);
            const float a = distance(rows[0] + bit), b = distance(on), at = a / (a - b);
            along.data[edge++] = at < LOWEST ? LOWEST : at > HIGHEST ? HIGHEST : at;
        }
    }
"""
)


@wp.func_native(_CROSS_EDGES_IN_CPP)
def cross_edges(cells: Cells, slot: int, z: int, voxels: Voxels, edge: int, along: wp.array(dtype=float)) -> None:
    """Write where the trilinear field, which is linear there, crosses a layer's edges, from number ``edge`` on."""


@wp.kernel
def _cross_edges(first: int, cells: Cells, voxels: Voxels, along: wp.array(dtype=float)) -> None:
    layer = wp.tid() + first
    edge = cells.starts[layer][0]
    if edge != cells.starts[layer + 1][0]:
        cross_edges(cells, layer >> 3, layer & 7, voxels, edge, along)


@wp.func
def guesses(cells: Cells, voxels: Voxels, slot: int, voxel: wp.vec3i, axis: int, voxels_a_truncation: float) -> wp.vec2:
    """Return how far off the surface may be at both ends of an edge, in voxels: what the volume holds tells."""
    on = voxel + step_along(axis)
    a = wp.abs(distance_of(voxels, voxel_of(cells, slot, voxel[0], voxel[1], voxel[2])))
    b = wp.abs(distance_of(voxels, voxel_of(cells, slot, on[0], on[1], on[2])))
    return wp.vec2(wp.max(voxels_a_truncation * a, LEAST_GUESS), wp.max(voxels_a_truncation * b, LEAST_GUESS))


@cache
def _searcher(value: Any, state_type: Any) -> Any:
    """Return the function that asks an oracle where the surface crosses an edge."""

    @wp.func
    def search(state: state_type, number: int, start: wp.vec3, way: wp.vec3, at_start: float, at_end: float) -> float:
        """Return the crossing between two voxels of different sign, in voxels from the first."""
        low = float(0.0)
        high = float(1.0)
        at_low = at_start
        at_high = at_end
        for step in range(MOST_QUESTIONS):
            s = next_question(low, high, at_low, at_high, step)
            answer = value(state, number, start + s * way)
            if not is_known(answer):
                return low + (high - low) * at_low / (at_low - at_high)
            if answer == 0.0:
                return s
            if (answer < 0.0) == (at_start < 0.0):
                low = s
                at_low = answer
            else:
                high = s
                at_high = answer
            if high - low < TOLERANCE:
                return 0.5 * (low + high)
            if wp.abs(answer) < 0.2 * TOLERANCE:
                return s
        return 0.5 * (low + high)

    return search


@cache
def search_kernel(value: Any, state_type: Any) -> Kernel:
    """Return the kernel that asks an oracle where the surface crosses the edges; a thread takes a layer."""
    search = _searcher(value, state_type)

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def search_edges(
        first: int,
        grid: DualGrid,
        blocks: wp.array(dtype=wp.vec3i),
        voxels: Voxels,
        voxels_a_truncation: float,
        state: state_type,
        along: wp.array(dtype=float),
    ) -> None:
        layer = wp.tid() + first
        cells = grid.cells
        edge = cells.starts[layer][0]
        if edge == cells.starts[layer + 1][0]:
            return
        slot = layer >> 3
        number = number_of(cells, slot)
        for axis in range(3):
            step = step_along(axis)
            way = wp.vec3(float(step[0]), float(step[1]), float(step[2]))
            left = cells.edges[layer, axis]
            while left != NONE:
                bit = lowest_bit(left)
                voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
                corner = 8 * blocks[number] + voxel
                start = wp.vec3(float(corner[0]), float(corner[1]), float(corner[2]))
                guess = guesses(cells, voxels, slot, voxel, axis, voxels_a_truncation)
                sign = wp.where(((cells.inside[layer] >> wp.uint64(bit)) & wp.uint64(1)) != NONE, -1.0, 1.0)
                found = search(state, number, start, way, sign * guess[0], -sign * guess[1])
                along[edge] = wp.clamp(found, _LOWEST, _HIGHEST)
                edge += 1
                left = left & (left - wp.uint64(1))

    return search_edges


def edge_points(volume: Volume, grid: DualGrid, counts: Counts, oracle: Oracle | None) -> wp.array:
    """Return where the surface crosses each edge (edges,), in voxels from the edge's lower one.

    Without an oracle it is where the volume's trilinear field does.
    """
    device = volume.device
    along = wp.empty(counts.edges, dtype=float, device=device)
    layers = len(grid.cells.starts) - 1
    if oracle is None:
        launch_over_layers(_cross_edges, dim=layers, inputs=[grid.cells, volume.voxels], outputs=[along], device=device)
        return along
    launch_in_slabs(
        search_kernel(oracle.value, oracle.state_type),
        dim=layers,
        inputs=[
            grid,
            volume.table.blocks,
            volume.voxels,
            volume.truncation / volume.voxel_size,
            oracle.state,
        ],
        outputs=[along],
        device=device,
        least_slab=64,
    )
    return along
