"""Does ``datagen validate`` name every fault, and none where there is none? Random recordings, each corrupted each way.

    python -m benchmarks.validate --seeds 200 --workers 2 --out validate.jsonl

A seed is a scene (objects on a table, an object alone, a room), a handheld path of 40 frames, a camera and a size; two
in three have texture. Each is checked clean, as a depth camera would see it, and with each fault of
``tests/ray_cast_recordings.py``, with the ground-truth mesh and without. A fault is named where it is the only fault
that is reported. Without the mesh a recording may not show it: that is told apart where the report says so.
"""

import argparse
import json
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
from ray_cast_recordings import CORRUPTIONS, Recording, record, with_sensor_noise

from datagen.dataset_check.check import check_dataset

CLEAN = ("clean", "sensor-noise")
KINDS = (*CLEAN, *CORRUPTIONS)


def corrupted(clean: Recording, kind: str, seed: int) -> tuple[Recording, str]:
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "clean":
        return clean, ""
    if kind == "sensor-noise":
        return with_sensor_noise(clean, rng), ""
    return CORRUPTIONS[kind](clean, rng)


def check(recording: Recording, mesh: Path | None) -> dict:
    start = time.process_time()
    report = check_dataset(recording.in_memory(mesh))
    seconds = time.process_time() - start
    faults = [finding.kind for finding in report.findings if finding.severity == "fault"]
    unsure = [k for f in report.findings if f.kind == "cannot-tell" for k in f.evidence["kinds"]]
    unsure += [k for f in report.findings if f.kind == "ambiguous" for k in f.evidence["candidates"]]
    notes = [finding.kind for finding in report.findings if finding.severity == "note"]
    messages = [finding.message for finding in report.findings]
    return {"faults": faults, "notes": notes, "unsure": unsure, "seconds": seconds, "messages": messages}


def outcome(kind: str, result: dict) -> str:
    found = sorted(set(result["faults"]))
    if found == ([] if kind in CLEAN else [kind]):
        return "right"
    if not found or found == ["ambiguous"]:
        return "told that it cannot be told" if kind in result["unsure"] else "missed"
    return "+".join(found)


def run_seed(seed: int, kinds: tuple[str, ...], meshes: tuple[bool, ...]) -> list[dict]:
    clean = record(seed)
    rows = []
    with tempfile.TemporaryDirectory(prefix="validate-") as folder:
        mesh = Path(folder) / "mesh.ply"
        clean.mesh.export(mesh)
        for kind in kinds:
            recording, size = corrupted(clean, kind, seed)
            for with_mesh in meshes:
                result = check(recording, mesh if with_mesh else None)
                rows.append({"seed": seed, "kind": kind, "size": size, "mesh": with_mesh, **result})
                rows[-1]["outcome"] = outcome(kind, result)
    return rows


def print_table(rows: list[dict]) -> None:
    for with_mesh in (True, False):
        counts = {
            kind: Counter(r["outcome"] for r in rows if r["mesh"] == with_mesh and r["kind"] == kind) for kind in KINDS
        }
        if not any(counts.values()):
            continue
        print(f"\n{'with the ground-truth mesh' if with_mesh else 'without a mesh'}")
        for kind, counter in counts.items():
            if counter:
                others = ", ".join(f"{n} {name}" for name, n in counter.most_common() if name != "right")
                print(f"  {kind:14}{counter['right']:5} right of {sum(counter.values()):4}  {others}")
    seconds = [row["seconds"] for row in rows]
    print(f"\n{len(rows)} checks, processor time of one: median {np.median(seconds):.2f} s, most {max(seconds):.2f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200, help="recordings, and so corruptions of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--mesh", choices=("with", "without", "both"), default="both")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--out", type=Path, help="every result as a line of JSON; seeds that are there are not run again"
    )
    options = parser.parse_args()
    meshes = {"with": (True,), "without": (False,), "both": (True, False)}[options.mesh]
    rows = (
        [json.loads(line) for line in options.out.read_text().splitlines()]
        if options.out and options.out.exists()
        else []
    )
    there = {row["seed"] for row in rows if row["mesh"] in meshes}
    seeds = [seed for seed in range(options.first, options.first + options.seeds) if seed not in there]
    with ProcessPoolExecutor(options.workers) as pool:
        for future in as_completed([pool.submit(run_seed, seed, tuple(options.kinds), meshes) for seed in seeds]):
            new = future.result()
            rows += new
            if options.out:
                with options.out.open("a") as file:
                    file.writelines(json.dumps(row) + "\n" for row in new)
            for row in new:
                if row["outcome"] != "right":
                    mesh = "mesh" if row["mesh"] else "no mesh"
                    print(f"seed {row['seed']} {row['kind']} {row['size']} {mesh}: {row['outcome']}", flush=True)
                    for message in row["messages"]:
                        print(f"    {message}", flush=True)
    print_table(rows)


if __name__ == "__main__":
    main()
