"""Histograms of errors, one line of them for each trial."""

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from fusion.pose_benchmark.case_files import CaseResult
from fusion.pose_benchmark.protocol import Trial

INK, FAINT_INK, RULE, FILL, FAILED = "#1d2329", "#5c6873", "#dfe4e8", "#7f9fb5", "#b8623f"
DOTS_PER_INCH = 110
BINS = 24
DECADES_AT_LEAST = 2


def error_histograms(trials: Sequence[tuple[Trial, Sequence[CaseResult]]]) -> bytes:
    """Return a PNG: for each trial how many cases there are by rotation error, and by translation error.

    Both axes of errors are logarithmic and shared by all trials, so that columns can be compared. Cases where nothing
    was found are counted in words.
    """
    height = 0.9 + 1.25 * len(trials)
    with mpl.rc_context({"font.family": "sans-serif", "font.size": 9, "axes.edgecolor": RULE}):
        figure = Figure(figsize=(9.0, height), dpi=DOTS_PER_INCH, facecolor="white", layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(len(trials), 2, squeeze=False, sharex="col")
        for column, (name, factor, label) in enumerate(
            (("rotation_deg", 1.0, "rotation error (°)"), ("translation_m", 1000.0, "translation error (mm)"))
        ):
            values = [
                np.array([factor * getattr(case.errors, name) for case in cases if case.errors is not None])
                for _trial, cases in trials
            ]
            edges = _edges(np.concatenate([*values, np.empty(0)]))
            for row, ((trial, cases), errors) in enumerate(zip(trials, values, strict=True)):
                _draw(grid[row, column], errors, edges, failed=len(cases) - len(errors))
                if column == 0:
                    grid[row, column].set_title(trial.title, loc="left", fontsize=9.5, color=INK)
            grid[-1, column].set_xlabel(label, color=FAINT_INK)
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
    return stream.getvalue()


def _edges(values: np.ndarray) -> np.ndarray:
    """Return bins, equally wide in the logarithm, over all positive ``values``, of two decades at least."""
    positive = values[values > 0]
    low, high = (np.log10(positive.min()), np.log10(positive.max())) if len(positive) else (-1.0, 1.0)
    pad = max(DECADES_AT_LEAST - (high - low), 0.1) / 2
    return np.logspace(low - pad, high + pad, BINS + 1)


def _draw(axes: Any, errors: np.ndarray, edges: np.ndarray, *, failed: int) -> None:
    axes.hist(np.maximum(errors, edges[0]), bins=edges, color=FILL, edgecolor="white", linewidth=0.6)
    axes.set_xscale("log")
    axes.set_xlim(edges[0], edges[-1])
    axes.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    axes.grid(axis="x", color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT_INK, length=2)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    if len(errors):
        axes.axvline(float(np.median(errors)), color=INK, linewidth=1.2)
    told = f"median {np.median(errors):.3g}" if len(errors) else "none found"
    if failed:
        told += f"; {failed} not found"
    axes.annotate(
        told,
        (0.99, 0.92),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=8.5,
        color=FAILED if failed else FAINT_INK,
    )
