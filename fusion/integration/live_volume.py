"""A volume that grows while frames arrive, for live use: ``volume.integrate(frame)``, then the mesh of what changed.

A frame finds its blocks and is integrated into all that it sees, by the kernels of the offline path with a batch of
one. Where all blocks are there beforehand the result is that of one pass over all frames, to rounding. A block that is
found later misses what earlier frames saw of it: free space, as a frame finds every block of its own truncation band.

On CUDA nothing waits for the device in the steady state: two pinned buffers take turns, what a frame launches is
captured once as a graph, and whether its blocks found room is looked up when its buffer is needed again.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Frame
from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.devices import load_kernels, resolve_device
from fusion.frames.depth_tiles import DepthTiles
from fusion.frames.frame_batch import FrameBatch, FrameUploader
from fusion.frames.frame_matrices import frame_matrices
from fusion.frames.survey import SceneSurvey
from fusion.integration.find_blocks import launch_find_blocks, out_of_range
from fusion.integration.fuse_batch import integrate_batch, load_fusion_kernels, survey_batch
from fusion.integration.live_frames import checked_pose, fingerprint, with_weights
from fusion.integration.live_slots import LiveSlot, note_changes, note_outcome
from fusion.integration.options import Integration
from fusion.reconstruction_config import EXACT, ReconstructionConfig, check_length, choose_lengths
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_pieces import MeshPiece, MeshPieces
from fusion.volume.block_table import OUT_OF_RANGE, TABLE_FULL
from fusion.volume.memory_budget import INDEX_LIMIT, block_budget
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Storage

KERNEL_MODULES = (
    "fusion.integration.live_slots",
    "fusion.surface.cells",
    "fusion.surface.marching_cubes",
    "fusion.surface.mesh_pieces",
)
_FIRST_CAPACITY = 1 << 13


class LiveVolume:
    """A growing volume for frames of one camera, one at a time.

    ``voxel_size`` and ``truncation`` (4 voxels if not given) are metres. Frames have depth in metres, float32, or with
    ``depth_scale`` (metres a step) in uint16 steps, 0 and 65535 invalid. ``integration`` is that of a reconstruction if
    not given; ``storage`` is full, so that frames can be removed exactly. ``device`` is auto, cpu or cuda[:N].
    ``max_blocks`` bounds the volume, by the free memory if not given. Raises InputError for options that make none.
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
        # Checks what it is given as for a reconstruction.
        config = ReconstructionConfig(
            voxel_size=voxel_size, truncation=truncation, storage=storage, integration=integration or EXACT
        )
        lengths = choose_lengths(config, _no_survey)
        if depth_scale is not None:
            check_length("depth_scale", depth_scale)
        if max_blocks is not None and not 1 <= max_blocks <= INDEX_LIMIT:
            raise InputError(f"max_blocks {max_blocks}: expected 1 to {INDEX_LIMIT}")
        self.integration = config.integration
        on = resolve_device(device)
        self._volume = Volume(
            voxel_size=lengths.voxel_size,
            truncation=lengths.truncation,
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
            LiveSlot(
                upload=FrameUploader(camera, device=on, capacity=1, depth_scale=depth_scale, turns=1),
                outcome=wp.zeros(2, dtype=int, device="cpu", pinned=on.is_cuda),
            )
            for _ in range(2 if on.is_cuda else 1)
        ]
        self._depth_dtype = np.dtype(np.float32 if depth_scale is None else np.uint16)
        self._blocks_at: dict[int, int] = {}
        self._prints: dict[int, int] = {}
        self._pieces = MeshPieces()
        self._outcome = wp.zeros(2, dtype=int, device=on)
        self._changed = wp.zeros(0, dtype=wp.uint8, device=on)
        self._reserve()

    @property
    def volume(self) -> Volume:
        """The fused volume itself, for ray casting, saving or merging, with every frame in it: see ``finish``."""
        self.finish()
        return self._volume

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """The frames that are in the volume."""
        return tuple(self._prints)

    def integrate(self, frame: Frame, *, pixel_weights: NDArray[np.float32] | None = None) -> None:
        """Add a frame; ``pixel_weights`` (height, width), 0 or more, multiply the weights of its pixels.

        Raises InputError where it does not fit the camera, is there already, or asks for too much. A frame that is
        refused changes no voxel. On CUDA an error may be that of one of the two frames before, which it names; this
        frame is then added nonetheless.
        """
        pose = checked_pose(frame, self.camera, self._depth_dtype)
        if frame.frame_id in self._prints:
            raise InputError(f"frame {frame.frame_id} is in the volume already; remove it before adding it again")
        self._make_room()
        slot = self._slots.pop(0)
        self._slots.append(slot)
        earlier = None
        try:
            self._settle(slot)
        except InputError as error:
            earlier = error
        slot.batch = self._upload(slot, frame, pose, pixel_weights)
        self._launch(slot)
        slot.frame_id = frame.frame_id
        self._prints[frame.frame_id] = fingerprint(frame, pixel_weights)
        if self._volume.device.is_cpu:
            self._settle(slot)
        if earlier is not None:
            raise earlier

    def remove(self, frame: Frame, *, pixel_weights: NDArray[np.float32] | None = None) -> None:
        """Take a frame away again, with the weights it was added with: exactly in full storage, to rounding in packed.

        Where weights are not whole numbers, rounding leaves traces of them in voxels that no other frame saw; meshing
        with a ``min_weight`` of 0.01 passes over these. Raises InputError where the frame is not in the volume, or is
        not the one that was added under its number, and where weights are capped.
        """
        pose = checked_pose(frame, self.camera, self._depth_dtype)
        self.finish()
        if frame.frame_id not in self._prints:
            raise InputError(f"frame {frame.frame_id} is not in the volume")
        if self._prints[frame.frame_id] != fingerprint(frame, pixel_weights):
            raise InputError(
                f"frame {frame.frame_id}: its images or pose are not those that were added; nothing removed"
            )
        if self.integration.weight_cap is not None:
            raise InputError("a frame cannot be removed where weights are capped; integrate without a weight cap")
        batch = self._upload(self._slots[0], frame, pose, pixel_weights)
        # Blocks that came later know nothing of it.
        self._integrate(batch, blocks=self._blocks_at.pop(frame.frame_id), remove=True)
        del self._prints[frame.frame_id]
        if not self._prints:
            for array in self._volume.arrays().values():
                array.zero_()

    def finish(self) -> None:
        """Wait until every frame is in the volume; raises InputError where one asked for too much."""
        for slot in self._slots:
            self._settle(slot)

    def mesh(self, *, min_weight: float = 0.0, normals: bool = False) -> Mesh:
        """Return the mesh of the whole volume."""
        self.finish()
        return marching_cubes(self._volume, min_weight=min_weight, normals=normals)

    def mesh_changes(self) -> dict[int, MeshPiece | None]:
        """Return the meshes of the blocks that changed since the last call, by block number; None where one vanished.

        ``fusion.surface.mesh_pieces.weld`` joins the pieces of all blocks to the mesh of the whole volume.
        """
        self.finish()
        changed = np.flatnonzero(self._changed.numpy()[: self._volume.table.count])
        self._changed.zero_()
        before = set(self._pieces.pieces)
        stale = self._pieces.update(self._volume, changed).tolist()
        pieces = self._pieces.pieces
        return {number: pieces.get(number) for number in stale if number in pieces or number in before}

    def _upload(self, slot: LiveSlot, frame: Frame, pose: Matrix, weights: NDArray[np.float32] | None) -> FrameBatch:
        batch = slot.upload([frame.depth], [pose], [frame.color])
        return batch if weights is None else with_weights(batch, weights, frame)

    def _make_room(self) -> None:
        """Let the table grow before it is full."""
        table = self._volume.table
        if 4 * table.count > 3 * len(table.blocks) and len(table.blocks) < table.max_blocks:
            self.finish()
            table.grow()
            self._reserve()

    def _launch(self, slot: LiveSlot) -> None:
        """Start all that a frame does; on CUDA by its graph, captured after the kernels ran once."""
        device = self._volume.device
        assert slot.batch is not None, "a slot is launched with a frame in it"
        # The user's weights lie elsewhere each time, which no graph knows of.
        may_capture = device.is_cuda and slot.batch.pixel_weights is None and wp.is_mempool_enabled(device)
        if may_capture and slot.graph is None and slot.done is not None:
            # All kernels are loaded by now; an older driver would have Warp load those of every module.
            with wp.ScopedCapture(device=device, force_module_load=False) as capture:
                self._find_and_integrate(slot)
            slot.graph = capture.graph
        if may_capture and slot.graph is not None:
            wp.capture_launch(slot.graph)
        else:
            self._find_and_integrate(slot)
        if device.is_cuda:
            slot.done = wp.get_stream(device).record_event(slot.done)

    def _find_and_integrate(self, slot: LiveSlot) -> None:
        assert slot.batch is not None, "a slot is launched with a frame in it"
        volume = self._volume
        tiles = survey_batch(slot.batch, truncation=volume.truncation)
        answers = self._find_blocks(slot.batch, tiles)
        note_outcome(answers, volume.table.arrays, self._outcome, device=volume.device)
        wp.copy(slot.outcome, self._outcome)
        self._integrate(slot.batch, blocks=volume.reserved, tiles=tiles, hold_back=True)

    def _find_blocks(self, batch: FrameBatch, tiles: DepthTiles) -> wp.array:
        """Enter a frame's blocks as far as there is room; returns what stood in the way."""
        volume = self._volume
        matrices = frame_matrices(batch, volume.voxel_size)
        return launch_find_blocks(
            volume.table, batch, tiles, matrices, truncation=volume.truncation, voxel_size=volume.voxel_size
        )

    def _integrate(
        self,
        batch: FrameBatch,
        *,
        blocks: int,
        remove: bool = False,
        tiles: DepthTiles | None = None,
        hold_back: bool = False,
    ) -> None:
        """Integrate a frame into the first ``blocks`` blocks, or ``hold_back`` where it found no room for its own."""
        masks = integrate_batch(
            self._volume,
            batch,
            self.integration,
            remove=remove,
            tiles=tiles,
            blocks=blocks,
            problem=self._outcome if hold_back else None,
        )
        note_changes(masks, self._changed, blocks=blocks, device=self._volume.device)

    def _settle(self, slot: LiveSlot) -> None:
        """See to it that a slot's frame is in every block that it asked for."""
        if slot.frame_id is None or slot.batch is None:
            return
        if slot.done is not None:
            wp.synchronize_event(slot.done)
        problem, count = slot.outcome.numpy().tolist()
        frame_id, slot.frame_id = slot.frame_id, None
        table = self._volume.table
        table.count = max(table.count, count)
        try:
            if problem == OUT_OF_RANGE:
                raise out_of_range(self._volume.voxel_size)
            if problem == TABLE_FULL:
                self._grow_for(slot.batch)
                self._integrate(slot.batch, blocks=table.count)
                count = table.count
        except InputError as error:
            del self._prints[frame_id]
            raise type(error)(f"frame {frame_id}: {error}; the frame was left out") from None
        self._blocks_at[frame_id] = count

    def _grow_for(self, batch: FrameBatch) -> None:
        """Let the table grow until all blocks of a frame have entered."""
        table, volume = self._volume.table, self._volume
        wp.synchronize_device(volume.device)
        tiles = survey_batch(batch, truncation=volume.truncation)
        problem = TABLE_FULL
        try:
            while problem == TABLE_FULL:
                table.grow()
                problem = int(self._find_blocks(batch, tiles).numpy().max())
        finally:
            table.drop_unnumbered()
            self._reserve()

    def _reserve(self) -> None:
        """Make room for as many blocks as the table can number; graphs of the old arrays are of no use any more."""
        table = self._volume.table
        self._volume.reserve(len(table.blocks))
        changed = wp.zeros(len(table.blocks), dtype=wp.uint8, device=self._volume.device)
        if len(self._changed):
            wp.copy(changed, self._changed)
        self._changed = changed
        for slot in self._slots:
            slot.graph = None


def _no_survey() -> SceneSurvey:
    raise InputError("voxel_size: a live volume cannot take it from frames that are still to come; give it in metres")
