import numpy as np
import pytest
from synthetic_scene import CAMERA, DEPTH_SCALE, SphereScene

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import transform_points
from fusion.frames.survey import combine, survey_frame


def survey_of(frame):
    return survey_depth(frame.depth, frame.world_from_camera)


def survey_depth(depth, pose, camera=CAMERA):
    return survey_frame(camera, np.rint(depth / DEPTH_SCALE).astype(np.uint16), pose, depth_scale=DEPTH_SCALE)


def test_bounds_hold_every_observed_point_and_little_more():
    frames = SphereScene(wall_z=-0.4).frames_around(5)
    points = np.concatenate(
        [transform_points(f.world_from_camera, CAMERA.back_project(f.depth)[f.depth > 0]) for f in frames]
    )
    bounds = combine([survey_of(frame) for frame in frames], CAMERA)
    assert (bounds.low <= points.min(0)).all()
    assert (bounds.high >= points.max(0)).all()
    assert (np.ptp([bounds.low, bounds.high], axis=0) <= 1.1 * np.ptp(points, axis=0) + 0.1).all()


@pytest.mark.parametrize("size", [(160, 120), (157, 115)])
def test_bounds_are_those_of_the_tiles_corners(size):
    rng = np.random.default_rng(0)
    width, height = size
    camera = PinholeCamera(width=width, height=height, fx=170.0, fy=165.0, cx=81.3, cy=58.6)
    depth = np.where(rng.random((height, width)) < 0.02, rng.uniform(0.5, 6.0, (height, width)), 0)
    depth = DEPTH_SCALE * np.rint(depth / DEPTH_SCALE)
    pose = SphereScene().poses_around(7)[4]
    corners = []
    for v in range(0, height, 8):
        for u in range(0, width, 8):
            valid = depth[v : v + 8, u : u + 8][depth[v : v + 8, u : u + 8] > 0]
            for z in [valid.min(), valid.max()] if valid.size else []:
                for pixel in np.ndindex(2, 2):
                    x, y = np.minimum((u + 8 * pixel[0], v + 8 * pixel[1]), size) - 0.5
                    corners.append([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z])
    survey = survey_depth(depth, pose, camera)
    world = transform_points(pose, np.array(corners))
    np.testing.assert_allclose(survey.low, world.min(axis=0), rtol=1e-9)
    np.testing.assert_allclose(survey.high, world.max(axis=0), rtol=1e-9)
    assert survey.farthest == pytest.approx(depth.max())


def test_the_area_of_a_plane_that_faces_the_camera_is_exact():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    expected = (2.0 * CAMERA.width / CAMERA.fx) * (2.0 * CAMERA.height / CAMERA.fy)
    assert survey_depth(depth, np.eye(4)).surface_area == pytest.approx(expected)


def test_a_stray_depth_does_not_change_the_scale():
    frames = SphereScene().frames_around(12)
    clean = combine([survey_of(frame) for frame in frames], CAMERA)
    frames[3].depth[5, 5] = 6.5
    spoilt = combine([survey_of(frame) for frame in frames], CAMERA)
    assert np.ptp([spoilt.low, spoilt.high], axis=0).max() > 4
    assert spoilt.typical_extent == pytest.approx(clean.typical_extent, rel=0.2)


def test_frames_without_a_valid_depth_are_an_error():
    empty = survey_depth(np.zeros((CAMERA.height, CAMERA.width)), np.eye(4))
    with pytest.raises(InputError, match="none of the 2 chosen frames has a valid depth"):
        combine([empty, empty], CAMERA)
