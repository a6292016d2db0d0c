"""Datasets of a floor, each frame of one grey, for the tests of previews."""

import numpy as np

from datagen.camera import PinholeCamera
from datagen.dataset_format import Intrinsics, Metadata, write_metadata
from datagen.dataset_writer import write_frame
from datagen.rigid import look_at

CAMERA = PinholeCamera(width=80, height=60, fx=90.0, fy=90.0, cx=39.5, cy=29.5)
SEVEN_SCENES_CAMERA = PinholeCamera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0)
FRAMES = 10


def gray(frame):
    """The brightness of a frame's colour image."""
    return 40 + 20 * frame


def write_dataset(folder, *, frames=FRAMES, foreign=False):
    """Write ``frames`` frames of the floor z = 0, seen from a path around it; return the folder."""
    camera = SEVEN_SCENES_CAMERA if foreign else CAMERA
    for frame in range(frames):
        angle = 0.3 * frame
        pose = look_at([np.cos(angle), np.sin(angle), 0.8 + 0.02 * frame], [0, 0, 0])
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        down = rays @ pose[2, :3]
        depth = np.where(down < 0, -pose[2, 3] / np.minimum(down, -1e-9), 0)
        depth[depth > 5] = 0
        write_frame(
            folder if foreign else folder / "frames",
            frame,
            color=np.full((camera.height, camera.width, 3), gray(frame), np.uint8),
            depth=depth,
            world_from_camera=pose,
            depth_scale=0.001 if foreign else 0.0001,
        )
    if foreign:
        return folder
    intrinsics = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    metadata = Metadata(
        frame_count=frames,
        intrinsics=Intrinsics(**intrinsics),
        depth_scale=0.0001,
        frames_per_second=25.0,
        ground_truth_mesh="ground_truth/mesh.ply",
        recipe={"name": "floor"},
        provenance={},
    )
    write_metadata(folder, metadata)
    return folder
