"""The model's silhouette with a soft edge, rendered so that it can be differentiated by the pose.

For each pixel just beside the silhouette the ray's nearest approach to the surface is found; the distance there, seen
as pixels, is the pixel's distance s from the silhouette's edge. All others take that of one of these, and the way
between them: what is under the surface, thick or thin, has no part in the silhouette, and what is far from it is not
well known. Coverage is Φ(−s/σ), Φ the normal distribution: that of a sharp silhouette blurred by a Gaussian of σ
pixels, where its edge is straight. Where a ray comes nearest does not change the distance in first order, so the
derivative is that of the distance at a fixed place of the ray; Warp's tape takes it, for all six parameters of a pose.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import launch_in_slabs
from fusion.pose.coverage_kernel import COVERAGE_KERNEL
from fusion.pose.nearest_approach import NOWHERE, nearest_approaches
from fusion.pose.pose_model import PoseModel

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_NOWHERE = wp.constant(NOWHERE)
BESIDE_PX = 1.0
"""Pixels no farther from the silhouette tell of all others: a fused field is right next to the surface alone."""
_BESIDE_PX = wp.constant(BESIDE_PX)
_HALF_PIECE_PX = wp.constant(0.7)
"""Of the edge, half of what a pixel beside it tells of: its diagonal, so that the pieces leave no gaps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftSilhouette:
    """The silhouette at n pixels.

    ``coverage`` (n,) from 0 to 1; ``jacobian`` (n, 6) its derivative by the twist of the pose along the world's axes
    about the pivot, from the tape; empty where it was not asked for. ``edge_px`` (n,) is the distance from the edge in
    pixels, negative within, infinite where the ray never comes near.
    """

    coverage: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    edge_px: NDArray[np.float64]


def soft_silhouette(
    model: PoseModel,
    camera: PinholeCamera,
    pixels: NDArray[np.floating],
    world_from_camera: Matrix,
    *,
    softness_px: float,
    pivot_world: NDArray[np.float64],
    with_jacobian: bool = True,
) -> SoftSilhouette:
    """Render the soft silhouette of ``model`` at ``pixels`` (n, 2), (u, v) of ``camera``, seen from a pose.

    The pixels are whole ones, and those beside the silhouette have to be among them. ``softness_px`` is σ, in the
    camera's pixels.
    """
    device = model.device
    count = len(pixels)
    approaches, edges_px, slopes = nearest_approaches(
        model, camera, pixels, world_from_camera, fine_within_px=BESIDE_PX
    )
    # Farther within than three deviations coverage is 1.
    nearest, within_px, shares = _pixels_beside(np.asarray(pixels), edges_px, slopes, int(np.ceil(3 * softness_px)) + 1)
    twists = wp.zeros(count, dtype=wp.spatial_vector, device=device, requires_grad=with_jacobian)
    coverage = wp.empty(count, dtype=float, device=device, requires_grad=with_jacobian)
    edge = wp.empty(count, dtype=float, device=device)
    pivot = wp.vec3(*(pivot_world - model.origin_world).tolist())
    inputs: list[Any] = [
        approaches,
        *(nearest, within_px, shares, twists, pivot, softness_px),
    ]
    jacobian = np.empty((0, 6))
    # Each pixel has six parameters to itself: one pass back through the tape gives all rows of the Jacobian.
    tape = wp.Tape()
    with tape:
        wp.launch(COVERAGE_KERNEL, dim=count, inputs=inputs, outputs=[coverage, edge], device=device)
    if with_jacobian:
        tape.backward(grads={coverage: wp.ones(count, dtype=float, device=device)})
        jacobian = twists.grad.numpy().astype(np.float64)
    return SoftSilhouette(
        coverage=coverage.numpy().astype(np.float64), jacobian=jacobian, edge_px=edge.numpy().astype(np.float64)
    )


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
    if own >= float(reach) or (own >= 0.0 and own < _BESIDE_PX):
        return
    if own < 0.0:
        within_px[index] = wp.inf
    place = places[index]
    side = wp.where(own < 0.0, -1.0, 1.0)
    least = float(reach)
    for row in range(wp.max(place[0] - reach, 0), wp.min(place[0] + reach + 1, held.shape[0])):
        for column in range(wp.max(place[1] - reach, 0), wp.min(place[1] + reach + 1, held.shape[1])):
            other = held[row, column]
            if other >= 0 and edges_px[other] >= 0.0 and edges_px[other] < _BESIDE_PX:
                way = wp.vec2(float(place[1] - column), float(place[0] - row))
                slope = wp.length(slopes[other])
                unit = slopes[other] / wp.max(slope, 0.1)
                across = edges_px[other] / wp.max(slope, 0.1) + wp.dot(unit, way)
                along = wp.max(wp.abs(unit[0] * way[1] - unit[1] * way[0]) - _HALF_PIECE_PX, 0.0)
                far = wp.sqrt(across * across + along * along)
                if far < least:
                    least = far
                    nearest[index] = other
                    # Beyond a piece's end the distance grows by a share of what the piece moves by.
                    shares[index] = wp.max(side * across / wp.max(far, 1.0e-3), 0.0)
                    within_px[index] = shares[index] * edges_px[other] - side * far


def _pixels_beside(
    pixels: NDArray[np.floating], edges_px: wp.array, slopes: wp.array, reach: int
) -> tuple[wp.array, wp.array, wp.array]:
    """Tell which pixel beside the silhouette tells of each pixel, and how much farther within this one is.

    ``pixels`` (n, 2) are whole, ``edges_px`` (n,) their distances from the edge, right where they are small and
    positive, ``slopes`` (n,) vec2 how these grow: so each such pixel knows a piece of the edge, square to its slope.
    The nearest piece tells. Returns the indices (n,), how many pixels farther within (n,), infinite within where no
    piece is in ``reach``, and the share (n,) of the other's distance that this is to be taken from.
    """
    device = edges_px.device
    places = np.rint(pixels[:, ::-1]).astype(np.int32)
    places -= places.min(axis=0)
    held = np.full(places.max(axis=0) + 1, -1, np.int32)
    held[places[:, 0], places[:, 1]] = np.arange(len(places))
    nearest = wp.empty(len(places), dtype=int, device=device)
    within_px = wp.empty(len(places), dtype=float, device=device)
    shares = wp.empty(len(places), dtype=float, device=device)
    launch_in_slabs(
        _tell_from_beside,
        dim=len(places),
        inputs=[
            wp.array(places, dtype=wp.vec2i, device=device),
            wp.array(held, dtype=int, device=device),
            *(edges_px, slopes, reach),
        ],
        outputs=[nearest, within_px, shares],
        device=device,
        least_slab=4096,
    )
    return nearest, within_px, shares
