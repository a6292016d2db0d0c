"""The third step: where a view was taken from, among the frames that were fused."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ReconstructionError
from ..files.dataset_files import write_pose, write_single_view
from ..files.json_values import read_json
from ..files.reconstruction_files import Pose, Record, read_record
from ..jobs.command import Command
from ..jobs.folder_claim import while_claimed
from ..jobs.job import Job, Work
from ..preferences import fusion_device
from ..results.import_reconstruction import place_located
from ..results.scene_units import pose_in_metres
from ..scan_folder import RECONSTRUCTION
from .bring_in import bring_in
from .scene_reference import SceneReference, push_undo
from .status import status_of

DATASET_QUERIES = ("FRAME", "HELD_OUT")
DEPTH_STEP_KEY = "depth_scale"


@dataclass(frozen=True, kw_only=True)
class LocateQuery:
    """What is located: the settings of ``LocateProperties``, and the pose of a view in the scene, in its units."""

    settings: dict[str, Any]
    view: Pose | None = None


def locate_work(scene: SceneReference, folder: Path, query: LocateQuery) -> Callable[[Job], Work[str]]:
    """Return the job that locates a query in the reconstruction of ``folder`` and marks what it finds."""

    def work(job: Job) -> Work[str]:
        out = folder / RECONSTRUCTION
        record = read_record(out)
        dataset, frames = yield from _queries(job, record, query, scene.metres_per_unit)
        arguments = ["locate", str(out), str(dataset), "--json", "--device", fusion_device()]
        if frames is not None:
            arguments += ["--frames", frames]
        arguments += ["--stages", "nearest,depth" if query.settings["refine"] else "nearest"]
        yield from job.run(Command(program="fusion", arguments=tuple(arguments), failure="Nothing was located"))
        record = read_record(out)
        if place_located(scene.find(), record) is None:
            yield from bring_in(job, scene, out, undo="Scanback: Locate")
        else:
            push_undo("Scanback: Locate")
        if not record.located:
            lost = record.lost[0]
            raise ReconstructionError(f"The place of query {lost.query} was not found: {lost.reasons}")
        first = record.located[0]
        more = f", and {len(record.located) - 1} more" if len(record.located) > 1 else ""
        verdict = f" ({first.verdict})" if first.verdict is not None else ""
        whose = f"frame {first.query}" if query.settings["query"] in DATASET_QUERIES else "this view"
        return f"Nearest to {whose} is frame {first.nearest}{verdict}{more}"

    return while_claimed(folder, work)


def _queries(job: Job, record: Record, query: LocateQuery, unit: float) -> Work[tuple[Path, str | None]]:
    """Return the dataset that holds the queries, made where there is none, and which of its frames they are."""
    settings = query.settings
    if settings["query"] == "HELD_OUT":
        return record.dataset, None
    if settings["query"] == "FRAME":
        count = status_of(record.folder.parent, record.dataset).frame_count
        if count and settings["frame"] >= count:
            raise ReconstructionError(f"There is no frame {settings['frame']}; the dataset's are 0 to {count - 1}")
        return record.dataset, f"{settings['frame']}:{settings['frame'] + 1}"
    single = job.folder / "query"
    if settings["query"] == "FILES":
        if not settings["depth_file"]:
            raise ReconstructionError("No depth image is chosen; locating needs one")
        color = Path(settings["color_file"]) if settings["color_file"] else None
        write_single_view(
            single,
            record.intrinsics,
            depth=Path(settings["depth_file"]),
            depth_scale=settings["depth_scale"],
            color=color,
        )
        return single, None
    if query.view is None:
        raise ReconstructionError("There is no view to locate; look at the scene in a 3D viewport, or add a camera")
    yield from _render_view(job, record, pose_in_metres(query.view, unit), single)
    return single, None


def _render_view(job: Job, record: Record, view: Pose, single: Path) -> Work[None]:
    """See the reconstruction from a pose as its scan's camera would, and make a dataset of that."""
    seen = job.folder / "view"
    write_pose(job.folder / "view.txt", view)
    arguments = ["render", str(record.folder), str(seen), "--pose", str(job.folder / "view.txt"), "--json"]
    arguments += ["--device", fusion_device()]
    answer = yield from job.run(
        Command(program="fusion", arguments=tuple(arguments), failure="The view could not be seen")
    )
    if not answer["coverage"]:
        raise ReconstructionError("Nothing of the reconstruction is in view; look at it, then locate")
    step = read_json(seen / "view.json", remedy="locate again").member(DEPTH_STEP_KEY).positive_number()
    write_single_view(
        single,
        record.intrinsics,
        depth=seen / "depth.png",
        depth_scale=step,
        color=seen / "color.png",
        world_from_camera=view,
    )
