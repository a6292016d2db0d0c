import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, icosphere, write_dataset

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from fusion.evaluation.evaluate import Observers, evaluate, sample_surface
from fusion.evaluation.observed_surface import observed_points
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh


def mesh_of(shape):
    return Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))


def part_of(shape, chosen):
    return shape.submesh([np.flatnonzero(chosen)], append=True)


def test_distances_agree_with_trimesh(device):
    shape = trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)
    points = np.random.default_rng(0).normal(size=(300, 3))
    corners = shape.triangles
    expected = [
        np.linalg.norm(trimesh.triangles.closest_point(corners, np.tile(p, (len(corners), 1))) - p, axis=1).min()
        for p in points
    ]
    np.testing.assert_allclose(closest_points(mesh_of(shape), points, device=device).distances, expected, atol=1e-6)


def test_distances_keep_their_digits_far_from_the_origin(device):
    shape = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    shape.apply_translation((100, 200, 300))
    mesh = mesh_of(shape)
    points = mesh.vertices[:50].astype(float) + 0.0123 * np.asarray(shape.vertex_normals[:50])
    distances = closest_points(mesh, points, device=device).distances
    np.testing.assert_allclose(distances, 0.0123, rtol=0.02)


def test_samples_are_spread_by_area_and_lie_on_the_surface(device):
    # One face of the box has half the area of another, and should have half of its samples.
    shape = trimesh.creation.box(extents=(1, 1, 2))
    samples = sample_surface(mesh_of(shape), 50_000, rng=np.random.default_rng(3))
    top = np.isclose(samples.points[:, 2], 1)
    side = np.isclose(samples.points[:, 0], 0.5)
    assert side.sum() / top.sum() == pytest.approx(2, rel=0.05)
    assert np.abs(samples.normals[top] - (0, 0, 1)).max() < 1e-12
    assert closest_points(mesh_of(shape), samples.points, device=device).distances.max() < 1e-6


def test_parallel_planes_are_their_distance_apart(device):
    plane = trimesh.creation.box(extents=(1, 1, 1e-9))
    raised = plane.copy()
    raised.apply_translation((0, 0, 0.01))
    metrics = evaluate(mesh_of(raised), mesh_of(plane), thresholds=(0.005, 0.02), device=device, voxel_size=0.005)
    for name in ("accuracy", "completeness", "chamfer"):
        assert metrics[f"{name}_m"] == pytest.approx(0.01, rel=1e-3)
        assert metrics[f"{name}_voxels"] == pytest.approx(2, rel=1e-3)
    assert metrics["fscore"] == 0
    assert metrics["fscores"][1]["fscore"] == 1
    assert metrics["normal_consistency"] == pytest.approx(1)


def test_a_mesh_equals_itself(device):
    shape = mesh_of(trimesh.creation.icosphere(subdivisions=4))
    metrics = evaluate(shape, shape, thresholds=(1e-5,), device=device)
    assert metrics["chamfer_m"] < 1e-6
    assert metrics["fscore"] == 1
    assert metrics["normal_consistency"] > 0.999


def test_half_a_surface_is_accurate_but_not_complete(device):
    whole = trimesh.creation.icosphere(subdivisions=4)
    half = part_of(whole, whole.triangles_center[:, 2] > 0)
    metrics = evaluate(mesh_of(half), mesh_of(whole), thresholds=(0.01,), device=device)
    assert metrics["accuracy_m"] < 1e-5
    assert metrics["completeness_m"] > 0.2
    assert metrics["fscores"][0]["precision"] == 1
    assert metrics["fscores"][0]["recall"] == pytest.approx(0.5, abs=0.02)


def test_only_what_a_camera_sees_is_observed(device, tmp_path):
    # From distance D, a sphere's visible cap lies beyond the plane n · p = r² / D.
    scene = SphereScene()
    (pose,) = scene.poses_around(1)
    dataset = open_dataset(write_dataset(tmp_path, [scene.frame(0, pose)]))
    vertices, triangles = icosphere(scene)
    truth = Mesh(vertices=vertices.astype(np.float32), triangles=triangles.astype(np.int32))
    towards = vertices - scene.centre
    height = towards @ (pose[:3, 3] - scene.centre)
    observed = observed_points(vertices, towards / scene.radius, truth, dataset, (0,), device=device)
    limit = scene.radius**2
    # Near the limb the sphere bends away within a pixel: what is seen so slantingly may go either way.
    assert observed[height > 1.9 * limit].all()
    assert not observed[height < 0.9 * limit].any()


def test_the_truth_is_culled_to_what_the_frames_saw(device, tmp_path):
    scene = SphereScene()
    dataset = open_dataset(write_dataset(tmp_path, [scene.frame(0, scene.poses_around(1)[0])]))
    vertices, triangles = icosphere(scene)
    truth = Mesh(vertices=vertices.astype(np.float32), triangles=triangles.astype(np.int32))
    centre_m = np.array(scene.centre)
    direction = scene.poses_around(1)[0][:3, 3] - centre_m
    shape = trimesh.Trimesh(vertices, triangles)
    shape = part_of(shape, (shape.triangles_center - centre_m) @ direction > 0.2 * scene.radius)
    options = {"thresholds": (0.01,), "device": device}
    seen = Observers(dataset=dataset, frame_ids=(0,))
    assert evaluate(mesh_of(shape), truth, **options)["completeness_m"] > 0.05
    assert evaluate(mesh_of(shape), truth, observed_by=seen, **options)["completeness_m"] < 0.002


def test_a_truth_that_no_frame_sees_is_an_error(device, tmp_path):
    scene = SphereScene()
    dataset = open_dataset(write_dataset(tmp_path, [scene.frame(0, scene.poses_around(1)[0])]))
    elsewhere = trimesh.creation.icosphere(radius=0.1)
    elsewhere.apply_translation((50, 0, 0))
    seen = Observers(dataset=dataset, frame_ids=(0,))
    with pytest.raises(InputError, match="see nothing of the ground truth"):
        evaluate(mesh_of(elsewhere), mesh_of(elsewhere), thresholds=(0.1,), device=device, observed_by=seen)
