"""A skin over rings of points that follow each other: what revolved shapes and tubes are made of."""

import numpy as np

from datagen.shapes.solid import Array, Solid, facing_outwards


def skin(points: Array, normals: Array, uv: Array, *, closed: bool) -> Solid:
    """Return the surface through rings ``points`` (R, C, 3) with ``normals`` (R, C, 3), facing outwards.

    ``uv`` (R, C + 1, 2) has one column more: the seam's other side. With ``closed`` the last ring joins the first one
    and ``uv`` has a row more too; otherwise the first and last rings are single points, C times the same.
    """
    rings, columns = points.shape[:2]
    column = np.arange(columns)
    following = (column + 1) % columns
    index = np.arange(rings * columns).reshape(rings, columns)
    kept = np.ones(rings * columns, bool)
    if not closed:
        for pole in (0, rings - 1):
            index[pole] = index[pole, 0]
            kept[pole * columns + 1 : (pole + 1) * columns] = False
    renumbered = np.cumsum(kept) - 1
    faces, places = [], []
    for low in range(rings if closed else rings - 1):
        high = (low + 1) % rings
        quads = np.stack([index[low], index[low, following], index[high, following], index[high]], axis=-1)
        uvs = np.stack([uv[low, column], uv[low, column + 1], uv[low + 1, column + 1], uv[low + 1, column]], axis=1)
        if not closed and low == 0:  # a fan about the first point
            middle = (uvs[:, :1] + uvs[:, 1:2]) / 2
            quads, uvs = quads[:, [0, 2, 3]], np.concatenate([middle, uvs[:, 2:]], axis=1)
        elif not closed and high == rings - 1:
            middle = (uvs[:, 2:3] + uvs[:, 3:]) / 2
            quads, uvs = quads[:, :3], np.concatenate([uvs[:, :2], middle], axis=1)
        faces.append(quads)
        places.append(uvs)
    uv_metres = np.concatenate([place.reshape(-1, 2) for place in places])
    low_corner, high_corner = uv_metres.min(axis=0), uv_metres.max(axis=0)
    return facing_outwards(
        Solid(
            vertices=points.reshape(-1, 3)[kept],
            normals=normals.reshape(-1, 3)[kept],
            sizes=np.concatenate([np.full(len(face), face.shape[1]) for face in faces]).astype(np.int32),
            corners=renumbered[np.concatenate([face.ravel() for face in faces])].astype(np.int32),
            uv_metres=uv_metres,
            uv_unit=(uv_metres - low_corner) / (high_corner - low_corner),
            slots=np.zeros(sum(map(len, faces)), np.int32),
        )
    )
