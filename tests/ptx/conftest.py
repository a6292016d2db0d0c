"""The same work on the CPU's kernels and on the GPU's code: a real GPU where there is one, else PTX run on the CPU."""

from collections.abc import Iterator
from typing import Any

import pytest
import warp as wp
from warp._src import context

from fusion.devices import resolve_device
from ptx.compile import compiler
from ptx.device import Machine
from ptx.install import ptx_device


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    """A CUDA device that is PTX on the CPU."""
    resolve_device("cpu")
    if wp.get_cuda_devices():
        if not isinstance(context.runtime.core, Machine):
            pytest.skip("there is a GPU: it runs what this stands in for")
        yield context.runtime.core
        return
    if compiler() is None:
        pytest.skip("no C compiler to compile the translated PTX with")
    with ptx_device() as machine:
        yield machine


@pytest.fixture(scope="module")
def cuda(request: pytest.FixtureRequest) -> Any:
    """The CUDA device: a real one where there is one."""
    resolve_device("cpu")
    if not wp.get_cuda_devices():
        request.getfixturevalue("machine")
    return resolve_device("cuda")


@pytest.fixture(scope="module")
def cpu() -> Any:
    return resolve_device("cpu")
