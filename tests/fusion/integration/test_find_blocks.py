import numpy as np
import pytest
from synthetic_scene import CAMERA as SCENE_CAMERA
from synthetic_scene import SphereScene

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import inverse, look_at, transform_points
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks
from fusion.volume.block_table import BlockTable

CAMERA = PinholeCamera(width=45, height=37, fx=40.0, fy=42.0, cx=21.7, cy=17.2)


def band_voxels(depth, world_from_camera, *, voxel_size, truncation, camera=CAMERA):
    """Return the lattice coordinates of all voxels that equation (1) puts within the truncation band."""
    points = transform_points(world_from_camera, camera.back_project(depth)[depth > 0])
    reach = truncation * 2 + voxel_size * 2
    low, high = np.floor((points.min(0) - reach) / voxel_size), np.ceil((points.max(0) + reach) / voxel_size)
    lattice = np.stack(np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
    lattice = lattice.reshape(-1, 3)
    camera_points = transform_points(inverse(world_from_camera), lattice * voxel_size)
    lattice, camera_points = lattice[camera_points[:, 2] > 0], camera_points[camera_points[:, 2] > 0]
    u, v = np.floor(camera.project(camera_points) + 0.5).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    seen = np.where(inside, depth[v.clip(0, camera.height - 1), u.clip(0, camera.width - 1)], 0)
    return lattice[(seen > 0) & (np.abs(seen - camera_points[:, 2]) <= truncation)].astype(int)


def rough_depth(rng):
    """A depth image with steps, slopes, holes and single stray pixels."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = 1.2 + 0.02 * u - 0.013 * v + 0.3 * (u > rng.integers(10, 35)) + 0.5 * (v > rng.integers(10, 30))
    depth[rng.random(depth.shape) < 0.05] += 0.8
    depth[rng.random(depth.shape) < 0.2] = 0
    return depth.astype(np.float32)


def blocks_found(frames, camera, device, *, voxel_size, truncation, table=None):
    """Return the blocks that (depth, pose) frames add to a table, a new one by default."""
    table = table or BlockTable(device=device, max_blocks=100_000, capacity=64)
    before = table.count
    depths, poses = zip(*frames, strict=True)
    batch = FrameUploader(camera, device=device, capacity=len(frames))(depths, poses)
    find_batch_blocks(table, batch, truncation=truncation, voxel_size=voxel_size)
    return {tuple(block) for block in table.blocks.numpy()[before : table.count]}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("voxel_size", "voxels"), [(0.02, 3), (0.05, 2), (0.03, 7)])
def test_no_block_of_the_truncation_band_is_missed(device, seed, voxel_size, voxels):
    rng = np.random.default_rng(seed)
    frames = [(rough_depth(rng), look_at(rng.normal(size=3), rng.normal(size=3))) for _ in range(2)]
    lengths = {"voxel_size": voxel_size, "truncation": voxels * voxel_size}
    given = blocks_found(frames, CAMERA, device, **lengths)
    needed = {
        tuple(block) for depth, pose in frames for block in np.unique(band_voxels(depth, pose, **lengths) // 8, axis=0)
    }
    assert needed
    assert needed <= given


def test_few_blocks_beside_the_band_are_taken_on_smooth_surfaces(device):
    frame = SphereScene().frames_around(4)[1]
    lengths = {"voxel_size": 0.01, "truncation": 0.04}
    found = blocks_found([(frame.depth, frame.world_from_camera)], SCENE_CAMERA, device, **lengths)
    voxels = band_voxels(frame.depth, frame.world_from_camera, camera=SCENE_CAMERA, **lengths)
    assert len(found) < 1.6 * len(np.unique(voxels // 8, axis=0))


def test_found_blocks_depend_on_the_frames_alone(device):
    frames = [(f.depth, f.world_from_camera) for f in SphereScene(wall_z=-0.5).frames_around(4)]
    lengths = {"voxel_size": 0.01, "truncation": 0.04}
    fresh = [blocks_found([frame], SCENE_CAMERA, device, **lengths) for frame in frames]
    table = BlockTable(device=device, max_blocks=10**5)
    one_by_one = [blocks_found([frame], SCENE_CAMERA, device, table=table, **lengths) for frame in frames]
    assert set.union(*one_by_one) == set.union(*fresh)
    assert blocks_found(frames, SCENE_CAMERA, device, **lengths) == set.union(*fresh)


def test_frames_without_a_valid_depth_find_nothing(device):
    empty = (np.zeros((CAMERA.height, CAMERA.width), np.float32), np.eye(4))
    assert blocks_found([empty], CAMERA, device, voxel_size=0.01, truncation=0.04) == set()


def test_a_stray_depth_asks_for_few_blocks(device):
    depth = np.full((CAMERA.height, CAMERA.width), 1.0, np.float32)
    lengths = {"voxel_size": 0.02, "truncation": 0.06}
    clean = blocks_found([(depth, np.eye(4))], CAMERA, device, **lengths)
    depth[20, 20] = 50.0
    spoilt = blocks_found([(depth, np.eye(4))], CAMERA, device, **lengths)
    assert clean <= spoilt
    # A tile at 50 m is 10 m wide: 62 × 62 blocks of 16 cm, two to three deep.
    assert len(spoilt - clean) < 3 * 70**2


def test_surfaces_too_far_to_be_numbered_are_refused(device):
    depth = np.full((CAMERA.height, CAMERA.width), 1.0, np.float32)
    pose = np.eye(4)
    pose[0, 3] = 9000.0
    with pytest.raises(InputError, match=r"more than 8\.39e\+03 m from the world's origin"):
        blocks_found([(depth, pose)], CAMERA, device, voxel_size=0.001, truncation=0.004)
