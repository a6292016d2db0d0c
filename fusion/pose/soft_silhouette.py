"""The model's silhouette with a soft edge, rendered so that it can be differentiated by the pose.

For each pixel just beside the silhouette the ray's nearest approach to the surface is found; the distance there, seen
as pixels, is the pixel's distance s from the silhouette's edge. All others take that of one of these, and the way
between them: what is under the surface, thick or thin, has no part in the silhouette. Coverage is Φ(−s/σ), Φ the normal
distribution: that of a sharp silhouette blurred by a Gaussian of σ pixels, where its edge is straight. Where a ray
comes nearest does not change the distance in first order, so the derivative is that of the distance at a fixed place of
the ray; Warp's tape takes it, for all six parameters of a pose.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from fusion.devices import SlabLaunch
from fusion.pose.coverage_kernel import COVERAGE_KERNEL
from fusion.pose.nearest_approach import ApproachFinder
from fusion.pose.pose_model import PoseModel

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

BESIDE_PX = 1.0
"""Pixels no farther from the silhouette tell of all others: what they know of its edge is next to them."""
_BESIDE_PX, _ABOVE_PX = wp.constant(BESIDE_PX), wp.constant(-0.5)
"""The second: a ray that misses the mesh may yet be within the surface, by as much as the mesh was corrected."""
_HALF_PIECE_PX = wp.constant(0.7)
"""Of the edge, half of what a pixel beside it tells of: its diagonal, so that the pieces leave no gaps."""
_REACH_SIGMAS = 3.0
"""Farther within than so many deviations coverage is 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftSilhouette:
    """The silhouette at n pixels, seen from k poses.

    ``coverage`` (k, n) from 0 to 1; ``jacobian`` (k, n, 6) its derivative by the twist of the pose along the world's
    axes about the pivot, from the tape; None where it was not asked for. ``edge_px`` (k, n) is the distance from the
    edge in pixels, negative within, infinite where that is farther than coverage tells.
    """

    coverage: NDArray[np.float64]
    jacobian: NDArray[np.float64] | None
    edge_px: NDArray[np.float64]


class SilhouetteRenderer:
    """Renders the soft silhouette of ``model`` at the same pixels from k ``poses`` at a time, in arrays that are kept.

    ``pixels`` (n, 2), (u, v) of ``camera``, are whole ones, and those beside the silhouette have to be among them.
    ``softness_px`` is σ, in the camera's pixels; ``pivot_world`` (3,) is what twists turn about.
    """

    def __init__(
        self,
        model: PoseModel,
        camera: PinholeCamera,
        pixels: NDArray[np.floating],
        *,
        softness_px: float,
        pivot_world: NDArray[np.float64],
        poses: int = 1,
    ) -> None:
        device = model.device
        self._shape = poses, len(pixels)
        reach = int(np.ceil(_REACH_SIGMAS * softness_px)) + 1
        self._finder = ApproachFinder(model, camera, pixels, poses=poses)
        size = poses * len(pixels)
        told = [wp.zeros(size, dtype=kind, device=device) for kind in (int, float, float)]
        self._tell = _teller(self._finder, reach, told)
        self._twists = wp.zeros(size, dtype=wp.spatial_vector, device=device, requires_grad=True)
        self._coverage = wp.zeros(size, dtype=float, device=device, requires_grad=True)
        self._edge = wp.zeros(size, dtype=float, device=device)
        arguments = {
            "dim": size,
            "inputs": [
                self._finder.approaches,
                *(*told, self._twists),
                wp.vec3(*(pivot_world - model.origin_world).tolist()),
                softness_px,
            ],
            "outputs": [self._coverage, self._edge],
            "device": device,
        }
        # What is recorded once is played back with what then lies in the arrays.
        self._tape = wp.Tape()
        with self._tape:
            wp.launch(COVERAGE_KERNEL, **arguments)
        self._cover = wp.launch(COVERAGE_KERNEL, **arguments, record_cmd=True)

    def render(self, world_from_camera: NDArray[np.float64], *, with_jacobian: bool = True) -> SoftSilhouette:
        """Render what is seen from poses (k, 4, 4)."""
        self._finder.find(world_from_camera)
        self._tell.run()
        self._cover.launch()
        jacobian = None
        if with_jacobian:
            # Each pixel has six parameters to itself: one pass back through the tape gives all rows of the Jacobian.
            self._twists.grad.zero_()
            self._coverage.grad.fill_(1.0)
            self._tape.backward()
            jacobian = self._twists.grad.numpy().astype(np.float64).reshape(*self._shape, 6)
        return SoftSilhouette(
            coverage=self._coverage.numpy().astype(np.float64).reshape(self._shape),
            jacobian=jacobian,
            edge_px=self._edge.numpy().astype(np.float64).reshape(self._shape),
        )


@wp.func
def is_beside(edge_px: float) -> bool:
    """Return whether a pixel is next to the silhouette, so that it knows a piece of the edge."""
    return edge_px > _ABOVE_PX and edge_px < _BESIDE_PX


@wp.kernel
def _tell_from_beside(
    first: int,
    places: wp.array(dtype=wp.vec2i),
    held: wp.array2d(dtype=int),
    edges_px: wp.array(dtype=float),
    slopes: wp.array(dtype=wp.vec2),
    reach: int,
    nearest: wp.array(dtype=int),
    within_px: wp.array(dtype=float),
    shares: wp.array(dtype=float),
) -> None:
    index = wp.tid() + first
    nearest[index] = index
    within_px[index] = 0.0
    shares[index] = 1.0
    own = edges_px[index]
    if is_beside(own):
        return
    if own < 0.0:
        within_px[index] = wp.inf
    pixel = index % places.shape[0]
    place = places[pixel]
    side = wp.where(own < 0.0, -1.0, 1.0)
    least = float(reach)
    for row in range(wp.max(place[0] - reach, 0), wp.min(place[0] + reach + 1, held.shape[0])):
        for column in range(wp.max(place[1] - reach, 0), wp.min(place[1] + reach + 1, held.shape[1])):
            other = held[row, column]
            if other >= 0:
                other += index - pixel
                if is_beside(edges_px[other]):
                    way = wp.vec2(float(place[1] - column), float(place[0] - row))
                    unit = slopes[other]
                    across = edges_px[other] + wp.dot(unit, way)
                    along = wp.max(wp.abs(unit[0] * way[1] - unit[1] * way[0]) - _HALF_PIECE_PX, 0.0)
                    far = wp.sqrt(across * across + along * along)
                    if far < least:
                        least = far
                        nearest[index] = other
                        # Beyond a piece's end the distance grows by a share of what the piece moves by.
                        shares[index] = wp.max(side * across / wp.max(far, 1.0e-3), 0.0)
                        within_px[index] = shares[index] * edges_px[other] - side * far


def _teller(finder: ApproachFinder, reach: int, told: list[wp.array]) -> SlabLaunch:
    """Return what tells which pixel beside the silhouette tells of each pixel, and how much farther within this one is.

    A pixel beside it knows a piece of the edge, square to its slope, and the nearest piece tells. ``told`` (k · n,) are
    the indices, how many pixels farther within, infinite within where no piece is in ``reach``, and the share of the
    other's distance that this is to be taken from.
    """
    return SlabLaunch(
        _tell_from_beside,
        dim=len(finder.edges_px),
        inputs=[finder.places, finder.held, finder.edges_px, finder.slopes, reach],
        outputs=told,
        device=finder.edges_px.device,
        least_slab=512,
    )
