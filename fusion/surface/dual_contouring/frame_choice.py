"""Which frames are asked about each part of a block: few, those that tell most, from many directions.

What a frame tells about a place is its weight there (``depth_views``) over the square of how many voxels the surface
that it sees is off, if more than one: a frame that looks past tells little. A part may hold several faces, so eight
places of it take turns, each the voxel next to the surface in an eighth of the part, and takes the frame that tells
most about it of those left. A frame that looks from where others were taken already tells little new: each of these
divides what it tells by 2², 3², …; so more frames than needed do not crowd out other directions.

Places are asked about with all frames, once; all other questions then cost the same, however many frames there are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.integration.visible_blocks import PARTS
from fusion.surface.dual_contouring.frame_scores import PLACES
from fusion.surface.dual_contouring.lanes import lanes_for
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels, distance_of, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_FRAMES = 32
"""Asked about a part."""

_PARTS = wp.constant(PARTS)
_PLACES = wp.constant(PLACES)
_SCORES = 1 << 23
"""How many are kept at a time."""


@wp.kernel
def _find_places(first: int, voxels: Voxels, places: wp.array2d(dtype=int)) -> None:
    # Each a voxel of its block, −1 where the surface is not near.
    row = wp.tid() + first
    number = row / _PARTS
    part = row - _PARTS * number
    for place in range(_PLACES):
        nearest = float(1.0)
        found = int(-1)
        for step in range(16):
            x = 4 * (place & 1) + (step & 3)
            y = 4 * (part & 1) + (place & 2) + ((step >> 2) & 1)
            z = 4 * (part >> 1) + ((place & 4) >> 1) + (step >> 3)
            voxel = 64 * z + 8 * y + x
            if weight_of(voxels, 512 * number + voxel) > 0.0:
                distance = wp.abs(distance_of(voxels, 512 * number + voxel))
                if distance < nearest:
                    nearest = distance
                    found = voxel
        places[row, place] = found


# Directions fall into the squares of an octahedron that is folded open. `left` are the frames that tell anything.
_CHOOSE_IN_CPP = """
    constexpr int SIDE = 16;
    const int frames = centers.shape[0], stride = scores.shape[1], most = chosen.shape[1], room = columns.shape[2];
    float *told = scores.data + (size_t)PLACES * at * stride;
    int *left = candidates.data + (size_t)at * frames, *list = chosen.data + (size_t)row * most;
    unsigned char *ways = directions.data + (size_t)at * frames;
    float share[SIDE * SIDE];
    int taken[SIDE * SIDE], count = 0, found = 0;
    for (int way = 0; way < SIDE * SIDE; ++way) share[way] = 1.0f, taken[way] = 0;
    for (int frame = 0; frame < frames; ++frame) {
        bool tells = false;
        for (int place = 0; place < PLACES; ++place)
            tells |= places.data[PLACES * row + place] >= 0 && told[place * stride + frame] > 0.0f;
        if (!tells) continue;
        const wp::vec3 to = centers.data[frame];
        float dx = to[0] - x, dy = to[1] - y, dz = to[2] - z;
        const float scale = 1.0f / (fabsf(dx) + fabsf(dy) + fabsf(dz) + 1.0e-20f);
        dx *= scale, dy *= scale;
        if (dz < 0.0f) {
            const float folded = (1.0f - fabsf(dy)) * (dx < 0.0f ? -1.0f : 1.0f);
            dy = (1.0f - fabsf(dx)) * (dy < 0.0f ? -1.0f : 1.0f);
            dx = folded;
        }
        auto square = [](float along) {
            const int i = (int)((along + 1.0f) * (0.5f * SIDE));
            return i < 0 ? 0 : i >= SIDE ? SIDE - 1 : i;
        };
        ways[count] = SIDE * square(dy) + square(dx);
        left[count++] = frame;
    }
    for (bool more = true; more && found < most;) {
        more = false;
        for (int place = 0; place < PLACES && found < most; ++place) {
            if (places.data[PLACES * row + place] < 0) continue;
            const float *here = told + place * stride;
            float best = 0.0f;
            int which = -1;
            for (int i = 0; i < count; ++i) {
                const float tells = here[left[i]] * share[ways[i]];
                which = tells > best ? i : which;
                best = tells > best ? tells : best;
            }
            if (which < 0) continue;
            more = true;
            list[found++] = left[which];
            const int way = ways[which], times = ++taken[way] + 1;
            share[way] = 1.0f / (times * times);
            --count;
            for (int i = which; i < count; ++i) left[i] = left[i + 1], ways[i] = ways[i + 1];
        }
    }
    counts.data[row] = found;
    float *own = columns.data + (size_t)slot * 12 * room;
    for (int i = 0; i < 12; ++i)
        for (int column = 0; column < room; ++column)
            own[i * room + column] = column < found ? projections.data[i * stride + list[column]] : 0.0f;
"""


@wp.func_native(f"constexpr int PLACES = {PLACES};" + _CHOOSE_IN_CPP)
def choose(
    at: int,
    row: int,
    slot: int,
    x: float,
    y: float,
    z: float,
    places: wp.array2d(dtype=int),
    centers: wp.array(dtype=wp.vec3),
    projections: wp.array2d(dtype=float),
    scores: wp.array2d(dtype=float),
    candidates: wp.array2d(dtype=int),
    directions: wp.array2d(dtype=wp.uint8),
    chosen: wp.array2d(dtype=int),
    counts: wp.array(dtype=int),
    columns: wp.array3d(dtype=float),
) -> None:
    """Write the frames chosen for a part, whose middle is (x, y, z) on the lattice, and in a slot their projections."""


@wp.kernel
def _choose_frames(
    first: int,
    first_row: int,
    rows: wp.array(dtype=int),
    places: wp.array2d(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
    centers: wp.array(dtype=wp.vec3),
    projections: wp.array2d(dtype=float),
    scores: wp.array2d(dtype=float),
    candidates: wp.array2d(dtype=int),
    directions: wp.array2d(dtype=wp.uint8),
    chosen: wp.array2d(dtype=int),
    counts: wp.array(dtype=int),
    columns: wp.array3d(dtype=float),
) -> None:
    at = wp.tid() + first
    row = rows[first_row + at]
    block = blocks[row / _PARTS]
    x = float(8 * block[0]) + 3.5
    y = float(8 * block[1] + 4 * (row & 1)) + 1.5
    z = float(8 * block[2] + 4 * ((row >> 1) & 1)) + 1.5
    choose(
        at,
        row,
        first_row + at,
        x,
        y,
        z,
        places,
        centers,
        projections,
        scores,
        candidates,
        directions,
        chosen,
        counts,
        columns,
    )


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which frames are asked about each part of the volume's blocks.

    ``chosen`` (4 · blocks, most) in no order, ``counts`` (4 · blocks,) of them, and ``slots`` (4 · blocks,) in which of
    ``columns`` (slots, 12, most rounded up to lanes) their ``projections`` are, −1 where no frames are.
    """

    chosen: wp.array
    counts: wp.array
    slots: wp.array
    columns: wp.array


def choose_frames(volume: Volume, views: Any, kernel: Kernel, *, most: int) -> Choice:
    """Choose the frames to ask about each part of the volume's blocks, at most so many.

    ``kernel`` is the ``score_kernel`` for the frames, ``DepthViews``.
    """
    device, parts = volume.device, PARTS * volume.table.count
    frames, stride = views.depth.shape[0], views.projections.shape[1]
    places = wp.empty((parts, PLACES), dtype=int, device=device)
    launch_in_slabs(_find_places, dim=parts, inputs=[volume.voxels], outputs=[places], device=device, least_slab=1024)
    rows = np.flatnonzero((places.numpy() >= 0).any(axis=1)).astype(np.int32)
    slots = np.full(parts, -1, np.int32)
    slots[rows] = np.arange(len(rows))
    choice = Choice(
        chosen=wp.empty((parts, most), dtype=int, device=device),
        counts=wp.zeros(parts, dtype=int, device=device),
        slots=wp.array(slots, dtype=int, device=device),
        columns=wp.empty((len(rows), 12, lanes_for(most)), dtype=float, device=device),
    )
    at_once = max(1, min(len(rows), _SCORES // (PLACES * stride)))
    scores = wp.empty((PLACES * at_once, stride), dtype=float, device=device)
    candidates = wp.empty((at_once, frames), dtype=int, device=device)
    directions = wp.empty((at_once, frames), dtype=wp.uint8, device=device)
    rows_there = wp.array(rows, dtype=int, device=device)
    for first in range(0, len(rows), at_once):
        some = min(at_once, len(rows) - first)
        inputs = [first, rows_there, places, volume.table.blocks]
        launch_in_slabs(
            kernel, dim=PLACES * some, inputs=[*inputs, views], outputs=[scores], device=device, least_slab=64
        )
        launch_in_slabs(
            _choose_frames,
            dim=some,
            inputs=[*inputs, views.centers, views.projections, scores, candidates, directions],
            outputs=[choice.chosen, choice.counts, choice.columns],
            device=device,
            least_slab=64,
        )
    return choice
