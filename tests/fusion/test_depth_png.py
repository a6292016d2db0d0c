import struct
import zlib

import cv2
import numpy as np
import pytest

from fusion import depth_png
from fusion.depth_png import decode_depth

ALL = 65535
NONE, LEFT, ABOVE, MEAN, PAETH = range(5)


@pytest.fixture(autouse=True)
def kernel():
    depth_png.load()


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(rows, size, *, form=(16, 0, 0, 0, 0), extra=b""):
    """A PNG of rows that are filtered already: random bytes are a valid image, whatever the filters."""
    header = struct.pack(">II", *size) + bytes(form)
    data = zlib.compress(rows.tobytes())
    parts = [chunk(b"IHDR", header), extra, chunk(b"IDAT", data[:100]), chunk(b"IDAT", data[100:]), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def rows_of(size, filters, seed=0):
    width, height = size
    rows = np.random.default_rng(seed).integers(0, 256, (height, 2 * width + 1), dtype=np.uint8)
    rows[:, 0] = np.resize(filters, height)
    return rows


@pytest.mark.parametrize("size", [(64, 48), (33, 21), (8, 8), (7, 9), (1, 1), (1, 20), (20, 1), (3, 3)])
@pytest.mark.parametrize(
    "filters", [[NONE], [LEFT], [ABOVE], [MEAN], [PAETH], [PAETH, ABOVE, LEFT, PAETH, MEAN, NONE, PAETH]]
)
def test_pixels_are_those_of_the_reference_decoder(size, filters):
    data = png(rows_of(size, filters), size)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decode_depth(data, size=size, largest=ALL), expected)


SIZE = (32, 24)
ROWS = rows_of(SIZE, [PAETH])


@pytest.mark.parametrize(
    "data",
    [
        b"",
        png(ROWS, SIZE)[:-30],
        png(ROWS, SIZE)[:20],
        b"\xff\xd8" + png(ROWS, SIZE),
        png(ROWS, (24, 32)),
        png(ROWS[:-1], SIZE),
        png(rows_of(SIZE, [5]), SIZE),
        png(ROWS, SIZE, form=(8, 2, 0, 0, 0)),
        png(ROWS, SIZE, form=(16, 0, 0, 0, 1)),
        png(ROWS, SIZE, extra=chunk(b"tRNS", b"\0\0")),
        png(ROWS, SIZE).replace(zlib.compress(ROWS.tobytes())[50:60], b"0123456789"),
    ],
    ids=["empty", "cut", "header", "jpeg", "size", "rows", "filter", "rgb", "interlaced", "transparent", "damaged"],
)
def test_what_it_cannot_decode_is_left_to_others(data):
    assert decode_depth(data, size=SIZE, largest=ALL) is None


@pytest.mark.parametrize("size", [(32, 24), (33, 21), (5, 3)])
def test_pixels_that_are_too_large_become_0_and_their_neighbours_stay(size):
    data = png(rows_of(size, [PAETH, ABOVE, MEAN]), size)
    pixels = decode_depth(data, size=size, largest=ALL)
    np.testing.assert_array_equal(decode_depth(data, size=size, largest=40_000), np.where(pixels <= 40_000, pixels, 0))


def test_an_array_can_be_given_to_be_filled():
    out = np.full(SIZE[::-1], 7, np.uint16)
    assert decode_depth(png(ROWS, SIZE), size=SIZE, largest=ALL, out=out) is out
    np.testing.assert_array_equal(out, decode_depth(png(ROWS, SIZE), size=SIZE, largest=ALL))


def test_other_chunks_are_passed_over():
    data = png(ROWS, SIZE, extra=chunk(b"tEXt", b"Comment\0made by hand"))
    np.testing.assert_array_equal(
        decode_depth(data, size=SIZE, largest=ALL), decode_depth(png(ROWS, SIZE), size=SIZE, largest=ALL)
    )
