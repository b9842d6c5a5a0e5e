"""Where paper A's correction (18)-(21) helps and where it harms: a table without images (study 3.1).

A perfect front end with white noise goes round the figure eight; only the truth about speed, scale and height
changes from row to row, only the reading of the correction from column to column.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pipelines.correlation.settings import CorrelationSettings
from pipelines.geometry import Floats
from pipelines.simulation import trajectories as way
from pipelines.simulation.channels import rng_of
from workbench.reproduce.conditions import FRAMES, METRES_PER_PX, RATE_HZ, SPEED_MPS, START_RAD, fluctuation
from workbench.reproduce.estimates import dead_reckoned, settings_of, variants
from workbench.reproduce.measures import rms

SHIFT_NOISE_PX, TURN_NOISE_RAD = 0.03, 1e-5
SEEDS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """One row: whether the speed is constant, and how far scale and height are from what the odometer takes."""

    name: str
    jitter: bool = False
    ramp_frames: int = 0
    scale_error: float = 0.0
    height_share: float = 0.0


TRUTHS = (
    Truth(name="constant speed, W exact"),
    Truth(name="constant speed, W +5 %", scale_error=0.05),
    Truth(name="constant speed, height 3 %", height_share=0.03),
    Truth(name="speed jitter 10 %, W exact", jitter=True),
    Truth(name="speed jitter 10 %, W +5 %", jitter=True, scale_error=0.05),
    Truth(name="jitter 10 % and a start within 40 frames", jitter=True, ramp_frames=40),
)

_Change = Callable[[Mapping[str, CorrelationSettings]], CorrelationSettings]
READINGS: Mapping[str, _Change] = {
    "none": lambda v: v["none"],
    "toward nominal": lambda v: v["speed prior"],
    "toward nominal, no thresholds": lambda v: v["speed prior"].model_copy(
        update={"correction_max_relative": float("inf"), "correction_min_m": 0.0}
    ),
    "as printed, par +25 cm": lambda v: v["as printed"].model_copy(update={"correction_par_m": 0.25}),
    "as printed, par -20 cm": lambda v: v["as printed"].model_copy(update={"correction_par_m": -0.20}),
}
"""The readings of (18)-(21) by name, each made of `variants`."""


@dataclass(frozen=True, slots=True)
class Effect:
    """What one reading does to one truth: rms and end-point error in metres, medians over the seeds."""

    truth: str
    reading: str
    rms_m: float
    end_m: float


def effects(seeds: int = SEEDS, frames: int = FRAMES) -> list[Effect]:
    """The whole table, row by row."""
    found = []
    for truth in TRUTHS:
        errors = np.array([_errors(truth, seed, frames) for seed in range(seeds)])
        for reading, (rms_m, end_m) in zip(READINGS, np.median(errors, axis=0), strict=True):
            found.append(Effect(truth.name, reading, float(rms_m), float(end_m)))
    return found


def _errors(truth: Truth, seed: int, frames: int) -> list[tuple[float, float]]:
    """RMS and end-point error of every reading."""
    poses, shift, turn = _measured(truth, seed, frames)
    scale = f"metres_per_px={METRES_PER_PX * (1 + truth.scale_error)!r}"
    known = variants(settings_of("paper-a", poses[0], (scale,)))
    found = []
    for change in READINGS.values():
        path = dead_reckoned(change(known), shift, turn, np.full(len(turn), 1 / RATE_HZ))
        distance = np.hypot(*(path - poses)[:, :2].T)
        found.append((rms(distance), float(distance[-1])))
    return found


def _measured(truth: Truth, seed: int, frames: int) -> tuple[Floats, Floats, Floats]:
    """True poses [n, 3], and the shifts [n - 1, 2] and turns [n - 1] that a good front end measures."""
    rng = rng_of(seed, "correction", truth.name)
    speeds = way.jittery_speed(frames, SPEED_MPS, rng) if truth.jitter else np.full(frames, SPEED_MPS)
    lengths = (speeds * way.ramp(frames, truth.ramp_frames))[:-1] / RATE_HZ
    poses = way.follow(way.figure_eight(start_rad=START_RAD), lengths)
    shift, turn = way.image_motion(poses, METRES_PER_PX)
    shift = shift / (1 + fluctuation(frames - 1, truth.height_share, rng))[:, None]
    noisy_shift = shift + rng.normal(0, SHIFT_NOISE_PX, shift.shape)
    return poses, noisy_shift, turn + rng.normal(0, TURN_NOISE_RAD, turn.shape)
