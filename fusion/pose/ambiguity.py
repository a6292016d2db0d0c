"""Which other poses explain a view as well: along the directions that it hardly fixes, and turned right round.

The normal equations say how steep the misfit is at the pose, not how far it stays low, and a few rough spots make a
valley look steep: a mug whose handle is hidden turns about its axis without anything to be seen. So the pose is moved,
the model ray-cast again, and compared with the view both ways, pixel by pixel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, inverse, rotation_angle_deg
from fusion.pose.comparison import Comparison, comparison
from fusion.pose.levenberg_marquardt import descend
from fusion.pose.normal_equations import GEMAN_MCCLURE, Normals, Robustness, normal_equations
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query, query_cloud
from fusion.pose.se3 import log_so3, perturb
from fusion.pose.uncertainty import Uncertainty, describe_direction, sense_of_axis

AS_GOOD = 0.02
"""Share of the object's pixels by which another pose may explain fewer, and still be as good."""
WEAK_SHARE = 0.02
"""Of the model's diameter: a direction in which its surface can move that far, either way together, is weak."""
LEAST_TURN_DEG = 15.0
"""Between poses that are told apart as alternatives."""

_STEPS = np.array([0.005, 0.01, 0.02, 0.04, 0.08, 0.16])
_DIRECTIONS = 3
_TURNS_DEG = np.arange(30, 360, 30)
_POINTS, _ITERATIONS = 600, 8
_SYMMETRIC_VOXELS, _SYMMETRIC_SHARE, _SYMMETRIC_MOST = 2.0, 0.02, 0.95
"""A motion is a symmetry where this share of the surface comes to lie so near to it: voxels, or of the diameter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alternative:
    """Another pose, world_from_camera, that explains the view as well.

    To the camera it is the pose found with the model turned by ``turn_deg`` about ``axis`` (3,), in the model's frame
    and right-handed; ``symmetric`` where the model looks the same from all sides after that.
    """

    world_from_camera: Matrix
    turn_deg: float
    axis: NDArray[np.float64]
    symmetric: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Ambiguity:
    """``weak`` names the directions along which the model can move, and how far; ``alternatives`` are poses far off."""

    weak: tuple[str, ...] = ()
    alternatives: tuple[Alternative, ...] = ()

    @property
    def symmetric(self) -> bool:
        """Whether all alternatives come from the model's own symmetry."""
        return all(alternative.symmetric for alternative in self.alternatives)


def find_ambiguity(model: PoseModel, query: Query, world_from_camera: Matrix, known: Uncertainty) -> Ambiguity:
    """Look for poses that explain the view about as well as ``world_from_camera``, whose uncertainty is ``known``.

    Along the least known directions, and turned by multiples of 30° about the principal axes of the model's surface,
    each such pose refined a little where there is depth.
    """
    compare = comparison(model, query, world_from_camera)
    if compare is None:
        return Ambiguity()
    found = float(compare.costs(world_from_camera[None])[0])
    weak = _valleys(model, compare, world_from_camera, known, found + AS_GOOD)
    turned = _turned(model, world_from_camera)
    if query.depth is not None:
        turned = _settled(model, query, turned, known)
    costs = compare.costs(turned)
    alternatives: list[Alternative] = []
    for pose, cost in sorted(zip(turned, costs, strict=True), key=lambda one: float(one[1])):
        others = [world_from_camera, *(alternative.world_from_camera for alternative in alternatives)]
        if cost < found + AS_GOOD and min(rotation_angle_deg(inverse(one) @ pose) for one in others) > LEAST_TURN_DEG:
            alternatives.append(_alternative(model, world_from_camera, pose))
    return Ambiguity(weak=weak, alternatives=tuple(alternatives))


def _valleys(model: PoseModel, compare: Comparison, pose: Matrix, known: Uncertainty, enough: float) -> tuple[str, ...]:
    """Name the least known directions in which the model can be moved far while the pose explains the view."""
    names = []
    for direction in known.directions[::-1][:_DIRECTIONS]:
        twist = direction / np.array([1, 1, 1, *3 * [known.radius_m]])
        lengths = model.diameter * np.concatenate([-_STEPS, _STEPS])
        costs = compare.costs(perturb(lengths[:, None] * twist, pose, pivot_world=known.pivot_world))
        good = (costs < enough).reshape(2, -1)
        # As far as all steps before it are good.
        back, ahead = (float(steps.cumprod() @ np.diff(_STEPS, prepend=0)) for steps in good)
        if back + ahead > WEAK_SHARE:
            names.append(describe_direction(direction) + _how_far(direction, back, ahead, known, model.diameter))
    return tuple(names)


def _how_far(direction: NDArray[np.float64], back: float, ahead: float, known: Uncertainty, diameter: float) -> str:
    """Say how far the model may move along the axis that the direction is named by; twists are the camera's motion."""
    turn, shift = float(np.linalg.norm(direction[3:])), float(np.linalg.norm(direction[:3]))
    turns = turn > 0.3
    # As the camera moves one way, the model, to its eyes, moves the other way.
    if sense_of_axis(direction[3:] if turns else direction[:3]) > 0:
        back, ahead = ahead, back
    low, high = 0.0 - back * diameter, ahead * diameter
    if turns:
        scale = float(np.degrees(turn / known.radius_m))
        return f", from {low * scale:.0f}° to {high * scale:+.0f}°"
    return f", from {1000 * low * shift:.0f} to {1000 * high * shift:+.0f} mm"


def _turned(model: PoseModel, pose: Matrix) -> NDArray[np.float64]:
    """Return the pose (n, 4, 4) with the model turned about the principal axes of its surface."""
    points = model.surface_points.numpy().astype(np.float64) + model.origin_world
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    twists = np.zeros((len(axes) * len(_TURNS_DEG), 6))
    twists[:, 3:] = (np.radians(_TURNS_DEG)[:, None, None] * axes).reshape(-1, 3)
    return perturb(twists, pose, pivot_world=middle)


def _settled(model: PoseModel, query: Query, poses: NDArray[np.float64], known: Uncertainty) -> NDArray[np.float64]:
    """Return poses brought to the nearest minimum of the points' distances, with a wide kernel."""
    cloud = query_cloud(query, device=model.device, most=_POINTS)
    robustness = Robustness(
        kind=GEMAN_MCCLURE,
        scales=np.full(len(poses), 0.03 * model.diameter),
        floor=0.2 * model.voxel_size,
        inlier_within=model.voxel_size,
    )

    def equations(at: NDArray[np.float64]) -> Normals:
        return normal_equations(
            model, cloud, at, count=cloud.count, pivot_world=known.pivot_world, robustness=robustness
        )

    return descend(
        equations,
        poses,
        pivot_world=known.pivot_world,
        radius_m=known.radius_m,
        iterations=_ITERATIONS,
        enough_m=0.05 * model.voxel_size,
    ).poses


def _alternative(model: PoseModel, found: Matrix, other: Matrix) -> Alternative:
    """Describe another pose by the motion of the model that it amounts to."""
    # The camera stays: inverse(other) = inverse(found) · moved, so the model is moved by this, in its own frame.
    moved = found @ inverse(other)
    angle = rotation_angle_deg(moved)
    turn = log_so3(moved[:3, :3])
    axis = turn / max(float(np.linalg.norm(turn)), 1e-12)
    # The same axis is named the same way round.
    if axis[np.abs(axis).argmax()] < 0:
        axis, angle = -axis, 360 - angle
    points = model.surface_points.numpy()[:1500].astype(np.float64) + model.origin_world
    distances, _normals, sources = model.sample(points @ moved[:3, :3].T + moved[:3, 3])
    within = max(_SYMMETRIC_VOXELS * model.voxel_size, _SYMMETRIC_SHARE * model.diameter)
    on_surface = float(np.mean((sources > 0) & (np.abs(distances) < within)))
    return Alternative(world_from_camera=other, turn_deg=angle, axis=axis, symmetric=on_surface >= _SYMMETRIC_MOST)
