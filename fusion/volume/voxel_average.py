"""What a voxel's sums average to, and colours between two voxels."""

from typing import TypeAlias

import warp as wp

from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Average: TypeAlias = wp.types.vector(length=5, dtype=float)
"""The average distance in units of the truncation, the average colour's RGB, and a number over 0 where it has any."""

# In C++ since a packed voxel holds the averages as they are wanted: going through its sums would take twice the time.
_AVERAGE_IN_CPP = """
    wp::vec_t<5, float> average;
    if (voxels.packed.shape[0] > 0) {
        const wp::uint64 bits = voxels.packed.data[voxel];
        average.c[0] = (float)(short)(bits & 0xffff) * (1.0f / 32767.0f);
        average.c[1] = (float)((bits >> 32) & 255);
        average.c[2] = (float)((bits >> 40) & 255);
        average.c[3] = (float)((bits >> 48) & 255);
        average.c[4] = (float)(bits >> 56);
        return average;
    }
    average.c[0] = voxels.distance_sum.data[voxel] / voxels.weight.data[voxel];
    const float color_weight = voxels.color_weight.data[voxel];
    const float inverse = color_weight > 0.0f ? 1.0f / color_weight : 0.0f;
    for (int channel = 0; channel < 3; ++channel)
        average.c[1 + channel] = inverse * voxels.color_sum.data[voxel].c[channel];
    average.c[4] = color_weight;
    return average;
"""


@wp.func_native(_AVERAGE_IN_CPP)
def average_of(voxels: Voxels, voxel: int) -> Average:
    """Return the averages of a voxel that was seen."""


@wp.func
def color_along(a: Average, b: Average, along: float) -> wp.vec3ub:
    """Return the colour between two voxels, one without colour left out; black where neither has any."""
    share = along
    if a[4] == 0.0:
        share = 1.0
    if b[4] == 0.0:
        share = 0.0
    return wp.vec3ub(
        wp.uint8(a[1] + share * (b[1] - a[1]) + 0.5),
        wp.uint8(a[2] + share * (b[2] - a[2]) + 0.5),
        wp.uint8(a[3] + share * (b[3] - a[3]) + 0.5),
    )
