import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from datagen.cli import main
from datagen.dataset_writer import write_frame


@pytest.fixture
def kitchen(tmp_path):
    """A 7-Scenes folder of two frames."""
    for frame in range(2):
        pose = np.eye(4)
        pose[0, 3] = frame
        write_frame(
            tmp_path,
            frame,
            color=np.zeros((480, 640, 3), np.uint8),
            depth=np.full((480, 640), 1.5),
            world_from_camera=pose,
            depth_scale=0.001,
        )
    return tmp_path


def test_info_prints_json_and_nothing_else(kitchen, capsys):
    assert main(["info", str(kitchen), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["format"], summary["frames_complete"]) == ("7-Scenes", 2)
    assert summary["trajectory"]["length_m"] == pytest.approx(1.0)


def test_info_speaks_to_people(kitchen, capsys):
    assert main(["info", str(kitchen)]) == 0
    assert "2 complete of 2" in capsys.readouterr().out


def test_nothing_is_said_where_nobody_listens_any_more(kitchen):
    command = [sys.executable, "-m", "datagen", "info", str(kitchen)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 128 + signal.SIGPIPE
    process.stderr.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["info", "/nowhere"], "/nowhere: no such folder"),
        (["render", "suzane", "unused"], "did you mean suzanne"),
        (["render", "suzanne", "unused", "--samples", "0"], "samples: expected greater than or equal to 1, found 0"),
    ],
)
def test_bad_input_is_one_line_on_standard_error_and_exit_code_2(arguments, complaint, capsys):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("datagen: error: ")
    assert complaint in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("options", [["--size", "640"], ["--workers", "0"], ["--device", "gpu"], ["--frames", "0"]])
def test_options_that_cannot_be_parsed_leave_with_exit_code_2(options, capsys):
    with pytest.raises(SystemExit) as left:
        main(["render", "suzanne", "unused", *options])
    assert left.value.code == 2
    assert options[0] in capsys.readouterr().err


@pytest.mark.parametrize("command", [["render", "suzanne", "unused"], ["verify", "unused"]])
def test_a_slice_where_a_number_of_frames_is_asked_for_is_told_so(command, capsys):
    with pytest.raises(SystemExit) as left:
        main([*command, "--frames", "::2"])
    assert left.value.code == 2
    complaint = "'::2' is no number of frames; expected how many, from 1; a slice chooses among frames"
    assert complaint in capsys.readouterr().err


@pytest.mark.parametrize("program", ["datagen", "fusion", "blender_addon"])
def test_all_programs_tell_the_version_of_the_project_and_nothing_else(program):
    checkout = Path(__file__).parents[2]
    version = tomllib.loads((checkout / "pyproject.toml").read_text())["project"]["version"]
    command = [sys.executable, "-m", program, "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=checkout)
    assert (done.returncode, done.stdout, done.stderr) == (0, f"scanback {version}\n", "")
