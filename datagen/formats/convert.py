"""Converting a dataset into another format, without loss where the format can carry what there is."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import require_writable, write_bytes
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat, OutputFrame
from datagen.formats.unfinished import begin, finish
from datagen.frame_selection import select_frames
from datagen.images import DEPTH_INVALID_MAX, write_color, write_depth_steps
from datagen.progress import ProgressReporter, silent

NOMINAL_FRAMES_PER_SECOND = 30.0
SAME_SCALE = 1e-9
"""Relative difference between depth scales that only rounding makes, for instance that of metres to millimetres."""


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What was written: how many frames, what became of the images, what the format could not carry, what to know."""

    folder: Path
    frames: int
    color: str
    depth: str
    lost: tuple[str, ...]
    advice: tuple[str, ...]


def convert_dataset(
    source: Dataset,
    folder: Path,
    target: DatasetFormat,
    *,
    frames: str | None = None,
    depth_scale: float | None = None,
    progress: ProgressReporter = silent,
) -> Converted:
    """Write ``source`` into ``folder`` in the format ``target``; a conversion that was interrupted goes on.

    Depth steps stay as they are where the format can say the source's scale; else, or with ``depth_scale`` (metres a
    step), they are rounded to the new one. ``frames`` is START:STOP:STEP. Raises InputError where ``folder`` holds
    anything else, a frame is incomplete or damaged, or a depth does not fit.
    """
    chosen = select_frames(source.frame_ids, frames)
    source.require(chosen)
    scale = _depth_scale(source, target, depth_scale)
    require_writable(folder)
    conversion = Conversion(
        folder=folder,
        source=source,
        frames=_planned(source, chosen, folder, target),
        depth_scale=scale,
    )
    job = {
        "source": str(source.folder.resolve()),
        "format": target.name,
        "frames": frames or "all",
        "frame_count": len(chosen),
        "depth_scale": scale,
    }
    begin(folder, job)
    _write_images(conversion, progress)
    target.write_index(conversion)
    finish(folder)
    return Converted(
        folder=folder,
        frames=len(chosen),
        color=_color_change(conversion),
        depth=_depth_change(source.depth_scale, scale),
        lost=_lost(conversion, target),
        advice=(*_invented(conversion, target), *target.advice(conversion)),
    )


def _depth_scale(source: Dataset, target: DatasetFormat, wanted: float | None) -> float:
    fixed = target.depth_scale
    if wanted is None:
        return source.depth_scale if fixed is None else fixed
    if not 0 < wanted < math.inf:
        raise InputError(f"--depth-scale {wanted:g}: expected metres a step, more than 0")
    if fixed is not None and not math.isclose(wanted, fixed, rel_tol=SAME_SCALE):
        raise InputError(
            f"--depth-scale {wanted:g}: {target.title} has {fixed:g} m a step, always; leave the option out"
        )
    return wanted


def _planned(source: Dataset, chosen: tuple[int, ...], folder: Path, target: DatasetFormat) -> tuple[OutputFrame, ...]:
    """Return the frames to write; raises InputError for a pose that cannot be used, and for two images of one name."""
    planned: list[OutputFrame] = []
    owner: dict[str, int] = {}
    for position, frame_id in enumerate(chosen):
        number = frame_id if "frame numbers" in target.carries else position
        time = source.timestamp_s(frame_id)
        timestamp_s = frame_id / NOMINAL_FRAMES_PER_SECOND if time is None else time
        color, depth = target.image_names(number, timestamp_s)
        if owner.setdefault(depth, frame_id) != frame_id:
            raise InputError(
                f"{source.folder}: frames {owner[depth]} and {frame_id} would both be {depth}; their times are the same"
            )
        suffix = source.color_file(frame_id).suffix.lower()
        planned.append(
            OutputFrame(
                frame_id=frame_id,
                number=number,
                color=folder / f"{color}{suffix if suffix in target.color_suffixes else '.png'}",
                depth=folder / depth,
                world_from_camera=source.world_from_camera(frame_id),
                timestamp_s=timestamp_s,
            )
        )
    return tuple(planned)


def _write_images(conversion: Conversion, progress: ProgressReporter) -> None:
    """Write all images that are not there yet, on all cores."""
    advance = progress("Converting", len(conversion.frames))
    with ThreadPoolExecutor(thread_name_prefix="convert") as pool:
        work = [pool.submit(_write_frame, frame, conversion) for frame in conversion.frames]
        try:
            for future in work:
                future.result()
                advance()
        finally:
            pool.shutdown(cancel_futures=True)


def _write_frame(frame: OutputFrame, conversion: Conversion) -> None:
    source = conversion.source
    path, place = source.color_file(frame.frame_id), source.depth_file(frame.frame_id)
    if _is_newer(frame.color, path) and _is_newer(frame.depth, place):
        return
    color = source.color(frame.frame_id)  # decoded in any case: what is damaged is not copied
    if path.suffix.lower() == frame.color.suffix:
        write_bytes(frame.color, path.read_bytes())
    else:
        write_color(frame.color, color)
    steps = source.depth_steps(frame.frame_id)
    write_depth_steps(frame.depth, rescaled(steps, source.depth_scale, conversion.depth_scale, source=str(place)))


def _is_newer(written: Path, origin: Path) -> bool:
    """Tell whether a file is there and was written after its origin; an origin that changed since is taken anew."""
    return written.is_file() and written.stat().st_mtime_ns >= origin.stat().st_mtime_ns


def rescaled(steps: NDArray[np.uint16], from_scale: float, to_scale: float, *, source: str) -> NDArray[np.uint16]:
    """Return a depth image in steps of ``to_scale`` metres, rounded to the nearest; 0 stays 0.

    Raises InputError, beginning with ``source``, where a depth is too large for 16 bits or would become 0.
    """
    if math.isclose(from_scale, to_scale, rel_tol=SAME_SCALE):
        return steps
    result = np.rint(steps * (from_scale / to_scale))
    largest = DEPTH_INVALID_MAX - 1
    if (result > largest).any():
        raise InputError(
            f"{source}: a depth of {steps.max() * from_scale:.3f} m does not fit: at {to_scale:g} m a step, depth ends "
            f"at {largest * to_scale:.3f} m; choose a larger --depth-scale, or a format that takes one"
        )
    if ((result == 0) & (steps > 0)).any():
        raise InputError(
            f"{source}: a depth of {steps[steps > 0].min() * from_scale:g} m is less than half a step of {to_scale:g} "
            "m, and would count as missing; choose a smaller --depth-scale, or a format that takes one"
        )
    return result.astype(np.uint16)


def _color_change(conversion: Conversion) -> str:
    source = conversion.source
    copied = (source.color_file(frame.frame_id).suffix.lower() == frame.color.suffix for frame in conversion.frames)
    return "files as they were" if all(copied) else "decoded and written as PNG, every pixel kept"


def _depth_change(from_scale: float, to_scale: float) -> str:
    ratio = from_scale / to_scale
    if math.isclose(ratio, 1, rel_tol=SAME_SCALE):
        return f"unchanged, {from_scale * 1000:g} mm a step"
    change = f"from {from_scale * 1000:g} to {to_scale * 1000:g} mm a step"
    if ratio > 1 and abs(ratio - round(ratio)) <= SAME_SCALE * ratio:
        return f"{change}, exactly"
    return f"{change}, rounded: changed by at most {to_scale * 500:g} mm"


def _invented(conversion: Conversion, target: DatasetFormat) -> tuple[str, ...]:
    """Return, in words, what the target has and the source does not."""
    if "timestamps" not in target.carries or _has_times(conversion):
        return ()
    return (f"the source has no timestamps: frame i was given i / {NOMINAL_FRAMES_PER_SECOND:g} s",)


def _has_times(conversion: Conversion) -> bool:
    return any(conversion.source.timestamp_s(frame.frame_id) is not None for frame in conversion.frames)


def _lost(conversion: Conversion, target: DatasetFormat) -> tuple[str, ...]:
    """Return, in words, what the source has and the target does not."""
    source, frame_ids = conversion.source, [frame.frame_id for frame in conversion.frames]
    has_mesh = source.ground_truth_mesh is not None and source.ground_truth_mesh.is_file()
    losses = {
        "timestamps": _has_times(conversion) and "timestamps" not in target.carries,
        "ground-truth mesh": has_mesh and "ground-truth mesh" not in target.carries,
        "recipe and provenance": source.metadata is not None and "recipe" not in target.carries,
        "frame numbers, which are counted anew from 0": frame_ids != list(range(len(frame_ids)))
        and "frame numbers" not in target.carries,
        f"layers {', '.join(source.layers)}": bool(source.layers),
    }
    return tuple(what for what, is_lost in losses.items() if is_lost)
