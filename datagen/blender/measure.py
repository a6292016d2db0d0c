"""A process that tells how large a model file is: ``python -m datagen.blender.measure FILE``, one JSON object.

Standard output has nothing else; what Blender prints goes to standard error.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

from datagen.errors import InputError


def main() -> int:
    """Read the file, print the answer; returns the exit code."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    try:
        answer = measure(Path(sys.argv[1]))
    except InputError as error:
        answer = {"error": str(error)}
    except ModuleNotFoundError as error:
        answer = {
            "error": f"reading models needs the Python module {error.name}, which is not installed: "
            'pip install "scanback[blender]"'
        }
    answers.write(json.dumps(answer))
    answers.close()
    return 1 if "error" in answer else 0


def measure(path: Path) -> dict[str, Any]:
    """Return what ``scene_spec.measured_model.MeasuredModel`` has, ready for JSON."""
    import bpy  # noqa: PLC0415 - what is missing is said in the answer

    from datagen.blender.imports import read_and_freeze  # noqa: PLC0415
    from datagen.blender.measured_camera import camera_settings  # noqa: PLC0415

    frozen = read_and_freeze(path)
    things = [thing for thing in frozen if isinstance(thing, bpy.types.Object)]
    corners = [
        tuple(thing.matrix_basis @ vertex.co)
        for thing in things
        if thing.type == "MESH"
        for vertex in thing.data.vertices
    ]
    low, high = ([pick(axis) for axis in zip(*corners, strict=True)] for pick in (min, max))
    cameras = [thing for thing in things if thing.type == "CAMERA"]
    return {
        "low": low,
        "high": high,
        "is_lit": any(thing.type == "LIGHT" for thing in things) or _shines(bpy.context.scene.world),
        "camera": camera_settings(cameras[0], bpy.context.scene, low, high) if cameras else None,
        "metres_per_unit": _metres_per_unit(bpy.context.scene) if path.suffix.lower() == ".blend" else 1.0,
    }


def _metres_per_unit(scene: Any) -> float:
    """Return how long a unit of Blender's is: what a .blend says of it counts where it has a system of units."""
    units = scene.unit_settings
    return 1.0 if units.system == "NONE" else float(f"{units.scale_length:.7g}")


def _shines(world: Any) -> bool:
    if world is None or world.node_tree is None:
        return False
    backgrounds = [node for node in world.node_tree.nodes if node.type == "BACKGROUND"]
    return any(
        node.inputs["Color"].is_linked
        or node.inputs["Strength"].is_linked
        or node.inputs["Strength"].default_value * max(node.inputs["Color"].default_value[:3]) > 0.1
        for node in backgrounds
    )


if __name__ == "__main__":
    sys.exit(main())
