"""How many vertices an error takes, with marching cubes and with dual contouring: for ``surfaces.py vertices``.

A recording with a true mesh is fused at several voxel sizes, each volume is meshed in several ways, and the meshes of
the smallest voxels are decimated to parts of their triangles, as ``fusion mesh --triangles`` does. Errors are mean
distances in millimetres: of the mesh from the truth, of what frames saw of the truth from the mesh, and their mean, the
chamfer distance; of the truth's sharp edges that frames saw from the mesh, and of the mesh from the truth where that is
smooth, beyond two of the smallest voxels from an edge.

Last comes the question itself: of the vertices of marching cubes' mesh on some voxels, how many does dual contouring
take for the same error, on voxels as large as it needs, or decimated, when marching cubes' is decimated too?
"""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.scene_surfaces import FAR, SAMPLES, true_surface
from fusion.evaluation.evaluate import Observers, sample_surface
from fusion.evaluation.sharp_edges import seen_sharp_edges, sharp_edge_error, smooth_error
from fusion.meshing import depth_oracle, fused_frames
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_operations import decimate

CUBES = "marching cubes"
MERGED = "dual, depth, merged"
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Of the triangles, that decimation leaves."""
ERRORS = ("mesh to truth", "truth to mesh", "chamfer", "sharp", "smooth")


def errors(mesh, truth, edges, voxel_size, device):
    """Return the mean distances of ``ERRORS`` in millimetres."""
    points = sample_surface(mesh, SAMPLES, rng=np.random.default_rng(1)).points
    away = closest_points(truth.mesh, points, device=device).distances.mean()
    missing = closest_points(mesh, truth.seen, device=device).distances.mean()
    found = (
        away,
        missing,
        (away + missing) / 2,
        sharp_edge_error(mesh, edges, device=device),
        smooth_error(mesh, truth.mesh, beyond=FAR * voxel_size, device=device),
    )
    return {name: 1000 * error for name, error in zip(ERRORS, found, strict=True) if error is not None}


def meshes_of(dataset, every, voxel_size, flatness, device):
    """Return a recording's meshes by mesher, from one volume, and the frames that it was fused of."""
    config = ReconstructionConfig(frames=f"::{every}", device=str(device.alias), voxel_size=voxel_size)
    with tempfile.TemporaryDirectory() as folder:
        made = reconstruct(dataset, Path(folder), config)
        with fused_frames(Path(folder), made.record, config) as source:
            oracle = depth_oracle(made.volume, source, config.integration)
    return {
        CUBES: marching_cubes(made.volume),
        "dual, volume": dual_contouring(made.volume),
        "dual, depth": dual_contouring(made.volume, oracle=oracle),
        MERGED: dual_contouring(made.volume, oracle=oracle, flatness=flatness),
    }


def measure_recording(dataset, options, device, print_row):
    """Print the errors of all meshes, and return them: by mesher lists of (vertices, errors), coarser and decimated."""
    sizes = sorted(options.voxel_sizes)
    truth = true_surface(dataset, dataset.frame_ids[:: options.every], sizes[0], device)
    observers = Observers(dataset=dataset, frame_ids=dataset.frame_ids[:: options.every], depth_max=None)
    edges = seen_sharp_edges(truth.mesh, spacing=0.25 * sizes[0], observed_by=observers, device=device)
    coarser, decimated = {}, {}
    for voxel_size in sizes:
        for mesher, mesh in meshes_of(dataset, options.every, voxel_size, options.flatness, device).items():
            for share in SHARES if voxel_size == sizes[0] and mesher != MERGED else (1.0,):
                # Without colours, which take longer than decimation itself.
                shape = Mesh(vertices=mesh.vertices, triangles=mesh.triangles)
                kept = mesh if share == 1 else decimate(shape, round(share * len(mesh.triangles)), device=device)
                found = len(kept.vertices), errors(kept, truth, edges, sizes[0], device)
                if share == 1:
                    coarser.setdefault(mesher, []).append(found)
                if voxel_size == sizes[0]:
                    decimated.setdefault(mesher, []).append(found)
                print_row(
                    dataset.folder.name,
                    f"{1000 * voxel_size:g}",
                    mesher,
                    f"{100 * share:g} %",
                    f"{found[0]:,}",
                    *(f"{found[1].get(name, np.nan):.3f}" for name in ERRORS),
                )
    return coarser, decimated


def vertices_for(found, name, error):
    """Return how many vertices an error takes along meshes (vertices, errors) from fine to coarse, and its bound.

    Between two meshes the logarithms are linear. The bound is "≤" where the coarsest is better, ">" where the finest is
    worse.
    """
    counts, lengths = np.log([count for count, _ in found]), np.log([lengths[name] for _, lengths in found])
    if lengths[0] > np.log(error):
        return np.exp(counts[0]), ">"
    worse = np.flatnonzero(lengths > np.log(error))
    if len(worse) == 0:
        return np.exp(counts[-1]), "≤"
    after = worse[0]
    share = (np.log(error) - lengths[after - 1]) / (lengths[after] - lengths[after - 1])
    return np.exp(counts[after - 1] + share * (counts[after] - counts[after - 1])), ""


def measure_vertices(device, options, datasets, print_row):
    """Measure recordings at ``options.voxel_sizes``, every ``options.every``-th frame."""
    for dataset in datasets:
        print_row("scene", "voxel (mm)", "mesher", "triangles kept", "vertices", *(f"{name} (mm)" for name in ERRORS))
        coarser, decimated = measure_recording(dataset, options, device, print_row)
        print_row("scene", "marching cubes' error", "at (mm)", "mesher", "way", "of its vertices")
        sizes = sorted(options.voxel_sizes)
        # On the largest voxels nothing tells how much coarser still might do.
        for number, size in enumerate(sizes[:-1] or sizes):
            vertices, lengths = coarser[CUBES][number]
            for name in lengths:
                for mesher, way, found in _alternatives(coarser, decimated, with_decimated=number == 0):
                    # A little more than its error, which else marching cubes itself would miss by rounding.
                    needed, bound = vertices_for(found, name, 1.0001 * lengths[name])
                    share = f"{bound}{100 * needed / vertices:.0f} %"
                    print_row(dataset.folder.name, name, f"{1000 * size:g}", mesher, way, share)


def _alternatives(coarser, decimated, *, with_decimated):
    """Yield the mesher, the way, and the meshes that take the place of marching cubes' on one size of voxels."""
    for mesher in coarser:
        if mesher != CUBES:
            yield mesher, "coarser voxels", coarser[mesher]
        if with_decimated and mesher != MERGED:
            yield mesher, "decimated", decimated[mesher]
