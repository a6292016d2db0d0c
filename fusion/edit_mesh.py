"""A mesh made ready for other programs: its parts chosen, smoothed, decimated, and written in their format."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.atomic_write import require_writable
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels, resolve_device
from fusion.reconstruction_files import MESH_FILE
from fusion.surface.mesh_files import WRITABLE, read_mesh, require_writable_format, write_mesh
from fusion.surface.mesh_operations import decimate, holes, largest_component, smooth, without_small_components

LISTED_HOLES = 10


@dataclass(frozen=True, kw_only=True)
class MeshEdits:
    """What is done, in this order: parts chosen, smoothed, decimated; None, False or 0 for what is not.

    ``largest`` keeps the component with the largest area, ``least_triangles`` those that are as large;
    ``smoothing`` is a number of Taubin iterations; ``triangles`` how many are to be left.
    """

    largest: bool = False
    least_triangles: int | None = None
    smoothing: int = 0
    triangles: int | None = None


def edit_mesh(
    source: Path, out: Path, edits: MeshEdits, *, device: str = "auto", progress: ProgressReporter = silent
) -> dict[str, Any]:
    """Edit the mesh of a reconstruction's folder or of a file and write it to ``out``, by its suffix.

    Returns, ready for JSON, the numbers of vertices and triangles, the ``holes`` (the longest, with their lengths and
    centres in metres), and what the format had no place for. Raises InputError for unusable input, before writing.
    """
    require_writable_format(out)
    require_writable(out.parent)
    path = source / MESH_FILE if source.is_dir() else source
    mesh = read_mesh(path)
    if edits.triangles is not None and edits.triangles < 4:
        raise InputError(f"--triangles {edits.triangles}: expected at least 4")
    if edits.least_triangles is not None:
        mesh = without_small_components(mesh, edits.least_triangles)
    if edits.largest:
        mesh = largest_component(mesh)
    if edits.smoothing:
        mesh = smooth(mesh, edits.smoothing)
    if edits.triangles is not None and edits.triangles < len(mesh.triangles):
        target = resolve_device(device)
        load_kernels(("fusion.surface.closest_points",), device=target, progress=progress)
        mesh = decimate(mesh, edits.triangles, device=target)
    write_mesh(out, mesh)
    found = holes(mesh)
    return {
        "file": str(out),
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "hole_count": len(found),
        "holes": [{"edges": h.edges, "length_m": h.length, "centre_m": list(h.centre)} for h in found[:LISTED_HOLES]],
        "left_out": WRITABLE[out.suffix.lower()],
    }
