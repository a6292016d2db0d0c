"""Posed frames as the kernels read them, on one device."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.images import DEPTH_INVALID_MAX, clear_beyond
from datagen.rigid import Matrix, inverse
from fusion.devices import Device, map_on_cores

MAX_BATCH = 32
"""Frames a batch: one bit each in a block's mask."""

TILE = 8
"""Pixels: images are looked over by square tiles of this width."""


@dataclass(frozen=True, kw_only=True)
class FrameBatch:
    """Up to ``MAX_BATCH`` frames of one camera, as device arrays.

    ``depth`` (frames, height, width) planar, 0 = invalid, in steps of ``depth_scale`` metres: uint16 as images store
    it, or float32 metres, then ``depth_scale`` is 1. ``color`` (frames, height, 3 · width) uint8, RGB, or None for
    depth alone; ``confidence`` (frames, rows of tiles, 8 · columns of tiles) uint8 is room for that of the colours
    (``color_confidence``): bit u % 8 of byte 8 · (u // 8) + v % 8 of row v // 8 is set where pixel (u, v) is trusted;
    ``pixel_weights`` (frames, height, width) float32, None where all are 1; ``camera_from_world`` (frames,) mat44d.
    """

    camera: PinholeCamera
    depth: wp.array
    depth_scale: float
    color: wp.array | None
    confidence: wp.array
    camera_from_world: wp.array
    pixel_weights: wp.array | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return int(self.camera_from_world.shape[0])


class _Buffers:
    """Room for a batch on the host and on the device, which on the CPU are the same.

    On CUDA ``copied`` is the event after the upload, ``released`` the one after the last kernel that reads the batch.
    """

    def __init__(self, camera: PinholeCamera, capacity: int, depth_type: type, device: Device) -> None:
        shape = (capacity, camera.height, camera.width)
        pinned = device.is_cuda
        self.host = (
            wp.empty(shape, dtype=depth_type, device="cpu", pinned=pinned),
            wp.empty(capacity, dtype=wp.mat44d, device="cpu", pinned=pinned),
            wp.empty((capacity, camera.height, 3 * camera.width), dtype=wp.uint8, device="cpu", pinned=pinned),
        )
        tiles = (-(-camera.height // TILE), TILE * -(-camera.width // TILE))
        self.confidence = wp.empty((capacity, *tiles), dtype=wp.uint8, device=device)
        self.on_device = tuple(wp.empty_like(array, device=device) for array in self.host) if pinned else self.host
        self.copied: Any = None
        self.released: Any = None


class FrameUploader:
    """Copies frames of one camera to a device, into a few sets of buffers in turn.

    With a ``depth_scale``, metres a step, depth images are uint16, half the memory to read; without, float32 metres.
    What is not finite becomes 0, as does 65535, which marks invalid steps too. On CUDA the copies run beside the
    kernels of the batch before.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        *,
        device: Device,
        capacity: int = MAX_BATCH,
        depth_scale: float | None = None,
        turns: int = 2,
    ) -> None:
        assert 1 <= capacity <= MAX_BATCH, f"a batch holds 1 to {MAX_BATCH} frames"
        self.camera = camera
        self.device = device
        self.depth_scale = 1.0 if depth_scale is None else depth_scale
        depth_type = wp.float32 if depth_scale is None else wp.uint16
        # The CPU's kernels are done when their launch returns: it needs no second set.
        sets = turns if device.is_cuda else 1
        self._turns = [_Buffers(camera, capacity, depth_type, device) for _ in range(sets)]
        self._copy_stream = wp.Stream(device) if device.is_cuda else None
        if self._copy_stream is not None:
            # The buffers belong to the kernels' stream; until then their memory may be what an earlier kernel reads.
            self._copy_stream.wait_stream(wp.get_stream(device))

    def __call__(
        self,
        depths: Sequence[NDArray[np.float32]] | Sequence[NDArray[np.uint16]],
        poses: Sequence[Matrix],
        colors: Sequence[NDArray[np.uint8]] | None = None,
    ) -> FrameBatch:
        """Return the frames on the device; the result lives until the next call.

        ``depths`` are (height, width) planar, metres or steps, ``poses`` world_from_camera 4×4, ``colors``
        (height, width, 3) RGB. On the CPU, images that lie in memory one after the other, as in an array of a dimension
        more, are not copied: they must stay as they are as long as the result is used, and mark invalid depth with 0.
        """
        if self.device.is_cuda:
            # All that reads the batch before was launched by now.
            self._turns[-1].released = wp.get_stream(self.device).record_event()
        buffers = self._turns.pop(0)
        self._turns.append(buffers)
        if buffers.copied is not None:
            wp.synchronize_event(buffers.copied)
        count = len(depths)
        depth, camera_from_world, color = (array[:count] for array in buffers.on_device)
        assert count <= len(buffers.confidence), "no more frames than there is room for"
        in_place = self.device.is_cpu and _are_one_array(depths, depth.shape, np.uint16)
        in_place &= colors is None or _are_one_array(colors, (*depth.shape, 3), np.uint8)
        camera_from_world_rows = buffers.host[1].numpy()
        camera_from_world_rows[:count] = inverse(np.asarray(poses))
        if in_place:
            depth = wp.array(depths, dtype=depth.dtype, device=self.device, copy=False)
            color = None if colors is None else _as_rows(colors, self.device)
        else:
            _fill(buffers, depths, colors)
        if self.device.is_cuda:
            self._copy(buffers, with_color=colors is not None)
        return FrameBatch(
            camera=self.camera,
            depth=depth,
            depth_scale=self.depth_scale,
            color=None if colors is None else color,
            confidence=buffers.confidence[:count],
            camera_from_world=camera_from_world,
        )

    def _copy(self, buffers: _Buffers, *, with_color: bool) -> None:
        """Copy to the device, once it has read what is there, and let the kernels to come wait for it."""
        stream = self._copy_stream
        assert stream is not None, "only CUDA has a stream for copies"
        if buffers.released is not None:
            stream.wait_event(buffers.released)
        for target, source in zip(buffers.on_device[: 3 if with_color else 2], buffers.host, strict=False):
            wp.copy(target, source, stream=stream)
        buffers.copied = stream.record_event()
        wp.get_stream(self.device).wait_event(buffers.copied)


def _fill(
    buffers: _Buffers,
    depths: Sequence[NDArray[np.float32]] | Sequence[NDArray[np.uint16]],
    colors: Sequence[NDArray[np.uint8]] | None,
) -> None:
    """Put images into the host's buffers, on all cores."""
    depth_rows, color_rows = buffers.host[0].numpy(), buffers.host[2].numpy()

    def copy(i: int) -> None:
        if depth_rows.dtype == np.uint16:
            clear_beyond(depths[i], DEPTH_INVALID_MAX - 1, out=depth_rows[i])
        else:
            np.copyto(depth_rows[i], depths[i], casting="no")
            depth_rows[i][~np.isfinite(depth_rows[i])] = 0
        if colors is not None:
            np.copyto(color_rows[i], colors[i].reshape(color_rows[i].shape), casting="no")

    map_on_cores(copy, range(len(depths)))


def _are_one_array(images: Any, shape: tuple[int, ...], dtype: type) -> bool:
    """Tell whether images are one array of steps or bytes, which kernels can read where it lies."""
    if not isinstance(images, np.ndarray) or not images.flags.c_contiguous:
        return False
    return bool(images.dtype == dtype and images.shape == shape)


def _as_rows(colors: Any, device: Device) -> wp.array:
    """Return (frames, height, width, 3) as (frames, height, 3 · width), where it lies."""
    frames, height, width, channels = colors.shape
    rows = colors.reshape(frames, height, channels * width)
    return wp.array(rows, dtype=wp.uint8, device=device, copy=False)
