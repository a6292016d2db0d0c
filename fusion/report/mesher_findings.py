"""What figure 11's numbers say to the paper's words: is dual contouring cleaner, lower in polygons, expensive?"""

from dataclasses import dataclass

import numpy as np

from fusion.report.panels import duration, millimetres, percent, ratio
from fusion.report.runs import Run
from fusion.report.thin_triangles import THIN_DEG

ALIKE = 1.1
"""Errors and sizes that differ by less are called the same."""

DECIMATED_TO = 0.25
"""Of a mesh's triangles are left where meshes are compared decimated."""

FLATNESS = 0.05
"""Voxels that the surface may be off where its cells are merged."""

DEAR = 3.0
"""Times marching cubes' time beyond which meshing counts as expensive."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A way of meshing: what it made, its mean errors in metres at the truth's sharp edges and on smooth parts, if any.

    ``thin`` is the share of thin triangles, ``decimated`` the chamfer distance, metres, with ``DECIMATED_TO`` of all.
    """

    run: Run
    sharp: float | None
    smooth: float | None
    thin: float
    decimated: float

    @property
    def chamfer(self) -> float:
        """The chamfer distance, metres."""
        assert self.run.record.metrics is not None
        return float(self.run.record.metrics["chamfer_m"])

    @property
    def vertices(self) -> int:
        """How many vertices the mesh has."""
        return self.run.record.vertices


@dataclass(frozen=True, kw_only=True)
class Outcomes:
    """Marching cubes, dual contouring by the volume and by the depth images, of these with cells merged; and coarser.

    Those on voxels twice as large are marching cubes' and dual contouring's by the depth images.
    """

    cubes: Outcome
    volume: Outcome
    depth: Outcome
    merged: Outcome
    coarse_cubes: Outcome
    coarse_depth: Outcome


def findings(outcomes: Outcomes, *, on_gpu: bool) -> tuple[tuple[str, str], ...]:
    """Return for each of the paper's three words an answer and its reasons."""
    return cleaner(outcomes), lower_in_polygons(outcomes), expensive(outcomes, on_gpu=on_gpu)


def cleaner(outcomes: Outcomes) -> tuple[str, str]:
    """Compare errors at sharp edges and on smooth parts, and thin triangles, with marching cubes'."""
    cubes, volume, depth = outcomes.cubes, outcomes.volume, outcomes.depth
    by_volume, by_depth = _improves(volume, cubes), _improves(depth, cubes)
    if by_volume and by_depth:
        answer = "Cleaner? Yes."
    elif by_depth:
        answer = "Cleaner? Yes where the depth images are asked, not by the volume alone."
    elif by_volume:
        answer = "Cleaner? Yes by the volume, not where the depth images are asked."
    else:
        answer = "Cleaner? No."
    parts = []
    for what, key in (("Sharp edges of the truth", "sharp"), ("Smooth parts", "smooth")):
        errors = [getattr(outcome, key) for outcome in (cubes, volume, depth)]
        if None not in errors:
            parts.append(
                f"{what} are {millimetres(errors[0])} off with marching cubes, {_compared(errors[1], errors[0])} "
                f"by the volume, {_compared(errors[2], errors[0])} by the depth images."
            )
    if cubes.sharp is None:
        parts.insert(0, "The truth has no sharp edges that frames saw.")
    parts.append(
        f"Thin triangles, with an angle under {THIN_DEG:g}°, are {percent(cubes.thin)} of marching cubes', "
        f"{percent(volume.thin)} and {percent(depth.thin)} of dual contouring's."
    )
    return answer, " ".join(parts)


def lower_in_polygons(outcomes: Outcomes) -> tuple[str, str]:
    """Compare vertices on the same voxels, with cells merged where it is flat, and for the same error."""
    cubes, depth, coarse, merged = outcomes.cubes, outcomes.depth, outcomes.coarse_depth, outcomes.merged
    same_voxels = depth.vertices / cubes.vertices
    needed = vertices_for(coarse.chamfer, fine=cubes, coarse=outcomes.coarse_cubes)
    lower = same_voxels < 1 / ALIKE
    fewer = coarse.vertices < needed / ALIKE
    if lower:
        answer = "Lower in polygons? Yes."
    elif merged.vertices < cubes.vertices / ALIKE and merged.chamfer <= cubes.chamfer:
        answer = "Lower in polygons? Yes where cells are merged, at no greater error."
    elif fewer:
        answer = "Lower in polygons? Not on the same voxels; for the same error, yes."
    else:
        answer = "Lower in polygons? No."
    reasons = (
        f"On the same voxels it has {100 * same_voxels:.0f} % of marching cubes' vertices "
        f"({100 * outcomes.volume.vertices / cubes.vertices:.0f} % by the volume); with cells merged where the surface "
        f"is flat to {FLATNESS:g} voxels, {100 * merged.vertices / cubes.vertices:.0f} %, and a chamfer distance of "
        f"{millimetres(merged.chamfer)}. On voxels twice as large it has "
        f"{coarse.vertices:,} vertices and a chamfer distance of {millimetres(coarse.chamfer)}; marching cubes has "
        f"{millimetres(outcomes.coarse_cubes.chamfer)} there, and {millimetres(cubes.chamfer)} on the small ones. For "
        f"the same distance it would need about {needed:,.0f} vertices, as its two sizes suggest: "
        f"{ratio(needed / coarse.vertices)} times as many. Decimated to {100 * DECIMATED_TO:.0f} % of the "
        f"triangles, the small voxels' meshes have a chamfer distance of {millimetres(cubes.decimated)} (marching "
        f"cubes), {millimetres(outcomes.volume.decimated)} (by the volume) and {millimetres(depth.decimated)} (by the "
        "depth images)."
    )
    return answer, reasons


def expensive(outcomes: Outcomes, *, on_gpu: bool) -> tuple[str, str]:
    """Compare the times of meshing."""
    cubes, volume, depth, coarse = outcomes.cubes, outcomes.volume, outcomes.depth, outcomes.coarse_depth
    by_volume, by_depth, by_coarse = (one.run.mesh_seconds / cubes.run.mesh_seconds for one in (volume, depth, coarse))
    if by_volume <= DEAR and by_depth <= DEAR:
        answer = "Expensive? No longer."
    elif by_volume <= DEAR:
        answer = "Expensive? By the volume no longer; asking the depth images is."
    elif by_depth <= DEAR:
        answer = "Expensive? Where the depth images are asked no longer; by the volume it is."
    else:
        answer = "Expensive? Yes."
    record = cubes.run.record
    fusing = record.seconds.allocate + record.seconds.integrate
    clock = "Times are the wall's." if on_gpu else "Times are processor time of all cores together."
    return answer, (
        f"Marching cubes takes {duration(cubes.run.mesh_seconds)}, dual contouring by the volume {ratio(by_volume)} "
        f"times that, asking the depth images {ratio(by_depth)} times, {duration(depth.run.mesh_seconds)}, with cells "
        f"merged {duration(outcomes.merged.run.mesh_seconds)}, and {ratio(by_coarse)} times on voxels twice as large. "
        f"Fusing the {record.frames} frames took {duration(fusing)} by the wall's clock. {clock}"
    )


def vertices_for(chamfer: float, *, fine: Outcome, coarse: Outcome) -> float:
    """Return how many vertices one mesher needs for an error, by the power law through its two meshes."""
    order = np.log(coarse.chamfer / fine.chamfer) / np.log(fine.vertices / coarse.vertices)
    if not order > 0:  # finer is no better: there is no law to go by
        return float(fine.vertices)
    return float(fine.vertices * (fine.chamfer / chamfer) ** (1 / order))


def _improves(one: Outcome, other: Outcome) -> bool:
    """Tell whether sharp edges, or smooth parts where there are none, are nearer to the truth."""
    if one.sharp is not None and other.sharp is not None:
        return other.sharp >= ALIKE * one.sharp
    return one.smooth is not None and other.smooth is not None and other.smooth >= ALIKE * one.smooth


def _compared(error: float, reference: float) -> str:
    """Say how an error compares with another one."""
    if error <= 0 or reference >= ALIKE * error:
        return f"{millimetres(error)} ({ratio(reference / max(error, 1e-12))} times nearer)"
    if error >= ALIKE * reference:
        return f"{millimetres(error)} ({ratio(error / reference)} times farther)"
    return f"{millimetres(error)} (the same)"
