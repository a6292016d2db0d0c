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
from analytic_oracle import SolidState, ball, cube, l_shape, random_solid, solid_value
from mesh_topology import is_closed, is_manifold, self_intersections

from benchmarks import accuracy, scene_surfaces, smooth_parts, vertices_for_errors
from datagen.open_dataset import open_dataset
from fusion.devices import launch_in_slabs, resolve_device
from fusion.evaluation.evaluate import sample_surface
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import load_fusion_kernels
from fusion.reconstruction_config import EXACT
from fusion.surface.dual_contouring.depth_oracle import DepthField
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.marching_cubes import marching_cubes

wp.set_module_options({"enable_backward": False})

NEAR, FAR = 0.5, 2.0


@wp.kernel
def _trace_rays(
    first: int,
    solid: SolidState,
    pose: wp.mat44,
    intrinsics: wp.vec4,
    depth: wp.array2d(dtype=float),
):
    index = wp.tid() + first
    width = depth.shape[1]
    u = index % width
    v = index / width
    ray = wp.vec3((float(u) - intrinsics[2]) / intrinsics[0], (float(v) - intrinsics[3]) / intrinsics[1], 1.0)
    origin = wp.transform_point(pose, wp.vec3(0.0, 0.0, 0.0))
    direction = wp.transform_vector(pose, ray)
    length = wp.length(direction)
    z = float(0.0)
    found = float(0.0)
    for _step in range(200):
        if z < 3.0 and found == 0.0:
            distance = solid_value(solid, 0, origin + z * direction)
            if distance < 1.0e-6:
                found = z
            z += wp.max(distance, 5.0e-7) / length
    depth[v, u] = found


class SolidScene(accuracy.Scene):
    """A solid in closed form, seen by sphere tracing."""

    def __init__(self, name, solid, device, views=60):
        super().__init__(name, accuracy.poses_around(views, centre=(0, 0, 0), nearest=1.3, farthest=1.6), device)
        self.solid = solid

    def depth(self, frame):
        camera = accuracy.CAMERA
        depth = wp.empty((camera.height, camera.width), dtype=float, device=self.device)
        state = self.solid.oracle(1.0, self.device).state
        pose = wp.mat44(*self.poses[frame].astype(np.float32).ravel().tolist())
        intrinsics = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        launch_in_slabs(
            _trace_rays, dim=depth.size, inputs=[state, pose, intrinsics], outputs=[depth], device=self.device
        )
        return depth.numpy()


def depth_oracle(volume, scene):
    field = DepthField(volume, EXACT, frames=len(scene.poses))
    upload = FrameUploader(accuracy.CAMERA, device=volume.device)
    for first in range(0, len(scene.poses), accuracy.BATCH):
        some = slice(first, first + accuracy.BATCH)
        field.add(upload(scene.depths[some], scene.poses[some]))
    return field.oracle()


def crease_distance(solid, points, voxel_size):
    """Return how far points are from an edge of the solid, up to 2 voxels: where normals around differ by over 25°."""
    ways = np.concatenate(
        [np.eye(3), -np.eye(3), *[np.array([[a, b, 0], [0, a, b], [a, 0, b]]) for a in (-1, 1) for b in (-1, 1)]]
    )
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)

    def normals(at):
        step = 1e-4 * voxel_size
        slopes = [(solid(at + step * axis) - solid(at - step * axis)) / (2 * step) for axis in np.eye(3)]
        return np.stack(slopes, -1)

    distance = np.full(len(points), FAR + 0.01)
    for reach in (FAR, NEAR):
        around = []
        for way in ways:
            at = points + reach * voxel_size * way
            slope = normals(at)
            # Onto the surface, once: near an edge that lands beside it, which is all that is asked.
            at = at - (solid(at) / np.maximum((slope**2).sum(-1), 1e-9))[:, None] * slope
            inside_reach = np.linalg.norm(at - points, axis=1) <= 1.05 * reach * voxel_size
            around.append(np.where(inside_reach[:, None], normals(at), np.nan))
        around = np.stack(around)
        own = normals(points)
        cosines = np.einsum("knj,nj->kn", around, own)
        sharp = np.nanmin(np.where(np.isnan(cosines), 1.0, cosines), axis=0) < np.cos(np.deg2rad(25))
        distance[sharp] = reach
    return distance


def box_crease_distance(solid, points, voxel_size):
    """Return how far points are from the edges of a box, in voxels."""
    q = np.abs((points - solid.centres[0]) @ solid.rotations[0])
    return np.linalg.norm(np.sort(np.abs(q - solid.halves[0]), axis=1)[:, :2], axis=1) / voxel_size


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
