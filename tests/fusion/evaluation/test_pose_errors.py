import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import transform_points
from fusion.evaluation.pose_errors import (
    ModelPoints,
    average_distance,
    average_nearest_distance,
    average_recall,
    mspd,
    mssd,
    projection_error_px,
    recall,
    rotation_error_deg,
    translation_error,
    visible_surface_discrepancy,
    within,
)
from fusion.evaluation.symmetries import ContinuousSymmetry, symmetry_transforms

SHARED = json.loads(Path(__file__).with_name("bop_toolkit_errors.json").read_text())
"""Cases with the numbers that bop_toolkit's own functions gave for them; its renderer was not needed."""

CAMERA = PinholeCamera(width=160, height=120, fx=170.0, fy=165.0, cx=81.3, cy=58.6)
BOX = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.02, 0.02)])


def model(points=BOX, **symmetries):
    return ModelPoints(points=points, symmetries=symmetry_transforms(**symmetries))


def pose(translation=(0.0, 0.0, 0.8), turn_deg=0.0, axis=(0.0, 0.0, 1.0)):
    result = np.eye(4)
    result[:3, :3] = cv2.Rodrigues(np.radians(turn_deg) * np.array(axis) / np.linalg.norm(axis))[0]
    result[:3, 3] = translation
    return result


def some_pose(rng):
    return pose(rng.normal(size=3) * 0.1 + (0, 0, 1), rng.uniform(0, 180), rng.normal(size=3))


@pytest.mark.parametrize("case", SHARED["cases"], ids=range(len(SHARED["cases"])))
def test_errors_are_those_of_bop_toolkit(case):
    info, expected = case["info"], case["expected"]
    camera = PinholeCamera(**SHARED["camera"])
    symmetries = symmetry_transforms(
        discrete=[np.reshape(matrix, (4, 4)) for matrix in info.get("symmetries_discrete", [])],
        continuous=[
            ContinuousSymmetry(axis=tuple(one["axis"]), offset=tuple(one["offset"]))
            for one in info.get("symmetries_continuous", [])
        ],
        largest_step=case["step"],
    )
    known = ModelPoints(points=np.array(case["points"]), symmetries=symmetries)
    estimate, truth = np.array(case["estimate"]), np.array(case["truth"])
    found = {
        "symmetries": len(symmetries),
        "re_deg": rotation_error_deg(estimate, truth),
        "te": translation_error(estimate, truth),
        "add": average_distance(estimate, truth, known),
        "adi": average_nearest_distance(estimate, truth, known),
        "proj_px": projection_error_px(estimate, truth, known, camera),
        "mssd": mssd(estimate, truth, known),
        "mspd_px": mspd(estimate, truth, known, camera),
        "diameter": known.diameter,
    }
    assert found == pytest.approx({name: expected[name] for name in found}, rel=1e-9)
    depths = (np.array(case[f"depth_{name}_mm10"]) * 1e-4 for name in ("estimate", "truth", "measured"))
    vsd = visible_surface_discrepancy(
        *depths, camera, diameter=known.diameter, delta=SHARED["delta"], taus=case["taus"]
    )
    assert vsd == pytest.approx(expected["vsd"], rel=1e-12)


def test_a_pose_has_no_error_against_itself():
    truth = some_pose(np.random.default_rng(1))
    known = model()
    assert rotation_error_deg(truth, truth) == pytest.approx(0, abs=1e-9)
    for error in (average_distance, average_nearest_distance, mssd):
        assert error(truth, truth, known) == pytest.approx(0, abs=1e-12)
    for error in (projection_error_px, mspd):
        assert error(truth, truth, known, CAMERA) == pytest.approx(0, abs=1e-9)


def test_a_pure_shift_moves_every_point_by_its_length():
    shift = np.array([0.003, -0.004, 0.012])
    truth = pose(turn_deg=30, axis=(1, 2, 3))
    estimate = truth.copy()
    estimate[:3, 3] += shift
    assert rotation_error_deg(estimate, truth) == pytest.approx(0, abs=1e-9)
    for error in (average_distance, mssd):
        assert error(estimate, truth, model()) == pytest.approx(0.013)
    assert translation_error(estimate, truth) == pytest.approx(0.013)
    assert translation_error(estimate, truth, point_model=(9, 9, 9)) == pytest.approx(0.013)


def test_a_turn_moves_a_point_by_the_chord_of_its_distance_from_the_axis():
    radius, angle = 0.2, 17.0
    ring = np.array([[radius * np.cos(a), radius * np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 50)])
    chord = 2 * radius * np.sin(np.radians(angle) / 2)
    known = model(ring)
    estimate, truth = pose(turn_deg=angle), pose()
    assert rotation_error_deg(estimate, truth) == pytest.approx(angle)
    assert average_distance(estimate, truth, known) == pytest.approx(chord)
    assert mssd(estimate, truth, known) == pytest.approx(chord)
    # At one depth, straight before a camera with square pixels, the image is the model scaled.
    camera = PinholeCamera(width=160, height=120, fx=170.0, fy=170.0, cx=80.0, cy=60.0)
    assert projection_error_px(estimate, truth, known, camera) == pytest.approx(170 * chord / 0.8)
    assert mspd(estimate, truth, known, camera) == pytest.approx(170 * chord / 0.8)


def test_the_translation_error_is_that_of_the_point_asked_for():
    estimate, truth = pose(turn_deg=90), pose()
    assert translation_error(estimate, truth) == 0
    assert translation_error(estimate, truth, point_model=(0.3, 0, 0)) == pytest.approx(0.3 * 2**0.5)


def test_half_a_turn_of_a_box_is_an_error_to_all_but_those_who_know_its_symmetry():
    half_turn = pose((0, 0, 0), 180)
    estimate, truth = pose(turn_deg=180), pose()
    known = model(discrete=[half_turn])
    assert average_distance(estimate, truth, known) == pytest.approx(2 * np.hypot(0.1, 0.05))
    assert average_nearest_distance(estimate, truth, known) == pytest.approx(0, abs=1e-12)
    assert mssd(estimate, truth, known) == pytest.approx(0, abs=1e-12)
    assert mspd(estimate, truth, known, CAMERA) == pytest.approx(0, abs=1e-9)
    assert mssd(estimate, truth, model()) == pytest.approx(2 * np.hypot(0.1, 0.05))


def test_steps_of_a_continuous_symmetry_move_no_point_farther_than_was_asked():
    symmetry = ContinuousSymmetry(axis=(0, 0, 2), offset=(0.02, -0.01, 0.5))
    transforms = symmetry_transforms(continuous=[symmetry], largest_step=0.05)
    np.testing.assert_allclose(transforms[0], np.eye(4), atol=1e-12)
    # The farthest a point can be from the axis: half a diameter, here 1.
    point = np.array([0.02 + 0.5, -0.01, 0.3])
    path = np.array([transform_points(transform, point) for transform in [*transforms, transforms[0]]])
    np.testing.assert_allclose(np.linalg.norm(path[:, :2] - (0.02, -0.01), axis=1), 0.5)
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.05


def test_symmetric_errors_do_not_see_a_turn_about_the_axis_but_for_half_a_step():
    rng = np.random.default_rng(3)
    known = model(continuous=[ContinuousSymmetry(axis=(0, 0, 1))])
    truth = some_pose(rng)
    farthest = np.linalg.norm(BOX[:, :2], axis=1).max()
    for angle in rng.uniform(0, 360, 5):
        estimate = truth @ pose((0, 0, 0), angle)
        assert mssd(estimate, truth, known) <= farthest * np.pi / np.ceil(np.pi / 0.01)
    tipped = truth @ pose((0, 0, 0), 5, axis=(1, 0, 0))
    assert mssd(tipped, truth, known) > 0.9 * 2 * 0.05 * np.sin(np.radians(2.5))


def test_the_hull_has_the_greatest_distance_and_the_diameter():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(500, 3))
    known = model(points)
    estimate, truth = some_pose(rng), some_pose(rng)
    all_distances = np.linalg.norm(transform_points(estimate, points) - transform_points(truth, points), axis=1)
    assert mssd(estimate, truth, known) == pytest.approx(all_distances.max(), rel=1e-12)
    assert known.diameter == pytest.approx(cdist(points, points).max(), rel=1e-12)
    assert len(known.hull) < 100


def test_add_s_is_the_mean_nearest_distance_of_every_pair():
    rng = np.random.default_rng(5)
    known = model(rng.normal(size=(300, 3)) * 0.1)
    estimate, truth = some_pose(rng), some_pose(rng)
    pairs = cdist(transform_points(truth, known.points), transform_points(estimate, known.points))
    assert average_nearest_distance(estimate, truth, known) == pytest.approx(pairs.min(axis=1).mean())


def test_a_point_behind_the_camera_is_infinitely_far_off_in_the_image():
    estimate = pose((0, 0, -0.5))
    assert projection_error_px(estimate, pose(), model(), CAMERA) == np.inf
    assert mspd(estimate, pose(), model(), CAMERA) == np.inf


def plate(z, columns):
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[40:80, columns] = z
    return depth


def vsd(estimate, truth, measured, **options):
    return visible_surface_discrepancy(estimate, truth, measured, CAMERA, diameter=0.1, **options)


def test_vsd_counts_what_one_pose_shows_and_the_other_does_not():
    left, right = plate(1.0, slice(20, 60)), plate(1.0, slice(30, 70))
    # 30 columns are in both, 50 in either; on the same plane they agree there.
    assert vsd(left, right, right) == pytest.approx([20 / 50] * 10)
    assert vsd(right, right, right) == (0.0,) * 10
    assert vsd(plate(1.0, slice(0, 10)), plate(1.0, slice(90, 99)), np.zeros_like(left)) == (1.0,) * 10


def test_vsd_does_not_count_what_something_hides():
    truth = plate(1.0, slice(20, 60))
    hidden = truth.copy()
    hidden[:, :50] = 0.7
    off = truth.copy()
    off[:, :50] *= 1.01  # wrong, but only where it cannot be seen
    assert vsd(off, truth, hidden) == (0.0,) * 10
    assert vsd(off, truth, truth, taus=(0.05,)) == pytest.approx([30 / 40])


def test_vsd_agrees_up_to_tau_diameters():
    truth, behind = plate(1.0, slice(78, 84)), plate(1.012, slice(78, 84))
    # Along the rays of the image's middle 12 mm are 0.12 diameters and a little.
    assert vsd(behind, truth, truth) == (1.0, 1.0, *([0.0] * 8))


def test_vsd_of_nothing_visible_is_one():
    nothing = np.zeros((CAMERA.height, CAMERA.width))
    assert vsd(nothing, nothing, nothing) == (1.0,) * 10


def test_recalls_count_what_is_below():
    assert recall([0.1, 0.2, np.nan, np.inf], below=0.2) == 0.25
    assert within([0.5, 2, 0.5], [0.001, 0.001, 0.02], degrees=1, metres=0.01) == pytest.approx(1 / 3)
    assert average_recall([0.1, 0.3], [0.2, 0.4]) == pytest.approx(0.75)
    with pytest.raises(InputError, match="no errors"):
        recall([], below=1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: symmetry_transforms(discrete=[2 * np.eye(4)]), "symmetry 0: "),
        (lambda: symmetry_transforms(continuous=[ContinuousSymmetry(axis=(0, 0, 0))]), "an axis that is not 0 0 0"),
        (lambda: symmetry_transforms(largest_step=0), "a step of 0 diameters"),
        (lambda: model(np.zeros((3, 3))), r"found shape \(3, 3\)"),
        (lambda: model(np.full((9, 3), np.nan)), "NaN or infinite"),
    ],
)
def test_what_makes_no_model_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
