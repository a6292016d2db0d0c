"""A shape of flat sides, whose outline fixes its pose: three boxes through each other."""

import numpy as np
import trimesh
from three_balls import CAMERA

from datagen.rigid import look_at
from fusion.pose.pose_model import prepare_model
from fusion.pose.shape_volume import volume_from_distances
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

VOXEL = 0.002
BOXES = [((0.3, 0.12, 0.1), (0, 0, 0)), ((0.06, 0.06, 0.3), (0.1, 0.03, 0.06)), ((0.1, 0.3, 0.05), (-0.1, 0.05, 0.03))]
POSES = [look_at(0.8 * np.array(way), (0, 0, 0.02)) for way in ((0.5, -0.8, 0.3), (-0.6, -0.5, -0.5), (0.9, 0.4, 0.2))]


def boxes():
    shape = trimesh.util.concatenate(
        [trimesh.creation.box(extents, trimesh.transformations.translation_matrix(at)) for extents, at in BOXES]
    )
    return Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))


def box_distances(points):
    """Return the signed distance to the union, right outside of it and at its surface."""
    to_each = []
    for extents, at in BOXES:
        beyond = np.abs(points - at) - np.array(extents) / 2
        to_each.append(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))
    return np.min(to_each, axis=0)


def box_model(device, *, grown_by=0.0):
    """Return the model of the boxes, or of what is larger than them by so many metres on all sides."""
    steps = np.linspace(-0.5, 0.5, 100)
    cube = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    cube = cube[np.abs(cube).max(axis=1) == 0.5]
    faces = np.concatenate([np.array(at) + np.array(extents) * cube for extents, at in BOXES])
    volume = volume_from_distances(
        lambda points: box_distances(points) - grown_by, faces, voxel_size=VOXEL, device=device
    )
    return prepare_model(volume, outline=None if grown_by else boxes())


def see_boxes(pose, device, camera=CAMERA):
    """Return exact planar depth."""
    return cast_rays_at_mesh(boxes(), camera, [pose], device=device, depth_only=True).depth.numpy()[0]
