"""A wavy, speckled wall, seen by rays against it; speckles are fixed to the wall, so features are too."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, look_at, rotation_angle_deg
from fusion.devices import resolve_device
from fusion.pose.epipolar import FEATURES, EpipolarOptions, ReferenceFrame, rectify
from fusion.pose.pose_model import prepare_model
from fusion.pose.query import Query
from fusion.pose.shape_volume import volume_from_distances

CAMERA = PinholeCamera(width=320, height=240, fx=300.0, fy=305.0, cx=158.7, cy=121.2)
WAVE = 0.05
TEXTURE = gaussian_filter(np.random.default_rng(5).standard_normal((1200, 1200)), 4.0)
POSES = [look_at((x, y, -1.1), (0.3 * x, 0.02, 0), up=(0, -1, 0)) for x, y in ((0.0, 0.0), (0.12, 0.04), (-0.1, -0.06))]


def height_at(x, y):
    return WAVE * np.sin(5 * x) * np.cos(4 * y)


def see(pose, *, textured=True):
    """Return colour and planar depth of the wall z = height_at(x, y)."""
    rays = CAMERA.back_project(np.ones((CAMERA.height, CAMERA.width))) @ pose[:3, :3].T
    depth = -pose[2, 3] / rays[..., 2]
    for _ in range(60):  # contracts: the wall's slope is under a third
        points = pose[:3, 3] + rays * depth[..., None]
        depth = (height_at(points[..., 0], points[..., 1]) - pose[2, 3]) / rays[..., 2]
    points = pose[:3, 3] + rays * depth[..., None]
    grey = map_coordinates(TEXTURE, [600 + 600 * points[..., 1], 600 + 600 * points[..., 0]], order=1, mode="reflect")
    shade = np.clip(127 + 900 * grey * textured, 0, 255).astype(np.uint8)
    return np.repeat(shade[..., None], 3, axis=2), depth.astype(np.float32)


@lru_cache(maxsize=2)
def _relief(device_name):
    side = np.linspace(-0.8, 0.8, 320)
    x, y = (a.ravel() for a in np.meshgrid(side, side))
    surface = np.stack([x, y, height_at(x, y)], axis=-1)
    # Across a surface that is nearly flat the height over it is nearly the distance.
    volume = volume_from_distances(
        lambda p: height_at(p[:, 0], p[:, 1]) - p[:, 2],
        surface,
        voxel_size=0.01,
        device=resolve_device(device_name),
    )
    return prepare_model(volume)


@pytest.fixture
def model(device):
    return _relief(device.alias)


def references():
    seen = [(*see(pose), pose) for pose in POSES[1:]]
    return [ReferenceFrame(camera=CAMERA, color=c, depth=d, world_from_camera=pose) for c, d, pose in seen]


def errors(found, truth):
    return rotation_angle_deg(inverse(found) @ truth), np.linalg.norm(found[:3, 3] - truth[:3, 3])


@pytest.mark.parametrize("features", FEATURES)
def test_texture_locates_the_view_with_its_scale(model, features):
    color, _depth = see(POSES[0])
    query = Query(camera=CAMERA, color=color)
    found = rectify(model, query, references(), POSES[1], options=EpipolarOptions(features=features))
    assert not found.declined, found.reason
    angle, distance = errors(found.world_from_camera, POSES[0])
    assert found.used >= 16
    # A pixel is 0.19°, or 3.7 mm at 1.1 m. ORB finds corners at whole pixels of a pyramid: a part of one is left.
    assert angle < (0.1 if features == "sift" else 0.19)
    assert distance < (0.0037 / 2 if features == "sift" else 0.0037)
    # Matches err each for itself as the covariance says, and all alike by what interpolation does to them, a twentieth
    # of a pixel; 22.5 is what chi squared with six degrees of freedom exceeds once in a thousand.
    known = found.uncertainty
    middle = np.eye(4)
    middle[:3, 3] = known.pivot_world
    moved = inverse(middle) @ POSES[0] @ inverse(found.world_from_camera) @ middle
    off = np.concatenate([moved[:3, 3], [moved[2, 1], moved[0, 2], moved[1, 0]]])
    alike = np.diag(np.repeat((0.05 * 0.0037, 0.05 * np.radians(0.19)), 3) ** 2)
    assert off @ np.linalg.solve(known.covariance + alike, off) < 22.5


def test_matches_that_no_motion_explains_are_left_out(model):
    color, _depth = see(POSES[0])
    color[60:180, 100:140] = color[60:180, 140:180][:, ::-1].copy()  # what is pasted elsewhere has false matches
    found = rectify(model, Query(camera=CAMERA, color=color), references(), POSES[1])
    angle, distance = errors(found.world_from_camera, POSES[0])
    assert angle < 0.15
    assert distance < 0.003


def test_points_off_the_model_are_left_out(model):
    moved = [
        ReferenceFrame(camera=CAMERA, color=r.color, depth=r.depth * 0.8, world_from_camera=r.world_from_camera)
        for r in references()
    ]
    found = rectify(model, Query(camera=CAMERA, color=see(POSES[0])[0]), moved, POSES[1])
    assert found.declined
    assert "have depth" in found.reason


def test_without_texture_or_colour_it_declines_and_hands_the_pose_on(model):
    plain = Query(camera=CAMERA, color=see(POSES[0], textured=False)[0])
    found = rectify(model, plain, references(), POSES[1])
    assert found.declined
    assert "too little texture" in found.reason
    np.testing.assert_allclose(found.world_from_camera, POSES[1], atol=1e-15)
    assert "no colour" in rectify(model, Query(camera=CAMERA), references(), POSES[1]).reason
    assert rectify(model, Query(camera=CAMERA, color=see(POSES[0])[0]), [], POSES[1]).declined


def test_the_same_images_give_the_same_pose(model):
    query = Query(camera=CAMERA, color=see(POSES[0])[0])
    once, again = (rectify(model, query, references(), POSES[1]).world_from_camera for _ in range(2))
    np.testing.assert_array_equal(once, again)
