"""Every kernel compiles for NVIDIA GPUs, whether or not there is one: NVRTC needs no driver."""

import importlib
import pkgutil

import pytest
import warp as wp

import fusion
from fusion.devices import resolve_device


def kernel_modules():
    resolve_device("cpu")
    names = [f"fusion.{info.name}" for info in pkgutil.iter_modules(fusion.__path__) if info.name != "__main__"]
    modules = [importlib.import_module(name) for name in names]
    return [m for m in modules if any(isinstance(value, wp.Kernel) for value in vars(m).values())]


def test_there_are_kernels_to_compile():
    assert {"fusion.integrate", "fusion.find_blocks", "fusion.marching_cubes"} <= {m.__name__ for m in kernel_modules()}


@pytest.mark.parametrize("module", kernel_modules(), ids=lambda module: module.__name__)
@pytest.mark.parametrize("architecture", [75, 80, 90])
def test_kernels_compile_for_cuda(module, architecture, tmp_path):
    wp.compile_aot_module(module, arch=architecture, use_ptx=True, module_dir=str(tmp_path))
    assert any(path.suffix == ".ptx" for path in tmp_path.rglob("*"))
