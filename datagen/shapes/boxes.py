"""Boxes with rounded edges, and books made of them."""

from dataclasses import replace

import numpy as np

from datagen.shapes.solid import Array, Solid, joined

EDGE_STEPS = 3
FACES = (
    # Axis that it faces, its sign; axis and sign of what lies to the right when one looks at it; axis of what lies up.
    (0, 1, (1, 1), 2),
    (0, -1, (1, -1), 2),
    (1, 1, (0, -1), 2),
    (1, -1, (0, 1), 2),
    (2, 1, (0, 1), 1),
    (2, -1, (0, -1), 1),
)


def box(size: tuple[float, float, float], *, bevel: float = 0.0) -> Solid:
    """Return a box of ``size`` metres about the origin; a ``bevel`` rounds its edges and gives it smooth normals.

    Each side has the whole stretched picture, upright; of a picture that repeats, the grain runs along the longer edge.
    """
    half = np.array(size, np.float64) / 2
    bevel = min(bevel, 0.98 * float(half.min()))
    vertices: list[Array] = []
    quads, uv_metres, uv_unit = [], [], []
    for axis, sign, (right, right_sign), up in FACES:
        # Tangents of even angles, so that the rounding is even once it is drawn onto its radius.
        rows, columns = _steps(half[up], bevel), _steps(half[right], bevel)
        points = np.empty((len(rows), len(columns), 3))
        points[..., axis] = sign * half[axis]
        points[..., right] = right_sign * columns[None, :]
        points[..., up] = rows[:, None]
        index = np.arange(points[..., 0].size).reshape(points.shape[:2]) + sum(len(side) for side in vertices)
        faces = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
        place = np.stack(np.broadcast_arrays(columns[None, :], rows[:, None]), axis=-1).reshape(-1, 2)
        local = faces.ravel() - index[0, 0]
        uv_unit.append((place / (2 * half[[right, up]]) + 0.5)[local])
        lengthwise = place if half[right] >= half[up] else place[:, ::-1] * [1, -1]
        uv_metres.append(lengthwise[local])
        vertices.append(points.reshape(-1, 3))
        quads.append(faces)
    inner = half - bevel
    points = np.concatenate(vertices)
    core = np.clip(points, -inner, inner)
    outward = points - core
    normals = outward / np.linalg.norm(outward, axis=1, keepdims=True) if bevel else None
    points = core + bevel * normals if normals is not None else points
    return _welded(points, normals, np.concatenate(quads), np.concatenate(uv_metres), np.concatenate(uv_unit))


def book(size: tuple[float, float, float]) -> Solid:
    """Return a lying book of ``size`` [width, height, thickness]: two boards, a spine (slot 0), pages (slot 1).

    A stretched picture wraps around it: back, spine, front from left to right.
    """
    width, height, thickness = size
    board = min(0.003, 0.14 * thickness)
    overlap = 0.1 * board
    boards = []
    for sign in (-1, 1):
        lid = box((width - 0.5 * board, height, board), bevel=0.3 * board)
        boards.append(_moved(lid, (0.25 * board, 0, sign * (thickness - board) / 2)))
    spine = _moved(
        box((1.2 * board, height - 0.4 * board, thickness - 0.5 * board), bevel=0.55 * board),
        (-width / 2 + 0.6 * board, 0, 0),
    )
    wrapped = [_wrapped(solid, size) for solid in (*boards, spine)]
    inset = max(0.002, board)
    pages = box((width - 0.8 * board - inset, height - 2 * inset, thickness - 2 * board + 2 * overlap), bevel=overlap)
    pages = _moved(pages, ((0.8 * board - inset) / 2, 0, 0))
    return joined([*wrapped, replace(pages, slots=np.ones_like(pages.slots))])


def _wrapped(solid: Solid, size: tuple[float, float, float]) -> Solid:
    """Place the solid on the picture of a cover, whose width is that of back, spine and front laid side by side."""
    width, height, thickness = size
    total = 2 * width + thickness
    x, y, z = solid.vertices[solid.corners].T
    from_spine = np.clip(x + width / 2, 0, width)
    spine = z + thickness / 2
    on_spine = np.ptp(solid.vertices[:, 2]) > np.ptp(solid.vertices[:, 0])
    flat = np.where(z > 0, width + thickness + from_spine, width - from_spine)
    u = (width + spine if on_spine else flat) / total
    return replace(solid, uv_unit=np.stack([u, y / height + 0.5], axis=-1))


def _steps(half: float, bevel: float) -> Array:
    if not bevel:
        return np.array([-half, half])
    edge = half - bevel + bevel * np.tan(np.linspace(0, np.pi / 4, EDGE_STEPS + 1))
    return np.concatenate([-edge[::-1], edge])


def _welded(points: Array, normals: Array | None, quads: np.ndarray, uv_metres: Array, uv_unit: Array) -> Solid:
    """Return the six sides as one surface: points that fall together on its edges become one."""
    grid = 1e-7 * max(1.0, float(np.abs(points).max()))
    _, first, index = np.unique(np.rint(points / grid).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    return Solid(
        vertices=points[first],
        normals=None if normals is None else normals[first],
        sizes=np.full(len(quads), 4, np.int32),
        corners=index.reshape(-1)[quads.ravel()].astype(np.int32),
        uv_metres=uv_metres,
        uv_unit=uv_unit,
        slots=np.zeros(len(quads), np.int32),
    )


def _moved(solid: Solid, offset: tuple[float, float, float]) -> Solid:
    return replace(solid, vertices=solid.vertices + np.array(offset))
