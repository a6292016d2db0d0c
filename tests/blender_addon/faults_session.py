"""A disk that fills up, one that may not be written to, and folders that may not be entered: what the panel says then.

``faults_session.py disks FOLDER CACHE`` runs where mounts are nobody else's, ``faults_session.py denied FOLDER CACHE``
gives up root's rights where it has them. Each prints one line of JSON: what was said and what was left behind.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import bpy

import blender_addon
from blender_addon.jobs import runner
from blender_addon.jobs.job import Pace
from blender_addon.settings import ScanProperties
from blender_addon.steps import reasons
from blender_addon.steps.scan import begun_scan, prepare_scan, scan_work

FRAMES = 12
NOBODY = 65534
SIZE = {"width": 64, "height": 48}
DISK_BYTES = 8 << 20


def mount(folder, *options):
    """Mount a small disk of its own on ``folder``, or mount it anew with other ``options``."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", ",".join(options), "scanback", str(folder)], check=True)


class Filler:
    """A file that takes all the room on a disk."""

    def __init__(self, folder):
        self.path = folder / "filler"

    def fill(self):
        with self.path.open("ab", buffering=0) as file:
            try:
                while file.write(b"x" * 4096):
                    pass
            except OSError:
                pass

    def free(self):
        self.path.unlink()


def names(folder):
    """Return the files in a folder and below, but for the filler."""
    return sorted(
        str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.name != "filler"
    )


def said(operator, **arguments):
    """Return what an operator says of its failure, empty where it does not fail."""
    try:
        operator(**arguments)
    except RuntimeError as error:
        return str(error)
    return ""


def scan_until_full(folder, disk):
    """Begin a scan as the panel does, and fill the disk when the first frames are there."""
    job = runner.start("Scan", scan_work(begun_scan(folder)))
    frames, filled, end = folder / "dataset" / "frames", False, time.monotonic() + 300
    while not job.is_over and time.monotonic() < end:
        if not filled and len(list(frames.glob("*.pose.txt"))) >= 3:
            disk.fill()
            filled = True
        if runner.advance() is Pace.WAIT:
            time.sleep(0.02)
    whole = {path.name.split(".")[0] for path in frames.glob("*.pose.txt")}
    torn = [name for name in whole for part in ("color.png", "depth.png") if not (frames / f"{name}.{part}").is_file()]
    written = {path.name: path.stat().st_mtime_ns for path in frames.iterdir() if path.name.split(".")[0] in whole}
    return {
        "state": job.state.value,
        "message": job.message,
        "whole": len(whole),
        "torn": torn,
        "unfinished": [name for name in names(folder) if ".unfinished" in name or ".lock" in name],
        "why not": reasons.why_no_job(),
        "dismissed": list(bpy.ops.scanback.dismiss()),
    }, written


def full_disk(folder):
    """Scan with no room at all, then until it is used up, then go on."""
    mount(folder, f"size={DISK_BYTES}")
    disk, seen = Filler(folder), {}
    disk.fill()
    bpy.ops.mesh.primitive_monkey_add(size=1)
    call = {"folder": str(folder), "preset": "draft", "frames": FRAMES, **SIZE}
    seen["no room"] = said(bpy.ops.scanback.scan, **call)
    seen["left of no room"] = names(folder)
    disk.free()
    chosen = {name: getattr(bpy.context.scene.scanback.scan, name) for name in ScanProperties.__annotations__} | call
    prepare_scan(bpy.context.scene, bpy.context.object, folder, chosen, overwrite=False)
    seen["filled"], written = scan_until_full(folder, disk)
    disk.free()
    seen["went on"] = list(bpy.ops.scanback.resume_scan(folder=str(folder)))
    frames = folder / "dataset" / "frames"
    seen["frames"] = len(list(frames.glob("*.pose.txt")))
    seen["anew"] = [name for name, time_ns in written.items() if (frames / name).stat().st_mtime_ns != time_ns]
    disk.fill()
    seen["fuse"] = said(bpy.ops.scanback.fuse, folder=str(folder), voxel_size=0.1, device="cpu", live=False)
    seen["left of fuse"] = [name for name in names(folder) if name.startswith("reconstruction")]
    disk.free()
    return seen


def read_only(folder):
    """All that writes, on a disk that takes nothing any more."""
    mount(folder, "remount", "ro")
    return {
        "again": said(bpy.ops.scanback.scan, folder=str(folder), overwrite=True, frames=3, **SIZE),
        "elsewhere": said(bpy.ops.scanback.scan, folder=str(folder / "new"), frames=3, **SIZE),
        "fuse": said(bpy.ops.scanback.fuse, folder=str(folder), device="cpu"),
        "frames": len(list((folder / "dataset" / "frames").glob("*.pose.txt"))),
        "why not": reasons.why_no_job(),
    }


def full_cache(folder, cache):
    """A job whose own folder has no room."""
    mount(cache, "size=64k")
    Filler(cache).fill()
    return {
        "estimate": said(bpy.ops.scanback.estimate, folder=str(folder)),
        "left": names(cache),
        "why not": reasons.why_no_job(),
    }


def disks(folder, cache):
    """Go through all cases of disks."""
    seen = {"full": full_disk(folder), "read-only": read_only(folder)}
    return seen | {"cache": full_cache(folder, cache)}


def denied(folder, cache):
    """Name a folder that may not be entered, and one in it, wherever a folder can be named."""
    if os.geteuid() == 0:
        os.chown(cache, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)
    else:
        folder.chmod(0)
    bpy.ops.mesh.primitive_cube_add()
    seen = {}
    for name, place in (("itself", folder), ("within", folder / "scan")):
        scene = bpy.context.scene
        scene.scanback.folder = str(place)
        why = (reasons.why_not_scan, reasons.why_not_fuse, reasons.why_not_locate, reasons.why_not_compare)
        seen[f"why, {name}"] = [reason(bpy.context) for reason in why]
        for step in ("scan", "resume_scan", "fuse", "locate", "compare"):
            seen[f"{step}, {name}"] = said(getattr(bpy.ops.scanback, step), folder=str(place))
        for kind in ("reconstruction", "dataset"):
            operator = getattr(bpy.ops.scanback, f"import_{kind}")
            seen[f"import {kind}, {name}"] = said(operator, directory=str(place))
    folder.chmod(0o700) if os.geteuid() != NOBODY else None
    return seen


def main(case, folder, cache):
    """Go through the cases in a Blender with the extension, whose jobs have their files in ``cache``."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    blender_addon.register()
    runner.cache_folder = lambda: cache
    seen = {"disks": disks, "denied": denied}[case](folder, cache)
    blender_addon.unregister()
    sys.stdout.write("SEEN " + json.dumps(seen) + "\n")


if __name__ == "__main__":
    os.chdir("/")
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
