"""The range filter step by step: a pure function from landmarks and a measurement to all that was computed.

Each landmark is its own filter with the state X = [x, y, ξ] (px, px, 1/m) and its covariance P; camera axes and
signs are those of `equations.py`. For thousands of landmarks without a record of each see `bank.py`, for shared
errors of the inputs `joint.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import equations as eq
from pipelines.ranging import kernels
from pipelines.ranging.settings import Model
from pipelines.ranging.start import Start

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))
"""Rows and columns of the upper triangle of P in the order of a bank's state."""
FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
"""Where the elements of P lie in its upper triangle, row by row."""


class Outcome(IntEnum):
    """What became of a landmark in a step."""

    PREDICTED = kernels.PREDICTED
    """No image point was measured."""
    UPDATED = kernels.UPDATED
    REJECTED = kernels.REJECTED
    """The NIS is above the gate; the prediction stands."""
    RESET = kernels.RESET
    """The last of several rejections in a row: the image point is taken, the range becomes uncertain."""
    LOST = kernels.LOST
    """It passed behind the camera, or was not seen for long."""
    STARTED = 5
    """Its first image point: there is nothing to update yet."""


class Status(IntEnum):
    """What the range of a landmark is worth."""

    UNKNOWN = 0
    """Neither is σ_ξ/ξ small nor is there enough parallax."""
    CONVERGING = 1
    """One of the two is fulfilled."""
    CONVERGED = 2
    """σ_ξ/ξ is below its limit, and the derotated parallax above its own."""
    REJECTED = 3
    RESET = 4
    LOST = 5


class Inputs(NamedTuple):
    """Measured speeds over an interval: ω̃ rad/s, Ṽ m/s, dt s; `still` where the camera is known to stand."""

    omega: float
    speed: float
    dt: float
    still: bool = False


@dataclass(frozen=True, slots=True)
class Landmarks:
    """All that the filter carries of n landmarks from step to step.

    Attributes:
        state: x, y, ξ and the upper triangle of P, row by row [9, n].
        rejections: in a row so far [n].
        first_px: image points at the start or at the last reset [n, 2].
        turn_rad: measured turn of the camera since [n].
    """

    state: Floats
    rejections: Longs
    first_px: Floats
    turn_rad: Floats

    @classmethod
    def of(cls, starts: Sequence[Start]) -> Landmarks:
        """Landmarks at the start."""
        return cls(
            np.array([[*s.state, *s.covariance[UPPER]] for s in starts], dtype=np.float64).reshape(-1, 9).T.copy(),
            np.zeros(len(starts), np.int64),
            np.array([s.state[:2] for s in starts], dtype=np.float64).reshape(-1, 2),
            np.zeros(len(starts)),
        )

    def __len__(self) -> int:
        return len(self.rejections)

    @property
    def mean(self) -> Floats:
        """X [n, 3]."""
        return self.state[:3].T

    @property
    def covariance(self) -> Floats:
        """P [n, 3, 3]."""
        return full_covariance(self.state[3:].T)

    def and_also(self, others: Landmarks) -> Landmarks:
        """These landmarks, followed by others."""
        return Landmarks(
            np.concatenate([self.state, others.state], axis=1),
            np.concatenate([self.rejections, others.rejections]),
            np.concatenate([self.first_px, others.first_px]),
            np.concatenate([self.turn_rad, others.turn_rad]),
        )

    def only(self, chosen: Longs | NDArray[np.bool_]) -> Landmarks:
        """Some of these landmarks."""
        return Landmarks(
            self.state[:, chosen].copy(), self.rejections[chosen], self.first_px[chosen], self.turn_rad[chosen]
        )


class Update(NamedTuple):
    """Everything that one step computed for n landmarks; what was not computed is NaN.

    Attributes:
        prior: X⁻ [n, 3] (23), px, px, 1/m.
        prior_covariance: P⁻ [n, 3, 3] (24).
        transition: A [n, 3, 3] (28).
        noise_gain: G [n, 3, 2] (29), columns ω and V.
        innovation: ν = z - H X⁻ [n, 2], px.
        innovation_covariance: S = H P⁻ Hᵀ + R [n, 2, 2], px².
        gain: K [n, 3, 2] (25), computed for a rejected point as well.
        nis: νᵀ S⁻¹ ν [n], of the prediction before any relinearisation.
        log_likelihood: of the innovation [n].
        outcome: `Outcome` [n].
        mean: X [n, 3] after the step (26).
        covariance: P [n, 3, 3] after the step (27).
        rejections: in a row so far [n].
        inputs: ω, V, dt as they were used (V = 0 at standstill) [3].
        input_variance: diagonal of Q_c / dt [2].
        range_m: Z = 1/ξ [n].
        range_interval_m: between which the depth lies, ± 2 σ_ξ [n, 2].
        relative_sigma: σ_ξ/ξ [n].
        parallax_px: distance of the image point from the first one [n].
        derotated_parallax_px: the same without the rotation's share [n].
        focus_distance_px: distance of the image point from the focus of expansion [n].
    """

    prior: Floats
    prior_covariance: Floats
    transition: Floats
    noise_gain: Floats
    innovation: Floats
    innovation_covariance: Floats
    gain: Floats
    nis: Floats
    log_likelihood: Floats
    outcome: Longs
    mean: Floats
    covariance: Floats
    rejections: Longs
    inputs: Floats
    input_variance: Floats
    range_m: Floats
    range_interval_m: Floats
    relative_sigma: Floats
    parallax_px: Floats
    derotated_parallax_px: Floats
    focus_distance_px: Floats


def full_covariance(upper: Floats) -> Floats:
    """P [..., 3, 3] from its upper triangle row by row [..., 6]."""
    return upper[..., FULL].reshape(*upper.shape[:-1], 3, 3)


def step(
    model: Model, landmarks: Landmarks, inputs: Inputs, pixel: Floats, variance: Floats | float
) -> tuple[Landmarks, Update]:
    """Carry landmarks over an interval and update them with the image points at its end.

    Args:
        model: settings and camera.
        landmarks: at the start of the interval.
        inputs: speeds over the interval.
        pixel: measured image points [n, 2], NaN where there is none.
        variance: of an image point's coordinate, px²; one number or [n].

    Raises:
        ValueError: the interval is negative, or the number of image points is not that of the landmarks.
    """
    n = len(landmarks)
    if not inputs.dt >= 0.0:
        raise ValueError(f"an interval must not be negative: dt = {inputs.dt} s; sort the samples by time")
    if pixel.shape != (n, 2):
        raise ValueError(f"{n} landmarks need image points of shape ({n}, 2), not {pixel.shape}")
    state, rejections = landmarks.state.copy(), landmarks.rejections.copy()
    block = np.empty((n, kernels.RECORD))
    spread = np.broadcast_to(np.asarray(variance, dtype=np.float64), (n,)).copy()
    columns = np.ascontiguousarray(pixel.T, dtype=np.float64)
    kernels.advance_recorded(
        model, state, rejections, inputs.omega, inputs.speed, inputs.dt, inputs.still, columns, spread, block
    )
    outcome = block[:, 41].astype(np.int64)
    mean, covariance = block[:, 42:45], block[:, 45:54].reshape(n, 3, 3)
    centre = (model.centre_x_px, model.centre_y_px)
    turn = landmarks.turn_rad + inputs.omega * inputs.dt
    reset = outcome == kernels.RESET
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(covariance[:, 2, 2])
        near, far = eq.range_interval(mean[:, 2], sigma)
        parallax = np.linalg.norm(mean[:, :2] - landmarks.first_px, axis=1)
        derotated = eq.derotated_parallax(landmarks.first_px, mean[:, :2], turn, model.focal_px, centre)
    update = Update(
        prior=block[:, 0:3],
        prior_covariance=block[:, 3:12].reshape(n, 3, 3),
        transition=block[:, 12:21].reshape(n, 3, 3),
        noise_gain=block[:, 21:27].reshape(n, 3, 2),
        innovation=block[:, 27:29],
        innovation_covariance=block[:, 29:33].reshape(n, 2, 2),
        gain=block[:, 33:39].reshape(n, 3, 2),
        nis=block[:, 39],
        log_likelihood=block[:, 40],
        outcome=outcome,
        mean=mean,
        covariance=covariance,
        rejections=rejections,
        inputs=np.array([inputs.omega, 0.0 if inputs.still else inputs.speed, inputs.dt]),
        input_variance=np.array(
            [model.q_omega / inputs.dt, 0.0 if inputs.still else model.q_speed / inputs.dt]
            if inputs.dt > 0.0
            else [0.0, 0.0]
        ),
        range_m=1.0 / mean[:, 2],
        range_interval_m=np.stack([near, far], axis=-1),
        relative_sigma=sigma / mean[:, 2],
        parallax_px=parallax,
        derotated_parallax_px=derotated,
        focus_distance_px=np.linalg.norm(mean[:, :2] - np.array(centre), axis=1),
    )
    first = np.where(reset[:, None], pixel, landmarks.first_px)
    return Landmarks(state, rejections, first, np.where(reset, 0.0, turn)), update


def statuses(update: Update, *, max_relative_sigma: float = 0.1, min_parallax_px: float = 5.0) -> Longs:
    """The `Status` of each landmark after a step [n].

    Args:
        update: the step.
        max_relative_sigma: σ_ξ/ξ below which a range counts.
        min_parallax_px: derotated parallax above which a range counts.
    """
    told = (update.relative_sigma < max_relative_sigma).astype(np.int64)
    found = told + (update.derotated_parallax_px > min_parallax_px)
    for outcome, status in (
        (Outcome.REJECTED, Status.REJECTED),
        (Outcome.RESET, Status.RESET),
        (Outcome.LOST, Status.LOST),
    ):
        found[update.outcome == outcome] = status
    return np.asarray(found, dtype=np.int64)
