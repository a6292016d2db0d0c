"""A reconstruction's volume in formats of other tools."""

from dataclasses import replace
from pathlib import Path

from datagen.atomic_write import require_writable
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels, resolve_device
from fusion.meshing import mesh_again, recorded_config
from fusion.reconstruction_files import VOLUME_FILE, read_record
from fusion.surface.mesh_files import write_mesh
from fusion.surface.meshers import Mesher, OracleName
from fusion.surface.surface_points import points_of, write_points
from fusion.volume.vdb_export import load_openvdb, write_vdb
from fusion.volume.volume_file import load_volume

KERNEL_MODULES = ("fusion.volume.block_table",)


def export(
    folder: Path,
    out: Path,
    *,
    points: bool = False,
    min_weight: float | None = None,
    mesher: Mesher | None = None,
    oracle: OracleName | None = None,
    flatness: float | None = None,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> str:
    """Write the volume of the reconstruction in ``folder`` to ``out``, by its suffix; returns what was written.

    ``.vdb`` is the field itself (``vdb_export``). ``.ply`` is the surface with normals and colours, as a mesh or as its
    vertices alone, ``points``, where a voxel counts as seen if its weight is over ``min_weight``. Where this,
    ``mesher``, ``oracle`` or ``flatness`` is None, it is meshed as the reconstruction was. Raises InputError for
    another suffix, where OpenVDB is wanted and not there, where depth images are to be asked that are not there, and
    where there is no surface.
    """
    suffix = out.suffix.lower()
    if suffix not in (".ply", ".vdb"):
        raise InputError(
            f"{out}: expected a name that ends in .ply (mesh, or points with --points) or .vdb (the field)"
        )
    if suffix == ".vdb" and (points or min_weight or mesher or oracle or flatness is not None):
        raise InputError(
            f"{out}: --points, --min-weight, --mesher, --oracle and --flatness are for .ply; "
            "a .vdb holds the whole field"
        )
    require_writable(out.parent)
    target = resolve_device(device)
    if suffix == ".vdb":
        load_openvdb()
        load_kernels(("fusion.volume.vdb_export",), device=target, progress=progress)
        volume = load_volume(folder / VOLUME_FILE, device=target)
        write_vdb(out, volume)
        return f"{volume.table.count:,} blocks"
    record = read_record(folder)
    config = recorded_config(folder, record, mesher=mesher, oracle=oracle, flatness=flatness)
    if min_weight is not None:
        config = replace(config, min_weight=min_weight)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    volume = load_volume(folder / VOLUME_FILE, device=target)
    mesh = mesh_again(volume, folder, record, config, normals=True, progress=progress)
    if len(mesh.triangles) == 0:
        raise InputError(
            f"{folder / VOLUME_FILE}: no surface where weights are over {config.min_weight:g}; lower --min-weight"
        )
    if points:
        write_points(out, points_of(mesh))
        return f"{len(mesh.vertices):,} points"
    write_mesh(out, mesh)
    return f"{len(mesh.vertices):,} vertices, {len(mesh.triangles):,} triangles"
