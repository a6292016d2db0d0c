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

    ``depth`` (frames, height, width) float32 planar metres, 0 = invalid; ``color`` (frames, height, width) uint32, red
    in the lowest byte, or None for depth alone; ``world_from_camera`` (frames,) mat44, and ``poses`` the same on the
    host in double precision.
    """

    camera: PinholeCamera
    depth: wp.array
    color: wp.array | None
    world_from_camera: wp.array
    poses: tuple[Matrix, ...]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.poses)

    def camera_from_lattice(self, voxel_size: float) -> wp.array:
        """Return (frames,) mat44 that take lattice coordinates, i of voxel i, into the camera frame, metres."""
        return self._matrices(np.eye(4), voxel_size)

    def pixel_from_lattice(self, voxel_size: float) -> wp.array:
        """Return (frames,) mat44 that take lattice coordinates to (u·z, v·z, z, 1)."""
        camera = self.camera
        pixel_from_camera = np.diag([camera.fx, camera.fy, 1.0, 1.0])
        pixel_from_camera[:2, 2] = camera.cx, camera.cy
        return self._matrices(pixel_from_camera, voxel_size)

    def _matrices(self, target_from_camera: Matrix, voxel_size: float) -> wp.array:
        """Multiply in double precision; only the product is rounded."""
        world_from_lattice = np.diag([voxel_size, voxel_size, voxel_size, 1.0])
        products = [target_from_camera @ inverse(pose) @ world_from_lattice for pose in self.poses]
        return wp.array(np.stack(products).astype(np.float32), dtype=wp.mat44, device=self.depth.device)


class FrameUploader:
    """Copies frames of one camera to a device, into the same buffers each time."""

    def __init__(self, camera: PinholeCamera, *, device: Device, capacity: int = MAX_BATCH) -> None:
        assert 1 <= capacity <= MAX_BATCH, f"a batch holds 1 to {MAX_BATCH} frames"
        self.camera = camera
        self.device = device
        shape = (capacity, camera.height, camera.width)
        self._host_depth = wp.empty(shape, dtype=float, device="cpu", pinned=device.is_cuda)
        self._host_color = wp.empty(shape, dtype=wp.uint32, device="cpu", pinned=device.is_cuda)
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
            if colors is not None:
                wp.copy(self._color, self._host_color)
            # The next call fills the host buffers anew.
            wp.synchronize_device(self.device)
        return FrameBatch(
            camera=self.camera,
            depth=self._depth[:count],
            color=None if colors is None else self._color[:count],
            world_from_camera=wp.array(np.stack(poses).astype(np.float32), dtype=wp.mat44, device=self.device),
            poses=tuple(poses),
        )
