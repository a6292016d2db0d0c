"""Ours against Open3D: the same frames, in turn, in one run.

    python -m benchmarks.fusion DATASET --voxel-size 0.02 --truncation 0.06 --frames 0:200
    python -m benchmarks.fusion DATASET --voxel-size 0.02 --truncation 0.06 --frames 0:200 --from-disk

The first compares integration and meshing, the frames decoded beforehand; the second the whole way from the folder to a
mesh on disk. Each contender runs in a process of its own, so that its peak memory is its own; rounds alternate between
them, and medians and ratios are printed, of wall time and of processor time. Where other work shares the cores, set
OMP_WAIT_POLICY=passive, or Open3D's threads spin while they wait for each other, and take the processor time of all
others. Imports, and the compiling of kernels, are not counted. Open3D must be
installed beside Scanback (0.19: the ScalableTSDFVolume of version 0.20 integrates nothing). A contender that gives an
empty mesh is an error.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

from benchmarks import contenders, contenders_from_disk
from benchmarks.peak_memory import PeakMemory
from datagen.dataset import Frame
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from fusion.devices import resolve_device
from fusion.evaluation.evaluate import evaluate
from fusion.surface.mesh_files import read_mesh


def compete(options):
    """Run one contender on all frames and print what it took as one line of JSON."""
    dataset = open_dataset(options.dataset)
    options.depth_scale = dataset.depth_scale
    result = (from_disk if options.from_disk else in_memory)(dataset, options)
    if result["vertices"] == 0:
        raise SystemExit(f"{options.contender}: the mesh is empty")
    print(json.dumps(result))


def in_memory(dataset, options):
    frames = [limited(dataset.frame(i), options.depth_max) for i in select_frames(dataset.frame_ids, options.frames)]
    integrate, extract = contenders.CONTENDERS[options.contender](frames, dataset.camera, options)
    # Three times each: memory that is fresh from the system costs time, which says little about the method.
    integrated, processor, meshed = [], [], []
    for attempt in range(3):
        with PeakMemory() as memory:
            start, cpu_start = time.perf_counter(), time.process_time()
            volume = integrate()
            integrated.append(time.perf_counter() - start)
            processor.append(time.process_time() - cpu_start)
        if attempt == 0:
            first_memory = memory.mib
    for _ in range(3):
        start_mesh = time.perf_counter()
        vertices, triangles = extract(volume)
        meshed.append(time.perf_counter() - start_mesh)
    trimesh.Trimesh(vertices, triangles, process=False).export(options.mesh)
    return {
        "frames_per_second": len(frames) / statistics.median(integrated),
        "cpu_seconds": statistics.median(processor),
        "mesh_seconds": statistics.median(meshed),
        "memory_mib": first_memory,
        "vertices": len(vertices),
    }


def limited(frame, depth_max):
    depth = np.where(frame.depth <= depth_max, frame.depth, np.float32(0))
    return Frame(frame_id=frame.frame_id, color=frame.color, depth=depth, world_from_camera=frame.world_from_camera)


def from_disk(dataset, options):
    """Time the whole way. Reading the images once beforehand puts them into the system's cache for everybody."""
    frame_ids = select_frames(dataset.frame_ids, options.frames)
    for files in contenders_from_disk.frame_files(dataset, options):
        for file in files[:2]:
            Path(file).read_bytes()
    run = contenders_from_disk.CONTENDERS[options.contender](dataset, options)
    with PeakMemory() as memory:
        start, cpu_start = time.perf_counter(), time.process_time()
        stages = run()
        seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    return {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "frames_per_second": len(frame_ids) / seconds,
        "memory_mib": memory.mib,
        "vertices": len(read_mesh(Path(options.mesh)).vertices),
        "stages": stages,
    }


def compare(options, arguments):
    """Let the contenders run in turn; returns what each took in each round, and their meshes."""
    results = {name: [] for name in options.contenders}
    with tempfile.TemporaryDirectory() as folder:
        meshes = {name: Path(folder) / str(i) / "mesh.ply" for i, name in enumerate(results)}
        for mesh in meshes.values():
            mesh.parent.mkdir()
        for round_number in range(options.rounds):
            for name, runs in results.items():
                command = [sys.executable, "-m", "benchmarks.fusion", *arguments]
                command += ["--contender", name, "--mesh", str(meshes[name])]
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
        return f"{median(name, key):.4g} ({min(values):.3g}–{max(values):.3g})"

    time_key = "seconds" if options.from_disk else "mesh_seconds"
    title = "whole way (s)" if options.from_disk else "mesh (s)"
    print(
        f"| | frames/s | {title} | memory (MiB) | vertices | ours to theirs | in CPU time | chamfer to ours (voxels) |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    ours = read_mesh(meshes["scanback"])
    for name in results:
        pairs = list(zip(results["scanback"], results[name], strict=True))
        ratios = [a["frames_per_second"] / b["frames_per_second"] for a, b in pairs]
        cpu_ratio = statistics.median(b["cpu_seconds"] / a["cpu_seconds"] for a, b in pairs)
        chamfer = evaluate(
            read_mesh(meshes[name]), ours, thresholds=[options.voxel_size / 2], device=resolve_device("cpu")
        )["chamfer_m"]
        print(
            f"| {name} | {spread(name, 'frames_per_second')} | {spread(name, time_key)} "
            f"| {median(name, 'memory_mib'):.0f} | {median(name, 'vertices'):.0f} "
            f"| {statistics.median(ratios):.2f}× ({min(ratios):.2f}–{max(ratios):.2f}) "
            f"| {cpu_ratio:.2f}× "
            f"| {chamfer / options.voxel_size:.3f} |"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--voxel-size", type=float, required=True)
    parser.add_argument("--truncation", type=float, required=True)
    parser.add_argument("--depth-max", type=float, default=10.0)
    parser.add_argument("--frames")
    parser.add_argument("--from-disk", action="store_true", help="from the folder to a mesh on disk, decoding included")
    parser.add_argument("--exact", action="store_true", help="from disk: ours with the command's defaults, more work")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--storage", choices=["packed", "full"], default="packed")
    parser.add_argument("--rounds", type=int, default=3)
    known = list(contenders.CONTENDERS)
    parser.add_argument("--contenders", nargs="+", choices=known, default=known)
    parser.add_argument("--contender", choices=known, help=argparse.SUPPRESS)
    parser.add_argument("--mesh", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.contender:
        compete(options)
    else:
        compare(options, sys.argv[1:])


if __name__ == "__main__":
    main()
