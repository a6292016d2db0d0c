"""What a frame says about a point: how far it lies from the plane of the surface that the frame sees there.

Depth is taken between pixels of one surface, in inverse depth, which is linear on planes. With its slopes along the
image it tells the plane of the surface, and so the distance from it, and not along the ray: a ray that grazes a surface
runs far on in front of it or behind, and would have more to say than one that meets it squarely, just where the little
that pixels tell about it is spread over a wide stretch. A frame's weight is 1 over the square of that stretch, the
length on the surface between the rays of two neighbouring pixels: what lies between them is not known, and is taken to
be flat.
"""

from functools import cache
from typing import Any

import warp as wp

from fusion.surface.dual_contouring.lanes import LANES_IN_CPP

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

LOOK_IN_CPP = (
    LANES_IN_CPP
    + """
    const int height = depth.shape[1], width = depth.shape[2];
    const float fx = intrinsics[0], fy = intrinsics[1], cx = intrinsics[2], cy = intrinsics[3];
    const float most_step = truncation / depth_scale, voxels_a_step = depth_scale / voxel_size;
    // The distance in voxels, positive in front, that each of the frames says, and its weight: 0 if it says nothing.
    auto look = [&](auto frame_at, int count, V &distance, V &weight) {
        const V none = 0.0f, one = 1.0f;
        V a = none, b = none, c = none, e = none, du = none, dv = none, u_off = none, v_off = none, z_point = one;
        V given = one;
        for (int lane = 0; lane < count; ++lane) {
            const int frame = frame_at(lane);
            const wp::mat44 &p = pixel_from_lattice.data[frame];
            const float z_at = p.data[2][0] * x + p.data[2][1] * y + p.data[2][2] * z + p.data[2][3];
            if (!(z_at > 0.0f)) continue;
            const float inverse_z = 1.0f / z_at;
            const float u = (p.data[0][0] * x + p.data[0][1] * y + p.data[0][2] * z + p.data[0][3]) * inverse_z;
            const float v = (p.data[1][0] * x + p.data[1][1] * y + p.data[1][2] * z + p.data[1][3]) * inverse_z;
            if (!(u >= -0.5f && v >= -0.5f && u < width - 0.5f && v < height - 0.5f)) continue;
            // The pixel before, or at the image's rim the last one but one: half a pixel beyond is as between these.
            const int u0 = (int)u < width - 2 ? (int)u : width - 2, v0 = (int)v < height - 2 ? (int)v : height - 2;
            const size_t image = (size_t)frame * height * width;
            const auto *depths = depth.data + image + (size_t)v0 * width + u0;
            lanes_of(a)[lane] = (float)depths[0];
            lanes_of(b)[lane] = (float)depths[1];
            lanes_of(c)[lane] = (float)depths[width];
            lanes_of(e)[lane] = (float)depths[width + 1];
            lanes_of(du)[lane] = u - u0;
            lanes_of(dv)[lane] = v - v0;
            lanes_of(u_off)[lane] = u - cx;
            lanes_of(v_off)[lane] = v - cy;
            lanes_of(z_point)[lane] = z_at;
            if (WEIGHTED)
                lanes_of(given)[lane] = pixel_weights.data[image + (size_t)(int)(v + 0.5f) * width + (int)(u + 0.5f)];
        }
        const V low_ab = a < b ? a : b, low_ce = c < e ? c : e, low = low_ab < low_ce ? low_ab : low_ce;
        const V high_ab = a > b ? a : b, high_ce = c > e ? c : e, high = high_ab > high_ce ? high_ab : high_ce;
        const auto one_surface = (low > none) & (high - low <= most_step);
        const V q_a = one / (one_surface ? a : one), q_b = one / (one_surface ? b : one);
        const V q_c = one / (one_surface ? c : one), q_e = one / (one_surface ? e : one);
        const V across_top = q_b - q_a, across_bottom = q_e - q_c;
        const V top = q_a + du * across_top, q_v = q_c + du * across_bottom - top;
        const V q_u = across_top + dv * (across_bottom - across_top), q = top + dv * q_v;
        // Inverse depth is n·ray, and so the plane n·X = 1.
        const V n_x = fx * q_u, n_y = fy * q_v, n_z = q - u_off * q_u - v_off * q_v;
        const V n_n = n_x * n_x + n_y * n_y + n_z * n_z, before = one - z_point * (1.0f / depth_scale) * q;
        V length = n_n;
        for (int lane = 0; lane < LANES; ++lane) lanes_of(length)[lane] = sqrtf(lanes_of(length)[lane]);
        distance = voxels_a_step * before / length;
        const auto says = one_surface & (before >= -most_step * q);
        weight = says ? given * (q * q) * (q * q) / n_n : none;
    };
"""
)
"""C++ for a native function with the point ``x``, ``y``, ``z`` and the members of ``DepthViews``."""


@cache
def views_type(depth_type: type) -> Any:
    """Return the struct of all frames for depth of a type, uint16 or float32."""

    @wp.struct
    class DepthViews:
        """The frames of all batches, as in ``FrameBatch``, and ``fx, fy, cx, cy``; lengths are metres.

        ``centers`` (frames,) are the cameras', on the lattice.
        """

        depth: wp.array3d(dtype=depth_type)
        pixel_weights: wp.array3d(dtype=float)
        depth_scale: float
        intrinsics: wp.vec4
        pixel_from_lattice: wp.array(dtype=wp.mat44)
        centers: wp.array(dtype=wp.vec3)
        truncation: float
        voxel_size: float

    return DepthViews
