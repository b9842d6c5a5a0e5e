"""Rules for runs of visual odometry: losses by their cause, what follows them, the start, the scale, the frames.

A loss is an interval of lost frames; its cause is looked for where it begins, the more specific one first. What was
found again is never trusted by itself: it hangs on one keyframe that looked alike, or on a map of its own.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pipelines.evaluation import path_lengths
from pipelines.semidirect.step import Feature, Stage
from pipelines.verdict import Severity, Verdict
from workbench.diagnosis.finding import Bools, Case, Evidence, Finding, Floats, Ints, Rule, spans_of

ESTIMATORS = ("semidirect", "ptam")
USED = Verdict.UNDECODABLE | Verdict.SIZE_CHANGED | Verdict.OUT_OF_ORDER | Verdict.DUPLICATE_FRAME
SCALE_PARTS = 8
"""Parts of the path whose lengths are held against the reference's, at most."""
CHORDS = 80
"""Straight pieces that the path is measured by, about."""
BEFORE_A_LOSS = 10
"""Frames before a loss that tell whether the ground had corners."""
USUAL_FRAMES = 61
"""What is usual at a frame is the median over so many about it."""


@dataclass(frozen=True)
class Signals:
    """The columns of a run that tell of failures, [n] each."""

    case: Case

    @functools.cached_property
    def stage(self) -> Ints:
        """`Stage` of each frame."""
        return np.asarray(self.case["stage"], np.int64)

    @functools.cached_property
    def lost(self) -> Bools:
        """Frames without a pose after a map had been there."""
        return np.asarray(self.stage == Stage.LOST)

    @functools.cached_property
    def accepted(self) -> Bools:
        """Frames with a pose of their own."""
        return np.asarray(self.case["accepted"], bool)

    @functools.cached_property
    def tracked(self) -> Floats:
        """Points that agree with the pose."""
        return np.asarray(self.case["tracked"], np.float64)

    @functools.cached_property
    def shares(self) -> Floats:
        """Share of each `Feature` among the points that were looked for [n, 9]; NaN where none was."""
        kinds = len(Feature)
        counts = np.array([np.bincount(np.asarray(row, np.int64), minlength=kinds) for row in self.case["outcome"]])
        counts = counts.reshape(-1, kinds).astype(np.float64)
        counts[:, Feature.NOT_TRIED] = 0
        with np.errstate(invalid="ignore"):
            return np.asarray(counts / counts.sum(axis=1, keepdims=True))

    @functools.cached_property
    def losses(self) -> list[Loss]:
        """The intervals of lost frames."""
        ends = np.flatnonzero(np.diff(np.concatenate([[0], self.lost.astype(np.int8), [0]])))
        return [Loss(int(a), int(b)) for a, b in ends.reshape(-1, 2)]

    def rings(self, flag: Verdict, row: int, before: int = 2) -> bool:
        """Whether an alarm rings at a row, or a little before."""
        return bool(self.case.rings(flag)[max(0, row - before) : row + 1].any())

    def usual_dt(self) -> float:
        """Median time between frames, s."""
        dt = np.asarray(self.case["dt_s"], np.float64)
        return float(np.nanmedian(dt)) if np.isfinite(dt).any() else math.nan


class Loss(NamedTuple):
    """Rows of lost frames, half-open."""

    first: int
    stop: int


# ------------------------------------------------------------------------------------ losses


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """Why the camera was lost: `is_it` looks at the first lost row; `evidence` tells its numbers."""

    name: str
    cause: str
    remedy: str
    thresholds: Mapping[str, float]
    is_it: Callable[[Signals, int, Mapping[str, float]], bool]
    evidence: Callable[[Signals, int, Mapping[str, float]], tuple[Evidence, ...]]


def _dt(signals: Signals, row: int) -> float:
    return float(np.asarray(signals.case["dt_s"], np.float64)[row])


def _gap(signals: Signals, row: int, bounds: Mapping[str, float]) -> bool:
    longer = _dt(signals, row) > bounds["usual_times"] * signals.usual_dt()
    return longer or signals.rings(Verdict.FRAME_GAP | USED, row)


def _dt_evidence(signals: Signals, row: int, bounds: Mapping[str, float]) -> tuple[Evidence, ...]:
    usual = signals.usual_dt()
    bound = bounds["usual_times"] * usual
    return (Evidence(name="dt_s", value=_dt(signals, row), unit="s", usual=usual, bound=bound),)


def _of_corners(signals: Signals) -> str:
    """The field that tells how many corners there are to make points of."""
    return "filters" if signals.case.estimator == "semidirect" else "corners"


def _corners(signals: Signals, row: int) -> float:
    """Their median over the frames with a pose before a row."""
    before = np.flatnonzero(signals.accepted[:row])[-BEFORE_A_LOSS:]
    found = np.asarray(signals.case[_of_corners(signals)], np.float64)[before]
    return float(np.median(found)) if len(found) else math.nan


def _usual_corners(signals: Signals) -> float:
    found = np.asarray(signals.case[_of_corners(signals)], np.float64)[signals.accepted]
    return float(np.median(found)) if len(found) else math.nan


def _share(feature: Feature, *more: Feature) -> Callable[[Signals, int, Mapping[str, float]], bool]:
    """Whether points that failed so are the largest part of those looked for."""

    def is_it(signals: Signals, row: int, bounds: Mapping[str, float]) -> bool:
        shares = signals.shares[row]
        return bool(shares[[feature, *more]].sum() > bounds["share"])

    return is_it


_UNLIKE = (Feature.NOT_CONVERGED, Feature.LEFT_IMAGE, Feature.OUTLIER)


def _unlike(signals: Signals, row: int, bounds: Mapping[str, float]) -> bool:
    """Whether the points are not where they were expected, or what is there does not look like them."""
    return signals.rings(Verdict.POINTS_UNLIKE, row, 0) or _share(*_UNLIKE)(signals, row, bounds)


def _share_evidence(feature: Feature, *more: Feature) -> Callable[..., tuple[Evidence, ...]]:
    def evidence(signals: Signals, row: int, bounds: Mapping[str, float]) -> tuple[Evidence, ...]:
        shares = signals.shares[:, [feature, *more]].sum(axis=1)
        usual = float(np.nanmedian(shares[signals.accepted])) if signals.accepted.any() else math.nan
        name = f"share of points {' or '.join(f.name.lower().replace('_', ' ') for f in (feature, *more))}"
        return (Evidence(name=name, value=float(shares[row]), usual=usual, bound=bounds["share"]),)

    return evidence


def _tracked_evidence(signals: Signals, row: int, bounds: Mapping[str, float]) -> tuple[Evidence, ...]:
    before = signals.tracked[signals.accepted]
    usual = float(np.median(before)) if len(before) else math.nan
    least = float(signals.case.settings.get("min_tracked", math.nan))
    return (Evidence(name="tracked", value=float(signals.tracked[row]), usual=usual, bound=least),)


CAUSES: tuple[Cause, ...] = (
    Cause(
        name="lost-frame-gap",
        cause="frames are missing or could not be used before the loss, so that the camera moved too far in between",
        remedy="look at the recording of the frames (dropped, size, stamps); a shorter gap or align_coarsest higher",
        thresholds={"usual_times": 1.6},
        is_it=_gap,
        evidence=_dt_evidence,
    ),
    Cause(
        name="lost-exposure",
        cause="the brightness jumped, which the alignment takes for motion",
        remedy="fix the exposure, or set illumination=true",
        thresholds={},
        is_it=lambda signals, row, bounds: signals.rings(Verdict.EXPOSURE_JUMP, row),
        evidence=_tracked_evidence,
    ),
    Cause(
        name="lost-blur",
        cause="the frame is blurred",
        remedy="a shorter exposure, more light, slower turns",
        thresholds={},
        is_it=lambda signals, row, bounds: signals.rings(Verdict.BLURRED, row),
        evidence=_tracked_evidence,
    ),
    Cause(
        name="lost-flat",
        cause="the ground below has too little texture for points to be told apart",
        remedy="fly higher, or lower corner_threshold and corner_min_score",
        thresholds={"share": 0.3, "corners": 0.35},
        is_it=lambda signals, row, bounds: (
            signals.rings(Verdict.LOW_TEXTURE, row)
            or _share(Feature.FLAT)(signals, row, bounds)
            or _corners(signals, row) < bounds["corners"] * _usual_corners(signals)
        ),
        evidence=lambda signals, row, bounds: (
            *_share_evidence(Feature.FLAT)(signals, row, bounds),
            Evidence(
                name=_of_corners(signals),
                value=_corners(signals, row),
                usual=_usual_corners(signals),
                bound=bounds["corners"] * _usual_corners(signals),
            ),
        ),
    ),
    Cause(
        name="lost-alignment",
        cause="the sparse alignment had no solution: the camera moved further between two frames than it can follow",
        remedy="more frames a second, a slower flight, or align_coarsest higher",
        thresholds={},
        is_it=lambda signals, row, bounds: signals.rings(Verdict.ALIGNMENT_FAILED, row, 0),
        evidence=_tracked_evidence,
    ),
    Cause(
        name="lost-unlike",
        cause="most points no longer look like their patches, or do not agree with one pose: blur, a moving thing, a "
        "surface that repeats itself, or a pose that is wrong",
        remedy="look at the image there; a shorter exposure, or more keyframes (keyframe_distance lower)",
        thresholds={"share": 0.4},
        is_it=_unlike,
        evidence=_share_evidence(*_UNLIKE),
    ),
    Cause(
        name="lost-drop",
        cause="far fewer points were found than in the frame before",
        remedy="look at the image there: something may cover the ground",
        thresholds={},
        is_it=lambda signals, row, bounds: signals.rings(Verdict.POINTS_DROPPED, row, 0),
        evidence=_tracked_evidence,
    ),
    Cause(
        name="lost-points",
        cause="the map ran out of points in view: it grows slower than the camera moves, or lies behind it",
        remedy="a slower flight, keyframe_distance lower, corner_threshold lower, or the preset accurate",
        thresholds={},
        is_it=lambda signals, row, bounds: True,
        evidence=_tracked_evidence,
    ),
)


def _causes_of(case: Case) -> dict[str, list[Loss]]:
    """Each loss under its first cause that fits."""
    signals = case.once(Signals)
    found: dict[str, list[Loss]] = {}
    for loss in signals.losses:
        cause = next(c for c in CAUSES if c.is_it(signals, loss.first, c.thresholds))
        found.setdefault(cause.name, []).append(loss)
    return found


def _find_losses(cause: Cause, case: Case, rule: Rule) -> Iterable[Finding]:
    signals, losses = case.once(Signals), case.once(_causes_of).get(cause.name, [])
    if not losses:
        return
    rows = np.zeros(len(case.frame), bool)
    for loss in losses:
        rows[loss.first : loss.stop] = True
    longest = max(losses, key=lambda loss: loss.stop - loss.first)
    seconds = float(case.t_ns[longest.stop - 1] - case.t_ns[longest.first]) / 1e9
    often = _times(len(losses))
    yield _finding(
        case, rule, rows, longest.first,
        f"Lost {often}, for {_frames(rows)} in all, at the longest from frame {case.frame[longest.first]} on "
        f"for {seconds:.3g} s; the last pose is held there.",
        cause.evidence(signals, longest.first, cause.thresholds),
    )  # fmt: skip


def _finding(case: Case, rule: Rule, rows: Bools, worst: int, sentence: str, evidence: tuple[Evidence, ...]) -> Finding:
    return Finding(
        rule=rule.name,
        severity=rule.severity,
        spans=spans_of(case.frame, rows),
        worst_frame=int(case.frame[worst]),
        sentence=sentence,
        evidence=evidence,
        cause=rule.cause,
        remedy=rule.remedy,
    )


def _frames(rows: Bools) -> str:
    count = int(rows.sum())
    return "1 frame" if count == 1 else f"{count} frames"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


# --------------------------------------------------------------------- start, found again, new map


def _start_failed(case: Case, rule: Rule) -> Iterable[Finding]:
    signals = case.once(Signals)
    starting = np.isin(signals.stage, (Stage.FIRST, Stage.STARTING))
    if signals.accepted.any() or not starting.any():
        return
    motion, matches = (np.asarray(case[name], np.float64) for name in ("start_motion_px", "start_matches"))
    known = np.where(starting & np.isfinite(motion), motion, -1.0)
    worst = int(np.argmax(known))
    bound = float(case.settings.get("start_motion_px", math.nan))
    yield _finding(
        case, rule, starting, worst,
        f"No map was ever started: corners were followed in {_frames(starting)} and moved "
        f"{max(float(known[worst]), 0.0):.3g} px at the most.",
        (
            Evidence(name="start_motion_px", value=float(known[worst]), unit="px", bound=bound),
            Evidence(name="start_matches", value=float(matches[worst])),
        ),
    )  # fmt: skip


def _after_relocalisation(case: Case, rule: Rule) -> Iterable[Finding]:
    signals = case.once(Signals)
    again = np.flatnonzero(signals.stage == Stage.RELOCALISED)
    if not len(again):
        return
    worst = int(again[0])
    since = np.asarray(case["relocalised_frames"], np.int64)
    doubtful = (since >= 0) & signals.accepted & (np.arange(len(since)) >= worst)
    correlation = np.asarray(case["relocalise_correlation"], np.float64)
    yield _finding(
        case, rule, doubtful, worst,
        f"Found again {_times(len(again))} (frame {', '.join(str(f) for f in case.frame[again][:4])}); the "
        f"{_frames(doubtful)} that follow hang on one keyframe that looked alike.",
        (
            Evidence(name="relocalise_correlation", value=float(correlation[worst]),
                     bound=float(case.settings.get("relocalise_correlation", math.nan))),
            Evidence(name="tracked", value=float(signals.tracked[worst])),
        ),
    )  # fmt: skip


def _new_map(case: Case, rule: Rule) -> Iterable[Finding]:
    number = np.asarray(case["map_number"], np.int64)
    later = number > 0
    if not later.any():
        return
    worst = int(np.argmax(later))
    yield _finding(
        case, rule, later, worst,
        f"{int(number.max()) + 1} maps: what was measured from frame {case.frame[worst]} on does not continue the path "
        "before in place, heading or scale.",
        (Evidence(name="map_number", value=float(number.max()), usual=0.0),),
    )  # fmt: skip


# ------------------------------------------------------------------------------------- scale


def _scale_unknown(case: Case, rule: Rule) -> Iterable[Finding]:
    signals = case.once(Signals)
    unknown = signals.accepted & (np.asarray(case["scale_known"], np.int64) == 0)
    if unknown.any():
        yield _finding(
            case, rule, unknown, int(np.argmax(unknown)),
            f"Nothing told the scale in {_frames(unknown)}: their lengths are in units of the first map.", (),
        )  # fmt: skip


def _height_drift(case: Case, rule: Rule) -> Iterable[Finding]:
    """Height over the map against the sensor's, where the ground is the same as at the start."""
    if case.estimator != "semidirect" or not case.settings.get("height_stream"):
        return
    sensor, mapped = (np.asarray(case[name], np.float64) for name in ("height_m", "map_height_m"))
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.where(case.once(Signals).accepted, mapped / sensor - 1, np.nan)
    bound = rule.thresholds["share"]
    drifted = np.abs(off) > bound
    if drifted.sum() < rule.thresholds["frames"]:
        return
    worst = int(np.nanargmax(np.abs(off)))
    yield _finding(
        case, rule, drifted, worst,
        f"The height over the map is off the sensor's by {100 * off[worst]:+.3g} % at the most, by more than "
        f"{100 * bound:g} % in {_frames(drifted)}.",
        (Evidence(name="map height / sensor's - 1", value=float(off[worst]), usual=float(np.nanmedian(off)),
                  bound=bound),),
    )  # fmt: skip


class Chords(NamedTuple):
    """The path in short straight pieces [m]: first and last row of each, its length, and the reference's."""

    first: Ints
    last: Ints
    length: Floats
    truth_m: Floats


def _chords(case: Case) -> Chords:
    """Pieces within one map, of frames with a pose and a reference, whose times are not in doubt.

    A piece is one of `CHORDS` of the path: so long that a frame's stamp does not matter in it.
    """
    signals = case.once(Signals)
    known = signals.accepted & np.isfinite(case.reference[:, :2]).all(axis=1)
    ends = np.flatnonzero(known)[:: max(1, int(known.sum()) // CHORDS)]
    first, last = ends[:-1], ends[1:]
    doubtful = np.cumsum(~known | case.rings(Verdict.FRAME_GAP | USED) | case.once(swapped_stamps))
    number = np.asarray(case["map_number"], np.int64)
    good = (doubtful[last] == doubtful[first]) & (number[last] == number[first])
    first, last = first[good], last[good]
    pose, truth = np.asarray(case["pose"], np.float64)[:, :2], case.reference[:, :2]
    mine, theirs = (np.linalg.norm(path[last] - path[first], axis=1) for path in (pose, truth))
    return Chords(first, last, mine, theirs)


def _parts(case: Case) -> tuple[Floats, list[Chords]]:
    """Lengths of parts of the path over the reference's, and the parts, none shorter than the scene is deep."""
    chords = case.once(_chords)
    depth = np.asarray(case["scene_depth_m"], np.float64)[chords.first]
    along = np.cumsum(chords.truth_m)
    if not np.isfinite(depth).any() or not along[-1] > 0:
        return np.zeros(0), []
    count = min(SCALE_PARTS, int(chords.length.sum() / np.nanmedian(depth)))
    if count < 1:
        return np.zeros(0), []
    part = np.minimum((along / along[-1] * count).astype(np.int64), count - 1)
    parts = [Chords(*(column[part == k] for column in chords)) for k in range(count)]
    parts = [one for one in parts if len(one.first) and one.truth_m.sum() > 0]
    return np.array([one.length.sum() / one.truth_m.sum() for one in parts]), parts


def _rows_of(case: Case, part: Chords) -> Bools:
    rows = np.zeros(len(case.frame), bool)
    for first, last in zip(part.first, part.last, strict=True):
        rows[first : last + 1] = True
    return rows


def _reference_scale(case: Case, rule: Rule) -> Iterable[Finding]:
    """Lengths of parts of the path against the reference's, relative to the first part."""
    scale, parts = case.once(_parts)
    if len(scale) < 2 or not scale[0] > 0:
        return
    off = scale / scale[0] - 1
    worst = int(np.argmax(np.abs(off)))
    if not abs(off[worst]) > rule.thresholds["share"]:
        return
    yield _finding(
        case, rule, _rows_of(case, parts[worst]), int(parts[worst].first[0]),
        f"The path grows or shrinks against the reference: by {100 * off[worst]:+.3g} % there since its beginning.",
        (Evidence(name="length / reference's, since the beginning", value=float(off[worst]), usual=0.0,
                  bound=rule.thresholds["share"]),),
    )  # fmt: skip


def _wrong_scale(case: Case, rule: Rule) -> Iterable[Finding]:
    """Lengths of the whole path against the reference's, where they are said to be metres."""
    scale, parts = case.once(_parts)
    metric = case.once(Signals).accepted & (np.asarray(case["scale_known"], np.int64) != 0)
    if not len(scale) or not metric.any():
        return
    off = float(np.median(scale)) - 1
    if not abs(off) > rule.thresholds["share"]:
        return
    yield _finding(
        case, rule, metric, int(parts[0].first[0]),
        f"The path is {100 * abs(off):.3g} % too {'long' if off > 0 else 'short'} against the reference, all along.",
        (Evidence(name="length / reference's - 1", value=off, usual=0.0, bound=rule.thresholds["share"]),),
    )  # fmt: skip


# -------------------------------------------------------------------------------- frames, points


def _usual(values: Floats) -> Floats:
    """The median about each row of values [n] or [n, k]; what is missing counts as nothing."""
    table = pd.DataFrame(values)
    return np.asarray(table.rolling(USUAL_FRAMES, center=True, min_periods=1).median()).reshape(values.shape)


def swapped_stamps(case: Case) -> Bools:
    """Frames [n] that go back where the path usually goes ahead, next to a leap, again and again.

    Of two frames that carry each other's stamps the later picture comes first, so that steps of -1 and +3 usual ones
    take turns. A camera that hovers steps back, too: a usual step of 0.2 % of the scene's depth is demanded.
    """
    signals = case.once(Signals)
    place = np.where(signals.accepted[:, None], np.asarray(case["position_m"], np.float64), np.nan)
    step = np.diff(place, axis=0, prepend=np.nan)
    usual = _usual(step)
    length = np.linalg.norm(usual, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (step * usual).sum(axis=1) / length**2
    back = (along < -0.3) & (length > 0.002 * np.asarray(case["scene_depth_m"], np.float64))
    leap = along > 1.7
    beside = np.concatenate([[False], leap[:-1]]) | np.concatenate([leap[1:], [False]])
    swapped = back & beside
    return swapped | np.concatenate([swapped[1:], [False]]) if swapped.sum() >= 2 else np.zeros(len(back), bool)


def _swapped(case: Case, rule: Rule) -> Iterable[Finding]:
    rows = case.once(swapped_stamps)
    if rows.any():
        yield _finding(
            case, rule, rows, int(np.argmax(rows)),
            f"The path goes back and leaps ahead, again and again, at {_frames(rows)}.", (),
        )  # fmt: skip


def _repeated(case: Case, rule: Rule) -> Iterable[Finding]:
    """Frames whose picture is that of the frame before, to the last grey level: noise never repeats itself."""
    if case.estimator != "semidirect":
        return
    grey, sharpness = (np.asarray(case[name], np.float64) for name in ("mean_grey", "sharpness"))
    same = (np.diff(grey, prepend=np.nan) == 0) & (np.diff(sharpness, prepend=np.nan) == 0) & (sharpness > 0)
    if same.any():
        evidence = Evidence(name="mean grey level", value=float(grey[np.argmax(same)]), unit="grey")
        yield _finding(
            case, rule, same, int(np.argmax(same)), f"{_frames(same)} had the picture of the frame before.", (evidence,)
        )


def _sharpness(case: Case, rule: Rule) -> Iterable[Finding]:
    """Frames that are sharper, or less sharp, than those about them."""
    if case.estimator != "semidirect":
        return
    sharpness = np.asarray(case["sharpness"], np.float64)
    lit = np.asarray(case["mean_grey"], np.float64) > rule.thresholds["grey"]
    usual = _usual(sharpness)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.maximum(sharpness / usual, 1e-3)
    bound = rule.thresholds["ratio"]
    beyond = ratio < bound if bound < 1 else ratio > bound
    rows = lit & beyond & ~case.rings(Verdict.EXPOSURE_JUMP) & ~case.once(Signals).lost
    if not rows.any():
        return
    worst = int(np.argmax(np.where(rows, np.abs(np.log(ratio)), -1.0)))
    yield _finding(
        case, rule, rows, worst,
        f"The sharpness was {ratio[worst]:.3g} of the usual at the worst, in {_frames(rows)}.",
        (Evidence(name="sharpness", value=float(sharpness[worst]), usual=float(usual[worst]),
                  bound=float(bound * usual[worst])),),
    )  # fmt: skip


def _ringing(flags: Verdict, what: str, case: Case, rule: Rule) -> Iterable[Finding]:
    """Frames with one of some alarms while the camera was not lost; `what` says it with a place for their number."""
    signals = case.once(Signals)
    rows = case.rings(flags) & ~signals.lost
    if rows.any():
        dt = np.asarray(case["dt_s"], np.float64)
        worst = int(np.argmax(np.where(rows, np.nan_to_num(dt), -1)))
        evidence = Evidence(name="dt_s", value=float(dt[worst]), unit="s", usual=signals.usual_dt())
        yield _finding(case, rule, rows, worst, what.format(_frames(rows)), (evidence,))


def _few_points(case: Case, rule: Rule) -> Iterable[Finding]:
    """Frames that were near to a loss."""
    signals, least = case.once(Signals), case.settings.get("min_tracked")
    if least is None:
        return
    bound = rule.thresholds["times"] * float(least)
    rows = signals.accepted & (signals.tracked < bound) & (signals.stage == Stage.TRACKED)
    if not rows.any():
        return
    worst = int(np.argmin(np.where(rows, signals.tracked, np.inf)))
    usual = float(np.median(signals.tracked[signals.accepted]))
    yield _finding(
        case, rule, rows, worst,
        f"{_frames(rows)} had fewer than {bound:.0f} points, the least {signals.tracked[worst]:.0f}; below "
        f"{least} the camera is lost.",
        (Evidence(name="tracked", value=float(signals.tracked[worst]), usual=usual, bound=bound),),
    )  # fmt: skip


def _drift(case: Case, rule: Rule) -> Iterable[Finding]:
    """The frames that add most to the end-point error, where that is much of the path."""
    harm = np.nan_to_num(case.harm_m)
    places = case.reference[np.isfinite(case.reference[:, :2]).all(axis=1), :2]
    if len(places) < 2 or not np.isfinite(case.harm_m).any():
        return
    total, length = float(harm.sum()), float(path_lengths(places)[-1])
    if not total > rule.thresholds["share"] * length:
        return
    order = np.argsort(-harm)
    enough = int(np.searchsorted(np.cumsum(harm[order]), total / 2)) + 1
    rows = np.zeros(len(harm), bool)
    rows[order[:enough]] = True
    worst = int(order[0])
    yield _finding(
        case, rule, rows, worst,
        f"Half of the error at the end, which is {100 * total / length:.3g} % of the path, comes of {_frames(rows)}.",
        (Evidence(name="harm", value=float(harm[worst]), unit="m", usual=float(np.nanmedian(case.harm_m))),),
    )  # fmt: skip


# --------------------------------------------------------------------------------------- rules

_OTHERS: tuple[dict[str, Any], ...] = (
    {
        "name": "start-failed",
        "severity": Severity.ERROR,
        "cause": "the camera moved too little or only turned, corners were lost on the way, or the frames lie too far "
        "apart to follow them",
        "remedy": "begin where the camera moves sideways; look at start_motion_px, corner_threshold and at the frame "
        "rate",
        "thresholds": {},
        "find": _start_failed,
    },
    {
        "name": "after-relocalisation",
        "severity": Severity.WARNING,
        "cause": "after a loss a keyframe that looks alike was taken for the place; on a surface that repeats itself "
        "that can be another one",
        "remedy": "do not trust lengths across the loss; mend its cause, or raise relocalise_correlation",
        "thresholds": {},
        "find": _after_relocalisation,
    },
    {
        "name": "new-map",
        "severity": Severity.ERROR,
        "cause": "lost for longer than restart_s, a new map was begun where the last pose was held",
        "remedy": "mend the cause of the loss; take each map's path by itself (map_number)",
        "thresholds": {},
        "find": _new_map,
    },
    {
        "name": "scale-unknown",
        "severity": Severity.NOTICE,
        "cause": "one camera alone cannot tell lengths, and no height, speed or position was given",
        "remedy": "--height STREAM, --set height_m=…, or --odometry STREAM",
        "thresholds": {},
        "find": _scale_unknown,
    },
    {
        "name": "scale-drift",
        "severity": Severity.WARNING,
        "cause": "each new point hangs on those before it, and errors of their depth add up; or the ground below is "
        "not as high as at the start",
        "remedy": "the preset accurate (local bundle adjustment), or more keyframes",
        "thresholds": {"share": 0.03, "frames": 10},
        "find": _height_drift,
    },
    {
        "name": "scale-drift-by-reference",
        "severity": Severity.WARNING,
        "cause": "each new point hangs on those before it, and errors of their depth add up",
        "remedy": "the preset accurate (local bundle adjustment), or more keyframes",
        "thresholds": {"share": 0.03},
        "find": _reference_scale,
    },
    {
        "name": "wrong-scale",
        "severity": Severity.WARNING,
        "cause": "the focal length is wrong, or what tells the scale: unit or place of the height sensor, the speed",
        "remedy": "calibrate the camera; compare the height with the true one, mend height_offset_m or the unit",
        "thresholds": {"share": 0.05},
        "find": _wrong_scale,
    },
    {
        "name": "swapped-stamps",
        "severity": Severity.WARNING,
        "cause": "neighbouring frames carry each other's stamps",
        "remedy": "look at the recording of the frames; --clock log where only their stamps are wrong",
        "thresholds": {},
        "find": _swapped,
    },
    {
        "name": "repeated-frames",
        "severity": Severity.WARNING,
        "cause": "the camera or its driver sent a picture again with a new stamp: the motion stands still, then leaps",
        "remedy": "look at the recording of the frames: load of the machine, driver of the camera",
        "thresholds": {},
        "find": _repeated,
    },
    {
        "name": "blur",
        "severity": Severity.NOTICE,
        "cause": "the pictures are less sharp than those about them: motion while the shutter was open, or the focus",
        "remedy": "a shorter exposure, more light, slower turns",
        "thresholds": {"ratio": 0.75, "grey": 5.0},
        "find": _sharpness,
    },
    {
        "name": "image-noise",
        "severity": Severity.NOTICE,
        "cause": "the pictures are rougher than those about them: noise of a high gain, interference, damaged pictures",
        "remedy": "more light, a lower gain; look at the pictures there",
        "thresholds": {"ratio": 1.5, "grey": 5.0},
        "find": _sharpness,
    },
    {
        "name": "frame-gap",
        "severity": Severity.WARNING,
        "cause": "frames are missing in the log, or its stamps are irregular",
        "remedy": "look at the recording of the frames: load of the machine, disk, network",
        "thresholds": {},
        "find": functools.partial(_ringing, Verdict.FRAME_GAP, "The time since the frame before is long at {}."),
    },
    {
        "name": "frames-skipped",
        "severity": Severity.WARNING,
        "cause": "frames are damaged, repeated, out of order or of another size",
        "remedy": "workbench inspect tells what is wrong with the recording",
        "thresholds": {},
        "find": functools.partial(_ringing, USED, "{} could not be used."),
    },
    {
        "name": "exposure",
        "severity": Severity.NOTICE,
        "cause": "the brightness of the image jumps, which the alignment takes for motion",
        "remedy": "fix the exposure, or set illumination=true",
        "thresholds": {},
        "find": functools.partial(_ringing, Verdict.EXPOSURE_JUMP, "The mean grey level jumped at {}."),
    },
    {
        "name": "few-points",
        "severity": Severity.NOTICE,
        "cause": "the map has few points in view: a fast flight, little texture, or a strong turn",
        "remedy": "keyframe_distance or corner_threshold lower, max_features higher",
        "thresholds": {"times": 1.3},
        "find": _few_points,
    },
    {
        "name": "drift",
        "severity": Severity.WARNING,
        "cause": "the motion of these frames is off against the reference",
        "remedy": "look at their points and residuals; the preset accurate",
        "thresholds": {"share": 0.01},
        "find": _drift,
    },
)


def _rules() -> Iterator[Rule]:
    for estimator in ESTIMATORS:
        for cause in CAUSES:
            yield Rule(
                name=cause.name,
                estimator=estimator,
                severity=Severity.ERROR,
                cause=cause.cause,
                remedy=cause.remedy,
                thresholds=cause.thresholds,
                find=functools.partial(_find_losses, cause),
            )
        for other in _OTHERS:
            yield Rule(estimator=estimator, **other)


RULES: tuple[Rule, ...] = tuple(_rules())
