"""Which blocks does each frame of a batch have something to say about?

A frame says nothing about a block that lies outside its view, that is hidden by more than the truncation behind all
that it sees there, or where it has no valid depth. Only such blocks are passed over: leaving them out changes no
voxel. Space that a frame sees through is not passed over, so that what one frame put there by mistake is outvoted by
the others.
"""

from dataclasses import dataclass

import warp as wp

from fusion.block_table import BLOCK_SIDE
from fusion.devices import launch_in_slabs
from fusion.frame_batch import FrameBatch
from fusion.volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

PATCH = 32
"""Depth images are surveyed in patches of this many pixels squared."""

_PATCH = wp.constant(PATCH)
_SIDE = wp.constant(float(BLOCK_SIDE))


@dataclass(frozen=True, kw_only=True)
class VisibleBlocks:
    """Blocks and the frames of a batch that see them.

    ``numbers`` (n,) int, block numbers, each once; ``frame_masks`` (n,) uint32, bit f set where frame f may see it.
    """

    numbers: wp.array
    frame_masks: wp.array

    def __len__(self) -> int:
        """Return the number of blocks."""
        return int(self.numbers.shape[0])


@wp.kernel
def _farthest_depths(first: int, depth: wp.array3d(dtype=float), farthest: wp.array3d(dtype=float)) -> None:
    index = wp.tid() + first
    columns = farthest.shape[2]
    rows = farthest.shape[1]
    patch_u = index % columns
    patch_v = (index / columns) % rows
    frame = index / (columns * rows)
    z_max = float(0.0)
    for v in range(patch_v * _PATCH, wp.min((patch_v + 1) * _PATCH, depth.shape[1])):
        for u in range(patch_u * _PATCH, wp.min((patch_u + 1) * _PATCH, depth.shape[2])):
            z_max = wp.max(z_max, depth[frame, v, u])
    farthest[frame, patch_v, patch_u] = z_max


@wp.func
def may_see(
    point: wp.vec3,  # the middle of the block's voxel centres, camera frame
    radius: float,
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    truncation: float,
    frame: int,
    width: int,
    height: int,
    farthest: wp.array3d(dtype=float),
) -> bool:
    """Tell whether a ball around a block may hold a voxel that the frame updates."""
    nearest = point[2] - radius
    if nearest + 2.0 * radius <= 0.0:
        return False
    first_u = int(0)
    last_u = width - 1
    first_v = int(0)
    last_v = height - 1
    if nearest > 0.1 * radius:
        # |x/z − x₀/z₀| ≤ r (1 + |x₀/z₀|) / (z₀ − r) for every point of the ball.
        x = point[0] / point[2]
        y = point[1] / point[2]
        reach_u = intrinsics[0] * radius * (1.0 + wp.abs(x)) / nearest + 1.0
        reach_v = intrinsics[1] * radius * (1.0 + wp.abs(y)) / nearest + 1.0
        u = intrinsics[0] * x + intrinsics[2]
        v = intrinsics[1] * y + intrinsics[3]
        first_u = int(wp.clamp(u - reach_u, 0.0, float(width)))
        last_u = int(wp.clamp(u + reach_u, -1.0, float(width - 1)))
        first_v = int(wp.clamp(v - reach_v, 0.0, float(height)))
        last_v = int(wp.clamp(v + reach_v, -1.0, float(height - 1)))
        if last_u < first_u or last_v < first_v or u + reach_u < -0.5 or v + reach_v < -0.5:
            return False
    for patch_v in range(first_v / _PATCH, last_v / _PATCH + 1):
        for patch_u in range(first_u / _PATCH, last_u / _PATCH + 1):
            z_max = farthest[frame, patch_v, patch_u]
            if z_max > 0.0 and nearest <= z_max + truncation:
                return True
    return False


@wp.kernel
def _mark_visible(
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    camera_from_lattice: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,
    voxel_size: float,
    truncation: float,
    width: int,
    height: int,
    farthest: wp.array3d(dtype=float),
    masks: wp.array(dtype=wp.uint32),
) -> None:
    number = wp.tid() + first
    block = blocks[number]
    half = 0.5 * (_SIDE - 1.0)
    middle = wp.vec3(_SIDE * float(block[0]) + half, _SIDE * float(block[1]) + half, _SIDE * float(block[2]) + half)
    # The ball around the voxel centres, a little larger against rounding.
    radius = 1.7325 * half * voxel_size
    mask = wp.uint32(0)
    for frame in range(camera_from_lattice.shape[0]):
        point = wp.transform_point(camera_from_lattice[frame], middle)
        if may_see(point, radius, intrinsics, truncation, frame, width, height, farthest):
            mask = mask | (wp.uint32(1) << wp.uint32(frame))
    masks[number] = mask


@wp.kernel
def _list_marked(
    masks: wp.array(dtype=wp.uint32),
    listed_numbers: wp.array(dtype=int),
    listed_masks: wp.array(dtype=wp.uint32),
    listed_count: wp.array(dtype=int),
) -> None:
    number = wp.tid()
    if masks[number] != wp.uint32(0):
        index = wp.atomic_add(listed_count, 0, 1)
        listed_numbers[index] = number
        listed_masks[index] = masks[number]


def visible_blocks(volume: Volume, batch: FrameBatch) -> VisibleBlocks:
    """Return the volume's blocks that the batch's frames may update, in the order of their numbers."""
    table, camera, device = volume.table, batch.camera, volume.device
    if table.count == 0:
        return VisibleBlocks(
            numbers=wp.empty(0, dtype=int, device=device), frame_masks=wp.empty(0, dtype=wp.uint32, device=device)
        )
    farthest = wp.empty((len(batch), -(-camera.height // PATCH), -(-camera.width // PATCH)), dtype=float, device=device)
    launch_in_slabs(_farthest_depths, dim=farthest.size, inputs=[batch.depth], outputs=[farthest], device=device)
    masks = wp.empty(table.count, dtype=wp.uint32, device=device)
    launch_in_slabs(
        _mark_visible,
        dim=table.count,
        inputs=[
            table.blocks,
            batch.camera_from_lattice(volume.voxel_size),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            volume.voxel_size,
            volume.truncation,
            camera.width,
            camera.height,
            farthest,
        ],
        outputs=[masks],
        device=device,
    )
    numbers = wp.empty(table.count, dtype=int, device=device)
    frame_masks = wp.empty(table.count, dtype=wp.uint32, device=device)
    count = wp.zeros(1, dtype=int, device=device)
    wp.launch(
        _list_marked,
        dim=table.count,
        inputs=[masks],
        outputs=[numbers, frame_masks, count],
        device=device,
    )
    listed = int(count.numpy()[0])
    return VisibleBlocks(numbers=numbers[:listed], frame_masks=frame_masks[:listed])
