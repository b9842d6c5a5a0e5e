"""What full logging of the range filter costs beside the time that it logs.

    python benchmarks/range_log.py [--landmarks 20] [--minutes 10] [--rate 30]

A camera drives along a circle among landmarks that are always in view; the steps are those of the filter's own
equations, prepared before the clock starts. The bar: 10 minutes of 20 landmarks at 30 Hz, every field, overlay, plot
and table of them, in 30 s, 20 times as fast as real time. Told are wall-clock time, the time of all threads, bytes a
step, and peak memory.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipelines.ranging.filter import Inputs, Landmarks, Update, statuses, step
from pipelines.ranging.settings import FilterSettings
from pipelines.ranging.start import from_range
from pipelines.ranging.step import RangeStep
from pipelines.verdict import Verdict
from workbench.range_traces import Beside, RangeScene

FOCAL, CENTRE, SIZE = 500.0, (319.5, 239.5), (640.0, 480.0)
BAR = 20.0
PREPARED = 600
"""Steps that are computed; they are logged over and over, with other times."""


def computed(landmarks: int, dt_s: float) -> list[tuple[Update, np.ndarray]]:
    """Updates of landmarks before a camera that swings from side to side as it goes, and the image points."""
    rng = np.random.default_rng(1)
    settings = FilterSettings()
    model = settings.model(FOCAL, CENTRE)
    places = np.column_stack(
        [rng.uniform(-2, 2, landmarks), rng.uniform(-1, 1, landmarks), rng.uniform(20, 30, landmarks)]
    )
    pixels = np.array(CENTRE) + FOCAL * places[:, :2] / places[:, 2:]
    carried = Landmarks.of([from_range(one, 0.25, 25.0, 5.0) for one in pixels])
    found = []
    for frame in range(PREPARED):
        forward = 0.5 if (frame // 100) % 2 == 0 else -0.5
        places[:, 2] -= forward * dt_s
        pixels = np.array(CENTRE) + FOCAL * places[:, :2] / places[:, 2:] + rng.normal(0, 0.5, (landmarks, 2))
        carried, update = step(model, carried, Inputs(0.0, forward, dt_s), pixels, 0.25)
        found.append((update, pixels))
    return found


def steps(updates: list[tuple[Update, np.ndarray]], count: int, dt_s: float) -> Iterator[RangeStep]:
    """So many steps of them."""
    for frame in range(count):
        update, pixels = updates[frame % len(updates)]
        n = len(pixels)
        alarms = Verdict.FIRST_FRAME if frame == 0 else Verdict.OK
        yield RangeStep(
            frame=frame,
            t_ns=round(frame * dt_s * 1e9),
            received_ns=round(frame * dt_s * 1e9),
            verdict=alarms,
            alarms=alarms,
            omega_radps=float(update.inputs[0]),
            speed_mps=float(update.inputs[1]),
            dt_s=dt_s,
            intervals=3,
            still=0,
            gyro_age_s=0.004,
            odometer_age_s=0.02,
            gyro_bias_radps=0.0,
            focus_px=np.array(CENTRE),
            landmarks=n,
            measured=n,
            converged=n,
            landmark_id=np.arange(n, dtype=float),
            outcome=update.outcome.astype(float),
            status=statuses(update).astype(float),
            age_frames=np.full(n, float(frame)),
            prior=update.prior,
            prior_covariance=update.prior_covariance,
            transition=update.transition,
            noise_gain=update.noise_gain,
            measured_px=pixels,
            innovation_px=update.innovation,
            innovation_covariance=update.innovation_covariance,
            gain=update.gain,
            nis=update.nis,
            log_likelihood=update.log_likelihood,
            rejections=update.rejections.astype(float),
            mean=update.mean,
            covariance=update.covariance,
            range_m=update.range_m,
            range_interval_m=update.range_interval_m,
            relative_sigma=update.relative_sigma,
            parallax_px=update.parallax_px,
            derotated_parallax_px=update.derotated_parallax_px,
            focus_distance_px=update.focus_distance_px,
        )


def log(file: Path, updates: list[tuple[Update, np.ndarray]], count: int, dt_s: float) -> None:
    """Log so many steps with a reference beside them, and close the file."""
    from workbench.rrd import RunWriter

    with RunWriter(
        file,
        recording_id="benchmark",
        run="best",
        estimator="range",
        step_type=RangeStep,
        settings_text="",
        scene=RangeScene(FOCAL, CENTRE, SIZE, referenced=True),
    ) as run:
        for one in steps(updates, count, dt_s):
            run.step(one, Beside(np.eye(4), one.range_m))
        run.finish({}, None)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=30.0, help="frames per second")
    given = parser.parse_args()
    dt_s, count = 1 / given.rate, round(60 * given.minutes * given.rate)
    updates = computed(given.landmarks, dt_s)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "best.rrd"
        log(file, updates, 10, dt_s)  # loads and warms up
        wall_s, process_s = time.perf_counter(), time.process_time()
        log(file, updates, count, dt_s)
        wall_s, process_s = time.perf_counter() - wall_s, time.process_time() - process_s
        size = file.stat().st_size
    unit = 1 if sys.platform == "darwin" else 1024
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / (1 << 20)
    print(f"{count} steps of {given.landmarks} landmarks: {wall_s:.1f} s, all threads {process_s:.1f} s")
    print(f"{60 * given.minutes / wall_s:.1f} x real time; bar {BAR:g}")
    print(f"{wall_s / count * 1e6:.0f} µs and {size / count / 1e3:.1f} kB a step; peak memory {peak_mib:.0f} MiB")


if __name__ == "__main__":
    main()
