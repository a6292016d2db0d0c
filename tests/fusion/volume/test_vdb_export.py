import subprocess
import sys

import numpy as np
import pytest
from analytic_volume import analytic_volume, sphere, voxel_centres

from datagen.color import linear_from_srgb
from datagen.errors import InputError
from fusion.volume import vdb_export
from fusion.volume.vdb_export import load_openvdb, write_vdb

CENTRE, RADIUS, VOXEL_SIZE, TRUNCATION = np.array([0.05, 0.02, -0.03]), 0.15, 0.02, 0.08

try:
    load_openvdb()
except InputError:
    HAS_OPENVDB = False
else:
    HAS_OPENVDB = True
needs_openvdb = pytest.mark.skipif(not HAS_OPENVDB, reason="OpenVDB comes with Blender as a module, which is not here")


def some_seen(points):
    return np.random.default_rng(1).integers(0, 3, len(points)).astype(float)


def some_colored(points):
    return some_seen(points) * (np.random.default_rng(2).random(len(points)) < 0.5)


def color(points):
    return 128 + 300 * points


def sphere_volume(device, **options):
    return analytic_volume(
        sphere(CENTRE, RADIUS),
        (-0.3,) * 3,
        (0.3,) * 3,
        device=device,
        voxel_size=VOXEL_SIZE,
        truncation=TRUNCATION,
        color=color,
        **options,
    )


@needs_openvdb
@pytest.mark.parametrize("storage", ["full", "packed"])
def test_active_voxels_are_those_seen_and_hold_metres_and_linear_colours(device, tmp_path, storage):
    volume = sphere_volume(device, weight=some_seen, color_weight=some_colored, storage=storage)
    write_vdb(tmp_path / "volume.vdb", volume)
    vdb = load_openvdb()
    distances, colors = (vdb.read(str(tmp_path / "volume.vdb"), name) for name in ("distance", "color"))
    points = voxel_centres(volume)
    seen, colored = some_seen(points) > 0, some_colored(points) > 0
    assert 0.5 < seen.mean() < 0.8
    assert distances.activeVoxelCount() == seen.sum()
    assert colors.activeVoxelCount() == colored.sum()
    assert distances.background == pytest.approx(TRUNCATION)
    truth = np.clip(sphere(CENTRE, RADIUS)(points), -TRUNCATION, TRUNCATION)
    lattice = np.rint(points / VOXEL_SIZE).astype(int)
    at_distance, at_color = distances.getConstAccessor(), colors.getConstAccessor()
    for i in range(0, len(points), 7):
        index = tuple(lattice[i].tolist())
        np.testing.assert_allclose(distances.transform.indexToWorld(index), points[i], atol=1e-9)
        value, active = at_distance.probeValue(index)
        assert active == seen[i]
        assert value == pytest.approx(truth[i] if seen[i] else TRUNCATION, abs=1e-5)
        value, active = at_color.probeValue(index)
        assert active == colored[i]
        level = color(points[i]) / 255 if colored[i] else np.zeros(3)
        np.testing.assert_allclose(value, linear_from_srgb(level), atol=1e-5 if storage == "full" else 0.01)


IN_BLENDER = """
import sys, numpy, bpy
folder, name = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.object.volume_import(filepath=f"{folder}/{name}", directory=folder, files=[{"name": name}])
volume = bpy.context.object
volume.data.grids.load()
mesh = bpy.data.objects.new("mesh", bpy.data.meshes.new("mesh"))
bpy.context.collection.objects.link(mesh)
modifier = mesh.modifiers.new("mesh", "VOLUME_TO_MESH")
modifier.object, modifier.grid_name, modifier.threshold = volume, "distance", 0.0
evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
points = numpy.empty(3 * len(evaluated.vertices))
evaluated.vertices.foreach_get("co", points)
radii = numpy.linalg.norm(points.reshape(-1, 3) - (0.05, 0.02, -0.03), axis=-1)
print("found", sorted((grid.name, grid.data_type) for grid in volume.data.grids), len(radii), radii.min(), radii.max())
"""


@needs_openvdb
def test_blender_opens_it_and_finds_the_sphere_in_its_place(device, tmp_path):
    pytest.importorskip("bpy")
    write_vdb(tmp_path / "volume.vdb", sphere_volume(device))
    done = subprocess.run(
        [sys.executable, "-c", IN_BLENDER, str(tmp_path), "volume.vdb"], capture_output=True, text=True, check=True
    )
    found = next(line for line in done.stdout.splitlines() if line.startswith("found"))
    assert "[('color', 'VECTOR_FLOAT'), ('distance', 'FLOAT')]" in found
    count, least, most = (float(text) for text in found.split()[-3:])
    assert count > 500
    assert least == pytest.approx(RADIUS, abs=0.1 * VOXEL_SIZE)
    assert most == pytest.approx(RADIUS, abs=0.1 * VOXEL_SIZE)


def test_without_openvdb_the_remedy_is_said_and_nothing_written(device, tmp_path, monkeypatch):
    monkeypatch.setattr(vdb_export.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"needs OpenVDB.*pip install 'scanback\[blender\]'"):
        write_vdb(tmp_path / "volume.vdb", sphere_volume(device))
    assert not list(tmp_path.iterdir())
