import json

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.interpolate import CubicSpline

from datagen.errors import InputError
from datagen.rigid import look_at
from datagen.scene_spec.keyframes import Keyframe, Keyframes
from datagen.trajectory.easing import EASE_OUT_BY_ITSELF, EASINGS, ease
from datagen.trajectory.f_curves import KeyedCurves, bezier_handles, evaluate
from datagen.trajectory.keyframe_path import keyframe_path

TARGET = (5.0, 0.0, 0.0)
TIMES = np.array([0.0, 0.15, 0.4, 0.75, 1.0])


def keys(positions, times=TIMES, **more):
    return [
        Keyframe(time=float(t), position=tuple(map(float, p)), look_at=TARGET, **more)
        for t, p in zip(times, positions, strict=True)
    ]


def positions_of(path):
    return path[:, :3, 3]


@pytest.fixture
def places():
    return np.random.default_rng(3).uniform(-1, 1, (5, 3))


def test_every_interpolation_passes_through_its_keys(places):
    for name in ("linear", "smooth", "constant", *EASINGS):
        path = keyframe_path(keys(places, interpolation=name), frames=101)
        np.testing.assert_allclose(positions_of(path)[np.rint(TIMES * 100).astype(int)], places, atol=1e-12)


def test_linear_motion_is_linear_and_constant_motion_holds_until_the_next_key(places):
    at = np.arange(101) / 100
    expected = np.column_stack([np.interp(at, TIMES, places[:, c]) for c in range(3)])
    np.testing.assert_allclose(positions_of(keyframe_path(keys(places, interpolation="linear"), 101)), expected)
    held = positions_of(keyframe_path(keys(places, interpolation="constant"), 101))
    np.testing.assert_array_equal(held, places[np.searchsorted(TIMES, at + 1e-9, side="right") - 1])


def test_smooth_motion_is_the_cubic_spline_that_is_level_at_its_ends(places):
    spline = CubicSpline(TIMES, places, bc_type="clamped")
    path = keyframe_path(keys(places), frames=201)
    np.testing.assert_allclose(positions_of(path), spline(np.arange(201) / 200), atol=1e-12)


def test_a_closed_smooth_path_is_the_periodic_spline_and_repeats_outside_its_keys(places):
    places[-1] = places[0]
    times = np.array([0.2, 0.3, 0.5, 0.6, 0.8])
    spline = CubicSpline(times, places, bc_type="periodic")
    path = keyframe_path(keys(places, times), frames=201)
    np.testing.assert_allclose(positions_of(path), spline(np.arange(201) / 200), atol=1e-12)


def test_an_open_path_stays_at_its_first_and_its_last_key(places):
    path = positions_of(keyframe_path(keys(places, 0.2 + 0.6 * TIMES), frames=101))
    np.testing.assert_array_equal(path[:21], np.tile(places[0], (21, 1)))
    np.testing.assert_array_equal(path[80:], np.tile(places[-1], (21, 1)))


def test_given_handles_are_the_control_points_of_a_bezier_curve():
    right, left = [(0.9, 0.2), (0.1, -0.5), (0.3, 0.0)], [(-0.05, 0.1), (-0.8, 0.3), (-0.3, 0.0)]
    path = keyframe_path(
        [
            Keyframe(time=0.0, position=(0, 0, 0), look_at=TARGET, position_handles={"right": tuple(right)}),
            Keyframe(time=1.0, position=(1, 1, 1), look_at=TARGET, position_handles={"left": tuple(left)}),
        ],
        frames=51,
    )
    u = np.linspace(0, 1, 20001)
    weights = np.stack([(1 - u) ** 3, 3 * u * (1 - u) ** 2, 3 * u * u * (1 - u), u**3], axis=1)
    for c in range(3):
        controls = np.array([[0, 0], right[c], np.add([1, 1], left[c]), [1, 1]])
        time, value = (weights @ controls).T
        np.testing.assert_allclose(path[:, c, 3], np.interp(np.arange(51) / 50, time, value), atol=2e-7)


def test_handles_that_reach_beyond_the_other_key_are_shortened_to_it():
    far = KeyedCurves(
        key_frames=np.array([0.0, 10.0]),
        values=np.array([[0.0], [1.0]]),
        interpolation=("smooth", "smooth"),
        easing=("auto", "auto"),
        handles=(np.array([[[-20.0, -2.0]], [[20.0, 2.0]]]), np.array([[[-10.0, 3.0]], [[30.0, 0.0]]])),
    )
    at_key = KeyedCurves(
        **{**vars(far), "handles": (np.array([[[-1, 0.0]], [[10.0, 1.0]]]), np.array([[[0.0, 2.0]]] * 2))}
    )
    frames = np.linspace(0, 10, 31)
    np.testing.assert_allclose(evaluate(far, frames), evaluate(at_key, frames), atol=1e-12)


def test_beside_a_given_handle_the_automatic_ones_leave_no_jump_of_acceleration():
    given = np.array([[[18.0, 0.5]], [[23.0, -0.2]]])
    curves = KeyedCurves(
        key_frames=np.array([0.0, 7.0, 20.0, 31.0, 40.0]),
        values=np.array([[0.0], [1.0], [0.3], [-0.4], [0.6]]),
        interpolation=("smooth",) * 5,
        easing=("auto",) * 5,
        handles=(None, None, given, None, None),
    )
    left, right = bezier_handles(curves)
    np.testing.assert_array_equal(left[2], given[0])
    np.testing.assert_array_equal(right[2], given[1])
    step = 0.02
    for key in (7.0, 31.0):
        # One-sided second differences, extrapolated to the key.
        second = [np.diff(evaluate(curves, key + side * step * np.arange(5))[:, 0], n=2) / step**2 for side in (-1, 1)]
        before, after = (2 * d[0] - d[1] for d in second)
        assert before == pytest.approx(after, abs=2e-4)
        assert abs(before) > 1e-3


def test_easing_runs_from_0_to_1_and_out_is_in_backwards():
    time = np.linspace(0, 1, 101)
    for name in EASINGS:
        ease_in, ease_out, both = (ease(name, easing, time) for easing in ("in", "out", "in-out"))
        for progress in (ease_in, ease_out, both):
            assert progress[[0, -1]] == pytest.approx([0, 1], abs=1e-9)
        np.testing.assert_allclose(ease_out, 1 - ease_in[::-1], atol=1e-12)
        np.testing.assert_allclose(both, 1 - both[::-1], atol=1e-12)
        chosen = ease_out if name in EASE_OUT_BY_ITSELF else ease_in
        np.testing.assert_array_equal(ease(name, "auto", time), chosen)


def test_easing_has_the_values_of_its_equations():
    quarter = np.array([0.25])
    assert ease("sine", "in", quarter) == pytest.approx(1 - np.cos(np.pi / 8))
    assert ease("quart", "in", quarter) == pytest.approx(0.25**4)
    assert ease("quad", "in-out", quarter) == pytest.approx(2 * 0.25**2)
    assert ease("circ", "in", quarter) == pytest.approx(1 - np.sqrt(15) / 4)
    assert ease("bounce", "out", np.array([1 / 2.75])) == pytest.approx(1)
    assert ease("bounce", "out", np.array([1.5 / 2.75])) == pytest.approx(0.75)
    assert ease("back", "in", np.linspace(0, 1, 1001)).min() == pytest.approx(-0.1, abs=1e-4)


def test_the_path_at_a_time_does_not_depend_on_the_number_of_frames(places):
    for name in ("smooth", "elastic", "expo"):
        coarse = keyframe_path(keys(places, interpolation=name), frames=26)
        np.testing.assert_allclose(keyframe_path(keys(places, interpolation=name), frames=101)[::4], coarse, atol=1e-9)


def test_a_key_looks_at_its_point_and_the_points_move_between_keys(places):
    targets = np.random.default_rng(4).uniform(4, 5, (5, 3))
    between = [
        key.model_copy(update={"look_at": tuple(target)}) for key, target in zip(keys(places), targets, strict=True)
    ]
    path = keyframe_path(between, frames=101)
    spline = CubicSpline(TIMES, targets, bc_type="clamped")
    for i in (0, 15, 33, 60):
        np.testing.assert_allclose(path[i], look_at(path[i, :3, 3], spline(i / 100)), atol=1e-12)


def test_quaternions_are_interpolated_component_by_component_along_the_nearer_sign():
    half = np.sqrt(0.5)
    turn = [
        Keyframe(time=0.0, position=(0, 0, 0), quat_wxyz=(1.0, 0.0, 0.0, 0.0), interpolation="linear"),
        Keyframe(time=1.0, position=(0, 0, 0), quat_wxyz=(-half, 0.0, 0.0, -half), interpolation="linear"),
    ]
    angles = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in keyframe_path(turn, frames=5)]
    parts = np.arange(5) / 4
    np.testing.assert_allclose(angles, 2 * np.arctan2(parts * half, 1 - parts + parts * half), atol=1e-12)


def test_keys_that_fall_together_and_views_without_an_up_direction_are_refused(places):
    with pytest.raises(InputError, match=r"0.015 frames apart at 2 frames.*render more frames or set fewer keys"):
        keyframe_path(keys(places[:2], [0.5, 0.515]), frames=2)
    over = [
        Keyframe(time=0.0, position=(-1, 0, 1), look_at=(0, 0, 0), interpolation="linear"),
        Keyframe(time=1.0, position=(1, 0, 1), look_at=(0, 0, 0), interpolation="linear"),
    ]
    with pytest.raises(
        InputError, match=r"in frame 5 the camera, at \[0.0, 0.0, 1.0\], is at, straight above or below"
    ):
        keyframe_path(over, frames=11)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"interpolation": "lineal"}, "expected 'linear', 'smooth'|should be 'linear', 'smooth'"),
        ({"position_handles": {}}, "give left, right or both"),
        ({"position_handles": {"right": [[-0.1, 0], [0, 0], [0, 0]]}}, "a right handle's at least 0"),
        ({"position_handles": {"right": [[0.1, 0]] * 4}}, "position_handles need 3 components, found 4"),
        ({"quat_wxyz_handles": {"right": [[0.1, 0]] * 4}}, "quat_wxyz_handles need quat_wxyz"),
        ({"position_handles": {"right": [[0.1, 0]] * 3, "left": [[-0.1, 0]] * 4}}, "left has 4 components, right 3"),
    ],
)
def test_wrong_settings_of_a_key_are_named(change, complaint):
    key = {"time": 0, "position": [0, 0, 0], "look_at": [1, 0, 0]} | change
    with pytest.raises(ValueError, match=complaint):
        TypeAdapter(Keyframes).validate_json(json.dumps([key]))
