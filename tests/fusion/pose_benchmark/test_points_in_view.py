import numpy as np
from synthetic_scene import CAMERA

from datagen.rigid import inverse, look_at, transform_points
from fusion.evaluation.pose_errors import ModelPoints
from fusion.evaluation.symmetries import symmetry_transforms
from fusion.pose_benchmark.run_case import points_in_view


def model(points):
    return ModelPoints(points=np.asarray(points, float), symmetries=symmetry_transforms())


def test_all_points_of_an_object_before_the_camera_count_even_those_beside_the_image():
    ball = model(np.random.default_rng(0).normal(size=(200, 3)) * 0.3)
    camera_from_model = inverse(look_at((0, -2, 0), (0.9, 0, 0)))
    assert points_in_view(ball, camera_from_model, CAMERA) is ball


def test_of_a_scene_around_the_camera_only_points_in_the_image_count():
    scene = model(np.random.default_rng(1).uniform(-3, 3, size=(3000, 3)))
    camera_from_model = inverse(look_at((0.1, 0.2, 0), (1, 0, 0.1)))
    seen = points_in_view(scene, camera_from_model, CAMERA)
    points_camera = transform_points(camera_from_model, seen.points)
    assert (points_camera[:, 2] > 0).all()
    u, v = CAMERA.project(points_camera).T
    assert ((u > -0.5) & (u < CAMERA.width - 0.5) & (v > -0.5) & (v < CAMERA.height - 0.5)).all()
    # The share of all directions that a pyramid of this opening holds.
    a, b = CAMERA.width / 2 / CAMERA.fx, CAMERA.height / 2 / CAMERA.fy
    share = np.arcsin(a * b / np.sqrt((1 + a * a) * (1 + b * b))) / np.pi
    assert 0.5 * share < len(seen.points) / len(scene.points) < 2 * share
