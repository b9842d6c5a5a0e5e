"""The checks of the range filter: running statistics of the innovations, and the flags of the verdict.

Each column "visible in" of the failures that the filter can see has its flag here; a scale error of the odometer, or
a principal point or pitch that is off, leave no trace in the innovations.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from pipelines.ranging.filter import Outcome, Status, Update
from pipelines.ranging.range_settings import RangeSettings
from pipelines.verdict import Verdict

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

FORGET = 0.9
"""Share of a running mean of whitened innovations that is kept at each update."""
TREND_SIGMA = ((1.0 - FORGET) / (1.0 + FORGET)) ** 0.5
"""σ of such a mean of white innovations."""
TREND_UPDATES = 10
"""Updates that a trend takes."""
CAP = 13.8
"""A larger NIS counts as this in the running mean: single blunders are told by the gate."""
TURNING_RADPS = 0.02
"""Rms rate of turn below which innovations that follow it tell nothing."""
FOLLOWS = 0.8
"""Correlation of the innovations in x with the rate of turn and its change that is taken for a delay."""


@dataclass(frozen=True, slots=True)
class Trends:
    """Running means of each landmark's whitened innovations w, components x and y.

    Attributes:
        mean: of w [n, 2].
        product: of w times the w before [n, 2].
        last: w of the last update [n, 2].
        updates: how many [n].
    """

    mean: Floats
    product: Floats
    last: Floats
    updates: Longs

    @classmethod
    def fresh(cls, n: int) -> Trends:
        """Before any update."""
        return cls(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n, np.int64))

    def only(self, kept: Longs) -> Trends:
        """Those of some landmarks, by number."""
        return Trends(self.mean[kept], self.product[kept], self.last[kept], self.updates[kept])

    def and_fresh(self, n: int) -> Trends:
        """Followed by those of new landmarks."""
        new = Trends.fresh(n)
        return Trends(
            np.concatenate([self.mean, new.mean]),
            np.concatenate([self.product, new.product]),
            np.concatenate([self.last, new.last]),
            np.concatenate([self.updates, new.updates]),
        )

    def taking(self, update: Update) -> Trends:
        """With the innovations of a step; a reset begins again."""
        spread = np.sqrt(np.diagonal(update.innovation_covariance, axis1=1, axis2=2))
        white = np.clip(update.innovation / spread, -4.0, 4.0)
        seen = np.asarray(np.isfinite(white).all(axis=1))[:, None]
        white = np.where(seen, white, 0.0)
        again = np.asarray(update.outcome == Outcome.RESET)[:, None]
        return Trends(
            np.where(again, 0.0, np.where(seen, FORGET * self.mean + (1 - FORGET) * white, self.mean)),
            np.where(
                again, 0.0, np.where(seen, FORGET * self.product + (1 - FORGET) * white * self.last, self.product)
            ),
            np.where(again, 0.0, np.where(seen, white, self.last)),
            np.where(again[:, 0], 0, self.updates + seen[:, 0]),
        )


ROTATION_SHARE = 0.1
"""Derotated parallax over raw parallax below which the landmarks have moved by rotation alone."""


class Turning(NamedTuple):
    """Running second moments of (ν_x, ω, Δω), row by row, and the last ω.

    ν_x is the frame's median whitened innovation in x, Δω the change of the rate of turn since the frame before: a
    delay of the images shifts x by f ω delay, which the filter takes up in part from frame to frame.
    """

    moments: tuple[float, ...] = (0.0,) * 9
    omega: float = 0.0
    frames: int = 0

    def taking(self, innovation: float, omega: float, keep: float) -> Turning:
        """With one frame."""
        row = (innovation, omega, omega - self.omega)
        new = tuple(
            keep * old + (1.0 - keep) * x * y
            for old, (x, y) in zip(self.moments, itertools.product(row, row), strict=True)
        )
        return Turning(new, omega, self.frames + 1)

    @property
    def correlation(self) -> float:
        """Multiple correlation of ν_x with ω and Δω, 0…1; 0 where it does not turn or the innovations are small."""
        m = np.array(self.moments).reshape(3, 3)
        if m[1, 1] < TURNING_RADPS**2 or m[0, 0] < 1.0:
            return 0.0
        return float(np.sqrt(m[0, 1:] @ np.linalg.pinv(m[1:, 1:]) @ m[1:, 0] / m[0, 0]))


@dataclass(frozen=True, slots=True)
class History:
    """What is judged over several frames: NIS of each frame, intervals between frames (s), innovations in turns."""

    nis: tuple[float, ...] = ()
    dt_s: tuple[float, ...] = ()
    turning: Turning = Turning()

    def taking(self, s: RangeSettings, update: Update, omega: float, dt_s: float) -> History:
        """With one frame: its update, its mean rate of turn (rad/s), the time since the frame before."""
        nis = update.nis[np.isfinite(update.nis)]
        level = (float(np.minimum(nis, CAP).mean()),) if len(nis) else ()
        kept = s.statistics_frames
        spread = np.sqrt(update.innovation_covariance[:, 0, 0])
        white = update.innovation[:, 0] / spread
        white = white[np.isfinite(white)]
        turning = self.turning
        if len(white):
            turning = turning.taking(float(np.clip(np.median(white), -4.0, 4.0)), omega, 1.0 - 2.0 / kept)
        return replace(self, nis=(*self.nis, *level)[-kept:], dt_s=(*self.dt_s, dt_s)[-kept:], turning=turning)


def alarms_of_frame(
    s: RangeSettings,
    update: Update,
    status: Longs,
    measured: NDArray[np.bool_],
    age_frames: Longs,
    trends: Trends,
    history: History,
    degrees: int,
) -> Verdict:
    """The checks of one frame, as flags.

    Args:
        s: the settings.
        update: of all n landmarks, those that started in this frame among them; the derotated parallax is the
            largest so far.
        status: `Status` [n].
        measured: has an image point [n].
        age_frames: frames since the start [n].
        trends: with this frame.
        history: before this frame's interval, with its NIS.
        degrees: of freedom of an image point: 2, for a bearing 1.
    """
    alarms = Verdict.OK
    for outcome, flag in (
        (Outcome.REJECTED, Verdict.LANDMARK_REJECTED),
        (Outcome.RESET, Verdict.LANDMARK_REJECTED | Verdict.LANDMARK_RESET),
        (Outcome.LOST, Verdict.LANDMARK_LOST),
    ):
        if (update.outcome == outcome).any():
            alarms |= flag
    if not measured.any():
        alarms |= Verdict.NO_LANDMARKS
    if not (status == Status.CONVERGED).any():
        alarms |= Verdict.RANGE_UNKNOWN
    alarms |= _alarms_of_parallax(s, update, measured & (age_frames > 0))
    return alarms | _alarms_of_nis(s, history, degrees) | _alarms_of_trends(s, trends, history)


def _alarms_of_parallax(s: RangeSettings, update: Update, old: NDArray[np.bool_]) -> Verdict:
    """Whether the way tells ranges at all, of landmarks that are seen for the second time or more."""
    alarms = Verdict.OK
    if not old.any():
        return alarms
    derotated, raw = update.derotated_parallax_px[old], update.parallax_px[old]
    if (derotated < s.min_parallax_px).all():
        alarms |= Verdict.LOW_PARALLAX
        moved = float(np.median(raw))
        if moved > s.rotation_parallax_px and np.median(derotated) < ROTATION_SHARE * moved:
            alarms |= Verdict.PURE_ROTATION
    uncertain = ~(update.relative_sigma[old] < s.max_relative_sigma)
    if (uncertain & (update.focus_distance_px[old] < s.focus_limit_px)).any():
        alarms |= Verdict.NEAR_FOCUS
    return alarms


def nis_band(s: RangeSettings, frames: int, degrees: int) -> tuple[float, float]:
    """Between which the mean NIS of so many frames lies, each counted as one image point.

    Landmarks share the inputs' errors, so that more of them do not narrow it.
    """
    total = degrees * frames
    low, high = chdtri(total, 1.0 - s.band_probability), chdtri(total, s.band_probability)
    return float(low) / frames, float(high) / frames


def _alarms_of_nis(s: RangeSettings, history: History, degrees: int) -> Verdict:
    frames = len(history.nis)
    if frames < min(s.statistics_frames, 2 * TREND_UPDATES):
        return Verdict.OK
    low, high = nis_band(s, frames, degrees)
    mean = sum(history.nis) / frames
    return Verdict.NIS_HIGH if mean > high else Verdict.NIS_LOW if mean < low else Verdict.OK


def _alarms_of_trends(s: RangeSettings, trends: Trends, history: History) -> Verdict:
    alarms = Verdict.OK
    old = trends.updates >= TREND_UPDATES
    limit = s.trend_sigmas * TREND_SIGMA
    if (np.abs(trends.mean[old]) > limit).any():
        alarms |= Verdict.INNOVATIONS_ONE_SIDED
    if old.any() and (np.median(trends.product[old], axis=0) < -limit).any():
        alarms |= Verdict.INNOVATIONS_ALTERNATE
    if history.turning.frames >= 2 * TREND_UPDATES and history.turning.correlation > FOLLOWS:
        alarms |= Verdict.INNOVATIONS_FOLLOW_TURN
    return alarms
