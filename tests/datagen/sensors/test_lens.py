import cv2
import numpy as np
import pytest

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.scene_spec.lens_settings import LensSettings
from datagen.sensors.lens import distort, fold_radius, lens_map, undistort

CAMERA = PinholeCamera(width=320, height=240, fx=262.0, fy=265.0, cx=161.3, cy=117.8)
LENSES = {
    "barrel": LensSettings(k1=-0.28, k2=0.09, p1=0.0012, p2=-0.0009, k3=-0.012),
    "pincushion": LensSettings(k1=0.15, k2=0.03, p1=-0.0008, p2=0.001),
    "moustache": LensSettings(k1=-0.2, k2=0.15),
    "rational": LensSettings(k1=0.3, k2=-0.05, k3=0.01, k4=0.6, k5=0.02, k6=0.03, p1=0.0005, p2=0.0005),
}


def opencv_coefficients(lens):
    return np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6])


def points(count=2000):
    return np.random.default_rng(0).uniform(-0.6, 0.6, (count, 2))


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_points_appear_where_opencv_projects_them(lens):
    in_space = np.column_stack([points(), np.ones(len(points()))])
    expected, _ = cv2.projectPoints(in_space, np.zeros(3), np.zeros(3), np.eye(3), opencv_coefficients(lens))
    np.testing.assert_allclose(distort(points(), lens), expected[:, 0], atol=1e-14)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistorting_agrees_with_opencv_and_is_the_inverse(lens):
    appearing = distort(points(), lens)
    found = undistort(appearing, lens)
    np.testing.assert_allclose(found, points(), atol=1e-12)
    many = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    theirs = cv2.undistortPointsIter(appearing[:, None], np.eye(3), opencv_coefficients(lens), None, None, many)
    np.testing.assert_allclose(found, theirs[:, 0], atol=1e-8)


def test_a_lens_that_folds_shows_the_nearer_point_and_nothing_beyond():
    lens = LensSettings(k1=-0.6)
    radius = fold_radius(lens)
    assert radius == pytest.approx(np.sqrt(1 / 1.8))  # d(r − 0.6 r³)/dr = 0
    reach = float(distort(np.array([radius, 0.0]), lens)[0])
    within, beyond = undistort(np.array([[0.99 * reach, 0.0], [1.01 * reach, 0.0]]), lens)
    assert 0 < within[0] < radius
    assert np.isnan(beyond).all()


def test_a_plain_lens_never_folds():
    assert fold_radius(LensSettings(k1=0.1)) == np.inf


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_covering_leaves_no_pixel_empty_and_wastes_nothing(lens):
    covering = lens_map(CAMERA, lens.model_copy(update={"magnification": "cover"}))
    assert covering.inside.all()
    magnification = covering.camera.fx / CAMERA.fx
    assert covering.camera.fy / CAMERA.fy == pytest.approx(magnification)
    less = lens_map(CAMERA, lens.model_copy(update={"magnification": 0.999 * magnification}))
    assert not less.inside.all()


def test_barrel_distortion_looks_past_the_rendered_image_and_pincushion_does_not():
    barrel, pincushion = lens_map(CAMERA, LENSES["barrel"]), lens_map(CAMERA, LENSES["pincushion"])
    assert not barrel.inside[0, 0]
    assert barrel.inside[120, 160]
    assert pincushion.inside.all()


def test_without_coefficients_every_pixel_is_itself():
    same = lens_map(CAMERA, LensSettings())
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    np.testing.assert_allclose(same.u, u, atol=1e-4)
    np.testing.assert_allclose(same.v, v, atol=1e-4)
    assert same.inside.all()


def test_a_lens_that_cannot_be_covered_is_refused():
    with pytest.raises(InputError, match="lens: no magnification"):
        lens_map(CAMERA, LensSettings(k1=-5000.0, magnification="cover"))
