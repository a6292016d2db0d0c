"""Which frames of a dataset: ``START:STOP:STEP``."""

import re
from collections.abc import Sequence

from datagen.errors import InputError

_SLICE = re.compile(r"(-?\d+)?:(-?\d+)?(?::(-?\d+)?)?")


def select_frames(frame_ids: Sequence[int], selection: str | None) -> tuple[int, ...]:
    """Return the frames that ``selection`` takes, in order.

    ``selection`` is a Python slice over the dataset's frames in their order (not over their numbers): ``0:60``,
    ``::10``, ``-20:`` (on a command line ``--frames=-20:``); one integer takes one frame; None takes all. Raises
    InputError for anything else, and where nothing is selected.
    """
    if selection is None:
        return tuple(frame_ids)
    if re.fullmatch(r"-?\d+", selection):
        index = int(selection)
        chosen = tuple(frame_ids[index : index + 1 or None])
    elif match := _SLICE.fullmatch(selection):
        start, stop, step = (int(part) if part else None for part in match.groups())
        if step == 0:
            raise InputError(f"--frames {selection}: the step is 0; use 1 for every frame")
        chosen = tuple(frame_ids[start:stop:step])
    else:
        raise InputError(f"--frames {selection}: expected START:STOP:STEP, for example 0:100 or ::10")
    if not chosen:
        raise InputError(f"--frames {selection}: selects none of the dataset's {len(frame_ids)} frames")
    return chosen
