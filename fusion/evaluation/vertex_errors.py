"""How far each vertex of a mesh is from the truth, for pictures of where it errs."""

import io
from pathlib import Path

import numpy as np

from datagen.atomic_write import write_bytes
from fusion.devices import Device
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh


def write_vertex_errors(path: Path, mesh: Mesh, ground_truth: Mesh, *, device: Device) -> None:
    """Write the distance (n,) float32, metres, of each vertex of ``mesh`` to ``ground_truth`` as a NumPy file."""
    distances = closest_points(ground_truth, mesh.vertices, device=device).distances
    data = io.BytesIO()
    np.save(data, distances.astype(np.float32))
    write_bytes(path, data.getvalue())
