"""Optional layers of a dataset: further images of every frame, each layer in a folder of its own name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import replacing, write_bytes
from datagen.dataset_format import frame_file
from datagen.errors import InputError
from datagen.images import write_color, write_depth

NORMAL_STEPS = 32767
"""A normal's component −1 … 1 is stored as (component + 1) · 32767; 0 0 0 marks pixels without a surface."""


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One kind of image: its file name's end, what it shows, and how it is encoded.

    ``encode`` takes the path to write and the array; ``decode`` takes the path and gives the array back. Layers of
    depth and colour are encoded as the frames' own and have neither.
    """

    part: str
    meaning: str
    encode: Callable[[Path, NDArray], None] | None = None
    decode: Callable[[Path], NDArray] | None = None


def _write_png16(path: Path, image: NDArray) -> None:
    encoded, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert encoded, f"OpenCV could not encode {path}"
    write_bytes(path, data.tobytes())


def _read_png16(path: Path, channels: int) -> NDArray[np.uint16]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None or image.dtype != np.uint16 or (1 if image.ndim == 2 else image.shape[2]) != channels:
        raise InputError(f"{path}: damaged, or not a 16-bit image of {channels} channel(s); render it again")
    return image.astype(np.uint16, copy=False)


def _write_normals(path: Path, normals: NDArray) -> None:
    steps = np.rint((np.asarray(normals, np.float64) + 1) * NORMAL_STEPS).astype(np.uint16)
    steps[(np.asarray(normals) == 0).all(axis=-1)] = 0
    _write_png16(path, steps[..., ::-1])  # OpenCV writes BGR


def _read_normals(path: Path) -> NDArray[np.float32]:
    steps = _read_png16(path, 3)[..., ::-1]
    normals = steps.astype(np.float32) / NORMAL_STEPS - 1
    normals[(steps == 0).all(axis=-1)] = 0
    return normals


def _write_flow(path: Path, flow: NDArray) -> None:
    with replacing(path) as temporary:
        if not cv2.writeOpticalFlow(str(temporary), np.ascontiguousarray(flow, np.float32)):
            raise OSError(f"OpenCV could not write {temporary}")


def _read_flow(path: Path) -> NDArray[np.float32]:
    flow = cv2.readOpticalFlow(str(path)) if path.is_file() else None
    if flow is None or flow.size == 0:
        raise InputError(f"{path}: missing or damaged; render it again")
    return flow.astype(np.float32, copy=False)


LAYERS = {
    "normals": Layer(
        part="normals.png",
        meaning="unit normals (H, W, 3) of the geometry, unshaded; camera axes, towards the camera; 0 0 0: no surface",
        encode=_write_normals,
        decode=_read_normals,
    ),
    "masks": Layer(
        part="mask.png",
        meaning="object indices (H, W) uint16: 0 background, i + 1 the scene's object i",
        encode=_write_png16,
        decode=lambda path: _read_png16(path, 1),
    ),
    "flow": Layer(
        part="flow.flo",
        meaning="optical flow (H, W, 2) in pixels to the next frame (Middlebury .flo); NaN where no surface is",
        encode=_write_flow,
        decode=_read_flow,
    ),
    "sensor_depth": Layer(part="depth.png", meaning="planar depth as the simulated sensor would give it"),
    "distorted_color": Layer(part="color.png", meaning="colour through the distorted lens"),
    "distorted_depth": Layer(part="depth.png", meaning="planar depth through the distorted lens"),
    "right_color": Layer(part="color.png", meaning="colour of the right camera of the stereo pair"),
    "right_depth": Layer(part="depth.png", meaning="planar depth of the right camera of the stereo pair"),
}


def layer_file(dataset_folder: Path, name: str, frame_id: int) -> Path:
    """Return the path of a frame's image in the layer ``name``."""
    return frame_file(dataset_folder / name, frame_id, LAYERS[name].part)


def write_layer(dataset_folder: Path, name: str, frame_id: int, image: NDArray, *, depth_scale: float) -> None:
    """Write a frame's ``image`` of the layer ``name`` atomically; depth is metres, ``depth_scale`` metres per step."""
    path, layer = layer_file(dataset_folder, name, frame_id), LAYERS[name]
    if layer.encode is not None:
        layer.encode(path, image)
    elif layer.part == "depth.png":
        write_depth(path, image, metres_per_step=depth_scale)
    else:
        write_color(path, image)
