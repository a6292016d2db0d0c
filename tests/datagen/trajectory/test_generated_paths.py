import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import chi2, kstest

from datagen.errors import InputError
from datagen.rigid import inverse, rotation_angle_deg, transform_points
from datagen.scene_spec.trajectory_settings import HemisphereTrajectory, OrbitTrajectory, ShellTrajectory
from datagen.trajectory.camera_path import camera_path
from datagen.trajectory.generated_paths import spacing

CENTER = (0.3, -0.2, 0.5)


def path_of(settings, frames, seed=0):
    return camera_path(settings, frames, 30.0, seed)


def from_centre(path):
    return path[:, :3, 3] - CENTER


def test_an_orbit_keeps_its_radius_and_elevation_and_sees_its_centre_in_the_middle():
    path = path_of(OrbitTrajectory(type="orbit", center=CENTER, radius=2.0, elevation_deg=25.0, turns=1.5), 70)
    np.testing.assert_allclose(np.linalg.norm(from_centre(path), axis=1), 2, rtol=1e-14)
    np.testing.assert_allclose(from_centre(path)[:, 2], 2 * np.sin(np.radians(25)), rtol=1e-14)
    for world_from_camera in path:
        np.testing.assert_allclose(
            transform_points(inverse(world_from_camera), np.array(CENTER)), [0, 0, 2], atol=1e-14
        )
        assert world_from_camera[2, 1] < 0  # upright
        assert np.linalg.det(world_from_camera[:3, :3]) == pytest.approx(1)


def test_an_orbit_of_whole_turns_ends_where_it_began_and_goes_in_equal_steps():
    for turns in (1.0, 2.0, 3.0):
        path = path_of(OrbitTrajectory(type="orbit", center=CENTER, radius=1.0, turns=turns), 100)
        np.testing.assert_allclose(path[-1], path[0], atol=1e-13)
        azimuth = np.unwrap(np.arctan2(*from_centre(path)[:, 1::-1].T))
        np.testing.assert_allclose(np.diff(azimuth), 2 * np.pi * turns / 99, rtol=1e-9)


def test_an_orbit_begins_at_its_angle_and_runs_in_its_direction():
    for direction, sign in (("counter-clockwise", 1), ("clockwise", -1)):
        settings = OrbitTrajectory(
            type="orbit", radius=1.0, elevation_deg=0.0, start_angle_deg=30.0, turns=0.25, direction=direction
        )
        path = path_of(settings, 2)
        angles = np.degrees(np.arctan2(path[:, 1, 3], path[:, 0, 3]))
        np.testing.assert_allclose(angles, [30, 30 + sign * 90], atol=1e-12)


def test_an_orbit_straight_above_what_it_looks_at_is_refused():
    settings = OrbitTrajectory(
        type="orbit", radius=1.0, elevation_deg=0.0, start_angle_deg=0.0, look_at=(1.0, 0.0, 5.0)
    )
    with pytest.raises(InputError, match=r"in frame 0 the camera.*straight above or below"):
        path_of(settings, 10)


@pytest.mark.parametrize("elevation_deg", [(0.0, 90.0), (-30.0, 60.0), (85.0, 10.0)])
@pytest.mark.parametrize("frames", [60, 500])
def test_a_hemisphere_is_covered_without_gaps(elevation_deg, frames):
    """Frames lie on rows at most a spacing s apart, a step of at most s from each other.

    Between rows no cap wider than half the diagonal of a square of side s is empty. The first and last rows rise
    within one turn from the rim to s above it, so that there a rectangle of s by s/2 has no frame: √5/2 · s.
    """
    settings = HemisphereTrajectory(type="hemisphere", radius=1.0, elevation_deg=elevation_deg)
    frames_on_sphere = path_of(settings, frames)[:, :3, 3]
    low, high = np.radians(sorted(elevation_deg))
    random = np.random.default_rng(0)
    height, azimuth = random.uniform(np.sin(low), np.sin(high), 50_000), random.uniform(0, 2 * np.pi, 50_000)
    across = np.sqrt(1 - height**2)
    points = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), height])
    empty = 2 * np.arcsin(cKDTree(frames_on_sphere).query(points)[0] / 2)
    step = spacing(settings, frames)
    assert step == pytest.approx(np.sqrt(2 * np.pi * (np.sin(high) - np.sin(low)) / frames))
    assert empty.max() < np.sqrt(5) / 2 * step
    inner = (np.arcsin(height) > low + step) & (np.arcsin(height) < high - step)
    # Rows bend: the flat bound holds to a little more than a hundredth.
    assert empty[inner].max() < 1.015 * step / np.sqrt(2)


def test_a_hemisphere_is_one_continuous_motion_and_each_frame_stands_for_the_same_area():
    settings = HemisphereTrajectory(type="hemisphere", center=CENTER, radius=2.0)
    path = path_of(settings, 400)
    moved = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    assert moved.max() < 1.01 * 2 * spacing(settings, 400)
    assert moved.min() > 0.85 * moved.max()
    np.testing.assert_allclose(np.diff(from_centre(path)[:, 2]), 2 / 400, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(from_centre(path), axis=1), 2, rtol=1e-14)


def test_the_turns_of_a_hemisphere_can_be_given():
    settings = HemisphereTrajectory(type="hemisphere", radius=1.0, elevation_deg=(10.0, 70.0), turns=3.0)
    azimuth = np.unwrap(np.arctan2(*path_of(settings, 600)[:, 1::-1, 3].T))
    assert np.ptp(azimuth) == pytest.approx(3 * 2 * np.pi, rel=0.01)


SHELL = {"type": "shell", "center": CENTER, "radius": (1.0, 1.5)}


def test_random_views_are_uniform_over_the_directions_and_within_their_radii():
    views = from_centre(path_of(ShellTrajectory(**SHELL), 4000, seed=5))
    radii = np.linalg.norm(views, axis=1)
    assert radii.min() >= 1
    assert radii.max() <= 1.5
    assert kstest((radii - 1) / 0.5, "uniform").pvalue > 0.01
    # 6 × 8 cells of equal area by Archimedes' theorem.
    height, azimuth = views[:, 2] / radii, np.arctan2(views[:, 1], views[:, 0])
    counts, _, _ = np.histogram2d(height, azimuth, bins=[6, 8], range=[[-1, 1], [-np.pi, np.pi]])
    statistic = ((counts - 4000 / 48) ** 2 / (4000 / 48)).sum()
    assert chi2.ppf(0.005, 47) < statistic < chi2.ppf(0.995, 47)


def test_random_views_keep_to_their_belt():
    settings = ShellTrajectory(**SHELL, elevation_deg=(20.0, 70.0))
    views = from_centre(path_of(settings, 500))
    elevation = np.degrees(np.arcsin(views[:, 2] / np.linalg.norm(views, axis=1)))
    assert 20 <= elevation.min() < 21
    assert 68 < elevation.max() <= 70


def test_random_views_look_at_a_ball_around_their_target_and_roll_both_ways():
    steady = path_of(ShellTrajectory(**SHELL), 800)
    for world_from_camera in steady[:20]:
        point = transform_points(inverse(world_from_camera), np.array(CENTER))
        np.testing.assert_allclose(point[:2], 0, atol=1e-12)
    jittered = path_of(ShellTrajectory(**SHELL, look_at_jitter=0.2), 800)
    np.testing.assert_array_equal(jittered[:, :3, 3], steady[:, :3, 3])
    # How far the axis of the view passes by the target.
    aside = np.linalg.norm(np.cross(jittered[:, :3, 2], np.array(CENTER) - jittered[:, :3, 3]), axis=1)
    assert 0.19 < aside.max() <= 0.2
    # In a uniform ball three fifths of the mean square distance are across any line: 2/3 · 3/5 · r².
    assert np.mean(aside**2) == pytest.approx(0.4 * 0.2**2, rel=0.1)
    rolled = path_of(ShellTrajectory(**SHELL, roll_deg=30.0), 800)
    angles = [rotation_angle_deg(inverse(a) @ b) for a, b in zip(steady, rolled, strict=True)]
    assert 29 < max(angles) <= 30
    assert np.mean(angles) == pytest.approx(15, rel=0.1)
    np.testing.assert_allclose(rolled[:, :3, 2], steady[:, :3, 2], atol=1e-12)
    up_to_the_right = np.count_nonzero(rolled[:, 2, 0] > 0)
    assert 300 < up_to_the_right < 500


def test_a_random_view_depends_on_its_seed_and_number_alone():
    settings = ShellTrajectory(**SHELL, look_at_jitter=0.1, roll_deg=10.0)
    np.testing.assert_array_equal(path_of(settings, 100)[:7], path_of(settings, 7))
    np.testing.assert_array_equal(path_of(settings, 7), path_of(settings, 7))
    assert not np.isclose(path_of(settings, 7, seed=1)[:, :3, 3], path_of(settings, 7)[:, :3, 3]).any()


@pytest.mark.parametrize(
    ("settings", "change", "complaint"),
    [
        (ShellTrajectory, {"radius": (2.0, 1.0)}, r"radius \[2.0, 1.0\] must be \[smallest, largest\]"),
        (ShellTrajectory, {"elevation_deg": (50.0, 40.0)}, "elevation_deg .*must be"),
        (ShellTrajectory, {"limits": {"max_speed": 1.0}}, "limits have no meaning for random views"),
        (HemisphereTrajectory, {"elevation_deg": (50.0, 50.0)}, "two elevations"),
        (OrbitTrajectory, {"elevation_deg": 90.0}, "less than 90"),
    ],
)
def test_wrong_settings_are_named(settings, change, complaint):
    kind = {ShellTrajectory: SHELL}.get(
        settings, {"type": settings.__name__.removesuffix("Trajectory").lower(), "radius": 1.0}
    )
    with pytest.raises(ValueError, match=complaint):
        settings(**{**kind, **change})
