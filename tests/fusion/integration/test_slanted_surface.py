"""What a frame sees edge-on is fused as the plane that it is; what it sees at an edge in depth is not bridged."""

import numpy as np
from analytic_depth import CAMERA, step, tilted_plane

from datagen.rigid import look_at
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.tsdf_volume import Volume

EXACT = Integration(depth_sampling="bilinear", drop_off=True)
# Along an axis, the plane's depth changes by 5.7 voxels a voxel: less than the truncation, which would cut it off.
VOXEL, TRUNCATION = 0.002, 0.012
TILT_DEG = 80.0
NORMAL = np.array([np.sin(np.radians(TILT_DEG)), 0.0, np.cos(np.radians(TILT_DEG))])


def fused(depths, device, poses):
    lengths = {"voxel_size": VOXEL, "truncation": TRUNCATION}
    volume = Volume(device=device, max_blocks=10**5, **lengths)
    color = np.full((CAMERA.height, CAMERA.width, 3), 200, np.uint8)
    batch = FrameUploader(CAMERA, device=device)(depths, poses, [color] * len(depths))
    find_batch_blocks(volume.table, batch, **lengths)
    volume.reserve(volume.table.count)
    integrate_batch(volume, batch, EXACT)
    return marching_cubes(volume)


def edge_on(distance=1.0):
    """Return depth of a plane at 80°, within 1.3 m, whose neighbouring pixels differ by more than the truncation."""
    depth, _ = tilted_plane(CAMERA, distance=distance, tilt_deg=TILT_DEG)
    depth[depth > 1.3] = 0
    steps = np.abs(np.diff(depth, axis=1))[(depth[:, 1:] > 0.9) & (depth[:, :-1] > 0.9)]
    assert steps.min() > TRUNCATION
    return depth


def test_a_plane_that_is_only_seen_edge_on_is_fused(device):
    mesh = fused([edge_on()], device, [np.eye(4)])
    near = (mesh.vertices[:, 2] > 0.95) & (mesh.vertices[:, 2] < 1.25)
    assert near.sum() > 1000
    # The plane n · p = n_z: exact, but for rounding.
    assert np.abs(mesh.vertices @ NORMAL - NORMAL[2])[near].max() < 0.02 * VOXEL


def test_a_frame_that_sees_it_better_has_the_say(device):
    # The one who sees it edge-on is off by half a voxel.
    centre = np.array([0.0, 0.0, 1.0])
    pose = look_at(centre - 0.5 * NORMAL, centre)
    facing = np.full((CAMERA.height, CAMERA.width), 0.5, np.float32)
    mesh = fused([edge_on(1 + 0.5 * VOXEL / NORMAL[2]), facing], device, [np.eye(4), pose])
    near = np.linalg.norm(mesh.vertices - centre, axis=1) < 0.1
    assert near.sum() > 100
    # Of its error 1/256 is left, in what is steeper by 1 / cos 80°.
    assert np.abs(mesh.vertices @ NORMAL - NORMAL[2])[near].max() < 0.5 * VOXEL * 6 / 256 + 0.02 * VOXEL


def test_an_edge_in_depth_is_not_bridged(device):
    mesh = fused([step(CAMERA, near=0.8, far=0.84, column=160)], device, [np.eye(4)])
    z = mesh.vertices[:, 2]
    assert (np.abs(z - 0.8) < 0.01 * VOXEL).any()
    assert (np.abs(z - 0.84) < 0.01 * VOXEL).any()
    assert (np.minimum(np.abs(z - 0.8), np.abs(z - 0.84)) < 0.01 * VOXEL).all()
