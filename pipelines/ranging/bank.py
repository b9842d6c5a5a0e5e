"""A bank of thousands of independent range filters (a depth map), updated in place by one compiled call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import kernels
from pipelines.ranging.filter import Inputs, Landmarks
from pipelines.ranging.settings import Model

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]


class Bank:
    """n independent filters; the same arithmetic as `filter.step`, without a record.

    Their errors are not independent of each other, because all share the errors of ω̃ and Ṽ: never average their
    ranges as if they were.

    Args:
        model: settings and camera.
        landmarks: at the start; copied.

    Attributes:
        state: x, y, ξ and the upper triangle of P row by row [9, n].
        rejections: in a row so far [n].
        nis: of the last update [n], NaN where there was none.
        outcome: `filter.Outcome` of the last update [n].
    """

    def __init__(self, model: Model, landmarks: Landmarks) -> None:
        self._model = model
        self.state: Floats = landmarks.state.copy()
        self.rejections: Longs = landmarks.rejections.copy()
        self.nis: Floats = np.full(len(landmarks), np.nan)
        self.outcome: Longs = np.zeros(len(landmarks), np.int64)

    def advance(self, inputs: Inputs, pixel: Floats, variance: Floats) -> None:
        """Carry all landmarks over an interval and update them with the image points at its end.

        Args:
            inputs: speeds over the interval.
            pixel: image points [2, n] float64, rows x and y, NaN for none.
            variance: of an image point's coordinate [n] float64, px².

        Raises:
            ValueError: the interval is negative, or the shapes do not fit.
        """
        n = self.state.shape[1]
        if pixel.shape != (2, n) or variance.shape != (n,):
            raise ValueError(
                f"{n} landmarks need pixel (2, {n}) and variance ({n},), not {pixel.shape}, {variance.shape}"
            )
        if not inputs.dt >= 0.0:
            raise ValueError(f"an interval must not be negative: dt = {inputs.dt} s; sort the samples by time")
        kernels.advance_bank(
            self._model,
            self.state,
            self.rejections,
            inputs.omega,
            inputs.speed,
            inputs.dt,
            inputs.still,
            pixel,
            variance,
            self.nis,
            self.outcome,
        )

    @property
    def range_m(self) -> Floats:
        """Depth Z = 1/ξ [n]."""
        return np.asarray(1.0 / self.state[2])

    @property
    def relative_sigma(self) -> Floats:
        """σ_ξ/ξ [n]."""
        return np.asarray(np.sqrt(self.state[8]) / self.state[2])
