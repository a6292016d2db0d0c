"""Frames reprojected into each other."""

import numpy as np
from numpy.typing import NDArray

from datagen.dataset_check.correction import Correction
from datagen.dataset_check.residuals import WORST_RELATIVE, Residuals, sample_smooth_pixels
from datagen.dataset_check.views import SMOOTH_RANGE, Views, inverse_depth


class PairEvidence:
    """Samples of source images that are reprojected into target images.

    ``pairs`` (b, 2) are indices of views, source and target. Both directions of a pair are two blocks.
    """

    name = "frames"

    def __init__(self, views: Views, pairs: NDArray[np.int64], *, samples: int, rng: np.random.Generator) -> None:
        self._views = views
        drawn = [(pair, sample_smooth_pixels(views.smooth[pair[0]], samples, rng)) for pair in pairs]
        kept = [(pair, pixels) for pair, pixels in drawn if pixels is not None]
        self.pairs = np.array([pair for pair, _ in kept], np.int64).reshape(-1, 2)
        self._u = np.array([pixels[0] for _, pixels in kept], np.int64).reshape(-1, samples)
        self._v = np.array([pixels[1] for _, pixels in kept], np.int64).reshape(-1, samples)
        self._depth = views.depth[self.pairs[:, :1], self._v, self._u].astype(np.float64)
        self._inverse_depth = inverse_depth(views.depth).ravel()

    def residuals(self, correction: Correction, *, every: int = 1) -> Residuals:
        """Return depth of the source's points in the target's frame minus the target's depth there."""
        fx, fy, cx, cy = correction.intrinsics(self._views.camera)
        u, v, stored = self._u[:, ::every], self._v[:, ::every], self._depth[:, ::every]
        x, y = (u - cx) / fx, (v - cy) / fy
        z = stored * correction.depth_factor
        if correction.ray_distance:
            z = z / np.sqrt(1 + x * x + y * y)
        relative_pose, known = self._target_from_source(correction)
        points = np.stack([x * z, y * z, z], axis=-1) @ relative_pose[:, :3, :3].transpose(0, 2, 1)
        points += relative_pose[:, None, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
        ahead = points[..., 2] > 0
        x, y = np.where(ahead, x, np.nan), np.where(ahead, y, np.nan)
        observed = self._observed(x * fx + cx, y * fy + cy)
        raw = observed.copy()
        observed *= correction.depth_factor
        if correction.ray_distance:
            observed /= np.sqrt(1 + x * x + y * y)
        noise = self._views.noise
        sigma = np.hypot(noise.sigma(stored), noise.sigma(np.nan_to_num(raw, nan=0.0))) * correction.depth_factor
        residual = points[..., 2] - observed
        return Residuals(
            normalised=residual / sigma,
            limit=WORST_RELATIVE * stored * correction.depth_factor / sigma,
            metres=residual,
            depth=stored * correction.depth_factor,
            known=known,
        )

    def _target_from_source(self, correction: Correction) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        poses = correction.poses(self._views.poses, self._views.positions)
        known = np.isfinite(poses[self.pairs]).all(axis=(1, 2, 3))
        source, target = (np.where(known[:, None, None], poses[self.pairs[:, i]], np.eye(4)) for i in (0, 1))
        rotation = target[:, :3, :3].transpose(0, 2, 1)  # also the inverse where axes are mirrored
        result = np.broadcast_to(np.eye(4), source.shape).copy()
        result[:, :3, :3] = rotation @ source[:, :3, :3]
        result[:, :3, 3] = np.einsum("bij,bj->bi", rotation, source[:, :3, 3] - target[:, :3, 3])
        return result, known

    def _observed(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the targets' stored depth at (u, v) px, bilinear in inverse depth; NaN beside or across surfaces."""
        height, width = self._views.camera.height, self._views.camera.width
        inside = (u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        column, row = u.astype(np.int64), v.astype(np.int64)
        index = (self.pairs[:, 1:] * height + row) * width + column
        a, b, c, d = (self._inverse_depth[index + step].astype(np.float64) for step in (0, 1, width, width + 1))
        right, down = u - column, v - row
        value = (a * (1 - right) + b * right) * (1 - down) + (c * (1 - right) + d * right) * down
        low = np.minimum(np.minimum(a, b), np.minimum(c, d))
        high = np.maximum(np.maximum(a, b), np.maximum(c, d))
        usable = inside & (low > 0) & (high - low < SMOOTH_RANGE * value)
        return np.divide(1, value, out=np.full_like(value, np.nan), where=usable)
