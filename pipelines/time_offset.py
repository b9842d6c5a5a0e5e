"""The offset between two clocks, from the speeds of two trajectories or the rates of two signals.

Speeds do not depend on the frame in which a path is given, nor on where it starts, so that they can be compared before
any alignment. Both are taken over the same stretch of time, T = 2 `half_window_s`: s(t) = |p(t + T/2) -
p(t - T/2)|/T. The lag with the highest normalised correlation is found over a raster, and refined by Gauss-Newton
on Σ (s_ref(t + τ) - k s_est(t) - b)² in the lag τ, the scale k and the offset b of the speeds. Its standard deviation
is that of the sum Σ slope · residual, the correlation of its terms over time included (a sandwich estimate).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pipelines.evaluation import Floats, Trajectory

SECOND_NS = 1_000_000_000
LEAST_CORRELATION = 0.5
"""Below this the speeds are not those of one motion."""
HALF_WINDOW_S = 0.5
"""Half the time over which speeds are taken: longer than the noise of positions, shorter than changes of speed."""
LEAST_WINDOWS = 20
"""Signals of fewer windows go together by chance."""
RIVAL_MARGIN = 0.02
"""A peak of the correlation within this of the best one is as good."""
LEAST_HALF_WINDOW_S = 0.1
"""The same of signals."""
COARSE = 4
"""Lags that are looked at per half window, before the best one is refined."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeOffset:
    """The offset that is to be added to the estimate's times, and what is known of it.

    `offset_ns` goes where `evaluate` takes its own of that name; `sigma_s` is its standard deviation, `correlation`
    that of the speeds at that offset, `scale` the reference's speed over the estimate's. `determined` is False,
    with a `reason`, where the speeds do not tell the offset.
    """

    offset_ns: int
    sigma_s: float
    correlation: float
    scale: float
    determined: bool
    reason: str = ""


def time_offset(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    max_offset_s: float = 10.0,
    around_s: float = 0.0,
    half_window_s: float | None = None,
) -> TimeOffset:
    """Estimate the offset between the clocks of two trajectories of one motion.

    Args:
        estimate: the path whose times are to be moved; its scale may be unknown.
        reference: the path whose times stay.
        max_offset_s: how far from `around_s` the offset is looked for.
        around_s: offset that is expected.
        half_window_s: half the time over which speeds are taken; None for half a second, and at least two median steps
            of the slower path.

    Raises:
        ValueError: `max_offset_s` or `half_window_s` is not positive.
    """
    if not max_offset_s > 0 or (half_window_s is not None and not half_window_s > 0):
        raise ValueError("max_offset_s and half_window_s must be positive")
    if min(len(estimate), len(reference)) < 3:
        return _unknown("one of the paths has fewer than 3 poses")
    steps = [float(np.median(np.diff(path.t_ns))) / SECOND_NS for path in (estimate, reference)]
    half = max(HALF_WINDOW_S, 2 * max(steps)) if half_window_s is None else half_window_s
    origin = int(estimate.t_ns[0])
    moved, truth = _Speed(estimate, origin, half), _Speed(reference, origin, half)
    raster = half / COARSE
    t = np.arange(moved.first, moved.last, raster)
    reach = math.ceil(max_offset_s / raster)
    lags = around_s + np.arange(-reach, reach + 1) * raster
    found = _correlations(moved.at(t), truth, t, lags, raster)
    if not np.isfinite(found).any():
        return _unknown("the two paths have too little time in common within the offsets that are looked at")
    best = int(np.nanargmax(found))
    if found[best] < LEAST_CORRELATION:
        return _unknown(f"the speeds do not go together: their correlation is {found[best]:.2f} at best")
    if best in (0, len(lags) - 1):
        return _unknown("the best offset lies at the border of those that are looked at")
    return _refined(moved, truth, np.arange(moved.first, moved.last, min(steps)), float(lags[best]))


def signal_offset(
    first_ns: NDArray[np.int64],
    first: Floats,
    second_ns: NDArray[np.int64],
    second: Floats,
    *,
    max_offset_s: float = 1.0,
    half_window_s: float | None = None,
) -> TimeOffset:
    """Estimate the offset between the clocks of two signals of one motion, such as an image's turn and a gyro's.

    Args:
        first_ns: times of the signal whose clock is to be moved [n], rising.
        first: it, summed up since its beginning [n]: an angle, a way. Its sign and scale may be unknown.
        second_ns: times of the signal whose clock stays [m], rising.
        second: it, summed up [m].
        max_offset_s: how far from zero the offset is looked for.
        half_window_s: half the time over which rates are taken; None for two median steps of the slower signal, and at
            least 0.1 s.

    Returns:
        The offset to add to the first signal's times; its `scale` is the second's rate over the first's.

    Raises:
        ValueError: `max_offset_s` or `half_window_s` is not positive.
    """
    if not max_offset_s > 0 or (half_window_s is not None and not half_window_s > 0):
        raise ValueError("max_offset_s and half_window_s must be positive")
    if min(len(first_ns), len(second_ns)) < 3:
        return _unknown("one of the signals has fewer than 3 values")
    found = correlations(first_ns, first, second_ns, second, max_offset_s=max_offset_s, half_window_s=half_window_s)
    least_s = LEAST_WINDOWS * 2 * found.moved.half
    if min(part.last - part.first for part in (found.moved, found.truth)) < least_s:
        return _unknown(f"there is too little of them: {least_s:.3g} s or more are needed")
    if not np.isfinite(found.correlation).any():
        return _unknown("the two signals have too little time in common, or one of them does not vary")
    best = int(np.nanargmax(np.abs(found.correlation)))
    if abs(found.correlation[best]) < LEAST_CORRELATION:
        return _unknown(f"the signals do not go together: their correlation is {found.correlation[best]:.2f} at best")
    if best in (0, len(found.lag_s) - 1):
        return _unknown("the best offset lies at the border of those that are looked at")
    if (rival := _rival(np.abs(found.correlation), best)) is not None:
        return _unknown(
            f"the motion repeats itself: {found.lag_s[best]:.3f} s and {found.lag_s[rival]:.3f} s fit alike"
        )
    t = np.arange(found.moved.first, found.moved.last, found.step_s)
    return _refined(found.moved, found.truth, t, float(found.lag_s[best]))


def _rival(strength: Floats, best: int) -> int | None:
    """The place of another peak of the correlation [k] that is as good as the best one, None if there is none."""
    inner = strength[1:-1]
    peaks = 1 + np.flatnonzero((inner > strength[:-2]) & (inner >= strength[2:]))
    rivals = [int(k) for k in peaks if abs(k - best) > COARSE and strength[k] > strength[best] - RIVAL_MARGIN]
    return max(rivals, key=lambda k: strength[k]) if rivals else None


class Correlations(NamedTuple):
    """Correlation of two signals' rates at lags [k], s, with what it was made of."""

    lag_s: Floats
    correlation: Floats
    moved: _Rates
    truth: _Rates
    step_s: float


def correlations(
    first_ns: NDArray[np.int64],
    first: Floats,
    second_ns: NDArray[np.int64],
    second: Floats,
    *,
    max_offset_s: float = 1.0,
    half_window_s: float | None = None,
) -> Correlations:
    """The correlation over the lag that `signal_offset` looks at; arguments as there."""
    steps = [float(np.median(np.diff(times))) / SECOND_NS for times in (first_ns, second_ns)]
    half = max(LEAST_HALF_WINDOW_S, 2 * max(steps)) if half_window_s is None else half_window_s
    origin = int(first_ns[0])
    moved, truth = _Summed(first_ns, first, origin, half), _Summed(second_ns, second, origin, half)
    raster = half / COARSE
    t = np.arange(moved.first, moved.last, raster)
    reach = math.ceil(max_offset_s / raster)
    lags = np.asarray(np.arange(-reach, reach + 1) * raster, np.float64)
    return Correlations(lags, _correlations(moved.at(t), truth, t, lags, raster), moved, truth, min(steps))


class _Rates(Protocol):
    """Rates over a window of time; times in seconds from an origin."""

    half: float
    first: float
    last: float

    def at(self, t: Floats) -> Floats:
        """Rates at times [n], NaN where the window leaves what is known."""
        ...


class _Summed:
    """Rates of a signal that is given summed up."""

    def __init__(self, t_ns: NDArray[np.int64], summed: Floats, origin_ns: int, half_s: float) -> None:
        self._t, self._summed, self.half = (t_ns - origin_ns) / SECOND_NS, summed, half_s
        self.first, self.last = float(self._t[0]) + half_s, float(self._t[-1]) - half_s

    def at(self, t: Floats) -> Floats:
        early, late = (np.interp(t + side, self._t, self._summed) for side in (-self.half, self.half))
        rate = (late - early) / (2 * self.half)
        rate[(t < self.first) | (t > self.last)] = np.nan
        return np.asarray(rate)


class _Speed:
    """Speeds of a path over a window of time; times in seconds from an origin."""

    def __init__(self, path: Trajectory, origin_ns: int, half_s: float) -> None:
        self._t = (path.t_ns - origin_ns) / SECOND_NS
        self._place, self.half = path.pose[:, :2], half_s
        self.first, self.last = self._t[0] + half_s, self._t[-1] - half_s

    def at(self, t: Floats) -> Floats:
        """Speeds at times [n], NaN where the window leaves the path."""
        ends = [
            np.column_stack([np.interp(t + side, self._t, axis) for axis in self._place.T])
            for side in (-self.half, self.half)
        ]
        speed = np.hypot(*(ends[1] - ends[0]).T) / (2 * self.half)
        speed[(t < self.first) | (t > self.last)] = np.nan
        return np.asarray(speed)


def _correlations(
    moved: Floats, truth: _Rates, t: NDArray[np.floating], lags: NDArray[np.floating], raster: float
) -> Floats:
    """Normalised correlation at each lag [m], NaN where less than half of the shorter path takes part."""
    long = truth.at(np.arange(len(t) + len(lags) - 1) * raster + t[0] + lags[0])
    known = np.isfinite(long)
    least = min(len(t), int(known.sum())) / 2
    result = np.full(len(lags), np.nan)
    for k in range(len(lags)):
        part = known[k : k + len(t)]
        if part.sum() < max(least, 10):
            continue
        a, b = moved[part], long[k : k + len(t)][part]
        a, b = a - a.mean(), b - b.mean()
        strength = math.sqrt(float(a @ a) * float(b @ b))
        if strength > 0:
            result[k] = float(a @ b) / strength
    return result


def _refined(moved: _Rates, truth: _Rates, t: Floats, coarse: float) -> TimeOffset:
    """Gauss-Newton on the lag; scale and offset of the speeds are fitted anew for every lag."""
    lag = coarse
    for _ in range(30):
        fit = _fit(moved, truth, t, lag)
        size = float(fit.slope @ fit.slope)
        change = float(fit.slope @ fit.residual) / size if size > 0 else math.inf
        lag += max(-truth.half / COARSE, min(change, truth.half / COARSE))
        if abs(change) < 1e-9:
            break
        if abs(lag - coarse) > truth.half:
            return _unknown("the speeds change too little to tell the offset")
    # what speeds over a window have in common makes neighbours count as one
    pull = fit.slope * fit.residual
    variance = float(pull @ pull) * max(_correlated(pull), 1.0) / size**2
    return TimeOffset(
        offset_ns=round(lag * SECOND_NS),
        sigma_s=math.sqrt(variance),
        correlation=fit.correlation,
        scale=fit.scale,
        determined=True,
    )


class _Fit(NamedTuple):
    """The fit s_ref(t + τ) = k s_est(t) + b at one lag τ: slope [n] of s_ref less what k and b explain of it."""

    slope: Floats
    residual: Floats
    scale: float
    correlation: float


def _fit(moved: _Rates, truth: _Rates, t: Floats, lag: float) -> _Fit:
    # over the window of the speeds itself: over less, the slope would be that of the noise
    early, late = (truth.at(t + lag + side * truth.half) for side in (-1, 1))
    a, b, slope = moved.at(t), truth.at(t + lag), (late - early) / (2 * truth.half)
    use = np.isfinite(a) & np.isfinite(b) & np.isfinite(slope)
    linear = np.column_stack([a[use], np.ones(int(use.sum()))])
    (scale, offset), along = (np.linalg.lstsq(linear, y[use], rcond=None)[0] for y in (b, slope))
    return _Fit(
        slope=slope[use] - linear @ along,
        residual=linear @ np.array([scale, offset]) - b[use],
        scale=float(scale),
        correlation=float(np.corrcoef(a[use], b[use])[0, 1]),
    )


def _correlated(values: Floats) -> float:
    """How many neighbouring values count as one: 1 + 2 Σ ρ, up to the first autocorrelation below zero."""
    n = len(values)
    spectrum = np.fft.rfft(values - values.mean(), 2 * n)
    auto = np.fft.irfft(np.abs(spectrum) ** 2)[: n // 2]
    if not auto[0] > 0:
        return 1.0
    rho = auto / auto[0]
    negative = np.flatnonzero(rho < 0)
    stop = int(negative[0]) if len(negative) else len(rho)
    return float(1 + 2 * rho[1:stop].sum())


def _unknown(reason: str) -> TimeOffset:
    return TimeOffset(
        offset_ns=0, sigma_s=math.nan, correlation=math.nan, scale=math.nan, determined=False, reason=reason
    )
