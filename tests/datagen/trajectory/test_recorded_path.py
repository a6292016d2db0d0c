import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.errors import InputError
from datagen.rigid import inverse, rotation_angle_deg
from datagen.scene_spec.scene_files import read_scene
from datagen.scene_spec.trajectory_settings import RecordedTrajectory
from datagen.trajectory.camera_path import camera_path, scene_camera_path
from datagen.trajectory.pose_files import read_recording
from datagen.trajectory.recorded_path import interpolate_poses

TIMES = np.array([100.0, 100.4, 100.5, 101.2, 102.0])


@pytest.fixture
def poses():
    random = np.random.default_rng(0)
    result = np.tile(np.eye(4), (5, 1, 1))
    result[:, :3, :3] = Rotation.random(5, random_state=1).as_matrix()
    result[:, :3, 3] = random.uniform(-2, 2, (5, 3))
    return result


@pytest.fixture
def tum_file(tmp_path, poses):
    path = tmp_path / "groundtruth.txt"
    lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(TIMES, poses, strict=True):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(f"{time:.4f} " + " ".join(f"{number:.17g}" for number in numbers))
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def log_file(tmp_path, poses):
    path = tmp_path / "path.log"
    blocks = [
        f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(repr, row)) for row in pose.tolist())
        for i, pose in enumerate(poses)
    ]
    path.write_text("\n".join(blocks))
    return path


@pytest.fixture
def pose_folder(tmp_path, poses):
    folder = tmp_path / "dataset"
    (folder / "frames").mkdir(parents=True)
    for i, pose in enumerate(poses):
        np.savetxt(folder / "frames" / f"frame-{3 * i:06}.pose.txt", pose, fmt="%.17g")
    return folder


def recorded(file, frames, *, fps=30.0, **more):
    return camera_path(RecordedTrajectory(type="recorded", file=str(file), **more), frames, fps, 0)


def test_poses_come_out_of_every_kind_of_file_as_they_were_put_in(tum_file, log_file, pose_folder, poses):
    for path in (tum_file, log_file, pose_folder, pose_folder / "frames"):
        np.testing.assert_allclose(recorded(path, 5, timing="as-is"), poses, atol=1e-14)
        np.testing.assert_allclose(recorded(path, 3, timing="as-is"), poses[:3], atol=1e-14)


def test_evo_reads_the_same_poses_from_a_tum_file(tum_file):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    theirs = file_interface.read_tum_trajectory_file(str(tum_file))
    ours = read_recording(tum_file)
    np.testing.assert_allclose(ours.world_from_camera, np.stack(theirs.poses_se3), atol=1e-12)
    np.testing.assert_array_equal(ours.times, theirs.timestamps)


def test_at_its_own_times_a_recording_has_exactly_its_poses(tum_file):
    recording = read_recording(tum_file)
    np.testing.assert_array_equal(interpolate_poses(recording, recording.times), recording.world_from_camera)
    # 21 frames over 2 s: a frame each tenth of a second, and recorded poses at some of them.
    path = recorded(tum_file, 21)
    np.testing.assert_array_equal(path[[0, 4, 5, 12, 20]], recording.world_from_camera)


def test_between_two_poses_position_is_on_the_line_and_rotation_on_the_shortest_arc(tum_file):
    recording = read_recording(tum_file)
    for i in range(4):
        start, end = recording.world_from_camera[i : i + 2]
        parts = np.linspace(0, 1, 9)
        path = interpolate_poses(recording, TIMES[i] + parts * (TIMES[i + 1] - TIMES[i]))
        np.testing.assert_allclose(
            path[:, :3, 3], start[:3, 3] + parts[:, None] * (end[:3, 3] - start[:3, 3]), atol=1e-12
        )
        whole = rotation_angle_deg(inverse(start) @ end)
        for part, pose in zip(parts, path, strict=True):
            # Both angles add up to the whole one on the geodesic alone.
            assert rotation_angle_deg(inverse(start) @ pose) == pytest.approx(part * whole, abs=1e-9)
            assert rotation_angle_deg(inverse(pose) @ end) == pytest.approx((1 - part) * whole, abs=1e-9)


def test_real_time_keeps_the_recording_s_pace_and_ends_with_it(tum_file):
    recording = read_recording(tum_file)
    path = recorded(tum_file, 21, fps=10.0, timing="real-time")
    np.testing.assert_allclose(path, interpolate_poses(recording, 100 + np.arange(21) / 10), atol=1e-12)
    with pytest.raises(InputError, match=r"lasts 2 s, at 10 frames a second 21 frames, but 22 are asked for"):
        recorded(tum_file, 22, fps=10.0, timing="real-time")


def test_gaps_between_the_numbers_of_pose_files_are_gaps_in_time(pose_folder, poses):
    (pose_folder / "frames" / "frame-000003.pose.txt").unlink()
    path = recorded(pose_folder, 13)
    np.testing.assert_allclose(path[[0, 6, 9, 12]], poses[[0, 2, 3, 4]], atol=1e-14)
    np.testing.assert_allclose(path[3, :3, 3], (poses[0] + poses[2])[:3, 3] / 2, atol=1e-14)


def test_a_recording_is_scaled_turned_and_moved_into_the_scene(tum_file, poses):
    path = recorded(tum_file, 5, timing="as-is", scale=2.0, rotation_deg=(0.0, 0.0, 90.0), location=(1.0, 0.0, 0.0))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(path[:, :3, :3], quarter @ poses[:, :3, :3], atol=1e-14)
    np.testing.assert_allclose(path[:, :3, 3], 2 * poses[:, :3, 3] @ quarter.T + (1, 0, 0), atol=1e-14)


def test_a_single_pose_stands_still(tum_file, poses):
    tum_file.write_text(tum_file.read_text().splitlines()[2])
    np.testing.assert_allclose(recorded(tum_file, 4), np.tile(poses[0], (4, 1, 1)), atol=1e-14)


def test_more_frames_than_poses_and_times_that_are_not_there_are_refused(tum_file, log_file):
    with pytest.raises(InputError, match=r'has 5 poses, but 6 frames.*set trajectory.timing to "fit"'):
        recorded(tum_file, 6, timing="as-is")
    with pytest.raises(InputError, match=r"path.log: has no times"):
        recorded(log_file, 2, timing="real-time")


def test_an_unusable_file_is_named_with_its_line(tmp_path, tum_file, log_file, pose_folder):
    lines = tum_file.read_text().splitlines()
    for line, complaint in (
        (lines[2], r"line 4: time 100.000000 does not come after the line before, 100.000000"),
        ("101 0 0 0 0 0 0 0", r"line 4: the quaternion \[0.0, 0.0, 0.0, 0.0\] has length 0"),
        ("101 0 0 0 0 0 1", r"line 4: found 7 fields, expected 8: t tx ty tz qx qy qz qw"),
        ("101 0 0 nan 0 0 0 1", r"line 4: holds NaN"),
    ):
        tum_file.write_text("\n".join([*lines[:3], line]))
        with pytest.raises(InputError, match=f"groundtruth.txt, {complaint}"):
            read_recording(tum_file)
    log = log_file.read_text().splitlines()
    for text, complaint in (
        (log[:-1], "line 24: the file ends within a pose"),
        ([*log[:2], "0 1 0", *log[3:]], "line 3: found 3 fields, expected a row of a 4×4"),
        ([log[0], "2 0 0 0", "0 2 0 0", "0 0 2 0", "0 0 0 1"], "line 1: the pose is not rigid"),
    ):
        log_file.write_text("\n".join(text))
        with pytest.raises(InputError, match=f"path.log, {complaint}"):
            read_recording(log_file)
    (pose_folder / "frames" / "frame-000003.pose.txt").write_text("1 2 3")
    with pytest.raises(InputError, match=r"frame-000003.pose.txt: found 3 numbers, expected 16"):
        read_recording(pose_folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: holds no poses"):
        read_recording(tmp_path / "empty")
    with pytest.raises(InputError, match=r"nowhere.txt: the file is missing"):
        read_recording(tmp_path / "nowhere.txt")


SCENE = """
name = "test"
[materials.clay]
color = "#ff8000"
[[objects]]
name = "Ball"
shape = "sphere"
material = "clay"
[trajectory]
type = "recorded"
file = "FILE"
"""


@pytest.mark.parametrize("name", ["groundtruth.txt", "dataset"])
def test_a_recording_lies_beside_its_scene_file_and_is_known_by_its_content(tmp_path, tum_file, pose_folder, name):
    def read(folder, text):
        (folder / "scene.toml").write_text(text)
        return read_scene(folder / "scene.toml")

    scene = read(tmp_path, SCENE.replace("FILE", name))
    assert scene.trajectory.file == str(tmp_path / name)
    assert scene_camera_path(scene).shape == (60, 4, 4)
    (tmp_path / "elsewhere").mkdir()
    moved = read(tmp_path / "elsewhere", SCENE.replace("FILE", f"../{name}"))
    assert moved.trajectory.sha256 == scene.trajectory.sha256
    changed = tum_file if name == "groundtruth.txt" else pose_folder / "frames" / "frame-000003.pose.txt"
    changed.write_text(changed.read_text() + "\n")
    assert read(tmp_path, SCENE.replace("FILE", name)).trajectory.sha256 != scene.trajectory.sha256
    with pytest.raises(InputError, match=f"{name}: its SHA-256 is .*restore it, or drop the sha256"):
        read(tmp_path, SCENE.replace("FILE", name) + f'sha256 = "{scene.trajectory.sha256}"')
    with pytest.raises(InputError, match=r"nowhere.log: cannot be read .*name a recorded path"):
        read(tmp_path, SCENE.replace("FILE", "nowhere.log"))
