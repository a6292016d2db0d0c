"""A reconstruction's volume in formats of other tools."""

from pathlib import Path

from datagen.atomic_write import require_writable
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels, resolve_device
from fusion.reconstruction_files import VOLUME_FILE
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh_files import write_mesh
from fusion.surface.surface_points import surface_points, write_points
from fusion.volume.vdb_export import load_openvdb, write_vdb
from fusion.volume.volume_file import load_volume

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.surface.cells",
    "fusion.surface.marching_cubes",
    "fusion.surface.vertex_normals",
)


def export(
    folder: Path,
    out: Path,
    *,
    points: bool = False,
    min_weight: float = 0.0,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> str:
    """Write the volume of the reconstruction in ``folder`` to ``out``, by its suffix; returns what was written.

    ``.vdb`` is the field itself (``vdb_export``). ``.ply`` is the surface with normals and colours, as a mesh or as
    ``points``, where a voxel counts as seen if its weight is over ``min_weight``. Raises InputError for another
    suffix, where OpenVDB is wanted and not there, and where there is no surface.
    """
    suffix = out.suffix.lower()
    if suffix not in (".ply", ".vdb"):
        raise InputError(
            f"{out}: expected a name that ends in .ply (mesh, or points with --points) or .vdb (the field)"
        )
    if suffix == ".vdb" and (points or min_weight):
        raise InputError(f"{out}: --points and --min-weight are for .ply; a .vdb holds the whole field")
    if not 0 <= min_weight < float("inf"):
        raise InputError(f"--min-weight {min_weight:g}: expected a number from 0 on")
    require_writable(out.parent)
    target = resolve_device(device)
    if suffix == ".vdb":
        load_openvdb()
        load_kernels(("fusion.volume.vdb_export",), device=target, progress=progress)
        volume = load_volume(folder / VOLUME_FILE, device=target)
        write_vdb(out, volume)
        return f"{volume.table.count:,} blocks"
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    volume = load_volume(folder / VOLUME_FILE, device=target)
    if points:
        cloud = surface_points(volume, min_weight=min_weight)
        _require_surface(len(cloud.points), folder, min_weight)
        write_points(out, cloud)
        return f"{len(cloud.points):,} points"
    mesh = marching_cubes(volume, min_weight=min_weight, normals=True)
    _require_surface(len(mesh.triangles), folder, min_weight)
    write_mesh(out, mesh)
    return f"{len(mesh.vertices):,} vertices, {len(mesh.triangles):,} triangles"


def _require_surface(count: int, folder: Path, min_weight: float) -> None:
    if count == 0:
        raise InputError(
            f"{folder / VOLUME_FILE}: no surface where weights are over {min_weight:g}; lower --min-weight"
        )
