"""How far a path in space is from a reference, with all six degrees of freedom: the counterpart of `evaluation`.

Poses are `world_T_body`: positions (m) and unit quaternions x, y, z, w. Errors are estimate against reference. The
definitions are those of evo and of the papers behind it: alignment after S. Umeyama (IEEE PAMI 13(4), 1991), absolute
and relative error after J. Sturm et al. (IROS 2012), drift over segments after A. Geiger et al. (CVPR 2012).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines import evaluation as planar
from pipelines.evaluation import Method, Statistics, Trajectory, neighbours
from pipelines.planar import heading_of_quat, quat_of_heading
from readers.streams import PoseSample

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
Pairs = NDArray[np.int64]
Fit = Literal["none", "origin", "yaw", "se3", "sim3", "scale"]

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10
"""The benchmark begins a segment at every tenth frame."""
ROUNDING = 1e-14
"""A quaternion whose norm is off 1 by less is a unit quaternion."""


@dataclass(frozen=True, slots=True)
class SpatialPath:
    """A path in space: `t_ns` int64 [n] ascending without repetition, `position_m` [n, 3], `quat_xyzw` [n, 4]."""

    t_ns: Times
    position_m: Floats
    quat_xyzw: Floats

    @classmethod
    def of(cls, t_ns: Times | Sequence[int], position_m: Floats, quat_xyzw: Floats) -> SpatialPath:
        """Sort by time, of equal stamps keep the first, scale quaternions to unit norm, leave unknown poses out.

        Quaternions whose norm is 1 but for rounding stay as they are, bit for bit. A pose is unknown where a number
        of it is not finite or its quaternion is zero.
        """
        times = np.asarray(t_ns, dtype=np.int64)
        places = np.asarray(position_m, dtype=np.float64).reshape(len(times), 3)
        quats = np.asarray(quat_xyzw, dtype=np.float64).reshape(len(times), 4)
        norm = np.linalg.norm(quats, axis=1)
        known = np.isfinite(places).all(axis=1) & np.isfinite(norm) & (norm > 0)
        times, kept = np.unique(times[known], return_index=True)
        scale = np.where(np.abs(norm - 1) < ROUNDING, 1.0, norm)[known, None]
        return cls(times, places[known][kept], (quats[known] / scale)[kept])

    @classmethod
    def of_poses(cls, samples: Iterable[PoseSample]) -> SpatialPath:
        """The path of pose samples."""
        rows = [(s.t_ns, s.position_m, s.quat_xyzw) for s in samples]
        times, places, quats = zip(*rows, strict=True) if rows else ((), (), ())
        return cls.of(np.array(times, np.int64), np.array(places, np.float64), np.array(quats, np.float64))

    @classmethod
    def of_plane(cls, path: Trajectory) -> SpatialPath:
        """A path in the plane as one in space, at z = 0; poses without heading are left out."""
        quats = np.array([quat_of_heading(h) for h in path.pose[:, 2].tolist()]).reshape(-1, 4)
        return cls.of(path.t_ns, np.column_stack([path.pose[:, :2], np.zeros(len(path))]), quats)

    def from_above(self) -> Trajectory:
        """The path in the plane: x, y and heading."""
        headings = [heading_of_quat(q) for q in self.quat_xyzw]
        return Trajectory(self.t_ns, np.column_stack([self.position_m[:, :2], headings]))

    @property
    def rotation(self) -> Rotation:
        """The orientations, as one `Rotation` of n."""
        return Rotation.from_quat(self.quat_xyzw)

    def at(self, index: NDArray[np.int64]) -> SpatialPath:
        """Some of the poses."""
        return SpatialPath(self.t_ns[index], self.position_m[index], self.quat_xyzw[index])

    def __len__(self) -> int:
        return len(self.t_ns)


# ---------------------------------------------------------------------------- association


def associated(
    estimate: SpatialPath,
    reference: SpatialPath,
    *,
    offset_ns: int = 0,
    method: Method = "interpolate",
    max_gap_ns: int | None = None,
) -> tuple[SpatialPath, SpatialPath]:
    """The poses of the estimate that have a reference, and the reference at their times [m each].

    Rules are those of `evaluation.associate`; orientations are interpolated along the great arc (slerp). Times of
    both are the estimate's own.

    Raises:
        EvaluationError: fewer than 2 poses, or fewer than half of them, have a reference.
    """
    near = neighbours(estimate.t_ns + offset_ns, reference.t_ns, method, max_gap_ns)
    index = np.flatnonzero(near.known)
    planar.demand_enough(len(index), estimate.t_ns, reference.t_ns, offset_ns)
    first, last, share = near.before[index], near.after[index], near.share[index]
    a, b = reference.position_m[first], reference.position_m[last]
    turn = reference.rotation[first]
    between = turn * Rotation.from_rotvec(share[:, None] * (turn.inv() * reference.rotation[last]).as_rotvec())
    quats = np.where(share[:, None] == 0, reference.quat_xyzw[first], between.as_quat())
    truth = SpatialPath(estimate.t_ns[index], np.where(share[:, None] == 0, a, a + share[:, None] * (b - a)), quats)
    return estimate.at(index), truth


# ------------------------------------------------------------------------------- alignment


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialAlignment:
    """Brings the estimate over the reference: p ↦ scale · R p + t, orientations ↦ R q; `rotation` R is [3, 3]."""

    rotation: Floats
    translation_m: Floats
    scale: float = 1.0

    def __call__(self, path: SpatialPath) -> SpatialPath:
        """Move a path."""
        turn = Rotation.from_matrix(self.rotation)
        moved = self.scale * path.position_m @ self.rotation.T + self.translation_m
        return SpatialPath(path.t_ns, moved, (turn * path.rotation).as_quat())


def align(estimate: SpatialPath, reference: SpatialPath, fit: Fit) -> SpatialAlignment:
    """The transform that lays the estimate over the reference; poses of the same row belong together.

    ``none``: as they are. ``origin``: the first pose over the first pose. ``yaw``: turned about z and shifted, by
    least squares, for estimates that know gravity. ``se3``, ``sim3``: Umeyama's least squares over the positions,
    without and with scale. ``scale``: only that scale.

    Raises:
        ValueError: the positions lie on one line or in one point, so that they do not tell the rotation.
    """
    if fit == "none":
        return SpatialAlignment(rotation=np.eye(3), translation_m=np.zeros(3))
    if fit == "origin":
        turn = (reference.rotation[0] * estimate.rotation[0].inv()).as_matrix()
        return SpatialAlignment(rotation=turn, translation_m=reference.position_m[0] - turn @ estimate.position_m[0])
    if fit == "yaw":
        return _about_z(estimate, reference)
    rotation, translation, scale = umeyama(estimate.position_m, reference.position_m, with_scale=fit != "se3")
    if fit == "scale":
        rotation, translation = np.eye(3), np.zeros(3)
    return SpatialAlignment(rotation=rotation, translation_m=translation, scale=scale)


def umeyama(points: Floats, onto: Floats, *, with_scale: bool) -> tuple[Floats, Floats, float]:
    """Rotation [d, d], translation [d] and scale that bring points [n, d] over others by least squares.

    With a, b the centred points and Σ b aᵀ/n = U D Vᵀ: R = U S Vᵀ, S = diag(1, …, det U · det V),
    c = tr(D S)/σ_a², t = b̄ - c R ā. Umeyama (38)-(43).

    Raises:
        ValueError: the covariance's rank is below d - 1.
    """
    n, d = points.shape
    mean_a, mean_b = points.mean(axis=0), onto.mean(axis=0)
    a, b = points - mean_a, onto - mean_b
    u, strength, vt = np.linalg.svd(b.T @ a / n)
    if np.count_nonzero(strength > 1e-12 * max(float(np.sum(a**2) + np.sum(b**2)) / n, 1e-300)) < d - 1:
        raise ValueError("the positions lie on one line or in one point: they do not tell the rotation")
    sign = np.ones(d)
    sign[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation: Floats = (u * sign) @ vt
    scale = float((strength * sign).sum() / (np.sum(a**2) / n)) if with_scale else 1.0
    return rotation, mean_b - scale * rotation @ mean_a, scale


def _about_z(estimate: SpatialPath, reference: SpatialPath) -> SpatialAlignment:
    above = planar.align(estimate.from_above().pose, reference.from_above().pose)
    rotation = Rotation.from_euler("z", above.rotation_rad).as_matrix()
    height = float(np.mean(reference.position_m[:, 2] - estimate.position_m[:, 2]))
    return SpatialAlignment(rotation=rotation, translation_m=np.array([*above.translation_m, height]))


# ---------------------------------------------------------------------------------- errors


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """Errors of poses or motions [m]: distance, angle of rotation, and their statistics.

    `pairs` [m, 2] are the rows that a motion lies between; those of an absolute error are twice the row itself.
    """

    pairs: Pairs
    translation_m: Floats
    rotation_rad: Floats

    @property
    def translation(self) -> Statistics:
        """Statistics of the distances."""
        return Statistics.of(self.translation_m)

    @property
    def rotation(self) -> Statistics:
        """Statistics of the angles."""
        return Statistics.of(self.rotation_rad)


def absolute_error(estimate: SpatialPath, reference: SpatialPath) -> PoseErrors:
    """APE: distance of the positions, and angle of Q⁻¹ P, row by row; align the estimate first."""
    rows = np.arange(len(estimate))
    return PoseErrors(
        pairs=np.column_stack([rows, rows]),
        translation_m=np.linalg.norm(estimate.position_m - reference.position_m, axis=1),
        rotation_rad=np.asarray((reference.rotation.inv() * estimate.rotation).magnitude()),
    )


def relative_error(estimate: SpatialPath, reference: SpatialPath, pairs: Pairs) -> PoseErrors:
    """RPE: E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j) over pairs (i, j) [m, 2]: length of its translation, angle of its rotation."""
    (q_shift, q_turn), (p_shift, p_turn) = _motions(reference, pairs), _motions(estimate, pairs)
    return PoseErrors(
        pairs=pairs,
        translation_m=np.linalg.norm(p_shift - q_shift, axis=1),
        rotation_rad=np.asarray((q_turn.inv() * p_turn).magnitude()),
    )


def _motions(path: SpatialPath, pairs: Pairs) -> tuple[Floats, Rotation]:
    """Translations [m, 3] in the body's axes at i, and rotations, from pose i to pose j."""
    i, j = pairs.T
    back = path.rotation[i].inv()
    shift: Floats = back.apply(path.position_m[j] - path.position_m[i])
    return shift, back * path.rotation[j]


# ----------------------------------------------------------------------------------- pairs


def pairs_by_frames(count: int, delta: int, *, every: bool = True) -> Pairs:
    """Pairs `delta` rows apart, of `count` rows: from every row on, or one after the other.

    Raises:
        ValueError: `delta` is below 1.
    """
    if delta < 1:
        raise ValueError(f"delta must be 1 frame or more, not {delta}")
    first = np.arange(0, max(count - delta, 0), 1 if every else delta)
    return np.column_stack([first, first + delta])


def pairs_by_measure(along: Floats, delta: float, *, tolerance: float = 0.1, every: bool = True) -> Pairs:
    """Pairs that lie `delta` apart in an ascending measure `along` [n]: metres of path, or seconds.

    From every row on (``every``), the row whose distance is nearest to `delta`, if it is within `tolerance` · delta.
    Else one after the other: each pair begins where the one before ended, and ends at the first row where at least
    `delta` has passed. These are evo's pairs of metres.

    Raises:
        ValueError: `delta` is not positive.
    """
    if not delta > 0:
        raise ValueError(f"delta must be positive, not {delta}")
    if every:
        return _nearest_pairs(along, delta, tolerance)
    ends, last = [0], 0.0
    for i, value in enumerate(along[1:].tolist(), start=1):
        if value - last >= delta * (1 - 1e-12):
            ends.append(i)
            last = value
    return np.column_stack([ends[:-1], ends[1:]]).astype(np.int64).reshape(-1, 2)


def _nearest_pairs(along: Floats, delta: float, tolerance: float) -> Pairs:
    n = len(along)
    if n < 2:
        return np.empty((0, 2), dtype=np.int64)
    first = np.arange(n - 1)
    after = np.searchsorted(along, along[:-1] + delta).clip(first + 1, n - 1)
    before = np.maximum(after - 1, first + 1)
    wide, narrow = (np.abs(along[j] - along[:-1] - delta) for j in (after, before))
    second = np.where(narrow <= wide, before, after)
    # rows where nothing moved are equally near: the first of them counts
    second = np.maximum(np.searchsorted(along, along[second]), first + 1)
    close = np.minimum(wide, narrow) <= tolerance * delta
    return np.column_stack([first[close], second[close]]).astype(np.int64)


def path_lengths(path: SpatialPath) -> Floats:
    """Length of the path from the first pose to each one [n]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path.position_m, axis=0), axis=1))])


# ------------------------------------------------------------------------------------ drift


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentDrift:
    """Drift over segments of one length: mean error per metre, and how many segments there were."""

    length_m: float
    drift: float
    rad_per_m: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Drift as the KITTI odometry benchmark has it: means over all segments of all lengths.

    `drift` is a share of the path (times 100 for %), `rad_per_m` the angle per metre; NaN where the path is shorter
    than the shortest segment.
    """

    drift: float
    rad_per_m: float
    count: int
    by_length: tuple[SegmentDrift, ...]


def segment_drift(
    estimate: SpatialPath,
    reference: SpatialPath,
    *,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    step: int = KITTI_STEP,
) -> Drift:
    """Error of the motion over segments of the reference's path, per metre of the segment's length.

    A segment begins at every `step`-th row and ends at the first row where more than its length has passed.

    Raises:
        ValueError: `step` is below 1.
    """
    if step < 1:
        raise ValueError(f"step must be 1 or more, not {step}")
    along = path_lengths(reference)
    rows = []
    for length in lengths_m:
        first = np.arange(0, len(along), step)
        last = np.searchsorted(along, along[first] + length, side="right")
        inside = last < len(along)
        found = relative_error(estimate, reference, np.column_stack([first, last])[inside])
        rows.append((length, found.translation_m / length, found.rotation_rad / length))
    by_length = tuple(
        SegmentDrift(length_m=length, drift=_mean([shift]), rad_per_m=_mean([turn]), count=len(shift))
        for length, shift, turn in rows
    )
    return Drift(
        drift=_mean([shift for _, shift, _ in rows]),
        rad_per_m=_mean([turn for _, _, turn in rows]),
        count=sum(s.count for s in by_length),
        by_length=by_length,
    )


def _mean(values: Sequence[Floats]) -> float:
    together = np.concatenate(values) if values else np.empty(0)
    return float(together.mean()) if len(together) else math.nan
