"""How long the commands about a finished run take on a long run, from the command to its answer.

    python benchmarks/debugging.py [--frames 20000] [--keep FOLDER]

The run is `best` over a simulated drive over gravel, 320 x 320 px, 400 frames there and back until there are enough,
with a reference. Every command runs in a process of its own, twice; the shorter time is told. Bars: explain 1.5 s, a
what-if of 100 frames 3 s, report 30 s and 10 MB.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from pipelines.simulation.mission import nadir_mission
from pipelines.simulation.surfaces import gravel
from pipelines.simulation.trajectories import drive, figure_eight

SOURCE_FRAMES, SIDE_PX, RATE_HZ, START_S = 400, 320, 60, 1_700_000_000
BAR_REPORT_BYTES = 10_000_000
PASSES = 2


class Timed(NamedTuple):
    """A command, its bar in seconds."""

    name: str
    arguments: Sequence[str]
    bar_s: float


def make_recording(folder: Path, frames: int) -> float:
    """Write a TUM RGB-D folder; its scale in m/px."""
    rng = np.random.default_rng(0)
    mission = nadir_mission(gravel(1024, rng), drive(figure_eight(), SOURCE_FRAMES, speed_mps=0.51, rng=rng))
    (folder / "rgb").mkdir(parents=True)
    for k in range(SOURCE_FRAMES):
        image = mission.frame(k)
        edge = (image.shape[0] - SIDE_PX) // 2
        cv2.imwrite(str(folder / "rgb" / f"{k}.jpg"), image[edge : edge + SIDE_PX, edge : edge + SIDE_PX])
    period = 2 * (SOURCE_FRAMES - 1)
    with (folder / "rgb.txt").open("w") as images, (folder / "groundtruth.txt").open("w") as poses:
        for k in range(frames):
            at = min(k % period, period - k % period)
            x, y, heading = map(float, mission.truth_poses[at])
            t = f"{START_S + k / RATE_HZ:.6f}"
            images.write(f"{t} rgb/{at}.jpg\n")
            poses.write(f"{t} {x!r} {y!r} 0 0 0 {math.sin(heading / 2)!r} {math.cos(heading / 2)!r}\n")
    return float(mission.metres_per_px)


def workbench(*arguments: str) -> float:
    """Run a command; its wall time in s."""
    code = "import sys; from workbench.cli import main; sys.exit(main())"
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    if done.returncode not in (0, 4):
        raise SystemExit(f"workbench {' '.join(arguments)} ended with {done.returncode}: {done.stderr}")
    return time.perf_counter() - began


def measure(folder: Path, frames: int) -> None:
    """Make the run if it is not there, time every command, print times and bars."""
    recording, results = folder / "long", folder / "results"
    if not (results / "best.rrd").is_file():
        scale = make_recording(recording, frames)
        took = workbench("replay", str(recording), "--set", f"metres_per_px={scale!r}", "-o", str(results))
        print(f"replay of {frames} frames: {took:.1f} s")
    run, middle, report = str(results / "best.rrd"), frames // 2 + 30, results / "report.html"
    changed = ["whatif", run, "--from", str(middle), "--to", str(middle + 100), "--set", "max_peak_ratio=0.6"]
    commands = (
        Timed("explain", ["explain", run, "--frame", str(middle)], 1.5),
        Timed("explain --worst", ["explain", run, "--worst", "3"], 1.5),
        Timed("what-if, 100 frames", changed, 3.0),
        Timed("report", ["report", run, "-o", str(report)], 30.0),
    )
    print(f"{'command':<22}{'s':>7}{'bar':>7}")
    for command in commands:
        took = min(workbench(*command.arguments) for _ in range(PASSES))
        print(f"{command.name:<22}{took:>7.2f}{command.bar_s:>7g}")
    print(f"report: {report.stat().st_size / 1e6:.2f} MB; bar {BAR_REPORT_BYTES / 1e6:g} MB")


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20_000, help="length of the run")
    parser.add_argument("--keep", type=Path, help="folder in which the run stays, for the next time")
    arguments = parser.parse_args()
    if arguments.keep is not None:
        measure(arguments.keep, arguments.frames)
        return
    with tempfile.TemporaryDirectory() as name:
        measure(Path(name), arguments.frames)


if __name__ == "__main__":
    main()
