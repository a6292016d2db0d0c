"""The allocation pass: which blocks does the truncation band of each frame touch?

Pixels are taken in 8×8 tiles. A tile's valid depths span [z_min, z_max]; the band of all its pixels lies in the piece
of the tile's frustum between z_min − t and z_max + t. Every block whose voxel centres come into that convex piece is
found, by testing the box of the centres against the piece's six planes: no block of the band is ever missed, some
beside it are taken. Where a tile spans an edge in depth, its near and far pixels make a piece each.
"""

import warp as wp

from datagen.errors import InputError
from fusion.block_table import BLOCK_SIDE, COORDINATE_LIMIT, BlockTable, block_key, insert_key
from fusion.frame_batch import FrameBatch

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TILE = 8
_TILE = wp.constant(TILE)
TABLE_FULL, OUT_OF_RANGE = 1, 2
_TABLE_FULL = wp.constant(TABLE_FULL)
_OUT_OF_RANGE = wp.constant(OUT_OF_RANGE)
_SIDE = wp.constant(float(BLOCK_SIDE))
_FAR = wp.constant(3.0e38)


@wp.func
def enter_piece(
    world_from_camera: wp.mat44,
    corners: wp.vec4,  # x/z at the tile's left and right, y/z at its top and bottom
    near: float,
    far: float,
    voxel_size: float,
    keys: wp.array(dtype=wp.int64),
    key_count: wp.array(dtype=int),
) -> int:
    """Enter every block with a voxel centre in one frustum piece; returns 0, or what stands in the way."""
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
                    if key < wp.int64(0):
                        return _OUT_OF_RANGE
                    if not insert_key(keys, key, key_count):
                        return _TABLE_FULL
    return 0


@wp.kernel
def _enter_blocks(
    depth: wp.array3d(dtype=float),
    world_from_camera: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    truncation: float,
    voxel_size: float,
    keys: wp.array(dtype=wp.int64),
    key_count: wp.array(dtype=int),
    problems: wp.array(dtype=int),
) -> None:
    frame, tile_v, tile_u = wp.tid()
    if problems[0] != 0:
        return
    height = depth.shape[1]
    width = depth.shape[2]
    u0 = tile_u * _TILE
    v0 = tile_v * _TILE
    u1 = wp.min(u0 + _TILE, width)
    v1 = wp.min(v0 + _TILE, height)
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
    for piece in range(2):
        near = wp.where(piece == 0, z_min, far_min)
        far = wp.where(piece == 0, near_max, z_max)
        if near < _FAR:
            near = wp.max(near - truncation - slack, 1.0e-6)
            far = far + truncation + slack
            problem = enter_piece(pose, corners, near, far, voxel_size, keys, key_count)
            if problem != 0:
                problems[0] = problem


def find_blocks(table: BlockTable, batch: FrameBatch, *, truncation: float, voxel_size: float) -> None:
    """Enter the blocks that the batch's truncation bands touch into ``table``.

    Which they are depends on the frames alone. ``truncation`` and ``voxel_size`` are metres. Raises BlockLimitError
    where the table may not grow as far as the frames ask, and InputError for surfaces too far away to be numbered.
    """
    camera = batch.camera
    tiles = (-(-camera.height // TILE), -(-camera.width // TILE))
    while True:
        problems = wp.zeros(1, dtype=int, device=table.device)
        wp.launch(
            _enter_blocks,
            dim=(len(batch), *tiles),
            inputs=[
                batch.depth,
                batch.world_from_camera,
                wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
                truncation,
                voxel_size,
            ],
            outputs=[table.keys, table.key_count, problems],
            device=table.device,
        )
        problem = int(problems.numpy()[0])
        if problem == 0:
            break
        if problem == OUT_OF_RANGE:
            reach = COORDINATE_LIMIT * BLOCK_SIDE * voxel_size
            raise InputError(
                f"a surface is more than {reach:.3g} m from the world's origin, too far for voxels of {voxel_size:g} m;"
                " use a larger --voxel-size, or leave far depths out with --depth-max"
            )
        table.grow()
    table.number_new_blocks()
