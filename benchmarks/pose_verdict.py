"""How often is a pose said to be found that is not, and not found that is? And which bounds would say so best?

    python benchmarks/pose_verdict.py out/held.json                          # shapes that no bound was chosen on
    python benchmarks/pose_verdict.py out/chosen.json --shapes chosen        # those that bounds are chosen on
    python benchmarks/pose_verdict.py out/scans.json --shapes none --meshes data/*/ground_truth/mesh.ply
    python benchmarks/pose_verdict.py out/real.json --shapes none --ycb-video data/ycbv
    python benchmarks/pose_verdict.py out/*.json --only-table

Every model is looked for in views of itself and in views of all others, as ``fusion locate`` does with a CAD model. The
shapes are random solids: boxes, ellipsoids, cylinders and rings, joined or cut out of each other, whose numbers make
them; a shape's *twin* has its last part a third larger, and is the hardest wrong object that there is. Views are ray
cast from random sides and distances, half before a slanting wall and half before nothing; half have a Kinect's noise, a
mask that is off by 1 to 2 pixels and something that hides up to 30 %. Each is located by depth and mask, by depth alone
where there is no wall, and by its mask alone. Real views are those of YCB-Video, with the models and masks that it has.

A pose of the right object is right where its points are off by less than 2 % of the diameter (ADD-S). Told are the
verdicts, the rates with their 95 % bounds (Clopper and Pearson), and the bounds on quality that these cases ask for:
*found* from where no wrong pose is left, *doubtful* from where 1 % of the right ones lie below.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

# Run as a script, this folder would hide the package that it measures: it has a file of that name.
sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != Path(__file__).resolve().parent]
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scipy import ndimage, stats
from skimage.measure import marching_cubes

from datagen.atomic_write import write_json
from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import inverse, look_at, transform_points
from fusion.devices import resolve_device
from fusion.evaluation.pose_errors import ModelPoints, average_nearest_distance
from fusion.evaluation.symmetries import symmetry_transforms
from fusion.pose.cad_model import CadModel, views_around
from fusion.pose.confidence import assess
from fusion.pose.nearest_pose import find_nearest_pose
from fusion.pose.nearest_silhouette import find_nearest_outline
from fusion.pose.pose_model import PoseModel, prepare_model
from fusion.pose.query import Query
from fusion.pose.se3 import exp_se3
from fusion.pose.stages import default_stages, refine
from fusion.pose.verdict import quality
from fusion.pose.view_index import ViewIndex, index_views
from fusion.pose_benchmark.scanned_subject import surface_sample
from fusion.pose_benchmark.views import Noise, View, spoiled
from fusion.pose_benchmark.ycb_video import ycb_video_subjects
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CAMERA = PinholeCamera(width=320, height=240, fx=444.0, fy=444.0, cx=159.5, cy=119.5)
FIRST_NUMBER = {"chosen": 100, "held": 200}
RIGHT_WITHIN = 0.02
TWIN = 4 / 3
_NODES = 96
_POINTS = 2000


# --- shapes -----------------------------------------------------------------------------------------------------------


def ellipsoid(points, size):
    return (np.linalg.norm(points / size, axis=-1) - 1) * size.min()


def box(points, size):
    return (np.abs(points) - size).max(axis=-1)


def cylinder(points, size):
    return np.maximum(np.hypot(points[..., 0], points[..., 1]) - size[0], np.abs(points[..., 2]) - size[2])


def ring(points, size):
    around = np.hypot(points[..., 0], points[..., 1]) - size.max()
    return np.hypot(around, points[..., 2]) - 0.35 * size.max()


def random_solid(number, *, twin=False):
    """Return the mesh of a random solid, 0.2 to 0.3 m large; a twin's last part is larger."""
    rng = np.random.default_rng(number)
    line = np.linspace(-1, 1, _NODES)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    parts, inside = int(rng.integers(2, 5)), None
    for part in range(parts):
        size = rng.uniform(0.12, 0.45, 3) * (TWIN if twin and part == parts - 1 else 1)
        place = np.eye(4) if part == 0 else exp_se3(np.concatenate([np.zeros(3), rng.normal(size=3)]))
        place[:3, 3] = 0 if part == 0 else rng.uniform(-0.35, 0.35, 3)
        shape = (box, ellipsoid, cylinder, ring)[rng.integers(4)]
        value = shape(transform_points(inverse(place), grid.reshape(-1, 3)).reshape(grid.shape), size)
        cut = part > 0 and rng.random() < 0.25
        inside = value if inside is None else np.maximum(inside, -value) if cut else np.minimum(inside, value)
    # One piece, the largest: what floats beside it is no part of an object.
    pieces, count = ndimage.label(inside < 0)
    sizes = ndimage.sum_labels(inside < 0, pieces, np.arange(1, count + 1))
    alone = np.where((inside < 0) & (pieces != 1 + int(np.argmax(sizes))), -inside, inside)
    alone = np.pad(alone, 1, constant_values=1.0)
    vertices, triangles, _normals, _values = marching_cubes(alone, 0.0)
    vertices = vertices * (line[1] - line[0])
    return centred(vertices, triangles, rng.uniform(0.2, 0.3))


def centred(vertices, triangles, diameter):
    extent = np.ptp(vertices, axis=0)
    vertices = (vertices - vertices.min(axis=0) - extent / 2) * (diameter / np.linalg.norm(extent))
    return Mesh(vertices=vertices.astype(np.float32), triangles=np.ascontiguousarray(triangles, np.int32))


# --- views and models -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """What is looked for."""

    name: str
    model: PoseModel
    index: ViewIndex
    points: ModelPoints


def model_of(name, model, camera, points):
    index = index_views(
        model.mesh, views_around(model.centre_world, model.diameter, camera), camera, device=model.device
    )
    return Model(
        name=name, model=model, index=index, points=ModelPoints(points=points, symmetries=symmetry_transforms())
    )


def cad_model(name, mesh, device):
    cad = CadModel(source=name, mesh=mesh, points=mesh.vertices.astype(float))
    model = prepare_model(cad.volume(device=device), outline=mesh)
    return model_of(name, model, CAMERA, surface_sample(mesh, _POINTS))


def random_view(mesh, rng, device):
    """Return a view of a mesh as a scanner or a segmentation would have it, and what was done to it."""
    diameter = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    way = rng.normal(size=3)
    # A Kinect sees nothing nearer than half a metre.
    eye = way / np.linalg.norm(way) * max(diameter * rng.uniform(2.2, 4), 0.5 + diameter)
    pose = look_at(eye, 0.05 * diameter * rng.normal(size=3), up=rng.normal(size=3))
    depth = cast_rays_at_mesh(mesh, CAMERA, [pose], device=device, depth_only=True).depth.numpy()[0]
    mask = depth > 0
    wall = bool(rng.random() < 0.5)
    if wall:
        normal = np.array([0.5 * rng.normal(), 0.5 * rng.normal(), -1])
        middle = transform_points(inverse(pose), np.zeros(3)) + np.array([0, 0, 0.5 * diameter])
        behind = (middle @ normal) / (CAMERA.back_project(np.ones(depth.shape)) @ normal)
        depth = np.where(mask, depth, np.where((behind > 0) & (behind < 5), behind, 0)).astype(np.float32)
    color = np.zeros((*depth.shape, 3), np.uint8)
    view = View(camera=CAMERA, color=color, depth=depth, mask=mask, world_from_camera=pose)
    spoilt = bool(rng.random() < 0.5)
    return (spoiled(view, Noise(), rng=rng) if spoilt else view), wall, spoilt


def queries_of(view, *, wall):
    yield "depth, mask", Query(camera=view.camera, depth=view.depth, mask=view.mask)
    if not wall:
        yield "depth", Query(camera=view.camera, depth=view.depth)
    yield "mask", Query(camera=view.camera, mask=view.mask)


# --- cases ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Case:
    """A model looked for in a view: ``error`` is ADD-S over the diameter, None of a wrong object."""

    model: str
    object: str
    sees: str
    spoilt: bool
    answer: str
    quality: float
    settled: bool
    error: float | None
    evidence: dict

    @property
    def truth(self):
        if self.error is None:
            return "twin" if self.model.removesuffix("'") == self.object.removesuffix("'") else "wrong object"
        return "right pose" if self.error < RIGHT_WITHIN else "wrong pose"


def locate(wanted, query):
    """Return the pose and what is said of it, as ``fusion locate`` has them; None where nothing is there to start."""
    try:
        if query.depth is None:
            start = find_nearest_outline(wanted.index, wanted.model, query).estimate
        else:
            start = find_nearest_pose(wanted.index, query.depth, mask=query.mask).estimate
    except InputError:
        return None
    results = refine(wanted.model, query, [], start, default_stages(has_depth=query.depth is not None, has_color=False))
    return results[-1], assess(wanted.model, query, results)


def case_of(wanted, name, sees, query, truth, *, spoilt):
    told = locate(wanted, query)
    if told is None:
        return None
    found, confidence = told
    error = None
    if name == wanted.name:
        there = inverse(truth)
        error = average_nearest_distance(inverse(found.world_from_camera), there, wanted.points)
        error = float(error / wanted.points.diameter)
    return Case(
        model=wanted.name,
        object=name,
        sees=sees,
        spoilt=spoilt,
        answer=confidence.verdict.answer,
        quality=quality(confidence.evidence),
        settled=found.converged,
        error=error,
        evidence={key: value for key, value in asdict(confidence.evidence).items() if value is not None},
    )


def cases_of_meshes(meshes, options, device):
    """Yield the cases of each mesh looked for in views of all; the same view is shown to all models."""
    for number, (name, mesh) in enumerate(meshes.items()):
        wanted = cad_model(name, mesh, device)
        for other, (shown, shape) in enumerate(meshes.items()):
            for k in range(options.right if other == number else options.wrong):
                view, wall, spoilt = random_view(shape, np.random.default_rng([options.seed, other, k]), device)
                for sees, query in queries_of(view, wall=wall):
                    yield case_of(wanted, shown, sees, query, view.world_from_camera, spoilt=spoilt)


def cases_of_ycb_video(options, device):
    subjects = ycb_video_subjects(options.ycb_video, voxel_size=None, device=device)
    for subject in subjects:
        camera, points = subject.view(subject.queries[0]).camera, subject.points.points
        # As fine as fusion locate makes a model of points.
        model = prepare_model(CadModel(source=subject.name, mesh=None, points=points).volume(device=device))
        wanted = model_of(subject.name, model, camera, points)
        for other in subjects:
            for frame in other.queries[: options.right if other is subject else options.wrong]:
                view = other.view(frame)
                for sees, query in queries_of(view, wall=True):
                    yield case_of(wanted, other.name, sees, query, view.world_from_camera, spoilt=True)


# --- what they tell ---------------------------------------------------------------------------------------------------


def rate(count, total):
    """Return a rate with its 95 % bounds, in words."""
    if not total:
        return "–"
    low = stats.beta.ppf(0.025, count, total - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, total - count) if count < total else 1.0
    return f"{count / total:.1%} ({low:.1%} to {high:.1%})"


def suggested(cases):
    """Return the bounds that cases ask for: found above all that is wrong, doubtful above 1 % of what is right."""
    wrong = [case.quality for case in cases if case.truth in ("wrong object", "wrong pose") and case.settled]
    right = [case.quality for case in cases if case.truth == "right pose"]
    found_from = np.ceil(100 * max(wrong, default=0) + 1e-9) / 100
    doubtful_from = np.floor(100 * np.quantile(right, 0.01)) / 100 if right else float("nan")
    return float(found_from), float(doubtful_from)


def show(cases):
    for sees in sorted({case.sees for case in cases}):
        some = [case for case in cases if case.sees == sees]
        print(f"\n{sees}: {'':12s} {'found':>6s} {'doubtful':>9s} {'not found':>10s}   quality: least, 5 %, 95 %, most")
        for truth in ("right pose", "wrong pose", "wrong object", "twin"):
            these = [case for case in some if case.truth == truth]
            if not these:
                continue
            counts = [sum(case.answer == answer for case in these) for answer in ("found", "doubtful", "not found")]
            spread = " ".join(f"{q:.2f}" for q in np.quantile([case.quality for case in these], (0, 0.05, 0.95, 1)))
            print(f"  {truth:14s} {counts[0]:10d} {counts[1]:9d} {counts[2]:10d}   {spread}")
        right = [case for case in some if case.truth == "right pose"]
        wrong = [case for case in some if case.truth in ("wrong object", "wrong pose")]
        print(f"  falsely found {rate(sum(case.answer == 'found' for case in wrong), len(wrong))}", end="")
        print(f", falsely not found {rate(sum(case.answer == 'not found' for case in right), len(right))}")
        found_from, doubtful_from = suggested(some)
        print(f"  these cases ask for: found from {found_from:.2f}, doubtful from {doubtful_from:.2f}", flush=True)


def chosen_meshes(options):
    meshes = {}
    if options.shapes != "none":
        first = FIRST_NUMBER[options.shapes] if options.first is None else options.first
        for number in range(first, first + options.count):
            meshes[f"solid {number}"] = random_solid(number)
        for number in range(first, first + min(options.twins, options.count)):
            meshes[f"solid {number}'"] = random_solid(number, twin=True)
    for path in options.meshes:
        mesh = read_mesh(path)
        meshes[path.resolve().parent.parent.name] = centred(mesh.vertices, mesh.triangles, 0.28)
    return meshes


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="+", help="JSON of the cases; several with --only-table")
    parser.add_argument("--shapes", choices=[*FIRST_NUMBER, "none"], default="held")
    parser.add_argument("--first", type=int, metavar="NUMBER", help="of the shapes, to have some that nobody has seen")
    parser.add_argument("--count", type=int, default=8, help="of shapes")
    parser.add_argument("--twins", type=int, default=4, help="of how many there is a twin, too")
    parser.add_argument("--meshes", type=Path, nargs="*", default=[], metavar="PLY")
    parser.add_argument("--ycb-video", type=Path, metavar="FOLDER")
    parser.add_argument("--right", type=int, default=8, help="views of the model itself")
    parser.add_argument("--wrong", type=int, default=2, help="views of each other object")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only-table", action="store_true", help="of cases that were written")
    options = parser.parse_args()
    if options.only_table:
        show([Case(**case) for path in options.out for case in json.loads(path.read_text())])
        return
    device = resolve_device("cpu")
    cases = []

    def keep(case):
        if case is not None:
            cases.append(case)
            write_json(options.out[0], [asdict(one) for one in cases])

    for case in cases_of_meshes(chosen_meshes(options), options, device):
        keep(case)
    if options.ycb_video is not None:
        for case in cases_of_ycb_video(options, device):
            keep(case)
    show(cases)


if __name__ == "__main__":
    main()
