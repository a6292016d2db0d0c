"""A voxel's weighted sums, and the two forms in which a volume stores them.

``full`` holds six float32 sums, 24 bytes: merging volumes is addition and removing a frame subtraction, exact to
rounding. ``packed`` takes 8 bytes, a third of the memory and of its traffic, and rounds at each write:

- the average distance to 1/32767 of the truncation (16 bits),
- the weight to 12 significant bits, between 2⁻¹⁵ and 2¹⁷: exact for whole weights to 4096, beyond which adding one
  frame at a time no longer counts (16 bits),
- the average colour to a level of 255, up or down at random so that no drift is lost (3 × 8 bits),
- the colour's weight as a share of the weight, to 1/255 and never down to none (8 bits).

So one write puts a distance off by at most 1.6e-5 of the truncation, and a colour by less than a level.
"""

from typing import Literal, TypeAlias

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Storage: TypeAlias = Literal["packed", "full"]
BYTES_PER_VOXEL: dict[Storage, int] = {"packed": 8, "full": 24}

PACKING_IN_CPP = """
    // 5 bits of exponent and 11 of mantissa, cut from a float's own.
    auto weight_of_bits = [](unsigned int bits) -> float {
        union { unsigned int u; float f; } as;
        as.u = bits ? (bits << 12) + (112u << 23) : 0u;
        return as.f;
    };
    auto bits_of_weight = [](float weight) -> unsigned int {
        union { float f; unsigned int u; } as;
        as.f = weight > 0.0f ? (weight < 131000.0f ? weight : 131000.0f) : 0.0f;  // −0 has bits, too
        const unsigned int rounded = as.u + 0x7ffu + ((as.u >> 12) & 1u);
        return rounded < (112u << 23) + (1u << 12) ? 0u : (rounded - (112u << 23)) >> 12;
    };
    // A number in [0, 1) that looks random, the same whenever the same voxel comes to the same weight.
    auto dither = [](unsigned int voxel, unsigned int weight_bits, unsigned int channel) -> float {
        unsigned int h = voxel * 0x9e3779b1u + weight_bits * 0x85ebca6bu + channel * 0xc2b2ae35u;
        h = (h ^ (h >> 15)) * 0x2c1b3c6du;
        h = (h ^ (h >> 13)) * 0x297a2d39u;
        return (float)((h ^ (h >> 16)) >> 8) * 5.9604645e-8f;
    };
    auto level = [&](float average, unsigned int voxel, unsigned int weight_bits, unsigned int channel) {
        // Whole levels stay as they are.
        const float shifted = average + 0.001f + 0.998f * dither(voxel, weight_bits, channel);
        return (unsigned int)(shifted < 255.0f ? (shifted > 0.0f ? shifted : 0.0f) : 255.0f);
    };
    // Without branches, so that a loop over voxels becomes vector instructions.
    auto pack_voxel = [&](unsigned int voxel, float distance_sum, float weight, float red, float green, float blue,
                          float color_weight) -> unsigned long long {
        const unsigned int weight_bits = bits_of_weight(weight);
        const bool seen = weight_bits != 0u, colored = seen & (color_weight > 0.0f);
        const float inverse_weight = 1.0f / (seen ? weight : 1.0f), inverse = 1.0f / (colored ? color_weight : 1.0f);
        float average = 32767.0f * distance_sum * inverse_weight;
        average = average < 32767.0f ? (average > -32767.0f ? average : -32767.0f) : 32767.0f;
        const int steps = (int)(average + (average < 0.0f ? -0.5f : 0.5f));
        float share = 255.0f * color_weight * inverse_weight + 0.5f;
        share = share < 255.0f ? (share > 1.0f ? share : 1.0f) : 255.0f;
        const unsigned int rgb = level(red * inverse, voxel, weight_bits, 0u)
                                 | level(green * inverse, voxel, weight_bits, 1u) << 8
                                 | level(blue * inverse, voxel, weight_bits, 2u) << 16;
        const unsigned int low = seen ? ((unsigned int)steps & 0xffffu) | weight_bits << 16 : 0u;
        const unsigned int high = colored ? rgb | (unsigned int)share << 24 : 0u;
        return (unsigned long long)low | (unsigned long long)high << 32;
    };
"""
"""C++ for the top of a native function: ``pack_voxel`` and what it is made of."""


@wp.struct
class Voxels:
    """The sums of all voxels; of the two forms, the arrays of one are empty.

    ``packed`` (n,); or ``distance_sum`` (n,) of t_d, in units of the truncation, ``weight`` (n,), ``color_sum`` (n,)
    RGB from 0 to 255, and ``color_weight`` (n,).
    """

    packed: wp.array(dtype=wp.uint64)
    distance_sum: wp.array(dtype=float)
    weight: wp.array(dtype=float)
    color_sum: wp.array(dtype=wp.vec3)
    color_weight: wp.array(dtype=float)


@wp.struct
class VoxelSums:
    """One voxel's sums; weight 0 means unseen."""

    distance: float
    weight: float
    color: wp.vec3
    color_weight: float


@wp.func_native("""
    union { unsigned int u; float f; } as;
    as.u = bits ? (bits << 12) + (112u << 23) : 0u;
    return as.f;
""")
def unpacked_weight(bits: wp.uint32) -> float:
    """Return the weight that 16 bits stand for."""


@wp.func_native(PACKING_IN_CPP + "return pack_voxel(voxel, distance, weight, red, green, blue, color_weight);")
def pack(
    voxel: wp.uint32, distance: float, weight: float, red: float, green: float, blue: float, color_weight: float
) -> wp.uint64:
    """Return a voxel's sums in eight bytes; 0 where the weight is."""


@wp.func
def weight_of(voxels: Voxels, voxel: int) -> float:
    """Return the weight of a voxel, 0 where it was never seen."""
    if voxels.packed.shape[0] > 0:
        return unpacked_weight(wp.uint32(voxels.packed[voxel] >> wp.uint64(16)) & wp.uint32(0xFFFF))
    return voxels.weight[voxel]


@wp.func
def distance_of(voxels: Voxels, voxel: int) -> float:
    """Return the average distance of a voxel in units of the truncation, +1 where it was never seen."""
    if voxels.packed.shape[0] > 0:
        bits = voxels.packed[voxel]
        if bits == wp.uint64(0):
            return 1.0
        return float(wp.int16(bits & wp.uint64(0xFFFF))) / 32767.0
    if voxels.weight[voxel] > 0.0:
        return voxels.distance_sum[voxel] / voxels.weight[voxel]
    return 1.0


@wp.func
def sums_of(voxels: Voxels, voxel: int) -> VoxelSums:
    """Return the sums of a voxel."""
    sums = VoxelSums()
    if voxels.packed.shape[0] > 0:
        bits = voxels.packed[voxel]
        byte = wp.uint64(255)
        sums.weight = weight_of(voxels, voxel)
        sums.distance = sums.weight * float(wp.int16(bits & wp.uint64(0xFFFF))) / 32767.0
        sums.color_weight = sums.weight * float(bits >> wp.uint64(56)) / 255.0
        red = float((bits >> wp.uint64(32)) & byte)
        green = float((bits >> wp.uint64(40)) & byte)
        blue = float((bits >> wp.uint64(48)) & byte)
        sums.color = sums.color_weight * wp.vec3(red, green, blue)
    else:
        sums.distance = voxels.distance_sum[voxel]
        sums.weight = voxels.weight[voxel]
        sums.color = voxels.color_sum[voxel]
        sums.color_weight = voxels.color_weight[voxel]
    return sums


@wp.func
def set_sums(voxels: Voxels, voxel: int, sums: VoxelSums) -> None:
    """Store the sums of a voxel."""
    if voxels.packed.shape[0] > 0:
        color = sums.color
        voxels.packed[voxel] = pack(
            wp.uint32(voxel), sums.distance, sums.weight, color[0], color[1], color[2], sums.color_weight
        )
    else:
        voxels.distance_sum[voxel] = sums.distance
        voxels.weight[voxel] = sums.weight
        voxels.color_sum[voxel] = sums.color
        voxels.color_weight[voxel] = sums.color_weight
