"""Whether a filter's covariances are those of its errors: squared errors in units of their own covariance, and χ².

Of a right filter the NEES eᵀ P⁻¹ e of k states and the NIS of k measured numbers are χ² with k degrees of freedom
(Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, 5.4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """Mean of some NEES or NIS, what a right filter would have (`expected`), and the band it would lie in.

    `ratio` is mean over expected: above 1 the filter trusts itself too much. `consistent` says whether the mean lies
    in the band, which holds for values that are independent of one another; along one path they are not.
    """

    mean: float
    expected: float
    low: float
    high: float
    count: int

    @property
    def ratio(self) -> float:
        """Mean over expected; NaN of none."""
        return self.mean / self.expected

    @property
    def consistent(self) -> bool:
        """Whether the mean lies within the band; False of none."""
        return self.low <= self.mean <= self.high

    @classmethod
    def of(cls, squared: Floats, degrees: int, confidence: float = 0.95) -> Consistency:
        """The consistency of NEES or NIS values [n] of that many degrees of freedom each, NaN left out."""
        known = squared[np.isfinite(squared)]
        count = len(known)
        low, high = band(degrees, count, confidence)
        mean = float(known.mean()) if count else math.nan
        return cls(mean=mean, expected=float(degrees), low=low, high=high, count=count)


def nees_of(error: Floats, covariance: Floats) -> Floats:
    """eᵀ P⁻¹ e of errors [..., k] and covariances [..., k, k]: NEES of states, NIS of innovations."""
    return np.asarray((error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1))


def band(degrees: int, samples: int, confidence: float = 0.95) -> tuple[float, float]:
    """Between which the mean of `samples` values of χ² with `degrees` lies; NaN of none."""
    if not samples:
        return math.nan, math.nan
    tail = (1.0 - confidence) / 2
    from scipy.special import gammaincinv  # late: it loads slowly, and many who import this need no band

    # the quantile of χ² with k degrees is twice that of the gamma distribution of shape k/2; scipy.stats loads slowly
    low, high = (2 * float(gammaincinv(degrees * samples / 2, p)) / samples for p in (tail, 1.0 - tail))
    return low, high
