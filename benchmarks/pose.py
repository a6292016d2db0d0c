"""How often, how exactly and how fast is a view located? Ours, Open3D's ICP and small_gicp from the same starts.

    fusion reconstruct DATASET RECONSTRUCTION --frames ::2
    python benchmarks/pose.py DATASET RECONSTRUCTION
    python benchmarks/pose.py DATASET RECONSTRUCTION --noise kinect-v1 --occlude 0.3 --perturb 40:0.16
    python benchmarks/pose.py DATASET RECONSTRUCTION --start nearest --stages silhouette

Queries are the dataset's frames that were not fused. A start is the true pose, turned by an angle about a random axis
through the model's middle and shifted by a length in a random direction (as Diff-DOPE's), or that of the nearest fused
frame. The peers get the model's vertices with their normals and colours and the query's points, at two widths of
correspondence as their tutorials do, wide and then narrow. Errors are those of the model in the camera's frame: the
angle, and how far the model's middle is off. ``--camera-errors`` gives the camera's place instead, for rooms.

Times are processor time over the cores that ``--cores`` says share it, so that a busy machine does not count twice;
"wall" is the clock's. Preparing the model, once, is in neither.
"""

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

# Run as a script, this folder would hide the package that it measures: it has a file of that name.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != Path(__file__).resolve().parent]
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from datagen.open_dataset import open_dataset
from datagen.rigid import inverse, rotation_angle_deg, transform_points
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.simulate_depth import simulate_depth
from fusion.devices import resolve_device
from fusion.pose.depth_refinement import DepthRefinementOptions, refine_with_depth
from fusion.pose.epipolar import ReferenceFrame, rectify
from fusion.pose.pose_model import prepare_model
from fusion.pose.query import Query, query_cloud
from fusion.pose.se3 import perturb
from fusion.pose.silhouette_refinement import refine_with_silhouette
from fusion.pose.verdict import judge
from fusion.reconstruction_files import read_record
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.volume_file import load_volume

SEED = 6
PEER_POINTS = 8000
MASK_JITTER_PX = 2


class Task:
    """One query: what the contenders are given, and the truth."""

    def __init__(self, query, start, truth, references):
        self.query, self.start, self.truth, self.references = query, start, truth, references


# --- contenders: each takes the model and gives a function from a task to a pose --------------------------------------


def scanback_depth(model, _options):
    return lambda task: refine_with_depth(model, task.query, task.start)


def scanback_depth_one_start(model, _options):
    options = DepthRefinementOptions(starts="one")
    return lambda task: refine_with_depth(model, task.query, task.start, options=options)


def scanback_silhouette(model, _options):
    def locate(task):
        depth = task.query.depth
        mask = task.query.mask if task.query.mask is not None else depth > 0
        return refine_with_silhouette(model, Query(camera=task.query.camera, mask=mask), task.start)

    return locate


def scanback_epipolar(model, _options):
    return lambda task: rectify(model, task.query, task.references, task.start)


def _points(model, task):
    """Return as many of the query's points as we take ourselves, with their colours, in the camera's frame."""
    cloud = query_cloud(task.query, device=model.device, most=PEER_POINTS).points_camera
    pixels = np.rint(task.query.camera.project(cloud)).astype(int)
    return cloud, task.query.color[pixels[:, 1], pixels[:, 0]] / 255


def _widths(model):
    return 0.1 * model.diameter if model.diameter < 2 else 0.15, 3 * model.voxel_size


def open3d_icp(model, _options, *, colored=False):
    import open3d as o3d

    registration = o3d.pipelines.registration
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model.mesh.vertices.astype(float)))
    target.normals = o3d.utility.Vector3dVector(model.mesh.normals.astype(float))
    target.colors = o3d.utility.Vector3dVector(model.mesh.colors / 255.0)

    def locate(task):
        points, colors = _points(model, task)
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        source.colors = o3d.utility.Vector3dVector(colors)
        pose = task.start
        for step, width in enumerate(_widths(model)):
            criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, 60)
            if colored and step == 1:
                source.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=4 * model.voxel_size, max_nn=20))
                estimation = registration.TransformationEstimationForColoredICP()
                pose = registration.registration_colored_icp(
                    source, target, width, pose, estimation, criteria
                ).transformation
            else:
                estimation = registration.TransformationEstimationPointToPlane()
                pose = registration.registration_icp(source, target, width, pose, estimation, criteria).transformation
        return pose

    return locate


def open3d_colored_icp(model, options):
    return open3d_icp(model, options, colored=True)


def small_gicp(model, options, *, kind="PLANE_ICP"):
    import small_gicp as peer

    threads = options.cores
    target, tree = peer.preprocess_points(
        model.mesh.vertices.astype(float), downsampling_resolution=model.voxel_size, num_threads=threads
    )

    def locate(task):
        points, _colors = _points(model, task)
        source, _tree = peer.preprocess_points(points, downsampling_resolution=1e-4, num_threads=threads)
        pose = task.start
        for width in _widths(model):
            pose = peer.align(
                target,
                source,
                tree,
                pose,
                registration_type=kind,
                max_correspondence_distance=width,
                num_threads=threads,
                max_iterations=60,
            ).T_target_source
        return pose

    return locate


def small_gicp_generalised(model, options):
    return small_gicp(model, options, kind="GICP")


OURS = {
    "depth": {"scanback, depth": scanback_depth, "scanback, one start": scanback_depth_one_start},
    "silhouette": {"scanback, silhouette": scanback_silhouette},
    "epipolar": {"scanback, epipolar": scanback_epipolar},
}
PEERS = {
    "Open3D ICP, point to plane": open3d_icp,
    "Open3D ICP, coloured": open3d_colored_icp,
    "small_gicp, point to plane": small_gicp,
    "small_gicp, GICP": small_gicp_generalised,
}


# --- tasks ------------------------------------------------------------------------------------------------------------


def random_direction(rng):
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def noisy(depth, camera, options, rng):
    """Return sensor depth, and the mask that a careless segmentation gives of what an occluder leaves."""
    mask = depth > 0
    if options.noise:
        depth = simulate_depth(depth, camera, SensorSettings(model=options.noise), rng=rng)
        kernel = np.ones((2 * rng.integers(1, MASK_JITTER_PX + 1) + 1,) * 2, np.uint8)
        mask = (cv2.dilate if rng.random() < 0.5 else cv2.erode)(mask.astype(np.uint8), kernel) > 0
    if options.occlude:
        v, u = np.mgrid[: camera.height, : camera.width]
        angle = rng.uniform(0, 2 * np.pi)
        across = u * np.cos(angle) + v * np.sin(angle)
        hidden = across < np.quantile(across[mask], rng.uniform(0, options.occlude))
        depth = np.where(hidden, 0.6 * np.median(depth[depth > 0]), depth)
        mask &= ~hidden
    return depth.astype(np.float32), mask


def make_tasks(dataset, record, model, options):
    fused = [frame.frame for frame in record.trajectory]
    poses = {frame: dataset.world_from_camera(frame) for frame in fused}
    queries = [frame for frame in dataset.frame_ids if frame not in poses][:: options.every]
    for frame in queries:
        rng = np.random.default_rng([SEED, frame])
        truth = dataset.world_from_camera(frame)
        near = sorted(fused, key=lambda other: _apart(poses[other], truth, model.diameter))[:2]
        if options.start == "nearest":
            start = poses[near[0]]
        else:
            turn, shift = options.perturb
            twist = np.concatenate([shift * random_direction(rng), np.radians(turn) * random_direction(rng)])
            start = perturb(twist, truth, pivot_world=model.centre_world)
        depth, mask = noisy(dataset.depth(frame), dataset.camera, options, rng)
        query = Query(
            camera=dataset.camera,
            depth=depth,
            color=dataset.color(frame),
            mask=mask if options.noise or options.occlude else None,
        )
        references = []
        if "epipolar" in options.stages:
            references = [
                ReferenceFrame(
                    camera=dataset.camera,
                    color=dataset.color(other),
                    depth=dataset.depth(other),
                    world_from_camera=poses[other],
                )
                for other in near
            ]
        yield Task(query, start, truth, references)


def _apart(one, other, size):
    return np.linalg.norm(one[:3, 3] - other[:3, 3]) / size + np.radians(rotation_angle_deg(inverse(one) @ other))


def errors(found, truth, model, options):
    """Return the angle (degrees), and how far the model's middle, or the camera, is off (millimetres)."""
    angle = rotation_angle_deg(inverse(found) @ truth)
    if options.camera_errors:
        return angle, 1000 * np.linalg.norm(found[:3, 3] - truth[:3, 3])
    middle = transform_points(inverse(truth), model.centre_world)
    return angle, 1000 * np.linalg.norm(transform_points(inverse(found), model.centre_world) - middle)


# --- the run ----------------------------------------------------------------------------------------------------------


def measure(name, make, model, tasks, options):
    locate = make(model, options)
    locate(tasks[0])  # compiles, fills caches
    off, processor, wall, answers = [], [], [], []
    for task in tasks:
        before, clock = time.process_time(), time.perf_counter()
        found = locate(task)
        processor.append(time.process_time() - before)
        wall.append(time.perf_counter() - clock)
        if hasattr(found, "world_from_camera"):
            answers.append(judge(found).answer)
            found = found.world_from_camera
        off.append(errors(found, task.truth, model, options))
    off = np.array(off)
    strict = (off[:, 0] < 1) & (off[:, 1] < 10)
    loose = (off[:, 0] < 5) & (off[:, 1] < 50)
    sure = f"{np.mean([answer == 'found' for answer in answers]):7.0%}" if answers else "      –"
    print(
        f"{name:28s} {strict.mean():8.1%} {loose.mean():8.1%} {np.median(off[:, 0]):9.4f} {np.median(off[:, 1]):9.4f}"
        f" {np.quantile(off[:, 0], 0.9):8.3f} {np.quantile(off[:, 1], 0.9):8.3f}"
        f" {1000 * np.median(processor) / options.cores:8.0f} {1000 * np.median(wall):8.0f} {sure}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("reconstruction", type=Path)
    parser.add_argument("--start", choices=("perturbed", "nearest"), default="perturbed")
    parser.add_argument(
        "--perturb",
        type=lambda text: tuple(map(float, text.split(":"))),
        default=(10.0, 0.04),
        metavar="DEG:M",
    )
    parser.add_argument("--noise", choices=("kinect-v1", "realsense-d435"))
    parser.add_argument("--occlude", type=float, default=0.0, metavar="SHARE", help="of the mask, at most")
    parser.add_argument("--stages", nargs="+", choices=tuple(OURS), default=["depth"])
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every Nth query")
    parser.add_argument("--camera-errors", action="store_true", help="of the camera's place, for rooms")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--no-peers", action="store_true")
    options = parser.parse_args()
    device = resolve_device("cpu")
    volume = load_volume(options.reconstruction / "volume.npz", device=device)
    model = prepare_model(volume, mesh=marching_cubes(volume, normals=True))
    dataset, record = open_dataset(options.dataset), read_record(options.reconstruction)
    tasks = list(make_tasks(dataset, record, model, options))
    print(f"{len(tasks)} queries, voxels of {1000 * model.voxel_size:g} mm, model {model.diameter:.2f} m across")
    print(f"{'':28s} {'1cm 1°':>8s} {'5cm 5°':>8s} {'median °':>9s} {'mm':>9s} {'90 % °':>8s} {'mm':>8s}", end="")
    print(f" {'cpu ms':>8s} {'wall ms':>8s} {'found':>7s}")
    for stage in options.stages:
        for name, make in OURS[stage].items():
            measure(name, make, model, tasks, options)
    if not options.no_peers:
        for name, make in PEERS.items():
            measure(name, make, model, tasks, options)


if __name__ == "__main__":
    main()
