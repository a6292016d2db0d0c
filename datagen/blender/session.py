"""A scene made in Blender, ready to render its frames one by one."""

from pathlib import Path
from typing import Any

import bpy

from datagen.blender.camera import add_camera, read_intrinsics
from datagen.blender.device import select_device
from datagen.blender.ground_truth import evaluated_mesh, write_ply
from datagen.blender.render import configure_render, render_frame
from datagen.blender.scene import build_scene
from datagen.blender.trajectory import animate_camera
from datagen.dataset_format import FRAMES_FOLDER, GROUND_TRUTH_FILE
from datagen.dataset_writer import write_frame
from datagen.scene_spec.scene import Scene


class RenderSession:
    """Blender with one scene in it, and the folder in memory through which its images come."""

    def __init__(self, spec: Scene, *, device: str, threads: int, scratch: Path) -> None:
        """Make the scene. ``threads`` 0 lets Cycles use all cores. Raises InputError for a device that is not there."""
        self.spec = spec
        self.scene = build_scene(spec)
        self.scratch = scratch
        animate_camera(add_camera(self.scene, spec.camera), spec.keyframes, frames=spec.render.frames)
        configure_render(self.scene, spec.render, threads=threads)
        self.device = select_device(self.scene, device)
        self.scene.frame_set(0)

    def description(self) -> dict[str, Any]:
        """Return what the dataset's metadata needs to know from Blender, ready for JSON."""
        camera = read_intrinsics(self.scene)
        return {
            "intrinsics": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
            "provenance": {
                "blender": bpy.app.version_string,
                "blender_build": bpy.app.build_hash.decode(),
                "device": self.device.type,
                "device_name": self.device.name,
            },
        }

    def write_frame(self, folder: Path, frame: int) -> None:
        """Render a frame and write its files into the dataset ``folder``."""
        rendered = render_frame(self.scene, frame, seed=self.spec.render.seed, scratch=self.scratch)
        write_frame(
            folder / FRAMES_FOLDER,
            frame,
            color=rendered.color,
            depth=rendered.depth,
            world_from_camera=rendered.world_from_camera,
            depth_scale=self.spec.render.depth_scale,
        )

    def write_ground_truth(self, folder: Path) -> None:
        """Write the mesh of the whole scene into the dataset ``folder``."""
        write_ply(folder / GROUND_TRUTH_FILE, evaluated_mesh())
