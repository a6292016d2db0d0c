"""Which way a volume is meshed."""

from collections.abc import Callable
from typing import Literal, TypeAlias

from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.volume.tsdf_volume import Volume

Mesher: TypeAlias = Literal["marching-cubes", "dual-contouring"]
OracleName: TypeAlias = Literal["volume", "depth"]
"""What dual contouring asks: the volume's trilinear field, or the continuous one of the depth images."""

_DUAL_CONTOURING = (
    "find_grid",
    "several_loops",
    "rim",
    "face_words",
    "edge_points",
    "cell_points",
    "cells_from_faces",
    "quad_corners",
    "close_gaps",
    "pins",
    "quads",
    "rim_polygons",
    "rim_vertices",
)
KERNEL_MODULES: dict[Mesher, tuple[str, ...]] = {
    "marching-cubes": ("fusion.surface.cells", "fusion.surface.marching_cubes"),
    "dual-contouring": (
        "fusion.surface.cells",
        *(f"fusion.surface.dual_contouring.{name}" for name in _DUAL_CONTOURING),
    ),
}


_MERGING = (
    "snap_signs",
    "cell_merging.extended_signs",
    "cell_merging.tame_cells",
    "cell_merging.merge_boxes",
    "cell_merging.box_tree",
    "cell_merging.box_quads",
    "cell_merging.box_flatness",
)


def kernel_modules(mesher: Mesher, *, flatness: float = 0.0) -> tuple[str, ...]:
    """Return the names of the modules whose kernels ``mesh_volume`` launches, imported."""
    if mesher == "dual-contouring":
        _dual_contouring()  # before any clock runs
    if mesher == "marching-cubes" or flatness == 0:
        return KERNEL_MODULES[mesher]
    merging = (f"fusion.surface.dual_contouring.{name}" for name in _MERGING)
    return (*KERNEL_MODULES[mesher], *merging)


def mesh_volume(
    volume: Volume,
    mesher: Mesher,
    *,
    oracle: Oracle | None = None,
    min_weight: float = 0.0,
    normals: bool = False,
    flatness: float = 0.0,
) -> Mesh:
    """Return a volume's surface as a mesh.

    ``oracle`` is dual contouring's, None for the volume itself, and so is ``flatness``, voxels, 0 for a vertex a cell.
    """
    if mesher == "dual-contouring":
        mesh_it = _dual_contouring()
        return mesh_it(volume, oracle=oracle, min_weight=min_weight, normals=normals, flatness=flatness)
    assert oracle is None, "marching cubes asks the volume alone"
    return marching_cubes(volume, min_weight=min_weight, normals=normals)


def _dual_contouring() -> Callable[..., Mesh]:
    # Its modules, more than forty, take nearly as long to import as Warp: what meshes otherwise does not wait for them.
    from fusion.surface.dual_contouring.dual_contouring import dual_contouring  # noqa: PLC0415

    return dual_contouring
