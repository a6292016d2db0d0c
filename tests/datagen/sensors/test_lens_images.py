import cv2
import numpy as np
import pytest
from analytic_depth import rays, tilted_plane

from datagen.camera import PinholeCamera
from datagen.scene_spec.lens_settings import LensSettings
from datagen.sensors.lens import distort, lens_map, undistort
from datagen.sensors.lens_images import distort_color, distort_depth

CAMERA = PinholeCamera(width=320, height=240, fx=262.0, fy=265.0, cx=161.3, cy=117.8)
BARREL = LensSettings(k1=-0.28, k2=0.09, p1=0.0012, p2=-0.0009, k3=-0.012, magnification=1.1)
PINCUSHION = LensSettings(k1=0.15, k2=0.03, p1=-0.0008, p2=0.001)
LENSES = pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])


def ideal_rays(lens):
    """Return the rays (H, W, 2), z = 1, that the pixels of the distorted image see, by OpenCV."""
    camera = lens_map(CAMERA, lens).camera
    coefficients = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    many = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    return cv2.undistortPointsIter(pixels, matrix, coefficients, None, None, many).reshape(*u.shape, 2)


@LENSES
@pytest.mark.parametrize("tilt_deg", [0, 50])
def test_a_planes_depth_is_that_along_the_distorted_rays(lens, tilt_deg):
    depth, _ = tilted_plane(CAMERA, distance=1.5, tilt_deg=tilt_deg, axis=(0.6, 0.8))
    x, y = np.moveaxis(ideal_rays(lens), -1, 0)
    tilt = np.radians(tilt_deg)
    normal = np.array([0.8 * np.sin(tilt), -0.6 * np.sin(tilt), np.cos(tilt)])
    expected = 1.5 * normal[2] / (normal[0] * x + normal[1] * y + normal[2])
    shown = distort_depth(depth, lens_map(CAMERA, lens))
    inside = lens_map(CAMERA, lens).inside
    np.testing.assert_allclose(shown[inside], expected[inside], rtol=1e-5)
    assert (shown[~inside] == 0).all()


@LENSES
def test_depth_is_never_between_two_surfaces(lens):
    left, _ = tilted_plane(CAMERA, distance=1.0, tilt_deg=35)
    right, _ = tilted_plane(CAMERA, distance=1.4, tilt_deg=-20)
    depth = np.where(np.hypot(*np.moveaxis(rays(CAMERA)[..., :2], -1, 0)) < 0.3, left, right)
    shown = distort_depth(depth, lens_map(CAMERA, lens))
    inside = lens_map(CAMERA, lens).inside
    x = ideal_rays(lens)[..., 0]

    def plane(distance, tilt_deg):
        tilt = np.radians(tilt_deg)
        return distance * np.cos(tilt) / (np.sin(tilt) * x + np.cos(tilt))

    off = np.minimum(np.abs(shown - plane(1.0, 35)), np.abs(shown - plane(1.4, -20)))
    apart = np.abs(plane(1.0, 35) - plane(1.4, -20)) / shown.clip(0.1)
    assert off[inside & (apart > 0.005)].max() < 2e-4
    assert off[inside].max() < 0.002 * 1.4  # where they cross, they are one within the tolerance


@LENSES
def test_a_curved_surface_is_followed_to_second_order(lens):
    along = rays(CAMERA)
    x, y = np.moveaxis(ideal_rays(lens), -1, 0)

    def sphere(x, y):  # radius 1 around (0, 0, 2), seen within 20 degrees
        square = x * x + y * y + 1
        return (2 - np.sqrt(np.maximum(4 - 3 * square, 0))) / square

    seen = np.hypot(x, y) < np.tan(np.radians(20))
    depth = np.where(3 * (along**2).sum(axis=-1) < 4, sphere(along[..., 0], along[..., 1]), 0)
    shown = distort_depth(depth, lens_map(CAMERA, lens))
    np.testing.assert_allclose(shown[seen], sphere(x, y)[seen], atol=2e-5)


@LENSES
def test_pixels_without_depth_spread_by_no_more_than_half_a_pixel(lens):
    depth, _ = tilted_plane(CAMERA, distance=1.5, tilt_deg=20)
    depth[100:140, 140:180] = 0
    mapped = lens_map(CAMERA, lens)
    hole = (np.abs(mapped.u - 159.5) < 20) & (np.abs(mapped.v - 119.5) < 20)
    np.testing.assert_array_equal((distort_depth(depth, mapped) == 0)[mapped.inside], hole[mapped.inside])


def displacement(image, expected, near, radius=6):
    """Return by how many pixels (2,) ``image`` is shifted against ``expected`` around ``near``, by least squares."""
    u, v = np.rint(near).astype(int)
    window = np.s_[v - radius : v + radius + 1, u - radius : u + radius + 1]
    along_v, along_u = np.gradient(expected)
    slopes = np.stack([along_u[window].ravel(), along_v[window].ravel()], axis=-1)
    return np.linalg.lstsq(slopes, (expected - image)[window].ravel(), rcond=None)[0]


@LENSES
def test_the_corners_of_a_checkerboard_land_where_the_lens_shows_them(lens):
    """A board in space, rendered without the lens and then shown through it, against what the lens sees of it."""
    mapped = lens_map(CAMERA, lens)
    columns, rows, square = 9, 6, 0.06
    tilt = np.radians(25)
    x_axis, y_axis = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([0.0, 1, 0])
    origin = np.array([0.0, 0.0, 0.75])
    normal = np.cross(x_axis, y_axis)

    def board(
        x, y
    ):  # its brightness along the ray (x, y, 1): squares with soft edges, so that corners are well defined
        distance = (normal @ origin) / (normal[0] * x + normal[1] * y + normal[2])
        hit = np.stack([x, y, np.ones_like(x)], axis=-1) * distance[..., None] - origin
        a, b = hit @ x_axis / square + (columns - 1) / 2, hit @ y_axis / square + (rows - 1) / 2
        return 127.5 + 110 * np.sin(np.pi * a) * np.sin(np.pi * b)

    rendered = np.rint(board(*np.moveaxis(rays(CAMERA)[..., :2], -1, 0))).astype(np.uint8)
    shown = distort_color(np.repeat(rendered[..., None], 3, axis=2), mapped)[..., 0]

    a, b = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    corners = origin + (a[..., None] * x_axis + b[..., None] * y_axis).reshape(-1, 3) * square
    appearing = distort(corners[:, :2] / corners[:, 2:], lens)
    expected = appearing * (mapped.camera.fx, mapped.camera.fy) + (mapped.camera.cx, mapped.camera.cy)
    ideal = board(*np.moveaxis(ideal_rays(lens), -1, 0))
    offset = np.array([displacement(shown.astype(np.float64), ideal, pixel) for pixel in expected])
    assert np.abs(offset.mean(axis=0)).max() < 0.01
    assert np.linalg.norm(offset, axis=1).max() < 0.05


def test_depth_and_colour_are_moved_alike():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    depth[80:160, 100:220] = 1.0
    color = np.where(depth[..., None] == 1, 255, 0).repeat(3, axis=2).astype(np.uint8)
    mapped = lens_map(CAMERA, BARREL)
    near = distort_depth(depth, mapped) == 1
    bright = distort_color(color, mapped)[..., 0] > 127
    assert (near != bright).sum() < 0.01 * near.sum()
    np.testing.assert_array_equal(near[~mapped.inside], False)


def test_points_of_the_distorted_depth_lie_on_the_plane_they_came_from():
    """The way a user goes: pixel, OpenCV's coefficients, depth, point."""
    depth, _ = tilted_plane(CAMERA, distance=1.5, tilt_deg=50)
    mapped = lens_map(CAMERA, BARREL)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    pixels = np.stack([u, v], axis=-1)
    ideal = undistort((pixels - (mapped.camera.cx, mapped.camera.cy)) / (mapped.camera.fx, mapped.camera.fy), BARREL)
    z = distort_depth(depth, mapped)
    points = np.dstack([ideal * z[..., None], z])[mapped.inside]
    tilt = np.radians(50)
    offset = points @ (np.sin(tilt), 0, np.cos(tilt)) - 1.5 * np.cos(tilt)
    assert np.abs(offset).max() < 2e-5
