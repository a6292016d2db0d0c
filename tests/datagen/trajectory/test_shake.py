import numpy as np
import pytest
from scipy.signal import get_window
from scipy.spatial.transform import Rotation

from datagen.errors import InputError
from datagen.rigid import inverse
from datagen.scene_spec.trajectory_settings import OrbitTrajectory, ShakeSettings
from datagen.trajectory.camera_path import camera_path
from datagen.trajectory.shake import band_limited_noise

FPS = 30.0
ORBIT = OrbitTrajectory(type="orbit", radius=2.0)


def shake_of(shake, frames, *, fps=FPS, seed=0):
    """Return position (N, 3) and rotation vector (N, 3) of the shaken camera in the steady one's axes."""
    steady = camera_path(ORBIT, frames, fps, seed)
    shaken = camera_path(ORBIT.model_copy(update={"shake": shake}), frames, fps, seed)
    difference = np.array([inverse(a) @ b for a, b in zip(steady, shaken, strict=True)])
    return difference[:, :3, 3], Rotation.from_matrix(difference[:, :3, :3]).as_rotvec()


def test_the_root_mean_square_of_shake_is_its_amplitude_on_every_axis():
    moved, turned = shake_of(ShakeSettings(position=0.02, rotation_deg=1.5, frequency_hz=(0.5, 5.0)), 9000)
    np.testing.assert_allclose(np.sqrt(np.mean(moved**2, axis=0)), 0.02, rtol=0.02)
    np.testing.assert_allclose(np.degrees(np.sqrt(np.mean(turned**2, axis=0))), 1.5, rtol=0.02)


def test_shake_has_no_frequency_outside_its_band_and_all_parts_of_it_inside():
    count = 6000
    noise = band_limited_noise(np.arange(count) / FPS, (1.0, 4.0), components=3, seed=7)
    # A Blackman-Harris window leaks less than 1e-9 of the power beyond 4 bins.
    power = np.abs(np.fft.rfft(noise * get_window("blackmanharris", count)[:, None], axis=0)) ** 2
    frequency, bin_width = np.fft.rfftfreq(count, 1 / FPS), FPS / count
    outside = (frequency < 1 - 4 * bin_width) | (frequency > 4 + 4 * bin_width)
    assert (power[outside].sum(axis=0) < 1e-8 * power.sum(axis=0)).all()
    for low in np.arange(1.0, 4.0, 0.5):
        part = power[(frequency >= low) & (frequency < low + 0.5)].sum(axis=0) / power.sum(axis=0)
        np.testing.assert_allclose(part, 1 / 6, rtol=0.25)


def test_shake_of_no_amplitude_leaves_the_path_as_it_is():
    none = ShakeSettings(position=0.0, rotation_deg=0.0)
    steady = camera_path(ORBIT, 40, FPS, 3)
    np.testing.assert_array_equal(camera_path(ORBIT.model_copy(update={"shake": none}), 40, FPS, 3), steady)


def test_a_shaken_camera_is_a_rigid_one():
    path = camera_path(ORBIT.model_copy(update={"shake": ShakeSettings(rotation_deg=10.0)}), 40, FPS, 3)
    products = path[:, :3, :3].transpose(0, 2, 1) @ path[:, :3, :3]
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-14)


def test_shake_is_a_function_of_time_and_seed_whatever_the_frames():
    shake = ShakeSettings()
    short, long = shake_of(shake, 50), shake_of(shake, 200)
    twice_as_often = shake_of(shake, 100, fps=2 * FPS)
    for a, b, c in zip(short, long, twice_as_often, strict=True):
        np.testing.assert_allclose(a, b[:50], atol=1e-14)
        np.testing.assert_allclose(a, c[::2], atol=1e-14)
    other = shake_of(shake, 50, seed=1)
    assert abs(np.corrcoef(short[0].ravel(), other[0].ravel())[0, 1]) < 0.5
    axes = np.corrcoef(band_limited_noise(np.arange(6000) / FPS, (0.5, 4.0), components=6, seed=0).T)
    assert np.abs(axes - np.eye(6)).max() < 0.1


def test_shake_faster_than_the_frames_show_is_refused():
    shake = ShakeSettings(frequency_hz=(1.0, 8.0))
    with pytest.raises(InputError, match="reaches 8 Hz, but 12 frames a second show at most 6 Hz"):
        camera_path(ORBIT.model_copy(update={"shake": shake}), 10, 12.0, 0)
    with pytest.raises(ValueError, match=r"frequency_hz \[3.0, 2.0\] must be \[lowest, highest\]"):
        ShakeSettings(frequency_hz=(3.0, 2.0))
