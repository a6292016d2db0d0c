import dataclasses

import numpy as np
import pytest
from synthetic_scene import CAMERA, SphereScene

from datagen.rigid import inverse, transform_points
from fusion.block_table import BLOCK_VOXELS
from fusion.depth_tiles import depth_tiles
from fusion.find_blocks import find_blocks
from fusion.frame_batch import FrameUploader
from fusion.integrate import integrate_frames
from fusion.integration import Integration
from fusion.marching_cubes import marching_cubes
from fusion.visible_blocks import visible_blocks
from fusion.volume import Volume

VOXEL_SIZE, TRUNCATION = 0.02, 0.07
SUMS = ("distance_sum", "weight", "color_sum", "color_weight")


def fuse(frames, device, *, batch_size=32, order=None, blocks_of=None):
    """Integrate ``frames``, in batches, into the blocks that ``blocks_of`` (the same frames) touch."""
    volume = Volume(voxel_size=VOXEL_SIZE, truncation=TRUNCATION, device=device, max_blocks=10**5)
    upload = FrameUploader(CAMERA, device=device)
    for batch in batches(upload, blocks_of or frames, 32):
        tiles = depth_tiles(batch, split_beyond=2 * TRUNCATION)
        find_blocks(volume.table, batch, tiles, truncation=TRUNCATION, voxel_size=VOXEL_SIZE)
    volume.table.sort()
    volume.reserve(volume.table.count)
    for batch in batches(upload, [frames[i] for i in order] if order is not None else frames, batch_size):
        tiles = depth_tiles(batch, split_beyond=2 * TRUNCATION)
        integrate_frames(volume, batch, visible_blocks(volume, batch, tiles), Integration())
    return volume


def batches(upload, frames, size):
    for first in range(0, len(frames), size):
        some = frames[first : first + size]
        yield upload([f.depth for f in some], [f.world_from_camera for f in some], [f.color for f in some])


def by_block(volume):
    """Return {block coordinates: (512, 6) sums}."""
    count = volume.table.count
    arrays = volume.arrays()
    columns = [arrays[name].numpy()[: count * BLOCK_VOXELS].reshape(count, BLOCK_VOXELS, -1) for name in SUMS]
    return dict(zip(map(tuple, volume.table.blocks.numpy()[:count].tolist()), np.concatenate(columns, 2), strict=True))


def reference(frames, block):
    """Equations (1) to (5) for one block's voxels: every frame, one after the other, as running averages in float64."""
    local = np.arange(BLOCK_VOXELS)
    lattice = 8 * np.array(block) + np.stack([local % 8, local // 8 % 8, local // 64], -1)
    distance, weight = np.ones(BLOCK_VOXELS), np.zeros(BLOCK_VOXELS)
    color, color_weight = np.zeros((BLOCK_VOXELS, 3)), np.zeros(BLOCK_VOXELS)
    nearest_tie = np.full(BLOCK_VOXELS, np.inf)
    for frame in frames:
        points = transform_points(inverse(frame.world_from_camera), lattice * VOXEL_SIZE)
        pixels = CAMERA.project(points)
        u, v = np.floor(pixels + 0.5).astype(int).T
        inside = (points[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        d_pixel = np.where(inside, frame.depth[v % CAMERA.height, u % CAMERA.width], 0)
        d = d_pixel - points[:, 2]
        new = (d_pixel > 0) & (d >= -TRUNCATION)
        t_d = np.maximum(-1, np.minimum(1, d / TRUNCATION))
        distance = np.where(new, (weight * distance + t_d) / (weight + 1), distance)
        weight += new
        near = new & (d <= TRUNCATION)
        seen = frame.color[v % CAMERA.height, u % CAMERA.width]
        updated = (color_weight[:, None] * color + seen) / (color_weight[:, None] + 1)
        color = np.where(near[:, None], updated, color)
        color_weight += near
        # Where rounding in float32 may take the neighbouring pixel, or the other side of the band, nothing is compared.
        tie = np.minimum(np.abs(pixels + 0.5 - np.round(pixels + 0.5)).min(1), np.abs(np.abs(d) - TRUNCATION) * 100)
        nearest_tie = np.minimum(nearest_tie, tie)
    return distance, weight, color, color_weight, nearest_tie > 1e-3


@pytest.fixture(scope="module")
def frames():
    return SphereScene(wall_z=-0.4).frames_around(7)


def test_every_voxel_follows_the_papers_equations(device, frames):
    # Every frame has its say in every block: that frames are left out where they see nothing must not show.
    volume = fuse(frames, device)
    compared = 0
    for block, sums in by_block(volume).items():
        distance, weight, color, color_weight, clear = reference(frames, block)
        np.testing.assert_array_equal(sums[clear, 1], weight[clear])
        np.testing.assert_array_equal(sums[clear, 5], color_weight[clear])
        seen, colored = clear & (weight > 0), clear & (color_weight > 0)
        np.testing.assert_allclose(sums[seen, 0] / sums[seen, 1], distance[seen], atol=1e-5)
        np.testing.assert_allclose(sums[colored, 2:5] / sums[colored, 5:], color[colored], atol=1e-3)
        compared += seen.sum()
    assert compared > 20_000


@pytest.mark.parametrize("batch_size", [1, 3])
def test_batches_of_any_size_make_the_same_volume(device, frames, batch_size):
    whole, parts = by_block(fuse(frames, device)), by_block(fuse(frames, device, batch_size=batch_size))
    assert whole.keys() == parts.keys()
    for block, sums in whole.items():
        np.testing.assert_allclose(parts[block], sums, rtol=1e-5, atol=1e-5)


def test_the_order_of_the_frames_does_not_matter(device, frames):
    forwards = by_block(fuse(frames, device))
    backwards = by_block(fuse(frames, device, order=range(len(frames))[::-1]))
    assert forwards.keys() == backwards.keys()
    for block, sums in forwards.items():
        np.testing.assert_allclose(backwards[block], sums, rtol=1e-5, atol=1e-5)


def test_a_mistake_of_one_frame_is_outvoted_by_those_that_see_through_it(device):
    clean = SphereScene(wall_z=-0.4).frames_around(12)[0]
    spoilt = clean.depth.copy()
    spoilt[50:62, 70:82] = 0.5
    wrong = dataclasses.replace(clean, depth=spoilt)

    def nearest_vertex(frames):
        vertices = marching_cubes(fuse(frames, device)).vertices
        return np.linalg.norm(vertices - clean.world_from_camera[:3, 3], axis=1).min()

    assert nearest_vertex([wrong]) < 0.6
    assert nearest_vertex([wrong, clean, clean]) > 0.6


def test_a_batch_that_sees_nothing_changes_nothing(device, frames):
    blind = dataclasses.replace(frames[0], depth=np.zeros_like(frames[0].depth))
    with_blind, without = by_block(fuse([*frames, blind], device, batch_size=7)), by_block(fuse(frames, device))
    assert with_blind.keys() == without.keys()
    for block, sums in without.items():
        np.testing.assert_array_equal(with_blind[block], sums)


def test_a_voxel_that_no_frame_saw_keeps_weight_zero(device, frames):
    # Behind the only frame's surface, beyond the truncation, nothing is known.
    frame = frames[0]
    camera_from_world = inverse(frame.world_from_camera)
    hidden = 0
    for block, sums in by_block(fuse([frame], device)).items():
        local = np.arange(BLOCK_VOXELS)
        lattice = 8 * np.array(block) + np.stack([local % 8, local // 8 % 8, local // 64], -1)
        points = transform_points(camera_from_world, lattice * VOXEL_SIZE)
        u, v = np.floor(CAMERA.project(points) + 0.5).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        d = np.where(inside, frame.depth[v % CAMERA.height, u % CAMERA.width], 0) - points[:, 2]
        assert (sums[inside & (d < -TRUNCATION - 1e-5), 1] == 0).all()
        hidden += (inside & (d < -TRUNCATION)).sum()
    assert hidden > 100
