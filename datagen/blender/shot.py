"""A frame that Cycles has rendered, and what becomes of it: decoding, further layers, files.

Nothing here touches Blender, so that it runs in a thread while Blender renders the next frame.
"""

from dataclasses import dataclass
from pathlib import Path

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


def write_shot(folder: Path, shot: Shot, *, spec: Scene, camera: PinholeCamera) -> None:
    """Write a frame's files into the dataset ``folder``, the pose last; the shot's own files are deleted."""
    clip_end = spec.camera.clip_end
    rendered = read_frame(shot.image, world_from_camera=shot.world_from_camera, clip_end=clip_end)
    layers = _layers(shot, rendered, spec=spec, camera=camera)
    write_frame(
        folder / FRAMES_FOLDER,
        shot.frame,
        color=rendered.color,
        depth=rendered.depth,
        world_from_camera=rendered.world_from_camera,
        depth_scale=spec.render.depth_scale,
        layers=layers,
    )


def _layers(shot: Shot, rendered: RenderedFrame, *, spec: Scene, camera: PinholeCamera) -> dict[str, NDArray]:
    """Return the images of all layers that ``layers_of`` the scene names."""
    layers: dict[str, NDArray] = {}
    depth, pose = rendered.depth, shot.world_from_camera
    if shot.normals is not None:
        layers["normals"] = read_normals(shot.normals, depth=depth, world_from_camera=pose)
    if rendered.object_index is not None:
        layers["masks"] = rendered.object_index
    if "flow" in spec.render.layers:
        layers["flow"] = optical_flow(depth, camera, world_from_camera=pose, world_from_next=shot.world_from_next)
    if shot.right_image is not None:
        right = read_frame(shot.right_image, world_from_camera=pose, clip_end=spec.camera.clip_end)
        layers |= {"right_color": right.color, "right_depth": right.depth}
    return layers | extra_layers(spec, shot.frame, rendered.color, depth, camera)
