import time

import numpy as np
import pytest

from datagen.errors import InputError

BALL = {"name": "Ball", "shape": "sphere", "material": "red", "scale": 0.4}
FLOOR = {"name": "Floor", "shape": "plane", "material": "red", "scale": 6.0, "location": [0, 0, -0.4]}
ELEVEN = {"frames": 11, "size": [64, 48], "samples": 1}


def cube(name, location, scale):
    return {"name": name, "shape": "cube", "material": "red", "location": location, "scale": scale}


@pytest.fixture
def check(open_session, make_scene):
    """Check a straight walk from x = −1 to x = 1, a metre before a ball, in 11 frames 0.2 m apart."""

    def checked(*objects, motion=None, render=ELEVEN, **more):
        walk = [
            {"time": t, "position": [x, -1, 0], "look_at": [0, 0, 0], "interpolation": "linear"}
            for t, x in ((0, -1), (1, 1))
        ]
        motion = motion or {"type": "keyframes", "keyframes": walk}
        scene = make_scene(
            render=render, objects=list(objects or [BALL]), keyframes=None, trajectory={**motion, **more}
        )
        open_session(scene).check_path()

    return checked


def test_a_path_around_its_subject_on_a_floor_is_good(check):
    check(BALL, FLOOR)
    check(BALL, FLOOR, motion={"type": "orbit", "radius": 2.0, "elevation_deg": 20.0})
    check(BALL, FLOOR, motion={"type": "shell", "radius": [1, 2], "elevation_deg": [10, 80]})


def test_frames_inside_a_closed_object_are_named(check):
    """The box spans x from 0.15 to 0.65 around the walk: frames 6 to 8, at 0.2, 0.4 and 0.6."""
    with pytest.raises(InputError, match=r"frames 6–8: the camera is inside 'Box'\. Move the path or the objects"):
        check(BALL, cube("Box", [0.4, -1, 0], [0.25, 0.2, 0.2]))


def test_a_stretched_and_turned_object_is_entered_where_it_really_is(check):
    """A long bar at 45° crosses the walk at x = 0 alone, though its bounding box holds all of it."""
    bar = cube("Bar", [0, -1, 0], [2.0, 0.05, 0.05]) | {"rotation_deg": [0, 0, 45]}
    with pytest.raises(InputError, match=r"path: frame 5: the camera is inside 'Bar'\. Move"):
        check(BALL, bar)


def test_a_wall_between_two_frames_is_not_passed_through(check):
    wall = cube("Wall", [0.5, -1, 0], [0.01, 0.5, 0.5])
    with pytest.raises(InputError, match=r"path: frame 8: on the way there the camera passes through 'Wall'\. Move"):
        check(BALL, wall)
    shell = {"type": "shell", "radius": [1.0, 2.0], "elevation_deg": [10, 60]}
    check(BALL, cube("Wall", [0, 0.6, 0], [3, 0.01, 0.01]), motion=shell)


def test_few_frames_of_a_curve_do_not_cut_its_corners(check):
    """Straight from one of three frames to the next, an orbit would pass through its centre."""
    few = {"frames": 3, "size": [64, 48]}
    for motion in ({"type": "orbit", "radius": 1.0}, {"type": "hemisphere", "radius": 1.0, "turns": 1.0}):
        check(BALL, motion=motion, render=few)
    # What stands on the circle, between two frames, is met all the same.
    with pytest.raises(InputError, match=r"path: frame 1: on the way there the camera passes through 'Post'\. Move"):
        check(BALL, cube("Post", [0.866, 0, 0], [0.05, 0.05, 2]), motion={"type": "orbit", "radius": 1.0}, render=few)


def test_an_open_sheet_has_no_inside_but_is_not_passed_through(check):
    sheet = {"name": "Sheet", "shape": "plane", "material": "red", "location": [0.1, -1, 0], "rotation_deg": [0, 80, 0]}
    with pytest.raises(InputError, match=r"path: frame 6: on the way there the camera passes through 'Sheet'\. Move"):
        check(BALL, sheet)


def test_the_camera_keeps_its_distance(check):
    """A plane 0.02 m under the walk is behind the near plane's corners, and too near where more is asked for."""
    close = FLOOR | {"location": [0, 0, -0.02]}
    check(BALL, close)
    with pytest.raises(InputError, match=r"frames 0–10: the camera is 0.02 m from 'Floor', at least 0.05 m is needed"):
        check(BALL, close, clearance=0.05)
    touching = FLOOR | {"location": [0, 0, -0.0095]}
    with pytest.raises(InputError, match=r"0.0095 m from 'Floor', at least 0.011 m is needed"):
        check(BALL, touching)


def test_what_is_inside_a_room_may_be_but_may_not_leave_it(check):
    room = cube("Room", [0, 0, 0], [3, 3, 3])
    check(BALL, room)
    with pytest.raises(InputError, match=r"frame 6: on the way there the camera passes through 'Room'|inside 'Room'"):
        check(BALL, cube("Room", [-1.9, 0, 0], [2, 3, 3]))


def test_a_subject_that_leaves_the_image_is_named_with_its_frames(check):
    turning = [
        {"time": 0, "position": [0, -2, 0], "look_at": [0, 0, 0], "interpolation": "linear"},
        {"time": 0.5, "position": [0, -2, 0], "look_at": [4, -2, 0], "interpolation": "constant"},
        {"time": 1, "position": [0, -2, 0], "look_at": [0, 0, 0]},
    ]
    motion = {"type": "keyframes", "keyframes": turning}
    with pytest.raises(InputError, match=r"frames \d–9: 0% of 'Ball' is in view, at least 10% is asked for"):
        check(BALL, FLOOR, motion=motion)
    check(BALL, FLOOR, motion=motion, min_in_view=0.0)
    check(BALL, FLOOR, motion=motion, check=False)
    check(BALL, FLOOR, motion=motion, subject="Floor", min_in_view=0.01)
    with pytest.raises(InputError, match=r"trajectory.subject: no object 'Bal'; there are: Ball, Floor"):
        check(BALL, FLOOR, motion=motion, subject=["Floor", "Bal"])


def test_an_object_of_parts_has_one_name(check):
    parts = [{"shape": "cube", "material": "red", "scale": 0.2, "location": [x, 0, 0]} for x in (-0.5, 0.5)]
    pair = {"name": "Pair", "parts": parts}
    check(pair, FLOOR, subject="Pair")
    with pytest.raises(InputError, match=r"the camera is inside 'Pair'"):
        check(BALL, pair | {"location": [0, -1, 0]})


def test_speed_limits_are_kept_even_where_nothing_else_is_checked(check):
    with pytest.raises(InputError, match=r"frames 1–10: the camera moves at up to 6 m/s.*render 61 frames"):
        check(limits={"max_speed": 1.0}, check=False)


def test_modifiers_count_as_they_are_rendered(check):
    """A cube of half side 0.5 that subdivision rounds: a corner of it is free, which would be inside otherwise."""
    corner = cube("Stone", [0.4, -1.4, 0.4], 0.5)
    with pytest.raises(InputError, match=r"inside 'Stone'"):
        check(BALL, corner)
    check(BALL, corner | {"subdivision": 3})


def test_500_frames_are_checked_in_a_second(open_session, make_scene):
    orbit = {"type": "orbit", "radius": 1.5, "turns": 3.0, "shake": {}}
    monkey = {"name": "Suzanne", "shape": "suzanne", "material": "red", "scale": 0.4, "subdivision": 2}
    # The table's top is inside the path's bounding box and near to all of it.
    table = cube("Table", [0, 0, -0.1], [2.0, 2.0, 0.02]) | {"subdivision": 5}
    scene = make_scene(
        render={"frames": 500, "size": [64, 48]}, objects=[monkey, table], keyframes=None, trajectory=orbit
    )
    session = open_session(scene)
    begin = time.process_time()
    session.check_path()
    assert time.process_time() - begin < 1.0


def test_the_path_that_is_checked_is_the_one_that_is_rendered(open_session, make_scene):
    from datagen.blender.camera import read_pose

    scene = make_scene(keyframes=None, trajectory={"type": "hemisphere", "radius": 1.5, "shake": {}})
    session = open_session(scene)
    for frame in range(scene.render.frames):
        session.scene.frame_set(frame)
        np.testing.assert_allclose(read_pose(session.scene), session.path[frame], atol=1e-6)


def test_a_bad_path_stops_rendering_before_anything_is_written(blender, make_scene, tmp_path):
    from datagen.rendering.render_job import render_dataset

    through = {"type": "orbit", "radius": 0.3, "elevation_deg": 0.0}
    with pytest.raises(InputError, match=r"frames 0–2: the camera is inside 'Ball'"):
        render_dataset(make_scene(keyframes=None, trajectory=through), tmp_path / "dataset", device="cpu")
    assert not list((tmp_path / "dataset").rglob("*.*"))
    # Nothing is in the way of the same folder once the path is mended.
    good = make_scene(keyframes=None, trajectory=through | {"radius": 2.0})
    assert render_dataset(good, tmp_path / "dataset", device="cpu").is_complete(2)
