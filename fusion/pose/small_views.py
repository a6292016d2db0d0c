"""Small depth images of the model, as kernels read them."""

import warp as wp

from fusion.pose.view_index import ViewIndex

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Views:
    """Depth images (n, height, width) of the model, metres, and their camera."""

    depth: wp.array3d(dtype=float)
    intrinsics: wp.vec4


def views_of(index: ViewIndex) -> Views:
    """Return an index's images."""
    views = Views()
    views.depth, views.intrinsics = index.depth, index.intrinsics
    return views


@wp.func
def pixel_at(views: Views, point: wp.vec3) -> wp.vec2i:
    """Return the row and column nearest to where a point is seen; −1 where that is outside the image."""
    if point[2] > 0.0:
        k = views.intrinsics
        u = int(wp.floor(k[0] * point[0] / point[2] + k[2] + 0.5))
        v = int(wp.floor(k[1] * point[1] / point[2] + k[3] + 0.5))
        if u >= 0 and v >= 0 and u < views.depth.shape[2] and v < views.depth.shape[1]:
            return wp.vec2i(v, u)
    return wp.vec2i(-1, -1)


@wp.func
def point_at(views: Views, view: int, v: int, u: int) -> wp.vec3:
    """Return the point that a pixel sees, in the view's frame; 0 for none."""
    k = views.intrinsics
    z = views.depth[view, v, u]
    return wp.vec3((float(u) - k[2]) / k[0] * z, (float(v) - k[3]) / k[1] * z, z)
