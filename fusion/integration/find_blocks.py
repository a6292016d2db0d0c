"""The allocation pass: which blocks does the truncation band of each frame touch?

Pixels are taken in square tiles. A tile's valid depths span [z_min, z_max]; the band of all its pixels lies in the
piece of the tile's frustum between z_min − t and z_max + t. Every block whose voxel centres come into that convex piece
is found, by testing the box of the centres against the piece's six planes: no block of the band is ever missed, some
beside it are taken. A cell of 32×32 pixels is one piece where that costs few blocks beside the band: it is no wider
than a block and its depths span no more than the truncation. Elsewhere it is divided, down to 8×8. Where such a tile
spans an edge in depth, its near and far pixels make a piece each.
"""

import warp as wp

from datagen.errors import InputError
from fusion.devices import launch_in_slabs
from fusion.frames.depth_tiles import NONE_NEAR, TILE, DepthTiles
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_matrices import FrameMatrices
from fusion.volume.block_table import (
    BLOCK_SIDE,
    COORDINATE_LIMIT,
    OUT_OF_RANGE,
    TABLE_FULL,
    BlockArrays,
    BlockTable,
    enter_block,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

CELL_TILES = 4
"""A cell is this many tiles wide."""

_TILE = wp.constant(float(TILE))
_CELL_TILES = wp.constant(CELL_TILES)
_SIDE = wp.constant(float(BLOCK_SIDE))
_FAR = wp.constant(3.0e38)
_TABLE_FULL = wp.constant(TABLE_FULL)
_OUT_OF_RANGE = wp.constant(OUT_OF_RANGE)


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
def enter_piece(piece: Piece, voxel_size: float, table: BlockArrays) -> int:
    """Enter every block with a voxel centre in the piece; returns 0, or what stands in the way."""
    side = _SIDE * voxel_size
    limit = side * float(COORDINATE_LIMIT)
    if wp.max(wp.max(wp.abs(piece.low)), wp.max(wp.abs(piece.high))) >= limit:
        return _OUT_OF_RANGE
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
                    result = enter_block(table, wp.vec3i(x, y, z))
                    if result >= _TABLE_FULL:
                        return result
    return 0


@wp.func
def range_of_tiles(ranges: wp.array3d(dtype=wp.vec4), frame: int, u: int, v: int, size: int) -> wp.vec2:
    """Return the nearest and farthest depth in a square of ``size`` tiles."""
    near = float(NONE_NEAR)
    far = float(0.0)
    for row in range(v, wp.min(v + size, ranges.shape[1])):
        for column in range(u, wp.min(u + size, ranges.shape[2])):
            tile = ranges[frame, row, column]
            near = wp.min(near, tile[0])
            far = wp.max(far, wp.max(tile[1], tile[3]))
    return wp.vec2(near, far)


@wp.func
def enter_range(
    near: float,
    far: float,
    u: int,
    v: int,
    size: int,
    pose: wp.mat44,
    intrinsics: wp.vec4,
    truncation: float,
    voxel_size: float,
    table: BlockArrays,
) -> int:
    """Enter the blocks of a square of ``size`` tiles whose depths span [near, far]; returns as ``enter_piece``."""
    # Bilinear sampling reaches up to a pixel beyond the outermost centres; a little more covers rounding.
    left = float(u) * _TILE - 1.01
    top = float(v) * _TILE - 1.01
    width = float(size) * _TILE + 1.02
    edges = wp.vec4(
        (left - intrinsics[2]) / intrinsics[0],
        (left + width - intrinsics[2]) / intrinsics[0],
        (top - intrinsics[3]) / intrinsics[1],
        (top + width - intrinsics[3]) / intrinsics[1],
    )
    band = 1.0001 * truncation
    piece = piece_of_tile(pose, edges, wp.max(near - band, 1.0e-6), far + band, voxel_size)
    return enter_piece(piece, voxel_size, table)


@wp.kernel
def _enter_blocks(
    first: int,
    ranges: wp.array3d(dtype=wp.vec4),
    world_from_camera: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    truncation: float,
    voxel_size: float,
    table: BlockArrays,
    answers: wp.array(dtype=int),
) -> None:
    index = wp.tid() + first
    columns = (ranges.shape[2] + _CELL_TILES - 1) / _CELL_TILES
    rows = (ranges.shape[1] + _CELL_TILES - 1) / _CELL_TILES
    cell_u = (index % columns) * _CELL_TILES
    cell_v = ((index / columns) % rows) * _CELL_TILES
    frame = index / (columns * rows)
    pose = world_from_camera[frame]
    widest = _SIDE * voxel_size * wp.min(intrinsics[0], intrinsics[1]) / _TILE
    # Squares of the cell in the order of a quadtree's walk: where one is entered whole, its parts are passed over.
    step = int(0)
    while step < _CELL_TILES * _CELL_TILES:
        u = cell_u + (step & 1) + ((step >> 2) & 1) * 2
        v = cell_v + ((step >> 1) & 1) + ((step >> 3) & 1) * 2
        size = int(1)
        span = wp.vec2(0.0, 0.0)
        if step == 0:
            size = _CELL_TILES
        elif step % 4 == 0:
            size = 2
        whole = bool(False)
        while size > 1 and not whole:
            span = range_of_tiles(ranges, frame, u, v, size)
            whole = span[1] == 0.0 or (span[1] - span[0] <= 2.0 * truncation and float(size) * span[1] <= widest)
            if not whole:
                size = size >> 1
        problem = int(0)
        if whole:
            if span[1] > 0.0:
                problem = enter_range(span[0], span[1], u, v, size, pose, intrinsics, truncation, voxel_size, table)
        elif u < ranges.shape[2] and v < ranges.shape[1]:
            tile = ranges[frame, v, u]
            if tile[0] < NONE_NEAR:
                problem = enter_range(tile[0], tile[1], u, v, 1, pose, intrinsics, truncation, voxel_size, table)
            if tile[2] < NONE_NEAR and problem == 0:
                problem = enter_range(tile[2], tile[3], u, v, 1, pose, intrinsics, truncation, voxel_size, table)
        if problem != 0:
            answers[index] = problem
            break
        step += size * size


def launch_find_blocks(
    table: BlockTable,
    batch: FrameBatch,
    tiles: DepthTiles,
    matrices: FrameMatrices,
    *,
    truncation: float,
    voxel_size: float,
) -> wp.array:
    """Enter the blocks of the batch's bands, as far as the table has room; returns (frames · cells,) answers.

    They are 0, TABLE_FULL or OUT_OF_RANGE: what stood in the way of each cell of each frame.
    """
    camera = batch.camera
    _, rows, columns = tiles.ranges.shape
    cells = len(batch) * -(-rows // CELL_TILES) * -(-columns // CELL_TILES)
    answers = wp.zeros(cells, dtype=int, device=table.device)
    launch_in_slabs(
        _enter_blocks,
        dim=cells,
        inputs=[
            tiles.ranges,
            matrices.world_from_camera,
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            truncation,
            voxel_size,
        ],
        outputs=[table.arrays, answers],
        device=table.device,
        least_slab=64,
    )
    return answers


def find_blocks(
    table: BlockTable,
    batch: FrameBatch,
    tiles: DepthTiles,
    matrices: FrameMatrices,
    *,
    truncation: float,
    voxel_size: float,
) -> None:
    """Enter the blocks that the batch's truncation bands touch.

    Which they are depends on the frames alone. ``truncation`` and ``voxel_size`` are metres. Raises BlockLimitError
    where the table may not grow as far as the frames ask, and InputError for surfaces too far away to be numbered.
    """
    while True:
        answers = launch_find_blocks(table, batch, tiles, matrices, truncation=truncation, voxel_size=voxel_size)
        problem = answers.numpy().max()
        if problem == OUT_OF_RANGE:
            raise out_of_range(voxel_size)
        if problem != TABLE_FULL:
            break
        table.grow()
    table.read_count()


def out_of_range(voxel_size: float) -> InputError:
    """Return the error for surfaces too far away to be numbered."""
    reach = COORDINATE_LIMIT * BLOCK_SIDE * voxel_size
    return InputError(
        f"a surface is more than {reach:.3g} m from the world's origin, too far for voxels of {voxel_size:g} m; use a "
        "larger --voxel-size, or leave far depths out with --depth-max"
    )
