"""The kernel of integration: all voxels of the blocks that a batch's frames see.

A thread takes its voxels through all frames of the batch that see them; the sums stay in registers, so a voxel is read
and written once a batch however many frames see it. On CUDA that is one voxel, so that neighbouring threads read side
by side, and share a mask. On the CPU it is a block by rows of eight voxels along x, over which the projection moves by
a constant step. Both are the same C++, in loops over lanes that the CPU's compiler turns into vector instructions: that
takes half the time of Warp's scalar code.
"""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel
from fusion.integration.voxel_lanes import INTEGRATE_IN_CPP
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS
from fusion.volume.voxels import Voxels

_ROWS = wp.constant(BLOCK_SIDE * BLOCK_SIDE)
_VOXELS = wp.constant(BLOCK_VOXELS)


@wp.struct
class Rules:
    """``truncation`` metres; ``sign`` +1 to add frames, −1 to remove them; ``weight_cap`` of a voxel."""

    truncation: float
    sign: float
    weight_cap: float


@cache
def frames_type(depth_type: type) -> Any:
    """Return the struct of what the kernel reads of a batch, for depth of a type, uint16 or float32."""

    @wp.struct
    class Frames:
        """A batch's images, as in ``FrameBatch``, and its matrices, as in ``FrameMatrices``.

        ``pixel_weights`` are empty where all are 1.
        """

        depth: wp.array3d(dtype=depth_type)
        depth_scale: float
        color: wp.array3d(dtype=wp.uint8)
        confidence: wp.array3d(dtype=wp.uint8)
        pixel_weights: wp.array3d(dtype=float)
        pixel_from_lattice: wp.array(dtype=wp.mat44)

    return Frames


@cache
def kernel(depth_type: type, *, by_voxel: bool, bilinear: bool, weighted: bool, drop_off: bool) -> Kernel:
    """Return the kernel for the given options; its threads take a voxel each (for CUDA), or a block (for the CPU)."""
    constants = {"BILINEAR": bilinear, "WEIGHTED": weighted, "DROP_OFF": drop_off}
    declared = "".join(f"constexpr bool {name} = {str(value).lower()};\n" for name, value in constants.items())
    # On CUDA a voxel's frames stay in registers one by one; others wait for memory in the meantime. On the CPU a whole
    # batch at a time is slower: what is kept of each frame has to stay in the first-level cache.
    lanes, frames_at_once = (1, 1) if by_voxel else (BLOCK_SIDE, 16)
    declared += f"constexpr int LANES = {lanes}, FRAMES = {frames_at_once};\n"
    frames_struct = frames_type(depth_type)

    @wp.func_native(declared + INTEGRATE_IN_CPP)
    def integrate_lanes(
        frame_mask: wp.uint32,
        x: float,
        y: float,
        z: float,
        voxel: int,
        frames: frames_struct,
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        """Add the frames of ``frame_mask`` to the voxels from ``voxel`` on, at lattice position (x …, y, z)."""

    @wp.func
    def integrate(
        number: int,
        local: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        frames: frames_struct,
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        y = (local >> 3) & 7
        z = local >> 6
        part = (y >> 2) + 2 * (z >> 2)
        mask = masks[number, part]
        if mask != wp.uint32(0):
            corner = 8 * blocks[number] + wp.vec3i(local & 7, y, z)
            integrate_lanes(
                mask,
                float(corner[0]),
                float(corner[1]),
                float(corner[2]),
                number * _VOXELS + local,
                frames,
                rules,
                voxels,
            )

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def integrate_threads(
        first: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        frames: frames_struct,
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        index = wp.tid() + first
        if wp.static(by_voxel):
            number = index / _VOXELS
            integrate(number, index - number * _VOXELS, masks, blocks, frames, rules, voxels)
        else:
            for row in range(_ROWS):
                integrate(index, 8 * row, masks, blocks, frames, rules, voxels)

    return integrate_threads
