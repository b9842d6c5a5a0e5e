"""Monte Carlo of the range filter: the paper's simulation (section 4), its tables and figures, bounds and consistency.

`Scenario()` is the standard case S0. Truth moves without noise by the exact arc; the measured speeds and image
points are noisy. `truth="as-printed"` is (30) to the letter: the truth itself moves by the noisy speeds of an
independent noise, in Euler steps. Only that reproduces the paper's Table 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.consistency import nees_of
from pipelines.ranging import equations as eq
from pipelines.ranging import joint, kernels, smoother
from pipelines.ranging.filter import UPPER, Inputs, full_covariance
from pipelines.ranging.inputs import Synchronisation, intervals
from pipelines.ranging.settings import FilterSettings
from pipelines.ranging.start import Start
from pipelines.simulation.channels import rng_of

Floats = NDArray[np.float64]

TABLE_2: Mapping[float, float] = {1.0: 3.2, 2.0: 2.1, 3.0: 1.7, 4.0: 1.5, 5.0: 1.35}
"""Paper B, Table 2: time (s) → relative error (%); the paper's L = V T / D₀ for the same columns is 0.05 … 0.31."""
TABLE_2_PIXEL_SIGMA = 0.02
"""Noise of the image points (px at f = 800) that the paper does not state and that Table 2 asks for."""
CONVERGED = 0.1
"""A mean error below this share of the range counts as converged."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One landmark, one motion, many runs; the defaults are the standard case S0.

    Attributes:
        focal_px: focal length.
        centre_px: true principal point.
        landmark_m: landmark in camera axes at the start [3].
        speed: V of each interval, m/s; one number for all.
        omega: ω of each interval, rad/s; one number for all.
        dt: length of an interval, s.
        steps: number of intervals m.
        sigma_omega: spectral density of the gyro's noise, rad/s/√Hz.
        sigma_speed: spectral density of the odometer's noise, m/s/√Hz.
        pixel_sigma: noise of an image point per axis, px.
        start_range_m: Ẑ₀; S0 starts 3 m too far.
        start_sigma_xi: σ_ξ of P₀, 1/m; the paper's (3 m)⁻² read as 3 m at Z = 8 m.
        start_pixel_variance: of P₀, px².
        truth: how the truth moves.
        runs: number of runs n.
        seed: of all noise.
        speed_scale: odometer's scale, 1 where it is right.
        gyro_bias: of ω̃, rad/s.
        centre_error_px: what the filter takes for the principal point minus the true one.
        blunder_share: share of image points that are off by up to ± blunder_px in both axes, uniformly.
        blunder_px: largest blunder.
        slip_s: time at which the track slips to another point, s; inf for never.
        slip_px: how far that point lies from the first one in the image, along x.
        slip_range_m: its depth.
    """

    focal_px: float = 800.0
    centre_px: tuple[float, float] = (0.0, 0.0)
    landmark_m: tuple[float, float, float] = (0.4, 0.4, 8.0)
    speed: float | tuple[float, ...] = 0.5
    omega: float | tuple[float, ...] = 0.0
    dt: float = 0.1
    steps: int = 30
    sigma_omega: float = 1e-3
    sigma_speed: float = 1e-2
    pixel_sigma: float = 0.5
    start_range_m: float = 11.0
    start_sigma_xi: float = 3.0 / 64.0
    start_pixel_variance: float = 10.0
    truth: Literal["exact", "as-printed"] = "exact"
    runs: int = 1000
    seed: int = 0
    speed_scale: float = 1.0
    gyro_bias: float = 0.0
    centre_error_px: tuple[float, float] = (0.0, 0.0)
    blunder_share: float = 0.0
    blunder_px: float = 50.0
    slip_s: float = math.inf
    slip_px: float = 5.0
    slip_range_m: float = 12.0

    @property
    def time_s(self) -> Floats:
        """Times of the frames [m + 1]."""
        return np.asarray(self.dt * np.arange(self.steps + 1), dtype=np.float64)

    def inputs(self) -> tuple[Floats, Floats]:
        """True ω and V of each interval [m], [m].

        Raises:
            ValueError: a profile has not one value for each interval.
        """
        found = []
        for name, value in (("omega", self.omega), ("speed", self.speed)):
            profile = np.asarray(value, dtype=np.float64)
            if profile.ndim and profile.shape != (self.steps,):
                raise ValueError(f"{name} needs {self.steps} values, one for each interval, not {len(profile)}")
            found.append(np.broadcast_to(profile, (self.steps,)))
        return found[0], found[1]

    def settings(self, **changes: object) -> FilterSettings:
        """The plain filter (no gate, no reset) with this scenario's noise, and changes to it."""
        noise: dict[str, object] = {
            "sigma_omega": self.sigma_omega,
            "sigma_speed": self.sigma_speed,
            "pixel_sigma": self.pixel_sigma,
        }
        return FilterSettings.plain(**noise | changes)


@dataclass(frozen=True)
class Simulated:
    """Measurements of all runs, and the truth.

    Attributes:
        truth: (x, y, ξ) at each frame [n or 1, m + 1, 3], px.
        omega: ω̃ [n, m], rad/s.
        speed: Ṽ [n, m], m/s.
        pixel: image points [n, m + 1, 2], px.
    """

    truth: Floats
    omega: Floats
    speed: Floats
    pixel: Floats


@dataclass(frozen=True)
class Runs:
    """What the filter made of a scenario, frame by frame; frame 0 is the start.

    Attributes:
        scenario: what was simulated.
        settings: of the filter.
        truth: (x, y, ξ) [n or 1, m + 1, 3].
        mean: X̂ [n, m + 1, 3].
        covariance: P [n, m + 1, 3, 3].
        nis: [n, m + 1], NaN at frame 0.
        outcome: `filter.Outcome` [n, m + 1].
    """

    scenario: Scenario
    settings: FilterSettings
    truth: Floats = field(repr=False)
    mean: Floats = field(repr=False)
    covariance: Floats = field(repr=False)
    nis: Floats = field(repr=False)
    outcome: Floats = field(repr=False)

    @property
    def time_s(self) -> Floats:
        """Times of the frames [m + 1]."""
        return self.scenario.time_s

    def at(self, time_s: float) -> int:
        """Number of the frame at a time."""
        return round(time_s / self.scenario.dt)

    @property
    def error_m(self) -> Floats:
        """Ẑ - Z [n, m + 1]."""
        return 1.0 / self.mean[..., 2] - 1.0 / self.truth[..., 2]

    @property
    def relative_error(self) -> Floats:
        """(Ẑ - Z) / Z [n, m + 1]."""
        return self.truth[..., 2] / self.mean[..., 2] - 1.0

    @property
    def mean_abs_error_m(self) -> Floats:
        """Mean of |Ẑ - Z| over the runs [m + 1]: Figs 6, 7."""
        return np.asarray(np.abs(self.error_m).mean(axis=0))

    @property
    def rms_relative(self) -> Floats:
        """Root mean square of the relative error over the runs [m + 1]: Table 2, Fig. 8."""
        return np.asarray(np.sqrt((self.relative_error**2).mean(axis=0)))

    @property
    def nees(self) -> Floats:
        """eᵀ P⁻¹ e [n, m + 1]: χ² with 3 degrees of freedom where the filter is consistent."""
        return nees_of(self.mean - self.truth, self.covariance)

    @property
    def coverage(self) -> Floats:
        """Share of the runs with |ξ̂ - ξ| < 2 σ_ξ [m + 1]: 0.954 where the filter is consistent."""
        off = np.abs(self.mean[..., 2] - self.truth[..., 2])
        return np.asarray((off < 2.0 * np.sqrt(self.covariance[..., 2, 2])).mean(axis=0))

    @property
    def diverged(self) -> float:
        """Share of the runs whose last range is off by more than half, or that lost the landmark."""
        return float(np.mean(~(np.abs(self.relative_error[:, -1]) < 0.5)))

    @property
    def converged_s(self) -> float:
        """First time at which the mean error is below 10 % of the range, s; inf for never."""
        below = np.flatnonzero(self.mean_abs_error_m < CONVERGED / self.truth[..., 2].mean(axis=0))
        return float(self.time_s[below[0]]) if len(below) else math.inf


def true_states(scenario: Scenario) -> Floats:
    """(x, y, ξ) of the noise-free truth at each frame [m + 1, 3], px in the true principal point."""
    omega, speed = scenario.inputs()
    point, points = np.asarray(scenario.landmark_m, dtype=np.float64), []
    slip = scenario.slip_s / scenario.dt
    for k in range(scenario.steps + 1):
        if k and k - 1 < slip <= k:
            state = eq.project(point, scenario.focal_px, scenario.centre_px)
            other = np.array([state[0] + scenario.slip_px, state[1], 1.0 / scenario.slip_range_m])
            point = eq.unproject(other, scenario.focal_px, scenario.centre_px)
        points.append(point)
        if k < scenario.steps:
            point = eq.carried(point, eq.held(omega[k], speed[k], scenario.dt))
    return eq.project(np.array(points), scenario.focal_px, scenario.centre_px)


def simulate(scenario: Scenario, landmark: int = 0) -> Simulated:
    """The noisy measurements of all runs.

    Args:
        scenario: what is simulated.
        landmark: number of the landmark: another one has other image noise under the same noise of the speeds.
    """
    s, n, m = scenario, scenario.runs, scenario.steps
    white = rng_of(s.seed, "speeds").standard_normal((n, m, 2)) / math.sqrt(s.dt)
    rng = rng_of(s.seed, "image", str(landmark))
    image = rng.standard_normal((n, m + 1, 2)) * s.pixel_sigma
    omega, speed = s.inputs()
    if s.truth == "exact":
        truth = true_states(s)[None]
    else:
        own = rng_of(s.seed, "truth").standard_normal((n, m, 2)) / math.sqrt(s.dt)
        truth = _truth_as_printed(s, omega + s.sigma_omega * own[..., 0], speed + s.sigma_speed * own[..., 1])
    pixel = truth[..., :2] + image
    if s.blunder_share > 0.0:
        hit = rng.random((n, m + 1, 1)) < s.blunder_share
        hit[:, 0] = False
        pixel = pixel + hit * rng.uniform(-s.blunder_px, s.blunder_px, (n, m + 1, 2))
    return Simulated(
        truth,
        omega + s.gyro_bias + s.sigma_omega * white[..., 0],
        s.speed_scale * speed + s.sigma_speed * white[..., 1],
        pixel,
    )


def _truth_as_printed(s: Scenario, omega: Floats, speed: Floats) -> Floats:
    """States of truths that move by (30) with the speeds [n, m] of each run [n, m + 1, 3]."""
    point = np.tile(np.asarray(s.landmark_m, dtype=np.float64), (len(omega), 1))
    points = [point]
    for k in range(s.steps):
        point = eq.carried_as_printed(point, omega[:, k], speed[:, k], s.dt)
        points.append(point)
    return eq.project(np.stack(points, axis=1), s.focal_px, s.centre_px)


def starts(scenario: Scenario, pixel: Floats) -> Floats:
    """State of every run at frame 0 [n, 9]: x, y from the first image point, ξ₀ and P₀ from the scenario."""
    start = np.zeros((len(pixel), kernels.STATE))
    start[:, :2] = pixel[:, 0]
    start[:, 2] = 1.0 / scenario.start_range_m
    start[:, 3] = start[:, 6] = scenario.start_pixel_variance
    start[:, 8] = scenario.start_sigma_xi**2
    return start


def run(
    scenario: Scenario,
    settings: FilterSettings | None = None,
    still: NDArray[np.bool_] | None = None,
    landmark: int = 0,
) -> Runs:
    """Simulate a scenario and filter every run.

    Args:
        scenario: what is simulated.
        settings: of the filter; default: the plain filter with the scenario's noise.
        still: intervals in which the filter knows the camera to stand [m] or [n, m]; default: none.
        landmark: its number, see `simulate`.
    """
    settings = settings or scenario.settings()
    data = simulate(scenario, landmark)
    start = starts(scenario, data.pixel)
    n, m = data.omega.shape
    history = np.empty((n, m, kernels.HISTORY))
    cx, cy = scenario.centre_px
    ex, ey = scenario.centre_error_px
    stands = np.ascontiguousarray(np.broadcast_to(False if still is None else still, (n, m)))
    kernels.advance_runs(
        settings.model(scenario.focal_px, (cx + ex, cy + ey)),
        start,
        data.omega,
        data.speed,
        np.full(m, scenario.dt),
        stands,
        np.ascontiguousarray(data.pixel[:, 1:]),
        settings.pixel_sigma**2,
        history,
    )
    state = np.concatenate([start[:, None], history[..., : kernels.STATE]], axis=1)
    first = np.array([[np.nan, kernels.PREDICTED]])
    rest = np.concatenate([np.broadcast_to(first, (n, 1, 2)), history[..., kernels.STATE :]], axis=1)
    return Runs(
        scenario,
        settings,
        data.truth,
        state[..., :3],
        full_covariance(state[..., 3:]),
        rest[..., 0],
        rest[..., 1],
    )


def cramer_rao(scenario: Scenario) -> Floats:
    """Smallest possible RMS relative error at each frame [m + 1], from P₀ and all image points, the first one too.

    The recursion of the posterior information J on the noise-free truth (P. Tichavský et al., IEEE TSP 46(5),
    1998), here in the form J⁻¹ ← A J⁻¹ Aᵀ + G (Q_c / dt) Gᵀ, J ← J + Hᵀ R⁻¹ H, because G Q Gᵀ is singular.
    """
    s = scenario
    omega, speed = s.inputs()
    state = true_states(s)
    first = 1.0 / (1.0 / s.start_pixel_variance + s.pixel_sigma**-2)
    bound = np.diag([first, first, s.start_sigma_xi**2])
    sigma = [s.start_sigma_xi]
    for k in range(s.steps):
        p = eq.Point(state[k, 0] - s.centre_px[0], state[k, 1] - s.centre_px[1], state[k, 2])
        h = eq.held(omega[k], speed[k], s.dt)
        upper = eq.covariance_ahead(
            eq.Covariance(*bound[UPPER]),
            eq.exact_transition(p, h, s.focal_px),
            eq.exact_noise_gain(p, h, s.focal_px),
            s.sigma_omega**2 / s.dt,
            s.sigma_speed**2 / s.dt,
        )
        information = np.linalg.inv(full_covariance(np.array(upper)))
        information[[0, 1], [0, 1]] += s.pixel_sigma**-2
        bound = np.linalg.inv(information)
        sigma.append(math.sqrt(bound[2, 2]))
    return np.asarray(np.array(sigma) / state[:, 2])


# --------------------------------------------------------------------- the paper's simulations


def table_2(truth: Literal["exact", "as-printed"], *, runs: int = 1000, seed: int = 0) -> Runs:
    """Table 2 in one of its two readings: noise in the truth as (30) prints it, or in the measurements only."""
    return run(Scenario(pixel_sigma=TABLE_2_PIXEL_SIGMA, steps=50, truth=truth, runs=runs, seed=seed))


def figure_6(scenario: Scenario | None = None, offsets_m: Sequence[float] = (0.2, 0.4, 0.8, 1.6)) -> dict[float, Runs]:
    """Fig. 6: landmarks at X = Y = offset; the farther from the focus of expansion, the faster."""
    base = scenario or Scenario()
    return {x: run(replace(base, landmark_m=(x, x, base.landmark_m[2]))) for x in offsets_m}


def figure_7(scenario: Scenario | None = None, speeds: Sequence[float] = (0.1, 0.3, 0.5, 0.8)) -> dict[float, Runs]:
    """Fig. 7: the same landmark at several speeds."""
    base = scenario or Scenario()
    return {v: run(replace(base, speed=v)) for v in speeds}


def figure_8(scenario: Scenario | None = None) -> tuple[Floats, Runs]:
    """Fig. 8: error against L = V t / D₀, at each frame [m + 1]."""
    found = run(scenario or Scenario(pixel_sigma=TABLE_2_PIXEL_SIGMA, steps=50, truth="as-printed"))
    way = np.concatenate([[0.0], np.cumsum(np.abs(found.scenario.inputs()[1])) * found.scenario.dt])
    return way / float(np.linalg.norm(found.scenario.landmark_m)), found


def scaled_in_space(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with all lengths times a factor, the odometer's noise with them: the same relative errors."""
    x, y, z = scenario.landmark_m
    return replace(
        scenario,
        landmark_m=(factor * x, factor * y, factor * z),
        speed=tuple(factor * scenario.inputs()[1]),
        sigma_speed=factor * scenario.sigma_speed,
        start_range_m=factor * scenario.start_range_m,
        start_sigma_xi=scenario.start_sigma_xi / factor,
    )


def scaled_in_time(scenario: Scenario, factor: float) -> Scenario:
    """The scenario run `factor` times as fast with as many frames, noise σ √factor: the same relative errors."""
    omega, speed = scenario.inputs()
    return replace(
        scenario,
        omega=tuple(factor * omega),
        speed=tuple(factor * speed),
        dt=scenario.dt / factor,
        sigma_omega=math.sqrt(factor) * scenario.sigma_omega,
        sigma_speed=math.sqrt(factor) * scenario.sigma_speed,
    )


# ------------------------------------------------------------------- several landmarks, smoother


@dataclass(frozen=True)
class JointRuns:
    """What the joint filter made of N landmarks in n runs.

    Attributes:
        truth: [m + 1, N, 3].
        mean: [n, m + 1, N, 3].
        covariance: of each landmark by itself [n, m + 1, N, 3, 3].
        nees: of all landmarks together over its degrees of freedom 3N [n, m + 1].
    """

    truth: Floats = field(repr=False)
    mean: Floats = field(repr=False)
    covariance: Floats = field(repr=False)
    nees: Floats = field(repr=False)

    @property
    def rms_relative(self) -> Floats:
        """Root mean square of (Ẑ - Z) / Z over the runs [m + 1, N]."""
        return np.asarray(np.sqrt(((self.truth[..., 2] / self.mean[..., 2] - 1.0) ** 2).mean(axis=0)))


def joint_scenarios(scenario: Scenario, landmarks_m: Sequence[tuple[float, float, float]]) -> list[Scenario]:
    """The scenario for each of several landmarks; each starts 3 m too far with σ_ξ of 3 m, as S0 does."""
    return [
        replace(scenario, landmark_m=p, start_range_m=p[2] + 3.0, start_sigma_xi=3.0 / p[2] ** 2) for p in landmarks_m
    ]


def run_joint(
    scenario: Scenario,
    landmarks_m: Sequence[tuple[float, float, float]],
    settings: FilterSettings | None = None,
) -> JointRuns:
    """Simulate several landmarks under the same noise of the speeds, and filter them jointly."""
    settings = settings or scenario.settings()
    model = settings.model(scenario.focal_px, scenario.centre_px)
    each = joint_scenarios(scenario, landmarks_m)
    data = [simulate(s, i) for i, s in enumerate(each)]
    start = np.stack([starts(s, d.pixel) for s, d in zip(each, data, strict=True)], axis=1)
    pixel = np.stack([d.pixel for d in data], axis=2)
    truth = np.stack([d.truth[0] for d in data], axis=1)
    n, frames, count = len(pixel), scenario.steps + 1, len(each)
    variance = np.full(count, settings.pixel_sigma**2)
    mean, covariance = np.empty((n, frames, count, 3)), np.empty((n, frames, count, 3, 3))
    nees = np.empty((n, frames))
    for i in range(n):
        first = full_covariance(start[i, :, 3:])
        state = joint.Joint.of([Start(x, p) for x, p in zip(start[i, :, :3], first, strict=True)])
        for k in range(frames):
            if k:
                inputs = Inputs(data[0].omega[i, k - 1], data[0].speed[i, k - 1], scenario.dt)
                state, _ = joint.step(model, state, inputs, pixel[i, k], variance)
            mean[i, k], covariance[i, k] = state.mean, state.blocks
            nees[i, k] = nees_of((state.mean - truth[k]).ravel(), state.covariance) / (3 * count)
    return JointRuns(truth, mean, covariance, nees)


def run_smoother(scenario: Scenario, settings: FilterSettings | None = None) -> Runs:
    """Simulate one landmark and smooth every run over all its frames: the measure of accuracy."""
    settings = settings or scenario.settings()
    model = settings.model(scenario.focal_px, scenario.centre_px)
    data = simulate(scenario)
    start = starts(scenario, data.pixel)
    first = full_covariance(start[:, 3:])
    found = []
    for i in range(scenario.runs):
        prior = joint.Joint.of([Start(start[i, :3], first[i])])
        found.append(
            smoother.smooth(
                model,
                prior,
                data.omega[i],
                data.speed[i],
                np.full(scenario.steps, scenario.dt),
                data.pixel[i, 1:, None],
                np.array([settings.pixel_sigma**2]),
            )
        )
    mean = np.stack([f.mean[:, 0] for f in found])
    covariance = np.stack([f.covariance[:, 0] for f in found])
    none = np.full(mean.shape[:2], np.nan)
    return Runs(scenario, settings, data.truth, mean, covariance, none, none)


# -------------------------------------------------------------------------- asynchronous sensors


@dataclass(frozen=True, kw_only=True)
class Asynchronous:
    """A run with sensors of different rates: a ramp up to `speed`, then steady, weaving with ω = a sin(2π t / T).

    Attributes:
        base: landmark, start, noise, runs and seed; its dt, steps, speed and omega are not used.
        gyro_hz: rate of ω̃.
        odometer_hz: rate of Ṽ.
        camera_hz: rate of the images.
        duration_s: of the run.
        speed: V after the ramp, m/s.
        ramp_s: length of the ramp.
        weave: a, rad/s.
        weave_s: T.
    """

    base: Scenario = Scenario(pixel_sigma=0.1)
    gyro_hz: float = 50.0
    odometer_hz: float = 20.0
    camera_hz: float = 5.0
    duration_s: float = 12.0
    speed: float = 0.3
    ramp_s: float = 3.0
    weave: float = 0.1
    weave_s: float = 4.0

    def speed_at(self, time_s: Floats) -> Floats:
        """True V, m/s."""
        return np.asarray(self.speed * np.clip(time_s / self.ramp_s, 0.0, 1.0))

    def omega_at(self, time_s: Floats) -> Floats:
        """True ω, rad/s."""
        return np.asarray(self.weave * np.sin(2.0 * math.pi * time_s / self.weave_s))

    def frame_s(self) -> Floats:
        """Times of the images [k]."""
        return np.arange(round(self.duration_s * self.camera_hz) + 1) / self.camera_hz


FINE_S = 1e-3
"""Interval of the truth's integration; the speeds at its middle are held."""


def run_asynchronous(
    scenario: Asynchronous,
    how: Synchronisation = Synchronisation.HOLD_BOTH,
    settings: FilterSettings | None = None,
) -> Runs:
    """Simulate sensors of different rates and filter every run; the result has one column an image.

    Args:
        scenario: what is simulated.
        how: what the filter takes for the speeds between two messages.
        settings: of the filter; default: the plain filter with the scenario's noise.
    """
    s = scenario.base
    settings = settings or s.settings()
    frame_s = scenario.frame_s()
    count = round(scenario.duration_s / FINE_S)
    middle = np.asarray(FINE_S * (np.arange(count) + 0.5), dtype=np.float64)
    point = np.asarray(s.landmark_m, dtype=np.float64)
    path: list[Floats] = []
    for k, (omega, speed) in enumerate(zip(scenario.omega_at(middle), scenario.speed_at(middle), strict=True)):
        if len(path) < len(frame_s) and k >= round(frame_s[len(path)] / FINE_S):
            path.append(point)
        point = eq.carried(point, eq.held(omega, speed, FINE_S))
    path.append(point)
    truth = eq.project(np.array(path), s.focal_px, s.centre_px)
    rng = rng_of(s.seed, "asynchronous")

    def measured(hz: float, sigma: float, profile: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
        times = np.arange(round(scenario.duration_s * hz) + 1) / hz
        return times, profile(times) + sigma * math.sqrt(hz) * rng.standard_normal((s.runs, len(times)))

    gyro = measured(scenario.gyro_hz, s.sigma_omega, scenario.omega_at)
    odometer = measured(scenario.odometer_hz, s.sigma_speed, scenario.speed_at)
    pixel = truth[:, :2] + s.pixel_sigma * rng.standard_normal((s.runs, len(frame_s), 2))
    found = intervals(*gyro, *odometer, frame_s, how)
    points = np.where((found.frame >= 0)[:, None], pixel[:, found.frame], np.nan)
    start = starts(s, pixel)
    history = np.empty((s.runs, len(found.dt), kernels.HISTORY))
    kernels.advance_runs(
        settings.model(s.focal_px, s.centre_px),
        start,
        np.ascontiguousarray(np.broadcast_to(found.omega, history.shape[:2])),
        np.ascontiguousarray(np.broadcast_to(found.speed, history.shape[:2])),
        found.dt,
        np.zeros(history.shape[:2], np.bool_),
        np.ascontiguousarray(points),
        settings.pixel_sigma**2,
        history,
    )
    rows = history[:, found.frame >= 0]
    state = np.concatenate([start[:, None], rows[..., : kernels.STATE]], axis=1)
    nis, outcome = (
        np.concatenate([np.full((s.runs, 1), first), rows[..., kernels.STATE + i]], axis=1)
        for i, first in enumerate((np.nan, float(kernels.PREDICTED)))
    )
    base = replace(s, dt=1.0 / scenario.camera_hz, steps=len(frame_s) - 1)
    return Runs(base, settings, truth[None], state[..., :3], full_covariance(state[..., 3:]), nis, outcome)
