"""Pictures of a reconstruction, ray-cast from its volume: colour, depth and normals."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import require_writable, write_json
from datagen.camera import PinholeCamera
from datagen.dataset import POSE_PART
from datagen.errors import InputError
from datagen.images import DEPTH_INVALID_MAX, write_color, write_depth
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix, rigid
from fusion.devices import load_kernels, resolve_device
from fusion.reconstruction_files import RECORD_FILE, VOLUME_FILE, ReconstructionRecord, read_record
from fusion.surface.ray_casting import cast_rays
from fusion.volume.volume_file import load_volume

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.surface.cells",
    "fusion.surface.surface_cells",
    "fusion.surface.ray_casting",
)
COLOR_FILE, DEPTH_FILE, NORMALS_FILE, VIEW_FILE = "color.png", "depth.png", "normals.png", "view.json"
LARGEST_SIDE = 8192
DEPTH_SCALES = (0.0001, 0.001, 0.01, 0.1)
"""Metres a step of the depth image: the finest that the view's depth fits is taken."""


def render(
    folder: Path,
    out: Path,
    *,
    frame: int | None = None,
    world_from_camera: Matrix | None = None,
    size: tuple[int, int] | None = None,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> dict[str, Any]:
    """Write what the reconstruction in ``folder`` looks like from a frame's pose or another one; returns ``view.json``.

    Into ``out`` go ``color.png``, ``depth.png``, ``normals.png`` and last ``view.json``, which says what their numbers
    mean. The camera is that of the fused frames, for images of ``size`` (width, height) if given. Raises InputError for
    a frame without a pose, and for files that cannot be used.
    """
    record = read_record(folder)
    pose = _pose_of(folder, record, frame) if world_from_camera is None else world_from_camera
    camera = PinholeCamera(**record.camera.model_dump())
    if size is not None:
        if max(size) > LARGEST_SIDE:
            raise InputError(f"--size {size[0]}x{size[1]}: expected at most {LARGEST_SIDE} pixels a side")
        camera = resized(camera, size)
    require_writable(out)
    target = resolve_device(device)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    seen = cast_rays(load_volume(folder / VOLUME_FILE, device=target), camera, pose)
    farthest = float(seen.depth.max())
    depth_scale = next(
        (scale for scale in DEPTH_SCALES if farthest < scale * (DEPTH_INVALID_MAX - 1)), DEPTH_SCALES[-1]
    )
    view = {
        "intrinsics": asdict(camera),
        "world_from_camera": pose.tolist(),
        "depth_scale": depth_scale,
        "normals": "world frame; x, y, z in red, green, blue as 127.5 (n + 1); 0 0 0 where there is no surface",
        "coverage": float((seen.depth > 0).mean()),
    }
    (out / VIEW_FILE).unlink(missing_ok=True)
    write_color(out / COLOR_FILE, seen.color)
    write_depth(out / DEPTH_FILE, seen.depth, metres_per_step=depth_scale)
    write_color(out / NORMALS_FILE, normals_as_color(seen.normals))
    write_json(out / VIEW_FILE, view)
    return view


def normals_as_color(normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return unit normals (…, 3) as RGB, 127.5 (n + 1); black where the normal is 0."""
    encoded = np.rint(127.5 * (normals + 1)).clip(0, 255)
    return np.where((normals == 0).all(axis=-1, keepdims=True), 0, encoded).astype(np.uint8)


def resized(camera: PinholeCamera, size: tuple[int, int]) -> PinholeCamera:
    """Return the camera of the same view in ``size`` (width, height) pixels: the image's edges stay in place."""
    x, y = size[0] / camera.width, size[1] / camera.height
    return PinholeCamera(
        width=size[0],
        height=size[1],
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=(camera.cx + 0.5) * x - 0.5,
        cy=(camera.cy + 0.5) * y - 0.5,
    )


def _pose_of(folder: Path, record: ReconstructionRecord, frame: int | None) -> Matrix:
    """Return the pose of a frame that was fused, or of another one of the dataset."""
    if frame is None:
        raise InputError("a view needs a frame or a pose; give --frame or --pose")
    for fused in record.trajectory:
        if fused.frame == frame:
            return rigid(fused.world_from_camera, source=f"{folder / RECORD_FILE}: trajectory: frame {frame}")
    source = (folder / record.dataset).resolve()
    if not source.is_dir():
        raise InputError(f"--frame {frame}: not fused, and its dataset {source} is not there; give one that was fused")
    dataset = open_dataset(source)
    if frame not in dataset.frame_ids:
        raise InputError(f"--frame {frame}: {source} has no such frame; its frames are {_span(dataset.frame_ids)}")
    dataset.require((frame,), (POSE_PART,))
    return dataset.world_from_camera(frame)


def _span(frame_ids: tuple[int, ...]) -> str:
    return f"{frame_ids[0]} to {frame_ids[-1]}, {len(frame_ids)} of them"
