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
    // ``columns`` are these frames' of ``projections``, or zeros for none; ``frame_at`` is then any frame.
    auto look = [&](const float *columns, int stride, auto frame_at, V &distance, V &weight) {
        const V none = 0.0f, one = 1.0f;
        auto along = [&](int row) {
            const float *m = columns + 4 * row * stride;
            return load(m) * x + load(m + stride) * y + (load(m + 2 * stride) * z + load(m + 3 * stride));
        };
        distance = weight = none;
        const V z_point = along(2);
        const auto ahead = z_point > none;
        const V inverse_z = one / (ahead ? z_point : one), u_seen = along(0) * inverse_z, v_seen = along(1) * inverse_z;
        const auto in_view = ahead & (u_seen >= (V)-0.5f) & (v_seen >= (V)-0.5f) & (u_seen < (V)(width - 0.5f))
                             & (v_seen < (V)(height - 0.5f));
        if (!any(in_view)) return;
        const V u = in_view ? u_seen : none, v = in_view ? v_seen : none;
        // The pixel before, or at the image's rim the last one but one: half a pixel beyond is as between these.
        const I u_last = width - 2, v_last = height - 2, u_before = truncate(u), v_before = truncate(v);
        const I u0 = u_before < u_last ? u_before : u_last, v0 = v_before < v_last ? v_before : v_last;
        const I first_pixel = v0 * width + u0;
        V a, b, c, e, given = one;
        I above = 0, below = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            const size_t image = (size_t)frame_at(lane) * height * width;
            const auto *depths = depth.data + image + lanes_of(first_pixel)[lane];
            if (STEPS) {
                lanes_of(above)[lane] = (unsigned int)depths[0] | (unsigned int)depths[1] << 16;
                lanes_of(below)[lane] = (unsigned int)depths[width] | (unsigned int)depths[width + 1] << 16;
            } else {
                lanes_of(a)[lane] = (float)depths[0];
                lanes_of(b)[lane] = (float)depths[1];
                lanes_of(c)[lane] = (float)depths[width];
                lanes_of(e)[lane] = (float)depths[width + 1];
            }
            if (WEIGHTED) {
                const int column = (int)(lanes_of(u)[lane] + 0.5f), row = (int)(lanes_of(v)[lane] + 0.5f);
                lanes_of(given)[lane] = pixel_weights.data[image + (size_t)row * width + column];
            }
        }
        if (STEPS) {
            a = to_floats(above & 0xffff), b = to_floats((above >> 16) & 0xffff);
            c = to_floats(below & 0xffff), e = to_floats((below >> 16) & 0xffff);
        }
        const V du = u - to_floats(u0), dv = v - to_floats(v0), u_off = u - cx, v_off = v - cy;
        const V low_ab = a < b ? a : b, low_ce = c < e ? c : e, low = low_ab < low_ce ? low_ab : low_ce;
        const V high_ab = a > b ? a : b, high_ce = c > e ? c : e, high = high_ab > high_ce ? high_ab : high_ce;
        const auto one_surface = in_view & (low > none) & (high - low <= (V)most_step);
        const V q_a = one / (one_surface ? a : one), q_b = one / (one_surface ? b : one);
        const V q_c = one / (one_surface ? c : one), q_e = one / (one_surface ? e : one);
        const V across_top = q_b - q_a, across_bottom = q_e - q_c;
        const V top = q_a + du * across_top, q_v = q_c + du * across_bottom - top;
        const V q_u = across_top + dv * (across_bottom - across_top), q = top + dv * q_v;
        // Inverse depth is n·ray, and so the plane n·X = 1.
        const V n_x = fx * q_u, n_y = fy * q_v, n_z = q - u_off * q_u - v_off * q_v;
        const V n_n = n_x * n_x + n_y * n_y + n_z * n_z, before = one - z_point * (1.0f / depth_scale) * q;
        distance = voxels_a_step * before / root(n_n);
        const auto says = one_surface & (before >= -most_step * q);
        weight = says ? given * (q * q) * (q * q) / n_n : none;
    };
"""
)
"""C++ for a native function, after ``declared``: takes a point ``x``, ``y``, ``z`` and members of ``DepthViews``."""


def declared(depth_type: type, *, weighted: bool) -> str:
    """Return the C++ that says what ``LOOK_IN_CPP`` is made for."""
    steps = str(depth_type is wp.uint16).lower()
    return f"constexpr bool STEPS = {steps}, WEIGHTED = {str(weighted).lower()};\n"


@cache
def views_type(depth_type: type) -> Any:
    """Return the struct of all frames for depth of a type, uint16 or float32."""

    @wp.struct
    class DepthViews:
        """The frames of all batches, as in ``FrameBatch``, and ``fx, fy, cx, cy``; lengths are metres.

        ``projections`` (12, frames rounded up to lanes) have a column for each frame, the rows of the 3×4 matrix from
        the lattice to (u·z, v·z, z), and zeros beyond; ``centers`` (frames,) are the cameras', on the lattice.
        """

        depth: wp.array3d(dtype=depth_type)
        pixel_weights: wp.array3d(dtype=float)
        depth_scale: float
        intrinsics: wp.vec4
        projections: wp.array2d(dtype=float)
        centers: wp.array(dtype=wp.vec3)
        truncation: float
        voxel_size: float

    return DepthViews
