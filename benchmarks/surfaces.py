"""Marching cubes against dual contouring: sharp edges, smooth parts, vertices, topology and time.

    python -m benchmarks.surfaces                        # all
    python -m benchmarks.surfaces topology --solids 300
    python -m benchmarks.surfaces edges table time
    python -m benchmarks.surfaces scenes --datasets suzanne bunny table --every 10
    python -m benchmarks.surfaces vertices smooth --datasets table --every 10 --voxel-sizes 0.010 0.014 0.020

*topology*: random solids in closed form, each meshed by the volume alone and by the solid as an oracle: how many are
closed and manifold, and how many pairs of triangles meet (exactly, CGAL through libigl); with cells merged, too, within
``--flatness`` voxels (*merged* in all tables). *edges*: a cube, an L and a
solid of parts, seen by 60 exact depth images; the mean distance from the true surface of what lies within half a voxel
of a true edge, and beyond two voxels. *order*: how vertices converge on a smooth field. *table*: the scene of
``accuracy.py`` over voxel sizes, for the vertices that an error takes. *time*: CPU and wall seconds of meshing it.
*scenes*: recordings with a true mesh (``scene_surfaces.py``), for their topology, errors, vertices and time.
*vertices*: how many vertices an error takes on such recordings, on coarser voxels or decimated
(``vertices_for_errors.py``). *smooth*: how far smooth parts are from the truth (``smooth_parts.py``).
"""

import argparse
import time
from pathlib import Path

import numpy as np
import warp as wp
from analytic_oracle import ball, cube, l_shape, random_solid
from mesh_topology import is_closed, is_manifold, self_intersections

from benchmarks import accuracy, scene_surfaces, smooth_parts, vertices_for_errors
from benchmarks.solid_scenes import FAR, NEAR, SolidScene, box_crease_distance, crease_distance
from datagen.open_dataset import open_dataset
from fusion.devices import resolve_device
from fusion.evaluation.evaluate import sample_surface
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import load_fusion_kernels
from fusion.reconstruction_config import EXACT
from fusion.surface.dual_contouring.depth_oracle import DepthField
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.marching_cubes import marching_cubes


def depth_oracle(volume, scene):
    field = DepthField(volume, EXACT, frames=len(scene.poses))
    upload = FrameUploader(accuracy.CAMERA, device=volume.device)
    for first in range(0, len(scene.poses), accuracy.BATCH):
        some = slice(first, first + accuracy.BATCH)
        field.add(upload(scene.depths[some], scene.poses[some]))
    return field.oracle()


def measure_edges(device, options):
    rng = np.random.default_rng(3)
    scenes = {
        "cube": cube(rng),
        "L": l_shape(rng),
        "solid of parts": random_solid(np.random.default_rng(11)),
        "ball": ball((0.013, -0.02, 0.03), 0.4),
    }
    print_row(
        "scene", "voxel (mm)", "mesher", "vertices", "edges (voxels)", "smooth (voxels)", "closed", "meets itself"
    )
    for name, solid in scenes.items():
        scene = SolidScene(name, solid, device)
        for voxel_size in options.voxel_sizes:
            options.truncation, options.storage = 4.0, "packed"
            volume, _ = accuracy.fuse(scene, voxel_size, options, EXACT)
            meshes = {
                "marching cubes": marching_cubes(volume),
                "dual, volume": dual_contouring(volume),
            }
            oracles = {"depth": depth_oracle(volume, scene)}
            if name != "ball":
                oracles["solid"] = solid.oracle(voxel_size, device)
            for asked, oracle in oracles.items():
                meshes[f"dual, {asked}"] = dual_contouring(volume, oracle=oracle)
                meshes[f"dual, {asked}, merged"] = dual_contouring(volume, oracle=oracle, flatness=options.flatness)
            for mesher, mesh in meshes.items():
                points = sample_surface(mesh, 60_000, rng=np.random.default_rng(1)).points
                away = np.abs(solid(points)) / voxel_size
                crease = (box_crease_distance if name == "cube" else crease_distance)(solid, points, voxel_size)
                near, far = away[crease <= NEAR], away[crease > FAR]
                print_row(
                    name,
                    f"{1000 * voxel_size:g}",
                    mesher,
                    f"{len(mesh.vertices):,}",
                    f"{near.mean():.4f}" if len(near) else "–",
                    f"{far.mean():.4f}" if len(far) else "–",
                    str(is_closed(mesh)),
                    str(self_intersections(mesh)),
                )


def measure_topology(device, options):
    voxel_size = 0.07
    counts = {name: np.zeros(4, int) for name in ("volume", "volume, merged", "solid", "solid, merged")}
    for seed in range(options.solids):
        solid = random_solid(np.random.default_rng(seed))
        volume = solid.volume(voxel_size, device)
        for name, oracle in (("volume", None), ("solid", solid.oracle(voxel_size, device))):
            for merged, flatness in (("", 0.0), (", merged", options.flatness)):
                mesh = dual_contouring(volume, oracle=oracle, flatness=flatness)
                found = [len(mesh.triangles) > 0, is_closed(mesh), is_manifold(mesh), self_intersections(mesh)]
                counts[name + merged] += found
    print_row("oracle", "solids", "with surface", "closed", "manifold", "pairs of triangles that meet")
    for name, found in counts.items():
        print_row(name, str(options.solids), *map(str, found))


def measure_table(device, options):
    options.views, options.truncation, options.storage, options.mesh = 60, 4.0, "packed", None
    scene = accuracy.make_scene("table", options, device)
    print_row("voxel (mm)", "mesher", "vertices", "chamfer (mm)", "accuracy (mm)", "completeness (mm)", "normals")
    for voxel_size in options.voxel_sizes:
        volume, _ = accuracy.fuse(scene, voxel_size, options, EXACT)
        oracle = depth_oracle(volume, scene)
        meshes = {
            "marching cubes": marching_cubes(volume),
            "dual, volume": dual_contouring(volume),
            "dual, depth": dual_contouring(volume, oracle=oracle),
            "dual, depth, merged": dual_contouring(volume, oracle=oracle, flatness=options.flatness),
        }
        for mesher, mesh in meshes.items():
            found = accuracy.measure(mesh, scene, voxel_size)
            lengths = [f"{1000 * voxel_size * found[key]:.4f}" for key in ("chamfer", "accuracy", "completeness")]
            print_row(f"{1000 * voxel_size:g}", mesher, f"{len(mesh.vertices):,}", *lengths, f"{found['normals']:.4f}")


def measure_time(device, options):
    options.views, options.truncation, options.storage, options.mesh = 60, 4.0, "packed", None
    scene = accuracy.make_scene("table", options, device)
    volume, _ = accuracy.fuse(scene, 0.004, options, EXACT)
    oracle = depth_oracle(volume, scene)
    ways = {
        "marching cubes": lambda: marching_cubes(volume),
        "dual, volume": lambda: dual_contouring(volume),
        "dual, volume, merged": lambda: dual_contouring(volume, flatness=options.flatness),
        "keeping depth images": lambda: depth_oracle(volume, scene),
        "dual, depth": lambda: dual_contouring(volume, oracle=oracle),
        "dual, depth, merged": lambda: dual_contouring(volume, oracle=oracle, flatness=options.flatness),
    }
    print_row("way", "CPU seconds", "wall seconds")
    for name, way in ways.items():
        way()
        times = []
        for _ in range(3 if "depth" in name or "merged" in name else 15):
            cpu, wall = time.process_time(), time.perf_counter()
            way()
            wp.synchronize_device(device)
            times.append((time.process_time() - cpu, time.perf_counter() - wall))
        print_row(name, *(f"{least:.4f}" for least in np.min(times, axis=0)))


def measure_order(device, _):
    print_row("mesher", "voxel (mm)", "rms of vertices (voxels)", "order")
    solid = ball((0.013, -0.02, 0.031), 0.5)
    meshers = {
        "marching cubes": lambda volume, _: marching_cubes(volume),
        "dual, volume": lambda volume, _: dual_contouring(volume),
        "dual, solid": lambda volume, size: dual_contouring(volume, oracle=solid.oracle(size, device)),
    }
    for name, mesher in meshers.items():
        before = None
        for voxel_size in (0.04, 0.02, 0.01):
            vertices = mesher(solid.volume(voxel_size, device), voxel_size).vertices.astype(np.float64)
            error = np.sqrt(np.mean(solid(vertices) ** 2))
            order = "" if before is None else f"{np.log2(before / error):.2f}"
            print_row(name, f"{1000 * voxel_size:g}", f"{error / voxel_size:.5f}", order)
            before = error


def measure_scenes(device, options):
    scene_surfaces.measure_scenes(device, options, print_row)


def measure_vertices(device, options):
    datasets = [open_dataset(folder) for folder in options.datasets]
    vertices_for_errors.measure_vertices(device, options, datasets, print_row)


def measure_smooth(device, options):
    smooth_parts.measure_smooth(device, options, print_row)


def print_row(*cells):
    print("| " + " | ".join(cells) + " |", flush=True)


MEASURES = {
    "topology": measure_topology,
    "edges": measure_edges,
    "order": measure_order,
    "table": measure_table,
    "time": measure_time,
    "scenes": measure_scenes,
    "vertices": measure_vertices,
    "smooth": measure_smooth,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measures", nargs="*", choices=[*MEASURES, []], default=[])
    parser.add_argument("--solids", type=int, default=300)
    parser.add_argument("--voxel-sizes", type=float, nargs="+", default=[0.016, 0.008], metavar="METRES")
    parser.add_argument("--datasets", type=Path, nargs="*", default=[], help="recordings with a true mesh, for scenes")
    parser.add_argument("--every", type=int, default=10, help="fuse each so-manieth frame of them")
    parser.add_argument(
        "--factors", type=float, nargs="+", default=[1, 2, 4], help="of the voxel that the data suggest"
    )
    parser.add_argument("--flatness", type=float, default=0.05, metavar="VOXELS", help="within which cells are merged")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    device = resolve_device(options.device)
    load_fusion_kernels(EXACT, device=device, depth_type=wp.float32)
    for name in options.measures or MEASURES:
        print(f"\n{name}", flush=True)
        MEASURES[name](device, options)


if __name__ == "__main__":
    main()
