"""How well a mesh keeps the sharp edges of the truth."""

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion.devices import Device
from fusion.evaluation.evaluate import Observers, sample_surface
from fusion.evaluation.observed_surface import observed_points
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

SMOOTH_SAMPLES = 50_000

SHARP_DEG = 30.0
"""Between the normals of an edge's two triangles; what is flatter is taken for a part of a smooth surface."""


def sharp_edge_points(ground_truth: Mesh, *, spacing: float) -> NDArray[np.float64]:
    """Return points (n, 3), world frame, about ``spacing`` metres apart along the sharp edges of a mesh."""
    return _sharp_edges(ground_truth, spacing)[0]


def _sharp_edges(ground_truth: Mesh, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (n, 3) along the sharp edges, and the normals (n, 2, 3) of the triangles on both sides."""
    shape = trimesh.Trimesh(ground_truth.vertices.astype(np.float64), ground_truth.triangles, process=False)
    shape.merge_vertices(merge_tex=True, merge_norm=True)
    sharp = shape.face_adjacency_angles > np.radians(SHARP_DEG)
    starts, ends = np.moveaxis(shape.vertices[shape.face_adjacency_edges[sharp]], 1, 0)
    normals = shape.face_normals[shape.face_adjacency[sharp]]
    lengths = np.linalg.norm(ends - starts, axis=1)
    if lengths.sum() == 0:
        return np.empty((0, 3)), np.empty((0, 2, 3))
    along = np.concatenate([[0], np.cumsum(lengths)])
    places = np.arange(spacing / 2, along[-1], spacing)
    edges = np.searchsorted(along, places, side="right") - 1
    shares = ((places - along[edges]) / lengths[edges])[:, None]
    return (1 - shares) * starts[edges] + shares * ends[edges], normals[edges]


def seen_sharp_edges(
    ground_truth: Mesh, *, spacing: float, observed_by: Observers, device: Device
) -> NDArray[np.float64]:
    """Return those of ``sharp_edge_points`` (n, 3) that the frames saw, on either side of the edge."""
    points, normals = _sharp_edges(ground_truth, spacing)
    if len(points) == 0:
        return points
    seen = observed_points(
        np.concatenate([points, points]),
        np.concatenate([normals[:, 0], normals[:, 1]]),
        ground_truth,
        observed_by.dataset,
        observed_by.frame_ids,
        device=device,
        depth_max=observed_by.depth_max,
    )
    return points[seen.reshape(2, -1).any(axis=0)]


def sharp_edge_error(mesh: Mesh, edges: NDArray[np.float64], *, device: Device) -> float | None:
    """Return the mean distance, metres, from points (n, 3) on the truth's sharp edges to a mesh; None for no points."""
    return float(closest_points(mesh, edges, device=device).distances.mean()) if len(edges) else None


def smooth_error(
    mesh: Mesh, ground_truth: Mesh, *, beyond: float, device: Device, samples: int = SMOOTH_SAMPLES
) -> float | None:
    """Return the mean distance, metres, of a mesh from the truth, ``beyond`` so many metres from its sharp edges.

    None where no part of the mesh is so far from all of them.
    """
    points = sample_surface(mesh, samples, rng=np.random.default_rng(0)).points
    edges = sharp_edge_points(ground_truth, spacing=beyond / 4)
    if len(edges):
        points = points[cKDTree(edges).query(points, distance_upper_bound=beyond)[0] > beyond]
    return float(closest_points(ground_truth, points, device=device).distances.mean()) if len(points) else None
