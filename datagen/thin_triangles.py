"""Exact depth on long thin triangles, such as those along a bevelled edge.

Renderers intersect rays in single precision, from the cross product of two edges. Where these are long and nearly
parallel little of it is left: depth is off by about ε·L²/(h·cos θ) for the longest edge L and the height h over it,
seen at the angle θ from straight on, with ε = 2^-24. That is a tenth of a millimetre on a metre-long strip of a bevel.
So these few triangles are intersected again in double precision, at the pixels where they are what was seen.
"""

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, transform_points

Array = NDArray[np.float64]
SINGLE_PRECISION = 2.0**-24
LEAST_ASPECT = 20.0
LEAST_ERROR_M = 1e-6
"""Triangles whose depth is surely better than this are left alone."""
NEAREST_M = 1e-4
"""The least clip_start that a scene can have."""
SAFETY = 3.0
"""Depth that is farther off than so many times the estimate is that of another surface."""


def find_thin_triangles(vertices_world: Array, triangles: NDArray[np.integer]) -> Array:
    """Return the corners (K, 3, 3) of the triangles of a mesh that are too thin for single precision."""
    corners = np.asarray(vertices_world, np.float64)[triangles]
    longest, height = _longest_and_height(corners)
    # What has no height at all covers no pixel.
    thin = (height > 1e-12) & (longest > LEAST_ASPECT * height)
    return corners[thin & (SINGLE_PRECISION * longest**2 > LEAST_ERROR_M * height)]


def refine_depth(
    depth: NDArray[np.float32], camera: PinholeCamera, *, world_from_camera: Matrix, corners_world: Array
) -> NDArray[np.float32]:
    """Return ``depth`` (H, W), planar metres, corrected where it is that of one of the triangles (K, 3, 3).

    Those seen from behind (clockwise) are left out: of a closed mesh they are hidden, maybe closely, by what was seen.
    """
    corners = transform_points(inverse(world_from_camera), corners_world)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners = corners[np.einsum("ij,ij->i", normals, corners[:, 0]) < 0]
    triangle, pieces = _before_camera(corners)
    pixels = camera.project(pieces)
    across = np.ptp(pixels[:, :, 0], axis=1) >= np.ptp(pixels[:, :, 1], axis=1)
    found = []
    for along, chosen in ((0, np.flatnonzero(across)), (1, np.flatnonzero(~across))):
        sides = (camera.width, camera.height) if along == 0 else (camera.height, camera.width)
        numbers, a, b = _covered(pixels[chosen][:, :, [along, 1 - along]], sides)
        found.append((triangle[chosen][numbers], *((a, b) if along == 0 else (b, a))))
    number, u, v = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _corrected(depth, camera, corners, number, u, v)


def _before_camera(corners: Array) -> tuple[NDArray[np.intp], Array]:
    """Return triangles (M, 3, 3) that make up the part of ``corners`` (K, 3, 3) before the camera, and of which."""
    before = corners[:, :, 2] >= NEAREST_M
    whole = np.flatnonzero(before.all(axis=1))
    owners, pieces = [whole], [corners[whole]]
    for number in np.flatnonzero(before.any(axis=1) & ~before.all(axis=1)):
        outline = []
        for corner, following in zip(corners[number], np.roll(corners[number], -1, axis=0), strict=True):
            if corner[2] >= NEAREST_M:
                outline.append(corner)
            if (corner[2] >= NEAREST_M) != (following[2] >= NEAREST_M):
                share = (NEAREST_M - corner[2]) / (following[2] - corner[2])
                outline.append(corner + share * (following - corner))
        fan = [[outline[0], outline[i], outline[i + 1]] for i in range(1, len(outline) - 1)]
        owners.append(np.full(len(fan), number))
        pieces.append(np.array(fan))
    return np.concatenate(owners), np.concatenate(pieces)


def _covered(pixels: Array, sides: tuple[int, int]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return which triangle covers which pixel centre: its number, the pixel along the triangle, and across it.

    ``pixels`` (K, 3, 2) are corners, the coordinate along the triangle first; ``sides`` the image's in that order.
    """
    number, a = _spans(pixels[:, :, 0].min(axis=1), pixels[:, :, 0].max(axis=1), sides[0])
    low, high = np.full(len(a), np.inf), np.full(len(a), -np.inf)
    for i in range(3):
        first, last = pixels[:, i], pixels[:, (i + 1) % 3]
        run, rise = (last - first).T
        slope = np.divide(rise, run, out=np.zeros_like(run), where=run != 0)
        crossing = first[number, 1] + (a - first[number, 0]) * slope[number]
        begin, end = np.minimum(first[:, 0], last[:, 0]), np.maximum(first[:, 0], last[:, 0])
        crosses = (a >= begin[number]) & (a <= end[number]) & (run != 0)[number]
        np.minimum(low, crossing, out=low, where=crosses)
        np.maximum(high, crossing, out=high, where=crosses)
    touched = np.flatnonzero(np.ceil(low) <= high)
    row, b = _spans(low[touched], high[touched], sides[1])
    return number[touched][row], a[touched][row], b


def _spans(low: Array, high: Array, side: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return all whole numbers from ``low`` to ``high`` in the image, and which span each is of."""
    start = np.clip(np.ceil(low), 0, side).astype(np.intp)
    count = np.maximum(np.clip(np.floor(high), -1, side - 1).astype(np.intp) - start + 1, 0)
    number = np.repeat(np.arange(len(low)), count)
    within = np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count)
    return number, start[number] + within


def _corrected(
    depth: NDArray[np.float32],
    camera: PinholeCamera,
    corners: Array,
    number: NDArray[np.intp],
    u: NDArray[np.intp],
    v: NDArray[np.intp],
) -> NDArray[np.float32]:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    longest, height = _longest_and_height(corners)
    rays = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    slope = np.einsum("ij,ij->i", rays, normals[number])
    slope = np.where(slope == 0, np.nan, slope)
    exact = np.einsum("ij,ij->i", corners[number, 0], normals[number]) / slope
    off = np.abs(exact - depth[v, u])
    error = SINGLE_PRECISION * longest[number] ** 2 / height[number] / np.abs(slope)
    use = np.flatnonzero(off <= SAFETY * error + 4 * SINGLE_PRECISION * exact)
    use = use[np.argsort(-off[use], kind="stable")]  # of several triangles at a pixel, the one that was seen comes last
    corrected = depth.copy()
    corrected[v[use], u[use]] = exact[use]
    return corrected


def _longest_and_height(corners: Array) -> tuple[Array, Array]:
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    doubled_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return longest, np.divide(doubled_area, longest, out=np.zeros_like(longest), where=longest > 0)
