"""A frame that Cycles has rendered, and what becomes of it: decoding, further layers, files.

Blender's units become metres here, once: what is rendered is in the scene's units, what is written is in metres.
Nothing here touches Blender, so that it runs in a thread while Blender renders the next frame.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.blender.geometry_pass import read_normals
from datagen.blender.render import RenderedFrame, read_frame
from datagen.camera import PinholeCamera
from datagen.dataset_format import FRAMES_FOLDER
from datagen.dataset_writer import write_frame
from datagen.optical_flow import optical_flow
from datagen.rigid import Matrix
from datagen.scene_spec.scene import Scene
from datagen.sensors.extra_layers import extra_layers
from datagen.thin_triangles import refine_depth


@dataclass(frozen=True, kw_only=True)
class Shot:
    """The EXR files of one frame, those of the layers None where they are not wanted, and its poses.

    ``world_from_next`` is the pose of the next frame, None for the last one and where no flow is wanted.
    """

    frame: int
    image: Path
    normals: Path | None
    right_image: Path | None
    world_from_camera: Matrix
    world_from_next: Matrix | None


def write_shot(
    folder: Path, shot: Shot, *, spec: Scene, camera: PinholeCamera, thin_triangles: NDArray[np.float64]
) -> None:
    """Write a frame's files into the dataset ``folder``, the pose last; the shot's own files are deleted.

    ``thin_triangles`` (K, 3, 3) are those whose depth single precision cannot hold, in the scene's units.
    """
    unit = spec.render.metres_per_unit
    rendered = _read_exact(shot.image, shot.world_from_camera, spec, camera, thin_triangles)
    layers = _layers(shot, rendered, spec=spec, camera=camera)
    if shot.right_image is not None:
        assert spec.camera.stereo_baseline is not None
        left_from_right = np.eye(4)
        left_from_right[0, 3] = spec.camera.stereo_baseline
        world_from_right = shot.world_from_camera @ left_from_right
        right = _read_exact(shot.right_image, world_from_right, spec, camera, thin_triangles)
        layers |= {"right_color": right.color, "right_depth": _in_metres(right.depth, unit)}
    write_frame(
        folder / FRAMES_FOLDER,
        shot.frame,
        color=rendered.color,
        depth=_in_metres(rendered.depth, unit),
        world_from_camera=_pose_in_metres(rendered.world_from_camera, unit),
        depth_scale=spec.render.depth_scale,
        layers=layers,
    )


def _in_metres(lengths: NDArray[np.float32], metres_per_unit: float) -> NDArray[np.float32]:
    return lengths if metres_per_unit == 1 else (lengths.astype(np.float64) * metres_per_unit).astype(np.float32)


def _pose_in_metres(world_from_camera: Matrix, metres_per_unit: float) -> Matrix:
    pose = world_from_camera.copy()
    pose[:3, 3] *= metres_per_unit
    return pose


def _read_exact(
    exr: Path, world_from_camera: Matrix, spec: Scene, camera: PinholeCamera, thin_triangles: NDArray[np.float64]
) -> RenderedFrame:
    rendered = read_frame(exr, world_from_camera=world_from_camera, clip_end=spec.camera.clip_end)
    if not len(thin_triangles):
        return rendered
    depth = refine_depth(rendered.depth, camera, world_from_camera=world_from_camera, corners_world=thin_triangles)
    return replace(rendered, depth=depth)


def _layers(shot: Shot, rendered: RenderedFrame, *, spec: Scene, camera: PinholeCamera) -> dict[str, NDArray]:
    """Return the images of all layers that ``layers_of`` the scene names, but for the right camera's."""
    layers: dict[str, NDArray] = {}
    depth, pose = rendered.depth, shot.world_from_camera
    if shot.normals is not None:
        layers["normals"] = read_normals(shot.normals, depth=depth, world_from_camera=pose)
    if rendered.object_index is not None:
        layers["masks"] = rendered.object_index
    if "flow" in spec.render.layers:
        layers["flow"] = optical_flow(depth, camera, world_from_camera=pose, world_from_next=shot.world_from_next)
    metres = _in_metres(depth, spec.render.metres_per_unit)
    return layers | extra_layers(spec, shot.frame, rendered.color, metres, camera)
