"""Whether the mesh with boxes is near to the mesh of cells, and that near to it.

Asked is for the vertices of cells that boxes serve, and for the corners of the triangles at boxes, the middles of their
edges and their own. All of it is in voxels from a block near by, so that 32 bits tell it well far from the origin, too.
"""

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

_SAMPLES = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3] * 3], np.float32
)


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


def _triangles(corners: NDArray[np.int32], splits: NDArray[np.uint8], crossings: NDArray[np.intp]) -> NDArray[np.int32]:
    """Return the triangles (m, 3) that quads are cut into, of vertices and of their ``crossings``, the middles of fans.

    None has a corner twice.
    """
    one, two, fan = splits >= WITHOUT_CORNER, splits < FAN, splits == FAN
    fewer = np.take_along_axis(corners[one], (splits[one, None] - WITHOUT_CORNER + np.arange(1, 4)) & 3, axis=1)
    turned = np.take_along_axis(corners[two], (splits[two, None] + np.arange(4)) & 3, axis=1)
    middles = crossings[fan][:, None]
    around = [np.hstack([middles, corners[fan][:, [side, (side + 1) & 3]]]) for side in range(4)]
    found = np.concatenate([fewer, turned[:, [0, 1, 2]], turned[:, [0, 2, 3]], *around]).astype(np.int32)
    return found[(found != np.roll(found, 1, axis=1)).all(axis=1)]


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
        merged = np.flatnonzero((levels > 0) & changed[owners])
        if len(merged) == 0:
            return False
        points = wp.clone(self._points)
        launch_over_layers(
            _place_boxes, dim=len(levels), inputs=[self._cells, tree.boxes], outputs=[points], device=self.device
        )
        near = (levels[self.corners] > 0).any(axis=1)
        triangles = _triangles(owners[self.corners[near]], splits.numpy()[near], self._crossings[near])
        refused = tree.boxes.refused.numpy()
        far = self._far(self._mesh(points, triangles), self._points.numpy()[merged])
        refused[owners[merged[far]]] = 1
        triangles = triangles[changed[np.minimum(triangles, len(levels) - 1)].any(axis=1)]
        samples = np.einsum("sk,mkc->smc", _SAMPLES, points.numpy()[triangles])
        off = self._far(self._fine, samples.reshape(-1, 3)).reshape(len(_SAMPLES), -1).any(axis=0)
        corners = triangles[off].ravel()
        corners = corners[corners < len(levels)]
        refused[corners[levels[corners] > 0]] = 1
        tree.boxes.refused.assign(refused)
        return bool(far.any() or off.any())

    def _changed(self, owners: NDArray[np.int32], levels: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return which owners (n,), as they are and with those around them, were not yet held against the cells."""
        before, self._held = self._held, (owners.copy(), levels.copy())  # on the CPU these are views
        changed = np.ones(len(owners), bool)
        if before is not None:
            touched = ((owners != before[0]) | (levels != before[1]))[self.corners].any(axis=1)
            changed[:] = False
            changed[owners[self.corners[touched]]] = True
        return changed

    def _mesh(self, points: wp.array, triangles: NDArray[np.int32]) -> wp.Mesh:
        used, corners = np.unique(triangles, return_inverse=True)
        return wp.Mesh(
            points=wp.array(points.numpy()[used], dtype=wp.vec3, device=self.device),
            indices=wp.array(corners.ravel().astype(np.int32), dtype=int, device=self.device),
        )

    def _far(self, mesh: wp.Mesh, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return which points (n, 3) are farther from a mesh than the flatness."""
        far = wp.empty(len(points), dtype=wp.uint8, device=self.device)
        inputs = [mesh.id, wp.array(points, dtype=wp.vec3, device=self.device), self.flatness]
        launch_in_slabs(_find_far, dim=len(points), inputs=inputs, outputs=[far], device=self.device)
        return far.numpy() != 0
