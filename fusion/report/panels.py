"""What a figure is made of: panels side by side, each with pictures and the numbers that stand beneath them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.report.heat_map import heat
from fusion.report.runs import Run
from fusion.report.subject import Subject
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

Numbers = tuple[tuple[str, str], ...]
"""Names and values."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """An image (height, width, 3) RGB, and what stands beneath it.

    ``name`` is its file's, unique in the dataset; ``caption`` says what it shows where the panel's title does not.
    ``heat_most_m`` are the metres at which a heat map ends, else None.
    """

    name: str
    image: NDArray[np.uint8]
    caption: str = ""
    numbers: Numbers = ()
    heat_most_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class Panel:
    """Pictures of one case beneath each other, under its title."""

    title: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Panels side by side, ``columns`` where there is room, under a heading, with a sentence on what to see.

    ``findings`` are what the numbers say: short answers, each with its reasons.
    """

    heading: str
    text: str
    panels: tuple[Panel, ...]
    columns: int = 4
    findings: tuple[tuple[str, str], ...] = ()


def clay_picture(subject: Subject, result: Run, name: str, *, extra: Numbers = ()) -> Picture:
    """Return the mesh in clay, with its size beneath and what is ``extra``."""
    return Picture(name=name, image=subject.picture(result.mesh), numbers=(*sizes(result), *extra))


def error_picture(
    subject: Subject, mesh: Mesh, name: str, *, most: float, numbers: Numbers = ()
) -> tuple[Picture, ...]:
    """Return the mesh coloured by its distance to the truth, bright at ``most`` metres; none without truth."""
    if subject.truth is None:
        return ()
    distances = closest_points(subject.truth.mesh, mesh.vertices, device=subject.device).distances
    image = subject.picture(mesh, heat(distances, most=most), shaded=False)
    return (Picture(name=f"{name}-error", image=image, caption="error", numbers=numbers, heat_most_m=most),)


def sizes(result: Run) -> Numbers:
    """Return what stands beneath each mesh."""
    return ("vertices", f"{result.record.vertices:,}"), ("triangles", f"{result.record.triangles:,}")


def costs(result: Run) -> Numbers:
    """Return what fusing and meshing took, and how much memory the blocks take."""
    return (
        ("volume", f"{result.volume_bytes / 2**20:,.1f} MiB"),
        ("fusion", f"{result.record.frames_per_second:,.0f} frames/s"),
        ("meshing", duration(result.mesh_seconds)),
    )


def errors(metrics: Mapping[str, Any]) -> Numbers:
    """Return the numbers beneath an error map: ``metrics`` are those of ``fusion.evaluation.evaluate``."""
    threshold = metrics["fscores"][0]["threshold_m"]
    return (
        ("chamfer", millimetres(metrics["chamfer_m"])),
        (f"F at {millimetres(threshold)}", percent(metrics["fscore"])),
    )


def millimetres(metres: float) -> str:
    """Return a length in millimetres, three digits."""
    return f"{float(f'{1000 * metres:.3g}'):g} mm"


def percent(share: float) -> str:
    """Return a share as a percentage with one decimal."""
    return f"{100 * share:.1f} %"


def duration(seconds: float) -> str:
    """Return a time in milliseconds below a second, else in seconds."""
    return f"{1000 * seconds:.0f} ms" if seconds < 0.9995 else f"{seconds:.1f} s"


def ratio(value: float) -> str:
    """Return a ratio, with one decimal where it is small."""
    return f"{value:.1f}" if value < 9.95 else f"{value:,.0f}"
