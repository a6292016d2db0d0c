"""How a quad is cut into triangles that stay within its edge's envelope.

Between neighbouring cells' vertices v₀ … v₃ lie the tetrahedra of the edge's two ends and two successive vertices. They
make up the edge's envelope, and the envelopes of all edges fill space without overlap: what stays within its envelope
meets no other quad. A diagonal is allowed where both of its triangles do. Of two allowed ones that one is taken whose
triangles pass the edge nearer to its 1-D point, where the surface is. Where none is allowed the quad becomes a fan
around the 1-D point, which always stays within.

In the coordinates here the edge is the third axis, from 0 to 1, and the cells lie around it counter-clockwise.
"""

import warp as wp

FAN = wp.constant(2)
"""Stands for neither diagonal; 0 and 1 for that from corner 0, or from corner 1."""
NOTHING = wp.constant(3)
"""Stands for no triangle, where boxes take the place of cells (``box_quads``)."""
WITHOUT_CORNER = wp.constant(4)
"""Stands for one triangle, without corner 0; for each other corner one more."""

SPLIT_IN_CPP = (
    "const float MARGIN = 0.5f * inset; constexpr float NOT_ALLOWED = 2.0f;\n"
    f"constexpr int FAN = {FAN};\n"
    """
    struct Point { V x, y, z; };
    auto cross_2d = [](const Point &a, const Point &b) { return a.x * b.y - a.y * b.x; };
    auto distance = [](V a, V b) { return a < b ? b - a : a - b; };
    // Where on the edge the triangles on the diagonal from start to end pass it, on whose side of the edge ``between``
    // is; NOT_ALLOWED where a triangle leaves the envelope.
    auto passes_edge_at = [&](const Point &start, const Point &between, const Point &end, const Point &behind) {
        const V from_start = cross_2d(between, start), from_end = cross_2d(between, end);
        const V share = from_start / (from_start - from_end);
        const V x = start.x + share * (end.x - start.x), y = start.y + share * (end.y - start.y);
        const V z = start.z + share * (end.z - start.z);
        const V out = (x * between.x + y * between.y) / (between.x * between.x + between.y * between.y);
        const V lowest = out * between.z, room = 1.0f - out;
        // The other triangle has the edge in it; barycentric coordinates of the edge.
        const V a = cross_2d(end, behind), b = cross_2d(behind, start), c = cross_2d(start, end);
        const V height = (a * start.z + b * end.z + c * behind.z) / (a + b + c);
        const auto allowed = (room > 0.0f) & (z >= lowest + MARGIN * room) & (z <= lowest + (1.0f - MARGIN) * room)
                             & (height >= MARGIN) & (height <= 1.0f - MARGIN);
        return allowed ? height : (V)NOT_ALLOWED;
    };
    auto diagonal_passes_at = [&](const Point &start, const Point &second, const Point &end, const Point &fourth) {
        const auto turned = cross_2d(start, end) < 0.0f;
        auto either = [&](const Point &a, const Point &b) {
            return Point{turned ? b.x : a.x, turned ? b.y : a.y, turned ? b.z : a.z};
        };
        return passes_edge_at(either(start, end), either(second, fourth), either(end, start), either(fourth, second));
    };
    auto choose_split = [&](const Point *corners, V along) {
        const V first = diagonal_passes_at(corners[0], corners[1], corners[2], corners[3]);
        const V second = diagonal_passes_at(corners[1], corners[2], corners[3], corners[0]);
        const V zero = 0.0f, one = 1.0f;
        const V chosen = distance(second, along) < distance(first, along) ? one : zero;
        const auto neither = (first == NOT_ALLOWED) & (second == NOT_ALLOWED);
        return neither ? (V)(float)FAN : chosen;
    };
"""
)
"""C++ for native functions with an ``inset``, after what says what ``V`` is: ``choose_split`` of four corners."""
