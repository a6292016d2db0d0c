"""Pictures of meshes for people: shaded, in their own colours or in those of a number at each vertex."""

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.color import linear_from_srgb, srgb8_from_linear
from datagen.rigid import Matrix, transform_points
from fusion.devices import Device
from fusion.render import resized
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

SUPERSAMPLING = 2
"""Rays along each side of a pixel."""

CLAY = (0.76, 0.74, 0.71)
BACK = (0.45, 0.58, 0.72)
"""Clay seen from behind: through a hole, where no frame has seen the other side."""
BACKGROUND = (1.0, 1.0, 1.0)
WIRE = (0.12, 0.14, 0.16)
WIRE_WIDTH = 1.0
"""Pixels of the picture."""

LIGHTS = np.array([[-0.45, -0.75, -0.48], [0.8, -0.1, -0.6], [0.0, 0.6, -0.8]])
"""Towards a key light over the left shoulder, a fill light and one from below; camera axes."""
STRENGTHS = (0.78, 0.26, 0.08)
AMBIENT = 0.14


def picture_of_mesh(
    mesh: Mesh,
    camera: PinholeCamera,
    world_from_camera: Matrix,
    *,
    device: Device,
    colors: NDArray[np.floating] | None = None,
    shaded: bool = True,
    wires: bool = False,
) -> NDArray[np.uint8]:
    """Return what ``camera`` sees of a mesh, (height, width, 3) RGB, white where there is nothing.

    ``colors`` (vertices, 3) are sRGB from 0 to 1; clay where None, bluish where it is seen from behind. Triangles are
    shaded flat, as they are, by three lights that move with the camera; both sides are lit. With ``shaded`` off,
    colours are shown as they are. With ``wires`` the triangles' edges are drawn.
    """
    fine = resized(camera, (camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING))
    hits = cast_rays_at_mesh(mesh, fine, [world_from_camera], device=device)
    triangles, weights = hits.triangles.numpy()[0], hits.barycentric.numpy()[0]
    hit = triangles >= 0
    vertices = transform_points(np.linalg.inv(world_from_camera), mesh.vertices)
    corners = mesh.triangles[triangles[hit]]
    normals, behind = _facing(vertices[corners])
    surface = _surface_color(colors, corners, weights[hit], behind)
    if shaded:
        surface = surface * _light(normals)[:, None]
    if wires:
        pixels = np.argwhere(hit)[:, ::-1]
        on_wire = _edge_distance(fine.project(vertices[corners]), pixels) < SUPERSAMPLING * WIRE_WIDTH / 2
        surface = np.where(on_wire[:, None], linear_from_srgb(WIRE), surface)
    linear = np.empty((fine.height, fine.width, 3))
    linear[:] = BACKGROUND
    linear[hit] = np.minimum(surface, 1)
    samples = linear.reshape(camera.height, SUPERSAMPLING, camera.width, SUPERSAMPLING, 3)
    return srgb8_from_linear(samples.mean(axis=(1, 3)))


def _surface_color(
    colors: NDArray[np.floating] | None,
    corners: NDArray[np.int32],
    weights: NDArray[np.float32],
    behind: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return linear colours (n, 3), interpolated among the three ``corners`` (n, 3) of each hit."""
    if colors is None:
        return linear_from_srgb([CLAY, BACK])[behind.astype(np.intp)]
    shares = np.column_stack([weights, 1 - weights.sum(axis=1)])
    return np.einsum("nk,nkc->nc", shares, linear_from_srgb(colors)[corners])


def _facing(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return unit normals (n, 3) towards the camera of triangles (n, 3, 3), its axes, and which show their back."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    behind = np.einsum("nk,nk->n", normals, a) > 0
    return np.where(behind[:, None], -normals, normals), behind


def _light(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    directions = LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True)
    return AMBIENT + np.maximum(normals @ directions.T, 0) @ np.array(STRENGTHS)


def _edge_distance(corners: NDArray[np.float64], pixels: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return how far ``pixels`` (n, 2) are from the nearest edge of the triangle (n, 3, 2) that each lies in."""
    nearest = np.full(len(pixels), np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, second] - corners[:, first]
        to_pixel = pixels - corners[:, first]
        area = np.abs(along[:, 0] * to_pixel[:, 1] - along[:, 1] * to_pixel[:, 0])
        nearest = np.minimum(nearest, area / np.maximum(np.linalg.norm(along, axis=1), 1e-300))
    return nearest
