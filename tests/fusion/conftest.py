"""Every numerical test of fusion runs on each device there is.

``SCANBACK_PTX=1 pytest tests/fusion`` gives Warp a CUDA device whose kernels are NVRTC's PTX, run on the CPU (see
``tests/ptx``): so all of these tests run Scanback's CUDA code without a GPU, some ten times as long. With
``SCANBACK_PTX=late`` nothing runs before it is waited for; with a number, threads and blocks run in another order.
"""

import os
from typing import Any

import pytest
import warp as wp

from fusion.devices import resolve_device


def _devices() -> list[str]:
    resolve_device("cpu")
    asked = os.environ.get("SCANBACK_PTX")
    if asked and not wp.get_cuda_devices():
        from ptx.install import install_for_all

        install_for_all(asked)
    return ["cpu", *(str(device.alias) for device in wp.get_cuda_devices())]


@pytest.fixture(params=_devices())
def device(request: pytest.FixtureRequest) -> Any:
    return resolve_device(request.param)
