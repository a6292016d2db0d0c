"""How well a mesh keeps the sharp edges of the truth."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from fusion.devices import Device
from fusion.evaluation.evaluate import Observers
from fusion.evaluation.observed_surface import observed_points
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

SHARP_DEG = 30.0
"""Between the normals of an edge's two triangles; what is flatter is taken for a part of a smooth surface."""


def sharp_edge_points(ground_truth: Mesh, *, spacing: float) -> NDArray[np.float64]:
    """Return points (n, 3), world frame, about ``spacing`` metres apart along the sharp edges of a mesh."""
    shape = trimesh.Trimesh(ground_truth.vertices.astype(np.float64), ground_truth.triangles, process=False)
    shape.merge_vertices(merge_tex=True, merge_norm=True)
    sharp = shape.face_adjacency_angles > np.radians(SHARP_DEG)
    starts, ends = np.moveaxis(shape.vertices[shape.face_adjacency_edges[sharp]], 1, 0)
    lengths = np.linalg.norm(ends - starts, axis=1)
    if lengths.sum() == 0:
        return np.empty((0, 3))
    along = np.concatenate([[0], np.cumsum(lengths)])
    places = np.arange(spacing / 2, along[-1], spacing)
    edges = np.searchsorted(along, places, side="right") - 1
    shares = ((places - along[edges]) / lengths[edges])[:, None]
    return (1 - shares) * starts[edges] + shares * ends[edges]


def sharp_edge_error(
    mesh: Mesh, ground_truth: Mesh, *, spacing: float, observed_by: Observers, device: Device
) -> float | None:
    """Return the mean distance, metres, from the truth's sharp edges to a mesh, where the frames saw them.

    Points lie ``spacing`` metres apart. None where the truth has no sharp edge that was seen.
    """
    points = sharp_edge_points(ground_truth, spacing=spacing)
    if len(points) == 0:
        return None
    seen = observed_points(
        points, observed_by.dataset, observed_by.frame_ids, device=device, depth_max=observed_by.depth_max
    )
    if not seen.any():
        return None
    return float(closest_points(mesh, points[seen], device=device).distances.mean())
