"""A volume that grows while frames arrive, for live use: ``volume.integrate(frame)``, then the mesh of what changed.

A frame finds its blocks and is integrated into all that it sees, by the kernels of the offline path with a batch of
one. Where all blocks are there beforehand the result is that of one pass over all frames, to rounding. A block that is
found later misses what earlier frames saw of it: free space, as a frame finds every block of its own truncation band.

On CUDA nothing waits for the device in the steady state: two pinned buffers take turns, what a frame launches is
captured once as a graph, and whether its blocks found room is looked up when its buffer is needed again.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from datagen.camera import PinholeCamera
from datagen.dataset import Frame
from datagen.errors import InputError
from datagen.rigid import rigid
from fusion.devices import load_kernels, resolve_device
from fusion.frames import color_confidence, depth_tiles, pixel_weights
from fusion.frames.frame_batch import FrameBatch, FrameUploader
from fusion.frames.frame_matrices import frame_matrices
from fusion.integration import integrate
from fusion.integration.find_blocks import launch_find_blocks, out_of_range
from fusion.integration.fuse_batch import load_fusion_kernels
from fusion.integration.options import Integration
from fusion.integration.visible_blocks import visible_blocks
from fusion.integration.volume_memory import block_budget
from fusion.reconstruction_config import VOXELS_PER_TRUNCATION
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_pieces import MeshPiece, MeshPieces
from fusion.volume.block_table import OUT_OF_RANGE, TABLE_FULL
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Storage

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

KERNEL_MODULES = (
    "fusion.integration.live_volume",
    "fusion.surface.cells",
    "fusion.surface.marching_cubes",
    "fusion.surface.mesh_pieces",
)
_FIRST_CAPACITY = 1 << 13


@wp.kernel
def _sum_up(
    answers: wp.array2d(dtype=int),
    count: wp.array(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
    outcome: wp.array(dtype=int),
) -> None:
    # outcome: what stood in the way, and how many blocks there are.
    index = wp.tid()
    if answers[index, 1] != 0:
        wp.atomic_max(outcome, 0, answers[index, 1])
    if index == 0:
        outcome[1] = wp.min(count[0], blocks.shape[0])


@wp.kernel
def _note_changes(masks: wp.array2d(dtype=wp.uint32), changed: wp.array(dtype=wp.uint8)) -> None:
    number = wp.tid()
    for part in range(masks.shape[1]):
        if masks[number, part] != wp.uint32(0):
            changed[number] = wp.uint8(1)


@dataclass(kw_only=True)
class _Slot:
    """One of two buffers for a frame on its way into the volume.

    ``outcome`` (2,) int is pinned: it tells what stood in the way and how many blocks there were.
    """

    upload: FrameUploader
    outcome: wp.array
    done: Any = None
    batch: FrameBatch | None = None
    frame_id: int | None = None
    graph: Any = None


class LiveVolume:
    """A growing volume for frames of one camera, one at a time.

    ``voxel_size`` and ``truncation`` (4 voxels if not given) are metres. Frames have depth in metres, or with
    ``depth_scale`` (metres a step) uint16 steps. ``device`` is auto, cpu or cuda[:N]. ``max_blocks`` bounds the volume,
    by the free memory if not given. ``volume`` is the fused volume itself, for ray casting, saving or merging; call
    ``finish`` before reading it.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        *,
        voxel_size: float,
        truncation: float | None = None,
        depth_scale: float | None = None,
        integration: Integration | None = None,
        storage: Storage = "full",
        device: str = "auto",
        max_blocks: int | None = None,
    ) -> None:
        self.camera = camera
        self.integration = integration or Integration()
        on = resolve_device(device)
        self.volume = Volume(
            voxel_size=voxel_size,
            truncation=truncation or VOXELS_PER_TRUNCATION * voxel_size,
            device=on,
            # While it grows, the volume is in memory twice.
            max_blocks=max_blocks or block_budget(on, storage) // 2,
            storage=storage,
            capacity=_FIRST_CAPACITY,
        )
        depth_type = wp.float32 if depth_scale is None else wp.uint16
        load_fusion_kernels(self.integration, device=on, depth_type=depth_type)
        load_kernels(KERNEL_MODULES, device=on)
        self._slots = [
            _Slot(
                upload=FrameUploader(camera, device=on, capacity=1, depth_scale=depth_scale, turns=1),
                outcome=wp.zeros(2, dtype=int, device="cpu", pinned=on.is_cuda),
            )
            for _ in range(2 if on.is_cuda else 1)
        ]
        self._blocks_at: dict[int, int] = {}
        self._pieces = MeshPieces()
        self._outcome = wp.zeros(2, dtype=int, device=on)
        self._changed = wp.zeros(0, dtype=wp.uint8, device=on)
        self._reserve()

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """The frames that are in the volume."""
        return tuple(self._blocks_at)

    def integrate(self, frame: Frame) -> None:
        """Add a frame. Raises InputError where it does not fit the camera, is there already, or asks for too much.

        A frame that is refused leaves the volume as it was; on CUDA that may be told one call later.
        """
        self._check(frame)
        if frame.frame_id in self._blocks_at:
            raise InputError(f"frame {frame.frame_id} is in the volume already; remove it before adding it again")
        slot = self._slots.pop(0)
        self._slots.append(slot)
        self._settle(slot)
        slot.batch = slot.upload([frame.depth], [frame.world_from_camera], [frame.color])
        slot.frame_id = frame.frame_id
        self._blocks_at[frame.frame_id] = self.volume.table.count
        self._launch(slot)
        if self.volume.device.is_cpu:
            self._settle(slot)

    def remove(self, frame: Frame) -> None:
        """Take a frame away again: exactly in full storage, to rounding in packed.

        Raises InputError where it is not in the volume, or weights are capped.
        """
        self._check(frame)
        self.finish()
        if frame.frame_id not in self._blocks_at:
            raise InputError(f"frame {frame.frame_id} is not in the volume")
        if self.integration.weight_cap is not None:
            raise InputError("a frame cannot be removed where weights are capped; integrate without a weight cap")
        batch = self._slots[0].upload([frame.depth], [frame.world_from_camera], [frame.color])
        # Blocks that came later know nothing of it.
        self._integrate(batch, blocks=self._blocks_at.pop(frame.frame_id), remove=True)

    def finish(self) -> None:
        """Wait until every frame is in the volume; raises InputError where one asked for too much."""
        for slot in self._slots:
            self._settle(slot)

    def mesh(self, *, min_weight: float = 0.0, normals: bool = False) -> Mesh:
        """Return the mesh of the whole volume."""
        self.finish()
        return marching_cubes(self.volume, min_weight=min_weight, normals=normals)

    def mesh_changes(self) -> dict[int, MeshPiece | None]:
        """Return the meshes of the blocks that changed since the last call, by block number; None where one vanished.

        ``fusion.surface.mesh_pieces.weld`` joins the pieces of all blocks to the mesh of the whole volume.
        """
        self.finish()
        changed = np.flatnonzero(self._changed.numpy()[: self.volume.table.count])
        self._changed.zero_()
        before = set(self._pieces.pieces)
        stale = self._pieces.update(self.volume, changed).tolist()
        pieces = self._pieces.pieces
        return {number: pieces.get(number) for number in stale if number in pieces or number in before}

    def _check(self, frame: Frame) -> None:
        size = (self.camera.height, self.camera.width)
        for name, shape in (("depth", frame.depth.shape), ("colour", frame.color.shape[:2])):
            if shape != size:
                raise InputError(
                    f"frame {frame.frame_id}: its {name} is {shape[1]}×{shape[0]}, the camera {size[1]}×{size[0]}"
                )
        rigid(frame.world_from_camera, source=f"frame {frame.frame_id}")

    def _launch(self, slot: _Slot) -> None:
        """Start all that a frame does; on CUDA by its graph, captured after the kernels ran once."""
        device = self.volume.device
        if slot.graph is None and slot.done is not None and device.is_cuda and wp.is_mempool_enabled(device):
            with wp.ScopedCapture(device=device) as capture:
                self._find_and_integrate(slot)
            slot.graph = capture.graph
        if slot.graph is None:
            self._find_and_integrate(slot)
        else:
            wp.capture_launch(slot.graph)
        if device.is_cuda:
            slot.done = wp.record_event(slot.done)

    def _find_and_integrate(self, slot: _Slot) -> None:
        assert slot.batch is not None, "a slot is launched with a frame in it"
        table = self.volume.table
        lengths = {"truncation": self.volume.truncation, "voxel_size": self.volume.voxel_size}
        tiles = depth_tiles.depth_tiles(slot.batch, split_beyond=2 * self.volume.truncation)
        matrices = frame_matrices(slot.batch, self.volume.voxel_size)
        answers = launch_find_blocks(table, slot.batch, tiles, matrices, **lengths)
        self._outcome.zero_()
        wp.launch(
            _sum_up,
            dim=len(answers),
            inputs=[answers, table.arrays.count, table.blocks],
            outputs=[self._outcome],
            device=self.volume.device,
        )
        wp.copy(slot.outcome, self._outcome)
        self._integrate(slot.batch, blocks=self.volume.reserved, tiles=tiles)

    def _integrate(
        self,
        batch: FrameBatch,
        *,
        blocks: int,
        first: int = 0,
        remove: bool = False,
        tiles: depth_tiles.DepthTiles | None = None,
    ) -> None:
        """Integrate a frame into the blocks from ``first`` to ``blocks``."""
        volume, truncation = self.volume, self.volume.truncation
        tiles = tiles or depth_tiles.depth_tiles(batch, split_beyond=2 * truncation)
        matrices = frame_matrices(batch, volume.voxel_size)
        color_confidence.judge_colors(batch, step=truncation)
        weights = pixel_weights.pixel_weights(batch, self.integration.weighting, step=truncation)
        weighed = replace(batch, pixel_weights=weights)
        masks = visible_blocks(volume.table, batch, tiles, matrices, truncation=truncation, blocks=blocks)
        if first:
            masks[:first].zero_()
        integrate.integrate_frames(volume, weighed, matrices, masks, self.integration, remove=remove)
        wp.launch(_note_changes, dim=blocks, inputs=[masks], outputs=[self._changed], device=volume.device)

    def _settle(self, slot: _Slot) -> None:
        """See to it that a slot's frame is in every block that it asked for."""
        if slot.frame_id is None or slot.batch is None:
            return
        if slot.done is not None:
            wp.synchronize_event(slot.done)
        problem, count = slot.outcome.numpy().tolist()
        frame_id, slot.frame_id = slot.frame_id, None
        table = self.volume.table
        table.count = max(table.count, count)
        try:
            if problem == OUT_OF_RANGE:
                raise out_of_range(self.volume.voxel_size)
            if problem == TABLE_FULL:
                self._grow_for(slot.batch)
                self._integrate(slot.batch, blocks=table.count, first=count)
                count = table.count
        except InputError as error:
            self._integrate(slot.batch, blocks=count, remove=True)
            del self._blocks_at[frame_id]
            raise type(error)(f"frame {frame_id}: {error}; the frame was left out") from None
        self._blocks_at[frame_id] = count
        if 4 * table.count > 3 * len(table.blocks) and table.count < table.max_blocks:
            self.finish()
            table.grow()
            self._reserve()

    def _grow_for(self, batch: FrameBatch) -> None:
        """Let the table grow until all blocks of a frame have entered."""
        table, volume = self.volume.table, self.volume
        wp.synchronize_device(volume.device)
        tiles = depth_tiles.depth_tiles(batch, split_beyond=2 * volume.truncation)
        matrices = frame_matrices(batch, volume.voxel_size)
        problem = TABLE_FULL
        try:
            while problem == TABLE_FULL:
                table.grow()
                answers = launch_find_blocks(
                    table, batch, tiles, matrices, truncation=volume.truncation, voxel_size=volume.voxel_size
                )
                problem = int(answers.numpy()[:, 1].max())
        finally:
            table.drop_unnumbered()
            self._reserve()

    def _reserve(self) -> None:
        """Make room for as many blocks as the table can number; graphs of the old arrays are of no use any more."""
        table = self.volume.table
        self.volume.reserve(len(table.blocks))
        changed = wp.zeros(len(table.blocks), dtype=wp.uint8, device=self.volume.device)
        if len(self._changed):
            wp.copy(changed, self._changed)
        self._changed = changed
        for slot in self._slots:
            slot.graph = None
