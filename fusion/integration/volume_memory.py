"""Whether a volume fits into memory, said before it is allocated."""

import math
from collections.abc import Callable, Iterable, Mapping

from datagen.errors import InputError
from fusion.devices import Device
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.survey import FrameSurvey
from fusion.integration.fuse_batch import find_batch_blocks
from fusion.reconstruction_config import LARGEST_LENGTH, Lengths
from fusion.volume.block_table import BLOCK_SIDE, BlockLimitError, BlockTable
from fusion.volume.memory_budget import block_budget, bytes_per_block
from fusion.volume.voxels import Storage

OUTSTANDING = 4
"""A frame that sees this many times the surface of the others is held to be at fault."""


def least_blocks(survey: FrameSurvey, lengths: Lengths) -> float:
    """Return how many blocks one frame's surface, seen as flat, touches at least.

    A plane cuts a cube of side s in at most √2 s², so an area A touches at least A / (√2 s²) blocks; and its band of
    thickness 2 t has a volume of 2 t A, which takes at least 2 t A / s³ blocks.
    """
    side = BLOCK_SIDE * lengths.voxel_size
    layers = max(1 / math.sqrt(2), 2 * lengths.truncation / side)
    return survey.surface_area * layers / side**2


def too_large(
    batches: Callable[[], Iterable[FrameBatch]],
    surveys: Mapping[int, FrameSurvey],
    lengths: Lengths,
    *,
    device: Device,
    storage: Storage,
) -> InputError:
    """Return the error for a voxel size that does not fit, with the one that does, and the frame at fault if it is one.

    That size is found by counting blocks at coarser ones. From there on their number goes at most with the inverse cube
    of the size (a band of fixed thickness), or square (one that grows with the voxels). ``batches`` yields all frames,
    each time it is called; then ``surveys`` has them all.
    """
    budget = block_budget(device, storage)
    for _ in batches():
        pass
    coarser, count = lengths, None
    while count is None and coarser.voxel_size < LARGEST_LENGTH:
        coarser = lengths.with_voxel_size(2 * coarser.voxel_size)
        if all(least_blocks(survey, coarser) <= budget for survey in surveys.values()):
            count = _count_blocks(batches(), budget, coarser, device)
    remedy = "leave far depths out with --depth-max"
    if count is not None:
        # A fifth to spare, since the law is not exact.
        power = 1 / 3 if lengths.truncation_is_given else 1 / 2
        fitting = coarser.voxel_size * (count / (0.8 * budget)) ** power
        step = 10.0 ** (math.floor(math.log10(fitting)) - 1)
        remedy = f"{math.ceil(fitting / step) * step:.3g} fits, or {remedy}"
    block_bytes = bytes_per_block(storage)
    return InputError(
        f"--voxel-size {lengths.voxel_size:g}: the volume would need more than the "
        f"{budget * block_bytes / 2**30:.1f} GiB that {device.alias} can give it; {remedy}"
        f"{_frame_at_fault(surveys, lengths, block_bytes)}"
    )


def _frame_at_fault(surveys: Mapping[int, FrameSurvey], lengths: Lengths, block_bytes: int) -> str:
    """Name the frame that sees far more surface than the others do; say nothing where none stands out."""
    by_area = sorted(surveys, key=lambda frame_id: surveys[frame_id].surface_area)
    worst, others = surveys[by_area[-1]], by_area[:-1]
    if not others or worst.surface_area < OUTSTANDING * surveys[others[len(others) // 2]].surface_area:
        return ""
    return (
        f"; frame {by_area[-1]}, whose depth reaches {worst.farthest:.3g} m, alone asks for at least "
        f"{least_blocks(worst, lengths) * block_bytes / 2**30:.2g} GiB"
    )


def _count_blocks(batches: Iterable[FrameBatch], budget: int, lengths: Lengths, device: Device) -> int | None:
    """Return how many blocks the frames touch, None where it is more than ``budget``."""
    table = BlockTable(device=device, max_blocks=budget)
    try:
        for batch in batches:
            find_batch_blocks(table, batch, truncation=lengths.truncation, voxel_size=lengths.voxel_size)
    except BlockLimitError:
        return None
    return table.count
