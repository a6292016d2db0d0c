"""Every numerical test of fusion runs on each device there is."""

from typing import Any

import pytest
import warp as wp

from fusion.devices import resolve_device


def _devices() -> list[str]:
    resolve_device("cpu")
    return ["cpu", *(str(device.alias) for device in wp.get_cuda_devices())]


@pytest.fixture(params=_devices())
def device(request: pytest.FixtureRequest) -> Any:
    return resolve_device(request.param)
