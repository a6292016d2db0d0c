"""What stands in the scene."""

from typing import Literal

from pydantic import Field

from datagen.scene_spec.base import Name, Scale, Spec, Vector


class ObjectSettings(Spec):
    """A shape in Blender's own size: round ones of radius 1, cube and plane of side 2, Suzanne 2.7 wide.

    It is scaled (by one number or by one an axis), turned about x, then y, then z, and moved. ``subdivision`` rounds
    it by that many Catmull-Clark levels; ``smooth`` shades across faces and leaves the geometry as it is.
    """

    name: Name
    shape: Literal["suzanne", "sphere", "cube", "plane", "cylinder", "cone", "torus"]
    material: Name
    location: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    scale: Scale = (1.0, 1.0, 1.0)
    subdivision: int = Field(default=0, ge=0, le=6)
    smooth: bool = False
