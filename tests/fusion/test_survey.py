import numpy as np
import pytest
from synthetic_scene import CAMERA, SphereScene

from datagen.errors import InputError
from datagen.rigid import transform_points
from fusion.survey import combine, survey_frame


def survey_of(frame):
    return survey_frame(CAMERA, frame.depth, frame.world_from_camera)


def test_bounds_hold_every_observed_point_and_little_more():
    frames = SphereScene(wall_z=-0.4).frames_around(5)
    points = np.concatenate(
        [transform_points(f.world_from_camera, CAMERA.back_project(f.depth)[f.depth > 0]) for f in frames]
    )
    bounds = combine([survey_of(frame) for frame in frames], CAMERA)
    assert (bounds.low <= points.min(0)).all()
    assert (bounds.high >= points.max(0)).all()
    assert (np.ptp([bounds.low, bounds.high], axis=0) <= 1.1 * np.ptp(points, axis=0) + 0.1).all()


def test_the_area_of_a_plane_that_faces_the_camera_is_exact():
    depth = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    expected = (2.0 * CAMERA.width / CAMERA.fx) * (2.0 * CAMERA.height / CAMERA.fy)
    assert survey_frame(CAMERA, depth, np.eye(4)).surface_area == pytest.approx(expected)


def test_a_stray_depth_does_not_change_the_scale():
    frames = SphereScene().frames_around(12)
    clean = combine([survey_of(frame) for frame in frames], CAMERA)
    frames[3].depth[5, 5] = 50.0
    spoilt = combine([survey_of(frame) for frame in frames], CAMERA)
    assert np.ptp([spoilt.low, spoilt.high], axis=0).max() > 10
    assert spoilt.typical_extent == pytest.approx(clean.typical_extent, rel=0.2)


def test_frames_without_a_valid_depth_are_an_error():
    empty = survey_frame(CAMERA, np.zeros((CAMERA.height, CAMERA.width), np.float32), np.eye(4))
    with pytest.raises(InputError, match="none of the 2 chosen frames has a valid depth"):
        combine([empty, empty], CAMERA)
