"""Does a surface go on from pixel to pixel, or is there an edge in depth? In C++, for the kernel of integration.

Where neighbouring pixels differ by more than the truncation, there is either an edge between two surfaces or one that
is seen almost edge-on: at 85° depth changes by 11 pixels' widths from pixel to pixel. A plane's inverse depth is linear
in the image, so a slanted surface goes on as it did beside the two pixels, or will beside them; an edge does neither.
"""

CONTINUES_IN_CPP = """
    // What a frame's word weighs where it sees a surface so slantingly: it counts where no other sees it better.
    constexpr float FAINT = 1.0f / 255.0f;
    // Four pixels with depth are of one surface if each two that are neighbours are, by one of the pixels beside them.
    auto goes_on = [&](const auto *depths, int first, int second, int step, bool has_before, bool has_after) -> bool {
        if (first == second) return true;  // beyond the image's border
        const float a = (float)depths[first], b = (float)depths[second];
        const float before = has_before ? (float)depths[first - step] : 0.0f;
        const float after = has_after ? (float)depths[second + step] : 0.0f;
        const float jump = 1.0f / b - 1.0f / a, bound = truncation / (frames.depth_scale * a * b);
        const bool as_before = before > 0.0f && fabsf(jump - (1.0f / a - 1.0f / before)) <= bound;
        return as_before || (after > 0.0f && fabsf(jump - (1.0f / after - 1.0f / b)) <= bound);
    };
    // u and v, from 0 to the image's size, are the pixel after the one before.
    auto is_one_surface = [&](const auto *depths, int u, int v) -> bool {
        const int left = u > 0 ? u - 1 : 0, right = u < width ? u : width - 1;
        const int upper = (v > 0 ? v - 1 : 0) * width, lower = (v < height ? v : height - 1) * width;
        const bool before = left > 0, after = right < width - 1;
        const bool above = upper > 0, below = lower < (height - 1) * width;
        return goes_on(depths, upper + left, upper + right, 1, before, after)
               && goes_on(depths, lower + left, lower + right, 1, before, after)
               && goes_on(depths, upper + left, lower + left, width, above, below)
               && goes_on(depths, upper + right, lower + right, width, above, below);
    };
"""
"""For within the kernel: ``is_one_surface`` tells it of four pixels, by the names that the kernel has."""
