import json
import re

import numpy as np
import pytest
import scipy.io
import trimesh
from synthetic_scene import CAMERA, write_dataset

from datagen.dataset import Frame
from datagen.images import write_color, write_depth
from datagen.rigid import inverse, look_at
from fusion.cli import main
from fusion.devices import resolve_device
from fusion.pose_benchmark import benchmark
from fusion.pose_benchmark.case_files import CaseResult
from fusion.reconstruction_files import read_record
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CPU = resolve_device("cpu")
OPTIONS = ("--voxel-size", "0.01", "--trials", "clean,off-10,noisy", "--frames", "0:2", "--device", "cpu", "--json")


def box_shape():
    boxes = [((0.5, 0.3, 0.2), (0, 0, 0)), ((0.1, 0.1, 0.5), (0.2, 0.1, 0.1)), ((0.3, 0.08, 0.1), (-0.2, -0.15, 0.15))]
    return trimesh.util.concatenate(
        [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    )


def frames_of(shape, poses):
    mesh = Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))
    depths = cast_rays_at_mesh(mesh, CAMERA, poses, device=CPU, depth_only=True).depth.numpy()
    return [
        Frame(
            frame_id=i,
            color=np.where(depth[..., None] > 0, np.uint8(120), np.uint8(0)).repeat(3, axis=-1),
            depth=depth,
            world_from_camera=pose,
        )
        for i, (depth, pose) in enumerate(zip(depths, poses, strict=True))
    ]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """30 views of three boxes on a circle, with the true mesh."""
    folder = tmp_path_factory.mktemp("pose-benchmark") / "boxes"
    angles = np.arange(30) * 2 * np.pi / 30
    poses = [look_at((np.cos(a), np.sin(a), 0.6 + 0.1 * np.sin(3 * a)), (0, 0, 0)) for a in angles]
    shape = box_shape()
    (folder / "ground_truth").mkdir(parents=True)
    shape.export(folder / "ground_truth" / "mesh.ply")
    return write_dataset(folder, frames_of(shape, poses), CAMERA, ground_truth_mesh="ground_truth/mesh.ply")


def run(capsys, *arguments):
    capsys.readouterr()
    code = main(["pose-benchmark", *(str(argument) for argument in arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture(scope="module")
def done(data):
    """The benchmark of the boxes, run once."""
    out = data.parent / "out"
    assert main(["pose-benchmark", str(data), str(out), *OPTIONS]) == 0
    return out


def results(out):
    files = sorted((out / "cases").glob("boxes/*/*.json"))
    return [CaseResult.model_validate_json(path.read_bytes()) for path in files]


def test_no_query_was_fused_and_each_has_its_result(done):
    fused = {frame.frame for frame in read_record(done / "models" / "boxes").trajectory}
    found = results(done)
    assert {(result.trial, result.frame) for result in found} == {
        (trial, frame) for trial in ("clean", "off-10", "noisy") for frame in (2, 7)
    }
    assert len(fused) == 24
    assert not fused & {result.frame for result in found}


def test_errors_are_those_of_the_poses_that_were_kept(done):
    for result in results(done):
        estimate, truth = inverse(np.array(result.estimate)), inverse(np.array(result.truth))
        relative = inverse(estimate) @ truth
        angle = np.degrees(np.arccos(np.clip((np.trace(relative[:3, :3]) - 1) / 2, -1, 1)))
        assert result.errors.rotation_deg == pytest.approx(angle, abs=1e-4)
        # The boxes are found from exact depth: no view's own error is larger than the voxel.
        assert result.errors.translation_m < 0.01
        assert result.errors.add_s_m <= result.errors.add_m <= result.errors.mssd_m
        if result.trial != "off-10":
            assert 0 <= min(result.errors.vsd) <= max(result.errors.vsd) <= 1


def test_starts_are_as_far_off_as_the_trial_says(done):
    starts = [result.start_errors for result in results(done) if result.trial == "off-10"]
    assert [start.rotation_deg for start in starts] == pytest.approx([10, 10])
    assert [start.translation_m for start in starts] == pytest.approx([0.04, 0.04])


def test_the_nearest_view_is_one_step_along_the_circle(done):
    for result in results(done):
        if result.trial == "clean":
            assert abs(result.nearest.frame - result.frame) == 1
            assert result.nearest.distance <= 1.1 * result.nearest.least_distance


def test_table_page_and_pictures_tell_the_same(done):
    told = json.loads((done / "results.json").read_text())
    page, table = (done / "pose-benchmark.html").read_text(), (done / "table.md").read_text()
    assert len(told["cases"]) == 6
    for row in told["rows"]:
        if row["what"] == "median rotation":
            errors = [case["errors"]["rotation_deg"] for case in told["cases"] if case["trial"] == row["trial"]]
            assert row["reached"] == pytest.approx(np.median(errors))
            assert f"| {row['reached']:.3f} °" in table
            assert f"<td>{row['reached']:.3f} °</td>" in page
        if row["at_most"] is not None:
            assert row["passed"] == (row["reached"] <= row["at_most"])
    sources = re.findall(r'(?:src|href)="([^"]{0,30})', page)
    assert all(source.startswith(("data:image/png;base64,", "data:image/jpeg;base64,", "#")) for source in sources)
    pictures = {path.name for path in (done / "pictures" / "boxes").glob("*.png")}
    trials = ("clean", "off-10", "noisy")
    assert pictures == {"histograms.png", *(f"{t}-{which}.png" for t in trials for which in ("typical", "worst"))}
    assert page.count("<img") == len(pictures)


def test_a_second_run_makes_nothing_again_but_what_is_missing_or_damaged(capsys, data, done, monkeypatch):
    before = {path: path.read_bytes() for path in (done / "cases").rglob("*.json")}
    (lost, damaged) = sorted(before)[1:3]
    lost.unlink()
    damaged.write_text("{")
    made = []

    def counted(case):
        made.append((case.trial.name, case.frame))
        return run_case(case)

    run_case = benchmark.run_case
    monkeypatch.setattr(benchmark, "run_case", counted)
    volume = (done / "models" / "boxes" / "volume.npz").stat().st_mtime_ns
    code, printed, _ = run(capsys, data, done, *OPTIONS)
    assert code == 0
    assert json.loads(printed) == json.loads((done / "results.json").read_text())["rows"]
    assert (done / "models" / "boxes" / "volume.npz").stat().st_mtime_ns == volume
    # Each of the trials that lack one warms up with it.
    assert set(made) == {("clean", 7), ("noisy", 2)}
    for path, content in before.items():
        then, now = json.loads(content), json.loads(path.read_text())
        assert now["estimate"] == then["estimate"]
        assert now["start"] == then["start"]


def test_an_interrupted_run_keeps_what_it_had_and_says_that_it_goes_on(capsys, data, done, tmp_path, monkeypatch):
    calls = iter(range(100))
    run_case = benchmark.run_case

    def interrupted(case):
        if next(calls) == 2:  # after a warm-up and one case
            raise KeyboardInterrupt
        return run_case(case)

    monkeypatch.setattr(benchmark, "run_case", interrupted)
    with pytest.raises(SystemExit) as stop:
        run(capsys, data, tmp_path, *OPTIONS)
    assert stop.value.code == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert len(results(tmp_path)) == 1
    assert not (tmp_path / "pose-benchmark.html").exists()


def test_another_seed_is_another_case(capsys, data, done, tmp_path):
    code, _, _ = run(
        capsys, data, tmp_path, *OPTIONS[:2], "--trials", "off-10", "--frames", "0:1", "--seed", "1", "--device", "cpu"
    )
    assert code == 0
    other = results(tmp_path)[0]
    first = next(result for result in results(done) if (result.trial, result.frame) == ("off-10", other.frame))
    assert other.identity != first.identity
    assert not np.allclose(other.start, first.start)


def test_a_recording_without_a_true_mesh_is_taken_for_a_room(capsys, data, tmp_path):
    content = json.loads((data / "dataset.json").read_text())
    room = tmp_path / "room"
    room.mkdir()
    (room / "frames").symlink_to(data / "frames")
    (room / "dataset.json").write_text(json.dumps(content | {"ground_truth_mesh": None}))
    out = tmp_path / "out"
    code, printed, _ = run(
        capsys, room, out, "--fuse", "::2", "--frames", "0:1", "--voxel-size", "0.02", "--device", "cpu", "--json"
    )
    assert code == 0
    rows = json.loads(printed)
    assert {row["trial"] for row in rows} == {"features", "depth"}
    told = {path.parent.name: json.loads(path.read_text()) for path in (out / "cases").rglob("*.json")}
    # Boxes of one colour have no features: the nearest pose is handed on, and it is said.
    assert any("too little texture" in reason for reason in told["features"]["reasons"])
    np.testing.assert_allclose(told["features"]["estimate"], told["features"]["start"], atol=1e-12)
    assert told["depth"]["errors"]["translation_m"] < 0.02
    assert told["depth"]["errors"]["add_m"] is None


@pytest.fixture(scope="module")
def ycb_video(tmp_path_factory):
    """Two frames of the boxes, a third as large, in YCB-Video's files, as its mug."""
    folder = tmp_path_factory.mktemp("ycb")
    shape = box_shape()
    shape.apply_scale(1 / 3)
    poses = [look_at((0.5, 0.2, 0.3), (0, 0, 0)), look_at((-0.2, 0.5, 0.35), (0, 0, 0))]
    (folder / "models").mkdir()
    np.savetxt(folder / "models" / "025_mug.xyz", trimesh.sample.sample_surface_even(shape, 3000, seed=0)[0])
    for frame in frames_of(shape, poses):
        stem = f"{frame.frame_id + 1:06d}"
        write_color(folder / f"{stem}-color.png", frame.color)
        write_depth(folder / f"{stem}-depth.png", frame.depth, metres_per_step=1e-4)
        write_color(folder / f"{stem}-label.png", np.where(frame.color > 0, np.uint8(14), np.uint8(0)))
        scipy.io.savemat(
            folder / f"{stem}-meta.mat",
            {
                "cls_indexes": np.array([[14]]),
                "factor_depth": np.array([[10000]]),
                "intrinsic_matrix": [[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]],
                "poses": inverse(frame.world_from_camera)[:3, :, None],
            },
        )
    return folder


def test_objects_of_ycb_video_are_located_in_their_points(capsys, ycb_video, tmp_path):
    code, printed, _ = run(capsys, ycb_video, tmp_path, "--voxel-size", "0.004", "--device", "cpu", "--json")
    assert code == 0
    rows = {row["what"]: row for row in json.loads(printed)}
    assert rows["ADD-S-0.1d"]["cases"] == 8
    assert rows["ADD-S-0.1d"]["reached"] == 100
    # The boxes turned by their true pose: a pose read the wrong way round would be off by far more.
    assert rows["median rotation"]["reached"] < 3
    # What is taken for the mug may turn about its axis: the rest of the error is no larger than the whole.
    for path in (tmp_path / "cases").rglob("*.json"):
        errors = json.loads(path.read_text())["errors"]
        assert 0 < errors["fixed_rotation_deg"] < errors["rotation_deg"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "000001-meta.mat").write_bytes(b"no"), "000001-meta.mat: cannot be read as YCB-Video's"),
        (lambda f: (f / "models" / "025_mug.xyz").write_text("1 2"), "025_mug.xyz: found 2 columns, expected x y z"),
        (lambda f: (f / "models" / "025_mug.xyz").rename(f / "models" / "024_bowl.xyz"), "no frame shows an object"),
        (lambda f: (f / "000001-label.png").unlink(), "000001-label.png: the file is missing"),
    ],
)
def test_bad_files_of_ycb_video_are_named(capsys, ycb_video, tmp_path, spoil, message):
    folder = tmp_path / "data"
    (folder / "models").mkdir(parents=True)
    for path in ycb_video.rglob("*.*"):
        (folder / path.relative_to(ycb_video)).write_bytes(path.read_bytes())
    spoil(folder)
    code, printed, errors = run(capsys, folder, tmp_path / "out", "--device", "cpu")
    assert code == 2
    assert printed == ""
    assert message in errors.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "nothing"], "--trials nothing: there is no 'nothing'"),
        (["--trials", "real"], "--trials real: no dataset has any of these trials"),
        (["--fuse", ":"], "all of its frames are fused, none is left to locate"),
        (["--frames", "90:95"], "--frames 90:95: selects none"),
        (["--seed", "-1"], "--seed -1: expected 0 or more"),
        (["--voxel-size", "0"], "--voxel-size 0: expected a positive number"),
    ],
)
def test_bad_options_give_one_clear_error(capsys, data, done, arguments, message):
    code, printed, errors = run(capsys, data, done, *OPTIONS[:2], *arguments)
    assert code == 2
    assert printed == ""
    assert message in errors
    assert errors.count("fusion: error:") == 1
