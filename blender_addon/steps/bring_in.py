"""A reconstruction brought into the scene in pieces, so that the interface stays alive."""

from collections.abc import Callable
from pathlib import Path

import bpy

from ..files.mesh_arrays import MeshArrays, mesh_arrays
from ..files.reconstruction_files import Reconstruction, read_reconstruction
from ..jobs.job import Job, Pace, Work
from ..results.import_reconstruction import MESH_NAME, place_reconstruction
from ..results.mesh_import import fill_mesh, object_of
from ..results.originals import originals_of, show_sides
from ..results.scene_units import reconstruction_in_units
from ..results.viewport_colors import suit_shading
from .scene_reference import SceneReference, push_undo

ATTEMPTS = 3


def bring_in(
    job: Job,
    scene: SceneReference,
    folder: Path,
    *,
    undo: str | None,
    match_render_size: bool = False,
    before_placing: Callable[[], None] = lambda: None,
) -> Work[Reconstruction]:
    """Read a reconstruction in a thread and put it into the scene, in its units; one undo step, named ``undo``.

    Where ``undo`` is None, the step is the caller's. The size of the scene's renders is the user's, unless
    ``match_render_size`` gives it that of the scan. Its originals in the scene are hidden.
    """

    def read() -> tuple[Reconstruction, MeshArrays]:
        reconstruction = reconstruction_in_units(read_reconstruction(folder), scene.metres_per_unit)
        return reconstruction, mesh_arrays(reconstruction.mesh)

    reconstruction, arrays = yield from job.in_thread(read)
    scene.find()  # nothing is made for a scene that is gone
    name = yield from _make_mesh(arrays)
    target = scene.find()
    before_placing()
    mesh = object_of(MESH_NAME, bpy.data.meshes[name])
    collection = place_reconstruction(target, reconstruction, mesh, match_render_size=match_render_size)
    if originals_of(target, folder):
        show_sides(target, collection, original=False, reconstruction=True)
    suit_shading(target)
    if undo is not None:
        push_undo(undo)
    return reconstruction


def _make_mesh(arrays: MeshArrays) -> Work[str]:
    """Make mesh data in pieces; an undo between two takes it away, and it is begun again."""
    for attempt in range(ATTEMPTS):
        try:
            name = ""
            for name in fill_mesh(MESH_NAME, arrays):  # noqa: B007 - the last one counts
                yield Pace.MORE
            bpy.data.meshes[name]
        except KeyError:
            if attempt == ATTEMPTS - 1:
                raise
        else:
            return name
    raise AssertionError("the last attempt returns or raises")
