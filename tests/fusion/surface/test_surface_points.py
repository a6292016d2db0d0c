import numpy as np
import pytest
import trimesh
from analytic_volume import analytic_volume, sphere

from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.surface_points import PointCloud, points_of, write_points
from fusion.volume.tsdf_volume import Volume

CENTRE, RADIUS = np.array([0.05, 0.02, -0.03]), 0.4


@pytest.mark.parametrize("storage", ["full", "packed"])
def test_points_lie_on_the_surface_with_its_normals_and_colours(device, storage):
    volume = analytic_volume(
        sphere(CENTRE, RADIUS),
        (-0.6,) * 3,
        (0.6,) * 3,
        device=device,
        voxel_size=0.02,
        truncation=0.08,
        storage=storage,
        color=lambda points: np.where(points[:, :1] > CENTRE[0], (200.0, 40.0, 20.0), (20.0, 40.0, 200.0)),
    )
    cloud = points_of(marching_cubes(volume, normals=True))
    radial = (cloud.points - CENTRE) / RADIUS
    np.testing.assert_allclose(np.linalg.norm(radial, axis=-1), 1, atol=1e-3)
    np.testing.assert_allclose(cloud.normals, radial, atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=-1), 1, atol=1e-5)
    red = cloud.points[:, 0] > CENTRE[0] + 0.02
    assert (cloud.colors[red] == (200, 40, 20)).all()
    # One point on each edge that the surface crosses: the sphere's area in voxels, 1.5 times.
    assert len(cloud.points) == pytest.approx(1.5 * 4 * np.pi * (RADIUS / 0.02) ** 2, rel=0.05)


def test_an_empty_volume_has_no_points(device):
    volume = Volume(voxel_size=0.1, truncation=0.3, device=device, max_blocks=10)
    cloud = points_of(marching_cubes(volume, normals=True))
    assert cloud.points.shape == cloud.normals.shape == cloud.colors.shape == (0, 3)


def test_points_come_back_from_the_file(tmp_path):
    rng = np.random.default_rng(0)
    points, normals = (rng.normal(size=(50, 3)).astype(np.float32) for _ in range(2))
    colors = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    write_points(tmp_path / "points.ply", PointCloud(points=points, normals=normals, colors=colors))
    loaded = trimesh.load(tmp_path / "points.ply", process=False)
    assert isinstance(loaded, trimesh.PointCloud)
    np.testing.assert_array_equal(loaded.vertices, points)
    np.testing.assert_array_equal(loaded.colors[:, :3], colors)
    # trimesh drops a point cloud's normals: they are what the header says they are.
    fields = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.column_stack([fields[name] for name in ("nx", "ny", "nz")]), normals)
