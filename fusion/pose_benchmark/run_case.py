"""One case: its task, the stages, and the errors of what they found."""

import numpy as np

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, inverse, transform_points
from fusion.evaluation.pose_errors import (
    ModelPoints,
    average_distance,
    average_nearest_distance,
    mspd,
    mssd,
    projection_error_px,
    rotation_error_deg,
    translation_error,
    visible_surface_discrepancy,
)
from fusion.pose.confidence import assess
from fusion.pose.stages import refine
from fusion.pose_benchmark.case_files import CaseResult, PoseErrors
from fusion.pose_benchmark.subjects import Subject
from fusion.pose_benchmark.tasks import Case, Task, make_task, timed
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

FEWEST_POINTS = 10


def run_case(case: Case) -> CaseResult:
    """Locate a case's view and measure how far off it is; what cannot be located is told, not raised."""
    outline = CaseResult(
        subject=case.subject.name,
        trial=case.trial.name,
        frame=case.frame,
        repeat=case.repeat,
        identity=case.identity,
        diameter_m=case.subject.points.diameter,
        truth=case.subject.view(case.frame).world_from_camera.tolist(),
    )
    try:
        task = make_task(case)
    except InputError as error:
        return outline.model_copy(update={"failure": str(error)})
    model, stages = case.subject.model, case.trial.stages
    results, cost = timed(lambda: refine(model, task.query, task.references, task.start, stages, others=task.others))
    estimate = results[-1].world_from_camera
    verdict = assess(case.subject.model, task.query, results).verdict
    return outline.model_copy(
        update={
            "start": task.start.tolist(),
            "start_errors": pose_errors(task, task.start),
            "estimate": estimate.tolist(),
            "errors": pose_errors(task, estimate, with_vsd=case.trial.with_vsd),
            "nearest": task.nearest,
            "verdict": verdict.answer,
            "reasons": verdict.reasons,
            "cost": cost,
        }
    )


def pose_errors(task: Task, world_from_camera: Matrix, *, with_vsd: bool = False) -> PoseErrors:
    """Return the errors of a pose that was found for a task's query."""
    subject, truth = task.case.subject, task.truth
    if subject.kind == "room":
        return PoseErrors(
            rotation_deg=rotation_error_deg(world_from_camera, truth),
            translation_m=float(np.linalg.norm(world_from_camera[:3, 3] - truth[:3, 3])),
        )
    found, there, camera = inverse(world_from_camera), inverse(truth), task.view.camera
    points = points_in_view(subject.points, there, camera)
    return PoseErrors(
        rotation_deg=rotation_error_deg(found, there),
        translation_m=translation_error(found, there, point_model=subject.centre_world),
        fixed_rotation_deg=_fixed_rotation_deg(subject, found, there),
        add_m=average_distance(found, there, points),
        add_s_m=average_nearest_distance(found, there, points),
        projection_px=_or_none(projection_error_px(found, there, points, camera)),
        mssd_m=mssd(found, there, points),
        mspd_px=_or_none(mspd(found, there, points, camera)),
        vsd=_vsd(task, world_from_camera) if with_vsd else None,
    )


def points_in_view(model: ModelPoints, camera_from_model: Matrix, camera: PinholeCamera) -> ModelPoints:
    """Return the points that errors are of: all of an object, and of a scene around the camera those in the image.

    A point behind the camera has no place in the image, and what is out of sight is nobody's to locate.
    """
    points_camera = transform_points(camera_from_model, model.points)
    before = points_camera[:, 2] > 0
    if before.all():
        return model
    u, v = np.full((2, len(points_camera)), np.inf)
    u[before], v[before] = camera.project(points_camera[before]).T
    seen = (np.abs(u - (camera.width - 1) / 2) < camera.width / 2) & (
        np.abs(v - (camera.height - 1) / 2) < camera.height / 2
    )
    # A view of next to nothing is not worth a crash: its errors in the image are infinite then.
    return model if seen.sum() < FEWEST_POINTS else ModelPoints(points=model.points[seen], symmetries=model.symmetries)


def _fixed_rotation_deg(subject: Subject, estimate: Matrix, truth: Matrix) -> float:
    """Return the angle between two poses, without the turn about the axis of a body of revolution."""
    if subject.revolution_axis is None:
        return rotation_error_deg(estimate, truth)
    found, there = estimate[:3, :3] @ subject.revolution_axis, truth[:3, :3] @ subject.revolution_axis
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(found, there)), found @ there)))


def _vsd(task: Task, world_from_camera: Matrix) -> tuple[float, ...]:
    subject, camera = task.case.subject, task.view.camera
    poses = [world_from_camera, task.truth]
    seen = cast_rays_at_mesh(subject.model.mesh, camera, poses, device=subject.model.device, depth_only=True)
    estimate, truth = seen.depth.numpy()
    return visible_surface_discrepancy(estimate, truth, task.view.depth, camera, diameter=subject.points.diameter)


def _or_none(error: float) -> float | None:
    return error if np.isfinite(error) else None
