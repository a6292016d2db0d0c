"""The second step: a dataset fused into a coloured mesh, which grows before your eyes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ..jobs.command import Command
from ..jobs.folder_claim import while_claimed
from ..jobs.job import Job, Work
from ..preferences import fusion_device
from ..results.live_mesh import LiveMesh
from ..results.originals import named, note_originals, originals_of
from ..scan_folder import DATASET, RECONSTRUCTION
from .bring_in import bring_in
from .scan import scanned_objects
from .scene_reference import SceneReference
from .status import forget


def fuse_command(
    dataset: Path, out: Path, settings: dict[str, Any], *, snapshots: Path | None, metres_per_unit: float = 1.0
) -> Command:
    """Return the command for the settings of ``FuseProperties``, whose lengths are in the scene's units."""
    arguments = ["reconstruct", str(dataset), str(out), "--json", "--device", settings["device"] or fusion_device()]
    arguments += ["--mesher", settings["mesher"]]
    for name in ("voxel_size", "truncation", "depth_max"):
        if settings[name] > 0:
            arguments += [f"--{name.replace('_', '-')}", repr(float(f"{settings[name] * metres_per_unit:.7g}"))]
    if settings["every"] > 1:
        arguments += ["--frames", f"::{settings['every']}"]
    if settings["use_sensor_depth"]:
        arguments += ["--depth", "sensor_depth"]
    if snapshots is not None:
        arguments += ["--snapshots", str(snapshots)]
    return Command(program="fusion", arguments=tuple(arguments), failure="The frames were not fused")


def fuse_work(
    scene: SceneReference, folder: Path, dataset: Path, settings: dict[str, Any]
) -> Callable[[Job], Work[str]]:
    """Return the job that fuses ``dataset`` into the scan's ``folder`` and brings the result into the scene."""

    def work(job: Job) -> Work[str]:
        out = folder / RECONSTRUCTION
        unit, growing = scene.metres_per_unit, job.folder / "live.ply"
        live = LiveMesh(growing, out, scene.find, unit=unit)
        snapshots = growing if settings["live"] else None
        command = fuse_command(dataset, out, settings, snapshots=snapshots, metres_per_unit=unit)

        def recall() -> None:
            if dataset == folder / DATASET:
                _recall_originals(scene.find(), folder)

        try:
            recall()
            yield from job.run(command, meanwhile=live.follow)
            forget()
            recall()
            made = yield from bring_in(job, scene, out, undo="Scanback: Fuse", before_placing=live.remove)
        finally:
            live.remove()
        hidden = "; the original is hidden" if originals_of(scene.find(), out) else ""
        return f"Fused {len(made.trajectory)} frames into {len(made.mesh.triangles):,} triangles{hidden}"

    return while_claimed(folder, work, makes=True)


def _recall_originals(scene: bpy.types.Scene, folder: Path) -> None:
    """Have a scene know what was scanned into ``folder``, by name where an undo, or another file, knows no better."""
    out = folder / RECONSTRUCTION
    if not originals_of(scene, out):
        note_originals(scene, out, named(scene, scanned_objects(folder)))
