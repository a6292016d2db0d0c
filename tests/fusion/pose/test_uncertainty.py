import numpy as np
import pytest

from fusion.pose.uncertainty import clustered_uncertainty, describe_direction, uncertainty


def normal_equations(points, normals):
    jacobian = np.hstack([normals, np.cross(points, normals)])
    return jacobian.T @ jacobian


def grid(count=11, side=0.2):
    line = np.linspace(-side, side, count)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def known(hessian, radius=0.15):
    return uncertainty(hessian, sigma=0.002, pivot_world=np.zeros(3), radius_m=radius)


def test_a_plane_fixes_three_directions_and_names_the_three_that_slide():
    points = grid()
    found = known(normal_equations(points, np.tile([0.0, 0, 1], (len(points), 1))))
    # Its normal's direction, and the two turns that tilt it: in closed form.
    assert found.covariance[2, 2] == pytest.approx(0.002**2 / len(points))
    assert found.covariance[3, 3] == pytest.approx(0.002**2 / (points[:, 1] ** 2).sum())
    assert len(found.weak) == 3
    assert "turning about the model's z" in found.weak
    assert found.condition > 1e6


def test_a_ball_fixes_its_place_and_no_turn():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = known(normal_equations(0.1 * normals, normals))
    assert len(found.weak) == 3
    assert all(name.startswith("turning about") for name in found.weak)
    assert np.sqrt(np.diag(found.covariance)[:3]).max() < 2e-4


def test_a_corner_of_three_planes_has_no_weak_direction():
    floor = grid()
    walls = [(floor, [0, 0, 1.0]), (floor[:, [2, 0, 1]], [1.0, 0, 0]), (floor[:, [1, 2, 0]], [0, 1.0, 0])]
    points = np.concatenate([points for points, _ in walls])
    normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in walls])
    found = known(normal_equations(points, normals))
    assert found.weak == ()
    # Drawn residuals scatter the solution as the covariance says.
    rng = np.random.default_rng(1)
    jacobian = np.hstack([normals, np.cross(points, normals)])
    drawn = np.stack(
        [np.linalg.lstsq(jacobian, 0.002 * rng.standard_normal(len(jacobian)), rcond=None)[0] for _ in range(800)]
    )
    np.testing.assert_allclose(np.cov(drawn.T), found.covariance, atol=0.15 * found.covariance.diagonal().max())


def test_more_points_make_it_surer_by_their_root():
    points = grid()
    once = normal_equations(points, points / 0.2 + [0, 0, 1.0])
    np.testing.assert_allclose(known(once).deviations_m, 2 * known(4 * once).deviations_m)


@pytest.mark.parametrize("bend", [-1.0, 0.0])
def test_a_cost_of_outliers_alone_that_bends_downwards_fixes_nothing(bend):
    rng = np.random.default_rng(2)
    jacobian, count = rng.normal(size=(50, 6)), 50
    clusters, weights = np.arange(count) // 5, np.full(count, 0.1)
    found = clustered_uncertainty(
        jacobian,
        rng.normal(size=count),
        weights,
        clusters,
        pivot_world=np.zeros(3),
        radius_m=0.1,
        bends=np.full(count, bend),
    )
    assert np.isfinite(found.covariance).all()
    assert found.deviations_m.min() > 1e3


def test_directions_are_named_by_what_moves():
    assert describe_direction(np.array([0, 0, 0, 0, 0, -1.0])) == "turning about the model's z"
    assert describe_direction(np.array([0, 1.0, 0, 0, 0, 0])) == "sliding along the model's y"
    assert describe_direction(np.array([-0.6, 0.8, 0, 0, 0, 0])) == "sliding along (-0.60, 0.80, 0.00)"
    # About an axis one radius aside, and as a screw.
    assert describe_direction(np.array([0, 0.7, 0, 0.7, 0, 0])) == "turning about the model's x"
    assert "while turning about the model's x" in describe_direction(np.array([0.7, 0, 0, 0.7, 0, 0]))
