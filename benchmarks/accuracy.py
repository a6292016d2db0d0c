"""How exact is the surface fused from exact frames? A sphere, Suzanne and a table, at several voxel sizes.

    python -m benchmarks.accuracy --depth-sampling bilinear --drop-off
    python -m benchmarks.accuracy --depth-sampling bilinear --drop-off --mesher dual-contouring --oracle depth
    python -m benchmarks.accuracy --depth-sampling bilinear --drop-off --truncation 2 --image-width 1280 --all-round
    python -m benchmarks.accuracy --scenes suzanne --mesh dataset/ground_truth/mesh.ply --voxel-sizes 0.004

Depth is ray-cast at the pixels' centres, so all that a mesh departs from the truth is the fusion's own doing. The mesh
is held against the whole truth, the truth that was observed (``fusion.evaluation.observed_surface``) against the mesh;
lengths are in voxels. "in sight" is the F-score over all that a line of sight reaches, whether a pixel measured it or
not, "well seen" over what three cameras see, none from more than 72° beside the normal: no voxel size makes a surface
of a slit that one camera looks into. Where sight ends, a mesh ends up to a voxel earlier, as cells are meshed only if
all their corners were seen: a table seen from above alone has such ends under its top's edge and at its legs, one that
is seen ``--all-round``, as the sphere and Suzanne are, has hardly any. A second layer of surface would show in the last
columns: mesh area that lies more than 1.5 voxels from the truth, or faces the wrong way, mesh area per area of observed
truth, and components.
"""

import argparse
import time
from pathlib import Path
from typing import get_args

import numpy as np
import warp as wp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from benchmarks.exact_scenes import CAMERA, SAMPLES, Scene, camera_of_width, make_scene, poses_around
from fusion.devices import load_kernels, resolve_device
from fusion.evaluation.evaluate import sample_surface
from fusion.frames.frame_batch import MAX_BATCH, FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch, load_fusion_kernels
from fusion.integration.options import DepthSampling, Integration, Weighting
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.depth_oracle import DepthField
from fusion.surface.dual_contouring.dual_contouring import oracle_kernels
from fusion.surface.mesh_files import write_mesh
from fusion.surface.meshers import KERNEL_MODULES, Mesher, OracleName, mesh_volume
from fusion.volume.tsdf_volume import Volume

__all__ = ["BATCH", "CAMERA", "Scene", "fuse", "make_scene", "poses_around"]  # for surfaces.py

BATCH = MAX_BATCH
FAR_VOXELS = 1.5


def fuse(scene, voxel_size, options, integration):
    """Return the volume of all frames, and frames a second from the allocation on."""
    lengths = {"voxel_size": voxel_size, "truncation": options.truncation * voxel_size}
    volume = Volume(device=scene.device, max_blocks=10**7, storage=options.storage, **lengths)
    upload = FrameUploader(scene.camera, device=scene.device)
    batches = [slice(first, first + BATCH) for first in range(0, len(scene.poses), BATCH)]
    _ = scene.depths, scene.colors
    start = time.perf_counter()
    for some in batches:
        find_batch_blocks(volume.table, upload(scene.depths[some], scene.poses[some]), **lengths)
    volume.table.sort()
    volume.reserve(volume.table.count)
    for some in batches:
        integrate_batch(volume, upload(scene.depths[some], scene.poses[some], scene.colors[some]), integration)
    wp.synchronize_device(scene.device)
    return volume, len(scene.poses) / (time.perf_counter() - start)


def mesh_of(volume, scene, options, integration):
    """Return the volume's mesh, by the mesher that was asked for."""
    oracle = None
    if options.mesher == "dual-contouring" and options.oracle == "depth":
        field = DepthField(volume, integration, frames=len(scene.poses))
        upload = FrameUploader(scene.camera, device=scene.device)
        for first in range(0, len(scene.poses), BATCH):
            field.add(upload(scene.depths[first : first + BATCH], scene.poses[first : first + BATCH]))
        oracle = field.oracle()
        load_kernels((), oracle_kernels(oracle), device=scene.device)
    return mesh_volume(volume, options.mesher, oracle=oracle)


def measure(mesh, scene, voxel_size):
    """Return a mesh's measures against the scene's truth, by column."""
    ours, truth = sample_surface(mesh, SAMPLES, rng=np.random.default_rng(1)), scene.in_sight
    observed = scene.is_observed
    to_truth, true_normals = scene.distances(ours.points)
    closest = closest_points(mesh, truth.points, device=scene.device)
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1) / 2
    normals = crosses / np.maximum(2 * areas, 1e-300)[:, None]
    cosines = np.einsum("ij,ij->i", ours.normals, true_normals)
    recall_cosines = np.einsum("ij,ij->i", truth.normals, normals[closest.triangles])[observed]
    missing = closest.distances[observed].mean()
    near, found = (to_truth < voxel_size / 2).mean(), closest.distances < voxel_size / 2

    def fscore(recall):
        return 200 * near * recall / (near + recall)

    return {
        "chamfer": (to_truth.mean() + missing) / 2 / voxel_size,
        "accuracy": to_truth.mean() / voxel_size,
        "completeness": missing / voxel_size,
        "precision (%)": 100 * near,
        "recall (%)": 100 * found[observed].mean(),
        "F at ½ (%)": fscore(found[observed].mean()),
        "in sight (%)": fscore(found.mean()),
        "well seen (%)": fscore(found[scene.is_well_seen].mean()),
        "normals": (np.abs(cosines).mean() + np.abs(recall_cosines).mean()) / 2,
        "far (%)": 100 * (to_truth > FAR_VOXELS * voxel_size).mean(),
        "flipped (%)": 100 * (cosines < 0).mean(),
        "area": areas.sum() / scene.observed_area,
        "parts": components(mesh),
    }


def components(mesh):
    corners = mesh.triangles
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(mesh.vertices),) * 2)
    return connected_components(graph, directed=False)[0]


def print_row(cells):
    print("| " + " | ".join(cells) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=["sphere", "suzanne", "table"])
    parser.add_argument("--voxel-sizes", type=float, nargs="+", default=[0.008, 0.004, 0.002], metavar="METRES")
    parser.add_argument("--truncation", type=float, default=3.0, metavar="VOXELS")
    parser.add_argument("--depth-sampling", choices=get_args(DepthSampling), default="nearest")
    parser.add_argument("--weighting", choices=get_args(Weighting), default="constant")
    parser.add_argument("--drop-off", action="store_true")
    parser.add_argument("--mesher", choices=get_args(Mesher), default="marching-cubes")
    parser.add_argument("--oracle", choices=get_args(OracleName), default="depth", help="of dual contouring")
    parser.add_argument("--save", type=Path, metavar="FOLDER", help="keep the meshes")
    parser.add_argument("--views", type=int, default=60, help="the table is seen by a third more")
    parser.add_argument("--image-width", type=int, default=CAMERA.width, metavar="PIXELS")
    parser.add_argument("--all-round", action="store_true", help="see the table from below, too, as the others are")
    parser.add_argument("--mesh", type=Path, help="Suzanne, where there is no bpy")
    parser.add_argument("--storage", choices=["packed", "full"], default="packed")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    device = resolve_device(options.device)
    integration = Integration(
        depth_sampling=options.depth_sampling, weighting=options.weighting, drop_off=options.drop_off
    )
    load_fusion_kernels(integration, device=device, depth_type=wp.float32)
    load_kernels(KERNEL_MODULES[options.mesher], device=device)
    header = None
    for name in options.scenes or ["sphere", "suzanne", "table"]:
        camera = camera_of_width(options.image_width)
        scene = make_scene(name, options, device, camera=camera, all_round=options.all_round)
        for voxel_size in options.voxel_sizes:
            volume, rate = fuse(scene, voxel_size, options, integration)
            mesh = mesh_of(volume, scene, options, integration)
            if options.save:
                write_mesh(options.save / f"{name}-{1000 * voxel_size:g}mm-{options.mesher}.ply", mesh)
            measures = measure(mesh, scene, voxel_size)
            row = {"scene": name, "voxel (mm)": f"{1000 * voxel_size:g}"}
            row |= {key: f"{value:.4g}" for key, value in measures.items()} | {"frames/s": f"{rate:.1f}"}
            if header is None:
                header = list(row)
                print_row(header)
                print_row(["---"] * len(header))
            print_row(row.values())


if __name__ == "__main__":
    main()
