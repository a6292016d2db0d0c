import numpy as np
import pytest
import warp as wp

from fusion.devices import launch_in_slabs
from fusion.volume.block_table import (
    COORDINATE_LIMIT,
    BlockArrays,
    BlockLimitError,
    BlockTable,
    block_key,
    block_of_key,
    enter_block,
    find_block,
    in_morton_order,
)


@wp.kernel(module="unique")
def _round_trip(blocks: wp.array(dtype=wp.vec3i), unpacked: wp.array(dtype=wp.vec3i)):
    unpacked[wp.tid()] = block_of_key(block_key(blocks[wp.tid()]))


@wp.kernel(module="unique")
def _look_up(
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
    found: wp.array(dtype=int),
):
    found[wp.tid()] = find_block(keys, numbers, blocks[wp.tid()])


@wp.kernel(module="unique")
def _enter(first: int, blocks: wp.array(dtype=wp.vec3i), table: BlockArrays, results: wp.array(dtype=int)):
    index = wp.tid() + first
    results[index] = enter_block(table, blocks[index])


def look_up(table, blocks):
    found = wp.empty(len(blocks), dtype=int, device=table.device)
    inputs = [table.keys, table.numbers, wp.array(blocks, dtype=wp.vec3i, device=table.device)]
    wp.launch(_look_up, dim=len(blocks), inputs=inputs, outputs=[found], device=table.device)
    return found.numpy()


def test_packing_coordinates_loses_nothing(device):
    rng = np.random.default_rng(1)
    extremes = [-COORDINATE_LIMIT, -1, 0, 1, COORDINATE_LIMIT - 1]
    corners = np.array(np.meshgrid(extremes, extremes, extremes)).reshape(3, -1).T
    blocks = np.concatenate([corners, rng.integers(-COORDINATE_LIMIT, COORDINATE_LIMIT, (1000, 3))]).astype(np.int32)
    unpacked = wp.empty(len(blocks), dtype=wp.vec3i, device=device)
    wp.launch(
        _round_trip, dim=len(blocks), inputs=[wp.array(blocks, dtype=wp.vec3i, device=device), unpacked], device=device
    )
    np.testing.assert_array_equal(unpacked.numpy(), blocks)


def test_growing_loses_no_block_and_keeps_its_number(device):
    rng = np.random.default_rng(2)
    blocks = np.unique(rng.integers(-50, 50, (3000, 3)).astype(np.int32), axis=0)
    rng.shuffle(blocks)
    table = BlockTable(device=device, max_blocks=10_000, capacity=64)
    table.adopt(blocks)
    np.testing.assert_array_equal(look_up(table, blocks), np.arange(len(blocks)))
    table.grow()
    np.testing.assert_array_equal(look_up(table, blocks), np.arange(len(blocks)))


def test_neighbours_in_morton_order_stay_together():
    # All 512 blocks of an 8×8×8 cube, shuffled: each run of 8 in the order is a 2×2×2 cube.
    side = np.arange(8)
    blocks = np.stack(np.meshgrid(side, side, side), -1).reshape(-1, 3)
    fields = in_morton_order(np.random.default_rng(0).permutation(blocks))
    assert (np.ptp(fields.reshape(64, 8, 3), axis=1) == 1).all()
    assert (np.ptp(fields.reshape(8, 64, 3), axis=1) == 3).all()


def test_a_block_that_was_never_entered_is_not_found(device):
    table = BlockTable(device=device, max_blocks=100)
    table.adopt(np.array([[0, 0, 0], [1, 2, 3]], np.int32))
    assert look_up(table, np.array([[3, 2, 1], [0, 0, 1], [COORDINATE_LIMIT, 0, 0]], np.int32)).tolist() == [-1, -1, -1]


def test_the_table_refuses_to_grow_beyond_its_bound(device):
    table = BlockTable(device=device, max_blocks=10, capacity=16)
    table.adopt(np.array([[i, 0, 0] for i in range(9)], np.int32))
    table.grow()
    with pytest.raises(BlockLimitError, match="11 blocks are more than the 10"):
        BlockTable(device=device, max_blocks=10).adopt(np.array([[i, 0, 0] for i in range(11)], np.int32))


def test_threads_that_enter_the_same_blocks_at_once_agree(device):
    rng = np.random.default_rng(5)
    blocks = rng.integers(-12, 12, (200_000, 3)).astype(np.int32)
    table = BlockTable(device=device, max_blocks=10**5, capacity=1 << 16)
    results = wp.zeros(len(blocks), dtype=int, device=device)
    launch_in_slabs(
        _enter,
        dim=len(blocks),
        inputs=[wp.array(blocks, dtype=wp.vec3i, device=device)],
        outputs=[table.arrays, results],
        device=device,
    )
    unique = np.unique(blocks, axis=0)
    assert table.read_count() == len(unique)
    assert np.bincount(results.numpy()).tolist() == [len(blocks) - len(unique), len(unique)]
    np.testing.assert_array_equal(np.unique(table.blocks.numpy()[: table.count], axis=0), unique)
    found = look_up(table, blocks)
    np.testing.assert_array_equal(table.blocks.numpy()[found], blocks)


def test_sorting_numbers_blocks_by_what_they_are(device):
    blocks = np.unique(np.random.default_rng(6).integers(-9, 9, (300, 3)).astype(np.int32), axis=0)
    tables = []
    for seed in range(2):
        table = BlockTable(device=device, max_blocks=1000)
        table.adopt(np.random.default_rng(seed).permutation(blocks))
        table.sort()
        tables.append(table)
        np.testing.assert_array_equal(look_up(table, table.blocks.numpy()[: table.count]), np.arange(len(blocks)))
    np.testing.assert_array_equal(*(table.blocks.numpy()[: len(blocks)] for table in tables))
