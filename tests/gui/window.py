"""What a session in Blender's interface does, step by step: ``blender --python window.py -- SESSION FOLDER``.

SESSION is a Python file with a generator function ``steps(window)``. Between two steps, that is at each ``yield``,
Blender draws and handles events for as many seconds as were yielded. What it put into ``window.seen`` is written to
FOLDER/seen.json, with an ``error`` where it failed; then Blender ends.
"""

import json
import runpy
import subprocess
import sys
import traceback
from pathlib import Path

import bpy

MODULE = "bl_ext.user_default.scanback"
FIRST_S = 3.0
"""Until the window is there and drawn."""


class Window:
    """Blender's window, as a person has it before them."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.seen = {}
        self._shots = 0

    @property
    def window(self):
        return bpy.context.window_manager.windows[0]

    def area(self, kind):
        return next(area for area in self.window.screen.areas if area.type == kind)

    def region(self, area, kind):
        return next(region for region in area.regions if region.type == kind)

    def within(self, kind="VIEW_3D"):
        """Give operators the place that they would have been called in."""
        area = self.area(kind)
        return bpy.context.temp_override(window=self.window, area=area, region=self.region(area, "WINDOW"))

    def install(self, archive="/shared/scanback.zip"):
        """Close the splash screen, install the extension and enable it."""
        yield from self.press("ESC", 700, 500)
        bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
        yield 0.5

    def runner(self):
        """Return the extension's module that runs jobs."""
        return sys.modules[f"{MODULE}.jobs.runner"]

    def finish_job(self, *, half_way="", when=lambda: True):
        """Wait until the job is over and return how it ended; take a picture in its middle, once ``when`` is true."""
        runner = self.runner()
        while (job := runner.current_job()) is not None:
            progress = job.progress
            if half_way and progress is not None and progress.fraction >= 0.5 and when():
                self.shot(half_way)
                half_way = ""
            yield 0.1
        yield 0.5
        ended = runner.last_job()
        return [ended.state.value, ended.message]

    def open_tab(self, name):
        """Open the sidebar of the 3D view; the tab is there after the next drawing."""
        self.area("VIEW_3D").spaces.active.show_region_ui = True
        yield 1.0
        region = self.region(self.area("VIEW_3D"), "UI")
        region.active_panel_category = name
        region.tag_redraw()
        yield 1.0

    def shot(self, name):
        """Write a picture of the whole display: what is on it, not what Blender thinks is. Return its path."""
        self._shots += 1
        path = self.folder / f"{self._shots:02d}-{name}.png"
        command = f"xwd -root -silent | xwdtopnm 2>/dev/null | pnmtopng 2>/dev/null > '{path}'"
        subprocess.run(command, shell=True, check=True)
        return path

    def event(self, kind, value="PRESS", **where):
        """Send one event to Blender as if it came from a device."""
        self.window.event_simulate(type=kind, value=value, **where)

    def scroll(self, notches):
        """Turn the wheel over the sidebar, up where ``notches`` is positive."""
        region = self.region(self.area("VIEW_3D"), "UI")
        x, y = region.x + region.width // 2, region.y + region.height // 2
        self.event("MOUSEMOVE", "NOTHING", x=x, y=y)
        yield 0.2
        for _ in range(abs(notches)):
            self.event("WHEELUPMOUSE" if notches > 0 else "WHEELDOWNMOUSE", "PRESS", x=x, y=y)
            yield 0.05
        yield 0.5

    def drag(self, x, y, by_x, by_y):
        """Drag what is at (x, y), as the edge of a region, so many pixels away."""
        self.event("MOUSEMOVE", "NOTHING", x=x, y=y)
        yield 0.3
        self.event("LEFTMOUSE", "PRESS", x=x, y=y)
        for part in (0.25, 0.5, 0.75, 1.0):
            yield 0.1
            self.event("MOUSEMOVE", "NOTHING", x=round(x + part * by_x), y=round(y + part * by_y))
        yield 0.2
        self.event("LEFTMOUSE", "RELEASE", x=x + by_x, y=y + by_y)
        yield 0.5

    def press(self, kind, x, y, **more):
        """Press and release a key or button at pixel (x, y) from the window's lower left corner."""
        self.event("MOUSEMOVE", "NOTHING", x=x, y=y)
        yield 0.2
        self.event(kind, "PRESS", x=x, y=y, **more)
        self.event(kind, "RELEASE", x=x, y=y, **more)
        yield 0.3


def _go_on(window, steps):
    try:
        return next(steps)
    except StopIteration:
        window.seen["finished"] = True
    except BaseException:
        window.seen["error"] = traceback.format_exc()
        window.shot("failed")
    finally:  # what was seen so far is of use where a session has to be ended
        (window.folder / "seen.json").write_text(json.dumps(window.seen))
    bpy.ops.wm.quit_blender()
    return None


def main(session, folder):
    window = Window(folder)
    steps = runpy.run_path(session)["steps"](window)
    bpy.app.timers.register(lambda: _go_on(window, steps), first_interval=FIRST_S, persistent=True)


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
