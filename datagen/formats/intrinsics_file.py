"""``camera-intrinsics.txt``: a 3×3 camera matrix beside recordings whose format has no place for one."""

from pathlib import Path

import numpy as np

from datagen.atomic_write import write_bytes
from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.formats.text_table import read_rows

INTRINSICS_FILE = "camera-intrinsics.txt"
EXPECTED = "a 3×3 intrinsic matrix [fx 0 cx; 0 fy cy; 0 0 1], integer pixel centres"


def read_intrinsics(path: Path, *, size: tuple[int, int]) -> PinholeCamera:
    """Return the camera of a 3×3 matrix for images of ``size`` (width, height); raises InputError for anything else."""
    rows = read_rows(path)
    for row in rows:
        if len(row.fields) != 3:
            raise row.error(f"found {len(row.fields)} numbers, expected {EXPECTED}")
    if len(rows) != 3:
        raise InputError(f"{path}: found {len(rows)} rows, expected {EXPECTED}")
    matrix = np.stack([row.numbers(row.fields, EXPECTED) for row in rows])
    return camera_from_matrix(matrix, size=size, source=str(path))


def camera_from_matrix(matrix: np.ndarray, *, size: tuple[int, int], source: str) -> PinholeCamera:
    """Return the camera of an intrinsic matrix (3, 3), integer pixel centres; ``source`` begins errors."""
    if matrix[0, 1] != 0 or matrix[1, 0] != 0 or (matrix[2] != (0, 0, 1)).any():
        raise InputError(f"{source}: expected {EXPECTED}, found {matrix.tolist()}")
    try:
        return PinholeCamera(
            width=size[0],
            height=size[1],
            fx=float(matrix[0, 0]),
            fy=float(matrix[1, 1]),
            cx=float(matrix[0, 2]),
            cy=float(matrix[1, 2]),
        )
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def write_intrinsics(path: Path, camera: PinholeCamera) -> None:
    """Write a camera's 3×3 matrix atomically, with the digits that bring every bit back."""
    rows = ((camera.fx, 0.0, camera.cx), (0.0, camera.fy, camera.cy), (0.0, 0.0, 1.0))
    write_bytes(path, "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows).encode())
