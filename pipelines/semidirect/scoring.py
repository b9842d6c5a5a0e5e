"""How well a visual odometry did on a flight whose truth is known: errors along the path, scale, losses, the map.

An odometry of one camera knows its world up to a similarity, so that errors are those after one least-squares Sim(3)
over all poses that it stands by (`accepted`); poses that are held while lost are no claims and are not scored, but
counted. The measures are those of paper C's Figs 3-5 and of C. Forster et al., "SVO", ICRA 2014 (relative errors per
second, scale along the path). Poses are `world_T_cam`, m; ground truth has a pose for every frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from pipelines.evaluation import Statistics
from pipelines.semidirect.step import Stage, VisualStep
from pipelines.simulation.sensors import distance_to_ground
from pipelines.spatial import (
    SpatialAlignment,
    SpatialPath,
    absolute_error,
    align,
    pairs_by_measure,
    path_lengths,
    relative_error,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ground = Callable[[Floats, Floats], Floats]
"""Height of the true ground, m [n], at world x and y, m [n]."""

RPE_S = 1.0
SCALE_WINDOW_M = 2.0
MOST_SCALES = 400
"""Places along the path that the line of the scale is laid through."""
OUTLIER = 0.05
"""A map point is an outlier when it is farther off the true ground than this share of the camera's height."""
NOTICE_FRAMES = 10
WRONG = 0.5
"""A claimed motion over `NOTICE_FRAMES` is wrong when it is off by more than this share of the true one …"""
WRONG_M = 0.02
"""… and by more than this."""


@dataclass(frozen=True, slots=True)
class Track:
    """What an odometry said, frame by frame: times int64 [n], whether it stands by the pose, poses, what it did."""

    t_ns: NDArray[np.int64]
    accepted: Bools
    position_m: Floats
    quat_xyzw: Floats
    stage: NDArray[np.int64]
    map_number: NDArray[np.int64]

    def claimed(self) -> NDArray[np.int64]:
        """Rows [m] of the poses that it stands by."""
        return np.flatnonzero(self.accepted)


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """A flight's scores; NaN where a number could not be had, and `note` says why.

    Attributes:
        frames: of the flight.
        accepted: frames whose pose it stands by.
        first: the first of these, -1 for none.
        losses: how often it was lost after it had started.
        lost_frames: frames after the first pose that it does not stand by.
        relocalisations: how often it found itself again in its map.
        maps: maps that it began.
        path_m: true length of the whole flight.
        covered: share of the path along which it stands by its poses.
        longest_unnoticed: most frames in a row that it stands by though its motion is wrong.
        ate_m: rmse of the positions after Sim(3), m.
        ate_share: that by the length of the flight.
        worst_share: largest error, by the length of the flight.
        attitude_rad: rmse of the attitude after Sim(3).
        attitude_worst_rad: its largest error.
        rpe_mps: rmse of the position's relative error over a second.
        rpe_median_mps: its median.
        rpe_radps: rmse of the attitude's relative error over a second.
        rpe_median_radps: its median.
        scale: metres per unit of the estimate, by Sim(3).
        scale_drift: growth of the estimate's scale from the begin to the end.
        note: what could not be had.
    """

    frames: int
    accepted: int
    first: int
    losses: int
    lost_frames: int
    relocalisations: int
    maps: int
    path_m: float
    covered: float
    longest_unnoticed: int = 0
    ate_m: float = math.nan
    ate_share: float = math.nan
    worst_share: float = math.nan
    attitude_rad: float = math.nan
    attitude_worst_rad: float = math.nan
    rpe_mps: float = math.nan
    rpe_median_mps: float = math.nan
    rpe_radps: float = math.nan
    rpe_median_radps: float = math.nan
    scale: float = math.nan
    scale_drift: float = math.nan
    note: str = ""


@dataclass(frozen=True, slots=True)
class Curves:
    """Along the flight, for the accepted frames [m]: true path, errors after Sim(3); and the scale's own places [k].

    `scale` is the estimate's over the true one, 1 in the median.
    """

    path_m: Floats
    position_m: Floats
    attitude_rad: Floats
    scale_path_m: Floats
    scale: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class MapErrors:
    """Points that were ever in the map, and those of them that are wrong.

    Attributes:
        points: that were in the map, each at the last place that it was given.
        outliers: farther than `OUTLIER` heights off the true ground after the trajectory's Sim(3).
        judged: that were seen by a camera whose true pose is known.
        misplaced: of these, whose depth is off that of the others by more than `OUTLIER`: free of the path's drift.
    """

    points: int
    outliers: int
    judged: int
    misplaced: int

    @property
    def share(self) -> float:
        """Outliers by points, NaN without points."""
        return self.outliers / self.points if self.points else math.nan

    @property
    def misplaced_share(self) -> float:
        """Misplaced by judged points, NaN without these."""
        return self.misplaced / self.judged if self.judged else math.nan


# ------------------------------------------------------------------------------ trajectory


def losses(accepted: Bools, stage: NDArray[np.int64]) -> int:
    """How often an odometry that had a pose says LOST, a frame that cannot be used being no loss."""
    told = accepted | (stage == Stage.LOST)
    known = accepted[told]
    return int(np.count_nonzero(known[:-1] & ~known[1:]))


def local_scale(estimate: SpatialPath, truth: SpatialPath, window_m: float = SCALE_WINDOW_M) -> tuple[Floats, Floats]:
    """Scale of the estimate along the true path: ratio of its chords to the true ones over windows of that length.

    Returns:
        The middle of each window on the true path, m [k], and the ratio [k].
    """
    along = path_lengths(truth)
    pairs = pairs_by_measure(along, window_m)
    pairs = pairs[:: max(1, -(-len(pairs) // MOST_SCALES))]
    i, j = pairs.T
    chord = np.linalg.norm(truth.position_m[j] - truth.position_m[i], axis=1)
    ours = np.linalg.norm(estimate.position_m[j] - estimate.position_m[i], axis=1)
    good = (chord > 0) & (ours > 0)
    return (along[i] + along[j])[good] / 2, ours[good] / chord[good]


def scale_drift(path_m: Floats, ratio: Floats, length_m: float) -> float:
    """Growth of a scale over a length: exp(slope · length) - 1, by the Theil-Sen line through log ratio [k].

    -0.04: things at the end are 4 % smaller than those at the begin. NaN for less than two places.
    """
    if len(path_m) < 2 or np.ptp(path_m) == 0:
        return math.nan
    return math.expm1(float(theilslopes(np.log(ratio), path_m).slope) * length_m)


def longest_unnoticed(rows: NDArray[np.int64], estimate: SpatialPath, truth: SpatialPath) -> int:
    """Most frames in a row over which an aligned estimate is wrong, though accepted.

    Args:
        rows: frame numbers of the poses [m].
        estimate: aligned, of these rows.
        truth: of these rows.
    """
    i = np.flatnonzero(rows[NOTICE_FRAMES:] - rows[:-NOTICE_FRAMES] == NOTICE_FRAMES)
    ours, true = (p.position_m[i + NOTICE_FRAMES] - p.position_m[i] for p in (estimate, truth))
    off = np.linalg.norm(ours - true, axis=1)
    wrong = np.zeros(int(rows[-1]) + 2 if len(rows) else 1, np.bool_)
    wrong[rows[i][off > np.maximum(WRONG * np.linalg.norm(true, axis=1), WRONG_M)]] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wrong, [False]]).astype(np.int8)))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def scored(track: Track, truth: SpatialPath) -> tuple[Accuracy, Curves, SpatialAlignment | None]:
    """Scores of a flight, its curves, and the Sim(3) that lays the estimate over the truth.

    Args:
        track: what the odometry said of each frame.
        truth: the camera's pose in each frame, in the same rows.

    Raises:
        ValueError: the two have different lengths.
    """
    if len(track.t_ns) != len(truth):
        raise ValueError(f"{len(track.t_ns)} steps for {len(truth)} true poses: each frame needs both")
    rows, along = track.claimed(), path_lengths(truth)
    fit, note = _fit(track, truth, rows)
    accuracy, curves = _unknown(track, along, note), Curves(*(np.empty(0),) * 5)
    if fit is None:
        return accuracy, curves, None
    kept, raw = truth.at(rows), SpatialPath(track.t_ns[rows], track.position_m[rows], track.quat_xyzw[rows])
    aligned = fit(raw)
    absolute = absolute_error(aligned, kept)
    relative = relative_error(aligned, kept, pairs_by_measure(1e-9 * (raw.t_ns - raw.t_ns[0]), RPE_S, tolerance=0.02))
    places, ratio = local_scale(aligned, kept)
    places = places + along[rows[0]]
    accuracy = replace(
        accuracy,
        longest_unnoticed=longest_unnoticed(rows, aligned, kept),
        ate_m=absolute.translation.rmse,
        ate_share=absolute.translation.rmse / accuracy.path_m,
        worst_share=absolute.translation.max / accuracy.path_m,
        attitude_rad=absolute.rotation.rmse,
        attitude_worst_rad=absolute.rotation.max,
        rpe_mps=relative.translation.rmse / RPE_S,
        rpe_median_mps=relative.translation.median / RPE_S,
        rpe_radps=relative.rotation.rmse / RPE_S,
        rpe_median_radps=relative.rotation.median / RPE_S,
        scale=fit.scale,
        scale_drift=scale_drift(places, ratio, accuracy.covered * accuracy.path_m),
    )
    middle = float(np.median(ratio)) if len(ratio) else 1.0
    return accuracy, Curves(along[rows], absolute.translation_m, absolute.rotation_rad, places, ratio / middle), fit


def _unknown(track: Track, along: Floats, note: str) -> Accuracy:
    """The counts of a flight, whose errors are not known; `along` [n] is the true path."""
    rows, length = track.claimed(), float(along[-1])
    stood_by = float(np.diff(along)[track.accepted[1:] & track.accepted[:-1]].sum())
    return Accuracy(
        frames=len(along),
        accepted=len(rows),
        first=int(rows[0]) if len(rows) else -1,
        losses=losses(track.accepted, track.stage),
        lost_frames=len(along) - int(rows[0]) - len(rows) if len(rows) else 0,
        relocalisations=int(np.count_nonzero(track.stage == Stage.RELOCALISED)),
        maps=len(np.unique(track.map_number[rows])),
        path_m=length,
        covered=stood_by / length if length > 0 else math.nan,
        note=note,
    )


def _fit(track: Track, truth: SpatialPath, rows: NDArray[np.int64]) -> tuple[SpatialAlignment | None, str]:
    """The Sim(3) over the accepted poses, or why there is none."""
    if len(rows) < 3:
        return None, "it has no poses to be judged"
    raw = SpatialPath(track.t_ns[rows], track.position_m[rows], track.quat_xyzw[rows])
    try:
        return align(raw, truth.at(rows), "sim3"), ""
    except ValueError as error:
        return None, str(error)


# ------------------------------------------------------------------------------------- map


def depth_ratios(
    points_m: Floats, turn: Floats, place: Floats, true_turn: Floats, true_place: Floats, ground: Ground
) -> Floats:
    """Estimated by true distances [n] of points along their rays, NaN for points behind the camera.

    A point's ray in camera axes is that of the estimated camera; the same ray of the true camera meets the ground at
    the true distance. So neither the drift of the path nor that of the scale counts, only the point's own depth.

    Args:
        points_m: in the estimate's world [n, 3].
        turn: rotation [3, 3] from the estimated camera's axes to its world.
        place: of the estimated camera [3].
        true_turn: of the true camera.
        true_place: of the true camera.
        ground: the true ground.
    """
    in_cam = (points_m - place) @ turn
    distance = np.linalg.norm(in_cam, axis=1)
    ahead = (in_cam[:, 2] > 0) & (distance > 0)
    ways = (in_cam[ahead] / distance[ahead, None]) @ true_turn.T
    true = distance_to_ground(np.broadcast_to(true_place, ways.shape), ways, ground)
    ratios = np.full(len(points_m), np.nan)
    ratios[ahead] = np.where(np.isfinite(true), distance[ahead] / true, np.nan)
    return ratios


class MapNotes:
    """Takes note of the places that map points are given, and of their depths in the frames that give them."""

    def __init__(self, ground: Ground, view_tangent: tuple[float, float]) -> None:
        """`view_tangent`: |x/z| and |y/z| of the points that a camera sees at most."""
        self._ground, self._view = ground, view_tangent
        self._place: dict[int, Floats] = {}
        self._ratio: dict[int, Floats] = {}

    def add(self, step: VisualStep, turn: Floats, true_turn: Floats, true_place: Floats) -> None:
        """Note what a step tells of its map; `turn` is that of its pose, the others are the true camera's."""
        if not len(step.map_id):
            return
        _put(self._place, step.map_number, step.map_id, step.map_point_m)
        if not step.accepted:
            return
        in_cam = (step.map_point_m - step.position_m) @ turn
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = (in_cam[:, 2] > 0) & np.all(np.abs(in_cam[:, :2] / in_cam[:, 2:]) <= self._view, axis=1)
        if not np.any(seen):
            return
        ratios = depth_ratios(step.map_point_m[seen], turn, step.position_m, true_turn, true_place, self._ground)
        _put(self._ratio, step.map_number, step.map_id[seen], (ratios / np.nanmedian(ratios))[:, None])

    def errors(self, fit: SpatialAlignment | None, height_m: float) -> MapErrors:
        """How many points are wrong; without a Sim(3) all of them are off the ground.

        Args:
            fit: lays the estimate over the truth.
            height_m: the camera's usual height.
        """
        points, ratios = _known(self._place, 3), _known(self._ratio, 1)[:, 0]
        off = np.full(len(points), np.inf)
        if fit is not None:
            moved = fit.scale * points @ fit.rotation.T + fit.translation_m
            off = np.abs(moved[:, 2] - self._ground(moved[:, 0], moved[:, 1]))
        return MapErrors(
            points=len(points),
            outliers=int(np.count_nonzero(off > OUTLIER * height_m)),
            judged=len(ratios),
            misplaced=int(np.count_nonzero(np.abs(ratios - 1) > OUTLIER)),
        )


def _put(kept: dict[int, Floats], number: int, ids: NDArray[np.int64], values: Floats) -> None:
    """Set the rows `ids` of what is kept of a map; rows that were never set are NaN."""
    table, size = kept.get(number, np.empty((0, values.shape[1]))), int(ids.max()) + 1
    if size > len(table):
        larger = np.full((max(size, 2 * len(table)), values.shape[1]), np.nan)
        larger[: len(table)] = table
        kept[number] = table = larger
    table[ids] = values


def _known(kept: dict[int, Floats], width: int) -> Floats:
    """All rows [n, width] that were set."""
    rows = np.concatenate([np.empty((0, width)), *kept.values()])
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


# ------------------------------------------------------------------------------------ work


def tracking_ms(cpu_ms: Floats, stage_ms: Floats) -> Floats:
    """CPU time [n] of the tracking of each frame: that of the whole step, less the mapping's.

    Args:
        cpu_ms: CPU time of the step's thread [n].
        stage_ms: that of its stages [n, k], the last of which is the mapping; NaN where there was none, [n, 0] for a
            method that does not tell them.
    """
    return cpu_ms - np.nan_to_num(stage_ms[:, -1]) if stage_ms.shape[1] else cpu_ms


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """CPU time of the tracking of a frame, ms: median, 95 % of the frames, mean; and that of all with the mapping."""

    median_ms: float
    most_ms: float
    mean_ms: float
    whole_mean_ms: float

    @classmethod
    def of(cls, cpu_ms: Floats, stage_ms: Floats) -> Work:
        """Of the frames of a flight, see `tracking_ms`."""
        tracking = tracking_ms(cpu_ms, stage_ms)
        usual = Statistics.of(tracking)
        return cls(
            median_ms=usual.median,
            most_ms=float(np.percentile(tracking, 95)) if len(tracking) else math.nan,
            mean_ms=usual.mean,
            whole_mean_ms=Statistics.of(np.asarray(cpu_ms)).mean,
        )

    @property
    def frames_per_s(self) -> float:
        """By the median."""
        return 1e3 / self.median_ms
