import numpy as np
import pytest
from three_balls import (
    CAMERA,
    CENTRES,
    OFFSET,
    POSES,
    RADII,
    VOXEL,
    ball_model,
    distances,
    errors,
    see,
    sphere_points,
    twist,
)

from datagen.errors import InputError
from datagen.rigid import inverse
from fusion.pose.depth_refinement import DepthRefinementOptions, refine_with_depth
from fusion.pose.model_field import FROM_GRID, FROM_VOLUME
from fusion.pose.normal_equations import GEMAN_MCCLURE, TUKEY, Robustness, normal_equations
from fusion.pose.query import Query, depth_noise, query_cloud
from fusion.pose.se3 import perturb


@pytest.fixture
def model(device):
    return ball_model(device)


def test_the_field_is_the_distance_and_its_slope_near_the_surface_and_far_from_it(model):
    rng = np.random.default_rng(0)
    to_balls = np.sort(np.linalg.norm(sphere_points()[:, None] - CENTRES, axis=2) - RADII, axis=1)
    smooth_points = sphere_points()[to_balls[:, 1] > 4 * VOXEL][::40]  # not where two balls meet in a crease
    near = smooth_points + rng.uniform(-0.3, 0.3, smooth_points.shape) * VOXEL
    found, normals, sources = model.sample(near)
    known = sources == FROM_VOLUME
    assert known.mean() > 0.99
    np.testing.assert_allclose(found[known], distances(near)[known], atol=0.06 * VOXEL)
    step = 1e-5
    slope = np.stack([(distances(near + step * e) - distances(near - step * e)) / (2 * step) for e in np.eye(3)], -1)
    assert (normals * slope).sum(axis=1)[known].min() > 0.99
    far = rng.uniform(CENTRES.min(axis=0) - 0.11, CENTRES.max(axis=0) + 0.1, (500, 3))
    far = far[distances(far) > 8 * VOXEL]
    found, _normals, sources = model.sample(far)
    assert (sources == FROM_GRID).mean() > 0.97  # the rest lies where the distance has no slope
    known = sources == FROM_GRID
    # A node takes the closest point that the nearest node beside the surface has. Those lie up to a spacing farther out
    # in one place than in another, and one to the side that is so much nearer is taken instead: no worse than that.
    off = np.abs(found[known] - distances(far)[known]) / model.grid.spacing
    assert off.max() < 1
    assert np.median(off) < 0.15


def test_a_point_off_the_grid_has_no_field(model):
    _distance, _normal, source = model.sample(OFFSET + np.array([[5.0, 0, 0], [0, 0, -3.0]]))
    np.testing.assert_array_equal(source, 0)


@pytest.mark.parametrize("kind", [GEMAN_MCCLURE, TUKEY])
def test_the_gradient_of_the_cost_is_that_of_finite_differences(model, kind):
    pose = perturb(twist(np.random.default_rng(3), 1.0, 0.004), POSES[0], pivot_world=OFFSET)
    cloud = query_cloud(Query(camera=CAMERA, depth=see(POSES[0])), device=model.device)
    robustness = Robustness(kind=kind, scales=np.array([0.02]), floor=1e-3, inlier_within=VOXEL)

    def at(step):
        moved = perturb(step, pose, pivot_world=OFFSET)[None]
        return normal_equations(model, cloud, moved, count=1500, pivot_world=OFFSET, robustness=robustness)

    # The cost is a point's mean, over scale²; near the surface the slope of the distance is 1 to a few percent.
    gradient = at(np.zeros(6)).gradient[0] / (1500 * 0.02**2)
    numeric = np.array([(at(1e-4 * e).cost[0] - at(-1e-4 * e).cost[0]) / 2e-4 for e in np.eye(6)])
    np.testing.assert_allclose(gradient, numeric, atol=0.05 * np.abs(numeric).max())


def test_many_poses_are_summed_as_one_alone(model):
    cloud = query_cloud(Query(camera=CAMERA, depth=see(POSES[0])), device=model.device)
    poses = np.stack(
        [perturb(twist(np.random.default_rng(i), 3, 0.01), POSES[0], pivot_world=OFFSET) for i in range(5)]
    )

    def at(some):
        scales = np.full(len(some), 0.01)
        robustness = Robustness(kind=TUKEY, scales=scales, floor=1e-3, inlier_within=VOXEL)
        return normal_equations(model, cloud, some, count=777, pivot_world=OFFSET, robustness=robustness)

    together = at(poses)
    for i in range(5):
        np.testing.assert_array_equal(together.hessian[i], at(poses[i : i + 1]).hessian[0])


@pytest.mark.parametrize(("turn_deg", "shift"), [(0.0, 0.0), (1.0, 0.01), (10.0, 0.04)])
def test_an_exact_view_is_located_to_a_tenth_of_a_millimetre(model, turn_deg, shift):
    for i, truth in enumerate(POSES):
        start = perturb(twist(np.random.default_rng(i), turn_deg, shift), truth, pivot_world=OFFSET)
        found = refine_with_depth(model, Query(camera=CAMERA, depth=see(truth)), start)
        angle, distance = errors(found.world_from_camera, truth)
        assert found.converged
        assert angle < 0.06
        assert distance < 1e-4
        assert found.inlier_share > 0.97
        assert found.overlap > 0.97


def test_a_view_forty_degrees_off_is_found_from_many_starts(model):
    for i, truth in enumerate(POSES):
        start = perturb(twist(np.random.default_rng(i), 40.0, 0.16), truth, pivot_world=OFFSET)
        options = DepthRefinementOptions(starts="many")
        found = refine_with_depth(model, Query(camera=CAMERA, depth=see(truth)), start, options=options)
        angle, distance = errors(found.world_from_camera, truth)
        assert angle < 0.1
        assert distance < 2e-4


def test_an_occluder_and_a_background_do_not_move_the_pose(model):
    truth = POSES[0]
    depth = see(truth)
    behind = np.where(depth > 0, depth, 1.4).astype(np.float32)
    behind[:, :62] = 0.4
    start = perturb(twist(np.random.default_rng(1), 4.0, 0.015), truth, pivot_world=OFFSET)
    found = refine_with_depth(model, Query(camera=CAMERA, depth=behind, mask=(depth > 0) & (behind > 0.4)), start)
    angle, distance = errors(found.world_from_camera, truth)
    assert angle < 0.1
    assert distance < 2e-4
    # Without a mask, too: what is far from the model is an outlier.
    found = refine_with_depth(model, Query(camera=CAMERA, depth=behind), start)
    angle, distance = errors(found.world_from_camera, truth)
    assert angle < 0.1
    assert distance < 2e-4
    assert found.inlier_share < 0.5


def test_the_spread_of_poses_under_noise_is_that_of_the_covariance(model):
    truth, sigma = POSES[0], 0.002
    depth = see(truth)
    exact = refine_with_depth(model, Query(camera=CAMERA, depth=depth), truth).world_from_camera
    squares = []
    for seed in range(24):
        noise = sigma * np.random.default_rng(seed).standard_normal(depth.shape)
        noisy = np.where(depth > 0, depth + noise, 0).astype(np.float32)
        found = refine_with_depth(model, Query(camera=CAMERA, depth=noisy), truth)
        known = found.uncertainty
        middle = np.eye(4)
        middle[:3, 3] = known.pivot_world
        moved = inverse(middle) @ exact @ inverse(found.world_from_camera) @ middle
        small = np.concatenate([moved[:3, 3], [moved[2, 1], moved[0, 2], moved[1, 0]]])
        squares.append(small @ np.linalg.solve(known.covariance, small))
    # Chi squared with six degrees of freedom has the mean 6; noise along the ray is not noise across the surface.
    assert 2 < np.mean(squares) < 12


def test_noise_is_told_from_the_depth_itself():
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:120, :160]
    plane = (1 / (0.5 + 0.002 * u + 0.001 * v)).astype(np.float64)
    told = depth_noise((plane + 0.003 * rng.standard_normal(plane.shape)).astype(np.float32))
    assert told(1.5) == pytest.approx(0.003, rel=0.1)
    told = depth_noise((plane + 0.002 * plane**2 * rng.standard_normal(plane.shape)).astype(np.float32))
    np.testing.assert_allclose(told(np.array([1.2, 1.8])), 0.002 * np.array([1.2, 1.8]) ** 2, rtol=0.15)
    assert depth_noise(plane.astype(np.float32))(1.5) < 1e-5


def test_what_cannot_be_refined_is_handed_on_unchanged_with_a_reason(model):
    start = POSES[1]
    empty = refine_with_depth(model, Query(camera=CAMERA, depth=np.zeros((120, 160), np.float32)), start)
    assert empty.declined
    assert "0 pixels of the image have a depth" in empty.reason
    np.testing.assert_allclose(empty.world_from_camera, start, atol=1e-15)
    masked = Query(camera=CAMERA, depth=see(start), mask=np.zeros((120, 160), bool))
    assert "of the mask" in refine_with_depth(model, masked, start).reason


def test_a_query_without_depth_or_of_another_size_is_an_error(model):
    with pytest.raises(InputError, match="no depth image"):
        refine_with_depth(model, Query(camera=CAMERA), POSES[0])
    with pytest.raises(InputError, match="its depth has 80×60 pixels, its camera 160×120"):
        Query(camera=CAMERA, depth=np.zeros((60, 80), np.float32))


def test_interpolation_does_not_shrink_a_ball(device):
    # A trilinear field of exact distances lies above them: its zero is inside a ball, by h²/(6 R) on average.
    model = ball_model(device)
    to_balls = np.sort(np.linalg.norm(sphere_points()[:, None] - CENTRES, axis=2) - RADII, axis=1)
    found, _normals, sources = model.sample(sphere_points()[to_balls[:, 1] > 4 * VOXEL])
    shrunk = VOXEL**2 / (6 * RADII.max())
    assert abs(found[sources == FROM_VOLUME].mean()) < 0.15 * shrunk
