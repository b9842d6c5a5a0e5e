"""The semi-direct odometry beside the PTAM-style baseline and OpenCV's KLT with homographies: CPU time and error.

    python benchmarks/semidirect.py [--flight gravel] [--frames 600] [--passes 3]
    python benchmarks/semidirect.py --quick

One process, one core, OpenCV with one thread. The flight is rendered before the clock starts; then the methods fly it
in turns, all of it each time, so that a disturbance does not fall on all passes of one of them. Of each frame the least
CPU time of the passes counts; the tables show the median frame. *Tracking* is the step of the tracking thread: pyramid,
alignment, features and pose of a decoded image; *mapping* is what the second thread does when it runs beside. Errors
are those after one Sim(3) alignment over the poses that a method stands by.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.semidirect.baseline_step import STAGES as BASELINE_STAGES
from pipelines.semidirect.scoring import Accuracy, scored, tracking_ms
from pipelines.simulation.mission import SimulatedMission
from pipelines.spatial import SpatialPath
from readers.streams import Sample
from workbench import scenarios
from workbench.reproduce.flights.flying import Pilot, frames_of, ground_of, settings_for, truth_of
from workbench.reproduce.flights.methods import ACCURATE, BASELINE, FAST, KLT, METHODS, built, chosen

Floats = NDArray[np.float64]

SEMIDIRECT_STAGES = ("pyramid", "alignment", "features and pose", "start, relocalisation", "mapping")
STAGES = {FAST: SEMIDIRECT_STAGES, ACCURATE: SEMIDIRECT_STAGES, BASELINE: BASELINE_STAGES, KLT: ()}
WARM_UP = 90
QUICK = {"frames": 150, "passes": 1}


def fly(mission: SimulatedMission, truth: SpatialPath, frames: Sequence[Sample], method: str) -> Pilot:
    """One pass of a method over the frames."""
    pilot = Pilot(built(method, **settings_for(mission, truth)), mission.camera, ground_of(mission))
    for k, frame in enumerate(frames):
        pilot.take(frame, truth.rotation[k].as_matrix(), truth.position_m[k])
    return pilot


class Row:
    """What a method's passes come to."""

    def __init__(self, method: str, passes: Sequence[Pilot], truth: SpatialPath) -> None:
        self.method = method
        whole = np.min([pilot.cpu_ms for pilot in passes], axis=0)
        self.tracking_ms: Floats = np.min([tracking_ms(p.cpu_ms, p.stage_ms) for p in passes], axis=0)
        self.mapping_mean_ms = max(float(np.mean(whole - self.tracking_ms)), 0.0)
        stages = np.min([pilot.stage_ms for pilot in passes], axis=0)
        self.stages = np.array([np.median(ms[np.isfinite(ms)]) if np.isfinite(ms).any() else np.nan for ms in stages.T])
        self.accuracy: Accuracy = scored(passes[0].track, truth)[0]

    @property
    def median_ms(self) -> float:
        """Of the tracking."""
        return float(np.median(self.tracking_ms))


def print_rows(rows: Sequence[Row]) -> None:
    """The table, the stages, and the ratios."""
    print(
        f"{'':10}{'tracking ms':>12}{'95 %':>8}{'frames/s':>10}{'mapping ms':>12}{'ATE %':>9}{'scale %':>9}{'lost':>6}"
    )
    for row in rows:
        a = row.accuracy
        times = f"{row.median_ms:12.2f}{np.percentile(row.tracking_ms, 95):8.2f}{1e3 / row.median_ms:10.0f}"
        errors = f"{100 * a.ate_share:9.4f}{100 * a.scale_drift:+9.2f}{a.lost_frames:6d}"
        print(f"{row.method:10}{times}{row.mapping_mean_ms:12.2f}{errors}")
    print("\nstages, CPU ms of the median frame that has them:")
    for row in rows:
        named = zip(STAGES[row.method], row.stages.tolist(), strict=True)
        print(f"{row.method:10}" + (", ".join(f"{name} {ms:.2f}" for name, ms in named if ms > 0) or "all in one"))
    print("\nframe rate of the tracking, times the peer's:")
    peers = [row for row in rows if row.method in (BASELINE, KLT)]
    for row in rows:
        ratios = [f"{peer.median_ms / row.median_ms:.2f} x {peer.method}" for peer in peers if peer is not row]
        print(f"{row.method:10}" + ", ".join(ratios))


def main() -> None:
    """Render, fly, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flight", default="gravel", help="which of the scenarios flight-…")
    parser.add_argument("--frames", type=int, default=600, help="frames of it")
    parser.add_argument("--passes", type=int, default=3, help="how often each method flies")
    parser.add_argument("--method", action="append", choices=METHODS, help="one of the methods; repeatable [all]")
    parser.add_argument("--quick", action="store_true", help="few frames, one pass")
    options = parser.parse_args()
    if options.quick:
        options.frames, options.passes = QUICK["frames"], QUICK["passes"]
    if options.frames < WARM_UP or options.passes < 1:
        parser.error(f"--frames {options.frames} --passes {options.passes}: at least {WARM_UP} and 1 are needed")
    cv2.setNumThreads(1)

    mission = scenarios.mission(scenarios.load(f"flight-{options.flight}", overrides=[f"frames={options.frames}"]))
    truth, frames, methods = truth_of(mission), list(frames_of(mission)), chosen(options.method or ())
    for method in methods:  # compiled code is loaded before the clock starts
        fly(mission, truth, frames[:WARM_UP], method)
    turns = [{method: fly(mission, truth, frames, method) for method in methods} for _ in range(options.passes)]
    rows = [Row(method, [turn[method] for turn in turns], truth) for method in methods]
    size = f"{mission.camera.width_px} x {mission.camera.height_px}"
    print(f"flight-{options.flight}, {len(frames)} frames of {size} px, passes: {options.passes}\n")
    print_rows(rows)


if __name__ == "__main__":
    main()
