"""How fast, how clean, how exact and how robust does ``datagen render`` make frames?

    python -m benchmarks.render quality suzanne            # each preset: time, and PSNR against a converged image
    python -m benchmarks.render overhead suzanne           # wall time over Cycles' own, at 1 and 16 samples
    python -m benchmarks.render depth suzanne bunny table  # against ray casting in double precision
    python -m benchmarks.render memory suzanne             # of a worker over hundreds of frames
    python -m benchmarks.render kills --times 20           # two shards, killed at random, against one run

Cycles' own time is what it writes into its images' headers (rendering and synchronisation). Each figure is from one
process that runs alone; on a machine with other work only ratios of the same line mean something, and "cpu" counts the
processor time of all threads.
"""

import argparse
import contextlib
import random
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import numpy as np
import psutil
from exact_raster import cast

from datagen.scene_spec.render_settings import PRESETS
from datagen.scene_spec.scene_files import load_scene, with_render_settings

CHECKOUT = Path(__file__).resolve().parents[1]
MEMORY = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())
WARM_UP_FRAMES = 2


def open_session(name, scratch, **changes):
    from datagen.blender.session import RenderSession

    return RenderSession(
        with_render_settings(load_scene(name), **changes), device="auto", threads=0, scratch=Path(scratch)
    )


def psnr(image, reference):
    """Return the peak signal-to-noise ratio, dB, of 8-bit images."""
    return 10 * np.log10(255**2 / np.mean((image.astype(float) - reference) ** 2))


def quality(options):
    from datagen.blender.render import configure_render, render_frame

    scene = load_scene(options.scenes[0])
    with tempfile.TemporaryDirectory(dir=MEMORY) as scratch:
        converged = {"samples": options.reference_samples, "bounces": 12, "denoise": False, "size": options.size}
        session = open_session(options.scenes[0], scratch, **converged)
        frames = [int(i) for i in np.linspace(0, session.spec.render.frames - 1, options.frames + 1)[:-1]]
        shoot = lambda frame, seed: render_frame(session.scene, frame, seed=seed, scratch=Path(scratch)).color  # noqa: E731
        references = [shoot(frame, 1) for frame in frames]
        print(f"{scene.name}, {options.size[0]}×{options.size[1]}, reference {options.reference_samples} samples")
        for name, preset in PRESETS.items():
            configure_render(session.scene, with_render_settings(scene, size=options.size, **preset).render)
            for frame in range(WARM_UP_FRAMES):
                shoot(frame, 0)
            wall, cpu = time.perf_counter(), time.process_time()
            images = [shoot(frame, 0) for frame in frames]
            wall, cpu = (
                (now - then) / len(frames) for now, then in ((time.perf_counter(), wall), (time.process_time(), cpu))
            )
            values = [psnr(image, reference) for image, reference in zip(images, references, strict=True)]
            print(
                f"{name:<9}{wall:7.2f} s a frame ({cpu:.2f} s cpu), PSNR {np.mean(values):.1f} dB "
                f"({min(values):.1f} to {max(values):.1f})  {preset}",
                flush=True,
            )


def overhead(options):
    import OpenEXR

    from datagen.blender import render

    own = []
    read = render.read_channels

    def reading_times(exr):
        with OpenEXR.File(str(exr), separate_channels=True) as file:
            header = file.header()  # which is empty once the file is closed
            keys = [key for key in header if key.endswith((".render_time", ".synchronization_time"))]
            own.append(sum(_seconds(header[key]) for key in keys))
        return read(exr)

    render.read_channels = reading_times
    for samples in (1, 16):
        with (
            tempfile.TemporaryDirectory(dir=MEMORY) as scratch,
            tempfile.TemporaryDirectory() as out,
            ThreadPoolExecutor(1) as writer,
        ):
            session = open_session(options.scenes[0], scratch, samples=samples, denoise=False)
            for frame in range(WARM_UP_FRAMES):
                session.write_frame(Path(out), frame)
            own.clear()
            waiting, begin = [], time.perf_counter()
            for frame in range(options.frames):
                shot = session.render(frame)
                wait(waiting)
                waiting = [writer.submit(session.write, Path(out), shot)]
            wait(waiting)
            wall = (time.perf_counter() - begin) / options.frames
        cycles = float(np.mean(own))
        print(f"{samples:>3} samples: {wall:.3f} s a frame, Cycles {cycles:.3f} s, overhead {wall / cycles - 1:.1%}")


def _seconds(text):
    minutes, seconds = str(text).split(":")[-2:]
    return 60 * float(minutes) + float(seconds)


def depth(options):
    from datagen.blender.ground_truth import evaluated_mesh

    for name in options.scenes:
        with tempfile.TemporaryDirectory(dir=MEMORY) as scratch:
            session = open_session(name, scratch, samples=1, denoise=False)
            mesh = evaluated_mesh()
            for frame in np.linspace(0, session.spec.render.frames - 1, options.frames).astype(int):
                found, pose = exact_depth(session, int(frame))
                truth = cast(mesh.vertices_world, mesh.triangles, session.camera, pose).depth
                both = (found > 0) & np.isfinite(truth)
                error = found[both] / truth[both] - 1
                grazing = np.abs(error) > 1e-4
                steps = np.abs(np.rint(found[both].astype(float) / 1e-4) * 1e-4 - truth[both]) / 1e-4
                print(
                    f"{name} frame {frame}: {both.sum()} pixels, relative rms {rms(error):.2e}; {grazing.sum()} beyond "
                    f"1e-4 (rays that graze an edge), without them {rms(error[~grazing]):.2e}; quantised at 0.1 mm "
                    f"{np.mean(steps <= 0.5 + 0.02):.5%} within half a step; covered otherwise "
                    f"{((found > 0) != np.isfinite(truth)).sum()}",
                    flush=True,
                )


def exact_depth(session, frame):
    """Return a frame's depth before it is quantised, and its pose."""
    from datagen.blender import shot

    taken = session.render(frame)
    rendered = shot._read_exact(
        taken.image, taken.world_from_camera, session.spec, session.camera, session._thin_triangles
    )
    return rendered.depth, taken.world_from_camera


def rms(values):
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def memory(options):
    with tempfile.TemporaryDirectory(dir=MEMORY) as scratch, tempfile.TemporaryDirectory() as out:
        session = open_session(options.scenes[0], scratch, samples=1, frames=options.frames, size=options.size)
        series = []
        for frame in range(options.frames):
            session.write_frame(Path(out), frame)
            series.append(psutil.Process().memory_info().rss / 2**20)
    fifth = len(series) // 5
    settled = np.array(series[fifth:])
    middle = float(np.median(settled))
    growth = np.mean(settled[-fifth:]) / np.mean(settled[:fifth]) - 1
    print(
        f"{options.frames} frames of {options.size[0]}×{options.size[1]}: {middle:.0f} MB, "
        f"{settled.min() / middle - 1:+.1%} to {settled.max() / middle - 1:+.1%} from frame {fifth} on; "
        f"the last fifth over the second {growth:+.2%}"
    )


def kills(options):
    """Render in one go, and in two shards whose processes are killed; compare the bytes."""
    chance = random.Random(options.seed)
    settings = ["--frames", "96", "--size", "64x48", "--preset", "draft", "--layers", "normals,masks,flow"]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "datagen", "render", options.scenes[0]]
        subprocess.run([*command, f"{folder}/straight", *settings], cwd=CHECKOUT, check=True, capture_output=True)
        torn, done = 0, 0
        while done < options.times:
            shard = ["--shard", f"{1 + done % 2}/2"]
            process = subprocess.Popen(
                [*command, f"{folder}/killed", *settings, *shard],
                cwd=CHECKOUT,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            _wait_for_frames(process, Path(folder) / "killed" / "frames", chance)
            if process.poll() is not None:
                raise SystemExit(f"a shard was done after {done} kills: give it more frames")
            _kill(process, chance)
            done += 1
            torn += any(Path(folder, "killed").rglob(".unfinished-*"))
        for number in (1, 2):
            subprocess.run(
                [*command, f"{folder}/killed", *settings, "--shard", f"{number}/2"],
                cwd=CHECKOUT,
                check=True,
                capture_output=True,
            )
        straight, killed = _contents(Path(folder) / "straight"), _contents(Path(folder) / "killed")
    same = straight == killed
    print(
        f"{done} kills, {torn} in the middle of a file; {len(straight)} files: {'identical' if same else 'DIFFERENT'}"
    )
    if not same:
        print([name for name in straight.keys() | killed.keys() if straight.get(name) != killed.get(name)][:10])
        raise SystemExit(1)


def _wait_for_frames(process, frames, chance):
    """Wait for none to four new frames, and a moment."""
    before, wanted = len(list(frames.glob("*.pose.txt"))), chance.randint(0, 4)
    while process.poll() is None and len(list(frames.glob("*.pose.txt"))) < before + wanted:
        time.sleep(0.002)
    time.sleep(chance.uniform(0, 2 if wanted == 0 else 0.2))


def _kill(process, chance):
    """Kill a run's parent, its worker, or both at once; what is left of it a moment later; wait until all are gone."""
    workers = psutil.Process(process.pid).children()
    for victims in (chance.choice([[process], workers, [process, *workers]]), [process, *workers]):
        for victim in victims:
            with contextlib.suppress(psutil.NoSuchProcess):
                victim.kill()
        time.sleep(chance.uniform(0, 0.5))
    process.wait()
    psutil.wait_procs(workers)


def _contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("quality", "overhead", "depth", "memory", "kills"))
    parser.add_argument("scenes", nargs="*", default=["suzanne"])
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--size", type=lambda text: tuple(map(int, text.split("x"))), default=(640, 480))
    parser.add_argument("--reference-samples", type=int, default=1024)
    parser.add_argument("--times", type=int, default=20, help="kills")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    globals()[options.what](options)


if __name__ == "__main__":
    main()
