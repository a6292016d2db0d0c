"""Colour and depth images on disk."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes
from datagen.errors import InputError

DEPTH_INVALID_MAX = 65535
"""Kinect recordings mark a missing return with the largest value; 0 marks it everywhere."""

# OpenCV 4.10 cannot. Where it can, decoding is all that has to be done, and its threads are not called for the rest.
_READ_RGB = getattr(cv2, "IMREAD_COLOR_RGB", None)


def read_color(path: Path, *, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a colour image (height, width, 3), RGB, uint8.

    Raises InputError where the file is missing, damaged, or not of ``size`` (width, height).
    """
    image = _decode(path, _READ_RGB or cv2.IMREAD_COLOR)
    _check_size(path, image, size)
    if _READ_RGB is None:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return image.astype(np.uint8, copy=False)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of an image; raises InputError where the file is missing or damaged."""
    height, width = _decode(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def read_depth_steps(path: Path, *, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Return planar depth (height, width) in the steps of the image, uint16, 0 where invalid.

    Raises InputError where the file is missing, damaged, not a 16-bit single-channel image, or not of ``size``.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(
            f"{path}: found {image.dtype} with shape {image.shape}, expected a 16-bit image of one channel; "
            "an 8-bit preview of the depth cannot be used"
        )
    _check_size(path, image, size)
    steps = image.astype(np.uint16, copy=False)
    clear_beyond(steps, DEPTH_INVALID_MAX - 1, out=steps)
    return steps


def clear_beyond(steps: NDArray[np.generic], last: int, *, out: NDArray[np.uint16]) -> None:
    """Write depth in steps to ``out``, contiguous and of the same shape, with 0, invalid, where it is beyond ``last``.

    In one pass over both, which may be the same array: NumPy's masks take several times as long.
    """
    assert out.flags.c_contiguous, "OpenCV would write elsewhere"
    assert out.shape == steps.shape, "OpenCV would write elsewhere"
    assert out.dtype == steps.dtype == np.uint16, "steps of depth images are 16 bits"
    cv2.threshold(np.ascontiguousarray(steps), last, 0, cv2.THRESH_TOZERO_INV, dst=out)


def read_depth(path: Path, *, size: tuple[int, int], metres_per_step: float) -> NDArray[np.float32]:
    """Return planar depth (height, width) in metres, float32, 0 where invalid; errors as ``read_depth_steps``."""
    return read_depth_steps(path, size=size).astype(np.float32) * np.float32(metres_per_step)


def write_color(path: Path, color: NDArray[np.uint8]) -> None:
    """Write an RGB image (height, width, 3), uint8, atomically as PNG."""
    _encode_png(path, cv2.cvtColor(color, cv2.COLOR_RGB2BGR))


def write_depth(path: Path, depth: NDArray[np.floating], *, metres_per_step: float) -> None:
    """Write planar depth (height, width), metres, 0 = invalid, atomically as a 16-bit PNG.

    Raises InputError where a depth is negative, not finite, or too large for the scale: it is never clipped.
    """
    if not np.isfinite(depth).all() or (depth < 0).any():
        raise InputError(f"{path}: depth holds NaN, infinity or a negative value; mark invalid pixels with 0")
    steps = np.rint(np.asarray(depth, dtype=np.float64) / metres_per_step)
    if (steps >= DEPTH_INVALID_MAX).any():
        needed = float(depth.max()) / (DEPTH_INVALID_MAX - 1) * 1.05  # the message rounds it to two digits
        raise InputError(
            f"{path}: a depth of {depth.max():.3f} m does not fit 16 bits at {metres_per_step:g} m per step; "
            f"set depth_scale to {needed:.2g} or more"
        )
    write_depth_steps(path, steps.astype(np.uint16))


def write_depth_steps(path: Path, steps: NDArray[np.uint16]) -> None:
    """Write a depth image (height, width), uint16, atomically as PNG, its steps as they are."""
    _encode_png(path, steps)


def _decode(path: Path, flags: int) -> cv2.typing.MatLike:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    # A cut JPEG decodes without complaint, its rest grey: the end marker tells. A cut PNG is refused by the decoder.
    cut = data[:2] == b"\xff\xd8" and data.rstrip(b"\x00")[-2:] != b"\xff\xd9"
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and not cut else None
    if image is None:
        raise InputError(
            f"{path}: damaged or cut short ({len(data)} bytes), not a whole image; copy or render it again"
        )
    return image


def _check_size(path: Path, image: cv2.typing.MatLike, size: tuple[int, int]) -> None:
    height, width = image.shape[:2]
    if (width, height) != size:
        raise InputError(
            f"{path}: the image is {width}×{height}, the dataset's camera {size[0]}×{size[1]}; "
            "all frames of a dataset share one size"
        )


def _encode_png(path: Path, image: cv2.typing.MatLike) -> None:
    encoded, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert encoded, f"OpenCV could not encode {path}"
    write_bytes(path, data.tobytes())
