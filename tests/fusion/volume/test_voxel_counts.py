import numpy as np
import pytest
import warp as wp

from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxel_counts import UpdateCounter, count_observed


@pytest.fixture(params=["packed", "full"])
def volume(request, device):
    volume = Volume(voxel_size=0.01, truncation=0.04, device=device, max_blocks=10, storage=request.param)
    volume.table.adopt(np.array([[0, 0, 0], [1, 0, 0], [-3, 2, 5]], dtype=np.int32))
    volume.reserve(3)
    return volume


def test_updates_are_the_bits_of_the_masks_times_the_voxels_of_a_part(volume):
    counter = UpdateCounter(volume)
    rng = np.random.default_rng(0)
    expected = 0
    for parts in (4, 16):
        masks = rng.integers(0, 2**32, (3, parts), dtype=np.uint32)
        counter.add(wp.array(masks, dtype=wp.uint32, device=volume.device))
        expected += sum(int(mask).bit_count() for mask in masks.ravel()) * 512 // parts
    assert counter.updates == expected


def test_observed_voxels_are_those_with_a_weight(volume):
    assert count_observed(volume) == 0
    seen = np.random.default_rng(0).random(3 * 512) < 0.3
    if volume.storage == "packed":
        volume.voxels.packed.assign(np.where(seen, np.uint64(0x7000_0000), np.uint64(0)))
    else:
        volume.voxels.weight.assign(seen.astype(np.float32))
    assert count_observed(volume) == seen.sum()
