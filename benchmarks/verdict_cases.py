"""Models looked for in views of themselves and of other objects: for ``pose_verdict.py``."""

from dataclasses import asdict, dataclass

import numpy as np

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import inverse, look_at, transform_points
from fusion.evaluation.pose_errors import ModelPoints, average_nearest_distance
from fusion.evaluation.symmetries import symmetry_transforms
from fusion.pose.cad_model import CadModel, views_around
from fusion.pose.confidence import assess
from fusion.pose.nearest_pose import find_nearest_pose
from fusion.pose.nearest_silhouette import find_nearest_outline
from fusion.pose.pose_model import PoseModel, prepare_model
from fusion.pose.query import Query
from fusion.pose.stages import default_stages, refine
from fusion.pose.verdict import quality
from fusion.pose.view_index import ViewIndex, index_views
from fusion.pose_benchmark.scanned_subject import surface_sample
from fusion.pose_benchmark.views import Noise, View, spoiled
from fusion.pose_benchmark.ycb_video import ycb_video_subjects
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CAMERA = PinholeCamera(width=320, height=240, fx=444.0, fy=444.0, cx=159.5, cy=119.5)
RIGHT_WITHIN = 0.02
_POINTS = 2000


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
