"""nerfstudio's ``transforms.json``: poses with OpenGL camera axes, pixel centres at +0.5.

``transform_matrix`` is world_from_camera for camera axes x right, y up, z backward; ``depth_file_path`` names 16-bit
images. nerfstudio takes metres a step of these as an option, by default 0.001; the key ``depth_unit_scale_factor``
records it in the file.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from datagen.atomic_write import write_bytes
from datagen.camera import PinholeCamera
from datagen.dataset import Dataset, FrameRecord
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat
from datagen.formats.frame_numbers import frame_numbers, natural_order
from datagen.formats.json_file import depth_scale, numbers, read_json_object
from datagen.images import image_size
from datagen.rigid import rigid

TRANSFORMS_FILE = "transforms.json"
CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes of OpenCV from those of OpenGL; its own inverse."""
DEFAULT_METRES_PER_STEP = 0.001
SCALE_KEY = "depth_unit_scale_factor"
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
INTRINSIC_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_model", *DISTORTION_KEYS)


def detect(folder: Path) -> bool:
    """Tell whether a folder holds nerfstudio's file of poses."""
    return (folder / TRANSFORMS_FILE).is_file()


def open_nerfstudio(folder: Path) -> Dataset:
    """Open a capture. Raises InputError, naming frame and key, for lens distortion, cameras that differ, no depth."""
    path = folder / TRANSFORMS_FILE
    content = read_json_object(path)
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: frames: expected a list of objects, at least one")
    records = {_file_path(entry, i, "file_path", path): _record(entry, i, path) for i, entry in enumerate(entries)}
    if len(records) < len(entries):
        raise InputError(f"{path}: frames: {len(entries) - len(records)} of them repeat another one's file_path")
    names = sorted(records, key=natural_order)
    frames = dict(zip(frame_numbers(names), (records[name] for name in names), strict=True))
    scale = depth_scale(content.get(SCALE_KEY, DEFAULT_METRES_PER_STEP), source=f"{path}: {SCALE_KEY}")
    size = image_size(next((f.depth for f in frames.values() if f.depth.is_file()), next(iter(frames.values())).depth))
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames=frames,
        camera=_camera(content, entries, path, size=size),
        depth_scale=scale,
        notes=()
        if SCALE_KEY in content
        else (
            f"depth: {scale:g} m a step, nerfstudio's default; {SCALE_KEY} in {TRANSFORMS_FILE} would say otherwise",
        ),
    )


def _record(entry: dict[str, Any], index: int, path: Path) -> FrameRecord:
    source = f"{path}: frames[{index}]"
    if "depth_file_path" not in entry:
        raise InputError(
            f"{source}: has no depth_file_path, and frames without depth cannot be used; name 16-bit depth images there"
        )
    matrix = numbers(entry.get("transform_matrix"), 16, source=f"{source}: transform_matrix").reshape(4, 4)
    return FrameRecord(
        color=path.parent / _file_path(entry, index, "file_path", path),
        depth=path.parent / _file_path(entry, index, "depth_file_path", path),
        pose=rigid(matrix, source=f"{source}: transform_matrix") @ CV_FROM_GL,
    )


def _file_path(entry: dict[str, Any], index: int, key: str, path: Path) -> str:
    value = entry.get(key)
    if not isinstance(value, str) or not value or "\0" in value:
        raise InputError(f"{path}: frames[{index}]: {key}: found {value!r}, expected the path of an image")
    return value


def _camera(
    content: dict[str, Any], entries: list[dict[str, Any]], path: Path, *, size: tuple[int, int]
) -> PinholeCamera:
    """Return the one camera of all frames; keys of a frame go before those of the file."""
    cameras = []
    for i, entry in enumerate(entries):
        source = f"{path}: frames[{i}]" if any(key in entry for key in INTRINSIC_KEYS) else str(path)
        merged = {key: value for key in INTRINSIC_KEYS if (value := entry.get(key, content.get(key))) is not None}
        cameras.append(_pinhole(merged, source=source, size=size))
        if cameras[i] != cameras[0]:
            raise InputError(f"{source}: its camera {cameras[i]} differs from frames[0]'s; one camera is expected")
    return cameras[0]


def _pinhole(keys: dict[str, Any], *, source: str, size: tuple[int, int]) -> PinholeCamera:
    model = keys.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise InputError(f"{source}: camera_model: {model!r} is not a pinhole camera; undistort the images first")
    for key in DISTORTION_KEYS:
        if numbers(keys.get(key, 0.0), 1, source=f"{source}: {key}")[0] != 0:
            raise InputError(f"{source}: {key}: {keys[key]} distorts the image; undistort the images first")

    def number(key: str, default: float | None = None) -> float:
        return float(numbers(keys.get(key, default), 1, source=f"{source}: {key}")[0])

    width, height = number("w", size[0]), number("h", size[1])
    if width != size[0] or height != size[1]:
        raise InputError(f"{source}: w, h: found {width:g}, {height:g}, but the depth images are {size[0]}×{size[1]}")
    if "fl_x" in keys:
        fx = number("fl_x")
    elif "camera_angle_x" in keys:
        fx = width / 2 / math.tan(number("camera_angle_x") / 2)
    else:
        raise InputError(f"{source}: has neither fl_x nor camera_angle_x; write the focal length in pixels as fl_x")
    try:
        return PinholeCamera.from_corner_origin(
            width=size[0],
            height=size[1],
            fx=fx,
            fy=number("fl_y", fx),
            cx=number("cx", width / 2),
            cy=number("cy", height / 2),
        )
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def write_index(conversion: Conversion) -> None:
    """Write ``transforms.json``."""
    cx, cy = conversion.source.camera.corner_origin
    camera = conversion.source.camera
    content = {
        "camera_model": "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": cx,
        "cy": cy,
        "w": camera.width,
        "h": camera.height,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        SCALE_KEY: conversion.depth_scale,
        "frames": [
            {
                "file_path": frame.color.relative_to(conversion.folder).as_posix(),
                "depth_file_path": frame.depth.relative_to(conversion.folder).as_posix(),
                "transform_matrix": (frame.world_from_camera @ CV_FROM_GL).tolist(),
            }
            for frame in conversion.frames
        ],
    }
    text = json.dumps(content, indent=1, allow_nan=False)
    write_bytes(conversion.folder / TRANSFORMS_FILE, (text + "\n").encode())


def _advice(conversion: Conversion) -> tuple[str, ...]:
    if math.isclose(conversion.depth_scale, DEFAULT_METRES_PER_STEP, rel_tol=1e-9):
        return ()
    return (f"nerfstudio must be told the depth images' scale: --depth-unit-scale-factor {conversion.depth_scale:g}",)


FORMAT = DatasetFormat(
    name="nerfstudio",
    title="nerfstudio",
    detect=detect,
    open=open_nerfstudio,
    image_names=lambda number, _: (f"images/frame_{number:06d}", f"depths/frame_{number:06d}.png"),
    write_index=write_index,
    carries=frozenset({"frame numbers"}),
    advice=_advice,
)
