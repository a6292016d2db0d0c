"""A process that renders what it is told to: ``python -m datagen.blender.worker SCRATCH``.

Standard input brings one JSON object a line: first the job, then one task each. Standard output gives one JSON line
for each of them and nothing else; what Blender prints goes to standard error. The end of standard input ends the
process, which removes its SCRATCH folder then, so that nothing is left behind when its parent dies.
"""

import json
import os
import shutil
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from datagen.errors import InputError
from datagen.scene_spec.scene import Scene

if TYPE_CHECKING:
    from datagen.blender.session import RenderSession


def main() -> int:
    """Serve one parent until it closes standard input; returns the exit code."""
    reports = _claim_standard_output()
    scratch = Path(sys.argv[1])
    try:
        first_line = sys.stdin.readline()
        if not first_line:
            return 0
        session = _open_session(json.loads(first_line), scratch)
        _send(reports, session.description())
        for line in sys.stdin:
            _perform(session, json.loads(line))
            _send(reports, {})
    except BrokenPipeError:
        return 0  # the parent died; what was being written is whole all the same
    except InputError as error:
        return _fail(reports, str(error), input_error=True)
    except Exception as error:  # the parent raises it
        traceback.print_exc()
        return _fail(reports, f"{type(error).__name__}: {error}", input_error=False)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return 0


def _claim_standard_output() -> TextIO:
    """Return the pipe to the parent, and send all that Blender's libraries print to standard error instead."""
    reports = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return reports


def _send(reports: TextIO, report: dict[str, Any]) -> None:
    reports.write(json.dumps(report) + "\n")
    reports.flush()


def _fail(reports: TextIO, message: str, *, input_error: bool) -> int:
    _send(reports, {"error": message, "input_error": input_error})
    return 1


def _open_session(job: dict[str, Any], scratch: Path) -> "RenderSession":
    try:
        from datagen.blender.session import RenderSession  # noqa: PLC0415 - what is missing is said to the parent
    except ModuleNotFoundError as error:
        raise InputError(
            f'rendering needs the Python module {error.name}, which is not installed: pip install "scanback[blender]"'
        ) from error
    except ImportError as error:
        raise InputError(
            f"Blender cannot be loaded, a system library is missing ({error}); on Debian or Ubuntu: apt-get install "
            "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1"
        ) from error
    scene = Scene.model_validate_json(job["scene"])
    return RenderSession(scene, device=job["device"], threads=job["threads"], scratch=scratch)


def _perform(session: "RenderSession", task: dict[str, Any]) -> None:
    folder = Path(task["folder"])
    if task["kind"] == "ground_truth":
        session.write_ground_truth(folder)
    else:
        session.write_frame(folder, task["frame"])


if __name__ == "__main__":
    sys.exit(main())
