"""What each stage of pose refinement hands on."""

from dataclasses import dataclass
from typing import Literal

from datagen.rigid import Matrix
from fusion.pose.uncertainty import Uncertainty

Stage = Literal["epipolar", "silhouette", "depth"]
Unit = Literal["m", "px"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """A stage's pose, and what speaks for it.

    ``converged`` where the stage moved the pose to a minimum; otherwise ``reason`` says why not, and where it
    ``declined``, ``world_from_camera`` is the start unchanged. ``residual`` is the root mean square of the inliers'
    residuals in ``unit``, ``expected`` what it should be of a right pose, from the query's own noise and the model's.
    ``inlier_share`` is the share of the query's measurements that the model explains; ``overlap`` the share of the
    model's surface, as far as it should be seen, that the query shows, None where there is no depth to tell.
    ``used`` is the number of measurements. ``score`` of a depth stage is how well the pose explains the view, 0 to 1:
    both ways together, and a point the less the farther it is from the surface.
    """

    stage: Stage
    world_from_camera: Matrix
    converged: bool
    declined: bool = False
    reason: str = ""
    residual: float = float("nan")
    expected: float = float("nan")
    unit: Unit = "m"
    inlier_share: float = 0.0
    overlap: float | None = None
    used: int = 0
    score: float | None = None
    iterations: int = 0
    uncertainty: Uncertainty | None = None


def declined(stage: Stage, start: Matrix, reason: str, *, used: int = 0, unit: Unit = "m") -> Refinement:
    """Return what a stage hands on that could do nothing: the start, and the reason."""
    return Refinement(
        stage=stage, world_from_camera=start, converged=False, declined=True, reason=reason, used=used, unit=unit
    )
