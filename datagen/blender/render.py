"""One Cycles render call for a frame's colours and its depth."""

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datagen.blender.camera import read_pose
from datagen.color import srgb8_from_linear
from datagen.rigid import Matrix
from datagen.scene_spec.render_settings import RenderSettings


@dataclass(frozen=True, kw_only=True)
class RenderedFrame:
    """``color`` (H, W, 3) uint8 sRGB; ``depth`` (H, W) float32 planar metres, 0 = nothing there; world_from_camera."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    world_from_camera: Matrix


def configure_render(scene: bpy.types.Scene, settings: RenderSettings, *, threads: int = 0) -> None:
    """Set Cycles up for ``settings``.

    Motion blur stays off, as it would spoil depth, and so does the compositor. Persistent data keeps the scene's
    acceleration structure from frame to frame. ``threads`` 0 takes all cores.
    """
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = settings.size
    render.resolution_percentage = 100
    render.fps = max(1, round(settings.frames_per_second))
    render.fps_base = render.fps / settings.frames_per_second
    render.use_motion_blur = False
    render.use_compositing = render.use_sequencer = False
    render.use_persistent_data = True
    render.threads_mode = "FIXED" if threads else "AUTO"
    if threads:
        render.threads = threads
    scene.frame_start, scene.frame_end = 0, settings.frames - 1
    cycles = scene.cycles
    cycles.samples = settings.samples
    cycles.max_bounces = settings.bounces
    cycles.use_adaptive_sampling = False
    # It pays from about ten lamps on; with few it costs a quarter of the time.
    cycles.use_light_tree = False
    cycles.use_animated_seed = False
    cycles.use_denoising = settings.denoise
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_quality = cycles.denoising_prefilter = "FAST"
    scene.view_layers[0].use_pass_z = True
    _configure_exr(render.image_settings)


def render_frame(scene: bpy.types.Scene, frame: int, *, seed: int, scratch: Path) -> RenderedFrame:
    """Render one frame through a temporary EXR file in ``scratch``, best a folder in memory.

    Cycles' Z pass is planar depth of the surface at the pixel's centre, from the first sample whatever their number,
    so that it is exact beside denoised colours.
    """
    scene.frame_set(frame)
    scene.cycles.seed = frame_seed(seed, frame)
    exr = scratch / "frame.exr"
    scene.render.filepath = str(exr)
    bpy.ops.render.render(write_still=True)
    channels = _read_exr(exr)
    exr.unlink()
    linear = np.stack([_pass(channels, f"Combined.{band}") for band in "RGB"], axis=-1)
    depth = _pass(channels, "Depth.")
    # Where no surface is, Cycles leaves 1e10.
    depth = np.where(depth < scene.camera.data.clip_end * 1.001, depth, np.float32(0))
    return RenderedFrame(color=srgb8_from_linear(linear), depth=depth, world_from_camera=read_pose(scene))


def frame_seed(seed: int, frame: int) -> int:
    """Return Cycles' sampling seed for a frame: its own, and the same in whatever order frames are rendered."""
    return int(np.random.SeedSequence([seed, frame]).generate_state(1)[0] >> 1)


def _configure_exr(image: bpy.types.ImageFormatSettings) -> None:
    if hasattr(image, "media_type"):  # Blender 5.0 and later: it decides which file formats may be set
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    image.exr_codec = "NONE"
    if hasattr(image, "use_exr_interleave"):
        image.use_exr_interleave = True


def _read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """Return all channels of a multilayer EXR, (H, W) each; Blender 4.5 writes one part, 5.0 may write several."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for part in file.parts for name, channel in part.channels.items()}


def _pass(channels: dict[str, NDArray[np.float32]], name: str) -> NDArray[np.float32]:
    matching = [channels[key] for key in channels if f".{name}" in f".{key}"]
    if len(matching) != 1:
        raise RuntimeError(f"Blender's EXR has the channels {sorted(channels)}, expected one {name}")
    return matching[0]
