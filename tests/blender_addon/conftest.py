"""Reconstructions to bring into Blender, and a fresh Blender scene for each test."""

import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest
from scanned_project import Project, make_project, open_copy
from sphere_scan import SphereScan, make_sphere_scan

import blender_addon


@pytest.fixture
def empty_scene() -> Iterator[bpy.types.Scene]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    yield bpy.context.scene
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def extension(empty_scene: bpy.types.Scene) -> Iterator[None]:
    blender_addon.register()
    yield
    blender_addon.unregister()


@pytest.fixture
def sphere_scan(tmp_path: Path) -> SphereScan:
    """A reconstruction folder of a coloured sphere, with its dataset."""
    return make_sphere_scan(tmp_path / "sphere")


@pytest.fixture(scope="session")
def made_project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scanned and fused scene, made once for all of the processes that test."""
    base = tmp_path_factory.getbasetemp()
    place = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "scanned-project"
    place.mkdir(exist_ok=True)
    with (place.with_suffix(".lock")).open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "seen.json").is_file():
            blender_addon.register()
            make_project(place)
            blender_addon.unregister()
    return place


@pytest.fixture
def project(made_project: Path, extension: None, tmp_path: Path) -> Project:
    """A copy of the scanned and fused scene, open in Blender."""
    return open_copy(made_project, tmp_path / "project")
