"""A reconstruction, presented: the .blend file, a render of all of it, and a comparison with a frame of the scan."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from blender_addon.files.reconstruction_files import Intrinsics, Reconstruction, read_reconstruction
from blender_addon.headless.comparison import Original, choose_original, write_side_by_side
from blender_addon.headless.overview_camera import FieldOfView, overview_pose, without_strays
from blender_addon.headless.quiet_stdout import quiet_stdout
from blender_addon.headless.render_still import render_png, set_up_presentation
from blender_addon.headless.save_blend import save_blend
from blender_addon.results.camera_conversion import blender_pose, set_intrinsics, set_render_size
from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.scan_camera import CLIP_END, CLIP_START
from blender_addon.results.scene_collection import MESH_PART, PART_KEY
from datagen.errors import InputError
from datagen.images import read_color
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix

FOCAL_LENGTH = 1.4
"""Of the overview, in longer sides of the picture: about 50 mm on small film."""


@dataclass(frozen=True, kw_only=True)
class PresentConfig:
    """What to read and what to write; ``preview_size`` is (width, height) in pixels.

    Without ``require_comparison`` the comparison is left out where the dataset cannot be read.
    """

    reconstruction: Path
    blend: Path
    preview: Path
    comparison: Path
    require_comparison: bool = False
    preview_size: tuple[int, int] = (1280, 720)
    samples: int = 16


@dataclass(frozen=True, kw_only=True)
class PresentReport:
    """The files that were written, and what the user should know about those that were not."""

    written: Sequence[Path]
    notes: Sequence[str]


def present(config: PresentConfig, *, progress: ProgressReporter = silent) -> PresentReport:
    """Write the .blend file and the pictures of a reconstruction folder; replaces the file that is open in Blender.

    Raises ReconstructionError and InputError, with nothing written, for input that cannot be used.
    """
    advance = progress("Blender", 4)
    reconstruction = read_reconstruction(config.reconstruction)
    original, notes = _original(reconstruction, required=config.require_comparison)
    with quiet_stdout():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        set_up_presentation(scene, samples=config.samples)
        collection = import_reconstruction(scene, config.reconstruction)
        overview = _overview_camera(scene, collection, reconstruction, size=config.preview_size)
        advance()
        save_blend(config.blend)
        advance()
        _render_preview(scene, overview, config.preview, size=config.preview_size)
        advance()
        written = [config.blend, config.preview]
        if original is not None:
            _compare(scene, collection, reconstruction.intrinsics, original, config.comparison)
            written.append(config.comparison)
        advance()
    return PresentReport(written=written, notes=notes)


def _original(reconstruction: Reconstruction, *, required: bool) -> tuple[Original | None, list[str]]:
    try:
        return choose_original(reconstruction), []
    except InputError as error:
        if required:
            raise
        return None, [f"no comparison with the scan: {error}"]


def _square_pixels(size: tuple[int, int]) -> Intrinsics:
    """Return the overview's camera for a picture of ``size``, its focal length measured on the longer side."""
    width, height = size
    focal_px = FOCAL_LENGTH * max(size)
    return Intrinsics(width=width, height=height, fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2)


def _overview_camera(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    reconstruction: Reconstruction,
    *,
    size: tuple[int, int],
) -> bpy.types.Object:
    """Return a new camera, the scene's, that frames the mesh, the camera path and the markers."""
    wires = [_wire_points(item) for item in collection.all_objects if item.type == "CURVE"]
    points_world = np.concatenate([without_strays(reconstruction.mesh.vertices_world), *wires])
    camera = _square_pixels(size)
    pose = overview_pose(
        points_world,
        [frame.world_from_camera for frame in reconstruction.trajectory],
        field_of_view=FieldOfView(camera.width / 2 / camera.fx, camera.height / 2 / camera.fy),
    )
    scene.camera = _add_camera(scene, "Overview", camera, pose)
    return scene.camera


def _wire_points(item: bpy.types.Object) -> NDArray[np.float64]:
    """Return the points (N, 3) of a curve object in the world frame."""
    # Blender updates the world matrices of children only with the view layer.
    bpy.context.view_layer.update()
    points = np.array([point.co for spline in item.data.splines for point in spline.points])
    return (points @ np.array(item.matrix_world).T)[:, :3]


def _add_camera(scene: bpy.types.Scene, name: str, intrinsics: Intrinsics, pose: Matrix) -> bpy.types.Object:
    data = bpy.data.cameras.new(name)
    set_intrinsics(data, intrinsics)
    data.clip_start, data.clip_end = CLIP_START, CLIP_END
    camera = bpy.data.objects.new(name, data)
    camera.matrix_world = blender_pose(pose)
    scene.collection.objects.link(camera)
    return camera


def _render_preview(scene: bpy.types.Scene, camera: bpy.types.Object, path: Path, *, size: tuple[int, int]) -> None:
    set_render_size(scene.render, _square_pixels(size))
    render_png(scene, camera, path)


def _compare(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    intrinsics: Intrinsics,
    original: Original,
    path: Path,
) -> None:
    """Render the mesh alone from the original's place and write both side by side."""
    for item in list(collection.all_objects):  # hiding rebuilds what is iterated over
        item.hide_render = item[PART_KEY] != MESH_PART
    camera = _add_camera(scene, "Comparison", intrinsics, original.world_from_camera)
    set_render_size(scene.render, intrinsics)
    with tempfile.TemporaryDirectory() as folder:
        rendered = Path(folder) / "rendered.png"
        render_png(scene, camera, rendered)
        color = read_color(rendered, size=(intrinsics.width, intrinsics.height))
    write_side_by_side(path, original=original, rendered=color)
