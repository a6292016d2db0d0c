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


@wp.struct
class Piece:
    """A convex piece of a tile's frustum, in the world, and how far a block's voxel centres reach across its planes.

    The four side planes pass through ``origin``, the camera; n · (p − origin) ≤ 0 inside. Along ``axis`` it spans
    [near, far]. ``low`` and ``high`` are the corners of the box around it.
    """

    origin: wp.vec3
    axis: wp.vec3
    left: wp.vec3
    right: wp.vec3
    top: wp.vec3
    bottom: wp.vec3
    near: float
    far: float
    half: float
    low: wp.vec3
    high: wp.vec3


@wp.func
def piece_of_tile(pose: wp.mat44, edges: wp.vec4, near: float, far: float, voxel_size: float) -> Piece:
    """Return the piece between depths ``near`` and ``far``.

    ``edges`` are x/z at the tile's left and right and y/z at its top and bottom.
    """
    piece = Piece()
    piece.origin = wp.transform_point(pose, wp.vec3(0.0, 0.0, 0.0))
    piece.axis = wp.transform_vector(pose, wp.vec3(0.0, 0.0, 1.0))
    piece.left = wp.transform_vector(pose, wp.vec3(-1.0, 0.0, edges[0]))
    piece.right = wp.transform_vector(pose, wp.vec3(1.0, 0.0, -edges[1]))
    piece.top = wp.transform_vector(pose, wp.vec3(0.0, -1.0, edges[2]))
    piece.bottom = wp.transform_vector(pose, wp.vec3(0.0, 1.0, -edges[3]))
    piece.near = near
    piece.far = far
    # Half the distance between a block's outer voxel centres, a little more against rounding.
    piece.half = 0.5 * (_SIDE - 1.0) * voxel_size * 1.0001
    low = wp.vec3(_FAR, _FAR, _FAR)
    high = -low
    for corner in range(8):
        z = wp.where(corner & 4, far, near)
        x = wp.where(corner & 1, edges[1], edges[0]) * z
        y = wp.where(corner & 2, edges[3], edges[2]) * z
        point = wp.transform_point(pose, wp.vec3(x, y, z))
        low = wp.min(low, point)
        high = wp.max(high, point)
    piece.low = low
    piece.high = high
    return piece


@wp.func
def reach(half: float, normal: wp.vec3) -> float:
    """Return how far a cube with sides of 2 ``half`` extends from its middle along ``normal``."""
    return half * (wp.abs(normal[0]) + wp.abs(normal[1]) + wp.abs(normal[2]))


@wp.func
def touches(piece: Piece, middle: wp.vec3) -> bool:
    """Tell whether the cube of voxel centres around ``middle`` may come into the piece; never no where it does."""
    offset = middle - piece.origin
    z = wp.dot(piece.axis, offset)
    reach_z = reach(piece.half, piece.axis)
    return (
        z - reach_z <= piece.far
        and z + reach_z >= piece.near
        and wp.dot(piece.left, offset) <= reach(piece.half, piece.left)
        and wp.dot(piece.right, offset) <= reach(piece.half, piece.right)
        and wp.dot(piece.top, offset) <= reach(piece.half, piece.top)
        and wp.dot(piece.bottom, offset) <= reach(piece.half, piece.bottom)
    )


@wp.func
def enter_piece(piece: Piece, voxel_size: float, keys: wp.array(dtype=wp.int64), key_count: wp.array(dtype=int)) -> int:
    """Enter every block with a voxel centre in the piece; returns 0, or what stands in the way."""
    side = _SIDE * voxel_size
    margin = 1.0e-3
    first_x = int(wp.ceil((piece.low[0] + voxel_size) / side - 1.0 - margin))
    first_y = int(wp.ceil((piece.low[1] + voxel_size) / side - 1.0 - margin))
    first_z = int(wp.ceil((piece.low[2] + voxel_size) / side - 1.0 - margin))
    last_x = int(wp.floor(piece.high[0] / side + margin))
    last_y = int(wp.floor(piece.high[1] / side + margin))
    last_z = int(wp.floor(piece.high[2] / side + margin))
    for x in range(first_x, last_x + 1):
        for y in range(first_y, last_y + 1):
            for z in range(first_z, last_z + 1):
                middle = side * wp.vec3(float(x), float(y), float(z)) + wp.vec3(piece.half, piece.half, piece.half)
                if touches(piece, middle):
                    key = block_key(wp.vec3i(x, y, z))
                    if key < wp.int64(0):
                        return _OUT_OF_RANGE
                    if not insert_key(keys, key, key_count):
                        return _TABLE_FULL
    return 0


@wp.func
def depth_ranges(depth: wp.array3d(dtype=float), frame: int, u0: int, v0: int, split_beyond: float) -> wp.vec4:
    """Return [nearest, farthest] of a tile's near pixels and of its far ones; an empty range begins at _FAR.

    All are near unless their depths span more than ``split_beyond``.
    """
    u1 = wp.min(u0 + _TILE, depth.shape[2])
    v1 = wp.min(v0 + _TILE, depth.shape[1])
    nearest = float(_FAR)
    farthest = float(0.0)
    for v in range(v0, v1):
        for u in range(u0, u1):
            z = depth[frame, v, u]
            if z > 0.0:
                nearest = wp.min(nearest, z)
                farthest = wp.max(farthest, z)
    if farthest - nearest <= split_beyond:
        return wp.vec4(nearest, farthest, _FAR, 0.0)
    middle = 0.5 * (nearest + farthest)
    near_end = float(0.0)
    far_begin = float(_FAR)
    for v in range(v0, v1):
        for u in range(u0, u1):
            z = depth[frame, v, u]
            if z > middle:
                far_begin = wp.min(far_begin, z)
            elif z > 0.0:
                near_end = wp.max(near_end, z)
    return wp.vec4(nearest, near_end, far_begin, farthest)


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
    u0 = tile_u * _TILE
    v0 = tile_v * _TILE
    # A pixel's footprint reaches half a pixel beyond its centre; a little more covers rounding in the projection.
    border = 0.51
    edges = wp.vec4(
        (float(u0) - border - intrinsics[2]) / intrinsics[0],
        (float(u0 + _TILE - 1) + border - intrinsics[2]) / intrinsics[0],
        (float(v0) - border - intrinsics[3]) / intrinsics[1],
        (float(v0 + _TILE - 1) + border - intrinsics[3]) / intrinsics[1],
    )
    band = 1.0001 * truncation
    ranges = depth_ranges(depth, frame, u0, v0, 2.0 * truncation)
    for i in range(2):
        if ranges[2 * i] < _FAR:
            near = wp.max(ranges[2 * i] - band, 1.0e-6)
            piece = piece_of_tile(world_from_camera[frame], edges, near, ranges[2 * i + 1] + band, voxel_size)
            problem = enter_piece(piece, voxel_size, keys, key_count)
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
