"""The allocation pass: which blocks does the truncation band of each frame touch?

Pixels are taken in square tiles. A tile's valid depths span [z_min, z_max]; the band of all its pixels lies in the
piece of the tile's frustum between z_min − t and z_max + t. Every block whose voxel centres come into that convex piece
is found, by testing the box of the centres against the piece's six planes: no block of the band is ever missed, some
beside it are taken. Where a tile spans an edge in depth, its near and far pixels make a piece each.
"""

import warp as wp

from datagen.errors import InputError
from fusion.devices import launch_in_slabs
from fusion.frames.depth_tiles import NONE_NEAR, DepthTiles
from fusion.frames.frame_batch import TILE, FrameBatch
from fusion.frames.frame_matrices import FrameMatrices
from fusion.volume.block_table import (
    BLOCK_SIDE,
    COORDINATE_LIMIT,
    ENTER_IN_CPP,
    OUT_OF_RANGE,
    TABLE_FULL,
    BlockArrays,
    BlockTable,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# A point of a tile's piece is origin + z (x a + y b + c), with x and y the slopes of its ray and a, b, c the camera's
# axes: its extremes over the piece are those of x a and of y b, added, times the nearest or the farthest z. Its planes
# pass through the origin, but for two across the axis; n · (p − origin) ≤ 0 inside. On the CPU a thread has a row of
# tiles, and remembers the blocks that it entered last: most tiles ask for those of the tile before.
_FIND_IN_CPP = """
#ifdef __CUDA_ARCH__
    constexpr int REMEMBERED = 1;
#else
    constexpr int REMEMBERED = 64;
#endif
    int remembered[REMEMBERED][3];
    for (int i = 0; i < REMEMBERED; ++i) remembered[i][0] = remembered[i][1] = remembered[i][2] = 2 * BLOCK_LIMIT;
    const float side = SIDE * voxel_size, limit = side * BLOCK_LIMIT, band = 1.0001f * truncation;
    // Half the distance between a block's outer voxel centres, a little more against rounding.
    const float half = 0.5f * (SIDE - 1.0f) * voxel_size * 1.0001f, margin = 1e-3f;
    const wp::mat44 &pose = world_from_camera;
    auto lesser = [](float a, float b) { return a < b ? a : b; };
    auto greater = [](float a, float b) { return a > b ? a : b; };
    auto size = [](float a) { return a < 0.0f ? -a : a; };
    // How far a cube with sides of 2 half extends from its middle along a normal.
    auto reach = [&](const float *n) { return half * (size(n[0]) + size(n[1]) + size(n[2])); };
    const float axis[3] = {pose.data[0][2], pose.data[1][2], pose.data[2][2]}, axis_reach = reach(axis);
    // Bilinear sampling reaches up to a pixel beyond the outermost centres; a little more covers rounding.
    const float top = (TILE * tile_v - 1.01f - cy) / fy, bottom = (TILE * tile_v + TILE + 0.01f - cy) / fy;
    float above[3], below[3];
    for (int i = 0; i < 3; ++i) {
        above[i] = top * axis[i] - pose.data[i][1];
        below[i] = pose.data[i][1] - bottom * axis[i];
    }
    const float top_reach = reach(above), bottom_reach = reach(below);
    for (int tile_u = first_u; tile_u < first_u + count; ++tile_u) {
        const wp::vec4 &range = ranges.data[((size_t)frame * ranges.shape[1] + tile_v) * ranges.shape[2] + tile_u];
        const float left = (TILE * tile_u - 1.01f - cx) / fx, right = (TILE * tile_u + TILE + 0.01f - cx) / fx;
        float to_left[3], to_right[3];
        for (int i = 0; i < 3; ++i) {
            to_left[i] = left * axis[i] - pose.data[i][0];
            to_right[i] = pose.data[i][0] - right * axis[i];
        }
        const float left_reach = reach(to_left), right_reach = reach(to_right);
        for (int piece = 0; piece < 2; ++piece) {
            if (range.c[2 * piece] >= NONE_NEAR) continue;
            const float near = greater(range.c[2 * piece] - band, 1e-6f), far = range.c[2 * piece + 1] + band;
            int first[3], last[3];
            for (int i = 0; i < 3; ++i) {
                const float *to_world = pose.data[i];
                const float least = lesser(left * to_world[0], right * to_world[0])
                                    + lesser(top * to_world[1], bottom * to_world[1]) + to_world[2];
                const float most = greater(left * to_world[0], right * to_world[0])
                                   + greater(top * to_world[1], bottom * to_world[1]) + to_world[2];
                const float low = to_world[3] + least * (least < 0.0f ? far : near);
                const float high = to_world[3] + most * (most > 0.0f ? far : near);
                if (!(greater(size(low), size(high)) < limit)) return OUT_OF_RANGE;
                first[i] = (int)ceilf((low + voxel_size) / side - 1.0f - margin);
                last[i] = (int)floorf(high / side + margin);
            }
            for (int x = first[0]; x <= last[0]; ++x)
            for (int y = first[1]; y <= last[1]; ++y)
            for (int z = first[2]; z <= last[2]; ++z) {
                int *known = remembered[(x * 7 + y * 13 + z * 29) & (REMEMBERED - 1)];
                if (known[0] == x && known[1] == y && known[2] == z) continue;
                const float dx = side * x + half - pose.data[0][3], dy = side * y + half - pose.data[1][3];
                const float dz = side * z + half - pose.data[2][3];
                auto along = [&](const float *n) { return n[0] * dx + n[1] * dy + n[2] * dz; };
                const float depth = along(axis);
                const bool touches = (depth - axis_reach <= far) & (depth + axis_reach >= near)
                                     & (along(to_left) <= left_reach) & (along(to_right) <= right_reach)
                                     & (along(above) <= top_reach) & (along(below) <= bottom_reach);
                if (!touches) continue;
                const int result = enter_block(x, y, z);
                if (result >= TABLE_FULL) return result;
                known[0] = x; known[1] = y; known[2] = z;
            }
        }
    }
    return 0;
"""
_DECLARED = f"""
    constexpr float SIDE = {BLOCK_SIDE}.0f, NONE_NEAR = {float(NONE_NEAR)}f;
    constexpr int TILE = {TILE};
"""


@wp.func_native(ENTER_IN_CPP + _DECLARED + _FIND_IN_CPP)
def enter_tiles(
    frame: int,
    tile_v: int,
    first_u: int,
    count: int,
    ranges: wp.array3d(dtype=wp.vec4),
    world_from_camera: wp.mat44,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    truncation: float,
    voxel_size: float,
    table: BlockArrays,
) -> int:
    """Enter the blocks of ``count`` tiles of a row; returns 0, or what stands in the way."""


@wp.kernel
def _enter_blocks(
    first: int,
    count: int,
    ranges: wp.array3d(dtype=wp.vec4),
    world_from_camera: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    truncation: float,
    voxel_size: float,
    table: BlockArrays,
    answers: wp.array(dtype=int),
) -> None:
    index = wp.tid() + first
    parts = ranges.shape[2] / count
    row = index / parts
    frame = row / ranges.shape[1]
    answers[index] = enter_tiles(
        frame,
        row - frame * ranges.shape[1],
        (index - row * parts) * count,
        count,
        ranges,
        world_from_camera[frame],
        intrinsics[0],
        intrinsics[1],
        intrinsics[2],
        intrinsics[3],
        truncation,
        voxel_size,
        table,
    )


def launch_find_blocks(
    table: BlockTable,
    batch: FrameBatch,
    tiles: DepthTiles,
    matrices: FrameMatrices,
    *,
    truncation: float,
    voxel_size: float,
) -> wp.array:
    """Enter the blocks of the batch's bands, as far as the table has room; returns answers.

    They are 0, TABLE_FULL or OUT_OF_RANGE: what stood in the way of each thread's tiles.
    """
    camera = batch.camera
    count = 1 if table.device.is_cuda else tiles.ranges.shape[2]
    answers = wp.empty(tiles.ranges.size // count, dtype=int, device=table.device)
    launch_in_slabs(
        _enter_blocks,
        dim=len(answers),
        inputs=[
            count,
            tiles.ranges,
            matrices.world_from_camera,
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            truncation,
            voxel_size,
        ],
        outputs=[table.arrays, answers],
        device=table.device,
        least_slab=8,
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
