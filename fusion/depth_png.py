"""Depth images are 16-bit PNGs; here those are decoded in a third of the time that libpng takes.

libpng takes most of it to undo the row filters, byte by byte: each byte is predicted from its neighbours to the left
(a), above (b) and above left (c). Rows depend on the rows above, but only up to the same pixel: so eight rows are
undone together, each a pixel behind the one above, as the lanes of one vector.
"""

import struct
from collections.abc import Iterator

import numpy as np
import warp as wp
from isal import isal_zlib
from numpy.typing import NDArray

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GRAY_16_BIT = bytes((16, 0, 0, 0, 0))  # bits, gray, deflate, filters by row, not interlaced

# A pixel is two lanes, its high byte first. Filters by number: none, a, b, their mean, Paeth's: whichever of a, b, c is
# nearest to a + b − c. `a` holds the eight rows' newest pixels, so moved by one row it is the next step's b.
_UNFILTER_IN_CPP = """
#ifdef __CUDA_ARCH__
    return false;  // images are decoded on the host
#else
    constexpr int ROWS = 8;
    typedef short lanes __attribute__((vector_size(32)));
    typedef unsigned char bytes __attribute__((vector_size(16)));
    for (int first = 0; first < height; first += ROWS) {
        const int rows = height - first < ROWS ? height - first : ROWS;
        lanes by_a = {0}, by_b = {0}, by_mean = {0}, by_nearest = {0};
        const unsigned char *line[ROWS];
        for (int r = 0; r < ROWS; ++r) {
            line[r] = filtered.data + (size_t)(first + (r < rows ? r : 0)) * (2 * width + 1) + 1;
            const int filter = line[r][-1];
            if (filter > 4) return false;
            for (int lane = 2 * r; lane < 2 * r + 2; ++lane) {
                by_a[lane] = filter == 1 ? -1 : 0;
                by_b[lane] = filter == 2 ? -1 : 0;
                by_mean[lane] = filter == 3 ? -1 : 0;
                by_nearest[lane] = filter == 4 ? -1 : 0;
            }
        }
        unsigned short *out = pixels.data + (size_t)first * width;
        lanes a = {0}, c = {0};
        auto advance = [&](int step, bool whole) __attribute__((always_inline)) {
            lanes b = __builtin_shufflevector(a, a, 0, 1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13);
            const unsigned short above = first > 0 && (whole || step < width) ? (out - width)[step] : 0;
            b[0] = above >> 8;
            b[1] = above & 255;
            unsigned long long fresh[2] = {0, 0}, done[2];
            for (int r = 0; r < ROWS; ++r) {
                const int u = step - r;
                if (!whole && (u < 0 || u >= width)) continue;
                unsigned short pixel;
                __builtin_memcpy(&pixel, line[r] + 2 * u, 2);
                fresh[r >> 2] |= (unsigned long long)pixel << 16 * (r & 3);
            }
            bytes x;
            __builtin_memcpy(&x, fresh, 16);
            const lanes to_a = b - c, to_b = a - c, to_c = to_a + to_b;
            const lanes far_a = to_a < 0 ? -to_a : to_a, far_b = to_b < 0 ? -to_b : to_b;
            const lanes far_c = to_c < 0 ? -to_c : to_c;
            const lanes nearest = ((far_a <= far_b) & (far_a <= far_c)) ? a : ((far_b <= far_c) ? b : c);
            const lanes expected = (by_a & a) | (by_b & b) | (by_mean & ((a + b) >> 1)) | (by_nearest & nearest);
            a = (__builtin_convertvector(x, lanes) + expected) & 255;
            c = b;
            x = __builtin_convertvector(
                __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14), bytes);
            __builtin_memcpy(done, &x, 16);
            for (int r = 0; r < ROWS; ++r) {
                const int u = step - r;
                if (!whole && (r >= rows || u < 0 || u >= width)) continue;
                out[(size_t)r * width + u] = (unsigned short)(done[r >> 2] >> 16 * (r & 3));
            }
        };
        const int last = width + ROWS - 1;
        int step = 0;
        while (step < (rows < ROWS || width < ROWS ? last : ROWS - 1)) advance(step++, false);
        while (step < width) advance(step++, true);
        while (step < last) advance(step++, false);
        // The last row is still to be predicted from.
        const int begin = first > 0 ? -width : 0, end = (first + rows < height ? rows - 1 : rows) * width;
        for (int i = begin; i < end; ++i) out[i] = out[i] <= largest ? out[i] : 0;
    }
    return true;
#endif
"""


@wp.func_native(_UNFILTER_IN_CPP)
def undo_filters(
    filtered: wp.array(dtype=wp.uint8), height: int, width: int, largest: int, pixels: wp.array(dtype=wp.uint16)
) -> bool:
    """Fill in ``pixels`` from rows of a filter's number and two bytes a pixel; false for a filter that is none.

    Pixels above ``largest`` become 0.
    """


@wp.kernel
def _undo_filters(
    filtered: wp.array(dtype=wp.uint8),
    height: int,
    width: int,
    largest: int,
    pixels: wp.array(dtype=wp.uint16),
    succeeded: wp.array(dtype=int),
) -> None:
    succeeded[0] = int(undo_filters(filtered, height, width, largest, pixels))


def load() -> None:
    """Load the kernel, to be done before threads decode together: each would compile it."""
    wp.load_module(__name__, device="cpu")


def decode_depth(
    data: bytes, *, size: tuple[int, int], largest: int, out: NDArray[np.uint16] | None = None
) -> NDArray[np.uint16] | None:
    """Return the pixels (height, width) of a 16-bit gray PNG of ``size`` (width, height), in ``out`` if it is given.

    Those above ``largest`` become 0. None for any other image, and for damaged ones: those are for a reader that has
    the words for it.
    """
    width, height = size
    try:
        header, *chunks = _chunks(data)
        if header != (b"IHDR", struct.pack(">II", *size) + _GRAY_16_BIT) or any(kind == b"tRNS" for kind, _ in chunks):
            return None
        length = height * (2 * width + 1)
        # With a byte to spare, or the decompressor would ask for more memory to find out that it is at the end.
        filtered = isal_zlib.decompress(b"".join(part for kind, part in chunks if kind == b"IDAT"), bufsize=length + 1)
    except (struct.error, ValueError, isal_zlib.error):
        return None
    if len(filtered) != length:
        return None
    pixels, succeeded = np.empty((height, width), np.uint16) if out is None else out, np.zeros(1, np.int32)
    wp.launch(
        _undo_filters,
        dim=1,
        inputs=[_shared(np.frombuffer(filtered, dtype=np.uint8), wp.uint8), height, width, largest],
        outputs=[_shared(pixels.ravel(), wp.uint16), _shared(succeeded, wp.int32)],
        device="cpu",
    )
    return pixels if succeeded[0] else None


def _shared(array: NDArray, dtype: type) -> wp.array:
    return wp.array(array, dtype=dtype, device="cpu", copy=False)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield type and contents of a PNG's chunks up to its end; raises ValueError where it is cut, or is none."""
    if data[: len(_SIGNATURE)] != _SIGNATURE:
        raise ValueError("no PNG")
    place, kind = len(_SIGNATURE), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        place += 8 + length + 4
        if place > len(data):
            raise ValueError("cut short")
        yield kind, data[place - 4 - length : place - 4]
