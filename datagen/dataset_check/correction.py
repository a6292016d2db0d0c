"""A correction: what would have to be changed in a dataset for it to be right."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera

PoseForm = Literal["stored", "inverse", "transposed"]


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Turns what a dataset says into what a hypothesis takes for the truth.

    The true principal point is the stored one plus ``principal_shift_px``, the true focal lengths are the stored ones
    times ``focal_factor``. True planar depth is the stored one times ``depth_factor``, of which ``ray_distance`` says
    that it is measured along the ray. The stored camera's axes are the true ones times ``axes`` (signs of x, y, z);
    where ``mirrored_image`` the image rows or columns run backwards, and so does the principal point. The true pose is
    the stored one, its inverse, or has its rotation transposed, and belongs to the image ``pose_shift`` frames before.
    """

    principal_shift_px: tuple[float, float] = (0.0, 0.0)
    focal_factor: tuple[float, float] = (1.0, 1.0)
    depth_factor: float = 1.0
    ray_distance: bool = False
    axes: tuple[int, int, int] = (1, 1, 1)
    mirrored_image: bool = False
    pose_form: PoseForm = "stored"
    pose_shift: int = 0

    def intrinsics(self, camera: PinholeCamera) -> tuple[float, float, float, float]:
        """Return the corrected fx, fy, cx, cy in pixels."""
        cx, cy = camera.cx, camera.cy
        if self.mirrored_image:
            cx = camera.width - 1 - cx if self.axes[0] < 0 else cx
            cy = camera.height - 1 - cy if self.axes[1] < 0 else cy
        shift_x, shift_y = self.principal_shift_px
        return camera.fx * self.focal_factor[0], camera.fy * self.focal_factor[1], cx + shift_x, cy + shift_y

    def poses(self, stored: NDArray[np.float64], positions: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return world_from_camera (m, 4, 4) of the frames at ``positions`` of the sequence ``stored`` (n, 4, 4).

        NaN where the shifted position lies outside of the sequence. Camera axes are those of a true camera.
        """
        shifted = positions + self.pose_shift
        inside = (shifted >= 0) & (shifted < len(stored))
        poses = stored[np.clip(shifted, 0, len(stored) - 1)].copy()
        rotation, translation = poses[:, :3, :3].copy(), poses[:, :3, 3].copy()
        if self.pose_form != "stored":
            poses[:, :3, :3] = rotation.transpose(0, 2, 1)
        if self.pose_form == "inverse":
            poses[:, :3, 3] = -np.einsum("nji,nj->ni", rotation, translation)
        poses[:, :3, :3] *= np.array(self.axes, dtype=np.float64)
        poses[~inside] = np.nan
        return poses

    def moved(self, parameters: dict[str, float]) -> "Correction":
        """Return the correction with steps added to its continuous parameters (see ``PARAMETERS``)."""
        (dx, dy), (fx, fy), depth = self.principal_shift_px, self.focal_factor, self.depth_factor
        both = np.exp(parameters.get("log_f", 0.0))
        return replace(
            self,
            principal_shift_px=(dx + parameters.get("cx", 0.0), dy + parameters.get("cy", 0.0)),
            focal_factor=(
                float(fx * both * np.exp(parameters.get("log_fx", 0.0))),
                float(fy * both * np.exp(parameters.get("log_fy", 0.0))),
            ),
            depth_factor=float(depth * np.exp(parameters.get("log_depth", 0.0))),
        )


PARAMETERS = {"cx": 0.1, "cy": 0.1, "log_f": 0.001, "log_fx": 0.001, "log_fy": 0.001, "log_depth": 0.001}
"""Continuous parameters and the steps for their numeric derivatives: pixels, and logarithms of factors."""
