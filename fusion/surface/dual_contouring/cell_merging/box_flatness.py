"""Whether the mesh with boxes is near to the mesh of cells, and that near to it.

Asked is for the vertices of cells that boxes serve, and for the corners of the triangles at boxes, the middles of their
edges and their own. All of it is in voxels from a block near by, so that 32 bits tell it well far from the origin, too.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.cell_merging.box_tree import BoxTree
from fusion.surface.dual_contouring.cell_merging.boxes import Boxes
from fusion.surface.dual_contouring.cell_table import COUNT_SHIFT
from fusion.surface.dual_contouring.dual_grid import DualGrid, complete_along, first_vertex
from fusion.surface.dual_contouring.quad_split import FAN, WITHOUT_CORNER
from fusion.surface.layers import NONE, below, launch_over_layers, lowest_bit, number_of, vertex_number
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def loops_of(grid: DualGrid, layer: int, bit: int) -> int:
    """Return how many vertices an active cell has."""
    several = grid.several[layer]
    if ((several >> wp.uint64(bit)) & wp.uint64(1)) == NONE:
        return 1
    code = grid.codes[grid.vertex_starts[layer][1] + wp.bit_count(several & below(bit))]
    return int(code >> wp.uint64(COUNT_SHIFT))


@wp.kernel
def _place_cells(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    origin: wp.vec3i,
    places: wp.array(dtype=wp.vec3),
    along: wp.array(dtype=float),
    points: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec3i),
) -> None:
    layer = wp.tid() + first
    corner = 8 * (blocks[number_of(grid.cells, layer >> 3)] - origin)
    left = grid.cells.active[layer]
    while left != NONE:
        bit = lowest_bit(left)
        vertex = first_vertex(grid, layer, bit)
        cell = corner + wp.vec3i(bit & 7, bit >> 3, layer & 7)
        for loop in range(loops_of(grid, layer, bit)):
            corners[vertex + loop] = cell
            low = wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
            points[vertex + loop] = low + places[vertex + loop]
        left = left & (left - wp.uint64(1))
    quad = grid.quad_starts[layer]
    if quad == grid.quad_starts[layer + 1]:
        return
    for axis in range(3):
        left = complete_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            voxel = corner + wp.vec3i(bit & 7, bit >> 3, layer & 7)
            point = wp.vec3(float(voxel[0]), float(voxel[1]), float(voxel[2]))
            point[axis] += along[vertex_number(grid.cells, layer, axis, bit)]
            points[places.shape[0] + quad] = point
            quad += 1
            left = left & (left - wp.uint64(1))


@wp.kernel
def _place_boxes(first: int, corners: wp.array(dtype=wp.vec3i), boxes: Boxes, points: wp.array(dtype=wp.vec3)) -> None:
    vertex = wp.tid() + first
    if boxes.levels[vertex] != wp.uint8(0):
        side = 1 << int(boxes.levels[vertex])
        cell = corners[vertex]
        low = wp.vec3(float(cell[0] & -side), float(cell[1] & -side), float(cell[2] & -side))
        points[vertex] = low + boxes.owner_places[vertex]


@wp.kernel
def _find_far(
    first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), within: float, far: wp.array(dtype=wp.uint8)
) -> None:
    index = wp.tid() + first
    query = wp.mesh_query_point_no_sign(mesh, points[index], within)
    far[index] = wp.uint8(wp.where(query.result, 0, 1))


@dataclass(frozen=True, kw_only=True)
class _Triangles:
    """Triangles that quads are cut into: their ``corners`` (m, 3), numbers of points, and their ``quads`` (m,)."""

    corners: NDArray[np.int32]
    quads: NDArray[np.intp]


def _triangles(corners: NDArray[np.int32], splits: NDArray[np.uint8], crossings: NDArray[np.intp]) -> _Triangles:
    """Return the triangles of quads between vertices, ``crossings`` the middles of fans; none has a corner twice."""
    one, two, fan = (np.flatnonzero(some) for some in (splits >= WITHOUT_CORNER, splits < FAN, splits == FAN))
    fewer = np.take_along_axis(corners[one], (splits[one, None] - WITHOUT_CORNER + np.arange(1, 4)) & 3, axis=1)
    turned = np.take_along_axis(corners[two], (splits[two, None] + np.arange(4)) & 3, axis=1)
    middles = crossings[fan][:, None]
    around = [np.hstack([middles, corners[fan][:, [side, (side + 1) & 3]]]) for side in range(4)]
    found = np.concatenate([fewer, turned[:, [0, 1, 2]], turned[:, [0, 2, 3]], *around]).astype(np.int32)
    quads = np.concatenate([one, two, two, fan, fan, fan, fan])
    proper = (found != found[:, [1, 2, 0]]).all(axis=1)
    return _Triangles(corners=found[proper], quads=quads[proper])


class BoxFlatness:
    """The mesh of cells, to hold that with boxes against."""

    def __init__(
        self,
        volume: Volume,
        grid: DualGrid,
        corners: wp.array,
        splits: wp.array,
        along: wp.array,
        places: wp.array,
        *,
        flatness: float,
    ) -> None:
        self.device: Any = volume.device
        self.flatness = flatness
        self.corners: NDArray[np.int32] = corners.numpy()
        self._crossings = len(places) + np.arange(len(self.corners))
        self._points = wp.zeros(len(places) + len(self.corners), dtype=wp.vec3, device=self.device)
        self._cells = wp.zeros(len(places), dtype=wp.vec3i, device=self.device)
        origin = wp.vec3i(*volume.table.blocks[:1].numpy()[0].tolist())
        launch_over_layers(
            _place_cells,
            dim=len(grid.several),
            inputs=[grid, volume.table.blocks, origin, places, along],
            outputs=[self._points, self._cells],
            device=self.device,
        )
        self._held: tuple[NDArray[np.int32], NDArray[np.uint8]] | None = None
        self._fine = self._mesh(self._points, _triangles(self.corners, splits.numpy(), self._crossings))

    def refuse_far(self, tree: BoxTree, splits: wp.array) -> bool:
        """Refuse boxes that are more than ``flatness`` voxels off, for quads cut so; return whether there are any."""
        levels, owners = tree.boxes.levels.numpy(), tree.boxes.owners.numpy()
        changed = self._changed(owners, levels)
        merged = levels > 0
        if not merged.any():
            return False
        points = wp.clone(self._points)
        launch_over_layers(
            _place_boxes, dim=len(levels), inputs=[self._cells, tree.boxes], outputs=[points], device=self.device
        )
        near = np.flatnonzero(merged[self.corners].any(axis=1))
        corners = owners[self.corners[near]]
        triangles = _triangles(corners, splits.numpy()[near], self._crossings[near])
        mesh = self._mesh(points, triangles)
        far = self._far_cells(mesh, np.flatnonzero(merged & changed[owners]))
        off = self._far_triangles(points.numpy(), triangles, changed, merged)
        if len(far) == 0 and len(off) == 0:
            # Those that had been near may have been so to triangles around boxes that are not beside theirs.
            far = self._far_cells(mesh, np.flatnonzero(merged & ~changed[owners]))
        refused = tree.boxes.refused.numpy()
        refused[owners[far]] = 1
        refused[self._boxes_at(triangles.corners[off], corners[triangles.quads[off]], merged)] = 1
        tree.boxes.refused.assign(refused)
        return len(far) > 0 or len(off) > 0

    def _changed(self, owners: NDArray[np.int32], levels: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return which owners (n,), as they are and with those around them, were not yet held against the cells."""
        before, self._held = self._held, (owners.copy(), levels.copy())  # on the CPU these are views
        changed = np.ones(len(owners), bool)
        if before is not None:
            touched = ((owners != before[0]) | (levels != before[1]))[self.corners].any(axis=1)
            changed[:] = False
            changed[owners[self.corners[touched]]] = True
        return changed

    def _mesh(self, points: wp.array, triangles: _Triangles) -> wp.Mesh:
        return wp.Mesh(points=points, indices=wp.array(triangles.corners.ravel(), dtype=int, device=self.device))

    def _far_cells(self, mesh: wp.Mesh, cells: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return which vertices of cells, of the numbers ``cells``, are too far from the mesh with boxes."""
        return cells[self._far(mesh, self._points.numpy()[cells])]

    def _far_triangles(
        self, points: NDArray[np.float32], triangles: _Triangles, changed: NDArray[np.bool_], merged: NDArray[np.bool_]
    ) -> NDArray[np.intp]:
        """Return which triangles with a changed corner are too far from the mesh of cells, of which they have points.

        Those are their corners, the middles of their edges and their own: what they share is asked for once.
        """
        of_vertices = np.zeros(len(points), bool)
        of_vertices[: len(changed)] = changed
        asked = np.flatnonzero(of_vertices[triangles.corners].any(axis=1))
        corners = triangles.corners[asked]
        # Single cells' vertices are those of the mesh of cells itself.
        far_points = np.zeros(len(points), bool)
        far_points[corners] = True
        far_points[: len(merged)] &= merged
        numbers = np.flatnonzero(far_points)
        far_points[numbers] = self._far(self._fine, points[numbers])
        ends = np.sort(np.stack([corners, corners[:, [1, 2, 0]]], axis=-1).reshape(-1, 2), axis=1).astype(np.int64)
        edges, edge_of = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
        middles = 0.5 * (points[edges // len(points)] + points[edges % len(points)])
        far = far_points[corners].any(axis=1)
        far |= self._far(self._fine, middles)[edge_of].reshape(-1, 3).any(axis=1)
        far |= self._far(self._fine, points[corners].mean(axis=1))
        return asked[far]

    def _boxes_at(
        self, triangles: NDArray[np.int32], quads: NDArray[np.int32], merged: NDArray[np.bool_]
    ) -> NDArray[np.int32]:
        """Return the boxes at the corners of triangles (m, 3), or else at those of the quads (m, 4) that they are of.

        Of a quad at a box a triangle may be between cells alone, where that of the cells is cut otherwise.
        """
        is_box = np.zeros(len(self._points), bool)
        is_box[: len(merged)] = merged
        without = ~is_box[triangles].any(axis=1)
        corners = np.concatenate([triangles.ravel(), quads[without].ravel()])
        return corners[is_box[corners]]

    def _far(self, mesh: wp.Mesh, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return which points (n, 3) are farther from a mesh than the flatness."""
        far = wp.empty(len(points), dtype=wp.uint8, device=self.device)
        inputs = [mesh.id, wp.array(points, dtype=wp.vec3, device=self.device), self.flatness]
        launch_in_slabs(_find_far, dim=len(points), inputs=inputs, outputs=[far], device=self.device)
        return far.numpy() != 0
