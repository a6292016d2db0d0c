"""Voxels and blocks by CUDA's code against those of the CPU's kernels.

A voxel's projection may lie so near to the border between two pixels that the last bit of rounding decides whose depth
it takes, and a surface may be seen so slantingly that this bit moves the depth there. So both may differ by the bound
and by what the CPU's own result changes for cameras and truncations that differ by little more than float32's rounding.
"""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest
import warp as wp
from synthetic_scene import SphereScene

from datagen.camera import PinholeCamera
from fusion.devices import resolve_device
from fusion.frames import color_confidence, depth_tiles
from fusion.frames.frame_batch import FrameUploader
from fusion.integration import integrate, pixel_weights
from fusion.integration.fuse_batch import KERNEL_MODULES, find_batch_blocks, integrate_batch, load_fusion_kernels
from fusion.integration.live_volume import LiveVolume
from fusion.integration.options import Integration
from fusion.volume.block_table import BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_operations import to_storage
from ptx.coverage import never_ran

CAMERA = PinholeCamera(width=70, height=52, fx=74.0, fy=72.0, cx=35.3, cy=25.6)
VOXEL_SIZE, TRUNCATION, DEPTH_SCALE = 0.05, 0.16, 0.0005
BOUND = 1e-5
# float32 has 4e-6 px at 70 px, and a projection is rounded a few times.
NUDGE_PX, NUDGE = 3e-5, 1e-6
PAPER = Integration()
OPTIONS = [
    Integration(depth_sampling=sampling, weighting=weighting, drop_off=drop_off)
    for sampling, weighting, drop_off in itertools.product(
        ("nearest", "bilinear"), ("constant", "cosine"), (False, True)
    )
]


def frames_of(count=5):
    scene = SphereScene(wall_z=-0.4)
    frames = [scene.frame(i, pose, CAMERA) for i, pose in enumerate(scene.poses_around(count))]
    rng = np.random.default_rng(1)
    colors = [rng.integers(0, 256, frame.color.shape, dtype=np.uint8) for frame in frames]
    return [dataclasses.replace(f, color=c) for f, c in zip(frames, colors, strict=True)]


FRAMES = frames_of()


def uploaded(device, *, steps, camera=CAMERA, frames=FRAMES):
    upload = FrameUploader(camera, device=device, capacity=8, depth_scale=DEPTH_SCALE if steps else None)
    depths = [frame.depth for frame in frames]
    if steps:
        depths = [np.rint(depth / DEPTH_SCALE).astype(np.uint16) for depth in depths]
    return upload(depths, [f.world_from_camera for f in frames], [f.color for f in frames])


def empty_volume(device, storage, truncation=TRUNCATION):
    return Volume(voxel_size=VOXEL_SIZE, truncation=truncation, device=device, max_blocks=10**5, storage=storage)


def blocks_found(device, *, steps):
    """Return the table of the frames' blocks, sorted, so that both devices number them alike."""
    volume = empty_volume(device, "full")
    find_batch_blocks(volume.table, uploaded(device, steps=steps), truncation=TRUNCATION, voxel_size=VOXEL_SIZE)
    volume.table.sort()
    return volume.table.blocks.numpy()[: volume.table.count]


@cache
def blocks_of_cpu(*, steps):
    return blocks_found(resolve_device("cpu"), steps=steps)


def fused(device, options, *, steps, storage="full", nudge=(0, 0, 0)):
    """Return the voxels' sums by name, of the CPU's blocks."""
    camera = dataclasses.replace(CAMERA, cx=CAMERA.cx + nudge[0] * NUDGE_PX, cy=CAMERA.cy + nudge[1] * NUDGE_PX)
    volume = empty_volume(device, storage, TRUNCATION * (1 + nudge[2] * NUDGE))
    volume.table.adopt(blocks_of_cpu(steps=steps))
    volume.reserve(volume.table.count)
    integrate_batch(volume, uploaded(device, steps=steps, camera=camera), options)
    held = BLOCK_VOXELS * volume.table.count
    return {name: array.numpy()[:held] for name, array in to_storage(volume, "full").arrays().items()}


def averages(sums):
    """Return distances in truncations, weights, and colours of 1, as columns."""
    sums = {name: values.astype(np.float64) for name, values in sums.items()}
    weight, color_weight = sums["weight"], sums["color_weight"]
    distance = sums["distance_sum"] / np.where(weight > 0, weight, 1)
    color = sums["color_sum"] / (255 * np.where(color_weight > 0, color_weight, 1))[:, None]
    return np.column_stack([distance, weight, color, color_weight])


def sensitivity(reference, options, *, steps, cpu):
    """Return how much the CPU's own result changes with the camera and the truncation."""
    nudges = [(1, 1, 1), (-1, -1, -1), (1, -1, -1), (-1, 1, 1)]
    others = [averages(fused(cpu, options, steps=steps, nudge=nudge)) for nudge in nudges]
    return np.max([np.abs(other - reference).max(axis=1) for other in others], axis=0)


@pytest.mark.parametrize("steps", [True, False], ids=["uint16", "float32"])
@pytest.mark.parametrize("options", OPTIONS, ids=lambda o: f"{o.depth_sampling}-{o.weighting}-{o.drop_off}")
def test_voxels_are_the_same(cpu, cuda, options, steps, record_property):
    reference = averages(fused(cpu, options, steps=steps))
    difference = np.abs(averages(fused(cuda, options, steps=steps)) - reference).max(axis=1)
    own_change = sensitivity(reference, options, steps=steps, cpu=cpu)
    seen, clear = reference[:, 1] > 0, own_change < BOUND
    assert seen.sum() > 5000
    assert clear[seen].mean() > 0.8
    record_property("largest difference", float(difference[clear].max()))
    assert difference[clear].max() <= BOUND
    assert (difference <= BOUND + own_change).all()


def test_packed_voxels_are_the_same_to_a_step(cpu, cuda):
    options = OPTIONS[-1]
    reference, found = (averages(fused(device, options, steps=True, storage="packed")) for device in (cpu, cuda))
    own_change = sensitivity(averages(fused(cpu, options, steps=True)), options, steps=True, cpu=cpu)
    weight = reference[:, 1]
    # A distance of 16 bits, weights of an eleven-bit mantissa, colours and their share of the weight of a byte.
    steps = np.stack(
        [np.full(len(weight), 1 / 32767), weight / 2**11, *np.full((3, len(weight)), 1 / 255), weight / 255]
    )
    clear = own_change < BOUND
    assert (np.abs(found - reference) <= 1.01 * steps.T + BOUND)[clear].all()


@pytest.mark.parametrize("steps", [True, False], ids=["uint16", "float32"])
def test_blocks_are_the_same(cpu, cuda, steps):
    np.testing.assert_array_equal(blocks_found(cuda, steps=steps), blocks_found(cpu, steps=steps))


@pytest.mark.parametrize("late", [False, True], ids=["at once", "late"])
def test_batches_that_take_turns_in_two_buffers_do_not_spoil_each_other(cpu, machine, cuda, late, monkeypatch):
    whole = averages(fused(cpu, PAPER, steps=True))
    monkeypatch.setattr(machine.streams, "late", late)
    volume = empty_volume(cuda, "full")
    volume.table.adopt(blocks_of_cpu(steps=True))
    volume.reserve(volume.table.count)
    upload = FrameUploader(CAMERA, device=cuda, capacity=1, depth_scale=DEPTH_SCALE)
    for frame in FRAMES:
        steps = np.rint(frame.depth / DEPTH_SCALE).astype(np.uint16)
        integrate_batch(volume, upload([steps], [frame.world_from_camera], [frame.color]), PAPER)
    apart = np.abs(averages({name: array.numpy() for name, array in volume.arrays().items()}) - whole).max(axis=1)
    assert (apart > BOUND).mean() < 1e-3


def live(device, **options):
    lengths = {"voxel_size": VOXEL_SIZE, "truncation": TRUNCATION, "depth_scale": DEPTH_SCALE}
    volume = LiveVolume(CAMERA, device=str(device.alias), **lengths, **options)
    for frame in FRAMES * 2:
        depth = np.rint(frame.depth / DEPTH_SCALE).astype(np.uint16)
        number = len(volume.frame_ids)
        volume.integrate(dataclasses.replace(frame, depth=depth, frame_id=number))
    return volume


def by_block(volume):
    count = volume.table.count
    columns = averages({k: array.numpy()[: count * BLOCK_VOXELS] for k, array in volume.arrays().items()})
    blocks = map(tuple, volume.table.blocks.numpy()[:count].tolist())
    return dict(zip(blocks, columns.reshape(count, BLOCK_VOXELS, -1), strict=True))


@pytest.mark.parametrize("late", [False, True], ids=["at once", "late"])
def test_a_live_volume_is_the_same_however_late_its_work_is_done(cpu, machine, cuda, late, monkeypatch):
    # So small that it grows, and its graphs are captured anew.
    monkeypatch.setattr("fusion.integration.live_volume._FIRST_CAPACITY", 64)
    monkeypatch.setattr(machine.streams, "late", late)
    streamed, reference = by_block(live(cuda).volume), by_block(live(cpu).volume)
    assert streamed.keys() == reference.keys()
    apart = np.concatenate([np.abs(streamed[block] - reference[block]).max(axis=1) for block in reference])
    assert (apart > BOUND).mean() < 1e-3


def test_a_frame_waits_for_no_compiler_and_for_no_read_back(machine, cuda, monkeypatch):
    monkeypatch.setattr("fusion.integration.live_volume._FIRST_CAPACITY", 256)
    load_fusion_kernels(PAPER, device=cuda)
    wp.load_module("fusion.volume.volume_operations", device=cuda)  # by which the test reads the voxels
    loaded = len(machine.loaded)
    fused(cuda, PAPER, steps=True)
    assert machine.loaded[loaded:] == []
    # Nor is a module made for one size of blocks ahead, and at its first launch for another.
    assert len({file.rsplit("_", 1)[0] for file in machine.loaded}) == len(set(machine.loaded))
    volume = live(cuda)
    volume.finish()
    waits = []
    monkeypatch.setattr(machine.streams, "synchronize", lambda *a: waits.append(a))
    for number in range(100, 106):
        volume.integrate(
            dataclasses.replace(
                FRAMES[0], depth=np.rint(FRAMES[0].depth / DEPTH_SCALE).astype(np.uint16), frame_id=number
            )
        )
    assert waits == []


def test_every_kernel_of_these_ran(machine):
    made = [
        integrate.kernel(depth, by_voxel=True, bilinear=bilinear, weighted=weighted, drop_off=drop_off)
        for depth in (wp.uint16, wp.float32)
        for bilinear, weighted, drop_off in itertools.product((False, True), repeat=3)
    ]
    made += [
        stage.kernel(depth)
        for stage in (color_confidence, depth_tiles, pixel_weights)
        for depth in (wp.uint16, wp.float32)
    ]
    assert never_ran(machine, [*KERNEL_MODULES, "fusion.integration.live_slots"], made) == []
