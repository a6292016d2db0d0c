"""How close a mesh is to the truth: accuracy, completeness, chamfer, F-score and normal consistency."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from fusion.devices import Device
from fusion.evaluation.observed_surface import observed_points
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

SAMPLES = 200_000
SEED = 0


@dataclass(frozen=True, kw_only=True)
class SurfaceSamples:
    """Points drawn evenly over a mesh: ``points`` (n, 3) metres, ``normals`` (n, 3) unit length, of their triangles."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Observers:
    """The frames of a dataset that observed a scene, up to ``depth_max`` metres of depth (None: all of it)."""

    dataset: Dataset
    frame_ids: tuple[int, ...]
    depth_max: float | None = None


def sample_surface(mesh: Mesh, count: int, *, rng: np.random.Generator) -> SurfaceSamples:
    """Draw ``count`` points on a mesh, with a density that is the same everywhere."""
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    normals, areas = _normals_and_areas(corners)
    # Evenly spaced along the triangles' cumulative area: fewer clumps than independent draws have.
    cumulative = np.cumsum(areas)
    chosen = np.searchsorted(cumulative, (np.arange(count) + rng.random(count)) / count * cumulative[-1])
    chosen = np.minimum(chosen, len(areas) - 1)
    root, other = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = np.moveaxis(corners[chosen], 1, 0)
    return SurfaceSamples(points=(1 - root) * a + root * (1 - other) * b + root * other * c, normals=normals[chosen])


def evaluate(
    mesh: Mesh,
    ground_truth: Mesh,
    *,
    thresholds: Sequence[float],
    device: Device,
    observed_by: Observers | None = None,
    seen: SurfaceSamples | None = None,
    voxel_size: float | None = None,
    progress: ProgressReporter = silent,
) -> dict[str, Any]:
    """Compare a mesh with the true one, both in world coordinates, metres.

    ``accuracy_m`` is the mean distance from the mesh to the truth, ``completeness_m`` from the truth to the mesh,
    ``chamfer_m`` their mean. ``fscores`` has for each threshold (metres) the share of the mesh's points nearer than it
    to the truth (precision), that of the truth's (recall), and their harmonic mean; ``fscore`` is the first of them
    (Knapitsch et al. 2017). ``normal_consistency`` is the mean |cos| between a point's normal and that of its closest
    triangle, both ways (Mescheder et al. 2019). With ``observed_by`` the truth is culled to what they saw, or ``seen``
    is what they saw of it; the mesh is always held against the whole truth. With ``voxel_size``, lengths are given in
    voxels too. Raises InputError where nothing of the truth was seen.
    """
    ours = sample_surface(mesh, SAMPLES, rng=np.random.default_rng(SEED))
    truth = seen or seen_truth(ground_truth, observed_by, device=device, progress=progress)
    to_truth, precision_cosines = _compare(ours, ground_truth, device)
    to_mesh, recall_cosines = _compare(truth, mesh, device)
    accuracy, completeness = float(to_truth.mean()), float(to_mesh.mean())
    fscores = [_fscore(to_truth, to_mesh, threshold) for threshold in thresholds]
    metrics: dict[str, Any] = {
        "chamfer_m": (accuracy + completeness) / 2,
        "accuracy_m": accuracy,
        "completeness_m": completeness,
        "fscore": fscores[0]["fscore"],
        "fscores": fscores,
        "normal_consistency": float((precision_cosines.mean() + recall_cosines.mean()) / 2),
    }
    if voxel_size is not None:
        lengths = ("chamfer", "accuracy", "completeness")
        metrics |= {f"{name}_voxels": metrics[f"{name}_m"] / voxel_size for name in lengths}
    return metrics


def seen_truth(
    ground_truth: Mesh, observed_by: Observers | None, *, device: Device, progress: ProgressReporter = silent
) -> SurfaceSamples:
    """Return points of the true surface, those that were seen where observers are given; InputError for none."""
    truth = sample_surface(ground_truth, SAMPLES, rng=np.random.default_rng([SEED, 1]))
    if observed_by is None:
        return truth
    seen = observed_points(
        truth.points,
        truth.normals,
        ground_truth,
        observed_by.dataset,
        observed_by.frame_ids,
        device=device,
        depth_max=observed_by.depth_max,
        progress=progress,
    )
    if not seen.any():
        raise InputError(
            f"{observed_by.dataset.folder}: its frames see nothing of the ground truth; are they of one scene?"
        )
    return SurfaceSamples(points=truth.points[seen], normals=truth.normals[seen])


def _compare(samples: SurfaceSamples, mesh: Mesh, device: Device) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances (n,) in metres from samples to a mesh, and |cos| (n,) between their normals."""
    closest = closest_points(mesh, samples.points, device=device)
    normals, _ = _normals_and_areas(mesh.vertices.astype(np.float64)[mesh.triangles[closest.triangles]])
    return closest.distances, np.abs(np.einsum("ij,ij->i", samples.normals, normals))


def _fscore(to_truth: NDArray[np.float64], to_mesh: NDArray[np.float64], threshold: float) -> dict[str, float]:
    precision, recall = float((to_truth < threshold).mean()), float((to_mesh < threshold).mean())
    total = precision + recall
    return {
        "threshold_m": threshold,
        "precision": precision,
        "recall": recall,
        "fscore": 2 * precision * recall / total if total else 0.0,
    }


def _normals_and_areas(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit normals (n, 3), 0 for degenerate triangles, and areas (n,) of triangles' corners (n, 3, 3)."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-300)[:, None], length / 2
