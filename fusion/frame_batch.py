"""Posed frames as the kernels read them, on one device."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse
from fusion.devices import Device, map_on_cores

MAX_BATCH = 32
"""Frames a batch: one bit each in a block's mask."""


@dataclass(frozen=True, kw_only=True)
class FrameBatch:
    """Up to ``MAX_BATCH`` frames of one camera, as device arrays.

    ``depth`` (frames, height, width) planar, 0 = invalid, in steps of ``depth_scale`` metres: uint16 as images store
    it, or float32 metres, then ``depth_scale`` is 1. ``color`` (frames, height, width) uint32, red in the lowest byte,
    its confidence in the highest, or None for depth alone; ``pixel_weights`` (frames, height, width) float32, None
    where all are 1; ``camera_from_world`` (frames,) mat44d.
    """

    camera: PinholeCamera
    depth: wp.array
    depth_scale: float
    color: wp.array | None
    camera_from_world: wp.array
    pixel_weights: wp.array | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return int(self.camera_from_world.shape[0])


class FrameUploader:
    """Copies frames of one camera to a device, into the same buffers each time.

    With a ``depth_scale``, metres a step, depth images are uint16, half the memory to read; without, float32 metres.
    """

    def __init__(
        self, camera: PinholeCamera, *, device: Device, capacity: int = MAX_BATCH, depth_scale: float | None = None
    ) -> None:
        assert 1 <= capacity <= MAX_BATCH, f"a batch holds 1 to {MAX_BATCH} frames"
        self.camera = camera
        self.device = device
        self.depth_scale = 1.0 if depth_scale is None else depth_scale
        shape = (capacity, camera.height, camera.width)
        depth_type = wp.float32 if depth_scale is None else wp.uint16
        self._host_depth = wp.empty(shape, dtype=depth_type, device="cpu", pinned=device.is_cuda)
        self._host_color = wp.empty(shape, dtype=wp.uint32, device="cpu", pinned=device.is_cuda)
        self._host_poses = wp.empty(capacity, dtype=wp.mat44d, device="cpu", pinned=device.is_cuda)
        # On the CPU the kernels read the host buffers themselves.
        self._poses = wp.empty_like(self._host_poses, device=device) if device.is_cuda else self._host_poses
        self._depth = wp.empty_like(self._host_depth, device=device) if device.is_cuda else self._host_depth
        self._color = wp.empty_like(self._host_color, device=device) if device.is_cuda else self._host_color

    def __call__(
        self,
        depths: Sequence[NDArray[np.float32]] | Sequence[NDArray[np.uint16]],
        poses: Sequence[Matrix],
        colors: Sequence[NDArray[np.uint8]] | None = None,
    ) -> FrameBatch:
        """Return the frames on the device; the result lives until the next call.

        ``depths`` are (height, width) planar, metres or steps, ``poses`` world_from_camera 4×4, ``colors``
        (height, width, 3) RGB.
        """
        count = len(depths)
        depth_rows, color_rows, pose_rows = (
            host.numpy() for host in (self._host_depth, self._host_color, self._host_poses)
        )

        def copy(i: int) -> None:
            np.copyto(depth_rows[i], depths[i], casting="no")
            if colors is not None:
                height, width = colors[i].shape[:2]
                rgba = color_rows[i].view(np.uint8).reshape(height, width, 4)
                cv2.cvtColor(colors[i], cv2.COLOR_RGB2RGBA, dst=rgba)

        map_on_cores(copy, range(count))
        pose_rows[:count] = [inverse(pose) for pose in poses]
        if self.device.is_cuda:
            wp.copy(self._poses, self._host_poses)
            wp.copy(self._depth, self._host_depth)
            if colors is not None:
                wp.copy(self._color, self._host_color)
            # The next call fills the host buffers anew.
            wp.synchronize_device(self.device)
        return FrameBatch(
            camera=self.camera,
            depth=self._depth[:count],
            depth_scale=self.depth_scale,
            color=None if colors is None else self._color[:count],
            camera_from_world=self._poses[:count],
        )
