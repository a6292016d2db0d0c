import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from converted_datasets import convert, write_source

from datagen.cli import main
from datagen.errors import InputError
from datagen.formats import convert as conversion
from datagen.formats.convert import convert_dataset, rescaled
from datagen.formats.registry import FORMAT_NAMES, format_named
from datagen.images import write_depth
from datagen.open_dataset import open_dataset


def files(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", FORMAT_NAMES)
def test_an_interrupted_conversion_goes_on_and_ends_as_an_uninterrupted_one(source, name, tmp_path, monkeypatch):
    whole = convert(source, tmp_path / "whole", name)
    calls = []
    write_steps = conversion.write_depth_steps

    def interrupted(path, steps):
        calls.append(path)
        if len(calls) == 3:
            raise KeyboardInterrupt
        write_steps(path, steps)

    monkeypatch.setattr(conversion, "write_depth_steps", interrupted)
    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "out", name)
    with pytest.raises(InputError, match=r"its conversion was not finished; run the same datagen convert again"):
        open_dataset(tmp_path / "out")
    done = len(list((tmp_path / "out").rglob("*depth*/*.png")) + list((tmp_path / "out").rglob("*.depth.png")))
    calls.clear()
    monkeypatch.setattr(conversion, "write_depth_steps", lambda *args: (calls.append(args), write_steps(*args)))
    convert(source, tmp_path / "out", name)
    assert len(calls) == 5 - done
    assert files(tmp_path / "out") == files(whole)


def test_a_killed_process_leaves_no_torn_file_and_the_same_command_goes_on(tmp_path):
    source = write_source(tmp_path / "source", count=60)
    whole = convert(source, tmp_path / "whole", "tum")
    code = (
        "import sys; from pathlib import Path; from datagen.formats.convert import convert_dataset; "
        "from datagen.formats.registry import format_named; from datagen.open_dataset import open_dataset; "
        "convert_dataset(open_dataset(Path(sys.argv[1])), Path(sys.argv[2]), format_named('tum'))"
    )
    out = tmp_path / "out"
    process = subprocess.Popen([sys.executable, "-c", code, str(source.folder), str(out)])
    deadline = time.monotonic() + 60
    while process.poll() is None and len(list(out.glob("depth/*.png"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    expected = files(whole)
    written = {path: data for path, data in files(out).items() if not path.name.startswith(".")}
    assert 0 < len(written) < len(expected)
    assert all(data == expected[path] for path, data in written.items())
    assert subprocess.run([sys.executable, "-c", code, str(source.folder), str(out)], check=False).returncode == 0
    assert files(out) == expected


def test_a_folder_that_holds_anything_else_is_refused(source, tmp_path):
    out = convert(source, tmp_path / "out", "bop")
    before = files(out)
    with pytest.raises(
        InputError, match=r"out: holds files already \(depth, models, rgb\); name a new or empty folder"
    ):
        convert(source, out, "bop")
    assert files(out) == before
    with pytest.raises(InputError, match="a file, not a folder"):
        convert(source, tmp_path / "source" / "dataset.json", "bop")


def test_another_conversion_does_not_go_on_in_the_folder_of_an_unfinished_one(source, tmp_path, monkeypatch):
    monkeypatch.setattr(conversion, "_write_images", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "out", "bop")
    with pytest.raises(InputError, match=r'unfinished conversion whose format is "bop", now asked for is "tum"'):
        convert(source, tmp_path / "out", "tum")
    with pytest.raises(InputError, match=r'whose frames is "all", now asked for is "::2"'):
        convert(source, tmp_path / "out", "bop", frames="::2")


def test_a_damaged_image_is_named_and_after_it_was_mended_the_conversion_goes_on(source, tmp_path):
    path = source.color_file(3)
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    with pytest.raises(InputError, match=r"frame-000003.color.png: damaged or cut short"):
        convert(source, tmp_path / "out", "open3d")
    path.write_bytes(whole)
    assert open_dataset(convert(source, tmp_path / "out", "open3d")).frame_ids == (0, 1, 2, 3, 4)


def test_an_image_that_changed_since_is_converted_anew(source, tmp_path, monkeypatch):
    monkeypatch.setattr(conversion, "finish", lambda _: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / "out", "bop")
    monkeypatch.undo()
    write_depth(source.depth_file(2), np.full((120, 160), 2.5), metres_per_step=0.0001)
    assert open_dataset(convert(source, tmp_path / "out", "bop")).depth(2)[7, 7] == pytest.approx(2.5)


def test_a_frame_without_its_pose_is_named_before_anything_is_written(source, tmp_path):
    (source.folder / "frames" / "frame-000002.pose.txt").unlink()
    with pytest.raises(InputError, match=r"frame-000002.pose.txt: the file is missing"):
        convert(source, tmp_path / "out", "tum")
    assert not (tmp_path / "out").exists()


def test_depth_that_does_not_fit_is_refused_by_file_and_value(tmp_path):
    source = write_source(tmp_path / "source", depth_scale=0.001)
    far = np.full((120, 160), 20.0)
    write_depth(source.depth_file(2), far, metres_per_step=0.001)
    complaint = r"frame-000002.depth.png: a depth of 20.000 m does not fit: at 0.0002 m a step, depth ends at 13.107 m"
    with pytest.raises(InputError, match=complaint):
        convert(source, tmp_path / "out", "tum")
    write_depth(source.depth_file(2), far / 20 * 0.001, metres_per_step=0.001)
    with pytest.raises(InputError, match=r"a depth of 0.001 m is less than half a step of 0.01 m"):
        convert(source, tmp_path / "coarse", "bop", depth_scale=0.01)


def test_a_scale_that_the_format_fixes_cannot_be_chosen(source, tmp_path):
    with pytest.raises(InputError, match=r"--depth-scale 0.001: TUM RGB-D has 0.0002 m a step, always"):
        convert(source, tmp_path / "out", "tum", depth_scale=0.001)
    with pytest.raises(InputError, match=r"--depth-scale -1: expected metres a step"):
        convert(source, tmp_path / "out", "bop", depth_scale=-1.0)


@pytest.mark.parametrize(
    ("from_scale", "to_scale", "change", "bound"),
    [
        (0.0001, 0.0001, "unchanged, 0.1 mm a step", 0.0),
        (0.001, 0.0002, "from 1 to 0.2 mm a step, exactly", 0.0),
        (0.0001, 0.001, "from 0.1 to 1 mm a step, rounded: changed by at most 0.5 mm", 0.0005),
        (0.0003, 0.0002, "from 0.3 to 0.2 mm a step, rounded: changed by at most 0.1 mm", 0.0001),
    ],
)
def test_what_is_said_about_the_depth_is_true(source, tmp_path, from_scale, to_scale, change, bound):
    first = open_dataset(convert(source, tmp_path / "first", "bop", depth_scale=from_scale))
    said = convert_dataset(first, tmp_path / "out", format_named("nerfstudio"), depth_scale=to_scale).depth
    assert said == change
    there = open_dataset(tmp_path / "out")
    errors = np.stack([np.abs(there.depth(i).astype(float) - first.depth(i)) for i in there.frame_ids])
    assert errors.max() <= bound + 1e-6
    if bound:
        assert errors.max() > 0.9 * bound


def test_rounding_is_to_the_nearest_step_and_holes_stay_holes():
    steps = np.array([[0, 4, 6, 14, 16, 65534]], np.uint16)
    np.testing.assert_array_equal(rescaled(steps[:, [0, 2, 3, 4]], 0.0001, 0.001, source=""), [[0, 1, 1, 2]])
    np.testing.assert_array_equal(rescaled(steps, 0.1, 100 / 1000, source=""), steps)


def test_what_a_format_cannot_carry_is_told(source, tmp_path):
    layered = tmp_path / "source" / "dataset.json"
    layered.write_text(json.dumps(json.loads(layered.read_text()) | {"layers": ["normals", "masks"]}))
    source = open_dataset(source.folder)
    lost = {name: convert_dataset(source, tmp_path / name, format_named(name)).lost for name in FORMAT_NAMES}
    assert all("layers normals, masks" in entries for entries in lost.values())
    assert {name for name, entries in lost.items() if "timestamps" in entries} == set(FORMAT_NAMES) - {
        "scanback",
        "tum",
    }
    assert {name for name, entries in lost.items() if "ground-truth mesh" in entries} == set(FORMAT_NAMES) - {
        "scanback",
        "bop",
    }
    assert "recipe and provenance" not in lost["scanback"]
    every_second = convert_dataset(source, tmp_path / "second", format_named("tum"), frames="::2")
    assert "frame numbers, which are counted anew from 0" in every_second.lost


def test_times_that_were_made_up_are_told(source, tmp_path):
    timeless = open_dataset(convert(source, tmp_path / "bop", "bop"))
    told = convert_dataset(timeless, tmp_path / "tum", format_named("tum"))
    assert "the source has no timestamps: frame i was given i / 30 s" in told.advice
    assert open_dataset(tmp_path / "tum").timestamp_s(4) == pytest.approx(4 / 30, abs=1e-12)


def test_times_without_a_beat_are_told_and_kept_in_the_provenance(source, tmp_path):
    tum = convert(source, tmp_path / "tum", "tum")
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (tum / name).write_text((tum / name).read_text().replace(f"\n{3 / 24!r} ", "\n0.1125 "))
    told = convert_dataset(open_dataset(tum), tmp_path / "out", format_named("scanback"))
    assert any("the original times are in dataset.json" in note for note in told.advice)
    times = open_dataset(tmp_path / "out").metadata.provenance["converted_from"]["timestamps_s"]
    assert times == pytest.approx([0, 1 / 24, 2 / 24, 0.1125, 4 / 24], abs=1e-12)


def test_the_command_says_what_it_did(source, tmp_path, capsys):
    assert main(["convert", str(source.folder), str(tmp_path / "out"), "--format", "nerfstudio"]) == 0
    out = capsys.readouterr().out
    assert f"{tmp_path / 'out'}: 5 frames of {source.folder} (scanback) as nerfstudio" in out
    assert "depth      unchanged, 0.1 mm a step" in out
    assert "not kept   ground-truth mesh" in out
    assert "--depth-unit-scale-factor 0.0001" in out


def test_all_formats_are_found_by_name():
    assert [format_named(name).name for name in FORMAT_NAMES] == list(FORMAT_NAMES)
    with pytest.raises(InputError, match="format 'rosbag': unknown; expected one of scanback, tum"):
        format_named("rosbag")
