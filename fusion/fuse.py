"""From frames to a volume: find all blocks, allocate them once, integrate batch by batch."""

from collections.abc import Iterator

from datagen.progress import ProgressReporter
from fusion.block_table import BlockLimitError
from fusion.depth_tiles import depth_tiles
from fusion.devices import Device
from fusion.find_blocks import find_blocks
from fusion.frame_batch import MAX_BATCH, FrameBatch, FrameUploader
from fusion.frame_source import FrameSource
from fusion.integrate import integrate_frames
from fusion.integration import Integration
from fusion.reconstruction_config import Lengths
from fusion.stopwatch import Stopwatch
from fusion.survey import SceneSurvey
from fusion.visible_blocks import visible_blocks
from fusion.volume import Volume
from fusion.volume_memory import block_budget, is_hopeless, too_large
from fusion.voxels import Storage


def fuse(
    source: FrameSource,
    survey: SceneSurvey,
    lengths: Lengths,
    *,
    device: Device,
    storage: Storage,
    clock: Stopwatch,
    progress: ProgressReporter,
) -> Volume:
    """Integrate all frames of ``source``; its time goes to the clock's stage "integrate".

    Every block exists before the first frame is integrated, so each frame has its say in each block that it sees,
    whatever their order. Raises InputError where the volume does not fit into memory, before it is allocated.
    """
    upload = FrameUploader(
        source.dataset.camera,
        device=device,
        capacity=min(len(source.frame_ids), MAX_BATCH),
        depth_scale=source.dataset.depth_scale,
    )

    def depth_batches() -> Iterator[FrameBatch]:
        for frame_ids in source.batches():
            yield upload(source.depths(frame_ids), [source.poses[i] for i in frame_ids])

    if is_hopeless(survey, lengths, device=device, storage=storage):
        raise too_large(depth_batches, survey, lengths, device=device, storage=storage)
    volume = Volume(
        voxel_size=lengths.voxel_size,
        truncation=lengths.truncation,
        device=device,
        max_blocks=block_budget(device, storage),
        storage=storage,
    )
    try:
        _find_all_blocks(volume, depth_batches(), len(source.frame_ids), clock, progress)
    except BlockLimitError:
        raise too_large(depth_batches, survey, lengths, device=device, storage=storage) from None
    volume.table.sort()
    volume.reserve(volume.table.count)
    advance = progress("integrate", len(source.frame_ids))
    for frame_ids in source.batches():
        depths, colors = source.depths(frame_ids), source.colors(frame_ids)
        with clock("integrate"):
            batch = upload(depths, [source.poses[i] for i in frame_ids], colors)
            tiles = depth_tiles(batch, split_beyond=2 * volume.truncation)
            integrate_frames(volume, batch, visible_blocks(volume, batch, tiles), Integration())
        for _ in frame_ids:
            advance()
    return volume


def _find_all_blocks(
    volume: Volume, batches: Iterator[FrameBatch], total: int, clock: Stopwatch, progress: ProgressReporter
) -> None:
    """Run the allocation pass over all frames; no voxel is allocated yet."""
    advance = progress("allocate", total)
    for batch in batches:
        with clock("integrate"):
            tiles = depth_tiles(batch, split_beyond=2 * volume.truncation)
            find_blocks(volume.table, batch, tiles, truncation=volume.truncation, voxel_size=volume.voxel_size)
        for _ in range(len(batch)):
            advance()
