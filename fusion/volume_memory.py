"""Whether a volume fits into memory, said before it is allocated."""

import math
from collections.abc import Callable, Iterable

from datagen.errors import InputError
from fusion.block_table import BLOCK_SIDE, BLOCK_VOXELS, BlockLimitError, BlockTable
from fusion.devices import Device, free_memory
from fusion.find_blocks import find_blocks
from fusion.frame_batch import FrameBatch
from fusion.survey import SceneSurvey
from fusion.volume import BYTES_PER_BLOCK

USABLE_SHARE = 0.7
"""How much of the free memory a volume may take; meshing needs some beside it."""

INDEX_LIMIT = (1 << 31) // BLOCK_VOXELS - 1
"""Voxels are indexed by 32-bit integers."""


def block_budget(device: Device) -> int:
    """Return how many blocks a volume on ``device`` may have."""
    return min(int(USABLE_SHARE * free_memory(device) / BYTES_PER_BLOCK), INDEX_LIMIT)


def is_hopeless(survey: SceneSurvey, *, voxel_size: float, device: Device) -> bool:
    """Tell whether even one frame's surface, seen as flat, touches more blocks than fit.

    A plane cuts a cube of side s in at most √2 s², so an area A touches at least A / (√2 s²) blocks.
    """
    return survey.largest_area / (math.sqrt(2) * (BLOCK_SIDE * voxel_size) ** 2) > block_budget(device)


def too_large(
    batches: Callable[[], Iterable[FrameBatch]],
    survey: SceneSurvey,
    *,
    voxel_size: float,
    truncation: float,
    device: Device,
) -> InputError:
    """Return the error for a voxel size that does not fit, with the one that does.

    That one is found by counting blocks at coarser sizes; their number goes with the inverse square of the size, as
    they cover a surface. ``batches`` yields all frames, each time it is called.
    """
    budget = block_budget(device)
    coarser, count = voxel_size, None
    while count is None:
        coarser *= 2
        if not is_hopeless(survey, voxel_size=coarser, device=device):
            count = _count_blocks(batches(), budget, truncation * coarser / voxel_size, coarser, device)
    # A fifth to spare, since the law is not exact.
    fitting = coarser * math.sqrt(count / (0.8 * budget))
    step = 10.0 ** (math.floor(math.log10(fitting)) - 1)
    return InputError(
        f"--voxel-size {voxel_size:g}: the volume would need more than the {budget * BYTES_PER_BLOCK / 2**30:.1f} GiB "
        f"that {device.alias} can give it; {math.ceil(fitting / step) * step:.3g} fits, "
        "or leave far depths out with --depth-max"
    )


def _count_blocks(
    batches: Iterable[FrameBatch], budget: int, truncation: float, voxel_size: float, device: Device
) -> int | None:
    """Return how many blocks the frames touch, None where it is more than ``budget``."""
    table = BlockTable(device=device, max_blocks=budget)
    try:
        for batch in batches:
            find_blocks(table, batch, truncation=truncation, voxel_size=voxel_size)
    except BlockLimitError:
        return None
    return table.count
