"""Runs side by side: their metrics, where they part, how far apart they are, and one recording with all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.planar import wrap_angles
from readers.streams import RecordingError, WorkbenchError
from workbench.metrics import metrics
from workbench.runs import Run
from workbench.schema import CLOCKED, Archetype

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

APART_M = (0.001, 0.01, 0.1, 1.0)
"""Distances at which two paths are said to have parted."""
APART_SHARE = (0.001, 0.01, 0.1)
"""Relative differences at which two runs' ranges are said to have parted."""


class CompareError(WorkbenchError):
    """Runs that cannot be compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Parting:
    """Where a run parts from the first one.

    Attributes:
        run: name of the run, and of the one that it is compared with.
        other: that one.
        frames: how many frames both have.
        identical: whether every number that both have is equal, bit for bit, but for times that a clock tells.
        first_different: the first frame at which any number differs, -1 for none.
        field: a field that differs there.
        first_verdict: the first frame with another verdict, -1 for none.
        verdicts_differ: how many frames have another verdict.
        apart: bound (m, or a share of the range) → the first frame that is further apart, -1 for none.
        difference: of each common frame [m, 2]: distance (m), heading (rad); of ranges: largest and median relative
            difference over the landmarks that both carry.
        frame: the common frames [m].
        t_ns: their sensor times [m].
        of_paths: whether they have paths; else it is ranges that differ.
    """

    run: str
    other: str
    frames: int
    identical: bool
    first_different: int
    field: str
    first_verdict: int
    verdicts_differ: int
    apart: Mapping[float, int]
    difference: Floats
    frame: Ints
    t_ns: Ints
    of_paths: bool

    @property
    def unit(self) -> str:
        """Of the bounds in `apart`."""
        return "m" if self.of_paths else "of a range"

    def largest(self) -> dict[str, float]:
        """The largest differences by name; those that are known nowhere are left out."""
        names = ("largest distance, m", "largest turn, rad") if self.of_paths else ("largest", "median at its largest")
        sizes = np.abs(self.difference)
        known = np.atleast_1d(np.isfinite(sizes).any(axis=0))
        return {name: float(np.nanmax(sizes[:, k])) for k, name in enumerate(names) if known[k]}


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Runs side by side.

    Attributes:
        runs: their names.
        one_mission: whether they are of the same recording.
        metrics: name → one number a run, NaN where a run does not have it.
        settings: settings that are not the same everywhere: name → one value a run, None where it is not set.
        partings: of every run but the first from the first one; empty for different missions or estimators.
    """

    runs: tuple[str, ...]
    one_mission: bool
    metrics: Mapping[str, tuple[float, ...]]
    settings: Mapping[str, tuple[Any, ...]]
    partings: tuple[Parting, ...]


def compare(runs: Sequence[Run]) -> Comparison:
    """Compare two or more runs.

    Raises:
        CompareError: there is only one run.
        RecordingError: a file cannot be read.
    """
    if len(runs) < 2:
        raise CompareError(f"only one run ({runs[0].file}): give two or more, or a folder of several")
    tables = [metrics(run.summary) for run in runs]
    names = dict.fromkeys(name for table in tables for name in table)
    first = runs[0]
    one_mission = all(run.digest == first.digest for run in runs)
    alike = [run for run in runs[1:] if one_mission and run.estimator == first.estimator]
    return Comparison(
        runs=labels(runs),
        one_mission=one_mission,
        metrics={name: tuple(table.get(name, _absent(name)) for table in tables) for name in names},
        settings=_different_settings(runs),
        partings=tuple(parting(first, run) for run in alike),
    )


def labels(runs: Sequence[Run]) -> tuple[str, ...]:
    """Names of runs that tell them apart: the run's own, with its folder where that is not enough."""
    names = [run.name for run in runs]
    unique = len(set(names)) == len(names)
    return tuple(run.name if unique else f"{run.folder.name}/{run.name}" for run in runs)


def _absent(name: str) -> float:
    """What a metric is of a run that does not tell it: counts are 0, all others unknown."""
    return 0.0 if name.startswith(("verdict.", "alarm.")) else math.nan


def _different_settings(runs: Sequence[Run]) -> dict[str, tuple[Any, ...]]:
    names = dict.fromkeys(name for run in runs for name in run.settings)
    rows = {name: tuple(run.settings.get(name) for run in runs) for name in names}
    return {name: values for name, values in rows.items() if any(value != values[0] for value in values)}


def parting(first: Run, run: Run) -> Parting:
    """Where a run parts from another one of the same mission and estimator.

    Raises:
        CompareError: they have no frame in common.
    """
    common, i, j = np.intersect1d(first.frames, run.frames, return_indices=True)
    if not len(common):
        raise CompareError(f"{first.file} and {run.file} have no frame in common")
    at, field = _first_different(first, run, i, j)
    verdicts = np.flatnonzero(first.column("verdict")[i] != run.column("verdict")[j])
    difference, bounds = _differences(first, run, i, j)
    return Parting(
        run=run.name,
        other=first.name,
        frames=len(common),
        identical=at < 0,
        first_different=int(common[at]) if at >= 0 else -1,
        field=field,
        first_verdict=int(common[verdicts[0]]) if len(verdicts) else -1,
        verdicts_differ=len(verdicts),
        apart={bound: _first_above(common, difference[:, 0], bound) for bound in bounds},
        difference=difference,
        frame=common,
        t_ns=first.t_ns[i],
        of_paths="pose" in first.fields,
    )


def _first_different(first: Run, run: Run, i: Ints, j: Ints) -> tuple[int, str]:
    """The first common row at which any number differs, and a field that does; -1 where none does."""
    earliest, name = len(i), ""
    for one in (first, run):
        one.columns(one.fields)  # in one pass over the file
    for field in first.fields:
        if field not in run.fields or field in CLOCKED:
            continue
        a, b = first.column(field)[i[:earliest]], run.column(field)[j[:earliest]]
        if a.shape != b.shape:
            return 0, field
        same = (a == b) | ((a != a) & (b != b))
        rows = np.flatnonzero(~same.reshape(len(same), -1).all(axis=1))
        if len(rows):
            earliest, name = int(rows[0]), field
        if not earliest:
            break
    for group in first.schema.of(Archetype.LISTS).values():
        names = [one.field for one in group if one.field in run.lists]
        lists, others = first.list_columns(names), run.list_columns(names)
        for field in names:
            row = _first_unequal(lists[field], others[field], i[:earliest], j[:earliest])
            if row >= 0:
                earliest, name = row, field
    return (earliest, name) if name else (-1, "")


def _first_unequal(lists: NDArray[Any], others: NDArray[Any], i: Ints, j: Ints) -> int:
    """The first of some pairs of rows whose lists differ, -1 for none."""
    for row, (a, b) in enumerate(zip(i, j, strict=True)):
        if not np.array_equal(lists[a], others[b], equal_nan=True):
            return row
    return -1


def _differences(first: Run, run: Run, i: Ints, j: Ints) -> tuple[Floats, Sequence[float]]:
    """Differences of the common frames, as `Parting` says, and the bounds that count for them."""
    if "pose" in first.fields:
        a, b = first.column("pose")[i], run.column("pose")[j]
        distance = np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1])
        return np.column_stack([distance, wrap_angles(b[:, 2] - a[:, 2])]), APART_M
    return _range_differences(first, run, i, j), APART_SHARE


def _range_differences(first: Run, run: Run, i: Ints, j: Ints) -> Floats:
    """Largest and median relative difference of the ranges to the landmarks that both carry, of each frame [m, 2]."""
    ids, others = first.column("landmark_id")[i], run.column("landmark_id")[j]
    ranges, theirs = first.column("range_m")[i], run.column("range_m")[j]
    found = np.full((len(i), 2), np.nan)
    for row, (a, b) in enumerate(zip(ids, others, strict=True)):
        _, p, q = np.intersect1d(a[np.isfinite(a)], b[np.isfinite(b)], return_indices=True)
        mine, other = ranges[row][np.isfinite(a)][p], theirs[row][np.isfinite(b)][q]
        off = np.abs(other / mine - 1)
        off = off[np.isfinite(off)]
        if len(off):
            found[row] = off.max(), np.median(off)
    return found


def _first_above(frames: Ints, values: Floats, bound: float) -> int:
    above = np.flatnonzero(values > bound)
    return int(frames[above[0]]) if len(above) else -1


def write_differences(found: Comparison, file: Path) -> None:
    """Write the differences of every common frame as CSV: run, frame, t_ns, two differences.

    Raises:
        CompareError: the runs cannot be compared frame by frame.
        RecordingError: the file cannot be written.
    """
    import pandas as pd

    if not found.partings:
        raise CompareError("the runs are of different recordings or estimators: no frame is compared")
    parts = []
    for one in found.partings:
        names = ("distance_m", "heading_rad") if one.of_paths else ("largest_share", "median_share")
        columns = {"run": one.run, "frame": one.frame, "t_ns": one.t_ns}
        parts.append(pd.DataFrame(columns | {name: one.difference[:, k] for k, name in enumerate(names)}))
    try:
        pd.concat(parts).to_csv(file, index=False)
    except OSError as error:
        raise RecordingError(file, f"cannot be written ({error.strerror})", "choose another file") from error


def overlay(runs: Sequence[Run], partings: Sequence[Parting], out: Path) -> None:
    """Write one recording that shows all the runs over one another, with their differences as plots.

    Raises:
        CompareError: the runs are of different missions or estimators, or two bear one name.
        RecordingError: a file cannot be read or written.
    """
    from workbench.blueprints import Extent
    from workbench.rrd_compare import DifferenceWriter
    from workbench.rrd_file import APPLICATION
    from workbench.rrd_reading import merge, without_view

    _demand_one_view(runs)
    if out.resolve() in {run.file.resolve() for run in runs}:
        raise RecordingError(out, "is one of the runs", "choose another file with --rrd")
    paths = {run.name: run.column("pose")[:, :2] for run in runs if "pose" in run.fields}
    known = [*paths.values()] + ([runs[0].reference.pose[:, :2]] if runs[0].reference is not None else [])
    with TemporaryDirectory() as folder:
        file = Path(folder) / "differences.rrd"
        with DifferenceWriter(
            file,
            recording_id=runs[0].digest[:32],
            estimator=runs[0].estimator,
            runs=[run.name for run in runs],
            extent=Extent.of(np.concatenate(known)) if paths else None,
            frames=(min(int(run.frames[0]) for run in runs), max(int(run.frames[-1]) for run in runs)),
            path_runs=bool(paths),
        ) as writer:
            for name, positions in paths.items():
                writer.path(name, positions)
            for found in partings:
                writer.differences(found.other, found.run, found.frame, found.t_ns, found.difference)
        sensors = [runs[0].sensors_file] if runs[0].sensors_file.is_file() else []
        parts = [Path(folder) / f"{number}.rrd" for number in range(len(sensors) + len(runs))]
        for source, part in zip([*sensors, *(run.file for run in runs)], parts, strict=True):
            without_view(source, part, APPLICATION, runs[0].digest[:32])
        merge([*parts, file], out)


def _demand_one_view(runs: Sequence[Run]) -> None:
    """One viewer must be able to tell the runs apart and lay them over one another."""
    if any(run.digest != runs[0].digest for run in runs):
        raise CompareError("the runs are of different recordings: one viewer cannot lay them over one another")
    if any(run.estimator != runs[0].estimator for run in runs):
        raise CompareError("the runs are of different estimators: their numbers cannot be laid over one another")
    names = [run.name for run in runs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise CompareError(f"two runs are called {twice!r}: replay one of them with another --name")
