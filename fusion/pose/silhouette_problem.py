"""A query's mask against a model: residuals of coverage, and their normal equations, from coarse to fine."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, inverse
from fusion.pose.levenberg_marquardt import Descent, descend
from fusion.pose.normal_equations import Normals
from fusion.pose.pose_model import PoseModel
from fusion.pose.se3 import about_pivot, log_se3
from fusion.pose.silhouette_target import Level
from fusion.pose.soft_silhouette import SilhouetteRenderer, SoftSilhouette

Poses = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Bias:
    """The slope of the cost that a right pose has since the model's outline is not the object's.

    ``gradient`` (6,) is by the twist of a pose about the model's middle; poses are told from ``anchor``, one nearby.
    """

    gradient: NDArray[np.float64]
    anchor: Matrix

    def taken_off(self, normals: Normals, poses: Poses, pivot_world: NDArray[np.float64], *, pixels: int) -> Normals:
        """Return the equations of poses (k, 4, 4), of so many pixels each, of a cost that is level at a right pose."""
        twists = np.stack([log_se3(about_pivot(pose @ inverse(self.anchor), pivot_world)) for pose in poses])
        return replace(
            normals, gradient=normals.gradient - self.gradient, cost=normals.cost - twists @ self.gradient / pixels
        )


class SilhouetteProblem:
    """A mask against a model at all levels; poses turn about ``pivot_world``, ``radius`` metres is the model's size.

    ``bias`` is what is known of where the model's own outline is wrong, at the finest level.
    """

    def __init__(self, model: PoseModel, levels: list[Level], *, bias: Bias | None = None) -> None:
        self.model, self.levels, self.bias = model, levels, bias
        self.pivot_world, self.radius = model.centre_world, 0.3 * model.diameter
        self._renderers: dict[tuple[int, int], SilhouetteRenderer] = {}

    def without(self, bias: Bias) -> "SilhouetteProblem":
        """Return the same problem without a bias."""
        mended = SilhouetteProblem(self.model, self.levels, bias=bias)
        mended._renderers = self._renderers
        return mended

    def see(self, number: int, poses: Poses, *, with_jacobian: bool = False) -> SoftSilhouette:
        """Return the model's soft silhouette at a level's pixels, from poses (k, 4, 4)."""
        level = self.levels[number]
        if (number, len(poses)) not in self._renderers:
            self._renderers[number, len(poses)] = SilhouetteRenderer(
                self.model,
                level.camera,
                level.pixels,
                softness_px=level.softness_px,
                pivot_world=self.pivot_world,
                poses=len(poses),
            )
        return self._renderers[number, len(poses)].render(poses, with_jacobian=with_jacobian)

    def normals(self, number: int, poses: Poses) -> Normals:
        """Return the normal equations of poses (k, 4, 4); residuals are shares of coverage."""
        seen = self.see(number, poses, with_jacobian=True)
        assert seen.jacobian is not None
        residuals = seen.coverage - self.levels[number].target
        weights, costs = robust(residuals)
        weighted = weights[..., None] * seen.jacobian
        normals = Normals(
            hessian=np.swapaxes(weighted, 1, 2) @ seen.jacobian,
            gradient=(weighted * residuals[..., None]).sum(axis=1),
            cost=costs.mean(axis=1),
            known=np.isfinite(seen.edge_px).mean(axis=1),
            inliers=(np.abs(residuals) < 0.25).mean(axis=1),
            weight=weights.sum(axis=1),
            squares=(weights * residuals**2).sum(axis=1),
        )
        if self.bias is None or number != len(self.levels) - 1:
            return normals
        return self.bias.taken_off(normals, poses, self.pivot_world, pixels=residuals.shape[1])

    def descend(self, number: int, poses: Poses) -> Descent:
        """Move poses (k, 4, 4) downhill at a level."""
        level = self.levels[number]
        # As the pose that is nearest sees it, a pixel at the model's middle.
        away = np.linalg.norm(poses[:, :3, 3] - self.pivot_world, axis=1).min()
        metres_a_pixel = float(away) / level.camera.fx
        return descend(
            lambda at: self.normals(number, at),
            poses,
            pivot_world=self.pivot_world,
            radius_m=self.radius,
            iterations=level.iterations,
            enough_m=level.enough_px * metres_a_pixel,
            rough_m=level.rough_px * metres_a_pixel,
        )

    def overlaps(self, number: int, poses: Poses) -> NDArray[np.float64]:
        """Return the intersections over union (k,) of the silhouettes, at a level that has all pixels."""
        ours, theirs = self.see(number, poses).coverage > 0.5, self.levels[number].target > 0.5
        return (ours & theirs).sum(axis=1) / np.maximum((ours | theirs).sum(axis=1), 1)


def robust(residuals: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return weights and costs (k, n): by Geman and McClure's kernel an edge that is off by more than σ counts less."""
    scale = robust_scales(residuals)
    share = (residuals / scale) ** 2
    return 1 / (1 + share) ** 2, 0.5 * scale**2 * share / (1 + share)


def robust_scales(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each pose's scale (k, 1), a share of coverage, beyond which a residual counts less."""
    return np.maximum(0.4, 2 * np.sqrt(np.mean(residuals**2, axis=1, keepdims=True)))
