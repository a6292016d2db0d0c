"""What stands in the scene."""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from datagen.scene_spec.base import Name, NotNegative, Positive, Scale, Spec, Vector

MODEL_SUFFIXES = (".blend", ".glb", ".gltf", ".obj", ".ply", ".stl", ".usd", ".usda", ".usdc", ".usdz")
SUFFIXES_WITHOUT_AXES = (".obj", ".ply", ".stl")
"""Of formats that do not say which axis points up; for the others their importer knows."""

Extent = tuple[Positive, Positive, Positive]
ProfilePoint = tuple[NotNegative, float]
ModelPath = Annotated[str, Field(min_length=1)]

_NEEDED: dict[str, tuple[str, ...]] = {
    "lathe": ("profile",),
    "tube": ("path", "radius"),
    "box": ("size",),
    "book": ("size", "inner_material"),
}
_OPTIONAL: dict[str, tuple[str, ...]] = {"lathe": ("bevel", "spline"), "box": ("bevel",)}
_SHAPE_KEYS = ("profile", "spline", "bevel", "path", "radius", "size", "inner_material")


class PartSettings(Spec):
    """A shape, or a model from a file, with its material; scaled, turned about x, then y, then z, and moved.

    Shapes in Blender's own size (round ones of radius 1, cube and plane of side 2, Suzanne 2.7 wide): ``suzanne``,
    ``sphere``, ``cube``, ``plane``, ``cylinder``, ``cone``, ``torus``. ``bunny``: Stanford's, 0.156 m wide, standing
    on z = 0, y to its back. In metres, closed and with smooth normals:

    - ``lathe`` revolves ``profile``, [radius, z] points, about z. It begins and ends on the axis, or ends where it
      began; ``bevel`` is the radius that rounds its corners, ``spline`` draws a curve through the points instead.
    - ``tube``: a curve through ``path``, with round ends; ``radius`` is one number or one for each point.
    - ``box`` of ``size``, its middle at the origin; ``bevel`` rounds its edges.
    - ``book`` of ``size`` [width, height, thickness], lying with its back down and the spine at −x, its middle at the
      origin: covers of ``material`` around pages of ``inner_material``.

    ``file`` is a model file instead of a shape, its path relative to the scene file; it keeps its own materials (or
    vertex colours) where no ``material`` is given. ``up_axis`` tells which axis of an OBJ (y), PLY or STL (z) points
    up; the other formats say so themselves. ``sha256`` identifies the file's content; reading the scene fills it in.
    ``subdivision`` rounds the mesh by that many Catmull-Clark levels; ``smooth`` shades across faces (as the shapes in
    metres do anyway) and leaves the geometry as it is.
    """

    shape: (
        Literal[
            "suzanne",
            "sphere",
            "cube",
            "plane",
            "cylinder",
            "cone",
            "torus",
            "bunny",
            "lathe",
            "tube",
            "box",
            "book",
        ]
        | None
    ) = None
    file: ModelPath | None = None
    sha256: str | None = None
    up_axis: Literal["y", "z"] | None = None
    material: Name | None = None
    inner_material: Name | None = None
    location: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    scale: Scale = (1.0, 1.0, 1.0)
    size: Extent | None = None
    bevel: NotNegative | None = None
    profile: tuple[ProfilePoint, ...] | None = None
    spline: bool | None = None
    path: tuple[Vector, ...] | None = None
    radius: Positive | tuple[Positive, ...] | None = None
    subdivision: int = Field(default=0, ge=0, le=6)
    smooth: bool = False

    @field_validator("file")
    @classmethod
    def _is_of_a_known_format(cls, file: str | None) -> str | None:
        if file is not None and Path(file).suffix.lower() not in MODEL_SUFFIXES:
            raise ValueError(f"no known format of models; known are {', '.join(MODEL_SUFFIXES)}")
        return file

    @field_validator("profile")
    @classmethod
    def _profile_encloses_a_volume(cls, profile: tuple[ProfilePoint, ...] | None) -> tuple[ProfilePoint, ...] | None:
        if profile is None:
            return None
        ring = profile[0] == profile[-1] and all(radius > 0 for radius, _ in profile)
        solid = profile[0][0] == profile[-1][0] == 0 and all(radius > 0 for radius, _ in profile[1:-1])
        if len(profile) < 3 or not (ring or solid):
            raise ValueError(
                "begin and end at radius 0 and nowhere else touch it, or end at the first point: else it has holes"
            )
        return profile

    @model_validator(mode="after")
    def _has_what_its_shape_has(self) -> Self:
        if self.shape is None and self.file is None:
            return self  # an object of parts; it is asked for there
        if self.shape is not None and self.file is not None:
            raise ValueError("give one of shape and file, not both")
        if self.shape is not None and self.material is None:
            raise ValueError("material: missing")
        needed = _NEEDED.get(self.shape or "", ())
        for key in _SHAPE_KEYS:
            given = getattr(self, key) is not None
            if key in needed and not given:
                raise ValueError(f"a {self.shape} needs {key}")
            if given and key not in (*needed, *_OPTIONAL.get(self.shape or "", ())):
                raise ValueError(f"{key} has no meaning for {self.shape or 'a file'}")
        if self.path is not None and isinstance(self.radius, tuple) and len(self.radius) != len(self.path):
            raise ValueError(f"radius has {len(self.radius)} numbers for the {len(self.path)} points of path")
        if self.path is not None and (len(self.path) < 2 or any(a == b for a, b in pairwise(self.path))):
            raise ValueError("path needs at least two points, each apart from the one before")
        return self

    @model_validator(mode="after")
    def _has_what_its_file_has(self) -> Self:
        suffix = Path(self.file).suffix.lower() if self.file is not None else ""
        if self.up_axis is not None and suffix not in SUFFIXES_WITHOUT_AXES:
            raise ValueError(
                f"up_axis has a meaning for {', '.join(SUFFIXES_WITHOUT_AXES)} only; turn others with rotation_deg"
            )
        if self.sha256 is not None and self.file is None:
            raise ValueError("sha256 has no meaning without file")
        return self


class ObjectSettings(PartSettings):
    """One thing in the scene, with a name and an index of its own: a shape, a model from a file, or ``parts`` of it.

    Parts are placed in the object's axes, and move, turn and scale with it.
    """

    name: Name
    parts: tuple[PartSettings, ...] = ()

    @property
    def all_parts(self) -> tuple[PartSettings, ...]:
        """What it is made of: its parts, or itself where it has none."""
        return self.parts or (self,)

    @model_validator(mode="after")
    def _is_a_shape_or_parts(self) -> Self:
        single = self.shape is not None or self.file is not None
        if single == bool(self.parts):
            raise ValueError("give exactly one of shape, file and parts")
        if self.parts:
            misplaced = self.model_fields_set & (
                PartSettings.model_fields.keys() - {"location", "rotation_deg", "scale"}
            )
            set_here = sorted(key for key in misplaced if getattr(self, key) != PartSettings.model_fields[key].default)
            if set_here:
                raise ValueError(f"{set_here[0]} belongs into the parts of an object that has parts")
        for i, part in enumerate(self.parts):
            if part.shape is None and part.file is None:
                raise ValueError(f"parts[{i}]: give shape or file")
        return self
