"""1-D points: where the surface crosses the edges between voxels."""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, place_of
from fusion.surface.dual_contouring.line_search import line_search
from fusion.surface.dual_contouring.oracle import Oracle, is_known
from fusion.surface.dual_contouring.rows import ROWS_IN_CPP
from fusion.surface.layers import NONE, Cells, launch_over_layers, lowest_bit, number_of, step_along, voxel_of
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels, distance_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_LEAST_GUESS = wp.constant(0.05)
"""Voxels."""


_CROSS_EDGES_IN_CPP = (
    "const float LOWEST = inset, HIGHEST = 1.0f - inset;"
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
def cross_edges(
    cells: Cells, inset: float, slot: int, z: int, voxels: Voxels, edge: int, along: wp.array(dtype=float)
) -> None:
    """Write where the trilinear field, which is linear there, crosses a layer's edges, from number ``edge`` on."""


@wp.kernel
def _cross_edges(first: int, grid: DualGrid, voxels: Voxels, along: wp.array(dtype=float)) -> None:
    layer = wp.tid() + first
    edge = grid.cells.starts[layer][0]
    if edge != grid.cells.starts[layer + 1][0]:
        cross_edges(grid.cells, grid.inset, layer >> 3, layer & 7, voxels, edge, along)


@wp.func
def as_point(voxel: wp.vec3i) -> wp.vec3:
    """Return a voxel as a point on the lattice."""
    return wp.vec3(float(voxel[0]), float(voxel[1]), float(voxel[2]))


@wp.func
def off_surface(voxels: Voxels, voxel: int, voxels_a_truncation: float) -> float:
    """Return how far off the surface a voxel may be, in voxels: what the volume holds tells."""
    return wp.max(voxels_a_truncation * wp.abs(distance_of(voxels, voxel)), _LEAST_GUESS)


@cache
def _edge_searcher(value: Any, state_type: Any) -> Any:
    """Return the function that asks an oracle where the surface crosses an edge."""
    search = line_search(value, state_type)

    @wp.func
    def search_edge(
        state: state_type,
        grid: DualGrid,
        voxels: Voxels,
        voxels_a_truncation: float,
        layer: int,
        bit: int,
        axis: int,
        corner: wp.vec3i,
    ) -> float:
        """Return the crossing on the edge along ``axis`` from a layer's voxel, in voxels from that."""
        slot = layer >> 3
        step = step_along(axis)
        voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
        end = voxel + step
        place = place_of(grid.cells.upper, slot, end[0], end[1], end[2])
        a = off_surface(voxels, voxel_of(grid.cells, slot, voxel[0], voxel[1], voxel[2]), voxels_a_truncation)
        b = off_surface(voxels, voxel_of(grid.cells, slot, end[0], end[1], end[2]), voxels_a_truncation)
        # What the volume holds is off by about the same factor at both ends: there it crosses zero rather well.
        guess = a / (a + b)
        at_start = grid.answers[64 * layer + bit]
        at_end = grid.answers[64 * place[0] + place[1]]
        sign = wp.where(((grid.cells.inside[layer] >> wp.uint64(bit)) & wp.uint64(1)) != NONE, -1.0, 1.0)
        if not is_known(at_start):
            at_start = sign * a
        if not is_known(at_end):
            at_end = -sign * b
        start = as_point(corner + voxel)
        found = search(state, number_of(grid.cells, slot), start, as_point(step), 0.0, 1.0, at_start, at_end, guess)
        if found < 0.0:
            return guess
        return found

    return search_edge


@cache
def search_kernel(value: Any, state_type: Any) -> Kernel:
    """Return the kernel that asks an oracle where the surface crosses the edges; a thread takes a layer."""
    search_edge = _edge_searcher(value, state_type)

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
        edge = grid.cells.starts[layer][0]
        if edge == grid.cells.starts[layer + 1][0]:
            return
        corner = 8 * blocks[number_of(grid.cells, layer >> 3)]
        for axis in range(3):
            left = grid.cells.edges[layer, axis]
            while left != NONE:
                bit = lowest_bit(left)
                found = search_edge(state, grid, voxels, voxels_a_truncation, layer, bit, axis, corner)
                along[edge] = wp.clamp(found, grid.inset, 1.0 - grid.inset)
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
        launch_over_layers(_cross_edges, dim=layers, inputs=[grid, volume.voxels], outputs=[along], device=device)
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
