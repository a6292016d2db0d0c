"""The one job that may run at a time in a Blender, and the timer that advances it."""

import time
from collections.abc import Callable

import bpy

from ..errors import ReconstructionError
from ..preferences import cache_folder
from .job import Job, Pace, Work

TICK_SECONDS = 0.1
SHORT_TICK_SECONDS = 0.01
BUDGET_SECONDS = 0.015
"""How long steps may follow each other within one tick."""

_current: Job | None = None
_last: Job | None = None


def current_job() -> Job | None:
    """Return the job that runs, None where none does."""
    return _current


def last_job() -> Job | None:
    """Return the job that ended last, None before the first one and once its message was dismissed."""
    return _last


def start(title: str, work: Callable[[Job], Work[str]]) -> Job:
    """Begin a job that a timer advances. Raises ReconstructionError where another one runs."""
    job = _begin(title, work)
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_SECONDS, persistent=True)
    return job


def run_to_end(title: str, work: Callable[[Job], Work[str]]) -> Job:
    """Do a job here and now: for scripts, and where no timers fire."""
    job = _begin(title, work)
    try:
        while not job.is_over:
            if job.step() is Pace.WAIT:
                time.sleep(0.02)
    except BaseException:
        job.kill()
        raise
    finally:
        _let_go()
    return job


def advance() -> Pace:
    """Do what there is to do within one tick; a timer calls it, and tests do. Tells whether there is more at once."""
    job = _current
    if job is None:
        return Pace.WAIT
    began = time.monotonic()
    pace = Pace.MORE
    while not job.is_over and pace is Pace.MORE and time.monotonic() - began < BUDGET_SECONDS:
        pace = job.step()
    if job.is_over:
        _let_go()
    _redraw()
    return pace


def dismiss() -> None:
    """Forget the message of the job that ended last."""
    global _last  # noqa: PLW0603
    _last = None


def end_all() -> None:
    """End the job that runs, and the timer: the extension is being taken away."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    if _current is not None:
        _current.kill()
        _let_go()
    dismiss()


def _begin(title: str, work: Callable[[Job], Work[str]]) -> Job:
    global _current  # noqa: PLW0603 - one job in a Blender: this is where it is kept
    if _current is not None:
        raise ReconstructionError(f"{_current.title} is still running; wait for it or cancel it")
    _current = Job(title, work, cache=cache_folder() / "jobs")
    dismiss()
    return _current


def _let_go() -> None:
    global _current, _last
    _current, _last = None, _current


def _tick() -> float | None:
    pace = advance()
    if _current is None:
        return None
    return TICK_SECONDS if pace is Pace.WAIT else SHORT_TICK_SECONDS


def _redraw() -> None:
    """Draw the sidebars anew, and not the scene beside them, which may be large."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()
