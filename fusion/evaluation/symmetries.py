"""Symmetries of a model: the rigid motions after which it looks as before."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError
from datagen.rigid import rigid

LARGEST_STEP = 0.01
"""BOP's: between neighbouring rotations of a continuous symmetry no point of the model moves farther than this share
of its diameter."""


@dataclass(frozen=True, kw_only=True)
class ContinuousSymmetry:
    """A model that looks the same turned by any angle about ``axis`` (3,) through the point ``offset`` (3,), metres."""

    axis: tuple[float, float, float]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


def symmetry_transforms(
    *,
    discrete: Sequence[ArrayLike] = (),
    continuous: Sequence[ContinuousSymmetry] = (),
    largest_step: float = LARGEST_STEP,
) -> NDArray[np.float64]:
    """Return the transforms (k, 4, 4), model_from_model, that leave a model as it is; the first is the identity.

    ``discrete`` are 4×4 matrices besides the identity. A continuous symmetry becomes ⌈π/``largest_step``⌉ rotations a
    turn: a point is at most half a diameter from the axis, and its way from one to the next at most ``largest_step``
    diameters. As BOP has it, every discrete one is followed by each of these (T. Hodaň et al., "BOP Challenge 2020 on
    6D Object Localization", ECCVW 2020, section 2.2). Raises InputError for a matrix that is not rigid, an axis of no
    length, and a step that is not between 0 and 1.
    """
    if not 0 < largest_step <= 1:
        raise InputError(f"symmetries: a step of {largest_step:g} diameters, expected more than 0 and at most 1")
    finite = [np.eye(4), *(rigid(matrix, source=f"symmetry {i}") for i, matrix in enumerate(discrete))]
    turns = [turn for symmetry in continuous for turn in _turns(symmetry, int(np.ceil(np.pi / largest_step)))]
    return np.stack([turn @ one for one in finite for turn in turns or [np.eye(4)]])


def _turns(symmetry: ContinuousSymmetry, count: int) -> list[NDArray[np.float64]]:
    axis, offset = np.asarray(symmetry.axis, float), np.asarray(symmetry.offset, float)
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise InputError("symmetries: a continuous one needs an axis that is not 0 0 0")
    result = []
    for angle in 2 * np.pi * np.arange(count) / count:
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(axis / length * angle)[0]
        turn[:3, 3] = offset - turn[:3, :3] @ offset
        result.append(turn)
    return result
