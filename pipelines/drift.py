"""The drift budget: how much of the error at the end of a path each of its frames made.

Poses are rows x, y, heading (m, m, rad) in a world with z up; P_k are those of the estimate, Q_k those of the
reference at the same times, k = 0 … n, laid over one another at the start. Contributions are vectors in the world,
in metres, at the end of the path: estimate minus reference.

With the increments e_k = P_{k-1}⁻¹ P_k = (t̂, α̂) and r_k = Q_{k-1}⁻¹ Q_k = (t, α), let T_k be the end of the mixed
chain that goes by the estimate up to frame k and by the reference from there: T_k = P_k (Q_k⁻¹ Q_n). Then T_0 is the
end of the reference, T_n that of the estimate, and frame k contributes T_k - T_{k-1}, whose sum telescopes. With g_k
the way from frame k to the end in the reference's body axes at k, and θ̂ the estimate's heading,

    T_k - T_{k-1} = R(θ̂_{k-1}) (t̂_k - t_k)  +  R(θ̂_{k-1}) (R(α̂_k) - R(α_k)) g_k
                    shift: moved wrongly        heading: turned wrongly, carried along the way to the end

Both parts are exact: the sum of all is the end-point error but for rounding. The order of the chain is a choice: with
the reference before frame k and the estimate after it the shares differ by products of two errors.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.evaluation import (
    Floats,
    Method,
    Trajectory,
    align,
    align_start,
    associated,
    motions,
    path_lengths,
)
from pipelines.planar import rotated, wrap_angles

Integers = NDArray[np.int64]
Order = Literal["harm", "size"]

BASELINE_SHARE = 0.05
"""Headings that a reference lacks are derived over this share of its path."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftBudget:
    """The end-point error of an estimate as a sum of contributions, one per increment.

    Contribution i is that of the increment from pose `since[i]` to pose `index[i]` of the estimate: one frame, or
    several where the reference has a gap (`frames`). `shift_m` and `heading_m` [m, 2] are its two parts in the world,
    `increment_error` [m, 3] is estimated minus true increment (x, y in the axes of the body before it, heading; m, m,
    rad). `start_m` [2] is what the start's heading does where the reference does not tell it, else 0.
    `end_error_m` [2] is the end-point error, `path_m` the reference's path. `headings` says whether the reference's
    headings are its own (``reference``) or were ``derived`` from positions. `unjudged` counts the estimate's poses
    before the first and after the last one that has a reference.

    `ape_m` [m] are the contributions to the root mean square of the error after alignment, which with
    `ape_alignment_m` sum to `ape_rmse_m`.
    """

    since: Integers = field(repr=False)
    index: Integers = field(repr=False)
    shift_m: Floats = field(repr=False)
    heading_m: Floats = field(repr=False)
    increment_error: Floats = field(repr=False)
    start_m: Floats
    end_error_m: Floats
    path_m: float
    headings: Literal["reference", "derived"]
    unjudged: tuple[int, int]
    ape_m: Floats = field(repr=False)
    ape_alignment_m: float
    ape_rmse_m: float

    @property
    def contribution_m(self) -> Floats:
        """Shift and heading together [m, 2]."""
        return self.shift_m + self.heading_m

    @property
    def size_m(self) -> Floats:
        """Length of each contribution [m], whichever way it points."""
        size: Floats = np.hypot(*self.contribution_m.T)
        return size

    @property
    def harm_m(self) -> Floats:
        """Each contribution along the end-point error [m]: they sum to its length, less what the start does.

        Below zero where a frame undid some of the error.
        """
        return self._along(self.contribution_m)

    @property
    def shift_harm_m(self) -> Floats:
        """The part of `harm_m` that came of wrong shifts [m]."""
        return self._along(self.shift_m)

    @property
    def heading_harm_m(self) -> Floats:
        """The part of `harm_m` that came of wrong turns [m]."""
        return self._along(self.heading_m)

    @property
    def frames(self) -> Integers:
        """How many frames each contribution covers [m]: 1, more over a gap of the reference."""
        return self.index - self.since

    @property
    def residual_m(self) -> float:
        """Distance between the end-point error and the sum of all contributions: rounding."""
        return float(np.hypot(*(self.start_m + self.contribution_m.sum(axis=0) - self.end_error_m)))

    def ranked(self, by: Order = "harm") -> Integers:
        """Which contributions did most, the greatest first [m]: along the end-point error, or by size."""
        values = self.harm_m if by == "harm" else self.size_m
        return np.argsort(-values, kind="stable").astype(np.int64)

    def over(self, frames: int) -> DriftBudget:
        """The budget in blocks of that many contributions: where single ones are the noise of the reference.

        Raises:
            ValueError: `frames` is below 1.
        """
        if frames < 1:
            raise ValueError(f"frames must be 1 or more, not {frames}")
        first = np.arange(0, len(self.index), frames)
        last = np.minimum(first + frames, len(self.index)) - 1
        return dataclasses.replace(
            self,
            since=self.since[first],
            index=self.index[last],
            shift_m=np.add.reduceat(self.shift_m, first, axis=0),
            heading_m=np.add.reduceat(self.heading_m, first, axis=0),
            increment_error=np.add.reduceat(self.increment_error, first, axis=0),
            ape_m=np.add.reduceat(self.ape_m, first),
        )

    def _along(self, vectors: Floats) -> Floats:
        length = float(np.hypot(*self.end_error_m))
        direction = self.end_error_m / length if length > 0 else np.zeros(2)
        harm: Floats = vectors @ direction
        return harm


def drift_budget(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    with_scale: bool = False,
    offset_ns: int = 0,
    method: Method = "interpolate",
    max_gap_ns: int | None = None,
    baseline_m: float | None = None,
) -> DriftBudget:
    """Decompose the end-point error of an estimate, the one that `evaluate` reports.

    A reference that is slower than the estimate is interpolated: the error of the interpolation goes into single
    contributions, and cancels over each of the reference's steps. Where some pose of the reference lacks its heading,
    all headings are derived from positions (see `derived_headings`); the sum stays exact, and what is shift and what
    is heading is told apart no finer than the baseline.

    Args:
        estimate: the path to be judged, with headings.
        reference: the path that is taken for the truth.
        with_scale: lay the estimate over the reference with the scale that fits best.
        offset_ns: added to the estimate's times before the reference is looked up.
        method: see `associate`.
        max_gap_ns: see `associate`.
        baseline_m: path over which missing headings are derived; None for a twentieth of the reference's.

    Raises:
        EvaluationError: fewer than 2 poses, or fewer than half of them, have a reference.
        ValueError: a heading of the estimate is unknown.
    """
    if not np.isfinite(estimate.pose[:, 2]).all():
        raise ValueError("a drift budget needs the heading of every pose of the estimate")
    index, truth = associated(estimate, reference, offset_ns=offset_ns, method=method, max_gap_ns=max_gap_ns)
    raw = estimate.pose[index]
    whole = align(raw, truth, with_scale=with_scale)
    path = align_start(raw, truth, whole)(raw)
    headings: Literal["reference", "derived"] = "reference"
    length = float(path_lengths(truth[:, :2])[-1])
    if not np.isfinite(truth[:, 2]).all():
        headings = "derived"
        truth = derived_headings(path, truth, BASELINE_SHARE * length if baseline_m is None else baseline_m)
    turned, shift, heading, error = _contributions(path, truth)
    aligned_error = whole(raw)[:, :2] - truth[:, :2]
    rmse = math.sqrt(float(np.mean(np.sum(aligned_error**2, axis=1))))
    shares = _shares(path, truth, error, aligned_error) / rmse if rmse > 0 else np.zeros(len(index) - 1)
    return DriftBudget(
        since=index[:-1],
        index=index[1:],
        shift_m=shift,
        heading_m=heading,
        increment_error=error,
        start_m=turned,
        end_error_m=path[-1, :2] - truth[-1, :2],
        path_m=length,
        headings=headings,
        unjudged=(int(index[0]), int(len(estimate) - 1 - index[-1])),
        ape_m=shares,
        ape_alignment_m=rmse - float(shares.sum()),
        ape_rmse_m=rmse,
    )


def derived_headings(estimate: Floats, reference: Floats, baseline_m: float) -> Floats:
    """The reference [n, 3] with headings that its positions imply, given the estimate's poses [n, 3].

    At each pose the heading error is taken for the angle between the displacements of the two paths over the stretch
    of `baseline_m` of reference path around it, cut at the ends of the path: the reference's heading is the estimate's
    less that angle. Where both stand still it is that of the stretch before.
    """
    along = path_lengths(reference[:, :2])
    first = np.searchsorted(along, along - baseline_m / 2)
    last = np.searchsorted(along, along + baseline_m / 2, side="right") - 1
    p, q = (path[last, :2] - path[first, :2] for path in (estimate, reference))
    angle = np.arctan2(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0], np.sum(p * q, axis=1))
    moves = (np.hypot(*q.T) > 0) & (np.hypot(*p.T) > 0)
    latest = np.maximum.accumulate(np.where(moves, np.arange(len(angle)), -1))
    known = np.where(latest >= 0, angle[latest], 0.0)
    return np.column_stack([reference[:, :2], wrap_angles(estimate[:, 2] - known)])


def _contributions(path: Floats, truth: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """The start's part [2], shift and heading parts [m, 2] and increment errors [m, 3] of poses [m + 1, 3]."""
    before, after = np.arange(len(path) - 1), np.arange(1, len(path))
    e, r = motions(path, before, after), motions(truth, before, after)
    ahead = rotated(truth[-1, :2] - truth[:, :2], -truth[:, 2])
    turned = rotated(ahead[:1], path[:1, 2])[0] - (truth[-1, :2] - truth[0, :2])
    shift = rotated(e[:, :2] - r[:, :2], path[:-1, 2])
    heading = rotated(rotated(ahead[1:], e[:, 2]) - rotated(ahead[1:], r[:, 2]), path[:-1, 2])
    error = np.column_stack([e[:, :2] - r[:, :2], wrap_angles(e[:, 2] - r[:, 2])])
    return turned, shift, heading, error


def _shares(path: Floats, truth: Floats, error: Floats, aligned_error: Floats) -> Floats:
    """What each increment adds [m] to the mean square of the aligned errors, m².

    The error of pose j is the sum over k ≤ j of c_kj, the contribution of increment k carried to pose j instead of the
    end; ẽ_j is the error after alignment. Σ_j ẽ_j · c_kj is the share of increment k: ẽ is orthogonal to the
    alignment's own motions, so that the shares sum to Σ ẽ² but for a term of second order in the alignment's
    rotation. With c_kj = a_k + B_k (q_j - q_k), B_k a difference of rotations, suffix sums make it linear in time.
    """
    q = truth[:, :2]
    x, y = aligned_error.T
    # per pose ẽ, ẽ · q and ẽ · J q, J a quarter turn; then summed over all poses from each one on
    terms = np.column_stack([x, y, x * q[:, 0] + y * q[:, 1], y * q[:, 0] - x * q[:, 1]])
    x, y, dot, cross = np.cumsum(terms[::-1], axis=0)[::-1][1:].T
    a = rotated(error[:, :2], path[:-1, 2])
    here = q[1:]
    dot = dot - (x * here[:, 0] + y * here[:, 1])
    cross = cross - (y * here[:, 0] - x * here[:, 1])
    turned = path[1:, 2] - truth[1:, 2]
    wrong = turned - error[:, 2]
    c, s = np.cos(turned) - np.cos(wrong), np.sin(turned) - np.sin(wrong)
    shares: Floats = (a[:, 0] * x + a[:, 1] * y + c * dot + s * cross) / len(path)
    return shares
