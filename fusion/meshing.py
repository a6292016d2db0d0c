"""A volume becomes a mesh: from the frames that were just fused, or again from what a reconstruction left on disk."""

from dataclasses import fields
from pathlib import Path

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels
from fusion.frames.frame_batch import FrameUploader
from fusion.frames.frame_source import FrameSource
from fusion.integration.options import Integration
from fusion.reconstruction_config import ReconstructionConfig, check_meshing
from fusion.reconstruction_files import RECORD_FILE, ReconstructionRecord
from fusion.stopwatch import Stopwatch
from fusion.surface.dual_contouring.depth_oracle import FIELD_MODULES, DepthField
from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.mesh import Mesh
from fusion.surface.meshers import Mesher, OracleName, kernel_modules, mesh_volume
from fusion.volume.tsdf_volume import Volume


def asks_depth(config: ReconstructionConfig) -> bool:
    """Return whether meshing looks at the depth images once more."""
    return config.mesher == "dual-contouring" and config.oracle == "depth"


def mesh_fused(
    volume: Volume,
    source: FrameSource,
    config: ReconstructionConfig,
    *,
    clock: Stopwatch,
    normals: bool = False,
    progress: ProgressReporter = silent,
) -> Mesh:
    """Mesh a volume as ``config`` says, which may ask the depth of ``source``, the frames that were fused into it.

    ``clock`` counts the time to ``mesh``; kernels are loaded before (``kernel_modules``), but those made for the depth
    images. The mesh is empty where there is no surface.
    """
    oracle = None
    if asks_depth(config):
        from fusion.surface.dual_contouring.dual_contouring import oracle_kernels  # noqa: PLC0415 - slow to import

        oracle = depth_oracle(volume, source, config.integration, clock=clock, progress=progress)
        load_kernels((), oracle_kernels(oracle), device=volume.device, progress=progress)
    advance = progress("mesh", 1)
    with clock("mesh"):
        mesh = mesh_volume(
            volume,
            config.mesher,
            oracle=oracle,
            min_weight=config.min_weight,
            normals=normals,
            flatness=config.flatness,
        )
    advance()
    return mesh


def mesh_again(
    volume: Volume,
    folder: Path,
    record: ReconstructionRecord,
    config: ReconstructionConfig,
    *,
    normals: bool = False,
    progress: ProgressReporter = silent,
) -> Mesh:
    """Mesh a volume, fused from what ``record`` says, as ``config`` says; ``record.dataset`` is seen from ``folder``.

    Raises InputError where the depth images are to be asked and their dataset is not there any more.
    """
    modules = kernel_modules(config.mesher, flatness=config.flatness)
    modules += ("fusion.surface.vertex_normals",) if normals else ()
    load_kernels(modules, device=volume.device, progress=progress)
    if not asks_depth(config):
        return mesh_volume(
            volume, config.mesher, min_weight=config.min_weight, normals=normals, flatness=config.flatness
        )
    clock = Stopwatch(volume.device)
    with fused_frames(folder, record, config) as source:
        return mesh_fused(volume, source, config, clock=clock, normals=normals, progress=progress)


def fused_frames(folder: Path, record: ReconstructionRecord, config: ReconstructionConfig) -> FrameSource:
    """Return the frames that a reconstruction was made of; raises InputError where its dataset is not there."""
    path = (folder / record.dataset).resolve()
    if not path.is_dir():
        raise InputError(
            f"{folder}: its mesh goes by the depth images of {path}, which is not there; "
            "give --oracle volume, or --mesher marching-cubes"
        )
    dataset = open_dataset(path)
    if config.depth_layer is not None:
        dataset = dataset.with_depth_layer(config.depth_layer)
    frames = tuple(fused.frame for fused in record.trajectory)
    return FrameSource(dataset, frames, depth_max=record.depth_max_m)


def recorded_config(
    folder: Path,
    record: ReconstructionRecord,
    *,
    mesher: Mesher | None = None,
    oracle: OracleName | None = None,
    flatness: float | None = None,
) -> ReconstructionConfig:
    """Return how the reconstruction in ``folder`` was fused and meshed; of a merged one its parts were fused alike.

    ``mesher``, ``oracle`` and ``flatness`` take the place of the recorded ones. Raises InputError for a record
    that does not tell, and for what the mesher, recorded or given, takes no notice of.
    """
    fused = record.config
    while fused.get("merged"):
        fused = fused["merged"][0]
    values = {field.name: fused[field.name] for field in fields(ReconstructionConfig) if field.name in fused}
    # A record without a mesher was written when there were marching cubes alone.
    values["mesher"] = mesher or record.config.get("mesher", "marching-cubes")
    check_meshing(values["mesher"], oracle=oracle, flatness=flatness)
    if oracle or "oracle" in record.config:
        values["oracle"] = oracle or record.config["oracle"]
    # A record without a flatness was written when no cells were merged.
    values["flatness"] = record.config.get("flatness", 0.0) if flatness is None else flatness
    try:
        if values.get("integration") is not None:
            values["integration"] = Integration(**values["integration"])
        return ReconstructionConfig(**values)
    except (TypeError, InputError) as error:
        raise InputError(f"{folder / RECORD_FILE}: config: {error}") from error


def depth_oracle(
    volume: Volume,
    source: FrameSource,
    integration: Integration,
    *,
    clock: Stopwatch | None = None,
    progress: ProgressReporter = silent,
) -> Oracle:
    """Decode the depth of all frames once more, for dual contouring to ask; ``clock`` counts it to ``mesh``."""
    timed = clock or Stopwatch(volume.device)
    load_kernels(FIELD_MODULES, device=volume.device, progress=progress)
    field = DepthField(volume, integration, frames=len(source.frame_ids))
    upload = FrameUploader(
        source.dataset.camera,
        device=volume.device,
        capacity=source.batch_size,
        depth_scale=source.dataset.depth_scale,
    )
    advance = progress("depth", len(source.frame_ids))
    for frames in source.depth_batches():
        with timed("mesh"):
            field.add(upload(frames.depths, frames.poses))
        for _ in frames.frame_ids:
            advance()
    load_kernels((), [field.kernel()], device=volume.device, progress=progress)
    with timed("mesh"):
        return field.oracle()
