"""Finding what dual contouring numbers, a layer of voxels at a time."""

import warp as wp

from fusion.devices import sum_before
from fusion.surface.cells import find_cells
from fusion.surface.dual_contouring.cell_table import CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid
from fusion.surface.dual_contouring.face_words import find_curves
from fusion.surface.dual_contouring.inset import inset_for
from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.dual_contouring.rim import find_rim
from fusion.surface.dual_contouring.several_loops import find_several_loops, write_several_loops
from fusion.surface.dual_contouring.signs import ask_signs
from fusion.surface.dual_contouring.snap_signs import snap_answers
from fusion.surface.layers import NONE, Cells, corners_back, launch_over_layers
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.kernel
def _find_complete(first: int, grid: DualGrid) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells = grid.cells
    x = NONE
    y = NONE
    z_edges = NONE
    if cells.starts[layer][0] != cells.starts[layer + 1][0]:
        here = corners_back(cells.active, cells.lower, slot, z)
        under = corners_back(cells.active, cells.lower, slot, z - 1)
        x = cells.edges[layer, 0] & here[0] & here[2] & under[0] & under[2]
        y = cells.edges[layer, 1] & here[0] & here[1] & under[0] & under[1]
        z_edges = cells.edges[layer, 2] & here[0] & here[1] & here[2] & here[3]
    grid.complete_x[layer] = x
    grid.complete_y[layer] = y
    grid.complete_z[layer] = z_edges
    grid.quad_starts[layer] = wp.bit_count(x) + wp.bit_count(y) + wp.bit_count(z_edges)


def find_grid(
    volume: Volume, oracle: Oracle | None, *, min_weight: float, snap: float = 0.0
) -> tuple[DualGrid, Counts]:
    """Find what dual contouring numbers in a volume, but for ``pins``; its voxels were seen if over ``min_weight``.

    Which voxels are inside is the oracle's to say, or without one the volume's; those of which an oracle says that they
    are ``snap`` voxels inside or less count as outside (``snap_signs``).
    """
    device = volume.device
    # Counted in place of triangles: one of each active cell.
    ones = wp.full(256, 1, dtype=int, device=device)
    cells = find_cells(volume, ones, meshed=None, min_weight=min_weight)
    answers = None if oracle is None else ask_signs(volume, cells, ones, oracle)
    if answers is not None and snap > 0:
        snap_answers(cells, ones, answers, within=snap)
    layers = len(cells.starts) - 1
    grid = _empty_grid(cells, answers)
    grid.inset = inset_for(volume)
    launch_over_layers(_find_complete, dim=layers, inputs=[], outputs=[grid], device=device)
    sum_before(grid.quad_starts)
    vertices = _find_vertices(grid, cell_tables(str(device.alias)))
    return grid, Counts(
        edges=int(cells.starts[layers:].numpy()[0][0]),
        vertices=vertices,
        quads=int(grid.quad_starts[layers:].numpy()[0]),
        rim=find_rim(grid),
        curves=0 if oracle is None else find_curves(grid),
    )


def _find_vertices(grid: DualGrid, tables: CellTables) -> int:
    """Find which cells have several loops and where vertices' numbers start, and return how many vertices there are."""
    device, layers = grid.several.device, len(grid.several)
    launch_over_layers(find_several_loops, dim=layers, inputs=[tables], outputs=[grid], device=device)
    sum_before(grid.vertex_starts)
    vertices, several = (int(total) for total in grid.vertex_starts[layers:].numpy()[0])
    grid.codes = wp.empty(several, dtype=wp.uint64, device=device)
    grid.more = wp.empty(several, dtype=int, device=device)
    launch_over_layers(write_several_loops, dim=layers, inputs=[tables], outputs=[grid], device=device)
    return vertices


def _empty_grid(cells: Cells, answers: wp.array | None) -> DualGrid:
    """Return room for what is found from the cells."""
    device, layers = cells.inside.device, len(cells.inside)
    grid = DualGrid()
    grid.cells = cells
    for name in ("complete_x", "complete_y", "complete_z", "several", "twice"):
        setattr(grid, name, wp.empty(layers, dtype=wp.uint64, device=device))
    grid.vertex_starts = wp.zeros(layers + 1, dtype=wp.vec2i, device=device)
    for name in ("quad_starts", "rim_starts", "pin_starts"):
        setattr(grid, name, wp.zeros(layers + 1, dtype=int, device=device))
    grid.parted = wp.empty((layers, 3), dtype=wp.uint64, device=device)
    grid.pins = wp.empty((2 * layers, 3), dtype=wp.uint64, device=device)
    rows = 0 if answers is None else layers
    for name in ("faces", "ambiguous"):
        setattr(grid, name, wp.empty((rows, 3), dtype=wp.uint64, device=device))
    grid.curve_starts = wp.zeros(rows + 1, dtype=int, device=device)
    grid.answers = wp.empty(0, dtype=float, device=device) if answers is None else answers
    return grid
