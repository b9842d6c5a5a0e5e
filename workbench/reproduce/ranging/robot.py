"""The paper's robot (section 4, Table 3, Figs 10-12): what the range filter says over runs of the replica."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import montecarlo as mc
from workbench.reproduce.ranging import replica
from workbench.reproduce.ranging.parts import Curve, Part
from workbench.reproduce.ranging.replica import Drive, Ranged, Way
from workbench.reproduce.ranging.simulation import curve
from workbench.reproduce.tasks import Tick

Floats = NDArray[np.float64]

TABLE_3: dict[float, float] = {0.042: 9.05, 0.085: 2.14, 0.127: 0.92, 0.174: 0.26, 0.23: 0.17}
"""Paper B, Table 3: L = V T / D₀ → relative error (%)."""
BAND = (5.0, 95.0)
"""Percentiles between which nine runs of ten lie."""
CONVERGED = mc.CONVERGED
SPEED_SIGMAS = (0.001, 0.002, 0.005, 0.01)
"""σ_V for which Table 3 is simulated; the last is that of Table 1."""
WAYS_RUNS = 5
"""Whole runs by which the ways to feed the filter are compared."""

MIDPOINT = "synchronisation=midpoint"
HERE, PAPER, PRINTED = (
    "as here: preset best, both speeds interpolated",
    "preset paper-b: both speeds held, V as measured at a stop",
    "preset paper-b, synchronisation as printed",
)
WAYS: dict[str, Way] = {
    HERE: Way("best", (MIDPOINT,)),
    "preset best: both speeds held": Way("best"),
    "preset best, both interpolated, V as measured at a stop": Way("best", (MIDPOINT, "zero_velocity_update=false")),
    PAPER: Way("paper-b"),
    PRINTED: Way("paper-b", ("synchronisation=as-printed",)),
}
LOGGED = (HERE, PAPER)
"""Ways of which the first run is logged."""


def log_folder(folder: Path) -> Path:
    """Where the log of the first run lies."""
    return folder / f"log-seed{replica.LOGGED_SEED}"


def log_files(folder: Path) -> tuple[Path, ...]:
    """What the log consists of."""
    return tuple(log_folder(folder) / f"{name}.rrd" for name in ("sensors", *(WAYS[way].preset for way in LOGGED)))


# ------------------------------------------------------------------------------------ the part


class Robot(Part):
    """Table 3 over many runs, one whole run over time, and what is compared with them.

    Errors are shares of the true depth.
    """

    class Facts(Part):
        """What the replica is."""

        distance_m: float
        focal_px: float
        speed_mps: float
        start_s: float
        gyro_hz: float
        odometer_hz: float
        camera_hz: float
        sigma_omega: float
        sigma_speed: float
        pixel_sigma: float
        parallax_px: Curve

    class Column(Part):
        """One L: |error| over the runs, the filter's σ, RMS of the reference, share as good as the paper."""

        scale: float
        paper: float
        median: float
        low: float
        high: float
        rms: float
        sigma: float
        reference: float
        as_good: float

    class Implied(Part):
        """Table 3 by Monte Carlo with an odometer of this noise; `as_good`: share of runs at the last two L."""

        sigma_speed: float
        median: Curve
        bound: Curve
        as_good: float

    class Way(Part):
        """One way to feed the filter: medians of |error| at the last L and at the end, there also in σ_ξ."""

        name: str
        last: float
        end: float
        sigmas: float

    class Run(Part):
        """The first run over time, from its steps."""

        omega: Curve
        speed: Curve
        frame_s: Curve
        scale: Curve
        depth_m: Curve
        reference_m: Curve
        estimate_m: Curve
        near_m: Curve
        far_m: Curve
        xi_error: Curve
        sigma_x: Curve
        sigma_y: Curve
        sigma_xi: Curve
        nis: Curve

    facts: Facts
    seeds: int
    table: tuple[Column, ...]
    converged_s: Curve
    within_one: float
    within_two: float
    implied: tuple[Implied, ...]
    ways: tuple[Way, ...]
    run: Run


def robot(seeds: int, runs: int, folder: Path, tick: Tick) -> Robot:
    """The replica: `seeds` first ways forth, whole runs of which one is logged; `runs` of each Monte Carlo."""
    whole = replica.drive(replica.LOGGED_SEED)
    estimates = {}
    for name in LOGGED:
        estimates[name] = replica.ranged_and_logged(whole, WAYS[name], log_folder(folder))
        tick()
    forth_s = whole.frame_s[whole.at(max(TABLE_3)) + 1]
    drives = []
    for seed in range(seeds):
        found = replica.drive(seed, forth_s)
        drives.append((found, replica.ranged(found, WAYS[HERE]), replica.board_depths(found)))
        tick()
    facts = _facts(whole)
    error = np.array([est.depth_m / found.point_m[:, 2] - 1 for found, est, _ in drives])
    off = np.array([(1 / found.point_m[:, 2] - est.mean[:, 2]) / est.sigma_xi for found, est, _ in drives])
    moving = drives[0][0].frame_s > facts.start_s
    implied = tuple(_implied(whole, sigma, runs) for sigma in SPEED_SIGMAS)
    tick()
    return Robot(
        facts=facts,
        seeds=seeds,
        table=tuple(_column(scale, drives, error) for scale in TABLE_3),
        converged_s=curve(
            _converged_s(found.frame_s - facts.start_s, e) for (found, _, _), e in zip(drives, error, strict=True)
        ),
        within_one=float(np.mean(np.abs(off[:, moving]) < 1)),
        within_two=float(np.mean(np.abs(off[:, moving]) < 2)),
        implied=implied,
        ways=_ways(min(seeds, WAYS_RUNS), tick),
        run=_run(whole, estimates[HERE]),
    )


def ticks(seeds: int) -> int:
    """How many steps of progress `robot` makes."""
    return len(LOGGED) + seeds + 1 + min(seeds, WAYS_RUNS)


def _facts(found: Drive) -> Robot.Facts:
    imu, odometer, tracks = replica.sensors(found.scenario)
    focal_px = float(found.mission.camera.matrix[0, 0])
    moving = np.flatnonzero(np.diff(found.way_m) > 0)
    places = focal_px * found.point_m[:, :2] / found.point_m[:, 2:]
    return Robot.Facts(
        distance_m=found.distance_m,
        focal_px=focal_px,
        speed_mps=float(np.max(np.diff(found.way_m) / np.diff(found.frame_s))),
        start_s=float(found.scenario.trajectory.profile_parameters["stop_s"]),
        gyro_hz=imu.timing.rate_hz,
        odometer_hz=odometer.timing.rate_hz,
        camera_hz=tracks.timing.rate_hz,
        sigma_omega=imu.gyro_density,
        sigma_speed=odometer.speed_density,
        pixel_sigma=tracks.noise_px,
        parallax_px=curve(np.hypot(*(places[found.at(scale)] - places[moving[0]])) for scale in TABLE_3),
    )


def _column(scale: float, drives: list[tuple[Drive, Ranged, Floats]], error: Floats) -> Robot.Column:
    k = drives[0][0].at(scale)
    size = np.abs(error[:, k])
    low, middle, high = np.percentile(size, [BAND[0], 50.0, BAND[1]])
    sigma = [est.sigma_xi[k] / est.mean[k, 2] for _, est, _ in drives]
    reference = [depths[k] / found.point_m[k, 2] - 1 for found, _, depths in drives]
    return Robot.Column(
        scale=scale,
        paper=TABLE_3[scale] / 100,
        median=float(middle),
        low=float(low),
        high=float(high),
        rms=float(np.sqrt(np.mean(size**2))),
        sigma=float(np.median(sigma)),
        reference=float(np.sqrt(np.mean(np.square(reference)))),
        as_good=float(np.mean(size <= TABLE_3[scale] / 100)),
    )


def _converged_s(time_s: Floats, error: Floats) -> float:
    """When the error falls below 10 % to stay there, from the start of the motion; inf for never."""
    off = np.flatnonzero(~(np.abs(error) < CONVERGED))
    if not len(off):
        return float(time_s[0])
    return float(time_s[off[-1] + 1]) if off[-1] + 1 < len(time_s) else math.inf


def _implied(found: Drive, sigma_speed: float, runs: int) -> Robot.Implied:
    """Table 3 by Monte Carlo: the replica's geometry, steady speed, inputs held from frame to frame."""
    facts, start_m = _facts(found), replica.START_FACTOR * float(found.point_m[0, 2])
    dt = 1.0 / facts.camera_hz
    x, y, z = (float(value) for value in found.point_m[0])
    scenario = mc.Scenario(
        focal_px=facts.focal_px,
        landmark_m=(x, y, z),
        speed=facts.speed_mps,
        dt=dt,
        steps=math.ceil(max(TABLE_3) * facts.distance_m / facts.speed_mps / dt),
        sigma_omega=facts.sigma_omega,
        sigma_speed=sigma_speed,
        pixel_sigma=facts.pixel_sigma,
        start_range_m=start_m,
        start_sigma_xi=replica.START_SIGMA / start_m,
        start_pixel_variance=replica.START_PIXEL_VARIANCE,
        runs=runs,
    )
    result, bound = mc.run(scenario), mc.cramer_rao(scenario)
    at = [round(scale * facts.distance_m / facts.speed_mps / dt) for scale in TABLE_3]
    size = np.abs(result.relative_error[:, at])
    paper = np.array(list(TABLE_3.values())) / 100
    return Robot.Implied(
        sigma_speed=sigma_speed,
        median=curve(np.median(size, axis=0)),
        bound=curve(bound[at]),
        as_good=float(np.mean(np.all(size[:, -2:] <= paper[-2:], axis=1))),
    )


def _ways(seeds: int, tick: Tick) -> tuple[Robot.Way, ...]:
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in WAYS}
    for seed in range(seeds):
        run = replica.drive(seed)
        last = run.at(max(TABLE_3))
        truth = 1 / run.point_m[-1, 2]
        for name, way in WAYS.items():
            estimate = replica.ranged(run, way)
            size = np.abs(estimate.depth_m / run.point_m[:, 2] - 1)
            sigmas = abs(estimate.mean[-1, 2] - truth) / estimate.sigma_xi[-1]
            found[name].append((float(size[last]), float(size[-1]), float(sigmas)))
        tick()
    return tuple(
        Robot.Way(name=name, **dict(zip(("last", "end", "sigmas"), np.median(rows, axis=0).tolist(), strict=True)))
        for name, rows in found.items()
    )


def _run(found: Drive, estimate: Ranged) -> Robot.Run:
    sigma = np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2))
    return Robot.Run(
        omega=curve(estimate.omega),
        speed=curve(estimate.speed),
        frame_s=curve(found.frame_s),
        scale=curve(found.scale),
        depth_m=curve(found.point_m[:, 2]),
        reference_m=curve(replica.board_depths(found)),
        estimate_m=curve(estimate.depth_m),
        near_m=curve(estimate.interval_m[:, 0]),
        far_m=curve(estimate.interval_m[:, 1]),
        xi_error=curve(1 / found.point_m[:, 2] - estimate.mean[:, 2]),
        sigma_x=curve(sigma[:, 0]),
        sigma_y=curve(sigma[:, 1]),
        sigma_xi=curve(sigma[:, 2]),
        nis=curve(estimate.nis),
    )
