"""From frames to a volume: find all blocks, allocate them once, integrate batch by batch."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

from datagen.progress import ProgressReporter
from fusion.devices import Device
from fusion.frames.depth_tiles import DepthTiles
from fusion.frames.frame_batch import FrameBatch, FrameUploader
from fusion.frames.frame_source import FrameSource
from fusion.frames.survey import SceneSurvey, combine
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.integration.volume_memory import least_blocks, too_large
from fusion.reconstruction_config import Lengths
from fusion.stopwatch import Stopwatch
from fusion.volume.block_table import BlockLimitError
from fusion.volume.memory_budget import block_budget
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxel_counts import UpdateCounter
from fusion.volume.voxels import Storage

WATCHED_BATCH = 8
"""Frames at a time where somebody watches the volume grow; otherwise large batches visit voxels less often."""

TILES_BYTES = 64 << 20
"""How much of what the allocation pass found out about the images is kept for integration."""


Watcher: TypeAlias = Callable[[Volume, int, int], None]
"""Is shown the volume after each batch, with the number of frames in it and of all frames."""


@dataclass(frozen=True, kw_only=True)
class Fused:
    """A volume of all frames, what they cover, and how many voxels were gone through, once a frame each."""

    volume: Volume
    survey: SceneSurvey
    voxel_updates: int


def fuse(
    source: FrameSource,
    lengths: Lengths,
    *,
    device: Device,
    storage: Storage,
    integration: Integration,
    clock: Stopwatch,
    progress: ProgressReporter,
    watch: Watcher | None = None,
) -> Fused:
    """Integrate all frames of ``source``; its time goes to the clock's stages "allocate" and "integrate".

    Every block exists before the first frame is integrated, so each frame has its say in each block that it sees,
    whatever their order. Raises InputError where no frame has a valid depth, and where the volume does not fit into
    memory, before it is allocated.
    """
    upload = FrameUploader(
        source.dataset.camera, device=device, capacity=source.batch_size, depth_scale=source.dataset.depth_scale
    )
    volume = Volume(
        voxel_size=lengths.voxel_size,
        truncation=lengths.truncation,
        device=device,
        max_blocks=block_budget(device, storage),
        storage=storage,
    )
    try:
        tiles = _find_all_blocks(volume, source, upload, lengths, clock, progress)
    except BlockLimitError:

        def depth_batches() -> Iterator[FrameBatch]:
            return (upload(frames.depths, frames.poses) for frames in source.depth_batches())

        raise too_large(depth_batches, source.surveys, lengths, device=device, storage=storage) from None
    survey = combine(list(source.surveys.values()), source.dataset.camera)
    with clock("allocate"):
        volume.table.sort()
        volume.reserve(volume.table.count)
    counter = UpdateCounter(volume)
    done, total = 0, len(source.frame_ids)
    advance = progress("integrate", total)
    for number, frames in enumerate(source.batches()):
        with clock("integrate"):
            batch = upload(frames.depths, frames.poses, frames.colors)
            known = tiles[number] if number < len(tiles) else None
            counter.add(integrate_batch(volume, batch, integration, tiles=known))
        for _ in frames.frame_ids:
            advance()
        done += len(frames.frame_ids)
        if watch is not None:
            watch(volume, done, total)
    return Fused(volume=volume, survey=survey, voxel_updates=counter.updates)


def _find_all_blocks(
    volume: Volume,
    source: FrameSource,
    upload: FrameUploader,
    lengths: Lengths,
    clock: Stopwatch,
    progress: ProgressReporter,
) -> list[DepthTiles]:
    """Run the allocation pass over all frames; no voxel is allocated yet. Returns the tiles of the first batches."""
    tiles: list[DepthTiles] = []
    advance = progress("allocate", len(source.frame_ids))
    for frames in source.depth_batches():
        with clock("allocate"):
            for frame_id in frames.frame_ids:
                if least_blocks(source.surveys[frame_id], lengths) > volume.table.max_blocks:
                    raise BlockLimitError(f"frame {frame_id} alone asks for more blocks than memory allows")
            found = find_batch_blocks(
                volume.table,
                upload(frames.depths, frames.poses),
                truncation=volume.truncation,
                voxel_size=volume.voxel_size,
            )
            if len(tiles) < TILES_BYTES // found.ranges.capacity:
                tiles.append(found)
        for _ in frames.frame_ids:
            advance()
    return tiles
