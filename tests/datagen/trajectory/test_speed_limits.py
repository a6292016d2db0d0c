import numpy as np
import pytest

from datagen.errors import InputError
from datagen.scene_spec.trajectory_settings import (
    BlendCameraTrajectory,
    HemisphereTrajectory,
    OrbitTrajectory,
    SpeedLimits,
)
from datagen.trajectory.camera_path import camera_path
from datagen.trajectory.frame_ranges import frame_ranges
from datagen.trajectory.speed_limits import exceeded, require_within_limits, speeds


def walk(steps, turns_deg=None):
    """Return a path along x by ``steps``, turning about z by ``turns_deg``."""
    path = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    path[1:, 0, 3] = np.cumsum(steps)
    angles = np.radians(np.append(0, np.cumsum(turns_deg if turns_deg is not None else np.zeros(len(steps)))))
    path[:, 0, 0] = path[:, 1, 1] = np.cos(angles)
    path[:, 1, 0] = np.sin(angles)
    path[:, 0, 1] = -path[:, 1, 0]
    return path


def test_speeds_are_those_of_the_circle():
    path = camera_path(OrbitTrajectory(type="orbit", radius=2.0, elevation_deg=0.0), 361, 10.0, 0)
    moved, turned = speeds(path, 10.0)
    np.testing.assert_allclose(turned[1:], 10, rtol=1e-9)
    np.testing.assert_allclose(moved[1:], 10 * 2 * 2 * np.sin(np.pi / 360), rtol=1e-9)
    assert moved[0] == turned[0] == 0


def test_exactly_the_frames_that_were_made_too_fast_are_found():
    steps, turns = np.full(200, 0.1), np.full(200, 2.0)
    fast, turning = [5, 6, 7, 40, 199], [0, 100, 101]
    steps[fast] = 0.11
    steps[40] = 0.25
    turns[turning] = -2.2
    found = exceeded(walk(steps, turns), SpeedLimits(max_speed=1.0, max_turn_deg=20.0), 10.0)
    assert [excess.key for excess in found] == ["max_speed", "max_turn_deg"]
    assert found[0].frames == tuple(i + 1 for i in fast)
    assert found[1].frames == tuple(i + 1 for i in turning)
    assert found[0].fastest == pytest.approx(2.5)
    assert found[1].fastest == pytest.approx(22)


def test_at_the_limit_nothing_is_too_fast():
    path = walk(np.full(20, 0.1), np.full(20, 2.0))
    assert exceeded(path, SpeedLimits(max_speed=1.0, max_turn_deg=20.0), 10.0) == []
    assert len(exceeded(path, SpeedLimits(max_speed=0.999), 10.0)[0].frames) == 20


def test_a_path_that_is_too_fast_is_refused_with_as_many_frames_as_it_needs():
    limits = SpeedLimits(max_speed=0.5, max_turn_deg=60.0)
    for settings in (
        OrbitTrajectory(type="orbit", radius=1.0, turns=2.0, limits=limits),
        HemisphereTrajectory(type="hemisphere", radius=1.0, elevation_deg=(0.0, 60.0), turns=3.0, limits=limits),
    ):
        path = camera_path(settings, 60, 30.0, 0)
        with pytest.raises(InputError, match=r"frames 1–59: the camera moves at up to .*render \d+ frames") as refusal:
            require_within_limits(settings, path, frames_per_second=30.0, seed=0)
        needed = int(str(refusal.value).split("render ")[1].split(" ")[0])
        enough = camera_path(settings, needed, 30.0, 0)
        require_within_limits(settings, enough, frames_per_second=30.0, seed=0)
        assert exceeded(camera_path(settings, int(needed * 0.97), 30.0, 0), limits, 30.0)


def test_where_more_frames_do_not_help_they_are_not_advised():
    shaking = OrbitTrajectory(
        type="orbit", radius=1.0, shake={"position": 0.1, "frequency_hz": (1.0, 4.0)}, limits={"max_speed": 0.01}
    )
    with pytest.raises(InputError, match="calm the path or raise the limits"):
        require_within_limits(shaking, camera_path(shaking, 60, 30.0, 0), frames_per_second=30.0, seed=0)


def test_the_motion_of_a_blend_slows_down_with_its_frames():
    settings = BlendCameraTrajectory(type="blend-camera", limits=SpeedLimits(max_speed=1.0))
    with pytest.raises(
        InputError, match=r"frames 1–4: .*4 times trajectory.limits.max_speed \(1 m/s\); render 17 frames"
    ):
        require_within_limits(settings, walk([0.4] * 4), frames_per_second=10.0, seed=0)


def test_without_limits_every_speed_is_allowed():
    settings = OrbitTrajectory(type="orbit", radius=1000.0)
    require_within_limits(settings, camera_path(settings, 2, 30.0, 0), frames_per_second=30.0, seed=0)
    with pytest.raises(ValueError, match="give max_speed, max_turn_deg or both"):
        SpeedLimits()


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([3], "frame 3"),
        ([3, 4], "frames 3–4"),
        ([12, 13, 14, 40], "frames 12–14 and 40"),
        ([0, 2, 3, 9], "frames 0, 2–3 and 9"),
        ([*range(0, 24, 2), 23], "frames 0, 2, 4, 6, 8, 10, 12, 14, 16, 18 and 3 more"),
    ],
)
def test_frames_are_named_in_ranges(frames, words):
    assert frame_ranges(frames) == words
