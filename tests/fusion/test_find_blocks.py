import numpy as np
import pytest
from synthetic_scene import CAMERA as SCENE_CAMERA
from synthetic_scene import SphereScene

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, look_at, transform_points
from fusion.block_table import BlockTable
from fusion.find_blocks import find_blocks
from fusion.frame_batch import FrameUploader

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


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("voxel_size", "voxels"), [(0.02, 3), (0.05, 2), (0.03, 7)])
def test_no_block_of_the_truncation_band_is_missed(device, seed, voxel_size, voxels):
    rng = np.random.default_rng(seed)
    poses = [look_at(rng.normal(size=3), rng.normal(size=3)) for _ in range(2)]
    depths = [rough_depth(rng) for _ in poses]
    truncation = voxels * voxel_size
    batch = FrameUploader(CAMERA, device=device, capacity=2)(depths, poses)
    table = BlockTable(device=device, max_blocks=100_000, capacity=64)
    found = find_blocks(table, batch, truncation=truncation, voxel_size=voxel_size)
    blocks = table.blocks.numpy()[found.numbers.numpy()]
    masks = found.frame_masks.numpy()
    for frame, (depth, pose) in enumerate(zip(depths, poses, strict=True)):
        voxels_needed = band_voxels(depth, pose, voxel_size=voxel_size, truncation=truncation)
        needed = {tuple(block) for block in np.unique(voxels_needed // 8, axis=0)}
        given = {tuple(block) for block in blocks[masks >> frame & 1 == 1]}
        assert needed
        assert needed <= given


def test_few_blocks_beside_the_band_are_taken_on_smooth_surfaces(device):
    frame = SphereScene().frames_around(4)[1]
    batch = FrameUploader(SCENE_CAMERA, device=device)([frame.depth], [frame.world_from_camera])
    found = find_blocks(BlockTable(device=device, max_blocks=10**5), batch, truncation=0.04, voxel_size=0.01)
    voxels = band_voxels(frame.depth, frame.world_from_camera, voxel_size=0.01, truncation=0.04, camera=SCENE_CAMERA)
    assert len(found) < 1.6 * len(np.unique(voxels // 8, axis=0))


def test_found_blocks_depend_on_the_frames_alone(device):
    scene = SphereScene(wall_z=-0.5)
    frames = scene.frames_around(4)
    upload = FrameUploader(SCENE_CAMERA, device=device)

    def found_by(table, some):
        batch = upload([f.depth for f in some], [f.world_from_camera for f in some])
        found = find_blocks(table, batch, truncation=0.04, voxel_size=0.01)
        return {tuple(block) for block in table.blocks.numpy()[found.numbers.numpy()]}

    fresh = [found_by(BlockTable(device=device, max_blocks=10**5), [frame]) for frame in frames]
    shared = BlockTable(device=device, max_blocks=10**5)
    assert [found_by(shared, [frame]) for frame in frames] == fresh
    assert found_by(BlockTable(device=device, max_blocks=10**5), frames) == set.union(*fresh)
