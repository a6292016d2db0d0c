"""The kernel that Warp's tape differentiates, against the formula and its derivative written out."""

import numpy as np
import warp as wp
from scipy.special import erf

from fusion.pose.coverage_kernel import COVERAGE_KERNEL, NearestApproach

COUNT, SOFTNESS = 40, 1.3
PIVOT = np.array([0.02, -0.05, 0.01])


def random_cells(rng):
    cells = {"point": rng.uniform(-0.2, 0.2, (COUNT, 3)), "terms": 0.01 * rng.normal(size=(COUNT, 8))}
    return cells | {"low": cells["point"] - rng.uniform(0, 0.01, (COUNT, 3)), "cells_per_metre": np.full(COUNT, 100.0)}


def distances_and_slopes(cells):
    """Return a cell's trilinear field at its point (n,), and its gradient (n, 3)."""
    k, at = cells["terms"].T, (cells["cells_per_metre"][:, None] * (cells["point"] - cells["low"])).T
    x, y, z = at
    value = k[0] + k[1] * x + (k[2] + k[3] * x) * y + (k[4] + k[5] * x + (k[6] + k[7] * x) * y) * z
    along_x = k[1] + k[3] * y + (k[5] + k[7] * y) * z
    along_y = k[2] + k[3] * x + (k[6] + k[7] * x) * z
    along_z = k[4] + k[5] * x + (k[6] + k[7] * x) * y
    return value, cells["cells_per_metre"][:, None] * np.stack([along_x, along_y, along_z], axis=-1)


def test_the_tapes_jacobian_is_the_derivative_of_the_coverage(device):
    rng = np.random.default_rng(0)
    before, after = random_cells(rng), random_cells(rng)
    share, offset, scale = rng.uniform(0, 1, COUNT), 0.001 * rng.normal(size=COUNT), rng.uniform(50, 200, COUNT)
    within, shares = rng.normal(size=COUNT), rng.uniform(0, 1, COUNT)
    told_by = rng.permutation(COUNT)
    approaches = np.zeros(COUNT, dtype=NearestApproach.numpy_dtype())
    for name, cells in (("before", before), ("after", after)):
        for key, values in cells.items():
            approaches[name][key] = values
        approaches[name]["known"] = 1
    approaches["share"], approaches["offset"], approaches["pixels_per_metre"] = share, offset, scale
    twists = wp.zeros(COUNT, dtype=wp.spatial_vector, device=device, requires_grad=True)
    coverage = wp.zeros(COUNT, dtype=float, device=device, requires_grad=True)
    edge = wp.zeros(COUNT, dtype=float, device=device)
    inputs = [
        wp.array(approaches, dtype=NearestApproach, device=device),
        *(wp.array(values, dtype=kind, device=device) for values, kind in ((told_by, int), (within, float))),
        *(wp.array(shares, dtype=float, device=device), twists, wp.vec3(*PIVOT), SOFTNESS),
    ]
    with wp.Tape() as tape:
        wp.launch(COVERAGE_KERNEL, dim=COUNT, inputs=inputs, outputs=[coverage, edge], device=device)
    tape.backward(grads={coverage: wp.ones(COUNT, dtype=float, device=device)})

    (value_before, slope_before), (value_after, slope_after) = map(distances_and_slopes, (before, after))
    distance = share * value_before + (1 - share) * value_after + offset
    # A point moves by v + ω × (x − pivot), and the distance by n · v + ((x − pivot) × n) · ω.
    rows = sum(
        part[:, None] * np.hstack([slope, np.cross(cells["point"] - PIVOT, slope)])
        for part, slope, cells in ((share, slope_before, before), (1 - share, slope_after, after))
    )
    expected_edge = shares * (scale * distance)[told_by] - within
    slope = -np.exp(-0.5 * (expected_edge / SOFTNESS) ** 2) / (SOFTNESS * np.sqrt(2 * np.pi))
    expected = (slope * shares)[:, None] * (scale[:, None] * rows)[told_by]
    # To the rounding of float32, which distances of 0.01 from coordinates of 0.2 keep five digits of.
    np.testing.assert_allclose(edge.numpy(), expected_edge, atol=1e-3)
    np.testing.assert_allclose(coverage.numpy(), 0.5 - 0.5 * erf(expected_edge / (SOFTNESS * 2**0.5)), atol=1e-4)
    np.testing.assert_allclose(twists.grad.numpy(), expected, atol=1e-4 * np.abs(expected).max())
