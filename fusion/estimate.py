"""How large a reconstruction will be, from a few frames and before it is made."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.frame_selection import select_frames
from datagen.images import DEPTH_INVALID_MAX
from datagen.progress import ProgressReporter, silent
from datagen.rigid import transform_points
from fusion.devices import resolve_device
from fusion.frames.survey import combine, load, survey_frame
from fusion.reconstruction_config import ReconstructionConfig, choose_lengths
from fusion.volume.block_table import BLOCK_SIDE
from fusion.volume.memory_budget import bytes_per_block
from fusion.volume.voxels import Storage

FRAMES = 24
PIXELS_PER_CELL = 8
MEAN_TAXICAB = 1.5
"""Mean of |nx| + |ny| + |nz| over all directions n: each of the three has a mean of a half."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a dataset shows, and from it the size of a reconstruction at any voxel size.

    ``taxicab_area`` (m²) is the surface's area times |nx| + |ny| + |nz| of its normal n: a grid of cubes of side v has
    taxicab_area / v² of them on the surface. ``voxel_size`` is the one that suits the data, metres; ``frames`` is how
    many would be fused.
    """

    taxicab_area: float
    voxel_size: float
    frames: int

    def triangles(self, voxel_size: float) -> int:
        """Return how many triangles marching cubes makes: a vertex for each edge crossed, as many as cubes crossed."""
        return round(2 * self.taxicab_area / voxel_size**2)

    def volume_bytes(self, voxel_size: float, truncation: float, storage: Storage = "packed") -> int:
        """Return what the volume's voxels take.

        A slab of thickness 2t and normal n meets (2t + s (|nx| + |ny| + |nz|)) / s³ cubes of side s per area.
        """
        side = BLOCK_SIDE * voxel_size
        blocks = (self.taxicab_area * side + 2 * truncation * self.taxicab_area / MEAN_TAXICAB) / side**3
        return round(blocks * bytes_per_block(storage))


def estimate(
    dataset: Dataset,
    *,
    frames: str | None = None,
    depth_max: float | None = None,
    progress: ProgressReporter = silent,
) -> Estimate:
    """Look at the depth of some frames, evenly chosen; what only others saw is missed.

    ``frames`` is START:STOP:STEP. Raises InputError for frames that cannot be used.
    """
    chosen = select_frames(dataset.frame_ids, frames)
    some = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, FRAMES).round().astype(int))]
    resolve_device("cpu")  # Warp keeps quiet from then on
    load()
    last_step = DEPTH_INVALID_MAX - 1 if depth_max is None else int(depth_max / dataset.depth_scale)
    depths, surveys = [], []
    advance = progress("estimate", len(some))
    for frame in some:
        steps = dataset.depth_steps(frame)
        steps[steps > last_step] = 0
        pose = dataset.world_from_camera(frame)
        surveys.append(survey_frame(dataset.camera, steps, pose, depth_scale=dataset.depth_scale))
        depths.append((steps, pose))
        advance()
    scene = combine(surveys, dataset.camera)
    cell = PIXELS_PER_CELL * scene.pixel_footprint
    seen: NDArray[np.int64] = np.empty((0, 3), np.int64)
    for steps, pose in depths:
        points = dataset.camera.back_project(steps.astype(np.float64) * dataset.depth_scale)[steps > 0]
        cells = np.floor(transform_points(pose, points) / cell).astype(np.int64)
        seen = np.unique(np.concatenate([seen, np.unique(cells, axis=0)]), axis=0)
    lengths = choose_lengths(ReconstructionConfig(), lambda: scene)
    return Estimate(taxicab_area=len(seen) * cell**2, voxel_size=lengths.voxel_size, frames=len(chosen))
