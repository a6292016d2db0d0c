import math

import numpy as np
import pytest
from analytic_depth import CAMERA, step, tilted_plane

from datagen.camera import PinholeCamera
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.depth_sensors import SENSORS
from datagen.sensors.simulate_depth import sensor_generator, simulate_depth

MODELS = tuple(SENSORS)
NARROW = PinholeCamera(width=320, height=240, fx=2000.0, fy=2000.0, cx=159.5, cy=119.5)


def settings(model, **changes):
    everything_returns = {"grazing": False, "shadow": False, "edges": False, "nearest": 0.0, "farthest": 1000.0}
    return SensorSettings(model=model, **(everything_returns | changes))


def simulate(depth, wanted, *, frame=0, camera=CAMERA, seed=7):
    return simulate_depth(depth, camera, wanted, rng=sensor_generator(seed, frame))


def nguyen_sigma(z, theta):
    """Written down anew, in double precision."""
    extra = 0.0001 / np.sqrt(z) * theta**2 / (np.pi / 2 - theta) ** 2
    return 0.0012 + 0.0019 * (z - 0.4) ** 2 + np.where(theta >= np.pi / 3, extra, 0)


def d435_sigma(z, theta):
    return z**2 * 0.08 / (424 * 0.05)


@pytest.mark.parametrize(("model", "sigma"), [("kinect-v1", nguyen_sigma), ("realsense-d435", d435_sigma)])
@pytest.mark.parametrize("quantisation", [0.0, 1.0])
@pytest.mark.parametrize("tilt_deg", [10, 40, 55, 66, 80])
@pytest.mark.parametrize("distance", [0.7, 1.5, 3.0])
def test_noise_along_z_has_the_published_deviation_at_every_depth_and_angle(
    model, sigma, quantisation, tilt_deg, distance
):
    depth, theta = tilted_plane(NARROW, distance=distance, tilt_deg=tilt_deg)
    noisy = simulate(depth, settings(model, quantisation=quantisation), camera=NARROW)
    assert (noisy > 0).all()
    error = (noisy.astype(np.float64) - depth) / sigma(depth.astype(np.float64), theta)
    count = error.size
    assert abs(error.mean()) < 5 / math.sqrt(count) + 0.01  # rounding 1/z, not z, leans by 0.002 sigma
    assert error.std() == pytest.approx(1, abs=5 / math.sqrt(2 * count) + 0.003)


@pytest.mark.parametrize("multiplier", [0.5, 3.0])
def test_the_multiplier_scales_the_noise(multiplier):
    depth, _ = tilted_plane(NARROW, distance=1.5, tilt_deg=30)
    once = simulate(depth, settings("kinect-v1", quantisation=0), camera=NARROW) - depth
    scaled = simulate(depth, settings("kinect-v1", quantisation=0, axial=multiplier), camera=NARROW) - depth
    np.testing.assert_allclose(scaled, multiplier * once, atol=1e-6)


@pytest.mark.parametrize("lateral", [0.5, 1.0, 2.0])
def test_an_edge_moves_sideways_with_the_published_deviation(lateral):
    column, frames = 160, 40
    depth = step(CAMERA, near=1.0, far=2.0, column=column)
    wanted = settings("kinect-v1", axial=0, quantisation=0, lateral=lateral)
    near = np.stack([simulate(depth, wanted, frame=i) < 1.5 for i in range(frames)])
    assert set(np.unique(simulate(depth, wanted))) == {np.float32(1), np.float32(2)}
    sigma = 0.8 * lateral  # at the image's centre the angle adds nothing
    rows = slice(100, 140)
    for offset in range(-4, 4):
        beyond = offset + 0.5  # the edge lies between two pixels
        expected = 0.5 * math.erfc(beyond / sigma / math.sqrt(2))
        found = near[:, rows, column + offset].mean()
        # Rows next to each other move together, so that some five count as one.
        assert found == pytest.approx(expected, abs=5 * math.sqrt(expected * (1 - expected) / (frames * 8)) + 0.003)
    position = near[:, rows, column - 20 : column + 20].sum(axis=2)
    assert position.std() == pytest.approx(math.sqrt(sigma**2 + 1 / 12), rel=0.1)  # whole pixels


def test_steps_are_those_of_khoshelham():
    depth = np.linspace(0.6, 4.9, CAMERA.width * CAMERA.height, dtype=np.float32).reshape(CAMERA.height, -1)
    levels = np.unique(simulate(depth, settings("kinect-v1", axial=0, lateral=0))).astype(np.float64)
    steps = np.diff(levels) / (levels[1:] * levels[:-1])
    np.testing.assert_allclose(steps, 2.85e-3, rtol=1e-3)
    at_2m = np.diff(levels)[np.searchsorted(levels, 2.0)]
    assert at_2m == pytest.approx(2.85e-3 * 2.0**2, rel=0.02)


def test_the_stereo_cameras_steps_are_a_32nd_of_a_pixel_of_disparity():
    depth = np.linspace(0.6, 4.9, CAMERA.width * CAMERA.height, dtype=np.float32).reshape(CAMERA.height, -1)
    levels = np.unique(simulate(depth, settings("realsense-d435", axial=0, lateral=0))).astype(np.float64)
    np.testing.assert_allclose(np.diff(424 * 0.05 / levels), -1 / 32, rtol=1e-3)


def scene_depth():
    depth, _ = tilted_plane(CAMERA, distance=2.0, tilt_deg=35)
    depth[60:180, 120:200] = 1.0
    depth[:, :15] = 0
    depth[100:110, 150:160] = 0
    return depth


@pytest.mark.parametrize("model", MODELS)
def test_with_everything_off_depth_comes_back_bit_for_bit(model):
    off = settings(model, axial=0, lateral=0, quantisation=0)
    np.testing.assert_array_equal(simulate(scene_depth(), off), scene_depth())


@pytest.mark.parametrize("model", MODELS)
def test_invalid_stays_invalid_and_nothing_is_negative(model):
    noisy = simulate(scene_depth(), SensorSettings(model=model, axial=30, lateral=5))
    assert (noisy[scene_depth() == 0] == 0).all()
    assert np.isfinite(noisy).all()
    assert (noisy >= 0).all()


@pytest.mark.parametrize("model", MODELS)
def test_a_frames_noise_is_its_own_in_whatever_order(model):
    wanted = SensorSettings(model=model)
    forwards = [simulate(scene_depth(), wanted, frame=i) for i in range(4)]
    backwards = [simulate(scene_depth(), wanted, frame=i) for i in (3, 2, 1, 0)][::-1]
    np.testing.assert_array_equal(forwards, backwards)
    assert len({image.tobytes() for image in forwards}) == 4
    assert not np.array_equal(forwards[0], simulate(scene_depth(), wanted, frame=0, seed=8))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("effect", ["grazing", "shadow", "edges"])
def test_an_effect_that_is_turned_off_leaves_the_others_as_they_were(model, effect):
    with_all = simulate(scene_depth(), SensorSettings(model=model))
    without = simulate(scene_depth(), SensorSettings(model=model, **{effect: False}))
    returned = with_all > 0
    np.testing.assert_array_equal(without[returned], with_all[returned])
    assert effect == "grazing" or (without > 0).sum() > returned.sum()


def test_returns_end_at_the_range():
    depth, _ = tilted_plane(CAMERA, distance=2.5, tilt_deg=60)
    noisy = simulate(depth, SensorSettings(model="kinect-v1", nearest=1.5, farthest=3.5))
    returned = noisy[noisy > 0]
    assert returned.size > 1000
    assert returned.min() >= 1.5
    assert returned.max() <= 3.5
    assert (noisy[depth > 4] == 0).all()


def test_steep_surfaces_return_less_and_the_steepest_nothing():
    def returned(tilt_deg):
        depth, _ = tilted_plane(NARROW, distance=1.5, tilt_deg=tilt_deg)
        return (simulate(depth, SensorSettings(model="kinect-v1", shadow=False), camera=NARROW) > 0).mean()

    assert returned(30) == 1
    assert 0.3 < returned(77.5) < 0.7
    assert returned(89.4) < 0.01


def test_foreground_grows_over_background_in_stereo():
    depth = step(CAMERA, near=1.0, far=2.0, column=160)
    noisy = simulate(depth, settings("realsense-d435", axial=0, quantisation=0))
    grown = (noisy < 1.5).sum(axis=1) - 160
    assert grown.mean() == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize("model", MODELS)
def test_a_clean_image_of_one_pixel_or_without_depth_is_no_trouble(model):
    pixel = PinholeCamera(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
    assert simulate(np.ones((1, 1)), SensorSettings(model=model), camera=pixel).shape == (1, 1)
    assert not simulate(np.zeros((CAMERA.height, CAMERA.width)), SensorSettings(model=model)).any()
