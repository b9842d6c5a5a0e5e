"""What full logging costs beside the work that it logs, in time, bytes and memory.

    python benchmarks/log.py [--frames 400] [--quality 90] [--passes 3]
    python benchmarks/log.py --frames 20000

The frames are JPEG images, 512 x 512, of a simulated drive over gravel. One process decodes them to grey, runs
the preset `best` over them, and logs images and steps with every surface; each part is timed alone, and the pass
with the least is told, per frame: CPU time of the thread that does it, and of all threads (Rerun encodes and
writes in threads of its own). Bars: logging at most as much again as decoding and estimating; 25 kB a frame
beyond the stored image.

Beyond 2000 frames it is memory that is measured instead: a process of its own replays a folder of so many
images, 400 of them over and over, there and back. Bar: 1 GiB at the peak.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import CorrelationSettings
from pipelines.correlation.step import CorrelationStep
from pipelines.replay import grey_sample
from pipelines.simulation.mission import SimulatedMission, nadir_mission
from pipelines.simulation.surfaces import gravel
from pipelines.simulation.trajectories import drive, figure_eight
from readers.streams import ImageSample, ReadOptions, Sample

RATE_HZ = 60.0
MEMORY_FROM, SOURCE_FRAMES = 2000, 400
BAR_BYTES, BAR_RATIO, BAR_MIB = 25_000, 1.0, 1024

T = TypeVar("T")


class Cost(NamedTuple):
    """CPU time in s: of this thread, and of all threads."""

    thread_s: float
    process_s: float


def measured(work: Callable[[], T]) -> tuple[T, Cost]:
    """The result of some work, and its cost."""
    thread_s, process_s = time.thread_time(), time.process_time()
    result = work()
    return result, Cost(time.thread_time() - thread_s, time.process_time() - process_s)


# ------------------------------------------------------------------------------------ input


def drive_over_gravel(frames: int) -> SimulatedMission:
    """The paper's figure eight at 0.51 m/s."""
    rng = np.random.default_rng(0)
    return nadir_mission(gravel(1024, rng), drive(figure_eight(), frames, speed_mps=0.51, rng=rng))


def jpegs(mission: SimulatedMission, quality: int) -> list[bytes]:
    """The mission's images as JPEG."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return [cv2.imencode(".jpg", mission.frame(k), flags)[1].tobytes() for k in range(len(mission.truth_poses))]


def stored(mission: SimulatedMission, images: Sequence[bytes]) -> list[ImageSample]:
    """The images as a reader would give them."""
    times = mission.truth_t_ns.tolist()
    return [
        ImageSample(stream="/camera", t_ns=t_ns, received_ns=t_ns, encoding="jpeg", payload=data, frame=k)
        for k, (t_ns, data) in enumerate(zip(times, images, strict=True))
    ]


# ------------------------------------------------------------------------------------- time


def estimate(settings: CorrelationSettings, samples: Sequence[Sample]) -> list[CorrelationStep]:
    """The steps of decoded images."""
    estimator = CorrelationOdometry(settings)
    state, steps = estimator.start(), []
    for sample in samples:
        state, step = estimator.step(state, sample)
        if step is not None:
            steps.append(step)
    return steps


def log(folder: Path, samples: Sequence[ImageSample], steps: Sequence[CorrelationStep]) -> None:
    """Log images and steps, every surface included, and close the files."""
    from workbench.rrd import RunWriter, SensorWriter

    with (
        SensorWriter(folder / "sensors.rrd", recording_id="benchmark") as sensors,
        RunWriter(
            folder / "best.rrd",
            recording_id="benchmark",
            run="best",
            estimator="correlation",
            step_type=CorrelationStep,
            settings_text="",
        ) as run,
    ):
        for sample, step in zip(samples, steps, strict=True):
            sensors.image(step.frame, sample)
            run.step(step)
        run.finish({}, None)


def measure_time(frames: int, quality: int, passes: int) -> None:
    """Time every part alone and print their costs per frame, the ratio, and the bytes."""
    mission = drive_over_gravel(frames)
    samples = stored(mission, jpegs(mission, quality))
    settings = replaced(CorrelationSettings.preset("best"), metres_per_px=mission.metres_per_px)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        decoded = [grey_sample(sample) for sample in samples[:5]]
        log(folder, samples[:5], estimate(settings, decoded))  # compiles and warms up
        costs: list[tuple[Cost, Cost, Cost]] = []
        for _ in range(passes):
            decoded, decoding = measured(lambda: [grey_sample(sample) for sample in samples])
            steps, estimating = measured(lambda decoded=decoded: estimate(settings, decoded))  # type: ignore[misc]
            _, logging = measured(lambda steps=steps: log(folder, samples, steps))  # type: ignore[misc]
            costs.append((decoding, estimating, logging))
        beyond = sum(file.stat().st_size for file in folder.iterdir()) - sum(len(s.data) for s in samples)
    least = [Cost(*np.min(part, axis=0)) for part in zip(*costs, strict=True)]
    print(
        f"{frames} frames, {sum(len(s.data) for s in samples) / frames / 1e3:.1f} kB each as JPEG of quality {quality}"
    )
    print(f"{'µs per frame':<14}{'thread':>9}{'all threads':>13}")
    for part, cost in zip(("decoding", "estimating", "logging"), least, strict=True):
        print(f"{part:<14}{cost.thread_s / frames * 1e6:>9.0f}{cost.process_s / frames * 1e6:>13.0f}")
    decoding, estimating, logging = least
    ratios = [c / (a + b) for a, b, c in zip(decoding, estimating, logging, strict=True)]
    print(f"{'ratio':<14}{ratios[0]:>9.2f}{ratios[1]:>13.2f}   logging over the rest; bar {BAR_RATIO:g}")
    print(f"{beyond / frames / 1e3:.1f} kB a frame beyond the stored image; bar {BAR_BYTES / 1e3:g} kB")


def replaced(settings: CorrelationSettings, **changes: object) -> CorrelationSettings:
    """Settings with some values changed."""
    return CorrelationSettings.model_validate(settings.model_dump() | changes)


# ----------------------------------------------------------------------------------- memory


def measure_memory(frames: int, quality: int) -> None:
    """Replay a folder of many images in a process of its own and print its peak memory."""
    mission = drive_over_gravel(SOURCE_FRAMES)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, long = folder / "source", folder / "long"
        source.mkdir()
        long.mkdir()
        for k, data in enumerate(jpegs(mission, quality)):
            (source / f"{k}.jpg").write_bytes(data)
        period = 2 * (SOURCE_FRAMES - 1)
        for k in range(frames):
            back = k % period
            os.link(source / f"{min(back, period - back)}.jpg", long / f"{k:06d}.jpg")
        scale = f"{mission.metres_per_px!r}"
        subprocess.run([sys.executable, __file__, "--replay", str(long), str(folder / "out"), scale], check=True)


def replay_folder(folder: Path, out: Path, scale: str) -> None:
    """Replay a folder of images with full logging; print what came of it and this process's peak memory."""
    from workbench.session import Request, run

    request = Request(
        path=folder, preset="best", overrides=(f"metres_per_px={scale}",), options=ReadOptions(rate_hz=RATE_HZ), out=out
    )
    outcome, cost = measured(lambda: run(request))
    unit = 1 if sys.platform == "darwin" else 1024
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / (1 << 20)
    print(f"{outcome.summary['frames']} frames in {cost.process_s:.0f} s of CPU: {outcome.summary['verdicts']}")
    print(
        f"run {outcome.run_file.stat().st_size / 1e6:.0f} MB, images {outcome.sensors_file.stat().st_size / 1e6:.0f} MB"
    )
    print(f"peak memory {peak_mib:.0f} MiB; bar {BAR_MIB} MiB")


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=400, help="number of frames; from 2000 on for memory")
    parser.add_argument("--quality", type=int, default=90, help="quality of the JPEG images")
    parser.add_argument("--passes", type=int, default=3, help="passes of which the least counts")
    parser.add_argument("--replay", nargs=3, metavar=("FOLDER", "OUT", "SCALE"), help="only replay a folder")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.replay:
        folder, out, scale = arguments.replay
        replay_folder(Path(folder), Path(out), scale)
    elif arguments.frames >= MEMORY_FROM:
        measure_memory(arguments.frames, arguments.quality)
    else:
        measure_time(arguments.frames, arguments.quality, arguments.passes)


if __name__ == "__main__":
    main()
