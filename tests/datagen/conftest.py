import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen.scene_spec.scene import Scene


@pytest.fixture(scope="session")
def blender() -> None:
    """Skip where Blender is not installed."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip('Blender is not installed: pip install "scanback[blender]"')


@pytest.fixture
def make_scene() -> Callable[..., Scene]:
    """A small, quick scene: a ball seen from a camera that passes by; keywords replace its tables."""
    content: dict[str, Any] = {
        "name": "small",
        "render": {"frames": 3, "size": [64, 48], "samples": 1, "bounces": 1, "denoise": False},
        "materials": {"red": {"color": "#c03020"}},
        "objects": [{"name": "Ball", "shape": "sphere", "material": "red", "scale": 0.4}],
        "lights": [{"type": "sun", "position": [1, -2, 3], "power": 2}],
        "keyframes": [
            {"time": 0, "position": [-0.5, -2, 0.3], "look_at": [0, 0, 0]},
            {"time": 1, "position": [0.5, -2, 0.6], "look_at": [0, 0, 0]},
        ],
    }
    return lambda **changes: Scene.model_validate_json(json.dumps(content | changes))


@pytest.fixture
def open_session(blender: None, tmp_path: Path) -> Callable[[Scene], Any]:
    """Make a scene in this process' Blender, which is emptied first."""
    from datagen.blender.session import RenderSession

    return lambda scene: RenderSession(scene, device="cpu", threads=0, scratch=tmp_path)
