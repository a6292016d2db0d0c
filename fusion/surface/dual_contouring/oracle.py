"""What dual contouring asks: on which side of the surface is a point?

An oracle is a Warp function ``value(state, number, point) -> float`` and the struct that it takes. ``number`` is that
of a block that holds the point, or has it on its border, and ``point`` is on the lattice: in voxels from the world's
origin. The value is negative inside the surface and positive outside; near the surface it should be about the distance
in voxels, which spares questions, but its sign alone decides where the surface is found. NOT_KNOWN is the answer where
there is none.

The volume itself is no such oracle: a trilinear field needs no questions (``edge_points``, ``cell_points``).
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

NOT_KNOWN = wp.constant(3.0e38)
_KNOWN_BELOW = wp.constant(1.0e38)


@dataclass(frozen=True)
class Oracle:
    """A Warp function, the struct type that it takes, and the struct."""

    value: Any
    state_type: Any
    state: Any


@wp.func
def is_known(value: float) -> bool:
    """Return whether an oracle's value is an answer."""
    return value < _KNOWN_BELOW
