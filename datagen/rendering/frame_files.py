"""The files of a frame, and whether they are whole."""

import struct
import zlib
from pathlib import Path

from datagen.dataset import read_pose
from datagen.dataset_format import FRAMES_FOLDER, frame_file
from datagen.errors import InputError
from datagen.layers import layer_file

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
FLOW_SIGNATURE = b"PIEH"


def frame_files(folder: Path, layers: tuple[str, ...], frame: int) -> tuple[Path, ...]:
    """Return the files that make a frame of the dataset ``folder``, in the order in which they are written."""
    frames = folder / FRAMES_FOLDER
    images = (frame_file(frames, frame, part) for part in ("color.png", "depth.png"))
    return (*images, *(layer_file(folder, name, frame) for name in layers), frame_file(frames, frame, "pose.txt"))


def is_complete(files: tuple[Path, ...]) -> bool:
    """Tell whether all files of a frame are there."""
    return all(path.is_file() for path in files)


def damaged_file(files: tuple[Path, ...]) -> Path | None:
    """Return the first of a frame's files that is not whole, None if all are.

    A machine that loses its power can leave files empty, cut or full of zeros though they were renamed into place.
    Images are compared with the checksums in them and not decoded: a fraction of a millisecond a file.
    """
    return next((path for path in files if not _is_whole(path)), None)


def _is_whole(path: Path) -> bool:
    if path.suffix == ".txt":
        try:
            read_pose(path)
        except InputError:
            return False
        return True
    data = path.read_bytes()
    return _is_whole_flow(data) if path.suffix == ".flo" else _is_whole_png(data)


def _is_whole_png(data: bytes) -> bool:
    """Follow the chunks of a PNG file to its end: length, type, content, checksum of type and content."""
    if data[:8] != PNG_SIGNATURE:
        return False
    view, at = memoryview(data), 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data) or zlib.crc32(view[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return end == len(data)
        at = end
    return False


def _is_whole_flow(data: bytes) -> bool:
    """Compare a .flo file's length with the size in its header: the format has no checksum."""
    if len(data) < 12 or data[:4] != FLOW_SIGNATURE:
        return False
    width, height = struct.unpack_from("<ii", data, 4)
    return len(data) == 12 + 8 * width * height
