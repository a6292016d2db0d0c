import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, icosphere, write_dataset

from datagen.camera import PinholeCamera
from datagen.rigid import look_at
from fusion.cli import main
from fusion.devices import resolve_device
from fusion.reconstruction_files import read_record
from fusion.report import runs
from fusion.report.heat_map import heat, heat_bar
from fusion.report.mesh_picture import picture_of_mesh
from fusion.surface.mesh import Mesh

CPU = resolve_device("cpu")
SCENE = SphereScene()


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """A small dataset of a sphere with its true mesh, and the report of it."""
    folder = tmp_path_factory.mktemp("report")
    truth = trimesh.Trimesh(*icosphere(SCENE), process=False)
    (folder / "ball" / "ground_truth").mkdir(parents=True)
    truth.export(folder / "ball" / "ground_truth" / "mesh.ply")
    write_dataset(folder / "ball", SCENE.frames_around(12), ground_truth_mesh="ground_truth/mesh.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "TIMED_FOR", 0.0)
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
    records = [read_record(path.parent) for path in sorted((reported / "out").glob("runs/ball/*/reconstruction.json"))]
    assert {record.frames for record in records} == {10, 12}
    assert len({record.voxel_size_m for record in records}) == 4
    assert len({record.truncation_m for record in records}) == 5
    assert len(records) == 9 + 4  # none of them twice: nine fused, and four meshed from two of these
    for record in records:
        assert f"<dd>{record.vertices:,}</dd>" in page
        assert f"<dd>{1000 * record.metrics['chamfer_m']:.3g} mm</dd>" in page


def test_every_picture_is_a_file_too(reported):
    page = (reported / "out" / "report.html").read_text()
    pictures = {path.stem for path in (reported / "out" / "images" / "ball").glob("*.png")}
    assert {"photograph", "coloured", "frames-010", "voxel-8", "truncation-16", "mesher-marching-cubes"} <= pictures
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
    # One of the four meshes is lost: it alone is meshed again, from the volume that is fused again.
    shutil.copytree(reported / "ball", tmp_path / "ball")
    shutil.copytree(reported / "out", tmp_path / "out")
    lost = next(
        path.parent
        for path in (tmp_path / "out").glob("runs/ball/meshed-*/reconstruction.json")
        if read_record(path.parent).config["oracle"] == "volume"
    )
    shutil.rmtree(lost)
    counted = []
    mesh_volume = runs.mesh_volume
    monkeypatch.setattr(
        runs, "mesh_volume", lambda *given, **options: counted.append(given) or mesh_volume(*given, **options)
    )
    monkeypatch.setattr(runs, "TIMED_FOR", 0.0)
    assert (
        main(["report", str(tmp_path / "ball"), str(tmp_path / "out"), "--voxel-size", "0.02", "--device", "cpu"]) == 0
    )
    assert {given[1] for given in counted} == {"dual-contouring"}
    assert (lost / "mesh.ply").is_file()


def test_what_dual_contouring_costs_and_gains_is_said_with_the_numbers_of_its_records(reported):
    page = (reported / "out" / "report.html").read_text()
    made = {}
    for path in (reported / "out").glob("runs/ball/meshed-*/reconstruction.json"):
        record = read_record(path.parent)
        seconds = json.loads((path.parent / runs.VARIANT_FILE).read_text())["seconds"]
        made[record.config["mesher"], record.config["oracle"], record.voxel_size_m] = record, seconds
    cubes, coarse = made["marching-cubes", "depth", 0.02], made["dual-contouring", "depth", 0.04]
    share = 100 * coarse[0].vertices / cubes[0].vertices
    assert f"On voxels twice as large it has {share:.0f} % of them" in page
    times = made["dual-contouring", "volume", 0.02][1] / cubes[1]
    assert f"it costs {times:.1f} times marching cubes" in page
    # A ball has no sharp edges, and all of it is smooth.
    assert "<dt>smooth parts</dt>" in page
    assert "<dt>sharp edges</dt>" not in page


def test_two_datasets_of_one_name_are_refused(reported, tmp_path, capsys):
    data = str(reported / "ball")
    assert main(["report", data, data, str(tmp_path / "out")]) == 2
    assert "two datasets are called 'ball'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_picture_shows_a_sphere_where_the_camera_sees_it():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    mesh = Mesh(vertices=np.asarray(sphere.vertices, np.float32), triangles=np.asarray(sphere.faces, np.int32))
    camera = PinholeCamera(width=200, height=160, fx=300, fy=300, cx=110, cy=70)
    picture = picture_of_mesh(mesh, camera, look_at((0, -2, 0), (0, 0, 0)), device=CPU)
    v, u = np.nonzero((picture < 250).all(axis=-1))
    assert (u.mean(), v.mean()) == pytest.approx((110, 70), abs=0.3)
    # Its outline is seen at the tangent's angle.
    radius = 300 * np.tan(np.arcsin(0.3 / 2))
    assert len(u) == pytest.approx(np.pi * radius**2, rel=0.03)


def test_unshaded_colours_are_shown_as_they_are():
    square = trimesh.creation.box((1, 1, 1))
    mesh = Mesh(vertices=np.asarray(square.vertices, np.float32), triangles=np.asarray(square.faces, np.int32))
    camera = PinholeCamera(width=20, height=20, fx=20, fy=20, cx=9.5, cy=9.5)
    colors = np.tile([0.2, 0.5, 0.9], (len(mesh.vertices), 1))
    picture = picture_of_mesh(mesh, camera, look_at((0, -1, 0), (0, 0, 0)), device=CPU, colors=colors, shaded=False)
    np.testing.assert_array_equal(picture[10, 10], np.rint(255 * colors[0]))


def test_heat_grows_brighter_and_ends_at_the_most():
    brightness = heat(np.linspace(0, 2, 9), most=2.0) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(brightness) > 0).all()
    np.testing.assert_array_equal(heat(2.0, most=2.0), heat(50.0, most=2.0))
    np.testing.assert_array_equal(heat_bar()[0, -1], np.rint(255 * heat(1, most=1.0)))
