import subprocess
import sys


def loaded_by(statement):
    """Return the modules that are loaded after a statement, in a fresh interpreter."""
    code = f"{statement}\nimport sys\nprint('\\n'.join(sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_fusion_loads_no_blender_and_no_renderer():
    loaded = loaded_by("import fusion.cli, fusion.reconstruct, fusion.pose.locate, fusion.evaluation.evaluate")
    assert "warp" in loaded
    assert "bpy" not in loaded
    assert not any(name.startswith(("datagen.blender", "blender_addon")) for name in loaded)
