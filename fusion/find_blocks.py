"""The allocation pass: which blocks does the truncation band of each frame touch?

Pixels are taken in 8×8 tiles. A tile's valid depths span [z_min, z_max]; the band of all its pixels lies in the piece
of the tile's frustum between z_min − t and z_max + t. Every block whose voxel centres come into that convex piece is
found, by testing the box of the centres against the piece's six planes: no block of the band is ever missed, some
beside it are taken. Where a tile spans an edge in depth, its near and far pixels make a piece each.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from fusion.block_table import BLOCK_SIDE, BlockTable, block_key, insert_key
from fusion.frame_batch import FrameBatch

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TILE = wp.constant(8)
_SIDE = wp.constant(float(BLOCK_SIDE))
_FAR = wp.constant(3.0e38)


@dataclass(frozen=True, kw_only=True)
class FoundBlocks:
    """The blocks that a batch of frames touches.

    ``numbers`` (n,) int, block numbers, each once; ``frame_masks`` (n,) uint32, bit f set where frame f touches it.
    """

    numbers: wp.array
    frame_masks: wp.array

    def __len__(self) -> int:
        """Return the number of blocks."""
        return int(self.numbers.shape[0])


@wp.func
def mark_piece(
    world_from_camera: wp.mat44,
    corners: wp.vec4,  # x/z at the tile's left and right, y/z at its top and bottom
    near: float,
    far: float,
    voxel_size: float,
    frame_bit: wp.uint32,
    keys: wp.array(dtype=wp.int64),
    key_count: wp.array(dtype=int),
    masks: wp.array(dtype=wp.uint32),
) -> int:
    """Mark every block with a voxel centre in one frustum piece; returns 0, or 1 where the table is full."""
    rotation = wp.mat33(
        world_from_camera[0, 0], world_from_camera[0, 1], world_from_camera[0, 2],
        world_from_camera[1, 0], world_from_camera[1, 1], world_from_camera[1, 2],
        world_from_camera[2, 0], world_from_camera[2, 1], world_from_camera[2, 2],
    )  # fmt: skip
    origin = wp.vec3(world_from_camera[0, 3], world_from_camera[1, 3], world_from_camera[2, 3])
    low = wp.vec3(_FAR, _FAR, _FAR)
    high = -low
    for corner in range(8):
        z = wp.where(corner & 4, far, near)
        x = wp.where(corner & 1, corners[1], corners[0]) * z
        y = wp.where(corner & 2, corners[3], corners[2]) * z
        point = rotation * wp.vec3(x, y, z) + origin
        low = wp.min(low, point)
        high = wp.max(high, point)

    # The side planes pass through the camera; n · p ≤ 0 inside. Near and far are z bounds.
    side0 = rotation * wp.vec3(-1.0, 0.0, corners[0])
    side1 = rotation * wp.vec3(1.0, 0.0, -corners[1])
    side2 = rotation * wp.vec3(0.0, -1.0, corners[2])
    side3 = rotation * wp.vec3(0.0, 1.0, -corners[3])
    axis = rotation * wp.vec3(0.0, 0.0, 1.0)
    half = 0.5 * (_SIDE - 1.0) * voxel_size * 1.0001
    reach0 = half * (wp.abs(side0[0]) + wp.abs(side0[1]) + wp.abs(side0[2]))
    reach1 = half * (wp.abs(side1[0]) + wp.abs(side1[1]) + wp.abs(side1[2]))
    reach2 = half * (wp.abs(side2[0]) + wp.abs(side2[1]) + wp.abs(side2[2]))
    reach3 = half * (wp.abs(side3[0]) + wp.abs(side3[1]) + wp.abs(side3[2]))
    reach_z = half * (wp.abs(axis[0]) + wp.abs(axis[1]) + wp.abs(axis[2]))

    side = _SIDE * voxel_size
    margin = 1.0e-3
    first_x = int(wp.ceil((low[0] + voxel_size) / side - 1.0 - margin))
    first_y = int(wp.ceil((low[1] + voxel_size) / side - 1.0 - margin))
    first_z = int(wp.ceil((low[2] + voxel_size) / side - 1.0 - margin))
    last_x = int(wp.floor(high[0] / side + margin))
    last_y = int(wp.floor(high[1] / side + margin))
    last_z = int(wp.floor(high[2] / side + margin))
    for bx in range(first_x, last_x + 1):
        for by in range(first_y, last_y + 1):
            for bz in range(first_z, last_z + 1):
                centre = side * wp.vec3(float(bx), float(by), float(bz)) + wp.vec3(half, half, half) - origin
                z = wp.dot(axis, centre)
                if (
                    z - reach_z <= far
                    and z + reach_z >= near
                    and wp.dot(side0, centre) <= reach0
                    and wp.dot(side1, centre) <= reach1
                    and wp.dot(side2, centre) <= reach2
                    and wp.dot(side3, centre) <= reach3
                ):
                    key = block_key(wp.vec3i(bx, by, bz))
                    if key >= wp.int64(0):
                        slot = insert_key(keys, key, key_count)
                        if slot < 0:
                            return 1
                        if (masks[slot] & frame_bit) == wp.uint32(0):
                            wp.atomic_or(masks, slot, frame_bit)
    return 0


@wp.kernel
def _mark_blocks(
    depth: wp.array3d(dtype=float),
    world_from_camera: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    truncation: float,
    voxel_size: float,
    keys: wp.array(dtype=wp.int64),
    key_count: wp.array(dtype=int),
    masks: wp.array(dtype=wp.uint32),
    overflow: wp.array(dtype=int),
) -> None:
    frame, tile_v, tile_u = wp.tid()
    if overflow[0] != 0:
        return
    height = depth.shape[1]
    width = depth.shape[2]
    u0 = tile_u * TILE
    v0 = tile_v * TILE
    u1 = wp.min(u0 + TILE, width)
    v1 = wp.min(v0 + TILE, height)
    z_min = float(_FAR)
    z_max = float(0.0)
    for v in range(v0, v1):
        for u in range(u0, u1):
            z = depth[frame, v, u]
            if z > 0.0:
                z_min = wp.min(z_min, z)
                z_max = wp.max(z_max, z)
    if z_max == 0.0:
        return

    # The largest depth of the near pixels and the smallest of the far ones.
    split = 0.5 * (z_min + z_max)
    near_max = z_max
    far_min = float(_FAR)
    if z_max - z_min > 2.0 * truncation:
        near_max = z_min
        for v in range(v0, v1):
            for u in range(u0, u1):
                z = depth[frame, v, u]
                if z > 0.0:
                    if z <= split:
                        near_max = wp.max(near_max, z)
                    else:
                        far_min = wp.min(far_min, z)

    # A pixel's footprint reaches half a pixel beyond its centre; a little more covers rounding in the projection.
    border = 0.51
    corners = wp.vec4(
        (float(u0) - border - intrinsics[2]) / intrinsics[0],
        (float(u1 - 1) + border - intrinsics[2]) / intrinsics[0],
        (float(v0) - border - intrinsics[3]) / intrinsics[1],
        (float(v1 - 1) + border - intrinsics[3]) / intrinsics[1],
    )
    slack = 1.0e-4 * truncation
    pose = world_from_camera[frame]
    bit = wp.uint32(1) << wp.uint32(frame)
    for piece in range(2):
        near = wp.where(piece == 0, z_min, far_min)
        far = wp.where(piece == 0, near_max, z_max)
        if near < _FAR:
            near = wp.max(near - truncation - slack, 1.0e-6)
            far = far + truncation + slack
            if mark_piece(pose, corners, near, far, voxel_size, bit, keys, key_count, masks) != 0:
                overflow[0] = 1


@wp.kernel
def _list_marked(
    numbers: wp.array(dtype=int),
    masks: wp.array(dtype=wp.uint32),
    listed_numbers: wp.array(dtype=int),
    listed_masks: wp.array(dtype=wp.uint32),
    listed_count: wp.array(dtype=int),
) -> None:
    slot = wp.tid()
    if masks[slot] != wp.uint32(0):
        index = wp.atomic_add(listed_count, 0, 1)
        listed_numbers[index] = numbers[slot]
        listed_masks[index] = masks[slot]


def find_blocks(table: BlockTable, batch: FrameBatch, *, truncation: float, voxel_size: float) -> FoundBlocks:
    """Enter the blocks that the batch's truncation bands touch into ``table`` and return them with their frames.

    The result depends on the frames alone, not on what the table held. ``truncation`` and ``voxel_size`` are metres.
    Raises BlockLimitError where the table may not grow as far as the frames ask.
    """
    while True:
        masks = wp.zeros(table.capacity, dtype=wp.uint32, device=table.device)
        if _mark(table, batch, masks, truncation=truncation, voxel_size=voxel_size):
            break
        table.grow()
    table.number_new_blocks()
    listed_numbers = wp.empty(table.count, dtype=int, device=table.device)
    listed_masks = wp.empty(table.count, dtype=wp.uint32, device=table.device)
    listed_count = wp.zeros(1, dtype=int, device=table.device)
    outputs = [listed_numbers, listed_masks, listed_count]
    wp.launch(_list_marked, dim=table.capacity, inputs=[table.numbers, masks], outputs=outputs, device=table.device)
    count = int(listed_count.numpy()[0])
    return FoundBlocks(
        numbers=wp.clone(listed_numbers[:count]) if count else listed_numbers,
        frame_masks=wp.clone(listed_masks[:count]) if count else listed_masks,
    )


def _mark(table: BlockTable, batch: FrameBatch, masks: wp.array, *, truncation: float, voxel_size: float) -> bool:
    """Run the kernel once; False where the table filled up."""
    camera = batch.camera
    overflow = wp.zeros(1, dtype=int, device=table.device)
    tiles = (-(-camera.height // 8), -(-camera.width // 8))
    wp.launch(
        _mark_blocks,
        dim=(len(batch), *tiles),
        inputs=[
            batch.depth,
            batch.world_from_camera,
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            truncation,
            voxel_size,
        ],
        outputs=[table.keys, table.key_count, masks, overflow],
        device=table.device,
    )
    return not np.any(overflow.numpy())
