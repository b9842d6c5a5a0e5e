"""What the rules for the odometry look at: the numbers of all frames of one run, each with what is usual.

Of the fragments the median one counts, as in the estimator's own checks. Frames without a match have NaN, for
which no comparison holds.
"""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pipelines.verdict import Verdict
from workbench.diagnosis.finding import Bools, Case, Floats, Ints

USUAL_FRAMES = 301
"""What is usual is the median over so many frames around."""
SKIPPED = Verdict.FIRST_FRAME | Verdict.DUPLICATE_FRAME | Verdict.OUT_OF_ORDER | Verdict.SIZE_CHANGED
SKIPPED |= Verdict.UNDECODABLE


@dataclass(frozen=True)
class Signals:
    """The columns of a run that reveal failures; computed when they are asked for, [n] unless said otherwise."""

    case: Case

    # ---- which frames

    @functools.cached_property
    def accepted(self) -> Bools:
        """The motion was measured."""
        return np.asarray(self.case["accepted"], dtype=bool)

    @functools.cached_property
    def compared(self) -> Bools:
        """The frame was compared with another one."""
        return ~self.case.rings(SKIPPED)

    @functools.cached_property
    def agreeing(self) -> Bools:
        """At least half of the fragments agree on one motion, whether it was used or not."""
        count = self.case["peak_correlation"].shape[1]
        return np.asarray(self.compared & (2 * self.case["inliers"] >= count))

    @functools.cached_property
    def template_row(self) -> Ints:
        """Row of the frame that it was compared with, -1 for none."""
        wanted, frames = self.case["template_frame"], self.case.frame
        row = np.searchsorted(frames, wanted).clip(0, len(frames) - 1)
        return np.where((wanted >= 0) & (frames[row] == wanted), row, -1)

    # ---- the match

    def median(self, name: str) -> Floats:
        """The median fragment's value of a field."""
        values = np.asarray(self.case[name], dtype=np.float64)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # all fragments of a skipped frame are NaN
            return np.asarray(np.nanmedian(values, axis=1))

    correlation = functools.cached_property(lambda self: self.median("peak_correlation"))
    peak_ratio = functools.cached_property(lambda self: self.median("peak_ratio"))
    anisotropy = functools.cached_property(lambda self: self.median("peak_anisotropy"))
    condition = functools.cached_property(lambda self: self.median("condition"))
    eigenvalue = functools.cached_property(lambda self: self.median("smallest_eigenvalue"))
    residual = functools.cached_property(lambda self: self.median("residual_rms"))
    gain = functools.cached_property(lambda self: self.median("gain"))

    @functools.cached_property
    def brightening(self) -> Floats:
        """How much brighter the same ground is than in the template frame, grey levels.

        From gain a and offset b of the match: g - (g - b) / a. Where they are not estimated, the change of the
        image's mean grey since the frame before.
        """
        if self.case.settings.get("gain_and_offset", True):
            grey, gain, offset = (self.case[name] for name in ("match_grey", "gain", "offset"))
            with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                change = grey - (grey - offset) / gain
                return np.asarray(np.nanmedian(change, axis=1))
        return np.concatenate([[0.0], np.diff(self.mean_grey)])

    # ---- the image

    @functools.cached_property
    def mean_grey(self) -> Floats:
        """Mean grey level of the image."""
        return np.asarray(self.case["mean_grey"], dtype=np.float64)

    @functools.cached_property
    def gradient_energy(self) -> Floats:
        """Mean squared gradient of the image, grey²/px²."""
        return np.asarray(self.case["gradient_energy"], dtype=np.float64)

    @functools.cached_property
    def sharpness(self) -> Floats:
        """Gradient energy over squared mean grey, 1/px², which a longer exposure does not change."""
        return np.asarray(self.gradient_energy / np.maximum(self.mean_grey, 1.0) ** 2)

    @functools.cached_property
    def texture(self) -> Floats:
        """Sharpness without the part of the noise.

        Noise of σ leaves a residual of √2 σ between two frames and has a squared gradient of 4 σ².
        """
        noise = 2.0 * usual(self.residual) ** 2
        left = np.maximum(self.gradient_energy - noise, 0.05 * self.gradient_energy)
        return np.asarray(left / np.maximum(self.mean_grey, 1.0) ** 2)

    # ---- the motion

    @functools.cached_property
    def dt_s(self) -> Floats:
        """Time since the frame before it that was compared."""
        return np.asarray(self.case["dt_s"], dtype=np.float64)

    @functools.cached_property
    def shift(self) -> Floats:
        """Shift of the image centre since the frame before [n, 2], px; NaN where none was measured."""
        return np.where(self.accepted[:, None], self.case["frame_shift_px"], np.nan)

    @functools.cached_property
    def turn(self) -> Floats:
        """Rotation since the frame before, rad; NaN where none was measured."""
        return np.where(self.accepted, self.case["delta_heading_rad"], np.nan)

    @functools.cached_property
    def surprise_px(self) -> Floats:
        """How far the shift is from the last velocity times the time, px."""
        return np.asarray(np.hypot(*self._surprise(self.shift).T))

    @functools.cached_property
    def surprise_rad(self) -> Floats:
        """How far the rotation is from the last rate of turn times the time, rad."""
        return np.asarray(np.abs(self._surprise(self.turn[:, None])[:, 0]))

    def _surprise(self, motion: Floats) -> Floats:
        """Motions [n, k] minus what the last measured velocity lets expect."""
        rate = motion / self.dt_s[:, None]
        known = pd.DataFrame(rate).ffill().shift(1).to_numpy()
        return np.asarray(motion - known * self.dt_s[:, None])


def usual(values: Floats) -> Floats:
    """Running median [n] over `USUAL_FRAMES` centred frames, whatever is not finite left out."""
    finite = pd.Series(np.where(np.isfinite(values), values, np.nan))
    return finite.rolling(USUAL_FRAMES, center=True, min_periods=1).median().to_numpy()


def extended(strong: Bools, weak: Bools) -> Bools:
    """Hysteresis: the runs of `weak` frames that hold a `strong` one; strong ones count as weak."""
    weak = weak | strong
    run = np.cumsum(np.diff(weak.astype(np.int8), prepend=0) == 1)
    return weak & np.isin(run, run[strong])


def previous(frames: Bools) -> Bools:
    """The frames [n] that come right after one of those."""
    return np.concatenate([[False], frames[:-1]])


def lasting(frames: Bools, count: int) -> Bools:
    """Those of the frames [n] that stand in a row of at least `count`."""
    run = np.cumsum(np.diff(frames.astype(np.int8), prepend=0) == 1)
    return np.asarray(frames & (np.bincount(run, weights=frames)[run] >= count))


def spread_of(values: Floats) -> tuple[float, float]:
    """Median, and median absolute deviation as the standard deviation that it stands for."""
    middle = float(np.median(values))
    return middle, 1.4826 * float(np.median(np.abs(values - middle)))
