"""Marching cubes against dual contouring on recordings with a true mesh: for ``surfaces.py scenes``.

Each scene is fused at several voxel sizes, and each volume meshed in several ways. *topology*: whether a mesh is
manifold, how many pairs of its triangles meet, and of the vertices on its border how many lie where the observed region
ends: with an unseen voxel at most one cell further. *errors*: mean distances, in voxels, of the mesh from the truth,
where that is smooth and where it is sharp, and of the truth that was seen from the mesh. *time*: the least processor
time of some repeats. Last, for each way, how many vertices marching cubes would take for the same chamfer distance.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp
from mesh_topology import edge_uses, is_manifold, self_intersections
from scipy.spatial import cKDTree

from datagen.open_dataset import open_dataset
from fusion.evaluation.evaluate import sample_surface
from fusion.evaluation.observed_surface import observed_points
from fusion.evaluation.sharp_edges import sharp_edge_points
from fusion.meshing import depth_oracle, fused_frames
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh_files import read_mesh

SAMPLES = 100_000
NEAR, FAR = 0.5, 2.0
"""Voxels from a sharp edge of the truth up to which a point is on it, and from which on the truth is smooth."""

REPEATS = {"marching cubes": 9, "dual, volume": 9, "dual, depth": 3, "dual, depth, merged": 2}


@dataclass
class Truth:
    """The true mesh, points of it that were seen, and points along its sharp edges."""

    mesh: object
    seen: np.ndarray
    edges: cKDTree | None


def true_surface(dataset, frames, voxel_size, device):
    mesh = read_mesh(dataset.ground_truth_mesh)
    samples = sample_surface(mesh, SAMPLES, rng=np.random.default_rng(0))
    seen = samples.points[observed_points(samples.points, samples.normals, mesh, dataset, frames, device=device)]
    edges = sharp_edge_points(mesh, spacing=0.25 * voxel_size)
    return Truth(mesh, seen, cKDTree(edges) if len(edges) else None)


def seen_lattice(volume):
    """Return a function that tells which lattice points (n, 3) were seen."""
    blocks = volume.table.blocks.numpy()[: volume.table.count].astype(np.int64)
    weights = (volume.voxels.packed.numpy() >> np.uint64(16)) & np.uint64(0xFFFF)

    def key(points):
        return ((points[:, 0] + 2**20) << 42) + ((points[:, 1] + 2**20) << 21) + points[:, 2] + 2**20

    order = np.argsort(key(blocks))
    keys = key(blocks)[order]

    def seen(points):
        wanted = key(points >> 3)
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        x, y, z = (points & 7).T
        weight = weights[512 * order[place] + 64 * z + 8 * y + x]
        return (keys[place] == wanted) & (weight > 0)

    return seen


def border(mesh, volume):
    """Return how many vertices lie on a mesh's border, and how many of these not where the observed region ends."""
    edges, uses = edge_uses(mesh)
    vertices = np.unique(edges[uses == 1])
    cells = np.floor(mesh.vertices[vertices].astype(np.float64) / volume.voxel_size).astype(np.int64)
    seen, ends = seen_lattice(volume), np.zeros(len(vertices), bool)
    for step in np.ndindex(4, 4, 4):
        ends |= ~seen(cells + np.array(step) - 1)
    return len(vertices), int((~ends).sum())


def errors(mesh, truth, voxel_size, device):
    """Return the mean distances in voxels: mesh to truth where smooth and where sharp, and the chamfer distance."""
    points = sample_surface(mesh, SAMPLES, rng=np.random.default_rng(1)).points
    away = closest_points(truth.mesh, points, device=device).distances / voxel_size
    missing = closest_points(mesh, truth.seen, device=device).distances / voxel_size
    crease = np.full(len(points), np.inf) if truth.edges is None else truth.edges.query(points)[0] / voxel_size
    smooth, sharp = away[crease > FAR], away[crease <= NEAR]
    return {
        "smooth": smooth.mean() if len(smooth) else np.nan,
        "sharp": sharp.mean() if len(sharp) else np.nan,
        "chamfer": (away.mean() + missing.mean()) / 2,
    }


def least_time(way, device, repeats):
    """Return the least processor time of some calls after the first, in seconds."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        way()
        wp.synchronize_device(device)
        times.append(time.process_time() - start)
    return min(times)


def measure_scene(dataset, options, device, print_row):
    frames, results, truth = dataset.frame_ids[:: options.every], {}, None
    base = None
    for factor in options.factors:
        config = ReconstructionConfig(
            frames=f"::{options.every}", device=str(device.alias), voxel_size=base and base * factor
        )
        with tempfile.TemporaryDirectory() as folder:
            # The first is the finest, whose size the data suggest.
            made = reconstruct(dataset, Path(folder), config)
            volume = made.volume
            base = base or volume.voxel_size
            truth = truth or true_surface(dataset, frames, base, device)
            with fused_frames(Path(folder), made.record, config) as source:
                oracle = depth_oracle(volume, source, config.integration)
        ways = {
            "marching cubes": lambda volume=volume: marching_cubes(volume),
            "dual, volume": lambda volume=volume: dual_contouring(volume),
            "dual, depth": lambda volume=volume, oracle=oracle: dual_contouring(volume, oracle=oracle),
            "dual, depth, merged": lambda volume=volume, oracle=oracle: dual_contouring(
                volume, oracle=oracle, flatness=options.flatness
            ),
        }
        for name, way in ways.items():
            mesh = way()
            found = errors(mesh, truth, volume.voxel_size, device)
            on_border, elsewhere = border(mesh, volume)
            results[name, factor] = len(mesh.vertices), volume.voxel_size * found["chamfer"]
            print_row(
                dataset.folder.name,
                f"{1000 * volume.voxel_size:.3g}",
                name,
                f"{len(mesh.vertices):,}",
                str(is_manifold(mesh)),
                str(self_intersections(mesh)),
                f"{on_border} ({elsewhere} elsewhere)",
                *(f"{found[key]:.4f}" for key in ("smooth", "sharp", "chamfer")),
                f"{least_time(way, device, REPEATS[name]):.3f}",
            )
    return results


def vertices_for_the_same_error(results, factors):
    """Yield for each way and voxel size its vertices over those that marching cubes takes for the same chamfer."""
    cubes = np.log([results["marching cubes", factor] for factor in sorted(factors)])
    for (name, factor), (vertices, chamfer) in results.items():
        if name != "marching cubes":
            inside = cubes[0, 1] <= np.log(chamfer) <= cubes[-1, 1]
            slope = np.polyfit(cubes[:, 1], cubes[:, 0], 1)
            needed = (
                np.interp(np.log(chamfer), cubes[:, 1], cubes[:, 0]) if inside else np.polyval(slope, np.log(chamfer))
            )
            yield name, factor, vertices / np.exp(needed), inside


def measure_scenes(device, options, print_row):
    """Measure all ``options.datasets``; every ``options.every``-th frame, at ``options.factors`` times the voxel."""
    header = ("vertices", "manifold", "pairs that meet", "border", "smooth", "sharp", "chamfer", "CPU s")
    for folder in options.datasets:
        print_row("scene", "voxel (mm)", "mesher", *header)
        results = measure_scene(open_dataset(folder), options, device, print_row)
        for name, factor, share, inside in vertices_for_the_same_error(results, options.factors):
            note = "" if inside else " (marching cubes extrapolated)"
            print_row(name, f"×{factor:g}", f"{100 * share:.0f} % of marching cubes' vertices for the chamfer{note}")
