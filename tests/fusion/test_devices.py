import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from fusion.devices import SlabLaunch, Step, launch_in_slabs


@wp.kernel
def _add_own_index(first: int, start: wp.array(dtype=int), result: wp.array(dtype=int)):
    index = wp.tid() + first
    result[index] += start[0] + index


@pytest.mark.parametrize(("dim", "least_slab"), [(1, 1), (7, 100), (1000, 1), (1001, 64)])
def test_each_index_is_launched_once_and_again_with_what_then_lies_in_the_arrays(device, dim, least_slab):
    start, result = wp.zeros(1, dtype=int, device=device), wp.zeros(dim, dtype=int, device=device)
    launch = SlabLaunch(_add_own_index, dim=dim, inputs=[start], outputs=[result], device=device, least_slab=least_slab)
    launch.run()
    np.testing.assert_array_equal(result.numpy(), np.arange(dim))
    start.fill_(5)
    launch.run()
    np.testing.assert_array_equal(result.numpy(), 5 + 2 * np.arange(dim))


@wp.kernel
def _repeat(first: int, threads: int, single: wp.array(dtype=int), repeated: wp.array(dtype=int)):
    index = wp.tid() + first
    repeated[index] = 10 * single[index / threads] + index % threads


@pytest.mark.parametrize("dim", [1, 7, 1001])
def test_a_step_follows_on_what_its_own_index_was_given(device, dim):
    start, single = wp.zeros(1, dtype=int, device=device), wp.zeros(dim, dtype=int, device=device)
    repeated = wp.zeros(3 * dim, dtype=int, device=device)
    then = Step(kernel=_repeat, inputs=[3, single], outputs=[repeated], threads=3)
    launch_in_slabs(_add_own_index, dim=dim, inputs=[start], outputs=[single], device=device, then=then)
    np.testing.assert_array_equal(repeated.numpy().reshape(dim, 3), 10 * np.arange(dim)[:, None] + np.arange(3))


def test_starting_says_nothing_and_keeps_what_others_say():
    script = """
import os
from fusion.devices import resolve_device
resolve_device("auto")
os.write(2, b"said afterwards")
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert result.stdout == b""
    assert result.stderr == b"said afterwards"
