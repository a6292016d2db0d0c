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
from fusion.mesh import Mesh, read_mesh
from fusion.observed_surface import observed_points
from fusion.surface_distance import closest_points

SAMPLES = 200_000
SEED = 0


@dataclass(frozen=True, kw_only=True)
class SurfaceSamples:
    """Points drawn evenly over a mesh: ``points`` (n, 3) metres, ``normals`` (n, 3) unit length, of their triangles."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]


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
    observed_by: tuple[Dataset, tuple[int, ...]] | None = None,
    voxel_size: float | None = None,
    progress: ProgressReporter = silent,
) -> dict[str, Any]:
    """Compare a mesh with the true one, both in world coordinates, metres.

    ``accuracy_m`` is the mean distance from the mesh to the truth, ``completeness_m`` from the truth to the mesh,
    ``chamfer_m`` their mean. ``fscores`` has for each threshold (metres) the share of the mesh's points nearer than it
    to the truth (precision), that of the truth's (recall), and their harmonic mean; ``fscore`` is the first of them
    (Knapitsch et al. 2017). ``normal_consistency`` is the mean |cos| between a point's normal and that of its closest
    triangle, both ways (Mescheder et al. 2019). With ``observed_by``, a dataset and frames, the truth is culled to
    what they saw; the mesh is always held against the whole truth. With ``voxel_size``, lengths are given in voxels
    too. Raises InputError where nothing of the truth was seen.
    """
    rng = np.random.default_rng(SEED)
    ours = sample_surface(mesh, SAMPLES, rng=rng)
    truth = sample_surface(ground_truth, SAMPLES, rng=rng)
    if observed_by is not None:
        dataset, frame_ids = observed_by
        seen = observed_points(truth.points, dataset, frame_ids, device=device, progress=progress)
        if not seen.any():
            raise InputError(
                f"{dataset.folder}: its frames see nothing of the ground truth; are both in one world frame?"
            )
        truth = SurfaceSamples(points=truth.points[seen], normals=truth.normals[seen])
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


def evaluate_reconstruction(
    mesh: Mesh,
    dataset: Dataset,
    frame_ids: tuple[int, ...],
    voxel_size: float,
    device: Device,
    progress: ProgressReporter = silent,
) -> dict[str, Any] | None:
    """Compare a fused mesh with its dataset's ground truth, at half a voxel and a voxel; None where there is none."""
    if dataset.ground_truth_mesh is None:
        return None
    return evaluate(
        mesh,
        read_mesh(dataset.ground_truth_mesh),
        thresholds=(voxel_size / 2, voxel_size),
        device=device,
        observed_by=(dataset, frame_ids),
        voxel_size=voxel_size,
        progress=progress,
    )


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
