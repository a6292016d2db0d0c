import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from datagen.rigid import inverse, look_at, transform_points
from fusion.pose.se3 import exp_se3, log_se3, log_so3, perturb, skew

RNG = np.random.default_rng(7)
ANGLES = [0.0, 1e-9, 1e-5, 9.9e-3, 1.01e-2, 0.3, 2.0, np.pi - 1e-3, np.pi - 1e-7]


def twist_of(angle):
    axis = RNG.normal(size=3)
    return np.concatenate([RNG.normal(size=3), angle * axis / np.linalg.norm(axis)])


def generator(twist):
    result = np.zeros((4, 4))
    result[:3, :3], result[:3, 3] = skew(twist[3:]), twist[:3]
    return result


@pytest.mark.parametrize("angle", ANGLES)
def test_the_exponential_is_that_of_the_matrix(angle):
    twist = twist_of(angle)
    np.testing.assert_allclose(exp_se3(twist), expm(generator(twist)), atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_logarithm_undoes_the_exponential(angle):
    for _ in range(20):
        twist = twist_of(angle)
        np.testing.assert_allclose(log_se3(exp_se3(twist)), twist, atol=1e-8 if angle > 3 else 1e-12)


def test_the_logarithm_of_a_rotation_is_scipys():
    rotations = Rotation.random(200, random_state=3)
    np.testing.assert_allclose(log_so3(rotations.as_matrix()), rotations.as_rotvec(), atol=1e-12)


def test_half_a_turn_has_a_logarithm():
    for axis in (*np.eye(3), np.array([0.6, -0.8, 0.0]), np.array([2.0, 3.0, 6.0]) / 7):
        turn = 2 * np.outer(axis, axis) - np.eye(3)
        found = log_so3(turn)
        assert np.linalg.norm(found) == pytest.approx(np.pi)
        np.testing.assert_allclose(abs(found @ axis), np.pi, rtol=1e-12)


def test_motions_of_one_screw_add_up():
    twist = twist_of(0.7)
    np.testing.assert_allclose(exp_se3(0.4 * twist) @ exp_se3(1.1 * twist), exp_se3(1.5 * twist), atol=1e-13)
    np.testing.assert_allclose(exp_se3(-twist), inverse(exp_se3(twist)), atol=1e-13)


def test_a_perturbation_turns_about_its_pivot_and_moves_points_as_its_jacobian_says():
    pose, pivot = look_at((0.4, -1.0, 0.3), (0, 0, 0)), np.array([0.1, 0.2, -0.3])
    turn = np.array([0, 0, 0, 0.3, -0.2, 0.5])
    pivot_camera = transform_points(inverse(pose), pivot)
    np.testing.assert_allclose(transform_points(perturb(turn, pose, pivot_world=pivot), pivot_camera), pivot)
    point_camera = np.array([0.2, -0.1, 1.3])
    point = transform_points(pose, point_camera)
    jacobian = np.hstack([np.eye(3), -skew(point - pivot)])
    step = 1e-6
    for column in range(6):
        twist = step * np.eye(6)[column]
        ahead, back = (transform_points(perturb(s * twist, pose, pivot_world=pivot), point_camera) for s in (1, -1))
        np.testing.assert_allclose((ahead - back) / (2 * step), jacobian[:, column], atol=1e-9)


def test_many_poses_move_at_once():
    poses = np.stack([look_at((1, 0.1 * i, 0.5), (0, 0, 0)) for i in range(5)])
    twists = RNG.normal(size=(5, 6))
    pivot = np.array([0.3, 0.1, 0.0])
    together = perturb(twists, poses, pivot_world=pivot)
    for i in range(5):
        np.testing.assert_array_equal(together[i], perturb(twists[i], poses[i], pivot_world=pivot))
