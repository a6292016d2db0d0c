"""What a depth image observes, where that is known in closed form: a slanted plane, a sphere, a slit before a wall."""

import numpy as np
import pytest
from analytic_depth import CAMERA, rays, tilted_plane
from synthetic_scene import SphereScene, icosphere

from datagen.camera import PinholeCamera
from fusion.evaluation.observed_surface import PIXELS_OF_SLACK, PointMarks
from fusion.frames.frame_batch import FrameUploader
from fusion.surface.mesh import Mesh

HERE, FACING = np.eye(4), np.array([0.0, 0.0, -1.0])
NEAR, COLUMN = 1.0, 100


NOTHING = Mesh(
    vertices=np.array([[0, 0, -10], [1, 0, -10], [0, 1, -10]], np.float32), triangles=np.array([[0, 1, 2]], np.int32)
)
"""A truth that hides nothing: what is asked then is what the images tell."""


def observed(points, normals, depth, device, *, truth=NOTHING, pose=HERE, depth_scale=None, camera=CAMERA):
    marks = PointMarks(points, np.broadcast_to(normals, points.shape), truth, device=device)
    marks.mark(FrameUploader(camera, device=device, depth_scale=depth_scale)([depth], [pose]))
    return marks.observed()


def points_at(u, v, z):
    """Return points (n, 3) of planar depth z that project to (u, v)."""
    return np.stack([z * (u - CAMERA.cx) / CAMERA.fx, z * (v - CAMERA.cy) / CAMERA.fy, z], axis=-1)


def anywhere(rng, count=2000):
    return rng.uniform(1, CAMERA.width - 2, count), rng.uniform(1, CAMERA.height - 2, count)


@pytest.mark.parametrize("tilt_deg", [0, 60, 85])
@pytest.mark.parametrize("side", [-1, 1])
def test_of_a_plane_all_is_observed_to_half_a_pixels_width(device, tilt_deg, side):
    depth, _ = tilted_plane(CAMERA, distance=1.0, tilt_deg=tilt_deg)
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    u, v = anywhere(np.random.default_rng(0))
    along = points_at(u, v, np.ones(len(u))) @ normal
    # Where the plane and its neighbouring pixels are before the camera.
    u, v, z = (part[along > 0.05 * np.cos(tilt)] for part in (u, v, normal[2] / np.where(along > 0, along, 1)))
    assert len(z) > 500
    points = points_at(u, v, z)
    width = z / min(CAMERA.fx, CAMERA.fy)
    assert observed(points, side * normal, depth, device).all()
    for pixels, expected in ((0.4, True), (-0.4, True), (0.6, False), (-0.6, False)):
        shifted = points * (1 + pixels * width / z)[:, None]
        # Slanted by 85° the depth changes by a fiftieth within half a pixel, and with it a shift by a share of depth.
        assert (observed(shifted, side * normal, depth, device) == expected).all()


def test_a_sphere_is_observed_where_it_is_flat_within_a_pixel(device):
    scene = SphereScene()
    camera = PinholeCamera(width=160, height=120, fx=170.0, fy=170.0, cx=81.3, cy=58.6)
    (pose,) = scene.poses_around(1)
    points, triangles = icosphere(scene, subdivisions=6)
    truth = Mesh(vertices=points.astype(np.float32), triangles=triangles.astype(np.int32))
    normals = (points - scene.centre) / scene.radius
    seen = observed(points, normals, scene.frame(0, pose, camera).depth, device, truth=truth, pose=pose, camera=camera)
    ways = pose[:3, 3] - points
    cosines = np.einsum("ij,ij->i", ways, normals) / np.linalg.norm(ways, axis=1)
    width = np.linalg.norm(ways, axis=1) / camera.fx
    # Half a pixel's diagonal d away, the sphere has bent away by at most d²/2 / (R cos³), with cos at that end.
    far_end = np.sqrt(1 - np.minimum(np.sqrt(1 - cosines**2) + np.sqrt(0.5) * width / scene.radius, 1) ** 2)
    flat = (cosines > 0) & (0.25 * width <= PIXELS_OF_SLACK * scene.radius * far_end**3)
    assert flat.mean() > 0.2
    assert seen[flat].all()
    # The mesh has corners where the sphere has none: 0.6° from one triangle to the next.
    assert not seen[cosines < -0.01].any()


def slit(centre, width, far):
    """Return depth of a wall at ``far`` behind a plane with a slit, centre and width in pixels."""
    columns = np.abs(np.arange(CAMERA.width) - centre) < width / 2
    return np.where(columns, far, NEAR)[None].repeat(CAMERA.height, axis=0).astype(np.float32)


def in_slit(centre, width, far):
    rng = np.random.default_rng(1)
    u = centre + width * rng.uniform(-0.49, 0.49, 500)
    return points_at(u, anywhere(rng, 500)[1], np.full(500, far))


@pytest.mark.parametrize("far", [1.02, 1.5])
def test_a_wall_is_observed_through_a_slit_that_a_pixels_ray_enters(device, far):
    # It lies between the centres of two columns, around one, or around two.
    for centre, width, expected in ((COLUMN + 0.5, 0.8, False), (COLUMN, 0.8, True), (COLUMN + 0.5, 1.9, True)):
        wall = in_slit(centre, width, far)
        assert (observed(wall, FACING, slit(centre, width, far), device) == expected).all()


def test_what_is_hidden_is_not_observed_from_half_a_pixels_width_on(device):
    depth = slit(COLUMN, 0, NEAR)
    u, v = anywhere(np.random.default_rng(2))
    for pixels, expected in ((0.4, True), (0.6, False), (1.5, False)):
        far = NEAR * (1 + pixels / min(CAMERA.fx, CAMERA.fy))
        assert (observed(points_at(u, v, np.full(len(u), far)), FACING, depth, device) == expected).all()


def test_what_the_truth_hides_is_not_observed_however_well_it_fits(device):
    # A plane that touches what the camera sees tells nothing of what lies in it behind something else.
    depth = slit(COLUMN, 0, NEAR)
    u, v = anywhere(np.random.default_rng(3))
    points = points_at(u, v, np.full(len(u), NEAR))
    for z, expected in ((0.999, False), (1.001, True)):
        screen = Mesh(
            vertices=np.array([[-5, -5, z], [5, -5, z], [5, 5, z], [-5, 5, z]], np.float32),
            triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        )
        assert (observed(points, FACING, depth, device, truth=screen) == expected).all()


def test_only_the_pixels_own_square_is_observed(device):
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    depth[60, COLUMN] = NEAR
    u, v = np.meshgrid(np.linspace(COLUMN - 1, COLUMN + 1, 101), np.linspace(59, 61, 101))
    inside = (np.abs(u - COLUMN) < 0.499) & (np.abs(v - 60) < 0.499)
    outside = (np.abs(u - COLUMN) > 0.501) | (np.abs(v - 60) > 0.501)
    points = points_at(u.ravel(), v.ravel(), np.full(u.size, NEAR)).reshape(*u.shape, 3)
    assert observed(points[inside], FACING, depth, device).all()
    assert not observed(points[outside], FACING, depth, device).any()


def test_what_storing_rounds_away_hides_nothing(device):
    step = 0.02  # six pixels' widths
    z = 1.0 + np.linspace(0, 0.4, rays(CAMERA).shape[1])[None].repeat(CAMERA.height, axis=0)
    steps = np.rint(z / step).astype(np.uint16)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].reshape(2, -1)
    points = points_at(u, v, z.ravel())
    assert observed(points, FACING, steps, device, depth_scale=step).all()
