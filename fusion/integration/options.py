"""How frames are weighed and sampled when they are integrated."""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from datagen.errors import InputError

DepthSampling: TypeAlias = Literal["nearest", "bilinear"]
Weighting: TypeAlias = Literal["constant", "inverse-square", "cosine"]


@dataclass(frozen=True, kw_only=True)
class Integration:
    """The options of integration; the defaults are the paper's.

    ``depth_sampling``: the pixel nearest to a voxel's projection, or ``bilinear``: between the four around it, in
    inverse depth, which is exact on planes. Where those four lie across an edge in depth, by more than the truncation,
    or one has no depth, the frame says nothing about the voxel: the nearest would carry the one surface's depth over to
    the other side of its outline. A surface that is seen so slantingly that it spans as much from pixel to pixel, but
    goes on beside them, counts for 1/255: it is there where no frame sees it better.
    ``weighting``: w_new of a pixel: 1, (1 m / z)², as the noise of depth cameras grows with z², or the cosine between
    the viewing ray and the surface's normal. ``drop_off``: behind the surface the weight falls linearly to 0 at −t, so
    that the far side of thin parts is disturbed less. ``weight_cap`` bounds a voxel's weight, so that new frames keep
    their say in a changing scene; a frame cannot be removed from such a volume.
    """

    depth_sampling: DepthSampling = "nearest"
    weighting: Weighting = "constant"
    drop_off: bool = False
    weight_cap: float | None = None

    def __post_init__(self) -> None:
        """Refuse options that are none; raises InputError."""
        for option, value, known in (
            ("--depth-sampling", self.depth_sampling, get_args(DepthSampling)),
            ("--weighting", self.weighting, get_args(Weighting)),
        ):
            if value not in known:
                raise InputError(f"{option} {value}: expected one of {', '.join(known)}")
        if not isinstance(self.drop_off, bool):
            raise InputError(f"drop_off {self.drop_off!r}: expected True or False")
        if self.weight_cap is not None and not 1 <= self.weight_cap <= 1e5:
            raise InputError(f"--weight-cap {self.weight_cap:g}: expected 1 to 100000 frames' worth of weight")
