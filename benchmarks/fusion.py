"""Ours against Open3D: integration and meshing of the same decoded frames, in turn, in one run.

    python benchmarks/fusion.py DATASET --voxel-size 0.02 --truncation 0.06 --frames 0:200

Each contender runs in a process of its own, so that its peak memory is its own; rounds alternate between them, and
medians and ratios are printed. Open3D must be installed beside Scanback (0.19: the ScalableTSDFVolume of version 0.20
integrates nothing). A contender that gives an empty mesh is an error.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import trimesh

# Run as a script, this file's own name would hide the package that it measures.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != Path(__file__).resolve().parent]
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from datagen.dataset import Frame
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from datagen.rigid import inverse
from fusion.depth_tiles import depth_tiles
from fusion.devices import load_kernels, resolve_device
from fusion.evaluate import evaluate
from fusion.find_blocks import find_blocks
from fusion.frame_batch import FrameUploader
from fusion.integrate import integrate_frames
from fusion.integration import Integration
from fusion.marching_cubes import marching_cubes
from fusion.mesh import read_mesh
from fusion.reconstruct import KERNEL_MODULES
from fusion.visible_blocks import visible_blocks
from fusion.volume import Volume


BATCH = 16


class PeakMemory:
    """The most memory of this process while the block runs, beyond what it held before, in MiB."""

    def __enter__(self):
        self._process = psutil.Process()
        self._before = self._process.memory_info().rss
        self._peak = self._before
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self):
        while not self._done.wait(0.005):
            self._peak = max(self._peak, self._process.memory_info().rss)

    def __exit__(self, *_):
        self._done.set()
        self._thread.join()
        self.mib = (max(self._peak, self._process.memory_info().rss) - self._before) / 2**20


def run_ours(frames, camera, options):
    device = resolve_device(options.device)
    load_kernels(KERNEL_MODULES, device=device)
    lengths = {"voxel_size": options.voxel_size, "truncation": options.truncation}

    # Depth as the images store it, which is also how Open3D takes it below.
    steps = [np.rint(f.depth / options.depth_scale).astype(np.uint16) for f in frames]
    poses = [f.world_from_camera for f in frames]
    colors = [f.color for f in frames]
    batches = [slice(first, first + BATCH) for first in range(0, len(frames), BATCH)]

    def integrate():
        volume = Volume(device=device, max_blocks=10**6, storage=options.storage, **lengths)
        upload = FrameUploader(camera, device=device, capacity=BATCH, depth_scale=options.depth_scale)
        for some in batches:
            batch = upload(steps[some], poses[some])
            tiles = depth_tiles(batch, split_beyond=2 * options.truncation)
            find_blocks(volume.table, batch, tiles, **lengths)
        volume.table.sort()
        volume.reserve(volume.table.count)
        for some in batches:
            batch = upload(steps[some], poses[some], colors[some])
            tiles = depth_tiles(batch, split_beyond=2 * options.truncation)
            integrate_frames(volume, batch, visible_blocks(volume, batch, tiles), Integration())
        return volume

    def extract(volume):
        mesh = marching_cubes(volume)
        return mesh.vertices, mesh.triangles

    return integrate, extract


def run_voxel_block_grid(frames, camera, options):
    import open3d as o3d
    import open3d.core as o3c

    device = o3c.Device("CPU:0")
    intrinsics = o3c.Tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], o3c.float64)
    images = [
        (
            # It takes depth and colour both as integers or both as floats; the integers are its faster way.
            o3d.t.geometry.Image(o3c.Tensor(np.rint(f.depth / options.depth_scale).astype(np.uint16))).to(device),
            o3d.t.geometry.Image(o3c.Tensor(f.color)).to(device),
            o3c.Tensor(inverse(f.world_from_camera)),
        )
        for f in frames
    ]
    shared = {
        "depth_scale": 1 / options.depth_scale,
        "depth_max": options.depth_max,
        "trunc_voxel_multiplier": options.truncation / options.voxel_size,
    }

    def integrate():
        grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(o3c.float32, o3c.uint16, o3c.uint16),
            attr_channels=((1), (1), (3)),
            voxel_size=options.voxel_size,
            block_resolution=16,
            block_count=10_000,
            device=device,
        )
        for depth, color, extrinsics in images:
            blocks = grid.compute_unique_block_coordinates(depth, intrinsics, extrinsics, **shared)
            grid.integrate(blocks, depth, color, intrinsics, intrinsics, extrinsics, **shared)
        return grid

    def extract(grid):
        mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
        return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()

    return integrate, extract


def run_scalable_volume(frames, camera, options):
    import open3d as o3d

    intrinsics = o3d.camera.PinholeCameraIntrinsic(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    )
    images = [
        (
            o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.geometry.Image(f.color),
                o3d.geometry.Image(f.depth),
                depth_scale=1.0,
                depth_trunc=options.depth_max,
                convert_rgb_to_intensity=False,
            ),
            inverse(f.world_from_camera),
        )
        for f in frames
    ]

    def integrate():
        volume = o3d.pipelines.integration.ScalableTSDFVolume(
            voxel_length=options.voxel_size,
            sdf_trunc=options.truncation,
            color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
        )
        for rgbd, extrinsics in images:
            volume.integrate(rgbd, intrinsics, extrinsics)
        return volume

    def extract(volume):
        mesh = volume.extract_triangle_mesh()
        return np.asarray(mesh.vertices), np.asarray(mesh.triangles)

    return integrate, extract


CONTENDERS = {
    "scanback": run_ours,
    "Open3D VoxelBlockGrid": run_voxel_block_grid,
    "Open3D ScalableTSDFVolume": run_scalable_volume,
}


def compete(options):
    """Run one contender on all frames and print what it took as one line of JSON."""
    dataset = open_dataset(options.dataset)
    options.depth_scale = dataset.depth_scale
    frames = [limited(dataset.frame(i), options.depth_max) for i in select_frames(dataset.frame_ids, options.frames)]
    integrate, extract = CONTENDERS[options.contender](frames, dataset.camera, options)
    with PeakMemory() as memory:
        start = time.perf_counter()
        volume = integrate()
        integrated = time.perf_counter()
    meshed = []
    for _ in range(3):  # the first call may compile or warm up
        start_mesh = time.perf_counter()
        vertices, triangles = extract(volume)
        meshed.append(time.perf_counter() - start_mesh)
    if len(triangles) == 0:
        raise SystemExit(f"{options.contender}: the mesh is empty")
    trimesh.Trimesh(vertices, triangles, process=False).export(options.mesh)
    result = {
        "frames_per_second": len(frames) / (integrated - start),
        "mesh_seconds": min(meshed),
        "memory_mib": memory.mib,
        "vertices": len(vertices),
    }
    print(json.dumps(result))


def limited(frame, depth_max):
    depth = np.where(frame.depth <= depth_max, frame.depth, np.float32(0))
    return Frame(frame_id=frame.frame_id, color=frame.color, depth=depth, world_from_camera=frame.world_from_camera)


def compare(options, arguments):
    """Let the contenders run in turn, and print medians, ratios and how far their meshes are from ours."""
    results = {name: [] for name in options.contenders}
    with tempfile.TemporaryDirectory() as folder:
        meshes = {name: Path(folder) / f"{i}.ply" for i, name in enumerate(results)}
        for round_number in range(options.rounds):
            for name, runs in results.items():
                command = [sys.executable, __file__, *arguments, "--contender", name, "--mesh", str(meshes[name])]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                if done.returncode != 0:
                    raise SystemExit(f"{name} failed:\n{done.stderr[-3000:]}")
                runs.append(json.loads(done.stdout.splitlines()[-1]))
                print(f"round {round_number + 1}: {name}: {runs[-1]}", file=sys.stderr)
        print_results(results, meshes, options)


def print_results(results, meshes, options):
    def median(name, key):
        return statistics.median(run[key] for run in results[name])

    def spread(name, key):
        values = [run[key] for run in results[name]]
        return f"{min(values):.3g}–{max(values):.3g}"

    print("| | frames/s | mesh (s) | memory (MiB) | vertices | ours to theirs | chamfer to ours (voxels) |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    ours = read_mesh(meshes["scanback"])
    for name in results:
        ratios = [
            a["frames_per_second"] / b["frames_per_second"]
            for a, b in zip(results["scanback"], results[name], strict=True)
        ]
        chamfer = evaluate(
            read_mesh(meshes[name]), ours, thresholds=[options.voxel_size / 2], device=resolve_device("cpu")
        )["chamfer_m"]
        print(
            f"| {name} | {median(name, 'frames_per_second'):.0f} ({spread(name, 'frames_per_second')}) "
            f"| {median(name, 'mesh_seconds'):.3f} | {median(name, 'memory_mib'):.0f} | {median(name, 'vertices'):.0f} "
            f"| {statistics.median(ratios):.2f}× | {chamfer / options.voxel_size:.3f} |"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--voxel-size", type=float, required=True)
    parser.add_argument("--truncation", type=float, required=True)
    parser.add_argument("--depth-max", type=float, default=10.0)
    parser.add_argument("--frames")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--storage", choices=["packed", "full"], default="packed")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--contenders", nargs="+", choices=CONTENDERS, default=list(CONTENDERS))
    parser.add_argument("--contender", choices=CONTENDERS, help=argparse.SUPPRESS)
    parser.add_argument("--mesh", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.contender:
        compete(options)
    else:
        compare(options, sys.argv[1:])


if __name__ == "__main__":
    main()
