"""The located views as a picture: the model's outline over each query, from the nearest pose and from the one found."""

from pathlib import Path

import numpy as np

from datagen.errors import InputError
from datagen.images import write_color
from fusion.pose.locate import Located
from fusion.pose.overlay import before_and_after, depth_as_grey, stacked, with_title
from fusion.pose.query import Query
from fusion.pose.query_source import QuerySource

MOST_QUERIES = 8


def require_png(path: Path) -> None:
    """Raise InputError unless ``path`` is named as a PNG file."""
    if path.suffix.lower() != ".png":
        raise InputError(f"--picture {path}: is written as PNG; end the name in .png")


def write_picture(path: Path, source: QuerySource, located: Located) -> None:
    """Write up to eight queries, evenly chosen, as PNG, each with the outline before and after refinement.

    Queries without a pose are shown without an outline.
    """
    count = len(located.results)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_QUERIES)).round().astype(int))
    model = located.target.model
    rows = []
    for result in (located.results[i] for i in chosen):
        query = source.read(result.query).query
        image = _background(query)
        title = f"query {result.query}"
        if result.world_from_camera is None:
            gap = np.full((len(image), 4, 3), 255, np.uint8)
            rows.append(np.hstack([with_title(image, title), gap, with_title(image, "not found")]))
            continue
        before = np.array(result.world_from_camera)
        refined = None if result.refined is None else result.refined.world_from_camera
        rows.append(
            before_and_after(
                image,
                model.mesh,
                query.camera,
                before,
                before if refined is None else np.array(refined),
                device=model.device,
                titles=(f"{title}: nearest", f"refined: {result.verdict}" if refined is not None else result.verdict),
            )
        )
    write_color(path, stacked(rows))


def _background(query: Query) -> np.ndarray:
    if query.color is not None:
        return query.color
    if query.depth is not None:
        return depth_as_grey(query.whole_depth())
    assert query.mask is not None, "a query has one of the three"
    return np.repeat(np.where(query.mask, 200, 30).astype(np.uint8)[..., None], 3, axis=2)
