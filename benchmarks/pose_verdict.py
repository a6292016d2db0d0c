"""How often is a pose said to be found that is not, and not found that is? And which bounds would say so best?

    python -m benchmarks.pose_verdict out/held.json                          # shapes that no bound was chosen on
    python -m benchmarks.pose_verdict out/chosen.json --shapes chosen        # those that bounds are chosen on
    python -m benchmarks.pose_verdict out/scans.json --shapes none --meshes data/*/ground_truth/mesh.ply
    python -m benchmarks.pose_verdict out/real.json --shapes none --ycb-video data/ycbv
    python -m benchmarks.pose_verdict out/*.json --only-table

Every model is looked for in views of itself and in views of all others, as ``fusion locate`` does with a CAD model. The
shapes are random solids: boxes, ellipsoids, cylinders and rings, joined or cut out of each other, whose numbers make
them; a shape's *twin* has its last part a third larger, and is the hardest wrong object that there is. Views are ray
cast from random sides and distances, half before a slanting wall and half before nothing; half have a Kinect's noise, a
mask that is off by 1 to 2 pixels and something that hides up to 30 %. Each is located by depth and mask, by depth alone
where there is no wall, and by its mask alone. Real views are those of YCB-Video, with the models and masks that it has.

A pose of the right object is right where its points are off by less than 2 % of the diameter (ADD-S). Told are the
verdicts, the rates with their 95 % bounds (Clopper and Pearson), and the bounds on quality that these cases ask for:
*found* from where no wrong pose is left, *doubtful* from where 1 % of the right ones lie below.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.random_solids import centred, random_solid
from benchmarks.verdict_cases import Case, cases_of_meshes, cases_of_ycb_video
from datagen.atomic_write import write_json
from fusion.devices import resolve_device
from fusion.surface.mesh_files import read_mesh

FIRST_NUMBER = {"chosen": 100, "held": 200}


def rate(count, total):
    """Return a rate with its 95 % bounds, in words."""
    if not total:
        return "–"
    low = stats.beta.ppf(0.025, count, total - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, total - count) if count < total else 1.0
    return f"{count / total:.1%} ({low:.1%} to {high:.1%})"


def suggested(cases):
    """Return the bounds that cases ask for: found above all that is wrong, doubtful above 1 % of what is right."""
    wrong = [case.quality for case in cases if case.truth in ("wrong object", "wrong pose") and case.settled]
    right = [case.quality for case in cases if case.truth == "right pose"]
    found_from = np.ceil(100 * max(wrong, default=0) + 1e-9) / 100
    doubtful_from = np.floor(100 * np.quantile(right, 0.01)) / 100 if right else float("nan")
    return float(found_from), float(doubtful_from)


def show(cases):
    for sees in sorted({case.sees for case in cases}):
        some = [case for case in cases if case.sees == sees]
        print(f"\n{sees}: {'':12s} {'found':>6s} {'doubtful':>9s} {'not found':>10s}   quality: least, 5 %, 95 %, most")
        for truth in ("right pose", "wrong pose", "wrong object", "twin"):
            these = [case for case in some if case.truth == truth]
            if not these:
                continue
            counts = [sum(case.answer == answer for case in these) for answer in ("found", "doubtful", "not found")]
            spread = " ".join(f"{q:.2f}" for q in np.quantile([case.quality for case in these], (0, 0.05, 0.95, 1)))
            print(f"  {truth:14s} {counts[0]:10d} {counts[1]:9d} {counts[2]:10d}   {spread}")
        right = [case for case in some if case.truth == "right pose"]
        wrong = [case for case in some if case.truth in ("wrong object", "wrong pose")]
        print(f"  falsely found {rate(sum(case.answer == 'found' for case in wrong), len(wrong))}", end="")
        print(f", falsely not found {rate(sum(case.answer == 'not found' for case in right), len(right))}")
        found_from, doubtful_from = suggested(some)
        print(f"  these cases ask for: found from {found_from:.2f}, doubtful from {doubtful_from:.2f}", flush=True)


def chosen_meshes(options):
    meshes = {}
    if options.shapes != "none":
        first = FIRST_NUMBER[options.shapes] if options.first is None else options.first
        for number in range(first, first + options.count):
            meshes[f"solid {number}"] = random_solid(number)
        for number in range(first, first + min(options.twins, options.count)):
            meshes[f"solid {number}'"] = random_solid(number, twin=True)
    for path in options.meshes:
        mesh = read_mesh(path)
        meshes[path.resolve().parent.parent.name] = centred(mesh.vertices, mesh.triangles, 0.28)
    return meshes


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="+", help="JSON of the cases; several with --only-table")
    parser.add_argument("--shapes", choices=[*FIRST_NUMBER, "none"], default="held")
    parser.add_argument("--first", type=int, metavar="NUMBER", help="of the shapes, to have some that nobody has seen")
    parser.add_argument("--count", type=int, default=8, help="of shapes")
    parser.add_argument("--twins", type=int, default=4, help="of how many there is a twin, too")
    parser.add_argument("--meshes", type=Path, nargs="*", default=[], metavar="PLY")
    parser.add_argument("--ycb-video", type=Path, metavar="FOLDER")
    parser.add_argument("--right", type=int, default=8, help="views of the model itself")
    parser.add_argument("--wrong", type=int, default=2, help="views of each other object")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only-table", action="store_true", help="of cases that were written")
    options = parser.parse_args()
    if options.only_table:
        show([Case(**case) for path in options.out for case in json.loads(path.read_text())])
        return
    device = resolve_device("cpu")
    cases = []

    def keep(case):
        if case is not None:
            cases.append(case)
            write_json(options.out[0], [asdict(one) for one in cases])

    for case in cases_of_meshes(chosen_meshes(options), options, device):
        keep(case)
    if options.ycb_video is not None:
        for case in cases_of_ycb_video(options, device):
            keep(case)
    show(cases)


if __name__ == "__main__":
    main()
