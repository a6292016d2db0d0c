import subprocess
import sys

from fusion.cli import COMMANDS


def loaded_by(statement):
    """Return the modules that are loaded after a statement, in a fresh interpreter."""
    code = f"{statement}\nimport sys\nprint('\\n'.join(sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_fusion_loads_no_blender_and_no_renderer():
    commands = ", ".join(f"fusion.commands.{name.replace('-', '_')}" for name in COMMANDS)
    loaded = loaded_by(f"import {commands}")
    assert "warp" in loaded
    assert "bpy" not in loaded
    assert not any(name.startswith(("datagen.blender", "blender_addon")) for name in loaded)


def test_help_waits_for_nothing_that_is_slow_to_import():
    loaded = loaded_by("from fusion.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass")
    assert "fusion.cli" in loaded
    assert not loaded & {"numpy", "cv2", "warp", "trimesh", "scipy", "pydantic", "rich", "importlib.metadata"}


def test_what_only_dual_contouring_needs_waits_for_it():
    """Its kernels take as long to import as Warp does; marching cubes is the default."""
    loaded = loaded_by("import fusion.commands.reconstruct, fusion.commands.locate, fusion.commands.estimate")
    assert "fusion.surface.meshers" in loaded
    assert "fusion.surface.dual_contouring.dual_contouring" not in loaded
    assert not any(name.startswith("fusion.surface.dual_contouring.cell_merging") for name in loaded)


def test_locating_in_a_reconstruction_waits_for_no_reader_of_meshes():
    loaded = loaded_by("import fusion.commands.locate")
    assert "fusion.pose.target" in loaded
    assert not loaded & {"trimesh", "networkx", "scipy.optimize"}
