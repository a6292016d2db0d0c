"""The continuous field of the posed depth images themselves, which still has what voxels have rounded.

A point's value is the weighted average of the truncated distances that the frames measure there, as integration would
store it for a voxel, with depth taken between pixels of one surface; but a frame has little say about what lies behind
the surface that it sees. Beside a sharp edge that may be free again, as other frames see: with all their weight, those
behind it would make the field bulge by a good part of the truncation. Half a voxel is left, so that a noisy frame that
sees the surface too near is still outvoted by those that see it too far.

Every frame's images are kept, and for each part of a block the frames that may see it.
"""

from functools import cache
from typing import Any

import warp as wp

from datagen.errors import InputError
from fusion.devices import free_memory, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_matrices import frame_matrices
from fusion.integration.fuse_batch import survey_batch
from fusion.integration.options import Integration
from fusion.integration.pixel_weights import pixel_weights
from fusion.integration.visible_blocks import PARTS, visible_blocks
from fusion.surface.dual_contouring.oracle import NOT_KNOWN, Oracle
from fusion.volume.block_table import find_block
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_PARTS = wp.constant(PARTS)
BEHIND = 0.5
"""Voxels behind what a frame sees at which it has no say any more; its say falls to that linearly."""

MEMORY_SHARE = 0.7
"""Of the free memory, how much the images may take."""

# As in ``fusion.integration.integrate``, for one point and between pixels only.
_VALUE_IN_CPP = """
    const int words = masks.shape[1], height = depth.shape[1], width = depth.shape[2];
    const float t = truncation;
    float sum = 0.0f, total = 0.0f;
    bool hidden = false;
    for (int word = 0; word < words; ++word) {
        for (unsigned int left = masks.data[(size_t)row * words + word]; left != 0; left &= left - 1) {
#ifdef __CUDA_ARCH__
            const int frame = 32 * word + __ffs(left) - 1;
#else
            const int frame = 32 * word + __builtin_ctz(left);
#endif
            const wp::mat44 &p = pixel_from_lattice.data[frame];
            const float z_point = p.data[2][0] * x + p.data[2][1] * y + p.data[2][2] * z + p.data[2][3];
            if (!(z_point > 0.0f)) continue;
            const float inverse_z = 1.0f / z_point;
            const float u = (p.data[0][0] * x + p.data[0][1] * y + p.data[0][2] * z + p.data[0][3]) * inverse_z;
            const float v = (p.data[1][0] * x + p.data[1][1] * y + p.data[1][2] * z + p.data[1][3]) * inverse_z;
            if (!(u >= -0.5f && v >= -0.5f && u < width - 0.5f && v < height - 0.5f)) continue;
            const int u1 = (int)(u + 1.0f), v1 = (int)(v + 1.0f);  // the pixel after the one before
            const float du = u + 1.0f - u1, dv = v + 1.0f - v1;
            const int left_u = u1 > 0 ? u1 - 1 : 0, right_u = u1 < width ? u1 : width - 1;
            const int upper_v = (v1 > 0 ? v1 - 1 : 0) * width, lower_v = (v1 < height ? v1 : height - 1) * width;
            const size_t image = (size_t)frame * height * width;
            const auto *depths = depth.data + image;
            const float a = (float)depths[upper_v + left_u], b = (float)depths[upper_v + right_u];
            const float c = (float)depths[lower_v + left_u], e = (float)depths[lower_v + right_u];
            const float low_ab = a < b ? a : b, low_ce = c < e ? c : e, low = low_ab < low_ce ? low_ab : low_ce;
            const float high_ab = a > b ? a : b, high_ce = c > e ? c : e, high = high_ab > high_ce ? high_ab : high_ce;
            if (!(low > 0.0f) || (high - low) * depth_scale > t || depth_scale * high < z_point - t) continue;
            const float inverse = (1.0f - dv) * ((1.0f - du) / a + du / b) + dv * ((1.0f - du) / c + du / e);
            const float ratio = (depth_scale / inverse - z_point) / t;
            if (ratio < -1.0f) continue;
            hidden |= ratio <= -behind;
            if (ratio <= -behind) continue;
            float w = ratio < 0.0f ? 1.0f + ratio / behind : 1.0f;
            if (WEIGHTED) w *= pixel_weights.data[image + (size_t)(int)(v + 0.5f) * width + (int)(u + 0.5f)];
            sum += w * (ratio < 1.0f ? ratio : 1.0f);
            total += w;
        }
    }
    return total > 0.0f ? sum / total : hidden ? -behind : NONE;
"""


@wp.kernel
def _spread_masks(
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    masks: wp.array2d(dtype=wp.uint32),
    first_frame: int,
    all_masks: wp.array2d(dtype=wp.uint32),
) -> None:
    # The masks are for voxel centres; points lie between these and the next part's.
    row = wp.tid() + first
    number = row / _PARTS
    part = row - _PARTS * number
    seen = wp.uint32(0)
    for step in range(8):
        y = (part & 1) + ((step >> 1) & 1)
        z = (part >> 1) + (step >> 2)
        beyond = wp.vec3i(step & 1, y >> 1, z >> 1)
        holder = number
        if beyond[0] + beyond[1] + beyond[2] > 0:
            holder = find_block(keys, numbers, blocks[number] + beyond)
        if holder >= 0 and holder < masks.shape[0]:
            seen |= masks[holder, (y & 1) + 2 * (z & 1)]
    # A batch may begin within a word.
    word = first_frame / 32
    bits = wp.uint64(seen) << wp.uint64(first_frame & 31)
    all_masks[row, word] = all_masks[row, word] | wp.uint32(bits & wp.uint64(0xFFFFFFFF))
    high = wp.uint32(bits >> wp.uint64(32))
    if high != wp.uint32(0):
        all_masks[row, word + 1] = all_masks[row, word + 1] | high


@cache
def depth_value(depth_type: type, *, weighted: bool) -> tuple[Any, Any]:
    """Return the Warp function of an ``Oracle`` for depth of a type, uint16 or float32, and the struct it takes."""
    declared = f"constexpr bool WEIGHTED = {str(weighted).lower()};\n"
    declared += f"constexpr float NONE = {NOT_KNOWN}f;\n"

    @wp.func_native(declared + _VALUE_IN_CPP)
    def average_distance(
        x: float,
        y: float,
        z: float,
        row: int,
        masks: wp.array2d(dtype=wp.uint32),
        depth: wp.array3d(dtype=depth_type),
        pixel_weights: wp.array3d(dtype=float),
        depth_scale: float,
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        truncation: float,
        behind: float,
    ) -> float:
        """Return the average in units of the truncation, NOT_KNOWN where no frame says anything."""

    @wp.struct
    class DepthState:
        """The frames of all batches, as in ``FrameBatch``.

        ``masks`` (4 · blocks, words): frame 32·w + i is bit i of word w where it may see the block's part. ``behind``
        is in units of the truncation.
        """

        blocks: wp.array(dtype=wp.vec3i)
        masks: wp.array2d(dtype=wp.uint32)
        depth: wp.array3d(dtype=depth_type)
        pixel_weights: wp.array3d(dtype=float)
        depth_scale: float
        pixel_from_lattice: wp.array(dtype=wp.mat44)
        truncation: float
        behind: float
        voxels_a_truncation: float

    @wp.func
    def value(state: DepthState, number: int, point: wp.vec3) -> float:
        """Return the continuous field at a point, in voxels."""
        block = state.blocks[number]
        y = wp.clamp(int(wp.floor(point[1])) - 8 * block[1], 0, 7)
        z = wp.clamp(int(wp.floor(point[2])) - 8 * block[2], 0, 7)
        row = _PARTS * number + (y >> 2) + 2 * (z >> 2)
        average = average_distance(
            point[0],
            point[1],
            point[2],
            row,
            state.masks,
            state.depth,
            state.pixel_weights,
            state.depth_scale,
            state.pixel_from_lattice,
            state.truncation,
            state.behind,
        )
        if average < 2.0:
            return state.voxels_a_truncation * average
        return NOT_KNOWN

    return value, DepthState


class DepthField:
    """The frames that were integrated into a volume, kept to ask for their field: ``add`` batches, then ``oracle``.

    ``frames`` is how many there will be, ``options`` what they were integrated with; depth is taken between pixels
    whatever these say.
    """

    def __init__(self, volume: Volume, options: Integration, *, frames: int) -> None:
        self.volume = volume
        self.options = options
        self.frames = frames
        self._count = 0
        self._value: Any = None
        self._state_type: Any = None
        self._state: Any = None

    def add(self, batch: FrameBatch) -> None:
        """Copy a batch's images; raises InputError where those of all frames do not fit into memory."""
        volume, state = self.volume, self._state
        weights = pixel_weights(batch, self.options.weighting, step=volume.truncation)
        if state is None:
            weighted = weights is not None
            _require_memory(volume, batch, self.frames, weighted=weighted)
            self._value, self._state_type = depth_value(batch.depth.dtype, weighted=weighted)
            state = self._state = _empty_state(self._state_type, volume, batch, self.frames, weighted=weighted)
        images = slice(self._count, self._count + len(batch))
        wp.copy(state.depth[images], batch.depth)
        if weights is not None:
            wp.copy(state.pixel_weights[images], weights)
        matrices = frame_matrices(batch, volume.voxel_size)
        wp.copy(state.pixel_from_lattice[images], matrices.pixel_from_lattice)
        tiles = survey_batch(batch, truncation=volume.truncation)
        masks = visible_blocks(volume.table, batch, tiles, matrices, truncation=volume.truncation)
        launch_in_slabs(
            _spread_masks,
            dim=PARTS * volume.table.count,
            inputs=[volume.table.blocks, volume.table.keys, volume.table.numbers, masks, self._count],
            outputs=[state.masks],
            device=volume.device,
            least_slab=1024,
        )
        self._count += len(batch)

    def oracle(self) -> Oracle:
        """Return the oracle of all frames."""
        assert self._count == self.frames, "as many frames as were announced"
        return Oracle(self._value, self._state_type, self._state)


def _require_memory(volume: Volume, batch: FrameBatch, frames: int, *, weighted: bool) -> None:
    """Raise InputError where the frames' images would take too much memory."""
    pixel_bytes = (2 if batch.depth.dtype is wp.uint16 else 4) + (4 if weighted else 0)
    needed = frames * batch.camera.width * batch.camera.height * pixel_bytes
    free = free_memory(volume.device)
    if needed > MEMORY_SHARE * free:
        raise InputError(
            f"--oracle depth: {frames} depth images take {needed / 2**30:.1f} GiB, of {free / 2**30:.1f} GiB that are "
            "free; take fewer --frames, or --oracle volume"
        )


def _empty_state(state_type: Any, volume: Volume, batch: FrameBatch, frames: int, *, weighted: bool) -> Any:
    device, camera = volume.device, batch.camera
    shape = (frames, camera.height, camera.width)
    state = state_type()
    state.blocks = volume.table.blocks
    state.masks = wp.zeros((PARTS * volume.table.count, -(-frames // 32)), dtype=wp.uint32, device=device)
    state.depth = wp.empty(shape, dtype=batch.depth.dtype, device=device)
    state.pixel_weights = wp.empty(shape if weighted else (0, 0, 0), dtype=float, device=device)
    state.depth_scale = batch.depth_scale
    state.pixel_from_lattice = wp.empty(frames, dtype=wp.mat44, device=device)
    state.truncation = volume.truncation
    state.behind = BEHIND * volume.voxel_size / volume.truncation
    state.voxels_a_truncation = volume.truncation / volume.voxel_size
    return state
