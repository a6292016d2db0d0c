"""Every kernel compiles for NVIDIA GPUs, whether or not there is one: NVRTC needs no driver.

What was compiled lies in Warp's cache, by a hash of its source, its options and Warp's version: what has not changed
since is not compiled again, and ``tests/ptx`` runs the very same files.
"""

import importlib
import itertools
import pkgutil
from pathlib import Path

import pytest
import warp as wp

import fusion
from fusion.devices import resolve_device
from fusion.evaluation import observed_surface
from fusion.frames import color_confidence, depth_tiles
from fusion.integration import integrate, pixel_weights
from fusion.surface.dual_contouring import depth_oracle, frame_scores
from fusion.surface.dual_contouring.dual_contouring import oracle_kernels
from fusion.surface.dual_contouring.oracle import Oracle

ARCHITECTURES = [75, 80, 90]


def kernel_modules():
    resolve_device("cpu")
    found = pkgutil.walk_packages(fusion.__path__, "fusion.")
    names = [info.name for info in found if not info.name.endswith("__main__")]
    modules = [importlib.import_module(name) for name in names]
    return [m for m in modules if any(isinstance(value, wp.Kernel) for value in vars(m).values())]


def kernels_made_to_measure():
    """Yield those that are made for a type of depth and for options."""
    for depth_type in (wp.uint16, wp.float32):
        for stage in (color_confidence, depth_tiles, pixel_weights, observed_surface):
            yield pytest.param(stage.kernel(depth_type), id=f"{stage.__name__}-{depth_type.__name__}")
        for bilinear, weighted, drop_off in itertools.product((False, True), repeat=3):
            options = {"bilinear": bilinear, "weighted": weighted, "drop_off": drop_off}
            asked = "-".join(name for name, value in options.items() if value)
            kernel = integrate.kernel(depth_type, by_voxel=True, **options)
            yield pytest.param(kernel, id=f"fusion.integration.integrate-{depth_type.__name__}-{asked or 'paper'}")


def kernels_made_for_oracles():
    """Yield those of dual contouring that ask for the depth images' field."""
    for depth_type, weighted in itertools.product((wp.uint16, wp.float32), (False, True)):
        value, state_type = depth_oracle.depth_value(depth_type, weighted=weighted)
        choice = frame_scores.score_kernel(depth_type, weighted=weighted)
        for kernel in [choice, *oracle_kernels(Oracle(value, state_type, None))]:
            name = f"{kernel.key.split('__')[-1]}-{depth_type.__name__}-{'weighted' if weighted else 'constant'}"
            yield pytest.param(kernel, id=name)


def compile_for(module, architecture):
    name = module.get_module_identifier()
    compiled = Path(wp.config.kernel_cache_dir) / name / f"{name}.sm{architecture}.ptx"
    if not compiled.exists():
        wp.compile_aot_module(module, arch=architecture, use_ptx=True)
    ptx = compiled.read_text(encoding="latin1")
    assert f".target sm_{architecture}" in ptx
    assert all(f".entry {kernel.get_mangled_name()}_cuda_kernel_forward(" in ptx for kernel in module.kernels.values())


def test_there_are_kernels_to_compile():
    found = {module.__name__ for module in kernel_modules()}
    assert {
        "fusion.volume.block_table",
        "fusion.integration.find_blocks",
        "fusion.integration.visible_blocks",
        "fusion.surface.marching_cubes",
    } <= found


@pytest.mark.parametrize("module", kernel_modules(), ids=lambda module: module.__name__)
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_kernels_compile_for_cuda(module, architecture):
    compile_for(wp.get_module(module.__name__), architecture)


@pytest.mark.parametrize("kernel", [*kernels_made_to_measure(), *kernels_made_for_oracles()])
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_kernels_made_to_measure_compile_for_cuda(kernel, architecture):
    compile_for(kernel.module, architecture)
