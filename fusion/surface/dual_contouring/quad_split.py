"""How a quad is cut into triangles that stay within its edge's envelope.

Between neighbouring cells' vertices v₀ … v₃ lie the tetrahedra of the edge's two ends and two successive vertices. They
make up the edge's envelope, and the envelopes of all edges fill space without overlap: what stays within its envelope
meets no other quad. A diagonal is allowed where both of its triangles do. Of two allowed ones that one is taken whose
triangles pass the edge nearer to its 1-D point, where the surface is. Where none is allowed the quad becomes a fan
around the 1-D point, which always stays within.

In the coordinates here the edge is the third axis, from 0 to 1, and the cells lie around it counter-clockwise.
"""

import warp as wp

from fusion.surface.dual_contouring.qef import INSET

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_MARGIN = wp.constant(0.5 * INSET)
_NOT_ALLOWED = wp.constant(2.0)
FAN = wp.constant(2)
"""Stands for neither diagonal."""


@wp.func
def cross_2d(a: wp.vec3, b: wp.vec3) -> float:
    """Return the cross product of the first two coordinates."""
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def passes_edge_at(start: wp.vec3, between: wp.vec3, end: wp.vec3, behind: wp.vec3) -> float:
    """Return where on the edge the triangles on the diagonal from ``start`` to ``end`` pass it.

    The diagonal passes ``between``'s side of the edge. _NOT_ALLOWED where a triangle leaves the envelope.
    """
    from_start = cross_2d(between, start)
    from_end = cross_2d(between, end)
    share = from_start / (from_start - from_end)
    q = start + share * (end - start)
    out = (q[0] * between[0] + q[1] * between[1]) / (between[0] * between[0] + between[1] * between[1])
    lowest = out * between[2]
    room = 1.0 - out
    if room <= 0.0 or q[2] < lowest + _MARGIN * room or q[2] > lowest + (1.0 - _MARGIN) * room:
        return _NOT_ALLOWED
    # The other triangle has the edge in it; barycentric coordinates of the edge.
    a = cross_2d(end, behind)
    b = cross_2d(behind, start)
    c = cross_2d(start, end)
    height = (a * start[2] + b * end[2] + c * behind[2]) / (a + b + c)
    if height < _MARGIN or height > 1.0 - _MARGIN:
        return _NOT_ALLOWED
    return height


@wp.func
def diagonal_passes_at(start: wp.vec3, second: wp.vec3, end: wp.vec3, fourth: wp.vec3) -> float:
    """Return where on the edge a quad with a diagonal from ``start`` to ``end`` passes it; _NOT_ALLOWED if outside."""
    if cross_2d(start, end) >= 0.0:
        return passes_edge_at(start, second, end, fourth)
    return passes_edge_at(end, fourth, start, second)


@wp.func
def choose_split(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, along: float) -> int:
    """Return which diagonal cuts a quad, or that it becomes a fan."""
    first = diagonal_passes_at(a, b, c, d)
    second = diagonal_passes_at(b, c, d, a)
    if first == _NOT_ALLOWED and second == _NOT_ALLOWED:
        return FAN
    if wp.abs(second - along) < wp.abs(first - along):
        return 1
    return 0
