"""Speed profiles: how fast a curve is driven, as exact functions of time, and frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.simulation.channels import rng_of
from pipelines.simulation.curves import made
from pipelines.simulation.noise import correlated
from pipelines.simulation.signals import rising_knots

Floats = NDArray[np.float64]

RATE_HZ = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Speed:
    """A speed that is linear in time between knots; its integral, the arc length, is exact.

    Within a piece v = v_k + a (t - t_k) and s = s_k + v_k (t - t_k) + a (t - t_k)²/2. A negative speed
    drives backwards. At a knot the acceleration is that of the piece that begins there.

    Args:
        t_s: times of the knots [n], n ≥ 2, the first 0, rising.
        speed_mps: speeds at the knots [n].

    Attributes:
        arc_m: arc length driven at the knots [n].

    Raises:
        ValueError: fewer than two knots, times that do not rise from 0, or numbers that are not finite.
    """

    t_s: Floats
    speed_mps: Floats
    arc_m: Floats = field(init=False)

    def __post_init__(self) -> None:
        t_s, speed = rising_knots(self.t_s, self.speed_mps)
        if len(t_s) < 2 or t_s[0] != 0:
            raise ValueError("a speed profile needs at least two knots, the first at 0 s")
        lengths = np.diff(t_s) * (speed[:-1] + speed[1:]) / 2
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "speed_mps", speed)
        object.__setattr__(self, "arc_m", np.concatenate([[0.0], np.cumsum(lengths)]))

    @property
    def duration_s(self) -> float:
        """Time of the last knot."""
        return float(self.t_s[-1])

    def at(self, t_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Arc length (m), speed (m/s) and acceleration (m/s²) at times [n] from 0 to the duration."""
        k = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        since = t_s - self.t_s[k]
        slope = (self.speed_mps[k + 1] - self.speed_mps[k]) / (self.t_s[k + 1] - self.t_s[k])
        return (
            self.arc_m[k] + since * (self.speed_mps[k] + slope * since / 2),
            self.speed_mps[k] + slope * since,
            slope,
        )

    def extent(self) -> tuple[float, float]:
        """Least and greatest arc length on the way; they are at knots or where the speed changes its sign."""
        v, w = self.speed_mps[:-1], self.speed_mps[1:]
        turning = np.flatnonzero(v * w < 0)
        turn_s = self.t_s[turning] + np.diff(self.t_s)[turning] * v[turning] / (v[turning] - w[turning])
        arcs = np.concatenate([self.arc_m, self.at(turn_s)[0]])
        return float(arcs.min()), float(arcs.max())

    def backwards(self) -> Speed:
        """The same speeds in reverse gear."""
        return Speed(self.t_s, -self.speed_mps)

    def then(self, other: Speed) -> Speed:
        """This profile and another after it.

        Raises:
            ValueError: the other begins at another speed than this one ends with.
        """
        if self.speed_mps[-1] != other.speed_mps[0]:
            raise ValueError(
                f"a profile that ends with {self.speed_mps[-1]:.6g} m/s cannot go on with "
                f"{other.speed_mps[0]:.6g} m/s: put a ramp between them"
            )
        t_s = np.concatenate([self.t_s, self.duration_s + other.t_s[1:]])
        return Speed(t_s, np.concatenate([self.speed_mps, other.speed_mps[1:]]))

    def with_stops(self, stops: Sequence[tuple[float, float]], *, ramp_s: float = 0.5) -> Speed:
        """The same profile with stops in it: it is slowed down before and speeds up after each.

        Args:
            stops: (time, length) in seconds; from time to time + length the vehicle stands.
            ramp_s: time of slowing down before, and of speeding up after a stop.

        Raises:
            ValueError: the stops are not in order, overlap with their ramps, or begin before 0.
        """
        if not stops:
            return self
        begins, lengths = np.array(stops, dtype=np.float64).T
        gate_s = np.stack([begins - ramp_s, begins, begins + lengths, begins + lengths + ramp_s], axis=1).ravel()
        if ramp_s <= 0 or gate_s[0] < 0 or np.any(np.diff(gate_s) < 0) or np.any(lengths <= 0):
            raise ValueError(f"stops {list(stops)} with ramps of {ramp_s} s: in order, apart, the first ramp after 0 s")
        gate = np.tile([1.0, 0.0, 0.0, 1.0], len(stops))
        t_s = np.union1d(self.t_s, gate_s[gate_s < self.duration_s])
        return Speed(t_s, np.interp(t_s, self.t_s, self.speed_mps) * np.interp(t_s, gate_s, gate))

    def until(self, length_m: float) -> Speed:
        """The same profile up to the moment when it has first driven `length_m` (> 0) forwards.

        Raises:
            ValueError: it never drives so far.
        """
        far = np.flatnonzero(self.arc_m >= length_m)
        if length_m <= 0 or not len(far):
            raise ValueError(f"the profile leads from 0 to {self.extent()[1]:.6g} m, not to {length_m:.6g} m")
        k = int(far[0]) - 1
        missing, v = length_m - self.arc_m[k], self.speed_mps[k]
        slope = (self.speed_mps[k + 1] - v) / (self.t_s[k + 1] - self.t_s[k])
        end_speed = math.sqrt(v * v + 2 * slope * missing)
        end_s = self.t_s[k] + 2 * missing / (v + end_speed)
        return Speed(np.append(self.t_s[: k + 1], end_s), np.append(self.speed_mps[: k + 1], end_speed))


# ------------------------------------------------------------------------------- by name


def constant(speed_mps: float, duration_s: float, ramp_s: float = 0.0) -> Speed:
    """One speed; with `ramp_s` above 0 it is reached from a standstill in that time."""
    _demand(duration_s > ramp_s >= 0, f"{duration_s} s with a ramp of {ramp_s} s")
    if ramp_s == 0:
        return Speed(np.array([0.0, duration_s]), np.array([speed_mps, speed_mps]))
    return Speed(np.array([0.0, ramp_s, duration_s]), np.array([0.0, speed_mps, speed_mps]))


def jitter(
    speed_mps: float,
    duration_s: float,
    seed: int = 0,
    share: float = 0.10,
    tau_s: float = 14 / RATE_HZ,
    ramp_s: float = 40 / RATE_HZ,
    rate_hz: float = RATE_HZ,
) -> Speed:
    """Slow driving (the paper's 2 km/h): AR(1) jitter with knots at `rate_hz`, after a smooth rise from 0.

    Args:
        speed_mps: mean speed.
        duration_s: length of the profile, rounded up to whole knots.
        seed: seed of the jitter.
        share: standard deviation against the mean, at the knots.
        tau_s: time after which its correlation has fallen to 1/e.
        ramp_s: time of the rise.
        rate_hz: knots per second.
    """
    n = _knots(duration_s, rate_hz)
    speeds = jittery_speed(n, speed_mps, rng_of(seed, "speed"), share=share, tau_frames=tau_s * rate_hz)
    return Speed(np.arange(n) / rate_hz, speeds * ramp(n, round(ramp_s * rate_hz)))


def waves(
    speed_mps: float,
    duration_s: float,
    seed: int = 0,
    share: float = 0.035,
    period_s: float = 240 / RATE_HZ,
    ramp_s: float = 40 / RATE_HZ,
    rate_hz: float = RATE_HZ,
) -> Speed:
    """Fast driving (8 and 15 km/h): a slow wave of random phase, after a smooth rise from 0.

    Args:
        speed_mps: mean speed.
        duration_s: length of the profile, rounded up to whole knots.
        seed: seed of the phase.
        share: amplitude against the mean.
        period_s: period of the wave.
        ramp_s: time of the rise.
        rate_hz: knots per second.
    """
    n = _knots(duration_s, rate_hz)
    speeds = wavy_speed(n, speed_mps, rng_of(seed, "speed"), share=share, period_frames=period_s * rate_hz)
    return Speed(np.arange(n) / rate_hz, speeds * ramp(n, round(ramp_s * rate_hz)))


def trapezoid(distance_m: float, speed_mps: float, acceleration_mps2: float = 0.5) -> Speed:
    """From standstill to standstill over a distance (backwards if negative); a triangle if it is too short."""
    _demand(distance_m != 0 and speed_mps > 0 and acceleration_mps2 > 0, f"{distance_m} m at {speed_mps} m/s")
    way = abs(distance_m)
    top = min(speed_mps, math.sqrt(way * acceleration_mps2))
    rise_s = top / acceleration_mps2
    cruise_s = way / top - rise_s
    t_s, speeds = [0.0, rise_s, rise_s + cruise_s, 2 * rise_s + cruise_s], [0.0, top, top, 0.0]
    if cruise_s <= 1e-9:
        t_s, speeds = [0.0, rise_s, 2 * rise_s], [0.0, top, 0.0]
    return Speed(np.array(t_s), math.copysign(1, distance_m) * np.array(speeds))


def forth_and_back(
    distance_m: float,
    speed_mps: float,
    acceleration_mps2: float = 0.5,
    stop_s: float = 1.5,
    runs: int = 1,
) -> Speed:
    """Stand, drive a distance, stand, drive back in reverse, and again for each of `runs`; stand at the end."""
    _demand(stop_s > 0 and runs > 0, f"{runs} runs with stops of {stop_s} s")
    stand = constant(0.0, stop_s)
    forth = trapezoid(distance_m, speed_mps, acceleration_mps2)
    profile = stand
    for _ in range(runs):
        profile = profile.then(forth).then(stand).then(forth.backwards()).then(stand)
    return profile


def knots(t_s: ArrayLike, speed_mps: ArrayLike) -> Speed:
    """Any profile: speeds at given times, linear in between."""
    return Speed(np.asarray(t_s, dtype=np.float64), np.asarray(speed_mps, dtype=np.float64))


SPEEDS: Mapping[str, Callable[..., Speed]] = {
    "constant": constant,
    "jitter": jitter,
    "waves": waves,
    "trapezoid": trapezoid,
    "forth-and-back": forth_and_back,
    "knots": knots,
}


def speed(name: str, **parameters: Any) -> Speed:
    """The profile of that name in `SPEEDS`, such as ``speed("constant", speed_mps=0.5, duration_s=10)``.

    Raises:
        ValueError: there is no such profile, it has no such parameter, or a value makes no profile.
    """
    return made("speed profile", SPEEDS, name, parameters)


def _demand(holds: bool, what: str) -> None:
    if not holds:
        raise ValueError(f"{what}: there is no such speed profile, change its parameters")


def _knots(duration_s: float, rate_hz: float) -> int:
    _demand(duration_s > 0 and rate_hz > 0, f"{duration_s} s with {rate_hz} knots a second")
    return 1 + math.ceil(duration_s * rate_hz - 1e-9)


# -------------------------------------------------------------------------- frame by frame


def jittery_speed(
    n_frames: int, speed_mps: float, rng: np.random.Generator, *, share: float = 0.10, tau_frames: float = 14.0
) -> Floats:
    """Speed [n_frames] with AR(1) jitter of standard deviation `share`: slow driving (2 km/h)."""
    return np.asarray(speed_mps * (1 + share * correlated(n_frames, tau_frames, rng)))


def wavy_speed(
    n_frames: int, speed_mps: float, rng: np.random.Generator, *, share: float = 0.035, period_frames: float = 240.0
) -> Floats:
    """Speed [n_frames] with slow waves of amplitude `share`: fast driving (8 and 15 km/h)."""
    phase = rng.uniform(0, 2 * math.pi)
    return np.asarray(speed_mps * (1 + share * np.sin(2 * math.pi * np.arange(n_frames) / period_frames + phase)))


def ramp(n_frames: int, ramp_frames: int = 40) -> Floats:
    """Smooth rise [n_frames] from 0 to 1 over `ramp_frames` frames: 3x² - 2x³."""
    x = np.clip(np.arange(n_frames) / max(ramp_frames, 1), 0, 1) if ramp_frames else np.ones(n_frames)
    return np.asarray(x * x * (3 - 2 * x))
