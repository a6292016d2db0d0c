"""Figures 7 to 10 and 12 of the paper: which reconstructions each one shows, and what its numbers say."""

import numpy as np

from fusion.report.panels import (
    Figure,
    Numbers,
    Panel,
    clay_picture,
    costs,
    error_picture,
    errors,
    millimetres,
    percent,
    ratio,
)
from fusion.report.runs import Run
from fusion.report.subject import Subject
from fusion.surface.closest_points import closest_points

FRAME_COUNTS = (10, 25, 50, 100, 200)
VOXEL_FACTORS = (8, 4, 2, 1)
TRUNCATION_VOXELS = (2, 4, 8, 16)
GROWTH_VIEW = 1 / 3
"""Of the way of the frames that figure 7 takes: from there some of the surface comes early, and some late."""


def frame_counts(available: int) -> list[int]:
    """Return how many frames figure 7 takes, of so many: where there are few, a quarter, half and all of them."""
    counts = [count for count in FRAME_COUNTS if count < available]
    if len(counts) < 2:
        return sorted({max(available // 4, 1), max(available // 2, 1), available})
    return counts if len(counts) == len(FRAME_COUNTS) else [*counts, available]


def growth_view(subject: Subject) -> int:
    """Return the frame from whose pose figure 7 is seen."""
    frames = subject.dataset.frame_ids
    return frames[int(GROWTH_VIEW * (frame_counts(len(frames))[-1] - 1))]


def growth(subject: Subject) -> Figure:
    """Figure 7: the mesh as frames come in."""
    assert subject.truth is not None
    frames = len(subject.dataset.frame_ids)
    counts = frame_counts(frames)
    panels, shares = [], []
    for count in counts:
        result = subject.reconstruct(frames=f"0:{count}")
        subject.advance()
        to_mesh = closest_points(result.mesh, subject.truth.seen.points, device=subject.device).distances
        shares.append(float((to_mesh < subject.voxel_size).mean()))
        covered = (("surface there", percent(shares[-1])),)
        panels.append(_panel(subject, result, f"frames-{count:03d}", f"{count} frames", extra=covered))
    return Figure(
        heading="Fig. 7: the mesh as frames come in",
        columns=len(panels),
        text=f"The first frames of the trajectory, fused, seen from frame {subject.view.frame}. What is bluish is seen "
        "from behind, through what is still open. Chamfer and F are over what these frames saw; the surface there is "
        f"the share of what all {frames} frames see that is less than a voxel from the mesh.",
        panels=tuple(panels),
        findings=(
            (
                "More frames, more surface.",
                f"{counts[0]} frames give {percent(shares[0])} of it, {counts[-1]} give {percent(shares[-1])}.",
            ),
        ),
    )


def voxel_sizes(subject: Subject) -> Figure:
    """Figure 9: coarse to fine."""
    panels, chamfers, results = [], [], []
    for factor in VOXEL_FACTORS:
        size = subject.voxel_size * factor
        result = subject.reconstruct(voxel_size=size, truncation=4 * size)
        subject.advance()
        metrics = subject.judge(result.mesh)
        assert metrics is not None
        chamfers.append(metrics["chamfer_m"])
        results.append(result)
        clay = clay_picture(subject, result, f"voxel-{factor}", extra=costs(result))
        # One scale for all, in which the finest is still seen to err.
        most = subject.voxel_size
        error = error_picture(subject, result.mesh, f"voxel-{factor}", most=most, numbers=errors(metrics))
        panels.append(Panel(title=f"{millimetres(size)} voxels", pictures=(clay, *error)))
    order = np.polyfit(np.log(VOXEL_FACTORS), np.log(chamfers), 1)[0]
    coarse, fine = results[0], results[-1]
    return Figure(
        heading="Fig. 9: voxel sizes",
        text="The truncation is four voxels throughout. Errors are in one scale, and F is at one distance, for all.",
        panels=tuple(panels),
        findings=(
            (
                "Smaller voxels give finer detail, and cost more.",
                f"From {millimetres(coarse.record.voxel_size_m)} to {millimetres(fine.record.voxel_size_m)} the "
                f"chamfer distance falls from {millimetres(chamfers[0])} to {millimetres(chamfers[-1])}, with the "
                f"voxel's power of {order:.1f}, for {ratio(fine.record.vertices / coarse.record.vertices)} times the "
                f"vertices and {ratio(fine.volume_bytes / coarse.volume_bytes)} times the memory.",
            ),
        ),
    )


def truncations(subject: Subject) -> Figure:
    """Figure 10: the truncation distance."""
    panels, results = [], []
    for voxels in TRUNCATION_VOXELS:
        distance = subject.voxel_size * voxels
        result = subject.reconstruct(truncation=distance)
        subject.advance()
        results.append(result)
        title = f"{millimetres(distance)}, {voxels} voxels"
        panels.append(_panel(subject, result, f"truncation-{voxels}", title, extra=costs(result)))
    best = min(results, key=_chamfer)
    most = max(results, key=_chamfer)
    return Figure(
        heading="Fig. 10: truncation distances",
        text="A short one keeps thin parts and their two sides apart, and needs depth with little noise; a long one "
        "averages noise over more frames, and lets one surface disturb the next.",
        panels=tuple(panels),
        findings=(
            (
                f"Here {millimetres(best.record.truncation_m)} comes closest to the truth,",
                f"with a chamfer distance of {millimetres(_chamfer(best))}; {millimetres(most.record.truncation_m)} is "
                f"farthest from it, with {millimetres(_chamfer(most))}.",
            ),
        ),
    )


def _panel(subject: Subject, result: Run, name: str, title: str, *, extra: Numbers = ()) -> Panel:
    """Return a mesh of the subject's own voxel size in clay, and how far it is from the truth."""
    assert result.record.metrics is not None
    numbers = errors(result.record.metrics)
    error = error_picture(subject, result.mesh, name, most=subject.voxel_size / 2, numbers=numbers)
    return Panel(title=title, pictures=(clay_picture(subject, result, name, extra=extra), *error))


def _chamfer(result: Run) -> float:
    assert result.record.metrics is not None
    return float(result.record.metrics["chamfer_m"])
