from types import SimpleNamespace

import numpy as np
import pytest

from fusion.report.mesher_findings import Outcome, Outcomes, cleaner, expensive, lower_in_polygons, vertices_for
from fusion.report.thin_triangles import thin_share
from fusion.surface.mesh import Mesh


def test_thin_triangles_are_those_with_a_small_angle():
    def triangle(smallest_deg):
        half = np.tan(np.radians(smallest_deg / 2))
        return np.array([[0, 0, 0], [1, -half, 0], [1, half, 0]])

    angles = [5.0, 9.9, 10.1, 59.9]
    corners = np.concatenate([triangle(angle) for angle in angles] + [np.zeros((3, 3))]).astype(np.float32)
    mesh = Mesh(vertices=corners, triangles=np.arange(15, dtype=np.int32).reshape(5, 3))
    assert thin_share(mesh) == pytest.approx(3 / 5)


def test_vertices_for_an_error_follow_the_law_through_two_meshes():
    # An error that falls as 1/n.
    fine, coarse = outcome(vertices=4000, chamfer=0.25), outcome(vertices=1000, chamfer=1.0)
    assert vertices_for(0.5, fine=fine, coarse=coarse) == pytest.approx(2000)
    assert vertices_for(0.125, fine=fine, coarse=coarse) == pytest.approx(8000)


@pytest.mark.parametrize(
    ("seconds", "answer"),
    [
        ((1.0, 2.0, 2.9), "No longer"),
        ((1.0, 2.0, 4.0), "By the volume no longer"),
        ((1.0, 4.0, 2.0), "Where the depth images are asked no longer"),
        ((1.0, 4.0, 4.0), "Yes"),
    ],
)
def test_what_is_expensive_follows_from_the_times(seconds, answer):
    cubes, volume, depth = (outcome(seconds=each) for each in seconds)
    every = outcomes(cubes=cubes, volume=volume, depth=depth)
    assert expensive(every, on_gpu=False)[0].startswith(f"Expensive? {answer}")


def test_what_is_cleaner_follows_from_the_errors():
    cubes, near, far = (outcome(sharp=error) for error in (1.0, 0.5, 1.5))

    def answer(volume, depth):
        return cleaner(outcomes(cubes=cubes, volume=volume, depth=depth))[0]

    assert answer(near, near) == "Cleaner? Yes."
    assert answer(far, near) == "Cleaner? Yes where the depth images are asked, not by the volume alone."
    assert answer(near, far) == "Cleaner? Yes by the volume, not where the depth images are asked."
    assert answer(far, far) == "Cleaner? No."


def test_fewer_polygons_for_the_same_error_are_told_from_fewer_on_the_same_voxels():
    cubes, coarse_cubes = outcome(vertices=4000, chamfer=0.25), outcome(vertices=1000, chamfer=1.0)

    def answer(depth, coarse_depth, merged=cubes):
        coarse = {"coarse_cubes": coarse_cubes, "coarse_depth": coarse_depth}
        return lower_in_polygons(outcomes(cubes=cubes, depth=depth, merged=merged, **coarse))[0]

    exact, alike = outcome(vertices=1000, chamfer=0.3), outcome(vertices=1000, chamfer=1.0)
    assert answer(outcome(vertices=2000), exact) == "Lower in polygons? Yes."
    assert answer(cubes, exact) == "Lower in polygons? Not on the same voxels; for the same error, yes."
    assert answer(cubes, alike) == "Lower in polygons? No."
    few, worse = outcome(vertices=1000, chamfer=0.2), outcome(vertices=1000, chamfer=0.3)
    assert answer(cubes, alike, few) == "Lower in polygons? Yes where cells are merged, at no greater error."
    assert answer(cubes, alike, worse) == "Lower in polygons? No."


def test_what_decimation_leaves_of_the_error_is_told_of_all_three():
    cubes, volume, depth = (outcome(vertices=4000, chamfer=error) for error in (0.25, 0.2, 0.1))
    told = lower_in_polygons(outcomes(cubes=cubes, volume=volume, depth=depth))[1]
    assert "25 % of the triangles" in told
    assert told.index("500 mm (m") < told.index("400 mm (by the v") < told.index("200 mm (by the d")


def outcomes(**given):
    """Outcomes of which only some matter."""
    names = ("cubes", "volume", "depth", "merged", "coarse_cubes", "coarse_depth")
    return Outcomes(**{name: given.get(name, outcome()) for name in names})


def outcome(*, vertices=1000, chamfer=1.0, seconds=1.0, sharp=None):
    """An outcome of meshing with the numbers of interest."""
    record = SimpleNamespace(
        vertices=vertices,
        metrics={"chamfer_m": chamfer},
        frames=1,
        seconds=SimpleNamespace(allocate=1.0, integrate=1.0),
    )
    return Outcome(
        run=SimpleNamespace(record=record, mesh_seconds=seconds),
        sharp=sharp,
        smooth=1.0,
        thin=0.1,
        decimated=2 * chamfer,
    )
