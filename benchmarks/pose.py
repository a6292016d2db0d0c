"""How often, how exactly and how fast is a view located? Ours, Open3D's ICP and small_gicp from the same starts.

    fusion pose-benchmark DATASET OUT
    python -m benchmarks.pose DATASET OUT
    python -m benchmarks.pose DATASET OUT --trials off-40,noisy --frames ::10

Models, queries, starts, noise and errors are those of ``fusion pose-benchmark``, whose folder OUT is: what it fused is
not fused again. Every contender gets the same task. The peers get the model's vertices with their normals and colours
and as many of the query's points as we take ourselves, or ``--points`` of them, within the mask if there is one, at two
widths of correspondence as their tutorials do, wide and then narrow. Where the protocol has no start of its own but
what our search for the nearest pose finds, all start there.

Times are processor time over the cores that ``--cores`` says share it, so that a busy machine does not count twice;
"wall" is the clock's. Preparing the model, once, is in neither.
"""

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from datagen.atomic_write import write_json
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from fusion.devices import resolve_device
from fusion.evaluation.pose_errors import recall, within
from fusion.pose.depth_refinement import DepthRefinementOptions, refine_with_depth, telling_points
from fusion.pose.query import query_cloud
from fusion.pose.stages import refine
from fusion.pose_benchmark.protocol import parse_trials, trials_for
from fusion.pose_benchmark.run_case import pose_errors
from fusion.pose_benchmark.scanned_subject import scanned_subject
from fusion.pose_benchmark.tasks import Case, make_task, timed
from fusion.pose_benchmark.ycb_video import is_ycb_video, ycb_video_subjects

# --- contenders: each takes the model and gives a function from a task to world_from_camera ---------------------------


def scanback(model, _options):
    def locate(task):
        stages, others = task.case.trial.stages, task.others
        return refine(model, task.query, task.references, task.start, stages, others=others)[-1].world_from_camera

    return locate


def scanback_one_start(model, _options):
    options = DepthRefinementOptions(starts="one")
    return lambda task: refine_with_depth(model, task.query, task.start, options=options).world_from_camera


def _points(model, task, options):
    """Return as many of the query's points as we take ourselves, with their colours, in the camera's frame."""
    most = options.points or telling_points(model, task.query)
    cloud = query_cloud(task.query, device=model.device, most=most).points_camera
    pixels = np.rint(task.query.camera.project(cloud)).astype(int)
    return cloud, task.query.color[pixels[:, 1], pixels[:, 0]] / 255


def _widths(model):
    return 0.1 * model.diameter if model.diameter < 2 else 0.15, 3 * model.voxel_size


def open3d_icp(model, options, *, colored=False):
    import open3d as o3d

    registration = o3d.pipelines.registration
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model.mesh.vertices.astype(float)))
    target.normals = o3d.utility.Vector3dVector(model.mesh.normals.astype(float))
    target.colors = o3d.utility.Vector3dVector(model.mesh.colors / 255.0)

    def locate(task):
        points, colors = _points(model, task, options)
        source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        source.colors = o3d.utility.Vector3dVector(colors)
        pose = task.start
        for step, width in enumerate(_widths(model)):
            criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, 60)
            if colored and step == 1:
                source.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=4 * model.voxel_size, max_nn=20))
                estimation = registration.TransformationEstimationForColoredICP()
                try:
                    pose = registration.registration_colored_icp(
                        source, target, width, pose, estimation, criteria
                    ).transformation
                except RuntimeError:  # no correspondence is left: it keeps what it has
                    continue
            else:
                estimation = registration.TransformationEstimationPointToPlane()
                pose = registration.registration_icp(source, target, width, pose, estimation, criteria).transformation
        return np.array(pose)

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
        points, _colors = _points(model, task, options)
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
        return np.array(pose)

    return locate


def small_gicp_generalised(model, options):
    return small_gicp(model, options, kind="GICP")


def contenders(trial, model, options):
    """Return {name: maker} of those that can do a trial: ICP needs depth, and colour where it is coloured."""
    ours = {f"scanback, {','.join(trial.stages)}": scanback}
    if trial.stages == ("depth",):
        ours["scanback, depth, one start"] = scanback_one_start
    if options.no_peers or trial.sees != "depth":
        return ours
    peers = {
        "Open3D ICP, point to plane": open3d_icp,
        "Open3D ICP, coloured": open3d_colored_icp,
        "small_gicp, point to plane": small_gicp,
        "small_gicp, GICP": small_gicp_generalised,
    }
    if model.mesh.colors is None or not model.mesh.colors.any():
        del peers["Open3D ICP, coloured"]
    return ours | peers


# --- the run ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Line:
    """One contender in one trial."""

    subject: str
    trial: str
    contender: str
    queries: int
    within_1cm_1deg: float
    within_5cm_5deg: float
    add_s_tenth: float | None
    median_deg: float
    median_mm: float
    ninety_percent_deg: float
    ninety_percent_mm: float
    processor_ms: float
    wall_ms: float


def measure(subject, trial, name, make, tasks, options):
    locate = make(subject.model, options)
    locate(tasks[0])  # compiles, fills caches
    found, costs = [], []
    for task in tasks:
        pose, cost = timed(lambda task=task: locate(task))
        costs.append(cost)
        found.append(pose_errors(task, pose))
    turned = np.array([error.rotation_deg for error in found])
    moved = np.array([error.translation_m for error in found])
    of_diameter = [error.add_s_m / subject.points.diameter for error in found if error.add_s_m is not None]
    return Line(
        subject=subject.name,
        trial=trial.name,
        contender=name,
        queries=len(tasks),
        within_1cm_1deg=within(turned, moved, degrees=1, metres=0.01),
        within_5cm_5deg=within(turned, moved, degrees=5, metres=0.05),
        add_s_tenth=recall(of_diameter, below=0.1) if of_diameter else None,
        median_deg=float(np.median(turned)),
        median_mm=1000 * float(np.median(moved)),
        ninety_percent_deg=float(np.quantile(turned, 0.9)),
        ninety_percent_mm=1000 * float(np.quantile(moved, 0.9)),
        processor_ms=1000 * float(np.median([cost.processor_s for cost in costs])) / options.cores,
        wall_ms=1000 * float(np.median([cost.wall_s for cost in costs])),
    )


def subjects_of(options, device):
    if is_ycb_video(options.dataset):
        return ycb_video_subjects(options.dataset, voxel_size=options.voxel_size, device=device)
    dataset = open_dataset(options.dataset)
    subject = scanned_subject(
        dataset,
        options.out / "models" / options.dataset.resolve().name,
        kind="room" if dataset.ground_truth_mesh is None else "object",
        fuse=options.fuse,
        voxel_size=options.voxel_size,
        device=device,
    )
    return [subject]


def tasks_of(subject, trial, options):
    tasks = []
    for frame in select_frames(subject.queries, options.frames):
        for repeat in range(trial.repeats):
            case = Case(subject=subject, trial=trial, frame=frame, repeat=repeat, seed=options.seed)
            try:
                tasks.append(make_task(case))
            except InputError as error:
                print(f"frame {frame} has no start: {error}")
    return tasks


def header(subject, trial, tasks):
    model = subject.model
    print(f"\n{subject.name}, {trial.title}: {len(tasks)} queries, voxels of {1000 * model.voxel_size:g} mm")
    print(
        f"{'':28s} {'1cm 1°':>8s} {'5cm 5°':>8s} {'ADD-S':>7s} {'median °':>9s} {'mm':>9s} {'90 % °':>8s} {'mm':>8s}",
        end="",
    )
    print(f" {'cpu ms':>8s} {'wall ms':>8s}")


def show(line):
    add_s = "–" if line.add_s_tenth is None else f"{line.add_s_tenth:.1%}"
    print(
        f"{line.contender:28s} {line.within_1cm_1deg:8.1%} {line.within_5cm_5deg:8.1%} {add_s:>7s}"
        f" {line.median_deg:9.4f} {line.median_mm:9.4f} {line.ninety_percent_deg:8.3f} {line.ninety_percent_mm:8.3f}"
        f" {line.processor_ms:8.0f} {line.wall_ms:8.0f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path, help="the folder of fusion pose-benchmark, or a new one")
    parser.add_argument("--trials", help="with commas between; all by default")
    parser.add_argument("--frames", metavar="SLICE", help="of those that are not fused")
    parser.add_argument("--fuse", metavar="SLICE")
    parser.add_argument("--voxel-size", type=float, metavar="M")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--points", type=int, metavar="N", help="of a query, for the peers; as many as we take by default"
    )
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    options = parser.parse_args()
    lines = []
    for subject in subjects_of(options, resolve_device("cpu")):
        width = subject.view(subject.queries[0]).camera.width
        for trial in trials_for(subject, parse_trials(options.trials), width_px=width):
            tasks = tasks_of(subject, trial, options)
            header(subject, trial, tasks)
            for name, make in contenders(trial, subject.model, options).items():
                lines.append(measure(subject, trial, name, make, tasks, options))
                show(lines[-1])
                if options.json is not None:
                    write_json(options.json, [asdict(line) for line in lines])


if __name__ == "__main__":
    main()
