"""How far an estimated path in the plane is from a reference: association in time, alignment, APE, RPE, drift.

Poses are rows x, y, heading (m, m, rad; heading NaN where it is unknown) in frames with z up. Errors are
estimate minus reference. Nothing here looks at heights, roll or pitch.

Association interpolates the reference at the estimate's times. The absolute error (APE) is that after the
least-squares alignment in the plane (S. Umeyama, IEEE PAMI 13(4), 1991, reduced to two dimensions, where the
rotation has a closed form). The relative error (RPE) compares motions over a distance or a time, as
J. Sturm et al. (IROS 2012) define it. The drift is the error of the last pose after the first poses were laid
over one another, as a share of the reference's path. NEES weighs errors by the estimate's own covariances.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.consistency import nees_of
from pipelines.planar import heading_of_quat, rotated, wrap_angle, wrap_angles
from readers.streams import PoseSample, WorkbenchError

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
Method = Literal["interpolate", "nearest"]

SMALLEST_SHARE = 0.5
GAP_STEPS = 5
TURNED_RAD = math.radians(5)
STILL_SHARE = 0.05


class EvaluationError(WorkbenchError):
    """An estimate and a reference that cannot be compared; the text says how many poses associate."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A path in the plane: `t_ns` int64 [n] ascending without repetition, `pose` float64 [n, 3]."""

    t_ns: Times
    pose: Floats

    @classmethod
    def of(cls, t_ns: Times | Sequence[int], pose: Floats) -> Trajectory:
        """Sort by time; of equal stamps keep the first; leave out positions that are not finite.

        Args:
            t_ns: times in nanoseconds, shape [n].
            pose: x, y, heading, shape [n, 3]; or x, y, shape [n, 2], for positions only.
        """
        times, poses = np.asarray(t_ns, dtype=np.int64), np.asarray(pose, dtype=np.float64)
        if poses.shape[1] == 2:
            poses = np.column_stack([poses, np.full(len(poses), np.nan)])
        finite = np.isfinite(poses[:, :2]).all(axis=1)
        times, kept = np.unique(times[finite], return_index=True)
        return cls(times, poses[finite][kept])

    @classmethod
    def of_poses(cls, samples: Iterable[PoseSample]) -> Trajectory:
        """The path of pose samples, seen from above."""
        rows = [(s.t_ns, *s.position_m[:2], heading_of_quat(s.quat_xyzw)) for s in samples]
        times = np.array([row[0] for row in rows], dtype=np.int64)
        return cls.of(times, np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3))

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics:
    """Root mean square, mean, median, largest and number of some magnitudes; NaN of none."""

    rmse: float
    mean: float
    median: float
    max: float
    count: int

    @classmethod
    def of(cls, values: Floats) -> Statistics:
        """Statistics of the magnitudes of `values` [n], NaN left out."""
        size = np.abs(values[np.isfinite(values)])
        if not len(size):
            return cls(rmse=math.nan, mean=math.nan, median=math.nan, max=math.nan, count=0)
        return cls(
            rmse=float(np.sqrt(np.mean(size**2))),
            mean=float(size.mean()),
            median=float(np.median(size)),
            max=float(size.max()),
            count=len(size),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """Brings the estimate over the reference: p ↦ scale · R(rotation) p + translation.

    `determined` is False where the points do not tell the rotation (all in one place).
    """

    rotation_rad: float
    translation_m: Floats
    scale: float = 1.0
    determined: bool = True

    def __call__(self, pose: Floats) -> Floats:
        """Move poses [n, 3]."""
        c, s = math.cos(self.rotation_rad), math.sin(self.rotation_rad)
        moved = np.empty_like(pose)
        moved[:, 0] = self.scale * (c * pose[:, 0] - s * pose[:, 1]) + self.translation_m[0]
        moved[:, 1] = self.scale * (s * pose[:, 0] + c * pose[:, 1]) + self.translation_m[1]
        moved[:, 2] = pose[:, 2] + self.rotation_rad
        return moved


@dataclass(frozen=True, slots=True, kw_only=True)
class Relative:
    """Error of the motion over `delta` (``m`` of reference path, ``s``, or ``frames``), from every frame on.

    `compared` is ``pose`` (translation as a vector in the body's frame, and heading) where the reference has
    headings, else ``distance`` (only how far apart the two positions are).
    """

    delta: float
    unit: str
    compared: str
    translation_m: Statistics
    heading_rad: Statistics


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """An estimate against its reference.

    `ape_m` and `ape_heading_rad` are those after `alignment`; `path_m` is the length of the estimate with the
    alignment's scale, `reference_path_m` that of the reference at the same times. `end_error_m` and `drift`
    (share of the reference's path) are those after laying the first poses over one another; `yaw_drift_rad` is
    the change of the heading error from the first to the last pose. `fitted_scale` is the scale that least
    squares find, whether or not `alignment` uses it, NaN where it is not determined. `index` [m] says which
    poses of the estimate associate, `errors` [m, 4] are their errors after `alignment`: x, y, distance (m),
    heading (rad).
    """

    matched: int
    total: int
    offset_ns: int
    alignment: Alignment
    fitted_scale: float
    path_m: float
    reference_path_m: float
    ape_m: Statistics
    ape_heading_rad: Statistics
    rpe: tuple[Relative, ...]
    end_error_m: float
    drift: float
    yaw_drift_rad: float
    yaw_drift_rad_per_m: float
    notes: tuple[str, ...]
    index: NDArray[np.int64] = field(repr=False)
    errors: Floats = field(repr=False)


def evaluate(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    with_scale: bool = False,
    offset_ns: int = 0,
    method: Method = "interpolate",
    max_gap_ns: int | None = None,
    rpe_m: Sequence[float] | None = None,
    rpe_s: Sequence[float] = (1.0,),
) -> Evaluation:
    """Compare an estimate with a reference.

    Args:
        estimate: the path to be judged.
        reference: the path that is taken for the truth.
        with_scale: estimate the scale as well, Sim(2) in place of SE(2).
        offset_ns: added to the estimate's times before the reference is looked up.
        method: see `associate`.
        max_gap_ns: see `associate`.
        rpe_m: distances of the relative error; None for one tenth of the path, rounded down to 1, 2 or 5.
        rpe_s: times of the relative error.

    Raises:
        EvaluationError: fewer than 2 poses, or fewer than half of them, have a reference.
    """
    index, truth = associated(estimate, reference, offset_ns=offset_ns, method=method, max_gap_ns=max_gap_ns)
    raw = estimate.pose[index]
    fitted = align(raw, truth, with_scale=True)
    alignment = fitted if with_scale else align(raw, truth)
    aligned = alignment(raw)
    errors = _errors(aligned, truth)
    along = path_lengths(truth[:, :2])
    length = float(along[-1])
    if rpe_m is None:
        rpe_m = [round_down(length / 10)] if length > 0 else []
    seconds = (estimate.t_ns[index] - estimate.t_ns[index[0]]) / 1e9
    relative = [relative_error(aligned, truth, along, delta, "m") for delta in rpe_m]
    relative += [relative_error(aligned, truth, seconds, delta, "s") for delta in rpe_s]
    end_error = end_point_error(raw, truth, alignment)
    yaw_drift = _growth(errors[:, 3])
    return Evaluation(
        matched=len(index),
        total=len(estimate),
        offset_ns=offset_ns,
        alignment=alignment,
        fitted_scale=fitted.scale if fitted.determined else math.nan,
        path_m=float(path_lengths(aligned[:, :2])[-1]),
        reference_path_m=length,
        ape_m=Statistics.of(errors[:, 2]),
        ape_heading_rad=Statistics.of(errors[:, 3]),
        rpe=tuple(relative),
        end_error_m=end_error,
        drift=end_error / length if length > 0 else math.nan,
        yaw_drift_rad=yaw_drift,
        yaw_drift_rad_per_m=yaw_drift / length if length > 0 else math.nan,
        notes=_notes(raw, truth, alignment, errors, length),
        index=index,
        errors=errors,
    )


def associate(
    t_ns: Times,
    reference: Trajectory,
    *,
    offset_ns: int = 0,
    method: Method = "interpolate",
    max_gap_ns: int | None = None,
) -> Floats:
    """The reference's poses [n, 3] at the times `t_ns + offset_ns` [n], NaN where it has none.

    ``interpolate`` takes the straight line (and the shorter turn) between the reference's neighbours, if they
    lie at most `max_gap_ns` apart (default: five of its median steps); nothing is extrapolated. ``nearest``
    takes the nearest pose, if it lies at most `max_gap_ns` away (default: half a median step).
    """
    near = neighbours(t_ns + offset_ns, reference.t_ns, method, max_gap_ns)
    poses = np.full((len(t_ns), 3), np.nan)
    index = np.flatnonzero(near.known)
    first, last = reference.pose[near.before[index]], reference.pose[near.after[index]]
    share = near.share[index, None]
    step = last - first
    step[:, 2] = wrap_angles(step[:, 2])
    # a known heading must not be lost to an unknown neighbour that has no weight
    poses[index] = np.where(share == 0, first, first + share * step)
    return poses


class Neighbours(NamedTuple):
    """Where times lie among known ones, all [n]: row before, row after, share of the way; whether that counts."""

    before: NDArray[np.int64]
    after: NDArray[np.int64]
    share: Floats
    known: NDArray[np.bool_]


def neighbours(t_ns: Times, known_ns: Times, method: Method, max_gap_ns: int | None) -> Neighbours:
    """The rows of ascending times `known_ns` [m] that stand for the times `t_ns` [n]; rules as for `associate`.

    For ``nearest`` both rows are the nearest one and the share is 0.
    """
    if not len(known_ns) or not len(t_ns):
        none = np.zeros(len(t_ns), dtype=np.int64)
        return Neighbours(none, none, none.astype(np.float64), none.astype(np.bool_))
    usual = float(np.median(np.diff(known_ns))) if len(known_ns) > 1 else 0.0
    after = np.searchsorted(known_ns, t_ns).clip(0, len(known_ns) - 1)
    before = (after - 1).clip(0)
    if method == "nearest":
        near = np.where(np.abs(known_ns[after] - t_ns) <= np.abs(t_ns - known_ns[before]), after, before)
        bound = usual / 2 if max_gap_ns is None else max_gap_ns
        return Neighbours(near, near, np.zeros(len(t_ns)), np.abs(known_ns[near] - t_ns) <= bound)
    before = np.where(known_ns[after] == t_ns, after, before)
    gap = known_ns[after] - known_ns[before]
    bound = GAP_STEPS * usual if max_gap_ns is None else max_gap_ns
    inside = (known_ns[before] <= t_ns) & (t_ns <= known_ns[after]) & (gap <= bound)
    share = np.where(gap > 0, (t_ns - known_ns[before]) / np.maximum(gap, 1), 0.0)
    return Neighbours(before, after, share, inside)


def associated(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    offset_ns: int = 0,
    method: Method = "interpolate",
    max_gap_ns: int | None = None,
) -> tuple[NDArray[np.int64], Floats]:
    """Which poses [m] of the estimate have a reference at their time, and that reference [m, 3]; see `associate`.

    Raises:
        EvaluationError: fewer than 2 poses, or fewer than half of them, have one.
    """
    at = associate(estimate.t_ns, reference, offset_ns=offset_ns, method=method, max_gap_ns=max_gap_ns)
    index = np.flatnonzero(np.isfinite(at[:, 0]))
    demand_enough(len(index), estimate.t_ns, reference.t_ns, offset_ns)
    return index, at[index]


def align(estimate: Floats, reference: Floats, *, with_scale: bool = False) -> Alignment:
    """The rotation, translation and (if asked) scale that bring the estimate's positions over the reference's.

    Both are poses [n, 3] of which the positions are used. With a, b the centred positions, the angle that
    maximises Σ b·R a is atan2(Σ a × b, Σ a·b), and the scale is Σ b·R a / Σ |a|² (Umeyama's (40)-(42) in the
    plane). Where all positions coincide, the rotation is that of the headings, 0 if they are unknown.
    """
    mean_a, mean_b = estimate[:, :2].mean(axis=0), reference[:, :2].mean(axis=0)
    a, b = estimate[:, :2] - mean_a, reference[:, :2] - mean_b
    dot = float(np.sum(a * b))
    cross = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    spread = float(np.sum(a**2))
    strength = math.hypot(cross, dot)
    determined = strength > 1e-12 * max(spread, float(np.sum(b**2)), 1e-300)
    angle = math.atan2(cross, dot) if determined else mean_angle(reference[:, 2] - estimate[:, 2])
    scale = strength / spread if with_scale and determined else 1.0
    c, s = math.cos(angle), math.sin(angle)
    turned = np.array([c * mean_a[0] - s * mean_a[1], s * mean_a[0] + c * mean_a[1]])
    return Alignment(rotation_rad=angle, translation_m=mean_b - scale * turned, scale=scale, determined=determined)


def align_start(estimate: Floats, reference: Floats, whole: Alignment) -> Alignment:
    """Lay the first pose of the estimate over the reference's, with the scale of the `whole` alignment.

    Without a heading of the reference the rotation is that of the whole path as well.
    """
    turn = wrap_angle(float(reference[0, 2] - estimate[0, 2]))
    if not math.isfinite(turn):
        turn = whole.rotation_rad
    rotated = Alignment(rotation_rad=turn, translation_m=np.zeros(2), scale=whole.scale)
    shift = reference[0, :2] - rotated(estimate[:1])[0, :2]
    return dataclasses.replace(rotated, translation_m=shift)


def end_point_error(estimate: Floats, reference: Floats, whole: Alignment) -> float:
    """Distance in metres between the last positions after `align_start`."""
    last = align_start(estimate, reference, whole)(estimate[-1:])[0]
    return math.hypot(last[0] - reference[-1, 0], last[1] - reference[-1, 1])


def pose_nees(
    estimate: Trajectory,
    covariance: Floats,
    reference: Trajectory,
    *,
    offset_ns: int = 0,
    method: Method = "interpolate",
    max_gap_ns: int | None = None,
) -> tuple[NDArray[np.int64], Floats]:
    """NEES of poses in the plane: which poses [m] have a reference, and eᵀ P⁻¹ e of them [m].

    Errors are those after `align_start`, turned back into the axes of the estimate's world, in which `covariance`
    [n, 3, 3] of x, y, heading (m², m·rad, rad²) since the start is given. NaN where it is not known, or not positive
    definite, as at the start itself. Of a right estimator each is χ² with 3 degrees of freedom
    (`pipelines.consistency.Consistency`), but those along one path are not independent of one another.

    Raises:
        EvaluationError: fewer than 2 poses, or fewer than half of them, have a reference.
        ValueError: there is not one covariance for each pose.
    """
    if covariance.shape != (len(estimate), 3, 3):
        raise ValueError(f"covariances of shape {covariance.shape} for {len(estimate)} poses: [n, 3, 3] is needed")
    index, truth = associated(estimate, reference, offset_ns=offset_ns, method=method, max_gap_ns=max_gap_ns)
    raw = estimate.pose[index]
    start = align_start(raw, truth, align(raw, truth))
    x, y, _, heading = _errors(start(raw), truth).T
    back = np.full(len(index), -start.rotation_rad)
    error = np.column_stack([rotated(np.column_stack([x, y]), back), heading])
    nees = np.full(len(index), np.nan)
    known = np.isfinite(covariance[index]).all(axis=(1, 2)) & np.isfinite(error).all(axis=1)
    known[known] = np.linalg.eigvalsh(covariance[index][known])[:, 0] > 0
    nees[known] = nees_of(error[known], covariance[index][known])
    return index, nees


def relative_error(estimate: Floats, reference: Floats, along: Floats, delta: float, unit: str) -> Relative:
    """Error of the motion from every pose to the first one that is `delta` further `along` [n] (ascending).

    With Q the reference and P the estimate, E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j); the magnitudes of its translation
    and of its rotation are collected. Both are poses [n, 3] of one scale.
    """
    start = np.arange(len(along))
    stop = np.searchsorted(along, along + delta - 1e-12 * max(abs(float(along[-1])), 1.0))
    pairs = stop < len(along)
    i, j = start[pairs], stop[pairs]
    headings = bool(np.isfinite(reference[:, 2]).all() and np.isfinite(estimate[:, 2]).all())
    if headings:
        q, p = motions(reference, i, j), motions(estimate, i, j)
        translation = np.hypot(p[:, 0] - q[:, 0], p[:, 1] - q[:, 1])
        turn = wrap_angles(p[:, 2] - q[:, 2])
    else:
        translation = _distance(estimate, i, j) - _distance(reference, i, j)
        turn = np.full(len(i), np.nan)
    return Relative(
        delta=delta,
        unit=unit,
        compared="pose" if headings else "distance",
        translation_m=Statistics.of(translation),
        heading_rad=Statistics.of(turn),
    )


def motions(pose: Floats, i: NDArray[np.intp], j: NDArray[np.intp]) -> Floats:
    """Motions pose_i⁻¹ pose_j [m, 3] in the frame of pose i."""
    dx, dy = (pose[j, :2] - pose[i, :2]).T
    c, s = np.cos(pose[i, 2]), np.sin(pose[i, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, pose[j, 2] - pose[i, 2]])


def path_lengths(positions: Floats) -> Floats:
    """Length of the path from the first position to each one [n], of positions [n, 2]."""
    steps = np.hypot(*np.diff(positions, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def round_down(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-12))


def demand_enough(matched: int, estimate_ns: Times, reference_ns: Times, offset_ns: int) -> None:
    """See to it that enough poses have a reference.

    Raises:
        EvaluationError: fewer than 2 poses of the estimate, or fewer than half of them, are `matched`.
    """
    if matched >= 2 and matched >= SMALLEST_SHARE * len(estimate_ns):
        return
    raise EvaluationError(
        f"{matched} of {len(estimate_ns)} poses have a reference at their time (estimate {_span(estimate_ns)}, "
        f"reference {_span(reference_ns)}, offset {offset_ns / 1e9:g} s); at least 2 and half of them are needed: "
        "look at the reference's clock and units, or choose another reference"
    )


def _span(t_ns: Times) -> str:
    if not len(t_ns):
        return "is empty"
    return f"from {t_ns[0] / 1e9:.3f} to {t_ns[-1] / 1e9:.3f} s"


def _errors(estimate: Floats, reference: Floats) -> Floats:
    """Errors [n, 4] of poses [n, 3]: x, y, distance, heading."""
    x, y = (estimate[:, :2] - reference[:, :2]).T
    return np.column_stack([x, y, np.hypot(x, y), wrap_angles(estimate[:, 2] - reference[:, 2])])


def mean_angle(angles_rad: Floats) -> float:
    """Circular mean of the known ones among some angles, 0 of none."""
    known = angles_rad[np.isfinite(angles_rad)]
    return math.atan2(float(np.sin(known).sum()), float(np.cos(known).sum())) if len(known) else 0.0


def _growth(angles_rad: Floats) -> float:
    """How far an angle has turned from the first known value to the last one, whole turns included."""
    known = np.unwrap(angles_rad[np.isfinite(angles_rad)])
    return float(known[-1] - known[0]) if len(known) else math.nan


def _distance(pose: Floats, i: NDArray[np.intp], j: NDArray[np.intp]) -> Floats:
    """Distances [m] between positions i and j."""
    distance: Floats = np.linalg.norm(pose[j, :2] - pose[i, :2], axis=1)
    return distance


def _notes(raw: Floats, truth: Floats, alignment: Alignment, errors: Floats, length: float) -> tuple[str, ...]:
    """What a reader of the numbers should know."""
    notes = []
    extent = float(np.hypot(*(truth[:, :2] - truth[0, :2]).T).max())
    if length == 0:
        notes.append("the reference does not move: drift per path has no value")
    elif extent < STILL_SHARE * length:
        notes.append(
            f"the reference stays within {extent:.3g} m while its path adds up to {length:.3g} m: "
            "the path is mostly noise, so that drift per path says little"
        )
    if not alignment.determined:
        notes.append("all positions coincide: the alignment's rotation and scale are not determined")
    if not np.isfinite(truth[:, 2]).any():
        notes.append("the reference has no heading: the start is aligned with the rotation of the whole path")
        return tuple(notes)
    offset = mean_angle(errors[:, 3])
    if abs(offset) > TURNED_RAD and alignment.determined and extent >= STILL_SHARE * length:
        notes.append(
            f"after alignment the headings differ by {math.degrees(offset):.1f} degrees on average: "
            "the camera's mounting yaw is not the reference's, or the path is turned"
        )
    return tuple(notes)
