"""A view compared with the model ray-cast from many poses at once: the share of the pixels that a pose explains."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.pose.object_window import depth_tolerance, object_window
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

_PIXELS = 4000


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """A query's pixels about the object: ``depth`` (height, width) metres, 0 = invalid, or None; ``mask`` or None.

    ``tolerance`` (height, width) metres is the difference in depth from which on a pixel is not explained at all.
    """

    model: PoseModel
    camera: PinholeCamera
    depth: NDArray[np.float32] | None
    mask: NDArray[np.bool_] | None
    tolerance: NDArray[np.float64] | None

    def costs(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how badly each of the poses (n, 4, 4), world_from_camera, explains the view (n,).

        The mean, over as many pixels as the object has, of the squared difference in depth in tolerances, at most 1;
        an object's pixel without model counts 1, and so does a model's at which the query has no object, but for
        where something else stands before it.
        """
        rendered = cast_rays_at_mesh(
            self.model.mesh,
            self.camera,
            list(poses),
            device=self.model.device,
            depth_only=True,
            hierarchy=self.model.hierarchy,
        ).depth.numpy()
        seen = rendered > 0
        if self.depth is None or self.tolerance is None:
            assert self.mask is not None
            return np.asarray((seen != self.mask).sum(axis=(1, 2)) / max(self.mask.sum(), 1))
        measured = self.depth > 0
        here = measured if self.mask is None else measured & self.mask
        difference = (self.depth - rendered) / self.tolerance
        cost = np.where(here, np.where(seen, np.minimum(difference**2, 1), 1.0), 0.0)
        elsewhere = seen & ~(measured if self.mask is None else self.mask)
        # Where nothing is measured nothing is known to hide the model: it is too far away, or there is nothing.
        beside = elsewhere & (~measured | (difference > -1))
        return np.asarray((cost.sum(axis=(1, 2)) + beside.sum(axis=(1, 2))) / max(here.sum(), 1))


def comparison(model: PoseModel, query: Query, world_from_camera: Matrix) -> Comparison | None:
    """Make a query ready for comparing poses about ``world_from_camera``; None where there is nothing to compare."""
    window = object_window(model, query, world_from_camera, most=_PIXELS)
    if window is None:
        return None
    mask = None if query.mask is None else window.of(query.mask)
    if query.depth is None:
        return (
            None
            if mask is None
            else Comparison(model=model, camera=window.camera, depth=None, mask=mask, tolerance=None)
        )
    depth = window.of(query.whole_depth())
    return Comparison(
        model=model,
        camera=window.camera,
        depth=depth,
        mask=mask,
        tolerance=2 * depth_tolerance(model, query, depth),
    )
