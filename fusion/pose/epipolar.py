"""Rectification by epipolar geometry: features of the query are matched with those of the nearest fused frames.

Between the query and each frame the essential matrix, found robustly (MAGSAC), leaves the matches that one motion of
the camera explains. The frame's depth makes its side of a match a point in space, and so gives the scale: the pose is
that of the query's pixels and all frames' points together (robust PnP, then least squares). Where there is too little
texture for that it declines, and hands the pose on as it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, rigid, transform_points
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.refinement import Refinement, declined
from fusion.pose.uncertainty import uncertainty

Features = Literal["sift", "orb", "akaze"]
FEATURES: tuple[Features, ...] = ("sift", "orb", "akaze")

_RATIO = 0.8
"""Of the distances to the best and the second best match, up to which the best is taken (Lowe 2004)."""
_FEWEST_MATCHES, _FEWEST_INLIERS = 20, 16
_LEAST_INLIER_SHARE = 0.35
_EPIPOLAR_PX, _REPROJECTION_PX = 1.5, 3.0
_CONFIDENCE, _ITERATIONS = 0.9999, 2000
_DEPTH_STEP = 0.02
"""Depths of the four pixels about a feature that differ by more than this share are of two surfaces."""
_OFF_SURFACE_VOXELS = 3.0
_LEAST_SPREAD = 0.02
"""Of the inliers in the query's image, as a share of its width, below which they fix no pose."""


@dataclass(frozen=True, kw_only=True)
class EpipolarOptions:
    """``features`` are SIFT, ORB or AKAZE; at most ``most_features`` an image (AKAZE takes all that there are).

    ``on_surface``: points of the frames that are off the model's surface, as a background is, are left out.
    """

    features: Features = "sift"
    most_features: int = 2000
    on_surface: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class _Keypoints:
    pixels: NDArray[np.float64]
    descriptors: Any


def rectify(
    model: PoseModel,
    query: Query,
    references: Sequence[ReferenceFrame],
    world_from_camera: Matrix,
    *,
    options: EpipolarOptions | None = None,
) -> Refinement:
    """Find the pose of ``query`` by features shared with ``references``, the fused frames nearest to the start.

    Residuals are pixels of the query's image. Without colour, or with too few matches, it declines and hands back the
    start ``world_from_camera``. Raises InputError for a start that is not rigid.
    """
    options = options or EpipolarOptions()
    start = rigid(world_from_camera, source="start of the rectification")
    if query.color is None:
        return declined("epipolar", start, "the query has no colour image to find features in", unit="px")
    ours = _keypoints(query.color, options, mask=query.mask)
    if len(ours.pixels) < _FEWEST_MATCHES:
        reason = f"the query has {len(ours.pixels)} features, fewer than {_FEWEST_MATCHES}: too little texture"
        return declined("epipolar", start, reason, used=len(ours.pixels), unit="px")
    pixels, points, matched = [], [], 0
    for reference in references:
        theirs = _keypoints(reference.color, options, mask=reference.depth > 0)
        pairs = _matches(ours, theirs, options)
        matched += len(pairs)
        pairs = _on_one_motion(pairs, ours, theirs, query.camera, reference.camera)
        some_pixels, some_points = _with_depth(pairs, ours, theirs, reference, model, options)
        pixels.append(some_pixels)
        points.append(some_points)
    pixels_query = np.concatenate([np.empty((0, 2)), *pixels])
    points_world = np.concatenate([np.empty((0, 3)), *points])
    if len(pixels_query) < _FEWEST_MATCHES:
        reason = (
            f"{len(pixels_query)} of {matched} matches agree with one motion and have depth, fewer than"
            f" {_FEWEST_MATCHES}: too little texture"
        )
        return declined("epipolar", start, reason, used=matched, unit="px")
    return _from_points(query, pixels_query, points_world, start, matched)


def _keypoints(color: NDArray[np.uint8], options: EpipolarOptions, *, mask: NDArray[np.bool_] | None) -> _Keypoints:
    """Find features in an RGB image, within ``mask`` if given."""
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    vision: Any = cv2  # its stubs know no detectors
    detector = {
        "sift": lambda: vision.SIFT_create(nfeatures=options.most_features, contrastThreshold=0.02),
        "orb": lambda: vision.ORB_create(nfeatures=options.most_features, fastThreshold=10),
        "akaze": lambda: vision.AKAZE_create(threshold=5e-4),
    }[options.features]()
    found, descriptors = detector.detectAndCompute(grey, None if mask is None else mask.astype(np.uint8))
    pixels = np.array([keypoint.pt for keypoint in found], np.float64).reshape(-1, 2)
    return _Keypoints(pixels=pixels, descriptors=descriptors)


def _matches(ours: _Keypoints, theirs: _Keypoints, options: EpipolarOptions) -> NDArray[np.int64]:
    """Return pairs (n, 2) of features that are each other's best match, clearly better than the second."""
    if min(len(ours.pixels), len(theirs.pixels)) < 2:
        return np.empty((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_L2 if options.features == "sift" else cv2.NORM_HAMMING)
    best_back = {match.queryIdx: match.trainIdx for match in matcher.match(theirs.descriptors, ours.descriptors)}
    pairs = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(ours.descriptors, theirs.descriptors, k=2)
        if first.distance < _RATIO * second.distance and best_back[first.trainIdx] == first.queryIdx
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def _rays(camera: PinholeCamera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixels (n, 2) on the plane z = 1."""
    return (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)


def _on_one_motion(
    pairs: NDArray[np.int64], ours: _Keypoints, theirs: _Keypoints, camera: PinholeCamera, their_camera: PinholeCamera
) -> NDArray[np.int64]:
    """Return the pairs that the essential matrix of one motion of the camera explains."""
    if len(pairs) < 8:
        return pairs[:0]
    here, there = _rays(camera, ours.pixels[pairs[:, 0]]), _rays(their_camera, theirs.pixels[pairs[:, 1]])
    cv2.setRNGSeed(0)  # the same matches give the same pose
    find: Any = cv2.findEssentialMat  # by its stubs it never fails
    essential, kept = find(
        there,
        here,
        np.eye(3),
        method=cv2.USAC_MAGSAC,
        prob=_CONFIDENCE,
        threshold=_EPIPOLAR_PX / camera.fx,
        maxIters=_ITERATIONS,
    )
    if essential is None or kept is None:
        return pairs[:0]
    return pairs[kept.ravel() > 0]


def _with_depth(
    pairs: NDArray[np.int64],
    ours: _Keypoints,
    theirs: _Keypoints,
    reference: ReferenceFrame,
    model: PoseModel,
    options: EpipolarOptions,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels (n, 2) of the query and the points (n, 3) in the world that the frame's depth has for them."""
    at = theirs.pixels[pairs[:, 1]]
    depth, known = _depth_at(reference.depth, at)
    rays = np.concatenate([_rays(reference.camera, at), np.ones((len(at), 1))], axis=1)
    points = transform_points(reference.world_from_camera, rays * depth[:, None])
    if options.on_surface and len(points):
        distances, _normals, sources = model.sample(points)
        known &= (sources > 0) & (np.abs(distances) < _OFF_SURFACE_VOXELS * model.voxel_size)
    return ours.pixels[pairs[known, 0]], points[known]


def _depth_at(depth: NDArray[np.float32], pixels: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return depth (n,) between the four pixels about ``pixels`` (n, 2), and whether they are of one surface."""
    height, width = depth.shape
    u, v = np.clip(pixels, 0, (width - 1.001, height - 1.001)).T
    left, top = u.astype(int), v.astype(int)
    x, y = u - left, v - top
    four = np.stack([depth[top, left], depth[top, left + 1], depth[top + 1, left], depth[top + 1, left + 1]]).astype(
        float
    )
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    known = (four > 0).all(axis=0) & (np.ptp(four, axis=0) < _DEPTH_STEP * four.max(axis=0))
    return (weights * four).sum(axis=0), known


def _from_points(
    query: Query, pixels: NDArray[np.float64], points_world: NDArray[np.float64], start: Matrix, matched: int
) -> Refinement:
    """Return the pose that sees points at pixels, robustly, with what speaks for it."""
    camera = query.camera
    solve: Any = cv2.solvePnPRansac  # the stubs of OpenCV know no matrices of doubles
    refine: Any = cv2.solvePnPRefineLM
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    # Relative to their middle, so that no digits are lost far from the world's origin.
    middle = points_world.mean(axis=0)
    points = points_world - middle
    cv2.setRNGSeed(0)
    found, turn, shift, kept = solve(
        points,
        pixels,
        intrinsics,
        None,
        iterationsCount=_ITERATIONS,
        reprojectionError=_REPROJECTION_PX,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    inliers = np.empty(0, int) if not found or kept is None else kept.ravel()
    if len(inliers) < max(_FEWEST_INLIERS, _LEAST_INLIER_SHARE * len(pixels)):
        reason = f"{len(inliers)} of {len(pixels)} matches agree on a pose, too few to trust it"
        return declined("epipolar", start, reason, used=matched, unit="px")
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(pixels[inliers].T))[0])
    if spread < _LEAST_SPREAD * camera.width:
        reason = f"the {len(inliers)} matches lie within {spread:.1f} pixels of a line: they fix no pose"
        return declined("epipolar", start, reason, used=matched, unit="px")
    turn, shift = refine(points[inliers], pixels[inliers], intrinsics, None, turn, shift)
    camera_from_points = np.eye(4)
    camera_from_points[:3, :3], camera_from_points[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    pose = inverse(camera_from_points)
    pose[:3, 3] += middle
    seen = transform_points(inverse(pose), points_world[inliers])
    residuals = camera.project(seen) - pixels[inliers]
    sigma = float(np.sqrt((residuals**2).sum() / max(2 * len(inliers) - 6, 1)))
    pivot = points_world[inliers].mean(axis=0)
    offsets = points_world[inliers] - pivot
    hessian = _information(camera, seen, offsets, pose)
    radius = float(np.sqrt((offsets**2).sum(axis=1).mean()))
    return Refinement(
        stage="epipolar",
        world_from_camera=pose,
        converged=True,
        residual=float(np.sqrt((residuals**2).sum(axis=1).mean())),
        expected=1.0,
        unit="px",
        inlier_share=len(inliers) / len(pixels),
        used=len(inliers),
        uncertainty=uncertainty(hessian, sigma=sigma, pivot_world=pivot, radius_m=radius),
    )


def _information(
    camera: PinholeCamera, seen: NDArray[np.float64], offsets: NDArray[np.float64], pose: Matrix
) -> NDArray[np.float64]:
    """Return JᵀJ (6, 6) of projections by the pose's twist about the pivot: points move back as the camera moves."""
    x, y, z = seen.T
    zero = np.zeros_like(z)
    across = np.stack([camera.fx / z, zero, -camera.fx * x / z**2], axis=-1)
    down = np.stack([zero, camera.fy / z, -camera.fy * y / z**2], axis=-1)
    slopes = -np.concatenate([across, down]) @ pose[:3, :3].T
    jacobian = np.concatenate([slopes, np.cross(np.concatenate([offsets, offsets]), slopes)], axis=1)
    return np.asarray(jacobian.T @ jacobian)
