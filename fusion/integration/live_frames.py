"""What a live frame has to be, and how it is known again."""

import zlib
from dataclasses import replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Frame
from datagen.errors import InputError
from datagen.rigid import Matrix, rigid
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_source import near_origin


def checked_pose(frame: Frame, camera: PinholeCamera, depth_dtype: np.dtype) -> Matrix:
    """Return a frame's pose, made exactly rigid; raises InputError for a frame that cannot be integrated."""
    height, width = camera.height, camera.width
    for name, image, dtype, shape in (
        ("depth", frame.depth, depth_dtype, (height, width)),
        ("colour", frame.color, np.dtype(np.uint8), (height, width, 3)),
    ):
        if not isinstance(image, np.ndarray) or image.dtype != dtype or image.shape != shape:
            found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
            raise InputError(f"frame {frame.frame_id}: its {name} is {found}, expected {dtype} {shape}")
    pose = rigid(np.asarray(frame.world_from_camera, dtype=np.float64), source=f"frame {frame.frame_id}")
    return near_origin(pose, source=f"frame {frame.frame_id}")


def with_weights(batch: FrameBatch, weights: NDArray[np.float32], frame: Frame) -> FrameBatch:
    """Return a batch of one frame with ``weights`` of its pixels; raises InputError unless they are 0 or more each."""
    if not isinstance(weights, np.ndarray) or weights.shape != frame.depth.shape or not (weights >= 0).all():
        raise InputError(f"frame {frame.frame_id}: expected pixel_weights {frame.depth.shape} of 0 or more")
    on_device = wp.array(weights[None].astype(np.float32), dtype=float, device=batch.depth.device)
    return replace(batch, pixel_weights=on_device)


def fingerprint(frame: Frame, weights: NDArray[np.float32] | None) -> int:
    """Return a number that tells a frame from another: of its pose and of every 16th pixel in both directions."""
    parts = [np.asarray(frame.world_from_camera, dtype=np.float64), frame.depth[::16, ::16], frame.color[::16, ::16]]
    parts += [] if weights is None else [weights[::16, ::16].astype(np.float32)]
    return zlib.crc32(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
