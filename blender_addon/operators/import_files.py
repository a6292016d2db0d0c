"""File > Import, and files dropped onto the viewport: reconstructions, datasets, meshes with vertex colours."""

# mypy: disable-error-code="valid-type,misc"
from pathlib import Path
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..files.dataset_files import METADATA_FILE
from ..files.ply_mesh import read_colored_mesh
from ..files.reconstruction_files import MESH_FILE, RECONSTRUCTION_FILE
from ..jobs import runner
from ..jobs.job import Job, Work
from ..results.import_dataset import import_dataset
from ..results.import_reconstruction import import_reconstruction
from ..results.mesh_import import create_mesh_object
from ..results.originals import originals_of, show_sides
from ..results.viewport_colors import suit_shading
from ..steps.bring_in import bring_in
from ..steps.scene_reference import SceneReference, remember

LARGE_BYTES = 4_000_000
"""A mesh file from this size on is brought in piece by piece, where there is an interface to keep alive."""


class _FolderOperator:
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads it once

    directory: bpy.props.StringProperty(
        name="Folder",
        description="The folder that is imported",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    filepath: bpy.props.StringProperty(
        name="File",
        description="A file in the folder that is imported",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", "HIDDEN"},
    )
    # Blender gives what is dropped in this and the folder, and warns where an operator has but one of both.
    files: bpy.props.CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    match_render_size: bpy.props.BoolProperty(
        name="Match Render Size",
        description="Give renders the size and pixel aspect of the scan, so that the cameras show what the scan saw",
        default=True,
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: Any, event: Any) -> set[str]:  # noqa: ARG002
        """Ask for the folder, unless a file in it was dropped."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        """Import it."""
        given = self.directory or (str(Path(self.filepath).parent) if self.filepath else "")
        if not given:
            self.report({"ERROR"}, f"No folder chosen; {self.remedy}")  # type: ignore[attr-defined]
            return {"CANCELLED"}
        try:
            return self.bring(context, Path(bpy.path.abspath(given)))
        except ReconstructionError as error:
            self.report({"ERROR"}, str(error))  # type: ignore[attr-defined]
            return {"CANCELLED"}

    remedy = ""

    def bring(self, context: Any, folder: Path) -> set[str]:
        """Import ``folder``."""
        raise NotImplementedError


class SCANBACK_OT_import_reconstruction(_FolderOperator, bpy.types.Operator):  # noqa: N801 - Blender's naming
    """Asks for a folder and imports it."""

    bl_idname = "scanback.import_reconstruction"
    bl_label = "Import Scanback Reconstruction"
    bl_description = "Import a reconstruction folder: colored mesh, camera path and a camera for each located frame"
    remedy = "choose the one that 'fusion reconstruct' wrote"

    def bring(self, context: Any, folder: Path) -> set[str]:
        """Import it."""
        return _bring_reconstruction(self, context, folder)


class SCANBACK_OT_import_dataset(_FolderOperator, bpy.types.Operator):  # noqa: N801
    """Asks for a dataset's folder and imports its camera."""

    bl_idname = "scanback.import_dataset"
    bl_label = "Import Scanback Dataset"
    bl_description = "Import a dataset's camera path, and a camera that goes it again with the frames behind"
    remedy = "choose one that holds dataset.json"

    def bring(self, context: Any, folder: Path) -> set[str]:
        """Import its camera."""
        return _bring_dataset(self, context, folder)


class SCANBACK_OT_import_dropped(_FolderOperator, bpy.types.Operator):  # noqa: N801
    """Imports the folder that a dropped file stands for."""

    bl_idname = "scanback.import_dropped"
    bl_label = "Import Scanback Reconstruction or Dataset"
    bl_description = "Import what reconstruction.json or dataset.json stands for: the folder that it lies in"
    remedy = f"name {RECONSTRUCTION_FILE} or {METADATA_FILE}"

    def bring(self, context: Any, folder: Path) -> set[str]:
        """Import what the file's name says."""
        name = Path(self.filepath).name
        ways = {RECONSTRUCTION_FILE: _bring_reconstruction, METADATA_FILE: _bring_dataset}
        if name not in ways:
            raise ReconstructionError(f"{name or folder}: neither {' nor '.join(ways)}; drop one of these")
        return ways[name](self, context, folder)


class SCANBACK_OT_import_ply(bpy.types.Operator):  # noqa: N801
    """Asks for a mesh file and imports it with its colours."""

    bl_idname = "scanback.import_ply"
    bl_label = "Import PLY With Colors"
    bl_description = "Import a triangle mesh with a material that shows the colors of its vertices"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(
        name="File", description="A binary PLY file with a color at each vertex", subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})

    def invoke(self, context: Any, event: Any) -> set[str]:  # noqa: ARG002
        """Ask for the file, unless it was dropped."""
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        """Import it."""
        path = Path(bpy.path.abspath(self.filepath))
        try:
            item = create_mesh_object(path.stem, read_colored_mesh(path))
        except ReconstructionError as error:
            self.report({"ERROR"}, str(error).replace("write it again with 'fusion reconstruct'", "export it anew"))
            return {"CANCELLED"}
        context.collection.objects.link(item)
        context.view_layer.objects.active = item
        self.report({"INFO"}, f"Imported {len(item.data.vertices):,} vertices of {path.name}")
        return {"FINISHED"}


class _Dropped:
    """What can be dropped onto the viewport or the outliner."""

    @classmethod
    def poll_drop(cls, context: Any) -> bool:
        """Tell whether this is a place to drop it."""
        return context.area is not None and context.area.type in ("VIEW_3D", "OUTLINER")


class SCANBACK_FH_ply(_Dropped, bpy.types.FileHandler):  # noqa: N801
    """Takes mesh files that are dropped onto the viewport."""

    bl_idname = "SCANBACK_FH_ply"
    bl_label = "PLY With Colors (Scanback)"
    bl_import_operator = SCANBACK_OT_import_ply.bl_idname
    bl_file_extensions = ".ply"


class SCANBACK_FH_folder(_Dropped, bpy.types.FileHandler):  # noqa: N801
    """Takes reconstruction.json and dataset.json, which stand for their folders."""

    bl_idname = "SCANBACK_FH_folder"
    bl_label = "Scanback Reconstruction or Dataset (.json)"
    bl_import_operator = SCANBACK_OT_import_dropped.bl_idname
    bl_file_extensions = ".json"


def _bring_reconstruction(operator: Any, context: Any, folder: Path) -> set[str]:
    """Import a reconstruction, a large one piece by piece."""
    scene = context.scene
    if _is_large(folder / MESH_FILE) and not bpy.app.background and operator.options.is_invoke:
        runner.start("Import", _import_work(remember(scene), folder, operator.match_render_size))
        return {"INTERFACE"}  # no undo step yet: the job makes its own
    collection = import_reconstruction(scene, folder, match_render_size=operator.match_render_size)
    if originals_of(scene, folder):
        show_sides(scene, collection, original=False, reconstruction=True)
    suit_shading(scene)
    operator.report({"INFO"}, f"Imported {folder.name} into the collection {collection.name}")
    return {"FINISHED"}


def _bring_dataset(operator: Any, context: Any, folder: Path) -> set[str]:
    """Import a dataset's camera."""
    collection, frames = import_dataset(context.scene, folder, match_render_size=operator.match_render_size)
    count = len(frames.trajectory)
    operator.report({"INFO"}, f"Imported {count} poses of {folder.name} into the collection {collection.name}")
    return {"FINISHED"}


def _import_work(scene: SceneReference, folder: Path, match_render_size: bool) -> Any:
    def work(job: Job) -> Work[str]:
        made = yield from bring_in(
            job, scene, folder, undo="Import Scanback Reconstruction", match_render_size=match_render_size
        )
        return f"Imported {len(made.mesh.vertices_world):,} vertices of {made.name}"

    return work


def _is_large(path: Path) -> bool:
    try:
        return path.stat().st_size >= LARGE_BYTES
    except OSError:
        return False


def _draw_import_entries(menu: Any, context: Any) -> None:  # noqa: ARG001
    menu.layout.operator(SCANBACK_OT_import_reconstruction.bl_idname, text="Scanback Reconstruction")
    menu.layout.operator(SCANBACK_OT_import_dataset.bl_idname, text="Scanback Dataset")
    menu.layout.operator(SCANBACK_OT_import_ply.bl_idname, text="PLY With Colors (.ply)")


CLASSES = (
    SCANBACK_OT_import_reconstruction,
    SCANBACK_OT_import_dataset,
    SCANBACK_OT_import_dropped,
    SCANBACK_OT_import_ply,
    SCANBACK_FH_ply,
    SCANBACK_FH_folder,
)


def register() -> None:
    """Add the operators and the entries of File > Import."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_draw_import_entries)


def unregister() -> None:
    """Take them away."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_import_entries)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
