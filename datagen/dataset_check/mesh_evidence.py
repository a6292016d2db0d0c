"""Frames held against the mesh that they show."""

import numpy as np

from datagen.dataset_check.correction import Correction
from datagen.dataset_check.ray_casting import MeshRays
from datagen.dataset_check.residuals import WORST_RELATIVE, Residuals, sample_smooth_pixels
from datagen.dataset_check.views import Views


class MeshEvidence:
    """Samples of the images whose depth is compared with the mesh's along the same ray; a block is a view."""

    name = "mesh"

    def __init__(self, views: Views, mesh: MeshRays, *, samples: int, rng: np.random.Generator) -> None:
        self._camera, self._noise, self._poses, self._mesh = views.camera, views.noise, views.poses, mesh
        drawn = [sample_smooth_pixels(smooth, samples, rng) for smooth in views.smooth]
        kept = [i for i, pixels in enumerate(drawn) if pixels is not None]
        self.views = np.array(kept, np.int64)
        self._positions = views.positions[self.views]
        pixels = [pixels for pixels in drawn if pixels is not None]
        self._u = np.array([columns for columns, _ in pixels], np.int64).reshape(-1, samples)
        self._v = np.array([rows for _, rows in pixels], np.int64).reshape(-1, samples)
        self._depth = views.depth[self.views[:, None], self._v, self._u].astype(np.float64)

    def residuals(self, correction: Correction, *, every: int = 1) -> Residuals:
        """Return the mesh's depth along each sample's ray minus the sample's depth."""
        fx, fy, cx, cy = correction.intrinsics(self._camera)
        u, v, stored = self._u[:, ::every], self._v[:, ::every], self._depth[:, ::every]
        x, y = (u - cx) / fx, (v - cy) / fy
        z = stored * correction.depth_factor
        if correction.ray_distance:
            z = z / np.sqrt(1 + x * x + y * y)
        poses = correction.poses(self._poses, self._positions)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ poses[:, :3, :3].transpose(0, 2, 1)
        origins = np.broadcast_to(poses[:, None, :3, 3], rays.shape)
        predicted = self._mesh.cast(origins.reshape(-1, 3), rays.reshape(-1, 3))[0].reshape(z.shape)
        sigma = self._noise.sigma(stored) * correction.depth_factor
        return Residuals(
            normalised=(predicted - z) / sigma,
            limit=WORST_RELATIVE * stored * correction.depth_factor / sigma,
            metres=predicted - z,
            depth=stored * correction.depth_factor,
            known=np.isfinite(poses).all(axis=(1, 2)),
        )
