"""The paper's robot (section 4, Table 3, Figs 10-12) on a simulated replica of its run, the scenario `paper-b`.

The filter is fed as the paper's is: IMU and odometer turned into camera axes, the chessboard's upper-left corner as
the only landmark, all sorted by time. It starts half of the range too far, the largest error of a start that the
paper allows. The reference is the truth; the paper's own, perspective-n-point from the board, stands beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import montecarlo as mc
from pipelines.ranging.equations import range_interval
from pipelines.ranging.filter import Inputs, Landmarks, standstill, step
from pipelines.ranging.inputs import Synchronisation, intervals
from pipelines.ranging.settings import FilterSettings
from pipelines.ranging.start import from_range
from pipelines.simulation.motion import FORWARD
from pipelines.simulation.scenario import FRONT_TRACKS, Scenario, landmarks_of
from pipelines.simulation.scene import chessboard_corners
from pipelines.simulation.sensors import IMU, ODOMETRY, Imu, Odometer, Tracks
from readers.streams import Camera, ImuSample, OdometrySample, TrackSample
from workbench import scenarios
from workbench.reproduce.ranging.parts import Curve, Part
from workbench.reproduce.ranging.simulation import curve
from workbench.reproduce.tasks import Tick

Floats = NDArray[np.float64]

SCENARIO = "paper-b"
TABLE_3: dict[float, float] = {0.042: 9.05, 0.085: 2.14, 0.127: 0.92, 0.174: 0.26, 0.23: 0.17}
"""Paper B, Table 3: L = V T / D₀ → relative error (%)."""
START_FACTOR, START_SIGMA = 1.5, 0.5
"""The start's range over the true one; its σ over itself."""
START_PIXEL_VARIANCE = 10.0
BAND = (5.0, 95.0)
"""Percentiles between which nine runs of ten lie."""
CONVERGED = mc.CONVERGED
SPEED_SIGMAS = (0.001, 0.002, 0.005, 0.01)
"""σ_V for which Table 3 is simulated; the last is that of Table 1."""
WAYS_RUNS = 5
"""Whole runs by which the ways to feed the filter are compared."""
NO_GROUND_SEEN = ("ground.size_px=256",)
"""Of runs whose images are not rendered: the least ground."""


# ---------------------------------------------------------------------------- what is measured


@dataclass(frozen=True)
class Drive:
    """What the sensors of one run measured, in camera axes, and what was true.

    Attributes:
        scenario: what was simulated.
        camera: its intrinsics.
        omega_s: times of ω̃ [i], s.
        omega: [i], rad/s.
        speed_s: times of Ṽ [j], s.
        speed: [j], m/s.
        frame_s: times of the frames [k], s.
        corners: the board's inner corners, the upper left one first [k, c, 2], NaN where not seen, px.
        point_m: true place of the upper-left corner in camera axes [k, 3].
        way_m: driven so far [k].
    """

    scenario: Scenario
    camera: Camera
    omega_s: Floats
    omega: Floats
    speed_s: Floats
    speed: Floats
    frame_s: Floats
    corners: Floats
    point_m: Floats
    way_m: Floats

    @property
    def distance_m(self) -> float:
        """D₀."""
        return float(np.linalg.norm(self.point_m[0]))

    @property
    def scale(self) -> Floats:
        """L at the frames [k]."""
        return self.way_m / self.distance_m

    def at(self, scale: float) -> int:
        """The frame of that L on the first way forth."""
        return int(np.argmin(np.abs(self.scale - scale)))


def drive(seed: int, stop_s: float | None = None) -> Drive:
    """One run of the scenario up to `stop_s`; None for all of it."""
    loaded = scenarios.load(SCENARIO, seed=seed, overrides=NO_GROUND_SEEN)
    mission, around = scenarios.mission(loaded), loaded.scenario.surroundings
    others, points = len(around.landmarks_m), landmarks_of(around)
    gyro: list[tuple[float, float]] = []
    wheels: list[tuple[float, float]] = []
    frame_s: list[float] = []
    corners: list[Floats] = []
    stop_ns = None if stop_s is None else mission.start_ns + round(stop_s * 1e9)
    for sample in mission.read([IMU, ODOMETRY, FRONT_TRACKS], None, stop_ns):
        t_s = (sample.t_ns - mission.start_ns) / 1e9
        if isinstance(sample, ImuSample):
            gyro.append((t_s, in_camera(sample.angular_velocity_radps)[1]))
        elif isinstance(sample, OdometrySample):
            wheels.append((t_s, in_camera(sample.linear_velocity_mps)[2]))
        elif isinstance(sample, TrackSample):
            seen = np.full((len(points), 2), np.nan)
            seen[sample.ids] = sample.points_px
            frame_s.append(t_s)
            corners.append(seen[others:])
    state = mission.motion.at(np.array(frame_s))
    turn, place = mission.on_board[0].mount.world_t_camera(state)
    steps = np.linalg.norm(np.diff(state.position_m, axis=0), axis=1)
    (omega_s, omega), (speed_s, speed) = np.array(gyro).T, np.array(wheels).T
    return Drive(
        scenario=loaded.scenario,
        camera=mission.camera,
        omega_s=omega_s,
        omega=omega,
        speed_s=speed_s,
        speed=speed,
        frame_s=np.array(frame_s),
        corners=np.array(corners),
        point_m=np.einsum("kij,ki->kj", turn, points[others] - place),
        way_m=np.concatenate([[0.0], np.cumsum(steps)]),
    )


def in_camera(vector: Floats) -> Floats:
    """A vector of the robot (x forward, z up) in camera axes (z ahead, y down): R_r^c."""
    return np.asarray(FORWARD.T @ vector)


def board_depths(found: Drive) -> Floats:
    """Depth of the upper-left corner by perspective-n-point from all corners of the board [k], m.

    This is the paper's reference. NaN where not all corners are seen.
    """
    board = found.scenario.surroundings.chessboard
    if board is None:
        raise ValueError(f"scenario {found.scenario.name}: without a chessboard there is no reference range")
    points = chessboard_corners(board.columns, board.rows, board.square_m, np.eye(4))
    depths = np.full(len(found.frame_s), np.nan)
    for k, seen in enumerate(found.corners):
        if np.isfinite(seen).all():
            solved, turn, shift = cv2.solvePnP(points, seen, found.camera.matrix, found.camera.distortion)
            if solved:
                depths[k] = (cv2.Rodrigues(turn)[0] @ points[0] + shift[:, 0])[2]
    return depths


# ------------------------------------------------------------------------------ what is estimated


class Ranged(NamedTuple):
    """What the filter says at the frames: X [k, 3], P [k, 3, 3], NIS [k], NaN at the first."""

    mean: Floats
    covariance: Floats
    nis: Floats

    @property
    def depth_m(self) -> Floats:
        """Ẑ [k]."""
        return np.asarray(1.0 / self.mean[:, 2])

    @property
    def sigma_xi(self) -> Floats:
        """σ_ξ [k]."""
        return np.asarray(np.sqrt(self.covariance[:, 2, 2]))


def settings_of(scenario: Scenario) -> FilterSettings:
    """The filter told the noise that the scenario's sensors have."""
    imu, odometer, tracks = _sensors(scenario)
    return FilterSettings(sigma_omega=imu.gyro_density, sigma_speed=odometer.speed_density, pixel_sigma=tracks.noise_px)


def _sensors(scenario: Scenario) -> tuple[Imu, Odometer, Tracks]:
    if scenario.imu is None or scenario.odometer is None or scenario.tracks is None:
        raise ValueError(f"scenario {scenario.name}: it needs the sections imu, odometer and tracks")
    return scenario.imu, scenario.odometer, scenario.tracks


def ranged(found: Drive, how: Synchronisation = Synchronisation.MIDPOINT, *, stops: bool = True) -> Ranged:
    """The range filter on one drive, from its first frame.

    Args:
        found: the drive.
        how: what the speeds are between two messages.
        stops: whether a standstill is found in the odometer and V is 0 then.
    """
    settings = settings_of(found.scenario)
    matrix, pixel = found.camera.matrix, found.corners[:, 0]
    model = settings.model(matrix[0, 0], (matrix[0, 2], matrix[1, 2]))
    path = intervals(found.omega_s, found.omega, found.speed_s, found.speed, found.frame_s, how)
    still = standstill(path.speed, path.dt, settings.sigma_speed) if stops else np.zeros(len(path.dt), np.bool_)
    start_m = START_FACTOR * found.point_m[0, 2]
    start = from_range(pixel[0], START_PIXEL_VARIANCE, start_m, START_SIGMA * start_m)
    landmarks = Landmarks.of([start])
    mean, covariance, nis = [start.state], [start.covariance], [math.nan]
    none, variance = np.full((1, 2), np.nan), settings.pixel_sigma**2
    for dt, omega, speed, frame, stands in zip(path.dt, path.omega, path.speed, path.frame, still, strict=True):
        seen = pixel[frame][None] if frame >= 0 else none
        landmarks, update = step(model, landmarks, Inputs(omega, speed, dt, bool(stands)), seen, variance)
        if frame >= 0:
            mean.append(update.mean[0])
            covariance.append(update.covariance[0])
            nis.append(float(update.nis[0]))
    return Ranged(np.array(mean), np.array(covariance), np.array(nis))


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
        """The first run over time."""

        omega_s: Curve
        omega: Curve
        speed_s: Curve
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


def robot(seeds: int, runs: int, tick: Tick) -> Robot:
    """The replica: `seeds` first ways forth, one whole run; `runs` of each Monte Carlo."""
    whole = drive(0)
    estimate = ranged(whole)
    tick()
    forth_s = whole.frame_s[whole.at(max(TABLE_3)) + 1]
    drives = []
    for seed in range(seeds):
        found = drive(seed, forth_s)
        drives.append((found, ranged(found), board_depths(found)))
        tick()
    facts = _facts(whole)
    error = np.array([est.depth_m / found.point_m[:, 2] - 1 for found, est, _ in drives])
    after = whole.frame_s > facts.start_s
    off = np.array([(1 / found.point_m[:, 2] - est.mean[:, 2]) / est.sigma_xi for found, est, _ in drives])
    moving = after[: off.shape[1]]
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
        run=_run(whole, estimate),
    )


def _facts(found: Drive) -> Robot.Facts:
    imu, odometer, tracks = _sensors(found.scenario)
    settings = settings_of(found.scenario)
    moving = np.flatnonzero(np.diff(found.way_m) > 0)
    places = found.camera.matrix[0, 0] * found.point_m[:, :2] / found.point_m[:, 2:]
    return Robot.Facts(
        distance_m=found.distance_m,
        focal_px=float(found.camera.matrix[0, 0]),
        speed_mps=float(np.max(np.diff(found.way_m) / np.diff(found.frame_s))),
        start_s=float(found.scenario.trajectory.profile_parameters["stop_s"]),
        gyro_hz=imu.timing.rate_hz,
        odometer_hz=odometer.timing.rate_hz,
        camera_hz=tracks.timing.rate_hz,
        sigma_omega=settings.sigma_omega,
        sigma_speed=settings.sigma_speed,
        pixel_sigma=settings.pixel_sigma,
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
    facts, start_m = _facts(found), START_FACTOR * float(found.point_m[0, 2])
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
        start_sigma_xi=START_SIGMA / start_m,
        start_pixel_variance=START_PIXEL_VARIANCE,
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


HERE, NO_STOPS, HELD, PRINTED = (
    "as here: both speeds interpolated, V = 0 at a stop",
    "V as measured at a stop",
    "both speeds held",
    "synchronisation as printed",
)
_WAYS: dict[str, tuple[Synchronisation, bool]] = {
    HERE: (Synchronisation.MIDPOINT, True),
    NO_STOPS: (Synchronisation.MIDPOINT, False),
    HELD: (Synchronisation.HOLD_BOTH, True),
    PRINTED: (Synchronisation.AS_PRINTED, False),
}


def _ways(seeds: int, tick: Tick) -> tuple[Robot.Way, ...]:
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in _WAYS}
    for seed in range(seeds):
        run = drive(seed)
        last = run.at(max(TABLE_3))
        truth = 1 / run.point_m[-1, 2]
        for name, (how, stops) in _WAYS.items():
            estimate = ranged(run, how, stops=stops)
            size = np.abs(estimate.depth_m / run.point_m[:, 2] - 1)
            sigmas = abs(estimate.mean[-1, 2] - truth) / estimate.sigma_xi[-1]
            found[name].append((float(size[last]), float(size[-1]), float(sigmas)))
        tick()
    return tuple(
        Robot.Way(name=name, **dict(zip(("last", "end", "sigmas"), np.median(rows, axis=0).tolist(), strict=True)))
        for name, rows in found.items()
    )


def _run(found: Drive, estimate: Ranged) -> Robot.Run:
    near, far = range_interval(estimate.mean[:, 2], estimate.sigma_xi)
    sigma = np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2))
    return Robot.Run(
        omega_s=curve(found.omega_s),
        omega=curve(found.omega),
        speed_s=curve(found.speed_s),
        speed=curve(found.speed),
        frame_s=curve(found.frame_s),
        scale=curve(found.scale),
        depth_m=curve(found.point_m[:, 2]),
        reference_m=curve(board_depths(found)),
        estimate_m=curve(estimate.depth_m),
        near_m=curve(near),
        far_m=curve(far),
        xi_error=curve(1 / found.point_m[:, 2] - estimate.mean[:, 2]),
        sigma_x=curve(sigma[:, 0]),
        sigma_y=curve(sigma[:, 1]),
        sigma_xi=curve(sigma[:, 2]),
        nis=curve(estimate.nis),
    )
