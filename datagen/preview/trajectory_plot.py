"""A plot of the camera's path: in space with frusta, and from above."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from datagen.atomic_write import replacing
from datagen.camera import PinholeCamera
from datagen.preview.source import PreviewSource, evenly
from datagen.preview.world import Surroundings, plot_from_world, surroundings
from datagen.progress import ProgressReporter, silent
from datagen.rigid import transform_points

INK, FAINT_INK, RULE = "#20242c", "#6c7480", "#dfe2e7"
FRUSTA = 20
FRUSTUM_SHARE = 0.055
"""A frustum's depth over the size of everything."""
DOTS_PER_INCH = 120
SIZE_INCHES = (14.0, 7.4)
# Plasma without its pale end, which would vanish on paper; it runs in lightness and reads without red and green.
TIME_COLORS = LinearSegmentedColormap.from_list("time", mpl.colormaps["plasma"](np.linspace(0.0, 0.82, 256)))


def write_trajectory_plot(path: Path, source: PreviewSource, *, progress: ProgressReporter = silent) -> None:
    """Write a PNG of the path of the source's frames, coloured by time, before what the frames saw."""
    dataset = source.dataset
    advance = progress("Trajectory", 3)
    poses = np.stack([dataset.world_from_camera(frame_id) for frame_id in source.frame_ids])
    rotation, z_is_up = plot_from_world(dataset, poses)
    poses = rotation @ poses
    advance()
    around = surroundings(source, rotation)
    advance()
    figure = Figure(figsize=SIZE_INCHES, dpi=DOTS_PER_INCH, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((-0.01, 0.10, 0.56, 0.78), projection="3d", computed_zorder=False)
    above = figure.add_axes((0.625, 0.17, 0.345, 0.66))
    names = ("x", "y", "z") if z_is_up else ("right", "forward", "up")
    chosen = np.searchsorted(source.frame_ids, evenly(source.frame_ids, FRUSTA))
    size = _size(poses, around)
    lines = np.concatenate([frustum(dataset.camera, poses[i], depth=FRUSTUM_SHARE * size) for i in chosen])
    line_times = np.repeat(chosen / max(1, len(poses) - 1), 8)
    _draw_in_space(axes, poses, lines, line_times, around, names)
    _draw_from_above(above, poses, lines, line_times, around, names)
    _decorate(figure, source, poses, around)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    advance()


def frustum(camera: PinholeCamera, world_from_camera: NDArray[np.float64], *, depth: float) -> NDArray[np.float64]:
    """Return the eight edges (8, 2, 3) of what a camera sees up to ``depth`` metres: four rays, the far rectangle."""
    u = np.array([-0.5, camera.width - 0.5, camera.width - 0.5, -0.5])
    v = np.array([-0.5, -0.5, camera.height - 0.5, camera.height - 0.5])
    corners = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(4)], axis=-1) * depth
    far = transform_points(world_from_camera, corners)
    eye = np.broadcast_to(world_from_camera[:3, 3], far.shape)
    return np.concatenate([np.stack([eye, far], axis=1), np.stack([far, np.roll(far, -1, axis=0)], axis=1)])


def _size(poses: NDArray[np.float64], around: Surroundings | None) -> float:
    low, high = _bounds(poses, around)
    return float(np.linalg.norm(high - low))


def _bounds(poses: NDArray[np.float64], around: Surroundings | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    everything = poses[:, :3, 3] if around is None else np.concatenate([poses[:, :3, 3], around.points])
    low, high = everything.min(axis=0), everything.max(axis=0)
    least = max(0.05 * float((high - low).max()), 1e-3)  # a straight path is flat in two directions
    pad = 0.04 * (high - low).max() + np.maximum(least - (high - low), 0) / 2
    return low - pad, high + pad


def _draw_in_space(
    axes: Any,
    poses: NDArray[np.float64],
    lines: NDArray[np.float64],
    line_times: NDArray[np.float64],
    around: Surroundings | None,
    names: tuple[str, str, str],
) -> None:
    assert isinstance(axes, Axes3D)
    if around is not None:
        axes.scatter(*around.points.T, c=around.colors, s=1.4, linewidths=0, depthshade=False, zorder=1)
    axes.add_collection3d(
        Line3DCollection(lines, colors=TIME_COLORS(line_times), linewidths=0.7, alpha=0.75, zorder=2), autolim=False
    )
    segments, times = _segments(poses[:, :3, 3])
    axes.add_collection3d(
        Line3DCollection(segments, colors=TIME_COLORS(times), linewidths=2.2, capstyle="round", zorder=3), autolim=False
    )
    _mark_ends(axes, poses[:, :3, 3])
    low, high = _bounds(poses, around)
    for name, label, start, end in zip("xyz", names, low, high, strict=True):
        getattr(axes, f"set_{name}lim")(start, end)
        getattr(axes, f"set_{name}label")(f"{label} (m)", color=FAINT_INK, labelpad=8)
        axis = getattr(axes, f"{name}axis")
        ticks = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(start, end)
        margin = 0.06 * (end - start)  # in the corners the numbers of two axes would meet
        axis.set_ticks([tick for tick in ticks if start + margin <= tick <= end - margin])
        axis.set_pane_color((1.0, 1.0, 1.0, 1.0))
        axis.line.set_color(RULE)
        axis._axinfo["grid"].update(color=RULE, linewidth=0.6)
    axes.tick_params(colors=FAINT_INK, labelsize=9, pad=2)
    axes.set_box_aspect(high - low, zoom=1.06)
    axes.view_init(elev=24, azim=-58)


def _draw_from_above(
    axes: Axes,
    poses: NDArray[np.float64],
    lines: NDArray[np.float64],
    line_times: NDArray[np.float64],
    around: Surroundings | None,
    names: tuple[str, str, str],
) -> None:
    if around is not None:
        order = np.argsort(around.points[:, 2], kind="stable")  # what is high hides what is low
        x, y, _ = around.points[order].T
        axes.scatter(x, y, c=around.colors[order], s=2.2, linewidths=0, zorder=1)
    axes.add_collection(
        LineCollection(list(lines[..., :2]), colors=TIME_COLORS(line_times), linewidths=0.7, alpha=0.75)
    )
    segments, times = _segments(poses[:, :3, 3])
    axes.add_collection(
        LineCollection(list(segments[..., :2]), colors=TIME_COLORS(times), linewidths=2.2, capstyle="round", zorder=3)
    )
    _mark_ends(axes, poses[:, :2, 3])
    low, high = _bounds(poses, around)
    low = np.minimum(low[:2], lines[..., :2].min(axis=(0, 1)))
    high = np.maximum(high[:2], lines[..., :2].max(axis=(0, 1)))
    centre, half = (low + high) / 2, (high - low).max() / 2
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{names[0]} (m)", color=FAINT_INK)
    axes.set_ylabel(f"{names[1]} (m)", color=FAINT_INK)
    axes.set_title("From above", fontsize=12, color=INK, loc="left", pad=10)
    axes.grid(color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT_INK, labelsize=9)
    for spine in axes.spines.values():
        spine.set_color(RULE)


def _segments(positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pieces (N − 1, 2, 3) of a path, and when each is walked, from 0 to 1."""
    pieces = np.stack([positions[:-1], positions[1:]], axis=1)
    return pieces, (np.arange(len(pieces)) + 0.5) / max(1, len(pieces))


def _mark_ends(axes: Any, positions: NDArray[np.float64]) -> None:
    """Mark the first position by a disc and the last by a square, as the legend says."""
    # The disc is the larger, so that it shows where a path ends at its start.
    for position, marker, time, area in ((positions[0], "o", 0.0, 140), (positions[-1], "s", 1.0, 45)):
        axes.scatter(
            *position[:, None],
            marker=marker,
            s=area,
            color=[TIME_COLORS(time)],
            edgecolors="white",
            linewidths=1.2,
            zorder=5,
        )


def _decorate(figure: Figure, source: PreviewSource, poses: NDArray[np.float64], around: Surroundings | None) -> None:
    """Add title, facts, legend and the scale of time."""
    positions = poses[:, :3, 3]
    length = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    name = source.dataset.folder.resolve().name
    figure.text(0.03, 0.945, name, fontsize=19, fontweight="bold", color=INK, va="center")
    facts = f"{len(positions)} frames along {length:.2f} m"
    if around is not None:
        facts += f" · behind: {around.meaning}"
    figure.text(0.03, 0.895, facts, fontsize=11, color=FAINT_INK, va="center")
    handles = [
        Line2D([], [], marker=marker, linestyle="", markersize=8, color=TIME_COLORS(time), label=label)
        for marker, time, label in (
            ("o", 0.0, f"start, frame {source.frame_ids[0]}"),
            ("s", 1.0, f"end, frame {source.frame_ids[-1]}"),
        )
    ]
    figure.legend(
        handles=handles,
        loc="center right",
        bbox_to_anchor=(0.97, 0.92),
        ncols=2,
        frameon=False,
        fontsize=11,
        labelcolor=INK,
        handletextpad=0.3,
        columnspacing=1.4,
    )
    bar = figure.add_axes((0.03, 0.07, 0.26, 0.018))
    norm = Normalize(source.frame_ids[0], max(source.frame_ids[-1], source.frame_ids[0] + 1))
    colorbar = figure.colorbar(ScalarMappable(norm, TIME_COLORS), cax=bar, orientation="horizontal")
    colorbar.set_label("frame", color=FAINT_INK, fontsize=10)
    colorbar.outline.set_visible(False)
    colorbar.locator = MaxNLocator(5, integer=True)
    colorbar.update_ticks()
    bar.tick_params(colors=FAINT_INK, labelsize=9, length=3)
