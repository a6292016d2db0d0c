"""One Cycles render call for a frame's colours and its depth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from datagen.blender.camera import FILTER_WIDTH_PX, read_pose
from datagen.blender_program import runs_in_application
from datagen.color import srgb8_from_linear
from datagen.errors import InputError
from datagen.rigid import Matrix
from datagen.scene_spec.render_settings import RenderSettings

if runs_in_application():
    from datagen.blender.exr_process import read_file
else:
    from datagen.blender.exr_reader import read_file


@dataclass(frozen=True, kw_only=True)
class RenderedFrame:
    """``color`` (H, W, 3) uint8 sRGB; ``depth`` (H, W) float32 planar metres, 0 = nothing there; world_from_camera.

    ``object_index`` (H, W) uint16, where asked for: the pass index of the object at the pixel's centre, 0 = none.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    world_from_camera: Matrix
    object_index: NDArray[np.uint16] | None = None


def configure_render(scene: bpy.types.Scene, settings: RenderSettings, *, threads: int = 0) -> None:
    """Set Cycles up for ``settings``.

    Motion blur stays off, as it would spoil depth, and so does the compositor. Persistent data keeps the scene's
    acceleration structure from frame to frame. ``threads`` 0 takes all cores. Raises InputError where Blender was built
    without the denoiser that ``settings`` ask for.
    """
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = settings.size
    render.resolution_percentage = 100
    render.fps = max(1, round(settings.frames_per_second))
    render.fps_base = render.fps / settings.frames_per_second
    render.use_motion_blur = render.use_border = render.use_multiview = False
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
    cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    cycles.filter_width = FILTER_WIDTH_PX
    # It pays from about ten lamps on; with few it costs a quarter of the time.
    cycles.use_light_tree = False
    cycles.use_animated_seed = False
    cycles.use_denoising = settings.denoise
    if settings.denoise:
        _configure_denoiser(cycles, guided=settings.denoise_guided)
    first, *others = scene.view_layers
    first.use = first.use_pass_z = True
    first.use_pass_object_index = "masks" in settings.layers
    for other in others:
        other.use = False
    _configure_exr(render.image_settings)


def render_frame(scene: bpy.types.Scene, frame: int, *, seed: int, scratch: Path) -> RenderedFrame:
    """Render one frame through a temporary EXR file in ``scratch``, best a folder in memory."""
    exr = scratch / "frame.exr"
    render_exr(scene, frame, seed=frame_seed(seed, frame), exr=exr)
    return read_frame(exr, world_from_camera=read_pose(scene), clip_end=scene.camera.data.clip_end)


def render_exr(scene: bpy.types.Scene, frame: int, *, seed: int, exr: Path) -> None:
    """Render one frame of ``scene`` with Cycles' sampling ``seed`` into a multilayer EXR file.

    Raises RuntimeError where Blender leaves no file: it says why on standard error only.
    """
    scene.frame_set(frame)
    scene.cycles.seed = seed
    scene.render.filepath = str(exr)
    bpy.ops.render.render(write_still=True, scene=scene.name)
    if not exr.is_file():
        raise RuntimeError(f"Blender rendered frame {frame} but left no image of it")


def read_frame(exr: Path, *, world_from_camera: Matrix, clip_end: float) -> RenderedFrame:
    """Return the images of a rendered EXR file, which is deleted. Safe in a thread: it does not touch Blender.

    Cycles' Z pass is planar depth of the surface at the pixel's centre (as ``datagen.blender.camera`` sees to), from
    the first sample whatever their number, so that it is exact beside denoised colours; so is the object index.
    """
    channels = read_channels(exr)
    linear = np.stack([pass_channel(channels, f"Combined.{band}") for band in "RGB"], axis=-1)
    depth = pass_channel(channels, "Depth.")
    # Where no surface is, Cycles leaves 1e10.
    depth = np.where(depth < clip_end * 1.001, depth, np.float32(0))
    index = pass_channel(channels, "Object Index.", "IndexOB.") if any("Index" in name for name in channels) else None
    return RenderedFrame(
        color=srgb8_from_linear(linear),
        depth=depth,
        world_from_camera=world_from_camera,
        object_index=None if index is None else index.astype(np.uint16),
    )


def frame_seed(seed: int, frame: int, *more: int) -> int:
    """Return Cycles' sampling seed for a frame: its own, and the same in whatever order frames are rendered.

    ``more`` numbers tell apart what is rendered for one frame beside the first image.
    """
    return int(np.random.SeedSequence([seed, frame, *more]).generate_state(1)[0] >> 1)


def _configure_denoiser(cycles: Any, *, guided: bool) -> None:
    try:
        cycles.denoiser = "OPENIMAGEDENOISE"
    except TypeError:
        raise InputError(
            "[render] denoise: this Blender was built without OpenImageDenoise; switch denoise off, or choose the "
            "preset draft"
        ) from None
    cycles.denoising_quality = "FAST"
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL" if guided else "RGB"
    cycles.denoising_prefilter = "FAST" if guided else "NONE"


def _configure_exr(image: bpy.types.ImageFormatSettings) -> None:
    if hasattr(image, "media_type"):  # Blender 5.0 and later: it decides which file formats may be set
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    image.exr_codec = "NONE"
    if hasattr(image, "use_exr_interleave"):
        image.use_exr_interleave = True


def read_channels(exr: Path) -> dict[str, NDArray[np.float32]]:
    """Return all channels of a multilayer EXR file, (H, W) each, and delete it."""
    channels = read_file(exr)
    exr.unlink()
    return channels


def pass_channel(channels: dict[str, NDArray[np.float32]], *names: str) -> NDArray[np.float32]:
    """Return the channel of one of ``names``: Blender renamed some passes."""
    matching = [channels[key] for key in channels if any(f".{name}" in f".{key}" for name in names)]
    if len(matching) != 1:
        raise RuntimeError(f"Blender's EXR has the channels {sorted(channels)}, expected one {names[0]}")
    return matching[0]
