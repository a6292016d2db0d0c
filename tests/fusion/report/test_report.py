import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from synthetic_scene import SphereScene, icosphere, write_dataset

from datagen.open_dataset import open_dataset
from fusion.cli import main
from fusion.devices import resolve_device
from fusion.evaluation import evaluate
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import read_record
from fusion.report import mesher_figure, runs, subject
from fusion.report.panels import duration, millimetres, ratio

CPU = resolve_device("cpu")
SCENE = SphereScene()


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Small pictures, few samples of surfaces, and times taken once: what is tested depends on none of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "SAMPLES", 20_000)
        patch.setattr(runs, "TIMED_FOR", 0.0)
        patch.setattr(subject, "PICTURE_WIDTH", 120)
        yield


@pytest.fixture(scope="module")
def reported(tmp_path_factory, quick):
    """A small dataset of a sphere with its true mesh, and the report of it."""
    folder = tmp_path_factory.mktemp("report")
    truth = trimesh.Trimesh(*icosphere(SCENE), process=False)
    (folder / "ball" / "ground_truth").mkdir(parents=True)
    truth.export(folder / "ball" / "ground_truth" / "mesh.ply")
    write_dataset(folder / "ball", SCENE.frames_around(12), ground_truth_mesh="ground_truth/mesh.ply")
    arguments = ["report", str(folder / "ball"), str(folder / "out"), "--voxel-size", "0.02", "--device", "cpu"]
    assert main(arguments) == 0
    return folder


def test_the_page_asks_for_nothing_from_outside(reported):
    page = (reported / "out" / "report.html").read_text()
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', page)
    assert sources
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in sources)
    assert "@import" not in page
    assert "url(" not in page


def test_the_numbers_on_the_page_are_those_of_the_records(reported):
    page = (reported / "out" / "report.html").read_text()
    paths = sorted((reported / "out").glob("runs/ball/*/reconstruction.json"))
    records = [read_record(path.parent) for path in paths]
    assert {record.frames for record in records} == {3, 6, 12}
    assert len({record.voxel_size_m for record in records}) == 4
    assert len({record.truncation_m for record in records}) == 5
    assert len(records) == 10 + 6  # none of them twice: ten fused, and six meshed from two of these
    for path, record in zip(paths, records, strict=True):
        assert f"<dd>{record.vertices:,}</dd>" in page
        assert f"<dd>{duration(json.loads((path.parent / runs.TIMING_FILE).read_text())['mesh_seconds'])}" in page
    # All of figure 11 is held against one truth at one distance, whatever its voxels.
    meshed = [record for path, record in zip(paths, records, strict=True) if path.parent.name.startswith("meshed-")]
    assert {record.metrics["fscores"][0]["threshold_m"] for record in meshed} == {0.01}
    for record in meshed:
        assert f"<dd>{millimetres(record.metrics['chamfer_m'])}</dd>" in page


def test_every_picture_has_numbers_beneath_it(reported):
    page = (reported / "out" / "report.html").read_text()
    pictures = page.split("<figure>")[1:]
    assert pictures
    assert all(re.search(r"<dt>[^<]+</dt><dd>[^<]*[0-9]", picture.split("</figure>")[0]) for picture in pictures)


def test_more_frames_cover_more_of_what_all_frames_see(reported):
    page = (reported / "out" / "report.html").read_text()
    shares = [float(share) for share in re.findall(r"<dt>surface there</dt><dd>([0-9.]+) %", page)]
    assert len(shares) == 3
    assert shares[0] < shares[1] < shares[2]
    # The last is of all the frames: what they all see is less than a voxel from what they make.
    assert shares[2] > 99


def test_every_picture_is_a_file_too(reported):
    page = (reported / "out" / "report.html").read_text()
    pictures = {path.stem for path in (reported / "out" / "images" / "ball").glob("*.png")}
    assert {"photograph", "coloured", "coloured-error", "frames-006", "voxel-8", "truncation-16-error"} <= pictures
    assert {"mesher-marching-cubes", "mesher-marching-cubes-close", "mesher-marching-cubes-error"} <= pictures
    assert page.count("<figure>") == len(pictures)


def test_a_second_report_makes_no_reconstruction_again(reported, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("reconstructed again")

    monkeypatch.setattr(runs, "reconstruct", refuse)
    monkeypatch.setattr(runs, "mesh_volume", refuse)
    page = reported / "out" / "report.html"
    before = page.read_bytes()
    page.unlink()
    arguments = ["report", str(reported / "ball"), str(reported / "out"), "--voxel-size", "0.02", "--device", "cpu"]
    assert main(arguments) == 0
    assert page.read_bytes() == before


def test_a_volume_is_kept_no_longer_than_it_is_meshed(reported):
    assert not list((reported / "out").glob("runs/ball/*/volume.npz"))


def test_an_interrupted_figure_goes_on(reported, tmp_path, monkeypatch):
    # One of the six meshes is lost: it alone is meshed again, from the volume that is fused again.
    shutil.copytree(reported / "ball", tmp_path / "ball")
    shutil.copytree(reported / "out", tmp_path / "out")
    lost = next(
        path.parent
        for path in (tmp_path / "out").glob("runs/ball/meshed-*/reconstruction.json")
        if read_record(path.parent).config["oracle"] == "volume"
    )
    shutil.rmtree(lost)
    counted = []
    mesh_run = mesher_figure.mesh_run
    monkeypatch.setattr(
        mesher_figure, "mesh_run", lambda *given, **options: counted.append(given) or mesh_run(*given, **options)
    )
    arguments = [str(tmp_path / "ball"), str(tmp_path / "out"), "--voxel-size", "0.02", "--device", "cpu"]
    assert main(["report", *arguments]) == 0
    assert [(config.mesher, config.oracle) for _, _, config in counted] == [("dual-contouring", "volume")]
    assert (lost / "mesh.ply").is_file()


def test_what_dual_contouring_costs_and_gains_is_said_with_the_numbers_of_its_records(reported):
    page = (reported / "out" / "report.html").read_text()
    made = {}
    for path in (reported / "out").glob("runs/ball/meshed-*/reconstruction.json"):
        record = read_record(path.parent)
        seconds = json.loads((path.parent / runs.TIMING_FILE).read_text())["mesh_seconds"]
        config = record.config
        made[config["mesher"], config["oracle"], config["flatness"], record.voxel_size_m] = record, seconds
    cubes, coarse = made["marching-cubes", "depth", 0, 0.02], made["dual-contouring", "depth", 0, 0.04]
    merged = made["dual-contouring", "depth", 0.05, 0.02][0]
    assert f"flat to 0.05 voxels, {100 * merged.vertices / cubes[0].vertices:.0f} %" in page
    assert f"On voxels twice as large it has {coarse[0].vertices:,} vertices" in page
    times = made["dual-contouring", "volume", 0, 0.02][1] / cubes[1]
    assert f"dual contouring by the volume {ratio(times)} times" in page
    # A ball has no sharp edges, and all of it is smooth.
    assert "<dt>smooth parts</dt>" in page
    assert "<dt>sharp edges</dt><dd>" not in page
    assert "The truth has no sharp edges" in page


def test_two_datasets_of_one_name_are_refused(reported, tmp_path, capsys):
    data = str(reported / "ball")
    assert main(["report", data, data, str(tmp_path / "out")]) == 2
    assert "two datasets are called 'ball'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.fixture
def ball(reported, tmp_path):
    """A copy of the dataset."""
    return Path(shutil.copytree(reported / "ball", tmp_path / "ball"))


def test_a_missing_true_mesh_is_named_before_anything_is_made(ball, tmp_path, capsys):
    (ball / "ground_truth" / "mesh.ply").unlink()
    assert main(["report", str(ball), str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert str(ball / "ground_truth" / "mesh.ply") in error
    assert '"ground_truth_mesh": null' in error
    assert not (tmp_path / "out").exists()


def test_a_broken_dataset_is_named_before_another_one_is_fused(reported, ball, tmp_path, capsys):
    ball = ball.rename(tmp_path / "broken")
    (ball / "frames" / "frame-000007.depth.png").unlink()
    assert main(["report", str(reported / "ball"), str(ball), str(tmp_path / "out")]) == 2
    assert "frame-000007.depth.png: the file is missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_view_that_there_is_not_is_refused(ball, tmp_path, capsys):
    assert main(["report", str(ball), str(tmp_path / "out"), "--view-frame", "12"]) == 2
    assert "--view-frame 12" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_dataset_in_the_place_of_the_report_is_refused(reported, ball, capsys):
    before = sorted(ball.rglob("*"))
    assert main(["report", str(reported / "ball"), str(ball)]) == 2
    assert "name the folder for the report after the datasets" in capsys.readouterr().err
    assert sorted(ball.rglob("*")) == before


def test_a_run_is_stale_when_its_dataset_has_grown_or_was_made_anew(reported, ball):
    ours = open_dataset(ball)
    folder, config = ball.parent / "run", ReconstructionConfig(voxel_size=0.05, device="cpu")
    runs.run(ours, folder, config)
    assert runs.is_current(ours, folder, config)
    fewer = replace(ours, frames={i: ours.frames[i] for i in range(11)})
    assert not runs.is_current(fewer, folder, config)
    moved = {**ours.frames, 3: replace(ours.frames[3], pose=ours.world_from_camera(4))}
    assert not runs.is_current(replace(ours, frames=moved), folder, config)
    later = (folder / runs.TIMING_FILE).stat().st_mtime + 10
    os.utime(ours.color_file(5), (later, later))
    assert not runs.is_current(ours, folder, config)


def test_a_recording_without_truth_is_shown_in_its_colours_beside_the_papers_table(reported, ball):
    metadata = json.loads((ball / "dataset.json").read_text()) | {"ground_truth_mesh": None}
    (ball / "dataset.json").write_text(json.dumps(metadata))
    out = ball.parent / "out"
    assert main(["report", str(ball), str(out), "--voxel-size", "0.02", "--device", "cpu"]) == 0
    page = (out / "report.html").read_text()
    assert "Fig. 12" in page
    assert "Fig. 7" not in page
    # The scene is seen exactly: its depth is that of the frame, and its colours are two, without shading.
    assert float(re.search(r"<dt>depth off by</dt><dd>([0-9.]+) mm", page).group(1)) < 2
    assert float(re.search(r"<dt>colour, PSNR</dt><dd>([0-9.]+) dB", page).group(1)) > 20
    record = read_record(next((out / "runs" / "ball").iterdir()))
    assert f"<td>{record.frames_per_second:.1f}</td>" in page
    for rate in ("296.7", "530.7", "0.5"):
        assert f"<td>{rate}</td>" in page
