"""How far colour lies beside depth: edges of depth found again in colour, over all offsets."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.dataset_check.views import inverse_depth

EDGE = 0.08
"""Relative step of inverse depth between neighbours that makes an edge: one surface before another."""

CREASE = 0.02
"""Relative change of inverse depth's rise over ``CREASES_SIDES``-ths of the image's length that makes a crease."""

CREASES_SIDES = 64
LARGEST_OFFSET_PX = 12
LEAST_FRAMES = 2
EDGES_PER_FRAME = 600
LEAST_EDGES = 30
MOST_LOST_PX = 3
"""Depth sensors lose some pixels of the nearer surface at its edges, as many to either side."""

WIDEST_SHADOW = 0.1
"""Of the image's width: missing depth that is wider is no shadow of the nearer surface, but nothing to be seen."""

FLAT = 4.0
"""Colour differences of so few grey levels count half: noise has them too."""


LEAST_PROMINENCE = 6.0
"""Standard deviations by which the best offset stands out from all others where it is one at all."""

ZOOMED_FRAMES = 16
LEAST_ZOOMED_PROMINENCE, LEAST_ZOOMED_SIGNIFICANCE = 3.5, 8.0

ZOOMS = tuple(1 + 0.02 * step for step in range(-7, 8) if step)
"""Tried where no offset stands out: colour taken with another focal length and not registered to depth."""


@dataclass(frozen=True, kw_only=True)
class ColorAlignment:
    """Where depth's edges are found in colour.

    A depth pixel p is at c + zoom (p − c) + ``offset_px`` (x, y) in colour, c the image's centre. ``significance`` is
    the score's lead over that of no offset, in standard errors between frames; ``prominence`` is how far the best score
    stands above those of all offsets, in their standard deviations. ``lost_px`` is by how many pixels depth's surfaces
    are too small at their edges. ``frames`` had edges.
    """

    offset_px: tuple[float, float]
    zoom: float
    significance: float
    prominence: float
    lost_px: int
    frames: int
    edges: int

    @property
    def length_px(self) -> float:
        """Length of the offset."""
        return float(np.hypot(*self.offset_px))

    @property
    def is_clear(self) -> bool:
        """Whether one offset stands out from the others; parallax smears it out where another lens took the colour."""
        if self.zoom == 1:
            return self.prominence >= LEAST_PROMINENCE
        return self.prominence >= LEAST_ZOOMED_PROMINENCE and self.significance >= LEAST_ZOOMED_SIGNIFICANCE


@dataclass(frozen=True)
class _Edges:
    """Edges of one frame's depth between neighbours along ``axis``, and colour's differences between the same.

    ``outwards`` is the sense in which the nearer surface ends, 0 at a crease.
    """

    axis: int
    outwards: int
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    across_color: NDArray[np.float32]


def largest_offset(width: int) -> int:
    """Return how far offsets are looked for in images of a ``width``, pixels."""
    return max(LARGEST_OFFSET_PX, width // 30)


def measure_color_alignment(
    images: Iterable[tuple[NDArray[np.uint8], NDArray[np.float32]]], rng: np.random.Generator
) -> ColorAlignment | None:
    """Register depth's edges with colour's over frames of colour (H, W, 3) and depth (H, W); None without edges.

    Where the ends of surfaces do not tell, their creases are tried.

    For each offset, the colour differences across all of depth's edges are averaged, each saturating at strong ones;
    both differences are taken between the same two pixels, so that neither side is preferred. Pixels that depth loses
    at the edges move left and right, or upper and lower, edges of a surface against each other; an offset moves them
    together.
    """
    images = list(images)
    frames = _with_edges([_frame_edges(color, depth, rng) for color, depth in images])
    alignment = _best_offset(frames, zoom=1.0) if len(frames) >= LEAST_FRAMES else None
    if alignment is None or not alignment.is_clear:
        creased = _with_edges([_frame_creases(color, depth, rng) for color, depth in images])
        bent = _best_offset(creased, zoom=1.0, most_lost=0) if len(creased) >= LEAST_FRAMES else None
        if bent is not None and bent.is_clear:
            return bent
    if alignment is not None and not alignment.is_clear:
        some = frames[:: -(-len(frames) // ZOOMED_FRAMES)]
        zoomed = max((_best_offset(some, zoom=zoom, most_lost=0) for zoom in ZOOMS), key=lambda each: each.prominence)
        alignment = zoomed if zoomed.is_clear else alignment
    return alignment


def _best_offset(frames: list[list[_Edges]], *, zoom: float, most_lost: int = MOST_LOST_PX) -> ColorAlignment:
    sums = np.array([[_scores(each, zoom, most_lost) for each in edges] for edges in frames])
    counts = np.array([[max(each.rows.size, 1) for each in edges] for edges in frames])
    combined = _combined(sums.sum(axis=0), counts.sum(axis=0))
    lost, row, column = (int(i) for i in np.unravel_index(int(combined.argmax()), combined.shape))
    reach = combined.shape[-1] // 2
    lead = (sums[:, :, lost, row, column] - sums[:, :, lost, reach, reach]).sum(axis=1) / counts.sum(axis=1)
    error = float(lead.std(ddof=1)) / np.sqrt(len(lead))
    best = combined[lost]
    return ColorAlignment(
        offset_px=(_peak(best[row], column) - reach, _peak(best[:, column], row) - reach),
        zoom=zoom,
        significance=float(lead.mean()) / max(error, 1e-9) if (row, column) != (reach, reach) else 0.0,
        prominence=float((best.max() - best.mean()) / max(float(best.std()), 1e-9)),
        lost_px=lost,
        frames=len(frames),
        edges=sum(each.rows.size for edges in frames for each in edges),
    )


def _combined(sums: NDArray[np.float64], counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return one score (lost, rows, columns) from those of the four kinds of edges: two axes, two senses.

    Of the two senses the worse one counts: an offset must bring a surface's left and right edges to colour's both.
    """
    scores = sums / counts[:, None, None, None]
    axes = []
    for first, second in ((0, 1), (2, 3)):
        senses = [i for i in (first, second) if counts[i] >= LEAST_EDGES]
        if senses:
            axes.append(scores[senses].min(axis=0))
    return np.mean(axes, axis=0) if axes else np.zeros_like(scores[0])


def _with_edges(frames: list[list[_Edges]]) -> list[list[_Edges]]:
    return [edges for edges in frames if sum(each.rows.size for each in edges) >= LEAST_EDGES]


def _frame_edges(color: NDArray[np.uint8], depth: NDArray[np.float32], rng: np.random.Generator) -> list[_Edges]:
    """Return where one surface ends before another, in rows and columns, of either sense."""
    nearness, gap = inverse_depth(depth), max(3, int(WIDEST_SHADOW * depth.shape[1]))
    found = []
    for axis, across in enumerate(_color_differences(color)):
        falling = _edges_behind(nearness, axis, gap)
        rising = np.flip(_edges_behind(np.flip(nearness, axis), axis, gap), axis)
        found += [_drawn(axis, sense, edge, across, rng) for edge, sense in ((falling, 1), (rising, -1))]
    return found


def _frame_creases(color: NDArray[np.uint8], depth: NDArray[np.float32], rng: np.random.Generator) -> list[_Edges]:
    """Return where a surface bends, towards the camera and away from it: a room's corners may be all that it has."""
    nearness, found = inverse_depth(depth), []
    for axis, across in enumerate(_color_differences(color)):
        found += [_drawn(axis, 0, crease, across, rng) for crease in _creases(nearness, axis)]
    return found


def _color_differences(color: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
    """Return saturating differences between neighbours down the rows (H − 1, W) and along them (H, W − 1)."""
    image, size = color.astype(np.float32), 2 * largest_offset(color.shape[1]) + 1
    differences = []
    for axis in (0, 1):
        across = np.abs(np.diff(image, axis=axis)).max(axis=2)
        across = across / (across + FLAT + 2 * float(across.mean()))
        differences.append(
            across - cv2.blur(across, (size, size))
        )  # where much is going on, any offset finds something
    return differences


def _drawn(
    axis: int, outwards: int, edge: NDArray[np.bool_], across: NDArray[np.float32], rng: np.random.Generator
) -> _Edges:
    rows, columns = np.nonzero(edge)
    if rows.size > EDGES_PER_FRAME:
        chosen = rng.choice(rows.size, EDGES_PER_FRAME, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    return _Edges(axis, outwards, rows, columns, across)


def _scores(each: _Edges, zoom: float, most_lost: int) -> NDArray[np.float64]:
    """Return summed scores (lost pixels, offset rows, offset columns) of one frame's edges of one kind."""
    height, width = each.across_color.shape
    reach = largest_offset(width)
    size = 2 * reach + 1
    scores = np.zeros((most_lost + 1, size, size))
    windows = np.lib.stride_tricks.sliding_window_view(each.across_color, (size, size))
    # Windows begin ``reach`` before their middle.
    rows = np.rint((height - 1) / 2 + zoom * (each.rows - (height - 1) / 2)).astype(np.int64) - reach
    columns = np.rint((width - 1) / 2 + zoom * (each.columns - (width - 1) / 2)).astype(np.int64) - reach
    inside = (rows >= most_lost) & (rows < windows.shape[0] - most_lost)
    inside &= (columns >= most_lost) & (columns < windows.shape[1] - most_lost)
    rows, columns = rows[inside], columns[inside]
    for lost in range(most_lost + 1 if rows.size else 0):
        move = (lost * each.outwards, 0) if each.axis == 0 else (0, lost * each.outwards)
        scores[lost] = windows[rows + move[0], columns + move[1]].sum(axis=0)
    return scores


def _edges_behind(nearness: NDArray[np.float32], axis: int, gap: int) -> NDArray[np.bool_]:
    """Return for each two neighbours along ``axis`` whether a surface ends at the first, before something farther.

    Behind it lies a farther surface, also beyond missing depth of up to ``gap`` pixels (the nearer surface's shadow),
    or nothing. Single missing pixels, and surfaces seen at a grazing angle, are no edges.
    """
    pixels = np.moveaxis(nearness, axis, -1)
    length = pixels.shape[-1]
    index = np.where(pixels > 0, np.arange(length), length)
    following = np.minimum.accumulate(index[..., ::-1], axis=-1)[..., ::-1]  # the next valid pixel from here on
    reached = np.take_along_axis(pixels, np.minimum(following, length - 1), axis=-1)
    behind = np.where(following - np.arange(length) <= gap, np.where(following < length, reached, 0), 0)
    edge = np.zeros((*pixels.shape[:-1], length - 1), bool)
    own = pixels[..., 2:-3]
    lasts = (np.abs(pixels[..., 1:-4] - own) < 0.5 * EDGE * own) & (np.abs(pixels[..., :-5] - own) < 0.5 * EDGE * own)
    farther = np.maximum(np.maximum(behind[..., 3:-2], pixels[..., 4:-1]), pixels[..., 5:]) < (1 - EDGE) * own
    edge[..., 2:-2] = (own > 0) & lasts & farther
    return np.moveaxis(edge, -1, axis)


def _creases(nearness: NDArray[np.float32], axis: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return for each two neighbours along ``axis`` whether a surface bends between them, away or towards the camera.

    On a plane inverse depth is linear in the pixel: slopes to either side are compared, and where they differ most
    within their length is the crease.
    """
    pixels = np.moveaxis(nearness, axis, -1)
    length = pixels.shape[-1]
    side = max(4, length // CREASES_SIDES)
    bend = np.zeros((*pixels.shape[:-1], length - 1), np.float32)
    if length > 2 * side + 1:
        left, right = pixels[..., side : -side - 1], pixels[..., side + 1 : -side]
        rise = left - pixels[..., : -2 * side - 1], pixels[..., 2 * side + 1 :] - right
        valid = np.lib.stride_tricks.sliding_window_view(pixels > 0, 2 * side + 2, axis=-1).all(axis=-1)
        joined = np.abs(right - left) < 0.5 * EDGE * left
        bend[..., side:-side] = np.where(valid & joined, (rise[1] - rise[0]) / np.maximum(left, 1e-9), 0)
    strongest = cv2.dilate(np.abs(bend), np.ones((1, 2 * side + 1), np.uint8))
    crease = (np.abs(bend) >= CREASE) & (np.abs(bend) == strongest)
    return np.moveaxis(crease & (bend > 0), -1, axis), np.moveaxis(crease & (bend < 0), -1, axis)


def _peak(profile: NDArray[np.float64], at: int) -> float:
    """Return the place of the maximum to a part of a pixel, by a parabola through it and its neighbours."""
    if not 0 < at < len(profile) - 1:
        return float(at)
    left, middle, right = profile[at - 1 : at + 2]
    bend = left - 2 * middle + right
    return float(at + 0.5 * (left - right) / bend) if bend < 0 else float(at)
