import json

import numpy as np
import pytest
from pydantic import TypeAdapter

from datagen.errors import InputError
from datagen.rigid import inverse, look_at, rotation_angle_deg, transform_points
from datagen.scene_spec.trajectory_settings import Trajectory
from datagen.trajectory.camera_path import camera_path
from datagen.trajectory.easing import EASINGS

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


FRAMES = 51
TIMES = [0.0, 0.21, 0.45, 0.7, 1.0]
"""Between frames, at 10.5 and 22.5, and on them: times that single precision, which Blender has, holds exactly."""


@pytest.fixture
def move(blender):
    """Move a camera in an empty Blender, and return Blender's path and the one computed without it."""
    import bpy

    from datagen.blender.camera import BLENDER_FROM_OPENCV
    from datagen.blender.trajectory import animate_camera, find_blend_camera

    def moved(settings, *, frames=FRAMES, seed=0, scene=None):
        if scene is None:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            scene = bpy.context.scene
        blend_camera = find_blend_camera(scene)
        camera = bpy.data.objects.new("Ours", bpy.data.cameras.new("Ours"))
        scene.collection.objects.link(camera)
        settings = TypeAdapter(Trajectory).validate_json(json.dumps(settings))
        path = animate_camera(
            camera, settings, frames=frames, frames_per_second=30.0, seed=seed, blend_camera=blend_camera
        )
        evaluated = np.empty((frames, 4, 4))
        for frame in range(frames):
            scene.frame_set(frame)
            matrix = camera.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world
            evaluated[frame] = np.array(matrix) @ BLENDER_FROM_OPENCV
        if settings.type != "blend-camera":
            np.testing.assert_array_equal(path, camera_path(settings, frames, 30.0, seed))
        return evaluated, path

    return moved


def random_keys(seed, *, closed=False, quaternions=False, **more):
    random = np.random.default_rng(seed)
    result = []
    for time in TIMES:
        key = {"time": time, "position": random.uniform(-1, 1, 3).tolist(), **more}
        if quaternions:
            quat = np.array([0.5, -0.5, 0.5, -0.5]) + random.uniform(-0.3, 0.3, 4)
            key["quat_wxyz"] = (quat / np.linalg.norm(quat)).tolist()
        else:
            key["look_at"] = random.uniform((2, -0.5, -0.5), (3, 0.5, 0.5)).tolist()
        result.append(key)
    if closed:
        result[-1] |= {name: result[0][name] for name in ("position", "look_at")}
    return result


def random_handles(seed, components, reach):
    random = np.random.default_rng(seed)
    times, values = random.uniform(0, reach, (2, components)), random.uniform(-0.3, 0.3, (2, components))
    left, right = np.stack([times * [[-1], [1]], values], axis=-1).tolist()
    return {"left": left, "right": right}


def assert_same_path(moved):
    blender, ours = moved
    np.testing.assert_allclose(ours, blender, rtol=0, atol=1e-6)


@pytest.mark.parametrize("interpolation", ["linear", "smooth", "constant"])
@pytest.mark.parametrize("quaternions", [False, True])
def test_keys_are_evaluated_as_blender_does(move, interpolation, quaternions):
    for seed in range(4):
        keyframes = random_keys(seed, interpolation=interpolation, quaternions=quaternions)
        assert_same_path(move({"type": "keyframes", "keyframes": keyframes}))


@pytest.mark.parametrize("easing", ["auto", "in", "out", "in-out"])
@pytest.mark.parametrize("interpolation", EASINGS)
def test_easing_is_evaluated_as_blender_does(move, interpolation, easing):
    keyframes = random_keys(1, interpolation=interpolation, easing=easing)
    assert_same_path(move({"type": "keyframes", "keyframes": keyframes}))


@pytest.mark.parametrize("seed", range(3))
def test_closed_paths_are_evaluated_as_blender_does_also_outside_of_their_keys(move, seed):
    keyframes = random_keys(seed, closed=True)
    assert_same_path(move({"type": "keyframes", "keyframes": keyframes}))
    for key in keyframes:
        key["time"] = 0.13 + 0.61 * key["time"]
    assert_same_path(move({"type": "keyframes", "keyframes": keyframes}, frames=77))


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("keyed", [(1,), (2, 3), (0,), (4,), (0, 1, 2, 3, 4)])
@pytest.mark.parametrize("reach", [0.05, 0.2, 0.5])
def test_given_handles_and_the_automatic_ones_beside_them_are_evaluated_as_blender_does(move, keyed, reach, closed):
    keyframes = random_keys(6, closed=closed)
    for i in keyed:
        keyframes[i]["position_handles"] = random_handles(i, 3, reach)
        keyframes[i]["look_at_handles"] = random_handles(i + 9, 3, reach)
    assert_same_path(move({"type": "keyframes", "keyframes": keyframes}))


def test_handles_of_quaternions_are_evaluated_as_blender_does(move):
    keyframes = random_keys(2, quaternions=True)
    keyframes[2]["quat_wxyz"] = [-number for number in keyframes[2]["quat_wxyz"]]
    for i in (1, 2, 4):
        keyframes[i]["quat_wxyz_handles"] = random_handles(i, 4, 0.1)
    assert_same_path(move({"type": "keyframes", "keyframes": keyframes}))


def test_linear_eased_and_handled_keys_mix_as_in_blender(move):
    keyframes = random_keys(5)
    for key, name in zip(keyframes, ["linear", "smooth", "bounce", "smooth", "smooth"], strict=True):
        key["interpolation"] = name
    keyframes[1]["position_handles"] = {"right": [[0.1, 0.5], [0.05, 0.0], [0.3, -0.2]]}
    assert_same_path(move({"type": "keyframes", "keyframes": keyframes}))


@pytest.mark.parametrize(
    "settings",
    [
        {"type": "orbit", "radius": 1.2, "turns": 2.0},
        {"type": "hemisphere", "radius": 1.2},
        {"type": "shell", "radius": [0.5, 1.5], "roll_deg": 40.0, "look_at_jitter": 0.1},
        {"type": "orbit", "radius": 1.2, "shake": {"position": 0.01, "rotation_deg": 1.0}},
        {"type": "keyframes", "keyframes": random_keys(0), "shake": {"position": 0.01}},
    ],
)
def test_any_other_path_stands_in_blender_frame_by_frame(move, settings):
    assert_same_path(move(settings, frames=60, seed=3))


def test_between_frames_a_baked_path_takes_no_long_way_round(move):
    import bpy

    move({"type": "orbit", "radius": 1.0, "turns": 3.0}, frames=60)
    camera = bpy.data.objects["Ours"]
    for frame in range(59):
        bpy.context.scene.frame_set(frame, subframe=0.5)
        position = np.array(camera.matrix_world.translation)
        forward = -np.array(camera.matrix_world.to_3x3())[:, 2]
        assert forward @ -position / np.linalg.norm(position) > 0.99


def animated_blend_camera():
    """Make a .blend's scene: a camera on a turning, scaled arm, looking at the origin, from frame 10 to 50."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    arm, target = bpy.data.objects.new("Arm", None), bpy.data.objects.new("Target", None)
    camera = bpy.data.objects.new("Theirs", bpy.data.cameras.new("Theirs"))
    for thing in (arm, target, camera):
        scene.collection.objects.link(thing)
    camera.parent, arm.scale = arm, (2, 2, 2)
    camera.location = (1, 0, 0.5)
    constraint = camera.constraints.new("TRACK_TO")
    constraint.target, constraint.track_axis, constraint.up_axis = target, "TRACK_NEGATIVE_Z", "UP_Y"
    for frame, angle in ((10, 0), (50, np.pi)):
        arm.rotation_euler.z = angle
        arm.keyframe_insert("rotation_euler", frame=frame)
    from datagen.blender.trajectory import f_curves

    for curve in f_curves(arm):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
    scene.camera, scene.frame_start, scene.frame_end = camera, 10, 50
    return scene


@pytest.mark.parametrize(("more", "first", "last"), [({}, 0, 180), ({"first_frame": 20, "last_frame": 30}, 45, 90)])
def test_the_motion_of_a_blend_s_own_camera_is_stretched_over_the_frames(move, more, first, last):
    scene = animated_blend_camera()
    blender, ours = move({"type": "blend-camera", **more}, frames=13, scene=scene)
    angles = np.radians(np.linspace(first, last, 13))
    expected = [look_at((2 * np.cos(a), 2 * np.sin(a), 1), (0, 0, 0)) for a in angles]
    np.testing.assert_allclose(blender, expected, atol=2e-6)
    np.testing.assert_allclose(ours, expected, atol=2e-6)


def test_a_scene_without_a_camera_of_its_own_is_refused(move):
    with pytest.raises(InputError, match=r"no camera of its own.*choose another type of trajectory"):
        move({"type": "blend-camera"})


def test_keys_that_were_there_before_trajectories_were_move_the_camera_as_they_did(open_session, make_scene):
    """Places that Blender's curves gave when keyframes were the only trajectory, recorded then."""
    path = keys([-1, -2, 0], [0.4, -2, 1], [1, -1.5, 0.2], [-1, -2, 0])
    path[1]["time"], path[1]["interpolation"] = 0.25, "linear"
    session = open_session(make_scene(render=ELEVEN, keyframes=path))
    recorded = [
        [-1.0, -2.0, 0.0],
        [-0.672361, -2.0703149, 0.4068016],
        [0.0289428, -2.0454977, 0.846754],
        [0.472, -1.94, 0.904],
        [0.616, -1.82, 0.712],
        [0.76, -1.7, 0.52],
        [0.904, -1.58, 0.328],
        [0.7910739, -1.5202042, 0.1004119],
        [0.0206364, -1.6548597, -0.1190333],
        [-0.6930591, -1.8405278, -0.1726026],
        [-1.0, -2.0, 0.0],
    ]
    np.testing.assert_allclose([pose[:3, 3] for pose in poses_of(session)], recorded, atol=1e-6)
