"""``fusion locate``: where a view was taken from, or where an object lies in it."""

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from datagen.atomic_write import require_writable
from datagen.commands.arguments import add_frames, add_json
from datagen.commands.job_options import add_job_options, reporting
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import add_device, print_json
from fusion.pose.epipolar import FEATURES
from fusion.pose.locate import LocateOptions, frames_to_locate, locate_queries, write_poses
from fusion.pose.located_picture import require_png, write_picture
from fusion.pose.mask_source import MaskChoice
from fusion.pose.query_source import ImageFiles, QuerySource, image_query
from fusion.reconstruction_files import POSES_FILE, LocatedPose, poses_as_json

MOST_TOLD = 5

DESCRIPTION = """\
Find the 6-DoF pose of a view: of the camera in a scene that was scanned, or of an object before the camera.

Each query gets the nearest view first, by geometry alone, then what refines it:
  nearest     the nearest fused frame (or rendered view of a mesh); with depth by its shape, without by the outline
  epipolar    features shared with the nearest frames (or renderings): needs colour and texture
  silhouette  the mask's outline: needs --mask, or depth that shows the object alone
  depth       the depth against the model's surface: needs depth; the most exact
Without --stages it is nearest,depth, or nearest,epipolar,silhouette where there is no depth, epipolar given colour.
"""

EPILOG = """\
examples:
  fusion locate room recording --frames ::10                       frames of another recording of a room
  fusion locate mug table --mask layer --object mug                an object of a rendered dataset (--layers masks)
  fusion locate mug table --mask derived                           the mask from depth: what stands on a support
  fusion locate mug.ply --color c.png --depth d.png --depth-scale 0.001 --intrinsics 615 615 320 240 --mask m.png
  fusion locate obj_000005.ply scene --model-scale 0.001 --mask 'mask_visib/{frame:06d}_000000.png'   BOP: millimetres
  fusion locate mug.obj --color c.png --mask m.png --intrinsics camera.json      no depth: by features and silhouette
  fusion locate mug table --mask derived --picture located.png     the model's outline drawn over each query

results (poses.json, --json): the world's frame is the object's frame: that of the reconstruction, or of the mesh's
file after --model-scale (glTF turned so that z is up). world_from_camera is the camera in it; camera_from_object, its
inverse, the object before the camera: for an object that moves. Metres, OpenCV axes (x right, y down, z forward).

verdict: found; doubtful: the reasons say why, the pose may be right; not found: no pose is given. It comes from what
the view shows for and against the pose (quality, evidence). uncertainty names the directions that nothing fixes;
alternatives are other poses that explain the view as well, symmetric where the model looks the same in them.
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.description = DESCRIPTION
    command.epilog = EPILOG
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.add_argument(
        "model",
        metavar="MODEL",
        type=Path,
        help="a folder that fusion reconstruct wrote, or a mesh: .ply, .obj, .glb, .stl (.xyz)",
    )
    command.add_argument(
        "dataset", metavar="DATASET", type=Path, nargs="?", help="where the query frames are; not with --color, --depth"
    )
    _add_query(command)
    add_frames(command, default="all that were not fused")
    command.add_argument("--stages", metavar="A,B", help="nearest, then any of epipolar, silhouette, depth")
    command.add_argument(
        "--features", choices=FEATURES, default="sift", help="what the epipolar stage matches (default: sift)"
    )
    command.add_argument(
        "--model-scale", type=float, metavar="S", help="metres a unit of the mesh's file: 0.001 for millimetres"
    )
    command.add_argument(
        "--out", type=Path, metavar="FILE", help="write the result here (default: poses.json in the reconstruction)"
    )
    command.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw the model's outline over up to 8 queries"
    )
    add_device(command)
    add_json(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def _add_query(command: argparse.ArgumentParser) -> None:
    query = command.add_argument_group("the queries")
    query.add_argument(
        "--mask",
        metavar="layer|derived|FILE",
        help="where the object is: the dataset's layer masks; told from depth; or an image, {frame} standing for the"
        " query's number",
    )
    query.add_argument("--object", metavar="NAME|N", help="which object of a mask that numbers several")
    query.add_argument("--color", type=Path, metavar="FILE", help="one query's colour image, in place of a dataset")
    query.add_argument(
        "--depth",
        metavar="LAYER|FILE",
        help="of a dataset: sensor_depth in place of depth; else the query's 16-bit PNG",
    )
    query.add_argument("--depth-scale", type=float, metavar="S", help="metres a step of the depth image")
    query.add_argument(
        "--intrinsics", nargs="+", default=(), metavar="FX FY CX CY|FILE", help="the query's camera, in pixels"
    )


def _run(options: argparse.Namespace) -> None:
    out = options.out
    if out is None and options.dataset is not None and options.model.is_dir():
        out = options.model / POSES_FILE
    if options.picture is not None:
        require_png(options.picture)
    for path in (out, options.picture):
        if path is not None:
            require_writable(path.parent)
    source = _queries(options)
    settings = LocateOptions(
        stages=options.stages, features=options.features, model_scale=options.model_scale, device=options.device
    )
    with reporting(options) as progress:
        located = locate_queries(options.model, source, settings, progress=progress)
    if out is not None:
        write_poses(out, located)
    if options.picture is not None:
        write_picture(options.picture, source, located)
    if options.json:
        print_json(poses_as_json(located.results))
    else:
        _print_poses(located.results)
    for result in located.results:
        # What is found without reserve is told of a few queries, not of hundreds.
        if result.verdict != "found" or len(located.results) <= MOST_TOLD:
            for reason in result.reasons:
                print(f"fusion: note: query {result.query}, {result.verdict}: {reason}", file=sys.stderr)


def _queries(options: argparse.Namespace) -> QuerySource:
    if options.object is not None and options.mask is None:
        raise InputError(f"--object {options.object}: says which object of a mask; give --mask too")
    mask = None if options.mask is None else MaskChoice(source=options.mask, object_name=options.object)
    if options.dataset is None:
        if options.frames is not None:
            raise InputError(f"--frames {options.frames}: a slice over a dataset's frames; name the dataset too")
        if not (options.color or options.depth or options.mask):
            raise InputError("nothing to locate: name a DATASET, or one image by --color, --depth or --mask")
        return image_query(
            ImageFiles(
                color=options.color,
                depth=None if options.depth is None else Path(options.depth),
                depth_scale=options.depth_scale,
                intrinsics=tuple(options.intrinsics),
                mask=mask,
            )
        )
    for name in ("color", "depth_scale", "intrinsics"):
        if getattr(options, name):
            flag = "--" + name.replace("_", "-")
            raise InputError(f"{flag}: is for one image; {options.dataset} is a dataset, which has its own")
    dataset = open_dataset(options.dataset)
    if options.depth is not None:
        dataset = dataset.with_depth_layer(options.depth)
    return frames_to_locate(options.model, dataset, frames=options.frames, mask=mask)


def _print_poses(poses: list[LocatedPose]) -> None:
    refined = any(pose.refined is not None for pose in poses)
    known = any(pose.rotation_error_deg is not None for pose in poses)
    columns = ["query", "verdict", "nearest"]
    columns += ["quality", "object before\ncamera (m)", "±\n(mm)"] if refined else ["score\n(mm²)"]
    columns += ["off\n(°)", "off\n(mm)"] if known else []
    # Headers of two lines, so that all of it fits a terminal of 80 columns.
    table = Table(*(Column(name, no_wrap=True) for name in columns), box=None, padding=(0, 2, 0, 0))
    for pose in poses:
        nearest = "–" if pose.nearest is None else str(pose.nearest)
        details = _refined_cells(pose, known=known) if refined else _nearest_cells(pose, known=known)
        table.add_row(str(pose.query), pose.verdict, nearest, *details)
    Console().print(table)


def _nearest_cells(pose: LocatedPose, *, known: bool) -> list[str]:
    score = _number(None if pose.score is None else 1e6 * pose.score, 3)
    cells = [f"{score}{' (ambiguous)' if pose.ambiguous else ''}"]
    return cells + ([_number(pose.rotation_error_deg, 2), _millimetres(pose.translation_error_m)] if known else [])


def _refined_cells(pose: LocatedPose, *, known: bool) -> list[str]:
    found = pose.refined
    if found is None:
        return ["–"] * (5 if known else 3)
    place = "–"
    if found.camera_from_object is not None:
        place = " ".join(f"{line[3]:z.3f}" for line in found.camera_from_object[:3])
    spread = None if found.uncertainty is None else found.uncertainty.deviations_mm[-1]
    cells = [_number(found.quality, 2), place, _number(spread, 2)]
    return cells + ([_number(found.rotation_error_deg, 3), _millimetres(found.translation_error_m)] if known else [])


def _millimetres(metres: float | None) -> str:
    return _number(None if metres is None else 1000 * metres, 2)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
