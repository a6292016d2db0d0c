"""The point that is nearest to several planes: a quadratic error function, minimised within a cell.

In C++, for its local arrays: this is most of the work of dual contouring.
"""

INSET = 1e-3
"""How far, in voxels, vertices keep from the border of their cell, face or edge: sheets never touch there."""

REGULARISATION = 0.003
"""How much the centroid of the points counts, a plane: it decides where the planes leave a direction open."""

SWEEPS = 24

QEF_IN_CPP = (
    f"constexpr float LOWEST = {INSET}f, HIGHEST = 1.0f - {INSET}f, WEIGHT = {REGULARISATION}f;\n"
    f"constexpr int SWEEPS = {SWEEPS};\n"
    """
    auto within = [](float x) { return x < LOWEST ? LOWEST : x > HIGHEST ? HIGHEST : x; };
    // Planes in voxels from the cell's lowest corner: with normals n and points p the sums of n n^T / n.n, of
    // n (n.p) / n.n, of n, and of p.
    struct Planes {
        float xx = 0.0f, xy = 0.0f, xz = 0.0f, yy = 0.0f, yz = 0.0f, zz = 0.0f;
        float offset[3] = {0.0f}, normal[3] = {0.0f}, points[3] = {0.0f}, planes = 0.0f, count = 0.0f;
    };
    auto add_plane = [](Planes &all, const float *p, float x, float y, float z) {
        for (int i = 0; i < 3; ++i) all.points[i] += p[i];
        all.count += 1.0f;
        const float size = x * x + y * y + z * z;
        if (!(size > 0.0f)) return;
        const float inverse = 1.0f / size, ux = inverse * x, uy = inverse * y, uz = inverse * z;
        const float along = x * p[0] + y * p[1] + z * p[2];
        all.xx += x * ux; all.xy += x * uy; all.xz += x * uz;
        all.yy += y * uy; all.yz += y * uz; all.zz += z * uz;
        all.offset[0] += along * ux; all.offset[1] += along * uy; all.offset[2] += along * uz;
        all.normal[0] += x; all.normal[1] += y; all.normal[2] += z;
        all.planes += 1.0f;
    };
    // The point in the cell with the least sum of squared distances to the planes, near the points' centroid.
    auto nearest_to_planes = [&](const Planes &all, float *best) {
        const float weight = WEIGHT * (all.planes + 1.0f), share = weight / all.count;
        const float xx = all.xx + weight, yy = all.yy + weight, zz = all.zz + weight;
        const float xy = all.xy, xz = all.xz, yz = all.yz;
        float right[3];
        for (int i = 0; i < 3; ++i) right[i] = all.offset[i] + share * all.points[i];
        const float cxx = yy * zz - yz * yz, cxy = xz * yz - xy * zz, cxz = xy * yz - xz * yy;
        const float cyy = xx * zz - xz * xz, cyz = xy * xz - xx * yz, czz = xx * yy - xy * xy;
        const float inverse = 1.0f / (xx * cxx + xy * cxy + xz * cxz);
        best[0] = inverse * (cxx * right[0] + cxy * right[1] + cxz * right[2]);
        best[1] = inverse * (cxy * right[0] + cyy * right[1] + cyz * right[2]);
        best[2] = inverse * (cxz * right[0] + cyz * right[1] + czz * right[2]);
        bool inside = true;
        for (int i = 0; i < 3; ++i) inside &= best[i] >= LOWEST && best[i] <= HIGHEST;
        if (inside) return;
        for (int i = 0; i < 3; ++i) best[i] = within(best[i]);
        // The minimum over a box, a coordinate at a time.
        for (int sweep = 0; sweep < SWEEPS; ++sweep) {
            const float x = within((right[0] - xy * best[1] - xz * best[2]) / xx);
            const float y = within((right[1] - xy * x - yz * best[2]) / yy);
            const float z = within((right[2] - xz * x - yz * y) / zz);
            const float dx = x - best[0], dy = y - best[1], dz = z - best[2];
            best[0] = x; best[1] = y; best[2] = z;
            if (dx * dx + dy * dy + dz * dz < 1e-10f) return;
        }
    };
"""
)
"""C++ for the top of a native function: ``Planes``, ``add_plane`` and ``nearest_to_planes``."""
