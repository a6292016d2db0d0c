"""Posed frames as the kernels read them, on one device."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse
from fusion.devices import Device

MAX_BATCH = 32
"""Frames a batch: one bit each in a block's mask."""


@dataclass(frozen=True, kw_only=True)
class FrameBatch:
    """Up to ``MAX_BATCH`` frames of one camera, as device arrays.

    ``depth`` (frames, height, width) float32 planar metres, 0 = invalid; ``color`` (frames, height, width) uint32,
    red in the lowest byte, or None for depth alone; ``world_from_camera`` and ``camera_from_world`` (frames,) mat44.
    """

    camera: PinholeCamera
    depth: wp.array
    color: wp.array | None
    world_from_camera: wp.array
    camera_from_world: wp.array

    def __len__(self) -> int:
        """Return the number of frames."""
        return int(self.depth.shape[0])


class FrameUploader:
    """Copies frames of one camera to a device, into the same buffers each time."""

    def __init__(self, camera: PinholeCamera, *, device: Device, capacity: int = MAX_BATCH) -> None:
        assert 1 <= capacity <= MAX_BATCH, f"a batch holds 1 to {MAX_BATCH} frames"
        self.camera = camera
        self.device = device
        shape = (capacity, camera.height, camera.width)
        self._host_depth = wp.zeros(shape, dtype=float, device="cpu", pinned=device.is_cuda)
        self._host_color = wp.zeros(shape, dtype=wp.uint32, device="cpu", pinned=device.is_cuda)
        # On the CPU the kernels read the host buffers themselves.
        self._depth = wp.empty_like(self._host_depth, device=device) if device.is_cuda else self._host_depth
        self._color = wp.empty_like(self._host_color, device=device) if device.is_cuda else self._host_color

    def __call__(
        self,
        depths: Sequence[NDArray[np.float32]],
        poses: Sequence[Matrix],
        colors: Sequence[NDArray[np.uint8]] | None = None,
    ) -> FrameBatch:
        """Return the frames on the device; the result lives until the next call.

        ``depths`` are (height, width) metres, ``poses`` world_from_camera 4×4, ``colors`` (height, width, 3) RGB.
        """
        count = len(depths)
        depth_rows, color_rows = self._host_depth.numpy(), self._host_color.numpy()
        for i, depth in enumerate(depths):
            np.copyto(depth_rows[i], depth)
        for i, color in enumerate(colors or ()):
            height, width = color.shape[:2]
            cv2.cvtColor(color, cv2.COLOR_RGB2RGBA, dst=color_rows[i].view(np.uint8).reshape(height, width, 4))
        if self.device.is_cuda:
            wp.copy(self._depth, self._host_depth)
            wp.copy(self._color, self._host_color)
        camera_from_world = np.stack([inverse(pose) for pose in poses])
        return FrameBatch(
            camera=self.camera,
            depth=self._depth[:count],
            color=None if colors is None else self._color[:count],
            world_from_camera=wp.array(np.stack(poses).astype(np.float32), dtype=wp.mat44, device=self.device),
            camera_from_world=wp.array(camera_from_world.astype(np.float32), dtype=wp.mat44, device=self.device),
        )
