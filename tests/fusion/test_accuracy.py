"""How exact is what exact frames are fused to? A sphere before a wall, both known in closed form."""

import numpy as np
import pytest
from synthetic_scene import SphereScene

from datagen.camera import PinholeCamera
from fusion.evaluation.evaluate import sample_surface
from fusion.frames.frame_batch import MAX_BATCH, FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.volume.tsdf_volume import Volume

CAMERA = PinholeCamera(width=320, height=240, fx=262.5, fy=262.5, cx=159.5, cy=119.5)
SCENE = SphereScene(wall_z=-0.4)
VOXEL_SIZE = 0.008
EXACT = Integration(depth_sampling="bilinear", drop_off=True)


@pytest.fixture(scope="module")
def frames():
    above = [pose for pose in SCENE.poses_around(48) if pose[2, 3] > SCENE.centre[2] + 0.1]
    return [SCENE.frame(i, pose, CAMERA) for i, pose in enumerate(above[:MAX_BATCH])]


def fused(frames, device, options):
    lengths = {"voxel_size": VOXEL_SIZE, "truncation": 3 * VOXEL_SIZE}
    volume = Volume(device=device, max_blocks=10**6, **lengths)
    upload = FrameUploader(CAMERA, device=device)
    batch = upload([f.depth for f in frames], [f.world_from_camera for f in frames], [f.color for f in frames])
    find_batch_blocks(volume.table, batch, **lengths)
    volume.table.sort()
    volume.reserve(volume.table.count)
    integrate_batch(volume, batch, options)
    return marching_cubes(volume)


def samples(mesh: Mesh):
    """Return how far points on the mesh are from the truth, in voxels, cos of their normals, which are the sphere's."""
    drawn = sample_surface(mesh, 50_000, rng=np.random.default_rng(0))
    offsets = drawn.points - np.array(SCENE.centre)
    radii = np.linalg.norm(offsets, axis=1)
    to_sphere, to_wall = np.abs(radii - SCENE.radius), np.abs(drawn.points[:, 2] - SCENE.wall_z)
    on_sphere = to_sphere < to_wall
    normals = np.where(on_sphere[:, None], offsets / radii[:, None], [0.0, 0.0, 1.0])
    cosines = np.einsum("ij,ij->i", normals, drawn.normals)
    return np.minimum(to_sphere, to_wall) / VOXEL_SIZE, cosines, on_sphere


def test_exact_frames_make_an_exact_surface(device, frames):
    distances, cosines, on_sphere = samples(fused(frames, device, EXACT))
    assert distances.mean() < 0.01
    assert distances[on_sphere].mean() < 0.06
    assert (distances < 0.5).mean() > 0.999
    assert cosines.mean() > 0.999


def test_no_second_layer_of_surface(device, frames):
    distances, cosines, _ = samples(fused(frames, device, EXACT))
    assert distances.max() < 1
    assert (cosines > 0).all()
