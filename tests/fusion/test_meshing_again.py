"""What is meshed again from the disk is meshed as it was, or as was asked for."""

import json
import shutil

import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, write_dataset

from fusion.cli import main

SCENE, VOXEL_SIZE = SphereScene(), 0.03
WAYS = {
    "cubes": ["--mesher", "marching-cubes"],
    "volume": ["--mesher", "dual-contouring", "--oracle", "volume"],
    "depth": ["--mesher", "dual-contouring", "--oracle", "depth"],
    "merged": ["--mesher", "dual-contouring", "--oracle", "depth", "--flatness", "0.1"],
}
EVERYWHERE = ["--low", "_", "_", "_"]


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A dataset, and all of its frames fused and meshed in each way."""
    folder = tmp_path_factory.mktemp("base")
    data = write_dataset(folder / "data", SCENE.frames_around(16))
    for name, way in WAYS.items():
        assert run("reconstruct", data, folder / name, "--voxel-size", VOXEL_SIZE, *way) == 0
    return folder


def run(*arguments):
    return main([str(argument) for argument in arguments])


def mesh_in(path):
    mesh = trimesh.load(path, process=False)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def assert_same(one, other):
    for ours, theirs in zip(one, other, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("way", WAYS)
def test_a_crop_of_everything_has_the_mesh_of_the_whole(base, tmp_path, way):
    assert run("crop", base / way, tmp_path / "crop", *EVERYWHERE) == 0
    assert_same(mesh_in(tmp_path / "crop" / "mesh.ply"), mesh_in(base / way / "mesh.ply"))


@pytest.mark.parametrize("way", WAYS)
def test_an_export_is_the_mesh_with_normals_out_of_it(base, tmp_path, way):
    assert run("export", base / way, tmp_path / "mesh.ply") == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(base / way / "mesh.ply"))
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    radial = (mesh.vertices - np.array(SCENE.centre)) / SCENE.radius
    assert np.median((mesh.vertex_normals * radial).sum(axis=1)) > 0.99
    assert run("export", base / way, tmp_path / "points.ply", "--points") == 0
    np.testing.assert_array_equal(
        trimesh.load(tmp_path / "points.ply", process=False).vertices, mesh_in(base / way / "mesh.ply")[0]
    )


@pytest.mark.parametrize("way", WAYS)
def test_another_mesher_can_be_asked_for_and_is_recorded(base, tmp_path, way):
    # What was fused is the same: meshing again in a way gives the mesh that it gave at once.
    assert run("crop", base / "cubes", tmp_path / "crop", *EVERYWHERE, *WAYS[way]) == 0
    assert_same(mesh_in(tmp_path / "crop" / "mesh.ply"), mesh_in(base / way / "mesh.ply"))
    config = json.loads((tmp_path / "crop" / "reconstruction.json").read_text())["config"]
    assert config["mesher"] == WAYS[way][1]
    # And a crop of the crop goes by what its record says.
    assert run("crop", tmp_path / "crop", tmp_path / "again", *EVERYWHERE) == 0
    assert_same(mesh_in(tmp_path / "again" / "mesh.ply"), mesh_in(base / way / "mesh.ply"))
    assert run("export", base / "cubes", tmp_path / "mesh.ply", *WAYS[way]) == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(base / way / "mesh.ply"))


@pytest.mark.parametrize("way", WAYS)
def test_merged_halves_are_meshed_as_they_were(base, tmp_path, way):
    for name, frames in (("even", "0::2"), ("odd", "1::2")):
        arguments = ["--voxel-size", VOXEL_SIZE, "--frames", frames, *WAYS[way]]
        assert run("reconstruct", base / "data", tmp_path / name, *arguments) == 0
    assert run("merge", tmp_path / "even", tmp_path / "odd", tmp_path / "both") == 0
    record = json.loads((tmp_path / "both" / "reconstruction.json").read_text())
    assert (record["config"]["mesher"], record["config"]["oracle"]) == (WAYS[way][1], (WAYS[way] + ["", "depth"])[3])
    merged, whole = (trimesh.load(folder / "mesh.ply", process=False) for folder in (tmp_path / "both", base / way))
    # Packed sums are rounded differently when they are added up in halves.
    assert len(merged.faces) == pytest.approx(len(whole.faces), rel=0.02)
    assert merged.area == pytest.approx(whole.area, rel=0.005)
    # A crop of what was merged knows the mesher too.
    assert run("crop", tmp_path / "both", tmp_path / "crop", *EVERYWHERE) == 0
    assert_same(mesh_in(tmp_path / "crop" / "mesh.ply"), mesh_in(tmp_path / "both" / "mesh.ply"))


def test_the_least_weight_is_kept_too(base, tmp_path):
    arguments = ["--voxel-size", VOXEL_SIZE, "--min-weight", 3]
    assert run("reconstruct", base / "data", tmp_path / "often", *arguments) == 0
    assert run("export", tmp_path / "often", tmp_path / "mesh.ply") == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(tmp_path / "often" / "mesh.ply"))
    assert len(mesh_in(tmp_path / "mesh.ply")[1]) < len(mesh_in(base / "cubes" / "mesh.ply")[1])


def refused(capsys, message, *arguments):
    assert run(*arguments) == 2
    assert message in capsys.readouterr().err.replace("\n", "")


def test_depth_images_that_are_gone_are_missed(base, tmp_path, capsys):
    shutil.copytree(base / "depth", tmp_path / "elsewhere" / "depth")
    moved, out = tmp_path / "elsewhere" / "depth", tmp_path / "out"
    message = "which is not there; give --oracle volume, or --mesher marching-cubes"
    refused(capsys, message, "crop", moved, out, *EVERYWHERE)
    refused(capsys, message, "export", moved, tmp_path / "mesh.ply")
    assert not out.exists()
    assert not (tmp_path / "mesh.ply").exists()
    assert run("export", moved, tmp_path / "mesh.ply", "--oracle", "volume") == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(base / "volume" / "mesh.ply"))


def test_parts_meshed_differently_are_refused_unless_it_is_said_how(base, tmp_path, capsys):
    for name, frames, way in (("even", "0::2", "cubes"), ("odd", "1::2", "volume"), ("third", "1::2", "depth")):
        arguments = ["--voxel-size", VOXEL_SIZE, "--frames", frames, *WAYS[way]]
        assert run("reconstruct", base / "data", tmp_path / name, *arguments) == 0
    out = tmp_path / "both"
    message = "meshed with --mesher dual-contouring, and"
    refused(capsys, message, "merge", tmp_path / "even", tmp_path / "odd", out)
    assert not out.exists()
    assert run("merge", tmp_path / "even", tmp_path / "odd", out, *WAYS["volume"]) == 0


def test_cells_are_merged_as_they_were_or_as_is_said(base, tmp_path, capsys):
    few, many = (len(mesh_in(base / way / "mesh.ply")[0]) for way in ("merged", "depth"))
    assert few < 0.8 * many
    assert run("export", base / "merged", tmp_path / "mesh.ply", "--flatness", "0") == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(base / "depth" / "mesh.ply"))
    for name, frames, way in (("even", "0::2", "merged"), ("odd", "1::2", "depth")):
        arguments = ["--voxel-size", VOXEL_SIZE, "--frames", frames, *WAYS[way]]
        assert run("reconstruct", base / "data", tmp_path / name, *arguments) == 0
    message = "meshed with --flatness 0.0, and"
    refused(capsys, message, "merge", tmp_path / "even", tmp_path / "odd", tmp_path / "both")
    assert run("merge", tmp_path / "even", tmp_path / "odd", tmp_path / "both", "--flatness", "0.1") == 0
    assert json.loads((tmp_path / "both" / "reconstruction.json").read_text())["config"]["flatness"] == 0.1
    refused(capsys, "--flatness", "export", base / "depth", tmp_path / "mesh.ply", "--flatness", "-1")
    cubes = [*WAYS["cubes"], "--flatness", "0.1"]
    refused(capsys, "add --mesher dual-contouring", "reconstruct", base / "data", tmp_path / "cubes", *cubes)


def test_options_of_dual_contouring_are_refused_where_it_is_not_what_meshes(base, tmp_path, capsys):
    out, oracle = tmp_path / "out", ["--oracle", "volume"]
    message = "--oracle volume: marching cubes asks no oracle; add --mesher dual-contouring"
    refused(capsys, message, "export", base / "cubes", tmp_path / "mesh.ply", *oracle)
    refused(capsys, message, "crop", base / "cubes", out, *EVERYWHERE, *oracle)
    refused(capsys, message, "crop", base / "volume", out, *EVERYWHERE, *WAYS["cubes"], *oracle)
    refused(capsys, "--flatness 0.1: ", "export", base / "cubes", tmp_path / "mesh.ply", "--flatness", "0.1")
    assert list(tmp_path.iterdir()) == []
    # Without them, what was recorded of the other mesher is no complaint; with it, they are taken.
    assert run("export", base / "depth", tmp_path / "mesh.ply", *WAYS["cubes"]) == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(base / "cubes" / "mesh.ply"))
    assert run("export", base / "cubes", tmp_path / "mesh.ply", *WAYS["volume"]) == 0
    assert_same(mesh_in(tmp_path / "mesh.ply"), mesh_in(base / "volume" / "mesh.ply"))


def test_a_record_that_says_nonsense_is_named(base, tmp_path, capsys):
    shutil.copytree(base / "cubes", tmp_path / "cubes")
    path = tmp_path / "cubes" / "reconstruction.json"
    record = json.loads(path.read_text())
    for change, message in (({"mesher": "cubes"}, "--mesher cubes"), ({"integration": {"speed": 1}}, "speed")):
        path.write_text(json.dumps(record | {"config": record["config"] | change}))
        refused(capsys, "reconstruction.json: config: ", "export", tmp_path / "cubes", tmp_path / "mesh.ply")
        refused(capsys, message, "export", tmp_path / "cubes", tmp_path / "mesh.ply")
