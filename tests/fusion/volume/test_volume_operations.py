import numpy as np
import pytest
from analytic_volume import analytic_volume, sphere, voxel_centres
from synthetic_scene import CAMERA, SphereScene

from datagen.errors import InputError
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_operations import crop, merge, to_storage

VOXEL_SIZE, TRUNCATION = 0.03, 0.09
STORAGES = ["full", "packed"]


def fused(frames, device, *, storage="full", blocks_of=None):
    """Integrate frames into the blocks that ``blocks_of`` touch, by default the frames themselves."""
    volume = Volume(voxel_size=VOXEL_SIZE, truncation=TRUNCATION, device=device, max_blocks=10**4, storage=storage)
    for chosen in (blocks_of or frames, frames):
        batch = FrameUploader(CAMERA, device=device)(
            [f.depth for f in chosen], [f.world_from_camera for f in chosen], [f.color for f in chosen]
        )
        find_batch_blocks(volume.table, batch, truncation=TRUNCATION, voxel_size=VOXEL_SIZE)
    volume.reserve(volume.table.count)
    integrate_batch(volume, batch, Integration())
    return volume


def sums_by_block(volume):
    """Return {block: (512, 6) sums} of a volume, whatever its storage."""
    full = to_storage(volume, "full")
    arrays = {name: array.numpy() for name, array in full.arrays().items()}
    table = np.column_stack([arrays[n] for n in ("distance_sum", "weight", "color_weight", "color_sum")])
    blocks = full.table.blocks.numpy()[: full.table.count]
    return {tuple(block): sums for block, sums in zip(blocks.tolist(), table.reshape(-1, 512, 6), strict=True)}


@pytest.fixture(scope="module")
def halves():
    frames = SphereScene(wall_z=-0.5).frames_around(12)
    order = np.random.default_rng(3).permutation(12)
    return frames, [frames[i] for i in order[:5]], [frames[i] for i in order[5:]]


def test_merging_halves_is_one_pass_over_all_frames(device, halves):
    frames, some, others = halves
    merged = merge([fused(some, device, blocks_of=frames), fused(others, device, blocks_of=frames)])
    expected, found = sums_by_block(fused(frames, device)), sums_by_block(merged)
    assert merged.storage == "full"
    assert expected.keys() == found.keys()
    for block, sums in expected.items():
        # Distances of both signs cancel: what is relative is relative to the weight.
        scale = np.maximum(np.abs(sums), sums[:, 1:2])
        assert (np.abs(found[block] - sums) <= 1e-5 * scale).all()
    assert sum((sums[:, 1] > 1).sum() for sums in found.values()) > 10_000


def test_merging_packed_halves_is_right_to_the_packing(device, halves):
    frames, some, others = halves
    merged = merge([fused(half, device, storage="packed", blocks_of=frames) for half in (some, others)])
    expected, found = sums_by_block(fused(frames, device)), sums_by_block(merged)
    assert merged.storage == "packed"
    for block, sums in expected.items():
        seen = sums[:, 1] > 0
        ours, exact = found[block][seen], sums[seen]
        np.testing.assert_array_equal(ours[:, 1], exact[:, 1])
        # Three writes, each to half a step of 1/32767, and one more level of colour each.
        assert np.abs(ours[:, 0] - exact[:, 0]).max(initial=0) <= 2.1 / 32767 * exact[:, 1].max(initial=1)
        colored = exact[:, 2] > 0
        np.testing.assert_array_equal(ours[:, 2] > 0, colored)
        averages = [table[colored, 3:] / table[colored, 2:3] for table in (ours, exact)]
        assert np.abs(averages[0] - averages[1]).max(initial=0) < 3


def test_blocks_that_both_have_add_up_and_the_others_are_taken_over(device, halves):
    # Each volume holds only the blocks of its own frames. Where both have a block nothing is lost; a block of one alone
    # lacks what the other's frames saw through it, and is as that one had it.
    _, some, others = halves
    volumes = [fused(half, device) for half in (some, others)]
    one, other = (sums_by_block(volume) for volume in volumes)
    found = sums_by_block(merge(volumes))
    assert found.keys() == one.keys() | other.keys()
    assert one.keys() & other.keys()
    assert one.keys() ^ other.keys()
    none = np.zeros((512, 6), np.float32)
    for block, sums in found.items():
        np.testing.assert_array_equal(sums, one.get(block, none) + other.get(block, none))


def test_merging_is_independent_of_order_and_of_how_many_at_once(device, halves):
    frames, _, _ = halves
    parts = [fused(frames[i::3], device) for i in range(3)]
    at_once, one_by_one = merge(parts), merge([merge(parts[1:]), parts[0]])
    np.testing.assert_array_equal(
        at_once.table.blocks.numpy()[: at_once.table.count], one_by_one.table.blocks.numpy()[: one_by_one.table.count]
    )
    for block, sums in sums_by_block(at_once).items():
        np.testing.assert_allclose(sums_by_block(one_by_one)[block], sums, rtol=1e-5, atol=1e-5)
        break
    mesh, other = marching_cubes(at_once), marching_cubes(one_by_one)
    np.testing.assert_allclose(mesh.vertices, other.vertices, atol=1e-5)


def test_volumes_that_do_not_fit_together_are_refused(device):
    def empty(voxel_size, truncation):
        return Volume(voxel_size=voxel_size, truncation=truncation, device=device, max_blocks=1)

    with pytest.raises(InputError, match=r"voxel size 0\.1 m and 0\.2 m cannot be merged"):
        merge([empty(0.1, 0.4), empty(0.2, 0.4)])
    with pytest.raises(InputError, match=r"truncation 0\.4 m and 0\.5 m cannot be merged"):
        merge([empty(0.1, 0.4), empty(0.1, 0.5)])
    with pytest.raises(InputError, match="no volume was given"):
        merge([])


def sphere_volume(device, storage="full"):
    return analytic_volume(
        sphere(np.array([0.05, 0.02, -0.03]), 0.4),
        (-0.6,) * 3,
        (0.6,) * 3,
        device=device,
        voxel_size=0.02,
        truncation=0.08,
        storage=storage,
        weight=lambda points: np.random.default_rng(1).integers(0, 3000, len(points)).astype(float),
        color=lambda points: np.random.default_rng(2).random(points.shape) * 255,
    )


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((-0.13, -0.2, -0.5), (0.2, 0.31, 0.07)),
        ((-np.inf, -np.inf, 0), (np.inf, np.inf, np.inf)),
        ((-9, -9, -9), (9, 9, 9)),
    ],
)
def test_a_crop_keeps_the_box_bit_for_bit_and_nothing_else(device, storage, low, high):
    volume = sphere_volume(device, storage)
    cropped = crop(volume, low, high)
    before, after = sums_by_block(volume), sums_by_block(cropped)
    centres = dict(zip(before, voxel_centres(volume).reshape(-1, 512, 3), strict=True))
    kept = 0
    for block, sums in before.items():
        inside = ((centres[block] >= low) & (centres[block] <= high)).all(-1)
        if inside.any():
            np.testing.assert_array_equal(after[block], np.where(inside[:, None], sums, 0))
            kept += 1
        else:
            assert block not in after
    assert kept == len(after) > 0


@pytest.mark.parametrize("storage", STORAGES)
def test_a_copy_in_the_same_storage_is_the_same(device, storage):
    volume = sphere_volume(device, storage)
    copy = to_storage(volume, storage)
    for name, array in volume.arrays().items():
        np.testing.assert_array_equal(copy.arrays()[name].numpy(), array.numpy())
        assert copy.arrays()[name].ptr != array.ptr
    mesh, other = marching_cubes(volume), marching_cubes(copy)
    np.testing.assert_array_equal(mesh.vertices, other.vertices)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_copy_of_an_empty_volume_is_empty(device, storage):
    empty = Volume(voxel_size=0.01, truncation=0.04, device=device, max_blocks=100, storage=storage)
    assert to_storage(empty, "full").table.count == 0
    assert merge([empty, empty]).table.count == 0


def test_packing_rounds_as_it_says(device):
    exact = {name: array.numpy() for name, array in sphere_volume(device).arrays().items()}
    packed = sphere_volume(device, "packed")
    assert packed.storage == "packed"
    back = {name: array.numpy() for name, array in to_storage(packed, "full").arrays().items()}
    np.testing.assert_array_equal(back["weight"], exact["weight"])
    np.testing.assert_allclose(back["distance_sum"] / 3000, exact["distance_sum"] / 3000, atol=1.6e-5)
    seen = exact["color_weight"] > 0
    averages = [sums["color_sum"][seen] / sums["color_weight"][seen, None] for sums in (back, exact)]
    assert np.abs(averages[0] - averages[1]).max() < 1.01


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ((0, 0, np.nan), (1, 1, 1), r"low \[0.0, 0.0, nan\], high \[1, 1, 1\] m: expected three numbers each"),
        ((0, 0, 2), (1, 1, 1), "every low one less than its high one"),
        ((0, 0, 0), (1, 1, 0), "every low one less than its high one"),
        ((5, 5, 5), (6, 6, 6), r"nothing of the volume lies in this box; it spans \[-0"),
    ],
)
def test_boxes_that_make_no_sense_are_refused(device, low, high, message):
    with pytest.raises(InputError, match=message):
        crop(sphere_volume(device), low, high)
