"""A scene made in Blender, ready to render its frames one by one."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from datagen.blender.camera import add_camera, add_right_camera, read_intrinsics, read_pose
from datagen.blender.device import select_device
from datagen.blender.geometry_pass import add_geometry_scene, render_normals_exr
from datagen.blender.ground_truth import evaluated_mesh, write_ply
from datagen.blender.path_check import check_path
from datagen.blender.render import configure_render, frame_seed, render_exr
from datagen.blender.scene import build_scene
from datagen.blender.shot import Shot, write_shot
from datagen.blender.trajectory import animate_camera, find_blend_camera
from datagen.camera import PinholeCamera
from datagen.dataset_format import GROUND_TRUTH_FILE
from datagen.errors import InputError
from datagen.rigid import Matrix
from datagen.scene_spec.scene import Scene
from datagen.thin_triangles import find_thin_triangles
from datagen.trajectory.camera_path import way_between_frames
from datagen.trajectory.speed_limits import require_within_limits


class RenderSession:
    """Blender with one scene in it, and the folder in memory through which its images come."""

    def __init__(self, spec: Scene, *, device: str, threads: int, scratch: Path, require_gpu: bool = False) -> None:
        """Make the scene. ``threads`` 0 lets Cycles use all cores. Raises InputError for a device that is not there."""
        self.spec = spec
        self.scene = build_scene(spec)
        self.scratch = scratch
        blend_camera = find_blend_camera(self.scene)
        configure_render(self.scene, spec.render, threads=threads)
        self.path = animate_camera(
            add_camera(self.scene, spec.camera),
            spec.camera_motion,
            frames=spec.render.frames,
            frames_per_second=spec.render.frames_per_second,
            seed=spec.render.seed,
            blend_camera=blend_camera,
        )
        self.device = select_device(self.scene, device, require_gpu=require_gpu)
        self.camera = _settled_intrinsics(self.scene, spec.camera.pinhole(spec.render.size))
        wanted, baseline = spec.render.layers, spec.camera.stereo_baseline
        self._right_camera = add_right_camera(self.scene, baseline) if baseline is not None else None
        self._geometry = add_geometry_scene(self.scene, spec.render, threads=threads) if "normals" in wanted else None
        moving = self._moving_objects()
        if moving and "flow" in wanted:
            raise InputError(
                f"[render] layers: flow is that of a scene in which only the camera moves, but {', '.join(moving[:3])} "
                "moves too; leave flow out"
            )
        mesh = evaluated_mesh()
        thin = find_thin_triangles(mesh.vertices_world, mesh.triangles)
        self._thin_triangles = thin[:0] if moving else thin
        self.scene.frame_set(0)

    def check_path(self) -> None:
        """Raise InputError naming the frames in which the camera is too fast, in an object, or loses its subject."""
        motion, render, camera = self.spec.camera_motion, self.spec.render, self.spec.camera
        require_within_limits(motion, self.path, frames_per_second=render.frames_per_second, seed=render.seed)
        if motion.check:
            way = way_between_frames(motion, render.frames, render.frames_per_second, render.seed)
            names = [settings.name for settings in self.spec.objects]
            clip_range = (camera.clip_start, camera.clip_end)
            check_path(self.path, way, motion, self.camera, clip_range=clip_range, names=names)

    def description(self) -> dict[str, Any]:
        """Return what the dataset's metadata needs to know from Blender, ready for JSON."""
        return {
            "intrinsics": {name: getattr(self.camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
            "provenance": {
                "blender": bpy.app.version_string,
                "blender_build": bpy.app.build_hash.decode(),
                "device": self.device.type,
                "device_name": self.device.name,
            },
        }

    def write_frame(self, folder: Path, frame: int) -> None:
        """Render a frame and write its files into the dataset ``folder``."""
        self.write(folder, self.render(frame))

    def render(self, frame: int) -> Shot:
        """Render all that a frame's files are made of, in the scratch folder."""
        seed, wanted = self.spec.render.seed, self.spec.render.layers
        image, normals, right = (self.scratch / f"{name}-{frame}.exr" for name in ("image", "normals", "right"))
        has_next = "flow" in wanted and frame + 1 < self.spec.render.frames
        world_from_next = self._pose(frame + 1) if has_next else None
        render_exr(self.scene, frame, seed=frame_seed(seed, frame), exr=image)
        world_from_camera = read_pose(self.scene)
        if self._right_camera is not None:
            left, self.scene.camera = self.scene.camera, self._right_camera
            render_exr(self.scene, frame, seed=frame_seed(seed, frame, 1), exr=right)
            self.scene.camera = left
        if self._geometry is not None:
            render_normals_exr(self._geometry, frame, exr=normals)
        return Shot(
            frame=frame,
            image=image,
            normals=normals if self._geometry is not None else None,
            right_image=right if self._right_camera is not None else None,
            world_from_camera=world_from_camera,
            world_from_next=world_from_next,
        )

    def write(self, folder: Path, shot: Shot) -> None:
        """Write the files of a rendered frame into the dataset ``folder``; may run beside ``render`` in a thread."""
        write_shot(folder, shot, spec=self.spec, camera=self.camera, thin_triangles=self._thin_triangles)

    def write_ground_truth(self, folder: Path) -> None:
        """Write the mesh of the whole scene into the dataset ``folder``."""
        unit = self.spec.render.metres_per_unit
        write_ply(folder / GROUND_TRUTH_FILE, evaluated_mesh(), metres_per_unit=unit)

    def _pose(self, frame: int) -> Matrix:
        self.scene.frame_set(frame)
        return read_pose(self.scene)

    def _moving_objects(self) -> list[str]:
        """Return the names of visible objects that are not where they were, at the first, middle or last frame."""
        last = self.spec.render.frames - 1
        first, *later = [self._placed_objects(frame) for frame in sorted({0, last // 2, last})]
        return sorted(name for name in first if any(not _same(first, other, name) for other in later))

    def _placed_objects(self, frame: int) -> dict[str, Any]:
        self.scene.frame_set(frame)
        instances = bpy.context.evaluated_depsgraph_get().object_instances
        shapes = ("MESH", "CURVE", "SURFACE", "FONT", "META")
        return {i.object.name: np.array(i.matrix_world) for i in instances if i.object.type in shapes}


def _same(placed: dict[str, Any], later: dict[str, Any], name: str) -> bool:
    return name in later and np.array_equal(placed[name], later[name])


def _settled_intrinsics(scene: bpy.types.Scene, declared: PinholeCamera) -> PinholeCamera:
    """Return the declared intrinsics, which Blender's own, in single precision, must agree with."""
    found = read_intrinsics(scene)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        there, wanted = getattr(found, name), getattr(declared, name)
        if abs(there - wanted) > 1e-6 * max(declared.fx, declared.fy, abs(wanted), declared.width, declared.height):
            raise RuntimeError(f"Blender's camera has {name} {there}, declared is {wanted}")
    return declared
