"""Occupancy-based dual contouring on the sparse blocks, after Hwang and Sung (SIGGRAPH Asia 2024).

1-D points on edges, 2-D points on faces, 3-D points in cells, and quads that are cut so that they never meet: the steps
are modules of their own, as is merging cells where the surface is flat. Vertices are in the order of their cells, then
those on faces, then those on edges, and last those on the edges of the rim; triangles are in the order of the edges,
those at the rim last. So nothing depends on which thread is first.
"""

from fusion.devices import Kernel
from fusion.surface.dual_contouring.cell_merging.merge_cells import merge_cells, without_unused_vertices
from fusion.surface.dual_contouring.cell_points import cell_points
from fusion.surface.dual_contouring.close_gaps import close_gaps
from fusion.surface.dual_contouring.edge_points import edge_points, search_kernel
from fusion.surface.dual_contouring.face_points import face_kernel, face_points
from fusion.surface.dual_contouring.find_grid import find_grid
from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.dual_contouring.pins import place_pins
from fusion.surface.dual_contouring.quad_corners import quad_corners
from fusion.surface.dual_contouring.quads import cut_quads, split_quads
from fusion.surface.dual_contouring.rim_polygons import count_rim_triangles, write_rim_triangles
from fusion.surface.dual_contouring.rim_vertices import rim_vertices
from fusion.surface.dual_contouring.signs import sign_kernel
from fusion.surface.dual_contouring.snap_signs import MOST_SNAP, snapped
from fusion.surface.dual_contouring.vertices import VertexRoom
from fusion.surface.mesh import Mesh
from fusion.volume.tsdf_volume import Volume

_MORE = 16
"""A vertex on a face or an edge for so many within cells is more than most scenes have."""


def dual_contouring(
    volume: Volume,
    *,
    oracle: Oracle | None = None,
    min_weight: float = 0.0,
    normals: bool = False,
    flatness: float = 0.0,
) -> Mesh:
    """Return the volume's surface as a manifold mesh in world coordinates, with colours, that never meets itself.

    Which voxels are inside and where the surface passes between them is what ``oracle`` answers, which is asked near
    the volume's surface, or without one what the volume's trilinear field says. A voxel counts as seen where its weight
    is over ``min_weight`` (≥ 0), and a cell where its eight corners do. The mesh is open at the border of the cells
    that were seen, where marching cubes' is. ``normals`` asks for the vertices' normals.

    With a ``flatness`` (≥ 0) one vertex serves many cells where the surface is flat (``merge_cells``): no vertex that a
    cell would have is farther than so many voxels from the mesh. What is less than 0.01 voxel thick may vanish.
    """
    assert min_weight >= 0, "an unseen voxel's weight is 0"
    assert flatness >= 0, "a distance"
    snap = min(MOST_SNAP, 0.25 * flatness)
    if snap > 0 and oracle is None:
        volume = snapped(volume, min_weight=min_weight, within=snap)
    grid, counts = find_grid(volume, oracle, min_weight=min_weight, snap=snap)
    along = edge_points(volume, grid, counts, oracle)
    curve_points = None if oracle is None else face_points(volume, grid, counts, oracle, along)
    merges = flatness > 0 and counts.quads > 0
    room = VertexRoom(counts.vertices + counts.rim + counts.vertices // _MORE, volume.device, normals=normals or merges)
    places, cells = cell_points(volume, grid, counts, along, curve_points, room=room)
    corners, gaps = quad_corners(grid, counts, along, places, gaps=oracle is None)
    if oracle is None:
        close_gaps(volume, grid, gaps, places, cells)
    del gaps  # its memory serves what follows
    pins = place_pins(volume, grid, along, curve_points, places, cells, room=room)
    starts, more = count_rim_triangles(grid, counts.rim)
    cuts = split_quads(grid, corners, along, places)
    if merges:
        cuts = merge_cells(volume, grid, cuts, along, places, cells, flatness=flatness - snap)
    cut = cut_quads(volume, grid, cuts, along, cells, pins=len(pins.points), more=more, room=room)
    rim_vertices(volume, grid, counts.rim, along, cells, room=room)
    first_pin, first_fan = len(cells.points), len(cells.points) + len(pins.points)
    write_rim_triangles(
        grid,
        starts,
        cut.triangles,
        first_pin=first_pin,
        first_rim=first_fan + len(cut.fans.points),
        first_triangle=len(cut.triangles) - more,
    )
    mesh = Mesh(
        vertices=room.taken("points"),
        triangles=cut.triangles.numpy(),
        colors=room.taken("colors"),
        normals=room.taken("normals") if normals else None,
    )
    return without_unused_vertices(mesh) if merges else mesh


def oracle_kernels(oracle: Oracle) -> list[Kernel]:
    """Return the kernels that are made for an oracle, to be compiled ahead."""
    asked = (sign_kernel, search_kernel, face_kernel)
    return [make(oracle.value, oracle.state_type) for make in asked]
