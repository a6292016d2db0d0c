"""How voxels side by side take in the frames that see them: the paper's equations (1) to (5), in C++.

The same C++ for both devices: on the CPU LANES voxels of a row, in loops that its compiler turns into vector
instructions, on CUDA one voxel a thread. FRAMES frames are gone through at a time. The CPU waits for memory more than
it computes, so all frames' pixels are found and asked for first; then their depths are looked at, and the colours of
those near the surface are asked for; then these are added up.

Names as in the paper: d by (1), t_d by (2); (3) to (5) are sums here, and averages where the volume is read. BILINEAR,
WEIGHTED and DROP_OFF are constants of the compiler, so that what is not asked for costs nothing. `left` runs through
the mask's bits, the frames.
"""

from fusion.integration.slanted_surface import CONTINUES_IN_CPP
from fusion.volume.voxels import PACKING_IN_CPP

_BEGIN_IN_CPP = """
#ifdef __CUDA_ARCH__
    auto first_bit = [](unsigned int bits) { return __ffs(bits) - 1; };
    auto ask_for = [](const void *) {};
    auto add_color = [](float *shade, float weight, unsigned int rgb) {
        for (int channel = 0; channel < 3; ++channel) shade[channel] += weight * (float)(rgb >> 8 * channel & 255u);
        shade[3] += weight;
    };
#else
    auto first_bit = [](unsigned int bits) { return __builtin_ctz(bits); };
    auto ask_for = [](const void *address) { __builtin_prefetch(address); };
    // Four bytes as one vector: red, green, blue, and 1 for the weight.
    typedef unsigned char Bytes __attribute__((ext_vector_type(4)));
    typedef float Floats __attribute__((ext_vector_type(4)));
    auto add_color = [](float *shade, float weight, unsigned int rgb) {
        const unsigned int and_one = (rgb & 0xffffffu) | 0x1000000u;
        Bytes bytes;
        Floats sum;
        memcpy(&bytes, &and_one, sizeof bytes);
        memcpy(&sum, shade, sizeof sum);
        sum += weight * __builtin_convertvector(bytes, Floats);
        memcpy(shade, &sum, sizeof sum);
    };
#endif
    constexpr float FAR = 3.0e38f;
    const int height = frames.depth.shape[1], width = frames.depth.shape[2];
    const int tile_stride = frames.confidence.shape[2];
    const size_t size = (size_t)height * width, tiles_size = (size_t)frames.confidence.shape[1] * tile_stride;
    const float bottom = (float)height, right = (float)width, truncation = rules.truncation;
    float distances[LANES] = {0}, weights[LANES] = {0}, shades[LANES][4] = {{0}};  // red, green, blue, and their weight
    for (unsigned int left = frame_mask; left != 0;) {
        int count = 0, numbers[FRAMES], pixels[FRAMES][LANES], spots[FRAMES][LANES];
        float us[FRAMES][LANES], vs[FRAMES][LANES], zs[FRAMES][LANES];
        unsigned int near_count = 0, nears[FRAMES * LANES];
        float near_weights[FRAMES * LANES];
"""

# Where is each voxel in each frame: in which pixel, and at which bit of the tiles of `confidence`? A lane outside the
# image reads its first pixel, and lies behind anything.
_PROJECT_IN_CPP = """
        for (; left != 0 && count < FRAMES; left &= left - 1, ++count) {
            const int frame = numbers[count] = first_bit(left);
            const wp::mat44 &p = frames.pixel_from_lattice.data[frame];
            const float uz = p.data[0][0] * x + p.data[0][1] * y + p.data[0][2] * z + p.data[0][3];
            const float vz = p.data[1][0] * x + p.data[1][1] * y + p.data[1][2] * z + p.data[1][3];
            const float z0 = p.data[2][0] * x + p.data[2][1] * y + p.data[2][2] * z + p.data[2][3];
            for (int i = 0; i < LANES; ++i) {
                const float z_voxel = z0 + i * p.data[2][0], inverse = 1.0f / z_voxel;
                // Shifted by half a pixel, truncation rounds to the nearest pixel centre.
                const float u = (uz + i * p.data[0][0]) * inverse + 0.5f;
                const float v = (vz + i * p.data[1][0]) * inverse + 0.5f;
                const bool inside = (z_voxel > 0.0f) & (u >= 0.0f) & (v >= 0.0f) & (u < right) & (v < bottom);
                us[count][i] = inside ? u : 0.5f;
                vs[count][i] = inside ? v : 0.5f;
                zs[count][i] = inside ? z_voxel : FAR;
                const int pixel_u = (int)us[count][i], pixel_v = (int)vs[count][i];
                pixels[count][i] = pixel_v * width + pixel_u;
                spots[count][i] = 8 * ((pixel_v >> 3) * tile_stride + (pixel_u & ~7) + (pixel_v & 7))
                                           + (pixel_u & 7);
            }
            for (int i = 0; i < LANES; ++i) ask_for(frames.depth.data + frame * size + pixels[count][i]);
        }
"""

# What does each frame say about each voxel? Those near its surface are put down for their colours.
_MEASURE_IN_CPP = """
        for (int k = 0; k < count; ++k) {
            const size_t image = numbers[k] * size;
            const auto *depths = frames.depth.data + image;
            float d[LANES], w_new[LANES];
            int seen[LANES];
            unsigned int slanted = 0;
            for (int i = 0; i < LANES; ++i) {
                const float z_pixel = frames.depth_scale * (float)depths[pixels[k][i]];
                d[i] = z_pixel - zs[k][i];
                seen[i] = (z_pixel > 0.0f) & (d[i] >= (BILINEAR ? -2.0f : -1.0f) * truncation);
            }
            if (BILINEAR) {
                int any_seen = 0;
                for (int i = 0; i < LANES; ++i) any_seen |= seen[i];
                if (!any_seen) continue;
                for (int i = 0; i < LANES; ++i) {
                    const float au = us[k][i] + 0.5f, av = vs[k][i] + 0.5f;
                    const int u1 = (int)au, v1 = (int)av;  // the pixel after the one before
                    const float du = au - u1, dv = av - v1;
                    const int left_u = u1 > 0 ? u1 - 1 : 0, right_u = u1 < width ? u1 : width - 1;
                    const int upper = (v1 > 0 ? v1 - 1 : 0) * width, lower = (v1 < height ? v1 : height - 1) * width;
                    const float a = (float)depths[upper + left_u], b = (float)depths[upper + right_u];
                    const float c = (float)depths[lower + left_u], e = (float)depths[lower + right_u];
                    const float low_ab = a < b ? a : b, low_ce = c < e ? c : e, low = low_ab < low_ce ? low_ab : low_ce;
                    const float high_ab = a > b ? a : b, high_ce = c > e ? c : e;
                    const float high = high_ab > high_ce ? high_ab : high_ce;
                    seen[i] &= low > 0.0f;
                    const float inverse = (1.0f - dv) * ((1.0f - du) / a + du / b) + dv * ((1.0f - du) / c + du / e);
                    d[i] = seen[i] ? frames.depth_scale / inverse - zs[k][i] : 0.0f;
                    seen[i] &= d[i] >= -truncation;
                    slanted |= (unsigned int)(seen[i] & ((high - low) * frames.depth_scale > truncation)) << i;
                }
                for (unsigned int some = slanted; some != 0; some &= some - 1) {
                    const int i = first_bit(some);
                    seen[i] = is_one_surface(depths, (int)(us[k][i] + 0.5f), (int)(vs[k][i] + 0.5f));
                }
            }
            unsigned int near_lanes = 0;
            for (int i = 0; i < LANES; ++i) {
                const float ratio = d[i] / truncation;
                const float t_d = ratio < 1.0f ? ratio : 1.0f;
                float w = WEIGHTED ? frames.pixel_weights.data[image + pixels[k][i]] : 1.0f;
                if (DROP_OFF) w *= t_d < 0.0f ? 1.0f + t_d : 1.0f;
                if (BILINEAR) w *= slanted >> i & 1 ? FAINT : 1.0f;
                w_new[i] = seen[i] ? w : 0.0f;
                distances[i] += seen[i] ? w_new[i] * t_d : 0.0f;
                weights[i] += w_new[i];
                near_lanes |= (unsigned int)(seen[i] & (d[i] <= truncation)) << i;
            }
            for (; near_lanes != 0; near_lanes &= near_lanes - 1, ++near_count) {
                const int i = first_bit(near_lanes);
                nears[near_count] = k * LANES + i;
                near_weights[near_count] = w_new[i];
                ask_for(frames.color.data + 3 * (image + pixels[k][i]));
            }
        }
"""

# A colour's three bytes are read as the last of four, as there is no fourth one after the last image's; but for the
# very first colour, before which there is none.
_COLOR_IN_CPP = """
        for (unsigned int near = 0; near < near_count; ++near) {
            const unsigned int at = nears[near], k = at / LANES, i = at % LANES, spot = spots[k][i];
            const size_t number = numbers[k], pixel = number * size + pixels[k][i];
            const bool trusted = frames.confidence.data[number * tiles_size + (spot >> 3)] >> (spot & 7u) & 1;
            unsigned int rgb;
            if (pixel > 0) {
                memcpy(&rgb, frames.color.data + 3 * pixel - 1, sizeof rgb);
                rgb >>= 8;
            } else {
                memcpy(&rgb, frames.color.data, sizeof rgb);
            }
            add_color(shades[i], near_weights[near] * (trusted ? 1.0f : 1.0f / 255.0f), rgb);
        }
    }
"""

# Read, add, write: as loops of their own, for the sake of vector instructions.
_ADD_IN_CPP = """
    float distance[LANES], weight[LANES], red[LANES], green[LANES], blue[LANES], color_weight[LANES];
    const bool packed = voxels.packed.shape[0] > 0;
    if (packed) {
        for (int i = 0; i < LANES; ++i) {
            const unsigned long long bits = voxels.packed.data[voxel + i];
            const unsigned int low = (unsigned int)bits, high = (unsigned int)(bits >> 32);
            weight[i] = weight_of_bits(low >> 16);
            distance[i] = weight[i] * (float)(short)(low & 0xffffu) * (1.0f / 32767.0f);
            color_weight[i] = weight[i] * (float)(high >> 24) * (1.0f / 255.0f);
            red[i] = color_weight[i] * (float)(high & 255u);
            green[i] = color_weight[i] * (float)((high >> 8) & 255u);
            blue[i] = color_weight[i] * (float)((high >> 16) & 255u);
        }
    } else {
        for (int i = 0; i < LANES; ++i) {
            distance[i] = voxels.distance_sum.data[voxel + i];
            weight[i] = voxels.weight.data[voxel + i];
            color_weight[i] = voxels.color_weight.data[voxel + i];
            red[i] = voxels.color_sum.data[voxel + i].c[0];
            green[i] = voxels.color_sum.data[voxel + i].c[1];
            blue[i] = voxels.color_sum.data[voxel + i].c[2];
        }
    }
    for (int i = 0; i < LANES; ++i) {
        const float sum = weight[i] + rules.sign * weights[i];
        const float color_sum = color_weight[i] + rules.sign * shades[i][3];
        // What rounding leaves of a weight that was taken away is nothing; above the cap, all sums shrink alike.
        const float capped = sum > rules.weight_cap ? rules.weight_cap / sum : 1.0f;
        const float kept = sum < 1e-4f * weight[i] ? 0.0f : capped;
        const float kept_color = color_sum < 1e-4f * color_weight[i] ? 0.0f : kept;
        weight[i] = kept * sum;
        distance[i] = kept * (distance[i] + rules.sign * distances[i]);
        color_weight[i] = kept_color * color_sum;
        red[i] = kept_color * (red[i] + rules.sign * shades[i][0]);
        green[i] = kept_color * (green[i] + rules.sign * shades[i][1]);
        blue[i] = kept_color * (blue[i] + rules.sign * shades[i][2]);
    }
    if (packed) {
        for (int i = 0; i < LANES; ++i) {
            const unsigned long long bits = pack_voxel(
                voxel + i, distance[i], weight[i], red[i], green[i], blue[i], color_weight[i]);
            // Untouched voxels are not rounded again.
            voxels.packed.data[voxel + i] = weights[i] != 0.0f ? bits : voxels.packed.data[voxel + i];
        }
    } else {
        for (int i = 0; i < LANES; ++i) {
            voxels.distance_sum.data[voxel + i] = distance[i];
            voxels.weight.data[voxel + i] = weight[i];
            voxels.color_weight.data[voxel + i] = color_weight[i];
            voxels.color_sum.data[voxel + i] = wp::vec3(red[i], green[i], blue[i]);
        }
    }
"""

INTEGRATE_IN_CPP = "".join(
    (PACKING_IN_CPP, _BEGIN_IN_CPP, CONTINUES_IN_CPP, _PROJECT_IN_CPP, _MEASURE_IN_CPP, _COLOR_IN_CPP, _ADD_IN_CPP)
)
"""Adds frames to, or takes them away from, LANES voxels; constants and arguments are those of ``voxel_kernel``."""
