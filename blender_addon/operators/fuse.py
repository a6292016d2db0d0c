"""Fuse: frames into a coloured mesh; and how large that will be."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..results.scene_units import length_text
from ..scan_folder import scan_folder, settle_folder
from ..settings import FolderProperties, FuseProperties, chosen
from ..steps.estimate import estimate_work
from ..steps.fuse import fuse_work
from ..steps.fuse_source import dataset_of
from ..steps.scene_reference import remember
from .job_operator import JobOperator, WorkMaker


class SCANBACK_OT_fuse(JobOperator, FolderProperties, FuseProperties, bpy.types.Operator):  # noqa: N801
    """Fuses a dataset."""

    bl_idname = "scanback.fuse"
    bl_label = "Fuse"
    bl_description = "Fuse the frames into a colored mesh, and bring mesh, camera path and cameras into the scene"
    title = "Fuse"

    def prepare(self, context: Any) -> WorkMaker:
        """Find the dataset."""
        scene = context.scene
        folder = scan_folder(scene, self.folder)
        settings = chosen(self, scene.scanback.fuse, FuseProperties)
        # A folder that was named holds its own dataset, whatever the panel has.
        named = self.dataset or ("" if self.folder else scene.scanback.fuse.dataset)
        dataset = dataset_of(scene, folder, named or str(folder / "dataset"))
        if not dataset.is_dir():
            raise ReconstructionError(f"{dataset}: no such folder; scan first, or choose the folder of a dataset")
        return fuse_work(remember(scene), settle_folder(scene, self.folder), dataset, settings)


class SCANBACK_OT_estimate(JobOperator, FolderProperties, bpy.types.Operator):  # noqa: N801
    """Estimates the size of a reconstruction."""

    bl_idname = "scanback.estimate"
    bl_label = "Estimate Size"
    bl_description = "Look at some frames to tell how many triangles and how much memory a voxel size makes"
    title = "Estimate"

    def prepare(self, context: Any) -> WorkMaker:
        """Find the dataset."""
        scene = context.scene
        dataset = dataset_of(scene, scan_folder(scene, self.folder))
        reference = remember(scene)
        return estimate_work(dataset, in_words=lambda metres: length_text(reference.find(), metres))


CLASSES = (SCANBACK_OT_fuse, SCANBACK_OT_estimate)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
