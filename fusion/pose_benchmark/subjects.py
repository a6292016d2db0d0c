"""What views are located in: a model, its true shape, and the views with their true poses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix
from fusion.evaluation.pose_errors import ModelPoints
from fusion.pose.pose_model import PoseModel
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.view_index import ViewIndex
from fusion.pose_benchmark.views import View

Kind = Literal["object", "room", "points"]
"""An object that was scanned from all sides; a room, scanned from within; a model of points and real frames of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """The frames that a model was fused from: their poses by frame, the model seen from there, and their images."""

    poses: Mapping[int, Matrix]
    index: ViewIndex
    reference: Callable[[int], ReferenceFrame]

    @property
    def frames(self) -> tuple[int, ...]:
        """Their numbers, in the index's order."""
        return tuple(self.poses)


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """A model and the views to locate in it, none of which it was made from.

    ``points`` is the true shape in the model's frame, the world's; ``queries`` are the frames to locate, which ``view``
    reads. ``revolution_axis`` (3,) is that of a body which looks the same turned about it, as far as depth tells.
    ``has_outline`` is False where the views are full of the model, so that a mask of it tells nothing. ``identity``
    tells this model from another one of the same name, for results that are kept.
    """

    name: str
    kind: Kind
    model: PoseModel
    points: ModelPoints
    queries: tuple[int, ...]
    view: Callable[[int], View]
    fused: Fused | None
    identity: str
    has_outline: bool = True
    revolution_axis: tuple[float, float, float] | None = None

    @property
    def centre_world(self) -> NDArray[np.float64]:
        """The middle of the true shape's box: what turns about and what translation errors are of."""
        return (self.points.points.min(axis=0) + self.points.points.max(axis=0)) / 2
