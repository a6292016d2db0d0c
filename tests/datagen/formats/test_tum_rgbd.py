import numpy as np
import pytest
from converted_datasets import convert
from oracles import oracle
from scipy.spatial.transform import Rotation

from datagen.dataset_writer import write_pose
from datagen.errors import InputError
from datagen.formats.tum_rgbd import associate
from datagen.images import write_color, write_depth
from datagen.open_dataset import open_dataset

POSES = "groundtruth.txt"


@pytest.fixture
def folder(converted):
    return converted("tum")


def write_recording(folder, *, colors_s, depths_s, poses_s, size=(640, 480), names="rgb/{:.3f}.png"):
    """Write a recording by hand: depth image i is 1 + i/10 m away everywhere, pose k stands at x = its time."""
    width, height = size
    (folder / "rgb.txt").parent.mkdir(parents=True, exist_ok=True)
    for name, times in (("rgb", colors_s), ("depth", depths_s)):
        lines = [f"{time:.6f} {name}/{time:.3f}.png\n" for time in times]
        (folder / f"{name}.txt").write_text("# comment\n" + "".join(lines))
    for i, time in enumerate(colors_s):
        write_color(folder / f"rgb/{time:.3f}.png", np.full((height, width, 3), i, np.uint8))
    for i, time in enumerate(depths_s):
        write_depth(folder / f"depth/{time:.3f}.png", np.full((height, width), 1 + i / 10), metres_per_step=1 / 5000)
    if poses_s is not None:
        (folder / POSES).write_text("".join(f"{time:.6f} {time} 0 0 0 0 0 1\n" for time in poses_s))
    return folder


def test_evo_reads_the_same_trajectory(source, folder):
    evo = oracle("evo.tools.file_interface")
    trajectory = evo.read_tum_trajectory_file(folder / POSES)
    np.testing.assert_allclose(trajectory.timestamps, [i / 24 for i in range(5)], atol=1e-12)
    for i, pose in enumerate(trajectory.poses_se3):
        np.testing.assert_allclose(pose, source.world_from_camera(i), atol=1e-12)


def test_a_trajectory_that_evo_wrote_is_read(source, folder):
    evo = oracle("evo.tools.file_interface")
    trajectory = evo.read_tum_trajectory_file(folder / POSES)
    (folder / POSES).unlink()
    evo.write_tum_trajectory_file(folder / POSES, trajectory)
    opened = open_dataset(folder)
    for i in range(5):
        np.testing.assert_allclose(opened.world_from_camera(i), source.world_from_camera(i), atol=1e-9)


def test_images_and_poses_belong_together_by_the_nearest_time_and_no_pose_is_made_up(tmp_path):
    folder = write_recording(
        tmp_path / "rgbd_dataset_freiburg3_test",
        colors_s=[10.000, 10.033, 10.066, 10.500],
        depths_s=[10.015, 10.040, 10.070, 10.900],
        poses_s=[9.9, 10.010, 10.018, 10.041, 10.095],
    )
    dataset = open_dataset(folder)
    assert dataset.frame_ids == (0, 1)  # the third pair's nearest pose is 25 ms away, the fourth colour has no depth
    assert [dataset.world_from_camera(i)[0, 3] for i in (0, 1)] == [10.018, 10.041]
    assert [dataset.timestamp_s(i) for i in (0, 1)] == [10.015, 10.040]
    assert [dataset.depth(i)[0, 0] for i in (0, 1)] == pytest.approx([1.0, 1.1], abs=1e-4)
    assert [int(dataset.color(i)[0, 0, 0]) for i in (0, 1)] == [0, 1]
    assert "2 of 4 colour images are left out: no depth image or pose within 0.02 s" in dataset.notes


def test_two_hundredths_of_a_second_are_the_limit_even_since_the_epoch():
    epoch = 1305031102.0
    first = epoch + np.array([0.0, 1.0])
    assert associate(first, epoch + np.array([0.02, 1.0201])) == [(0, 0)]


def test_the_closest_pair_goes_first_and_nobody_goes_twice():
    assert associate(np.array([0.0, 0.012]), np.array([0.010, 0.030])) == [(1, 0)]
    assert associate(np.array([0.0, 0.012]), np.array([0.010, 0.030, -0.019])[[2, 0, 1]]) == [(0, 0), (1, 1)]


@pytest.mark.parametrize(
    ("camera", "intrinsics"),
    [
        ("freiburg1", (517.306408, 516.469215, 318.643040, 255.313989)),
        ("freiburg2", (520.908620, 521.007327, 325.141442, 249.701764)),
        ("freiburg3", (535.4, 539.2, 320.1, 247.6)),
    ],
)
def test_the_published_recordings_cameras_are_known_by_the_folder(tmp_path, camera, intrinsics):
    times = [1.0, 1.1]
    folder = write_recording(tmp_path / f"rgbd_dataset_{camera}_xyz", colors_s=times, depths_s=times, poses_s=times)
    dataset = open_dataset(folder)
    found = dataset.camera
    assert (found.fx, found.fy, found.cx, found.cy) == intrinsics
    assert dataset.depth_scale == 1 / 5000
    assert ("distortion" in " ".join(dataset.notes)) == (camera != "freiburg3")


def test_a_camera_that_nobody_knows_is_asked_for(folder):
    (folder / "camera-intrinsics.txt").unlink()
    with pytest.raises(InputError, match=r"camera-intrinsics.txt: the file is missing.*write the 3×3 intrinsic matrix"):
        open_dataset(folder)


def test_a_recording_without_poses_opens_and_says_that_frames_lack_them(folder):
    (folder / POSES).unlink()
    dataset = open_dataset(folder)
    assert dataset.frame_ids == (0, 1, 2, 3, 4)
    assert dataset.has(0, "depth")
    assert not dataset.has(0, "pose")
    with pytest.raises(InputError, match=r"tum: frame 0 has no pose, and 5 of the 5 chosen frames lack one"):
        dataset.require(dataset.frame_ids)
    with pytest.raises(InputError, match=r"tum: frame 3 has no pose"):
        dataset.world_from_camera(3)


@pytest.mark.parametrize(
    ("name", "line", "complaint"),
    [
        (POSES, "1.0 0 0 0 0 0 1", r"groundtruth.txt, line 3: found 7 fields, expected 8: timestamp tx ty tz qx qy"),
        (POSES, "1.0 0 0 O 0 0 0 1", r"groundtruth.txt, line 3: found 'O', expected a number"),
        (POSES, "1.0 0 0 nan 0 0 0 1", r"groundtruth.txt, line 3: holds NaN"),
        (POSES, "1.0 0 0 0 0 0 0 0", r"groundtruth.txt, line 3: the quaternion .* has length 0"),
        ("rgb.txt", "1.0", r"rgb.txt, line 3: found 1 fields, expected 2: timestamp file"),
        ("depth.txt", "one depth/1.png", r"depth.txt, line 3: found 'one', expected a number"),
    ],
)
def test_a_malformed_line_is_named(folder, name, line, complaint):
    lines = (folder / name).read_text().splitlines()
    lines[2] = line
    (folder / name).write_text("\n".join(lines))
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_lists_that_have_nothing_in_common_are_refused(folder):
    (folder / "depth.txt").write_text("900.0 depth/0.000000.png\n")
    with pytest.raises(InputError, match=r"depth.txt: no depth image within 0.02 s of any image of rgb.txt"):
        open_dataset(folder)
    (folder / "depth.txt").write_text("# none\n")
    with pytest.raises(InputError, match=r"depth.txt: lists no image"):
        open_dataset(folder)


def test_poses_of_another_time_are_refused(folder):
    (folder / POSES).write_text("900.0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"groundtruth.txt: no pose within 0.02 s of any depth image.*0.000 to 0.167"):
        open_dataset(folder)


def test_an_image_that_is_listed_but_missing_is_named(folder):
    (folder / "depth" / "0.083333.png").unlink()
    dataset = open_dataset(folder)
    with pytest.raises(InputError, match=r"depth/0.083333.png: the file is missing, and 1 of the 5"):
        dataset.require(dataset.frame_ids)


def test_the_quaternions_last_number_is_its_real_part(source, folder):
    quat_xyzw = [float(word) for word in (folder / POSES).read_text().splitlines()[2].split()[4:]]
    np.testing.assert_allclose(
        Rotation.from_quat(quat_xyzw).as_matrix(), source.world_from_camera(1)[:3, :3], atol=1e-12
    )


def test_two_frames_of_the_same_time_cannot_be_written(source, tmp_path):
    tum = convert(source, tmp_path / "tum", "tum")
    times = tum / "rgb.txt"
    assert times.is_file()
    for name in ("rgb.txt", "depth.txt", POSES):
        text = (tum / name).read_text()
        (tum / name).write_text(text.replace(f"\n{1 / 24!r} ", "\n1e-07 "))
    with pytest.raises(InputError, match=r"frames 0 and 1 would both be depth/0.000000.png; their times are the same"):
        convert(open_dataset(tum), tmp_path / "again", "tum")


def test_a_pose_in_the_wrong_place_is_seen(source, folder):
    """A guard of the guards: the comparison above fails for a pose that is inverted."""
    write_pose(folder / "unused.txt", np.linalg.inv(source.world_from_camera(1)))
    assert not np.allclose(np.loadtxt(folder / "unused.txt"), open_dataset(folder).world_from_camera(1), atol=1e-3)
