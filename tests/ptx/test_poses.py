"""What poses are found by: CUDA's code against the CPU's kernels."""

import numpy as np
import pytest
import trimesh
from three_balls import CAMERA, OFFSET, POSES, ball_model, see, sphere_points

from datagen.camera import PinholeCamera
from datagen.rigid import look_at
from fusion.pose.depth_descent import DepthDescent
from fusion.pose.model_field import FROM_VOLUME
from fusion.pose.nearest_pose import find_nearest_pose
from fusion.pose.normal_equations import TUKEY, Robustness, normal_equations, point_residuals
from fusion.pose.pose_distance import pose_distances
from fusion.pose.query import Query, query_cloud
from fusion.pose.se3 import perturb
from fusion.pose.shape_volume import volume_from_mesh, volume_from_points
from fusion.pose.soft_silhouette import SilhouetteRenderer
from fusion.pose.view_index import index_views
from fusion.pose.view_overlap import overlap, query_view
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh
from ptx.coverage import never_ran

MODULES = [
    f"fusion.pose.{stage}"
    for stage in (
        *(
            "coverage_kernel",
            "depth_descent",
            "distance_grid",
            "model_field",
            "nearest_approach",
            "normal_equations",
            "shape_volume",
        ),
        *("soft_silhouette", "view_costs", "view_index", "view_overlap", "view_registration"),
    )
]
SMALL = PinholeCamera(width=80, height=60, fx=80.0, fy=80.0, cx=39.5, cy=29.5)


@pytest.fixture(scope="module")
def models(cpu, cuda):
    return [ball_model(device) for device in (cpu, cuda)]


def test_the_field_of_a_model_is_the_same(models):
    rng = np.random.default_rng(0)
    points = sphere_points()[::5]
    points = points + rng.normal(scale=0.01, size=points.shape)
    (distances, normals, sources), (there, normals_there, sources_there) = (m.sample(points) for m in models)
    assert (sources == sources_there).mean() > 0.999
    same = (sources == sources_there) & (sources == FROM_VOLUME)
    np.testing.assert_allclose(there[same], distances[same], atol=1e-6)
    np.testing.assert_allclose(normals_there[same], normals[same], atol=1e-3)


def test_the_normal_equations_of_a_view_are_the_same(models):
    query = Query(camera=CAMERA, depth=see(POSES[0]))
    poses = np.stack([perturb(np.full(6, step), POSES[0], pivot_world=OFFSET) for step in (0.0, 0.003, -0.01)])
    found = []
    for model in models:
        cloud = query_cloud(query, device=model.device)
        count = len(cloud.points)
        robustness = Robustness(scales=np.full(3, 2.0), floor=0.001, kind=TUKEY, inlier_within=3.0)
        equations = normal_equations(model, cloud, poses, count=count, pivot_world=OFFSET, robustness=robustness)
        residuals = point_residuals(model, cloud, poses, count=count, floor=0.001, inlier_within=3.0)
        counts = overlap(model, query_view(query, model=model), poses, within=0.005)
        found.append((equations, residuals, counts))
    (expected, residuals, counts), (there, residuals_there, counts_there) = found
    for name in ("hessian", "gradient", "cost", "known", "weight"):
        one, other = getattr(expected, name), getattr(there, name)
        np.testing.assert_allclose(other, one, atol=1e-4 * np.abs(one).max(), err_msg=name)
    known = np.isfinite(residuals) & np.isfinite(residuals_there)
    assert (np.isfinite(residuals) == np.isfinite(residuals_there)).mean() > 0.999
    assert np.quantile(np.abs(residuals - residuals_there)[known], 0.999) < 1e-3
    assert np.abs(counts - counts_there).max() <= 0.001 * counts.sum(axis=1).max()


def test_a_descent_by_depth_arrives_at_the_same_pose(models):
    query = Query(camera=CAMERA, depth=see(POSES[0]))
    start = perturb(np.full(6, 0.004), POSES[0], pivot_world=OFFSET)[None]
    lengths = {"radius_m": 0.05, "floor": 0.001, "enough_m": 1e-5, "sure_m": 1e-4}
    found = []
    for model in models:
        cloud = query_cloud(query, device=model.device)
        descent = DepthDescent(model, cloud, poses=1, count=len(cloud.points), pivot_world=OFFSET, **lengths)
        found.append(descent.descend(start, kind=TUKEY, scales=np.full(1, 0.02), iterations=20))
    assert found[0].iterations < 20
    # The last step is shorter than the length that is enough, and the rest of the way shorter than that.
    np.testing.assert_allclose(found[1].poses, found[0].poses, atol=2 * lengths["enough_m"])


def test_a_soft_silhouette_and_its_slopes_are_the_same(models):
    v, u = np.mgrid[20:70, 50:120]
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)
    expected, found = (
        SilhouetteRenderer(model, CAMERA, pixels, softness_px=1.0, pivot_world=OFFSET, poses=3) for model in models
    )
    # A micrometre and a microradian: near to a crease this much changes which side of it counts, as rounding does.
    nudged = [perturb(np.full(6, step), POSES[0], pivot_world=OFFSET) for step in (0.0, 1e-6, -1e-6)]
    expected, found = (renderer.render(np.stack(nudged)) for renderer in (expected, found))
    apart = np.abs(found.coverage - expected.coverage)
    assert np.quantile(apart, 0.99) < 1e-3  # a grey level of eight bits is four times that
    assert apart.mean() < 1e-4
    scale = np.abs(expected.jacobian).max()
    assert scale > 1
    own_change = np.abs(expected.jacobian - expected.jacobian[:1]).max(axis=0)
    difference = np.abs(found.jacobian - expected.jacobian)[0]
    assert np.quantile((difference - own_change).max(axis=-1), 0.99) < 1e-3 * scale


def test_the_volume_of_a_mesh_is_the_same(cpu, cuda):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    mesh = Mesh(vertices=np.asarray(ball.vertices, np.float32), triangles=np.asarray(ball.faces, np.int32))
    volumes = [volume_from_mesh(mesh, voxel_size=0.02, device=device) for device in (cpu, cuda)]
    sums = [volume.arrays()["distance_sum"].numpy() for volume in volumes]
    assert (sums[0] < 0).any()
    np.testing.assert_allclose(sums[1], sums[0], atol=1e-5)


def test_the_volume_of_points_is_the_same(cpu, cuda):
    points = sphere_points()[::8]
    volumes = [volume_from_points(points, voxel_size=0.02, device=device) for device in (cpu, cuda)]
    sums = [volume.arrays()["distance_sum"].numpy() for volume in volumes]
    assert (sums[0] < 0).any()
    np.testing.assert_allclose(sums[1], sums[0], atol=1e-5)


def test_the_nearest_pose_is_the_same(cpu, cuda):
    parts = [((0.5, 0.3, 0.2), (0, 0, 0)), ((0.1, 0.1, 0.5), (0.2, 0.1, 0.1)), ((0.3, 0.08, 0.1), (-0.2, -0.15, 0.15))]
    shape = trimesh.util.concatenate(
        [trimesh.creation.box(extents, trimesh.transformations.translation_matrix(at)) for extents, at in parts]
    )
    mesh = Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))
    angles = np.arange(8) * np.pi / 4
    poses = [look_at((np.cos(a), np.sin(a), 0.6 + 0.1 * np.sin(3 * a)), (0, 0, 0)) for a in angles]
    truth = look_at((np.cos(1.1), np.sin(1.1), 0.5), (0.02, 0, 0))
    depth = cast_rays_at_mesh(mesh, SMALL, [truth], device=cpu, depth_only=True).depth.numpy()[0]
    found = [find_nearest_pose(index_views(mesh, poses, SMALL, device=device), depth) for device in (cpu, cuda)]
    assert found[0].index == found[1].index
    np.testing.assert_allclose(found[1].scores, found[0].scores, rtol=1e-3, atol=1e-6)
    # Both estimates are where the alignment settles: a hundredth of the distance between the views apart at most.
    apart = pose_distances(found[0].estimate[None], found[1].estimate, depth=1.0)
    assert apart[0] < 0.01 * pose_distances(poses[0][None], poses[1], depth=1.0)[0]


def test_every_kernel_of_these_ran(machine):
    assert never_ran(machine, MODULES) == []
    assert "fusion.pose.coverage_kernel:_coverage:backward" in machine.launched
