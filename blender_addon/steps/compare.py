"""The fourth step: how far the reconstruction is from what was scanned, vertex by vertex."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError
from ..files.ply_mesh import write_triangles
from ..files.reconstruction_files import MESH_FILE, read_record
from ..jobs.command import Command
from ..jobs.folder_claim import while_claimed
from ..jobs.job import Job, Work
from ..preferences import fusion_device
from ..results.error_colors import put_errors
from ..results.originals import note_originals, show_sides
from ..results.scene_collection import MESH_PART, find_collection, parts
from ..results.scene_units import length_text
from ..results.viewport_colors import suit_shading
from ..scan_folder import RECONSTRUCTION
from .bring_in import bring_in
from .evaluation import evaluated_as_shown
from .scene_reference import SceneReference, push_undo

NUMBERS = ("chamfer_m", "accuracy_m", "completeness_m", "fscore", "normal_consistency")


def compare_work(
    scene: SceneReference, folder: Path, *, truth: tuple[NDArray, NDArray] | None, limit: float, original: int = 0
) -> Callable[[Job], Work[str]]:
    """Return the job that compares the reconstruction of ``folder`` and colours its mesh in the scene.

    ``truth`` has vertices (N, 3) and triangles (M, 3); None takes the mesh that the dataset keeps. Its vertices and
    ``limit``, the distance that has the last colour, are in the scene's units; what is measured is in metres. The
    object whose session_uid is ``original`` is hidden, so that the colours can be seen.
    """

    def work(job: Job) -> Work[str]:
        out = folder / RECONSTRUCTION
        target = read_record(out).dataset
        if truth is not None:
            target = job.folder / "truth.ply"
            vertices, triangles = (truth[0] * scene.metres_per_unit).astype(np.float32), truth[1]
            yield from job.in_thread(lambda: write_triangles(target, vertices, triangles))
        errors = job.folder / "errors.npy"
        arguments = ["evaluate", str(out / MESH_FILE), str(target), "--vertex-errors", str(errors), "--json"]
        arguments += ["--device", fusion_device()]
        metrics = yield from job.run(
            Command(program="fusion", arguments=tuple(arguments), failure="They were not compared")
        )
        distances = yield from job.in_thread(lambda: np.load(errors))
        item = _mesh_in(scene, out)
        if item is None:
            yield from bring_in(job, scene, out, undo=None)
            item = _mesh_in(scene, out)
        assert item is not None, "a reconstruction that was brought in has a mesh"
        numbers = {name: float(metrics[name]) for name in NUMBERS}
        numbers["fscore_threshold_m"] = float(metrics["fscores"][0]["threshold_m"])
        put_errors(item, distances, limit_m=limit * scene.metres_per_unit, numbers=numbers)
        _show_mesh_alone(scene.find(), out, original)
        push_undo("Scanback: Compare")
        accuracy, completeness = (length_text(scene.find(), numbers[name]) for name in ("accuracy_m", "completeness_m"))
        return f"The mesh is {accuracy} from the original on average, the original {completeness} from the mesh"

    return while_claimed(folder, work)


def _show_mesh_alone(scene: bpy.types.Scene, out: Path, original: int) -> None:
    collection = find_collection(scene, out.resolve())
    assert collection is not None, "it holds the mesh"
    note_originals(scene, out.resolve(), [item for item in scene.objects if item.session_uid == original])
    show_sides(scene, collection, original=False, reconstruction=True)
    suit_shading(scene)


def triangles_of(item: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return an object as its modifiers make it, in the world: vertices (N, 3) and triangles (M, 3).

    Triangles are counter-clockwise from outside, also of an object whose scale turns it inside out. A hidden object is
    taken as if it were shown. Raises ReconstructionError for one that has no faces, or that the view layer excludes.
    """
    with evaluated_as_shown([item]) as depsgraph:
        shown = item.evaluated_get(depsgraph)
        if not shown.is_evaluated:
            raise ReconstructionError(f"{item.name} is excluded from the view layer; include its collection")
        vertices, corners = _triangles(shown)
        world_from_object = np.array(shown.matrix_world)
    if not len(corners):
        raise ReconstructionError(f"{item.name} has no faces; choose another object")
    placed = vertices @ world_from_object[:3, :3].T + world_from_object[:3, 3]
    is_mirrored = np.linalg.det(world_from_object[:3, :3]) < 0
    return placed.astype(np.float32), np.ascontiguousarray(corners[:, ::-1]) if is_mirrored else corners


def _triangles(shown: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the vertices (N, 3) of an evaluated object in its own frame, and its triangles (M, 3)."""
    try:
        mesh = shown.to_mesh()
    except RuntimeError as error:
        raise ReconstructionError(f"{shown.name} is no surface ({error}); choose a mesh") from error
    try:
        mesh.calc_loop_triangles()
        vertices = np.empty(3 * len(mesh.vertices), np.float32)
        triangles = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.vertices.foreach_get("co", vertices)
        mesh.loop_triangles.foreach_get("vertices", triangles)
    finally:
        shown.to_mesh_clear()
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3)


def _mesh_in(scene: SceneReference, out: Path) -> bpy.types.Object | None:
    collection = find_collection(scene.find(), out.resolve())
    meshes = parts(collection, MESH_PART) if collection is not None else []
    return meshes[0] if meshes else None


def compared_settings(settings: dict[str, Any], scene: bpy.types.Scene) -> tuple[NDArray, NDArray] | None:
    """Return the truth that the settings of ``CompareProperties`` name; None for the dataset's own."""
    if settings["truth"] == "DATASET":
        return None
    item = scene.objects.get(settings["object_name"])
    if item is None:
        name = settings["object_name"]
        raise ReconstructionError(
            f"The scene has no object {name}; choose another" if name else "No object is chosen to compare with"
        )
    return triangles_of(item)
