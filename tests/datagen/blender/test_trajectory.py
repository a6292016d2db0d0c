import numpy as np
import pytest

from datagen.errors import InputError
from datagen.rigid import inverse, rotation_angle_deg, transform_points

ELEVEN = {"frames": 11, "size": [64, 48], "samples": 1}


def poses_of(session):
    from datagen.blender.camera import read_pose

    poses = []
    for frame in range(session.spec.render.frames):
        session.scene.frame_set(frame)
        poses.append(read_pose(session.scene))
    return poses


def keys(*positions, look_at=(0, 0, 0), interpolation="smooth"):
    times = np.linspace(0, 1, len(positions))
    return [
        {"time": t, "position": list(p), "look_at": list(look_at), "interpolation": interpolation}
        for t, p in zip(times, positions, strict=True)
    ]


def quaternion_key(time, quat_wxyz, **more):
    return {"time": time, "position": [0, -2, 0], "quat_wxyz": list(quat_wxyz), **more}


def rotation_of(quat_wxyz):
    w, x, y, z = quat_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_keyframes_are_real_f_curves_and_editing_one_moves_the_poses(open_session, make_scene):
    from datagen.blender.trajectory import f_curves

    session = open_session(make_scene(render=ELEVEN, keyframes=keys([-1, -2, 0], [0, -2, 1], [1, -2, 0])))
    curves = {curve.array_index: curve for curve in f_curves(session.scene.camera)}
    assert {curve.data_path for curve in curves.values()} == {"location"}
    assert [list(key.co) for key in curves[2].keyframe_points] == [[0, 0], [5, 1], [10, 0]]
    assert {key.interpolation for key in curves[2].keyframe_points} == {"BEZIER"}
    before = poses_of(session)[5]
    curves[2].keyframe_points[1].co[1] = 3.0
    curves[2].update()
    assert poses_of(session)[5][2, 3] - before[2, 3] == pytest.approx(2.0)


def test_linear_motion_is_midway_at_half_time_and_at_constant_speed(open_session, make_scene):
    a, b = np.array([-1.0, -2.0, 0.5]), np.array([1.0, -3.0, 1.5])
    session = open_session(make_scene(render=ELEVEN, keyframes=keys(a, b, interpolation="linear")))
    positions = np.array([pose[:3, 3] for pose in poses_of(session)])
    np.testing.assert_allclose(positions, a + np.linspace(0, 1, 11)[:, None] * (b - a), atol=1e-6)


def test_smooth_motion_passes_its_keys_without_a_corner(open_session, make_scene):
    corner = keys([-1, -2, 0], [0, -2, 1], [1, -2, 0.5])
    session = open_session(make_scene(render=ELEVEN | {"frames": 101}, keyframes=corner))
    positions = np.array([pose[:3, 3] for pose in poses_of(session)])
    np.testing.assert_allclose(positions[50], [0, -2, 1], atol=1e-6)
    steps = np.diff(positions, axis=0)
    assert np.linalg.norm(steps[50] - steps[49]) < 0.1 * np.linalg.norm(steps[50])


def test_a_closed_path_runs_through_its_closing_key_without_slowing_down(open_session, make_scene):
    circle = [[2 * np.sin(a), -2 * np.cos(a), 0.5] for a in np.radians(np.arange(0, 361, 45))]
    circle[-1] = circle[0]
    session = open_session(make_scene(render=ELEVEN | {"frames": 81}, keyframes=keys(*circle)))
    positions = np.array([pose[:3, 3] for pose in poses_of(session)])
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert speeds.min() > 0.9 * speeds.max()
    np.testing.assert_allclose(np.linalg.norm(positions[:, :2], axis=1), 2, rtol=0.01)


def test_what_is_looked_at_projects_to_the_image_centre_in_every_frame(open_session, make_scene):
    moving = keys([-1, -2, 0], [0.5, -2, 1], [1, -1, 0.2])
    moving[1]["look_at"], moving[2]["look_at"] = [0.3, 0.2, 0.1], [0.3, 0.2, 0.1]
    session = open_session(make_scene(render=ELEVEN, keyframes=moving))
    from datagen.blender.camera import read_intrinsics

    camera = read_intrinsics(session.scene)
    target = next(thing for thing in session.scene.objects if thing.type == "EMPTY")
    for frame, world_from_camera in enumerate(poses_of(session)):
        session.scene.frame_set(frame)
        point = transform_points(inverse(world_from_camera), np.array(target.matrix_world.translation))
        np.testing.assert_allclose(camera.project(point), [(64 - 1) / 2, (48 - 1) / 2], atol=1e-3)
        assert world_from_camera[2, 1] < 0


def test_a_quaternion_key_is_world_from_camera_in_opencv_axes(open_session, make_scene):
    quat_wxyz = np.array([0.6, -0.5, 0.3, 0.4]) / np.linalg.norm([0.6, -0.5, 0.3, 0.4])
    session = open_session(make_scene(render=ELEVEN, keyframes=[quaternion_key(0, quat_wxyz)]))
    np.testing.assert_allclose(poses_of(session)[0][:3, :3], rotation_of(quat_wxyz), atol=1e-6)


def test_a_quaternion_and_its_negative_are_one_rotation_also_between_keys(open_session, make_scene):
    quat_wxyz = np.array([0.5, -0.5, 0.5, 0.5])
    session = open_session(
        make_scene(render=ELEVEN, keyframes=[quaternion_key(0, quat_wxyz), quaternion_key(1, -quat_wxyz)])
    )
    first, *others = poses_of(session)
    assert max(rotation_angle_deg(inverse(first) @ other) for other in others) < 1e-3


def test_keys_lie_between_frames_where_their_time_does(open_session, make_scene):
    path = keys([-1, -2, 0], [1, -2, 0], interpolation="linear")
    path.insert(1, path[0] | {"time": 0.25, "position": [0, -2, 0]})
    session = open_session(make_scene(render=ELEVEN, keyframes=path))
    x = [pose[0, 3] for pose in poses_of(session)]
    assert x[2:4] == pytest.approx([-0.2, 0.5 / 7.5], abs=1e-6)


def test_keys_that_fall_together_are_refused(open_session, make_scene):
    crowded = keys([-1, -2, 0], [0, -2, 0], [1, -2, 0])
    crowded[1]["time"] = 0.001
    with pytest.raises(InputError, match=r"0.01 frames apart at 11 frames"):
        open_session(make_scene(render=ELEVEN, keyframes=crowded))


def test_a_single_frame_stands_at_the_first_key(open_session, make_scene):
    session = open_session(make_scene(render=ELEVEN | {"frames": 1}, keyframes=keys([-1, -2, 0], [1, -2, 0])))
    np.testing.assert_allclose(poses_of(session)[0][:3, 3], [-1, -2, 0])
