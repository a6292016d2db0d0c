from pathlib import Path

import numpy as np
import trimesh
from synthetic_scene import SphereScene, write_dataset

from datagen.open_dataset import open_dataset
from fusion.integration.fuse import WATCHED_BATCH
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.snapshots import Snapshots, thinned
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh
from fusion.volume.tsdf_volume import Volume

SCENE = SphereScene()
TRUNCATION = 0.06


def test_the_mesh_grows_while_frames_are_fused_and_is_the_same_in_the_end(tmp_path: Path) -> None:
    poses = sorted(SCENE.poses_around(48), key=lambda pose: pose[0, 3])  # from one side to the other
    frames = [SCENE.frame(i, pose) for i, pose in enumerate(poses)]
    dataset = open_dataset(write_dataset(tmp_path / "dataset", frames))
    config = ReconstructionConfig(voxel_size=0.02, truncation=TRUNCATION, device="cpu")
    seen: list[tuple[int, float]] = []
    live = tmp_path / "live.ply"
    write = Snapshots(live, count=3)

    def watch(volume: Volume, done: int, total: int) -> None:
        write(volume, done, total)
        if not live.exists():
            return
        mesh = read_mesh(live)
        live.unlink()
        seen.append((done, float(np.ptp(mesh.vertices[:, 0]))))
        assert np.abs(np.linalg.norm(mesh.vertices - SCENE.centre, axis=1) - SCENE.radius).max() < 0.02

    watched = reconstruct(dataset, tmp_path / "watched", config, watch=watch)
    assert [done for done, _ in seen] == [16, 32, 48]
    assert seen[0][1] < 0.95 * seen[-1][1]
    seen.clear()
    write = Snapshots(live, count=1)
    reconstruct(dataset, tmp_path / "watched", config, watch=watch)
    assert [done for done, _ in seen] == [48]
    alone = reconstruct(dataset, tmp_path / "alone", config)
    # Smaller batches write a packed voxel more often, and each time round its distance by 1.6e-5 of the truncation.
    rounding = 1.6e-5 * TRUNCATION * len(frames) / WATCHED_BATCH
    np.testing.assert_array_equal(watched.mesh.triangles, alone.mesh.triangles)
    heights = [np.linalg.norm(made.mesh.vertices - SCENE.centre, axis=1) for made in (watched, alone)]
    np.testing.assert_allclose(heights[0], heights[1], atol=2 * rounding)


def test_a_large_mesh_is_thinned_and_stays_where_it_was() -> None:
    thin = thinned(_sphere(6), 5000, cell=0.01)
    assert 1000 < len(thin.triangles) <= 5000
    radii = np.linalg.norm(thin.vertices, axis=1)
    assert radii.max() <= 1 + 1e-6
    assert radii.min() > 0.98
    assert thin.colors is not None
    expected = 127.5 + 120 * thin.vertices
    assert np.abs(thin.colors - expected).max() < 8


def test_a_small_mesh_is_left_alone() -> None:
    mesh = _sphere(2)
    assert thinned(mesh, 5000, cell=0.01) is mesh


def _sphere(subdivisions: int) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(
        vertices=sphere.vertices.astype(np.float32),
        triangles=sphere.faces.astype(np.int32),
        colors=np.rint(127.5 + 120 * sphere.vertices).astype(np.uint8),
    )
