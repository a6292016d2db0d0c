"""How long Blender's main thread is kept busy: between two ticks of a timer, and in calls of the extension's Python.

A tick comes some 5 ms after the last one where nothing is to be done. The wall clock tells what a person waits, and how
busy the machine is; the main thread's processor time is that thread's alone. Without a graphics card the processor
draws: what the extension draws with OpenGL is told apart.
"""

import sys
import time

import bpy

OURS = "user_default/scanback"
DRAWS = "panel/legend.py"
TICK_S = 0.001


class Stalls:
    """Records from ``begin`` to ``end``; ``end`` returns the longest of each, in milliseconds."""

    def __init__(self):
        self.gaps, self.calls = [], []
        self._last = self._timer = None
        self._depth, self._began, self._name = 0, (0.0, 0.0), ""

    def begin(self):
        self._last = _now()
        self._timer = self._tick  # Blender knows it by its identity
        bpy.app.timers.register(self._timer, first_interval=TICK_S)
        sys.setprofile(self._profile)

    def end(self):
        sys.setprofile(None)
        bpy.app.timers.unregister(self._timer)
        calls = sorted(((used, wall, name) for wall, used, name in self.calls if DRAWS not in name), reverse=True)
        return {
            "ticks": len(self.gaps),
            "gap_ms": max(wall for wall, _ in self.gaps),
            "gap_median_ms": sorted(wall for wall, _ in self.gaps)[len(self.gaps) // 2],
            "gap_processor_ms": max(used for _, used in self.gaps),
            "call_processor_ms": calls[0][0] if calls else 0.0,
            "call_ms": max((wall for _, wall, _ in calls), default=0.0),
            "drawing_processor_ms": max((used for _, used, name in self.calls if DRAWS in name), default=0.0),
            "longest_calls": calls[:5],
        }

    def _tick(self):
        now = _now()
        self.gaps.append(tuple(1000 * (b - a) for a, b in zip(self._last, now, strict=True)))
        self._last = now
        return TICK_S

    def _profile(self, frame, event, _):
        """Time each call from Blender into Python that begins in the extension; what it calls is part of it."""
        if event == "call":
            self._depth += 1
            if self._depth == 1:
                self._began, self._name = _now(), f"{frame.f_code.co_filename}:{frame.f_code.co_qualname}"
        elif event == "return" and self._depth > 0:
            self._depth -= 1
            if self._depth == 0 and OURS in self._name:
                wall, used = (1000 * (b - a) for a, b in zip(self._began, _now(), strict=True))
                self.calls.append((wall, used, self._name.rpartition("scanback/")[2]))


def watched(steps):
    """Go through ``steps``; return their result and the stalls meanwhile."""
    stalls = Stalls()
    stalls.begin()
    result = yield from steps
    return result, stalls.end()


def redrawing(seconds):
    """Let the interface draw as often as it does while a job runs."""
    for _ in range(round(seconds / 0.1)):
        for area in bpy.context.window_manager.windows[0].screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
        yield 0.1


def _now():
    return time.perf_counter(), time.thread_time()
