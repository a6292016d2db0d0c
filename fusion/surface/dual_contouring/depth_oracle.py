"""The continuous field of the posed depth images themselves, which still has what voxels have rounded.

A point's value is the weighted average of the distances that frames say (``depth_views``), up to the truncation in
front of the surface; but a frame has little say about what lies behind the surface that it sees. Beside a sharp edge
that may be free again, as other frames see: with all their weight, those behind it would make the field bulge by a good
part of the truncation. A quarter of a voxel is left: the bulge grows with the square of what is, and with nothing a
noisy frame that sees the surface too near would not be outvoted by those that see it too far.

Every frame's images are kept, and for each part of a block which frames are asked (``frame_choice``).
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from datagen.errors import InputError
from fusion.devices import Kernel, free_memory, map_on_cores
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_matrices import frame_matrices
from fusion.integration.options import Integration
from fusion.integration.pixel_weights import pixel_weights
from fusion.integration.visible_blocks import PARTS
from fusion.surface.dual_contouring.depth_views import LOOK_IN_CPP, declared, views_type
from fusion.surface.dual_contouring.frame_choice import MOST_FRAMES, choose_frames
from fusion.surface.dual_contouring.frame_scores import score_kernel
from fusion.surface.dual_contouring.lanes import lanes_for
from fusion.surface.dual_contouring.oracle import NOT_KNOWN, Oracle
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_PARTS = wp.constant(PARTS)
BEHIND = 0.25
"""Voxels behind what a frame sees at which it has no say any more; its say falls to that linearly."""

MEMORY_SHARE = 0.7
"""Of the free memory, how much the images may take."""

FIELD_MODULES = tuple(f"fusion.surface.dual_contouring.{name}" for name in ("depth_oracle", "frame_choice"))
"""Their kernels are those of ``DepthField`` that are not made for a type of depth."""

_VALUE_IN_CPP = """
    const V none = 0.0f, one = 1.0f;
    const float farthest = truncation / voxel_size;
    const int room = columns.shape[2], count = counts.data[row];
    const int *list = chosen.data + (size_t)row * chosen.shape[1];
    const float *own = columns.data + (size_t)slot * 12 * room;
    V sums = none, totals = none, hidden = none;
    for (int first = 0; first < count; first += LANES) {
        V d, w;
        look(own + first, room, [&](int lane) { return list[first + lane < count ? first + lane : first]; }, d, w);
        const V share = d < none ? one + d * (1.0f / BEHIND) : one;
        hidden = ((w > none) & (share <= none)) ? one : hidden;
        const V say = share > none ? w * share : none;
        sums += say * (d < farthest ? d : (V)farthest);
        totals += say;
    }
    float sum = 0.0f, total = 0.0f, behind = 0.0f;
    for (int lane = 0; lane < LANES; ++lane) {
        sum += lanes_of(sums)[lane];
        total += lanes_of(totals)[lane];
        behind += lanes_of(hidden)[lane];
    }
    return total > 0.0f ? sum / total : behind > 0.0f ? -BEHIND : NONE;
"""


@cache
def depth_value(depth_type: type, *, weighted: bool) -> tuple[Any, Any]:
    """Return the Warp function of an ``Oracle`` for depth of a type, uint16 or float32, and the struct it takes."""
    constants = f"constexpr float NONE = {NOT_KNOWN}f, BEHIND = {BEHIND}f;\n"

    @wp.func_native(declared(depth_type, weighted=weighted) + constants + LOOK_IN_CPP + _VALUE_IN_CPP)
    def average_distance(
        x: float,
        y: float,
        z: float,
        row: int,
        slot: int,
        depth: wp.array3d(dtype=depth_type),
        pixel_weights: wp.array3d(dtype=float),
        depth_scale: float,
        intrinsics: wp.vec4,
        truncation: float,
        voxel_size: float,
        chosen: wp.array2d(dtype=int),
        counts: wp.array(dtype=int),
        columns: wp.array3d(dtype=float),
    ) -> float:
        """Return the average in voxels, NOT_KNOWN where no frame says anything."""

    all_views: Any = views_type(depth_type)

    @wp.struct
    class DepthState:
        """The frames, and a ``Choice`` of them for the parts of ``blocks``."""

        views: all_views
        blocks: wp.array(dtype=wp.vec3i)
        chosen: wp.array2d(dtype=int)
        counts: wp.array(dtype=int)
        slots: wp.array(dtype=int)
        columns: wp.array3d(dtype=float)

    @wp.func
    def value(state: DepthState, number: int, point: wp.vec3) -> float:
        """Return the continuous field at a point, in voxels."""
        block = state.blocks[number]
        y = wp.clamp(int(wp.floor(point[1])) - 8 * block[1], 0, 7)
        z = wp.clamp(int(wp.floor(point[2])) - 8 * block[2], 0, 7)
        row = _PARTS * number + (y >> 2) + 2 * (z >> 2)
        slot = state.slots[row]
        if slot < 0:
            return NOT_KNOWN
        return average_distance(
            point[0],
            point[1],
            point[2],
            row,
            slot,
            state.views.depth,
            state.views.pixel_weights,
            state.views.depth_scale,
            state.views.intrinsics,
            state.views.truncation,
            state.views.voxel_size,
            state.chosen,
            state.counts,
            state.columns,
        )

    return value, DepthState


@wp.kernel
def _keep_cameras(
    first: int,
    poses: wp.array(dtype=wp.mat44),
    pixel_from_lattice: wp.array(dtype=wp.mat44),
    voxel_size: float,
    projections: wp.array2d(dtype=float),
    centers: wp.array(dtype=wp.vec3),
) -> None:
    frame = wp.tid()
    pose = poses[frame]
    centers[first + frame] = wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3]) / voxel_size
    for row in range(3):
        for column in range(4):
            projections[4 * row + column, first + frame] = pixel_from_lattice[frame][row, column]


class DepthField:
    """The frames that were integrated into a volume, kept to ask for their field: ``add`` batches, then ``oracle``.

    ``frames`` is how many there will be, ``options`` what they were integrated with; depth is taken between pixels
    whatever these say. About each part of a block at most ``most_frames`` are asked.
    """

    def __init__(self, volume: Volume, options: Integration, *, frames: int, most_frames: int = MOST_FRAMES) -> None:
        self.volume = volume
        self.options = options
        self.frames = frames
        self.most_frames = most_frames
        self._count = 0
        self._views: Any = None
        self._depth_type: Any = None

    def add(self, batch: FrameBatch) -> None:
        """Copy a batch's images; raises InputError where those of all frames do not fit into memory."""
        volume = self.volume
        weights = pixel_weights(batch, self.options.weighting, step=volume.truncation)
        if self._views is None:
            weighted = weights is not None
            _require_memory(volume, batch, self.frames, weighted=weighted)
            self._depth_type = batch.depth.dtype
            self._views = _empty_views(volume, batch, self.frames, weighted=weighted)
        views = self._views
        images = slice(self._count, self._count + len(batch))
        _copy_images(views.depth[images], batch.depth)
        if weights is not None:
            _copy_images(views.pixel_weights[images], weights)
        matrices = frame_matrices(batch, volume.voxel_size)
        wp.launch(
            _keep_cameras,
            dim=len(batch),
            inputs=[self._count, matrices.world_from_camera, matrices.pixel_from_lattice, volume.voxel_size],
            outputs=[views.projections, views.centers],
            device=volume.device,
        )
        self._count += len(batch)

    def kernel(self) -> Kernel:
        """Return the kernel that chooses frames, made for those that were added, to be compiled ahead."""
        return score_kernel(self._depth_type, weighted=self._views.pixel_weights.size > 0)

    def oracle(self) -> Oracle:
        """Choose which frames are asked where, and return the oracle."""
        assert self._count == self.frames, "as many frames as were announced"
        value, state_type = depth_value(self._depth_type, weighted=self._views.pixel_weights.size > 0)
        state = state_type()
        state.views = self._views
        state.blocks = self.volume.table.blocks
        choice = choose_frames(self.volume, self._views, self.kernel(), most=self.most_frames)
        for name in ("chosen", "counts", "slots", "columns"):
            setattr(state, name, getattr(choice, name))
        return Oracle(value, state_type, state)


def _copy_images(kept: wp.array, images: wp.array) -> None:
    """Copy images, on the CPU on all cores: memory that is written for the first time takes longer than copying."""
    if kept.device.is_cuda:
        wp.copy(kept, images)
        return
    targets, sources = kept.numpy(), images.numpy()
    map_on_cores(lambda image: np.copyto(targets[image], sources[image]), range(len(sources)))


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


def _empty_views(volume: Volume, batch: FrameBatch, frames: int, *, weighted: bool) -> Any:
    device, camera = volume.device, batch.camera
    shape = (frames, camera.height, camera.width)
    views = views_type(batch.depth.dtype)()
    views.depth = wp.empty(shape, dtype=batch.depth.dtype, device=device)
    views.pixel_weights = wp.empty(shape if weighted else (0, 0, 0), dtype=float, device=device)
    views.depth_scale = batch.depth_scale
    views.intrinsics = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
    views.projections = wp.zeros((12, lanes_for(frames)), dtype=float, device=device)
    views.centers = wp.empty(frames, dtype=wp.vec3, device=device)
    views.truncation = volume.truncation
    views.voxel_size = volume.voxel_size
    return views
