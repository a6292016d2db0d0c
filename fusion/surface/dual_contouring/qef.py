"""The point that is nearest to several planes: a quadratic error function, minimised within a cell.

In C++, for several cells at once: this is most of the work of dual contouring.
"""

REGULARISATION = 0.003
"""How much the centroid of the points counts, a plane: it decides where the planes leave a direction open."""

SWEEPS = 24

QEF_IN_CPP = (
    f"const float LOWEST = inset, HIGHEST = 1.0f - inset; constexpr float WEIGHT = {REGULARISATION}f;\n"
    f"constexpr int SWEEPS = {SWEEPS};\n"
    """
    // Planes in voxels from the cell's lowest corner: with normals n and points p the sums of n n^T / n.n, of
    // n (n.p) / n.n, of n, and of p.
    struct Planes {
        V xx = 0.0f, xy = 0.0f, xz = 0.0f, yy = 0.0f, yz = 0.0f, zz = 0.0f;
        V offset[3] = {0.0f, 0.0f, 0.0f}, normal[3] = {0.0f, 0.0f, 0.0f}, points[3] = {0.0f, 0.0f, 0.0f};
        V planes = 0.0f, count = 0.0f;
    };
    // The plane through the point ``along`` the edge from corner ``low``, with a normal n; none where ``on`` is 0.
    auto add_plane = [](Planes &all, V on, int axis, int low, V along, const V *n) {
        const V none = 0.0f, one = 1.0f, size = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
        const V used = size > none ? on : none, inverse = used / (size > none ? size : one);
        const V x = inverse * n[0], y = inverse * n[1], z = inverse * n[2];
        V offset = along * n[axis];
        for (int i = 0; i < 3; ++i)
            if (i != axis && ((low >> i) & 1)) offset += n[i], all.points[i] += on;
        all.points[axis] += on * along;
        all.xx += x * n[0]; all.xy += x * n[1]; all.xz += x * n[2];
        all.yy += y * n[1]; all.yz += y * n[2]; all.zz += z * n[2];
        all.offset[0] += offset * x; all.offset[1] += offset * y; all.offset[2] += offset * z;
        for (int i = 0; i < 3; ++i) all.normal[i] += used * n[i];
        all.planes += used;
        all.count += on;
    };
    // The normal equations: the point with the least sum of squared distances to the planes, near the points' centroid.
    struct Equations { V xx, xy, xz, yy, yz, zz, right[3]; };
    auto equations_of = [](const Planes &all) {
        const V weight = WEIGHT * (all.planes + 1.0f), share = weight / all.count;
        Equations e = {all.xx + weight, all.xy, all.xz, all.yy + weight, all.yz, all.zz + weight};
        for (int i = 0; i < 3; ++i) e.right[i] = all.offset[i] + share * all.points[i];
        return e;
    };
    auto solve = [](const Equations &e, V *best) {
        const V cxx = e.yy * e.zz - e.yz * e.yz, cxy = e.xz * e.yz - e.xy * e.zz, cxz = e.xy * e.yz - e.xz * e.yy;
        const V cyy = e.xx * e.zz - e.xz * e.xz, cyz = e.xy * e.xz - e.xx * e.yz, czz = e.xx * e.yy - e.xy * e.xy;
        const V inverse = 1.0f / (e.xx * cxx + e.xy * cxy + e.xz * cxz);
        best[0] = inverse * (cxx * e.right[0] + cxy * e.right[1] + cxz * e.right[2]);
        best[1] = inverse * (cxy * e.right[0] + cyy * e.right[1] + cyz * e.right[2]);
        best[2] = inverse * (cxz * e.right[0] + cyz * e.right[1] + czz * e.right[2]);
    };
    auto within = [&](float x) { return x < LOWEST ? LOWEST : x > HIGHEST ? HIGHEST : x; };
    // A lane's minimum over the cell, a coordinate at a time, where the minimum over all space lies outside it.
    auto keep_within_cell = [&](const Equations &e, int lane, float *best) {
        bool inside = true;
        for (int i = 0; i < 3; ++i) inside &= best[i] >= LOWEST && best[i] <= HIGHEST;
        if (inside) return;
        auto of_lane = [&](const V &x) { return ((const float *)&x)[lane]; };
        const float xy = of_lane(e.xy), xz = of_lane(e.xz), yz = of_lane(e.yz);
        const float ix = 1.0f / of_lane(e.xx), iy = 1.0f / of_lane(e.yy), iz = 1.0f / of_lane(e.zz);
        const float right[3] = {of_lane(e.right[0]), of_lane(e.right[1]), of_lane(e.right[2])};
        for (int i = 0; i < 3; ++i) best[i] = within(best[i]);
        for (int sweep = 0; sweep < SWEEPS; ++sweep) {
            const float x = within(ix * (right[0] - xy * best[1] - xz * best[2]));
            const float y = within(iy * (right[1] - xy * x - yz * best[2]));
            const float z = within(iz * (right[2] - xz * x - yz * y));
            const float dx = x - best[0], dy = y - best[1], dz = z - best[2];
            best[0] = x; best[1] = y; best[2] = z;
            if (dx * dx + dy * dy + dz * dz < 1e-10f) return;
        }
    };
"""
)
"""C++ for the top of a native function with an ``inset``, after what says what ``V`` is (``lanes``)."""
