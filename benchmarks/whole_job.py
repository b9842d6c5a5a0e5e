"""The whole job against decoding alone: from a log of JPEG images to the files of a run.

    python benchmarks/whole_job.py [--frames 600] [--passes 3] [--raw]

The log is an MCAP file of a simulated drive over gravel, 512 x 512. Decoding alone reads it and decodes every image to
grey in as many threads as there are cores; the whole job replays it with the preset `best` and logs everything. The
least of the passes is told, in frames a second by the clock and in CPU time a frame, with the shares of the manifest
and of the estimator, which gets images that are decoded already. Two bounds of the share are told besides, both from
CPU time, which a busy machine blurs less than the clock: of the whole job as it is, whose calling thread runs the
estimator and the log one after the other while images are decoded and files written in other threads; and of decoding
and the estimator alone on all cores, as if nothing were read, logged or judged.
Bar: the whole job at 80 % of the rate of decoding alone. Run it on a machine that has nothing else to do.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipelines.replay import grey_sample
from pipelines.simulation.mission import nadir_mission
from pipelines.simulation.surfaces import gravel
from pipelines.simulation.trajectories import drive, figure_eight
from readers import open_recording
from readers.streams import ImageSample
from workbench import manifest
from workbench.session import Request, run
from workbench.settings import plugin, resolve
from workbench.writers import write

BAR = 0.8


class Cost(NamedTuple):
    """Seconds by the clock, of CPU in all threads, and of CPU in the calling thread."""

    wall_s: float
    cpu_s: float
    thread_s: float


def timed(work: Callable[[], Any]) -> Cost:
    """What some work costs."""
    before = time.perf_counter(), time.process_time(), time.thread_time()
    work()
    after = time.perf_counter(), time.process_time(), time.thread_time()
    return Cost(*(b - a for a, b in zip(before, after, strict=True)))


def least(costs: Sequence[Cost]) -> Cost:
    """The least of each."""
    return Cost(*map(min, zip(*costs, strict=True)))


def made_log(file: Path, frames: int, raw: bool) -> None:
    """Write the log."""
    rng = np.random.default_rng(0)
    mission = nadir_mission(gravel(1024, rng), drive(figure_eight(), frames, speed_mps=0.51, rng=rng))
    write(mission, file, image_format="stored" if raw else "jpeg")


def decode(file: Path, threads: int) -> None:
    """Decode all images, at most eight under way a thread."""
    with open_recording(file) as recording, ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Any]] = deque()
        for sample in recording.read():
            if isinstance(sample, ImageSample):
                waiting.append(pool.submit(sample.grey))
                if len(waiting) > 8 * threads:
                    waiting.popleft().result()
        for future in waiting:
            future.result()


def estimator_alone(file: Path, request: Request) -> Callable[[], None]:
    """The estimator over all images of the log, which stand decoded in memory."""
    known = plugin(request.estimator)
    settings = resolve(known, preset=known.usual_preset, file=None, overrides=request.overrides).settings
    estimator: Any = known.build(settings)
    with open_recording(file) as recording:
        samples = [grey_sample(sample) for sample in recording.read() if isinstance(sample, ImageSample)]

    def step_all() -> None:
        state = estimator.start()
        for sample in samples:
            state, _ = estimator.step(state, sample)

    return step_all


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--passes", type=int, default=3)
    parser.add_argument("--raw", action="store_true", help="raw images instead of JPEG")
    chosen = parser.parse_args()
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.mcap"
        made_log(log, chosen.frames, chosen.raw)
        request = Request(path=log, out=folder / "run", overrides=("metres_per_px=0.001",))
        run(request)  # compiles what it needs
        alone = least([timed(lambda: decode(log, cores)) for _ in range(chosen.passes)])
        whole = []
        for k in range(chosen.passes):
            fresh = Request(path=log, out=folder / f"run{k}", overrides=request.overrides)
            whole.append(timed(lambda fresh=fresh: run(fresh)))  # type: ignore[misc]
        listed = timed(lambda: manifest.taken(folder / "run", "best"))
        best = least(whole)
        stepping = estimator_alone(log, request)
        stepped = least([timed(stepping) for _ in range(chosen.passes)])
        named = {"decoding alone": alone, "whole job": best, "of it, estimator": stepped, "of it, manifest": listed}
        for title, cost in named.items():
            rate, (cpu_ms, thread_ms) = chosen.frames / cost.wall_s, (1e3 * s / chosen.frames for s in cost[1:])
            print(f"{title:16} {rate:9.1f} frames/s {cpu_ms:8.3f} ms of CPU a frame, {thread_ms:.3f} in one thread")
        share = alone.wall_s / best.wall_s
        idle = alone.cpu_s / cores / max(best.thread_s, best.cpu_s / cores)
        bound = alone.cpu_s / (alone.cpu_s + stepped.cpu_s)
        verdict = "met" if share >= BAR else "not met"
        print(f"whole job at {share:.0%} of decoding alone on {cores} cores (bar {BAR:.0%}: {verdict})")
        print(f"by CPU time at most {idle:.0%}; decoding and estimator, nothing else, at most {bound:.0%}")


if __name__ == "__main__":
    main()
