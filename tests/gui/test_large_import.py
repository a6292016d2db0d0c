"""Blender's interface stays alive while a large mesh is imported."""

import json

import numpy as np
import pytest
import trimesh

SIDE = 1000
STALL_MS = 300.0
"""The longest that the extension may keep Blender's main thread while a million vertices are imported.

Of processor time: how long that takes by the clock depends on what else the machine does.
"""


@pytest.fixture(scope="module")
def seen(desktop):
    _write_ball(desktop.shared / "large")
    return desktop.run("large_session.py")


def test_a_million_vertices_come_in_piece_by_piece(seen):
    state, message = seen["ended"]
    assert state == "done", message
    assert seen["vertices"] == [SIDE * SIDE]
    assert seen["stalls"]["call_processor_ms"] <= STALL_MS, seen["stalls"]["longest_calls"]


def _write_ball(folder):
    """Write a reconstruction of a ball, its surface a grid of SIDE × SIDE vertices, coloured by direction."""
    folder.mkdir()
    polar, around = np.meshgrid(np.linspace(0.01, np.pi - 0.01, SIDE), np.linspace(0, 2 * np.pi, SIDE), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + SIDE, corner + 1]),
            np.column_stack([corner + 1, corner + SIDE, corner + SIDE + 1]),
        ]
    )
    colors = np.rint(127.5 + 120 * np.sin(3 * points + (0, 1, 2))).astype(np.uint8).reshape(-1, 3)
    mesh = trimesh.Trimesh(points.reshape(-1, 3), faces, vertex_colors=colors, process=False)
    mesh.export(folder / "mesh.ply")
    pose = np.eye(4)
    pose[2, 3] = -3
    record = {
        "format": "scanback-reconstruction",
        "version": 1,
        "dataset": "dataset",
        "frames": 1,
        "camera": {"width": 160, "height": 120, "fx": 150.0, "fy": 150.0, "cx": 80.0, "cy": 60.0},
        "trajectory": [{"frame": 0, "world_from_camera": pose.tolist()}],
    }
    (folder / "reconstruction.json").write_text(json.dumps(record))
