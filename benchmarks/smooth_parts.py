"""How far meshes are from a recording's true mesh where it is smooth, without samples' luck: ``surfaces.py smooth``.

Each triangle counts by its area, at the centroids of its four quarters. *Near* is what lies within two voxels of a
sharp edge of the truth, *smooth* the rest, and of this *on the truth* what lies within a voxel of it: beyond that, of
0.4 to 0.9 % of the table's area, are sheets where frames contradict each other, which are no part of the truth.
"""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.scene_surfaces import FAR, true_surface
from datagen.open_dataset import open_dataset
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.marching_cubes import marching_cubes

QUARTERS = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6


def errors(mesh, truth, voxel_size, device):
    """Return by part the mean distance from the truth in millimetres, and its share of the area."""
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    parts = {name: np.zeros(2) for name in ("all", "near", "smooth", "smooth, on the truth")}
    for weights in QUARTERS:
        points = np.einsum("k,mkc->mc", weights, corners)
        away = closest_points(truth.mesh, points, device=device).distances
        crease = np.full(len(points), np.inf) if truth.edges is None else truth.edges.query(points)[0]
        smooth = crease > FAR * voxel_size
        masks = (np.ones(len(points), bool), ~smooth, smooth, smooth & (away < voxel_size))
        for name, mask in zip(parts, masks, strict=True):
            parts[name] += (areas[mask] @ away[mask], areas[mask].sum())
    return {name: (1000 * total / area, area / parts["all"][1]) for name, (total, area) in parts.items() if area}


def measure_smooth(device, options, print_row):
    """Measure ``options.datasets`` at ``options.voxel_sizes``, every ``options.every``-th frame."""
    print_row("scene", "voxel (mm)", "mesher", "part", "mesh to truth (mm)", "of the area")
    for folder in options.datasets:
        dataset = open_dataset(folder)
        frames = dataset.frame_ids[:: options.every]
        truth = true_surface(dataset, frames, min(options.voxel_sizes), device)
        for voxel_size in options.voxel_sizes:
            config = ReconstructionConfig(frames=f"::{options.every}", device=str(device.alias), voxel_size=voxel_size)
            with tempfile.TemporaryDirectory() as out:
                volume = reconstruct(dataset, Path(out), config).volume
            for name, mesh in (("marching cubes", marching_cubes(volume)), ("dual, volume", dual_contouring(volume))):
                for part, (error, share) in errors(mesh, truth, voxel_size, device).items():
                    size = f"{1000 * voxel_size:g}"
                    print_row(folder.name, size, name, part, f"{error:.4f}", f"{100 * share:.2f} %")
