"""One frame of a run, explained: verdict, every intermediate, what of it is unusual in this run, the neighbours.

How unusual a number is, is its robust z-score: its distance from the run's median in standard deviations, which come
of the median absolute deviation (times 1.4826), or where that is 0, of the mean absolute deviation (times 1.2533;
B. Iglewicz, D. Hoaglin, 1993). A number that drifts, such as a pose, is judged by its change since the frame before.
Of a field of many numbers the one that is furthest off counts; as one of many is always far off, a field is out of its
usual range only where that distance is itself unusual among the frames of the run.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import quantities
from pipelines.verdict import Severity, Verdict, flags
from workbench.diagnosis.finding import Finding
from workbench.runs import Run

Floats = NDArray[np.float64]

ODD_Z = 4.0
"""A number this many standard deviations off is out of its usual range: 1 of 16 000 of a normal distribution."""
SAMPLED = 1500
"""Frames that the medians are taken of, spread over the run."""
MARGIN, BLOCKS = 100, 16
"""Frames to both sides that are read of a long run, and how many blocks of frames elsewhere."""
DRIFTS = 0.2
"""A number drifts if its median change from frame to frame is below this share of its deviation."""
NOT_JUDGED = ("frame", "t_ns", "received_ns", "verdict", "alarms")


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """One field of the Step at a frame.

    Attributes:
        field: its name.
        unit: its unit, ``1`` for none.
        meaning: what it is.
        values: all its numbers at the frame, in the field's shape.
        at: index of the number that is judged: the most unusual one; () of a single number.
        value: that number.
        usual: its median over the run; of one that drifts, of its changes.
        z: its robust z-score, NaN where there is none, infinite where it never differs elsewhere.
        rarity: share of the run's frames in which any of the field's numbers is as far off.
        stands_out: z-score of that distance among those of the run's frames.
        drifts: whether its change since the frame before is judged, which is then `change`.
        change: since the frame before.
    """

    field: str
    unit: str
    meaning: str
    values: NDArray[Any]
    at: tuple[int, ...]
    value: float
    usual: float
    z: float
    rarity: float
    stands_out: float
    drifts: bool = False
    change: float = math.nan

    @property
    def odd(self) -> bool:
        """Whether it is out of its usual range in this run."""
        return abs(self.z) >= ODD_Z and (not self.at or self.stands_out >= ODD_Z)

    @property
    def name(self) -> str:
        """The field, with the index of the number that is judged."""
        return self.field + (f"[{','.join(map(str, self.at))}]" if self.at else "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbour:
    """A frame beside: number, seconds since the explained frame, verdict, and the oddest quantities there."""

    frame: int
    after_s: float
    verdict: str
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """Everything about one frame.

    Attributes:
        run: name of the run.
        estimator: name of its estimator.
        frame: number of the frame.
        t_ns: its sensor time.
        since_start_s: seconds since the run's first frame.
        frames: how many frames the run has.
        verdict: name and sentence of its verdict.
        severity: of the verdict.
        alarms: name and sentence of every alarm.
        error: errors against the reference, x, y, distance (m), heading (rad); None without one.
        harm_m: what the frame adds to the end-point error, NaN where that is not known.
        quantities: all fields, the most unusual first; last the lists, which are not judged.
        neighbours: the frames around.
        followed: the names of the quantities that `neighbours` tell.
        findings: the findings that it belongs to.
    """

    run: str
    estimator: str
    frame: int
    t_ns: int
    since_start_s: float
    frames: int
    verdict: tuple[str, str]
    severity: Severity
    alarms: tuple[tuple[str, str], ...]
    error: tuple[float, ...] | None
    harm_m: float
    quantities: tuple[Quantity, ...]
    neighbours: tuple[Neighbour, ...]
    followed: tuple[str, ...]
    findings: tuple[Finding, ...]

    @property
    def odd(self) -> tuple[Quantity, ...]:
        """The quantities out of their usual range."""
        return tuple(q for q in self.quantities if q.odd)


def explain(
    run: Run,
    frame: int,
    *,
    findings: Iterable[Finding] = (),
    harm_m: Floats | None = None,
    around: int = 3,
    followed: int = 4,
) -> Explanation:
    """Explain one frame of a run.

    Args:
        run: the run.
        frame: number of the frame.
        findings: those of the run's diagnosis.
        harm_m: what each frame adds to the end-point error [n], None where it is not known.
        around: how many frames to both sides are told as neighbours.
        followed: how many quantities are told of them.

    Raises:
        RecordingError: the run has no such frame, or its file cannot be read.
    """
    row = run.row_of(frame)
    verdict = run.verdicts[row]
    columns = run.sample(frame, margin=max(around, MARGIN), blocks=BLOCKS)
    at = int(np.searchsorted(columns["frame"], frame))
    rows = _sample_of(columns["frame"])
    judged = sorted((_judged(run, name, columns[name], at, rows) for name in run.fields), key=_order)
    judged += [_unjudged(run, name, values) for name, values in run.lists_at(frame).items()]
    told = [q for q in judged if q.odd and math.isfinite(q.value)][:followed]
    near = run.frames[max(0, row - around) : row + around + 1]
    return Explanation(
        run=run.name,
        estimator=run.estimator,
        frame=frame,
        t_ns=int(run.t_ns[row]),
        since_start_s=float(run.t_ns[row] - run.t_ns[0]) / 1e9,
        frames=len(run.frames),
        verdict=(str(verdict.name), verdict.sentence),
        severity=verdict.severity,
        alarms=tuple((str(flag.name), flag.sentence) for flag in flags(run.alarms[row])),
        error=_error_at(run, frame),
        harm_m=math.nan if harm_m is None else float(harm_m[row]),
        quantities=tuple(judged),
        neighbours=tuple(_neighbour(columns, int(k), at, told) for k in np.searchsorted(columns["frame"], near)),
        followed=tuple(q.name for q in told),
        findings=tuple(finding for finding in findings if finding.covers(frame)),
    )


def worst_frames(run: Run, count: int, harm_m: Floats | None = None) -> list[int]:
    """The `count` worst frames, the worst first: by harm where it is known, else by severity, then by oddness.

    Oddness is the number of alarms. Frames that are fine and did no harm are left out.
    """
    severity = np.array([verdict.severity for verdict in run.verdicts], float)
    rings = np.array([bin(int(alarms)).count("1") for alarms in run.alarms], float)
    harm = np.zeros(len(severity)) if harm_m is None else np.abs(np.nan_to_num(harm_m))
    order = np.lexsort((-rings, -severity, -harm))
    bad = (harm > 0) | (severity > Severity.NOTICE)
    return [int(frame) for frame in run.frames[order[bad[order]]][:count]]


def _sample_of(frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `SAMPLED` rows, evenly chosen among those whose row before is the frame before."""
    steps = np.diff(frames)
    if not len(steps):
        return np.zeros(0, np.int64)
    rows = 1 + np.flatnonzero(steps <= np.median(steps))
    chosen: NDArray[np.int64] = rows[np.unique(np.linspace(0, len(rows) - 1, SAMPLED).astype(int))]
    return chosen


def _judged(run: Run, name: str, column: NDArray[Any], row: int, rows: NDArray[np.int64]) -> Quantity:
    """One field at one row, with the most unusual of its numbers."""
    about = quantities(run.step_type)[name]
    flat = column.reshape(len(column), -1)
    here = flat[row].astype(float)
    found = Scores.none(len(here))
    if name not in NOT_JUDGED and len(flat) > 1 and len(here):
        found = scores(flat.astype(float, copy=False), row, rows)
    at = _most_unusual(found.z, here) if len(here) else None
    index = np.unravel_index(at, column.shape[1:]) if at is not None and column.ndim > 1 else ()
    return Quantity(
        field=name,
        unit=about["unit"],
        meaning=about["meaning"],
        values=column[row],
        at=tuple(int(i) for i in index),
        value=math.nan if at is None else float(here[at]),
        usual=math.nan if at is None else float(found.usual[at]),
        z=math.nan if at is None else float(found.z[at]),
        rarity=found.rarity,
        stands_out=found.stands_out,
        drifts=at is not None and bool(found.drifts[at]),
        change=math.nan if at is None else float(found.change[at]),
    )


def _unjudged(run: Run, name: str, values: NDArray[Any]) -> Quantity:
    """A list: its numbers are others in every frame, so that none of them has a usual value."""
    about = quantities(run.step_type)[name]
    nothing = math.nan
    return Quantity(
        field=name,
        unit=about["unit"],
        meaning=about["meaning"],
        values=values,
        at=(),
        value=nothing,
        usual=nothing,
        z=nothing,
        rarity=nothing,
        stands_out=nothing,
    )


def _most_unusual(z: Floats, values: Floats) -> int:
    if not np.isnan(z).all():
        return int(np.nanargmax(np.abs(z)))
    finite = np.flatnonzero(np.isfinite(values))
    return int(finite[0]) if len(finite) else 0


class Scores(NamedTuple):
    """Of each number [k] of a field at a frame: z-score, usual value, change, whether it drifts.

    `rarity` and `stands_out` are about the furthest of them, see `Quantity`.
    """

    z: Floats
    usual: Floats
    change: Floats
    drifts: NDArray[np.bool_]
    rarity: float
    stands_out: float

    @classmethod
    def none(cls, count: int) -> Scores:
        """Of a field that is not judged."""
        nothing = np.full(count, np.nan)
        return cls(nothing, nothing, nothing, np.zeros(count, bool), math.nan, math.nan)


def scores(column: Floats, row: int, rows: NDArray[np.int64]) -> Scores:
    """Judge a row of a field's numbers [n, k] by a sample of the others, `rows` from 1 on."""
    sample, step = column[rows], column[rows] - column[rows - 1]
    change = column[row] - column[row - 1] if row else np.full(column.shape[1], np.nan)
    middle, spread = _spread(sample)
    usual_step, step_spread = _spread(step)
    with np.errstate(invalid="ignore"):
        drifts = (np.abs(usual_step) + step_spread < DRIFTS * spread) & (step_spread > 0)
    usual, width = np.where(drifts, usual_step, middle), np.where(drifts, step_spread, spread)
    z = _z(np.where(drifts, change, column[row]), usual, width)
    others = np.abs(_z(np.where(drifts, step, sample), usual, width))
    furthest = np.nanmax(np.nan_to_num(others, posinf=np.inf), axis=1, keepdims=True)
    here = np.array([np.nanmax(np.abs(z)) if not np.isnan(z).all() else 0.0])
    stands_out = _z(here, *_spread(furthest))[0]
    return Scores(z, usual, change, drifts, float(np.mean(furthest >= here)), float(stands_out))


def _z(value: Floats, middle: Floats, spread: Floats) -> Floats:
    """Distances in spreads; 0 where the value is the usual one, infinite where the usual one never varies."""
    off = value - middle
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(off == 0, 0.0, off / spread)


def _spread(sample: Floats) -> tuple[Floats, Floats]:
    """Median and robust standard deviation of each column of [m, k]; NaN where nothing is known."""
    known = np.isfinite(sample).any(axis=0)
    middle, spread = np.full(sample.shape[1], np.nan), np.full(sample.shape[1], np.nan)
    if known.any():
        seen = np.where(np.isfinite(sample[:, known]), sample[:, known], np.nan)
        median = np.nanmedian if np.isnan(seen).any() else np.median  # the same, but much quicker
        middle[known] = median(seen, axis=0)
        off = np.abs(seen - middle[known])
        mad = 1.4826 * median(off, axis=0)
        spread[known] = np.where(mad > 0, mad, 1.2533 * np.nanmean(off, axis=0))
    return middle, spread


def _order(quantity: Quantity) -> tuple[float, float, str]:
    return (0.0 if quantity.odd else 1.0, -abs(quantity.z) if not math.isnan(quantity.z) else 1.0, quantity.field)


def _error_at(run: Run, frame: int) -> tuple[float, ...] | None:
    errors = run.errors
    if errors is None:
        return None
    at = np.flatnonzero(errors.frame == frame)
    return tuple(float(v) for v in errors.values[at[0]]) if len(at) else None


def _neighbour(columns: Mapping[str, NDArray[Any]], k: int, row: int, told: Sequence[Quantity]) -> Neighbour:
    return Neighbour(
        frame=int(columns["frame"][k]),
        after_s=float(columns["t_ns"][k] - columns["t_ns"][row]) / 1e9,
        verdict=str(Verdict(int(columns["verdict"][k])).name),
        values=tuple(float(columns[q.field][(k, *q.at)]) for q in told),
    )


# ------------------------------------------------------------------------------ as text


def number(value: float) -> str:
    """A number for people: four digits, whole ones as they are."""
    if math.isnan(value):
        return "–"
    if float(value).is_integer() and abs(value) < 1e7:
        return str(int(value))
    return f"{value:.4g}"


def unit_of(unit: str) -> str:
    """A unit for people: nothing where there is none."""
    return "" if unit == "1" else unit


def brief(quantity: Quantity) -> str:
    """All numbers of a quantity in a few: up to three as they are, else median and range."""
    values = np.asarray(quantity.values, float).ravel()
    if len(values) <= 3:
        return " ".join(number(v) for v in values)
    known = values[np.isfinite(values)]
    if not len(known):
        return "–"
    low, middle, high = known.min(), np.median(known), known.max()
    return number(low) if low == high else f"{number(middle)} ({number(low)}…{number(high)})"


def score(z: float) -> str:
    """A z-score for people."""
    return "never else" if math.isinf(z) else f"{z:+.1f} σ"
