"""Many replays over a grid of settings and recordings, on all cores: a table and pictures of accuracy against cost.

Every replay leaves ``rows/NAME.json`` when it is done, so that an interrupted sweep goes on where it stopped. The cost
is the CPU time of the process that replayed, decoding included, without its start; it is the one number here that
two sweeps do not share.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import multiprocessing
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from readers.streams import RecordingError, WorkbenchError
from workbench import inputs
from workbench.metrics import metrics
from workbench.opening import open_any
from workbench.session import Request, run
from workbench.settings import SettingsError, parse_override, plugin, resolve, settings_values
from workbench.summary import without_nan

if TYPE_CHECKING:
    import pandas as pd

LONGEST_NAME = 60
PRESET = "preset"
ACCURACIES = ("drift_percent", "ape_m.rmse", "ranging.error.median_percent", "share.OK", "ranging.converged_share")
"""What the picture shows: the first of these that any row has."""
COST = "cpu_ms_per_frame"


class SweepError(WorkbenchError):
    """A sweep that cannot be."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One setting and the values that it takes, as they were written; ``preset`` is one, too."""

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Job:
    """One replay of a sweep: its name, where its row goes, the values of the axes, and the request.

    `kept` says whether the run's files stay; `inputs` digests recording and settings.
    """

    name: str
    row: Path
    values: Mapping[str, str]
    request: Request
    kept: bool
    inputs: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Swept:
    """What became of a sweep: its rows in the order of the grid, and how many were there before."""

    rows: tuple[Mapping[str, Any], ...]
    planned: int
    before: int
    files: tuple[Path, ...]
    interrupted: bool

    @property
    def failed(self) -> tuple[Mapping[str, Any], ...]:
        """The rows of the replays that could not be done."""
        return tuple(row for row in self.rows if row["error"])


# ---------------------------------------------------------------------------------- grid


def parse_axis(text: str) -> Axis:
    """An axis as the command line writes it, ``key=a,b,c``; commas within brackets or quotes do not divide.

    Raises:
        SweepError: it is none, or names a value twice.
    """
    key, equals, written = text.partition("=")
    values = tuple(_divided(written))
    if not key.strip() or not equals or not all(values):
        raise SweepError(f"--grid {text}: write key=a,b,c, for example --grid search_radius_px=8,16")
    if len(set(values)) < len(values):
        raise SweepError(f"--grid {text}: a value stands there twice")
    return Axis(key.strip(), values)


def _divided(text: str) -> Iterator[str]:
    """Divide at the commas that lie in no bracket and no quotes."""
    part, depth, quote = "", 0, ""
    for letter in text:
        if letter == "," and depth == 0 and not quote:
            yield part.strip()
            part = ""
            continue
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        depth += 0 if quote else (letter in "[{") - (letter in "]}")
        part += letter
    yield part.strip()


def plan(requests: Sequence[Request], axes: Sequence[Axis], folder: Path, *, keep: bool = False) -> list[Job]:
    """The replays of a sweep; every one is checked before the first one runs.

    Args:
        requests: one for each recording.
        axes: the grid.
        folder: where everything goes.
        keep: whether the files of the runs stay (``folder/RECORDING/NAME.rrd``), not only their rows.

    Raises:
        WorkbenchError: a recording that cannot be opened, an unknown key, a wrong value, an axis twice.
    """
    keys = [axis.key for axis in axes]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise SweepError(f"--grid {twice}: stands there twice")
    stems = [request.path.stem or "recording" for request in requests]
    jobs = []
    for number, request in enumerate(requests):
        with open_any(request.path, request.options) as recording:
            digest = inputs.digest_of(recording, request.path)
        stem = stems[number] if stems.count(stems[number]) == 1 else f"{stems[number]}-{number + 1}"
        stem = re.sub(r"[^\w.-]+", "_", stem)
        for values in itertools.product(*(axis.values for axis in axes)):
            chosen = dict(zip(keys, values, strict=True))
            jobs.append(_job(request, stem, chosen, folder, digest, keep=keep))
    return jobs


def _job(request: Request, stem: str, values: Mapping[str, str], folder: Path, digest: str, *, keep: bool) -> Job:
    overrides = (*request.overrides, *(f"{key}={value}" for key, value in values.items() if key != PRESET))
    preset = values.get(PRESET, request.preset)
    name = _name(values)
    asked = dataclasses.replace(request, preset=preset, overrides=overrides, name=name, out=folder / stem)
    estimator = plugin(asked.estimator)
    resolved = resolve(estimator, preset=preset, file=asked.settings_file, overrides=overrides)
    told = [digest, asked.estimator, settings_values(resolved.settings), asked.start, asked.stop, asked.stride]
    told += [asked.reference, asked.image, asked.height, asked.tracks, asked.odometry, asked.imu]
    key = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    return Job(name, folder / "rows" / stem / f"{name}.json", values, asked, keep, key)


def _name(values: Mapping[str, str]) -> str:
    """A run's name of the values of the axes; a digest at its end where they do not fit."""
    whole = "_".join(f"{key}-{value}" for key, value in values.items())
    safe = re.sub(r"[^A-Za-z0-9_.-]+", "-", whole).strip("-.") or "run"
    if safe == whole and len(safe) <= LONGEST_NAME:
        return safe
    return f"{safe[: LONGEST_NAME - 9]}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"


# --------------------------------------------------------------------------------- replays


def sweep(
    jobs: Sequence[Job],
    folder: Path,
    *,
    workers: int | None = None,
    on_done: Callable[[str, int, int], None] | None = None,
) -> Swept:
    """Do the replays that have no row yet; write the table and the picture, also after an interrupt.

    Args:
        jobs: of `plan`.
        folder: where the table goes.
        workers: how many replays run at a time; the number of cores by default.
        on_done: called after every replay with its name, how many are done, and how many there are.

    Raises:
        RecordingError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            folder, f"cannot be written ({error.strerror})", "choose another folder with -o"
        ) from error
    waiting = [job for job in jobs if _row_of(job) is None]
    before = len(jobs) - len(waiting)
    interrupted = False
    done = before
    try:
        for job in _run_all(waiting, workers or os.cpu_count() or 1):
            done += 1
            if on_done is not None:
                on_done(job.name, done, len(jobs))
    except KeyboardInterrupt:
        interrupted = True
    rows = tuple(row for row in map(_row_of, jobs) if row is not None)
    files = tuple(_tables(rows, folder)) if rows else ()
    return Swept(rows=rows, planned=len(jobs), before=before, files=files, interrupted=interrupted)


def _run_all(jobs: Sequence[Job], workers: int) -> Iterator[Job]:
    """Do the replays in processes of their own; yield each when its row is written."""
    if not jobs:
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=_one_thread)
    futures: dict[Future[None], Job] = {}
    try:
        futures = {pool.submit(_replayed, job): job for job in jobs}
        pending = set(futures)
        while pending:
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                future.result()
                yield futures[future]
    finally:
        pool.shutdown(cancel_futures=True)


def _one_thread() -> None:
    """One core for each worker: more would only get into one another's way."""
    import cv2

    cv2.setNumThreads(1)


def _replayed(job: Job) -> None:
    """Do one replay and write its row; an error that names its cure is the row."""
    row: dict[str, Any] = {"name": job.name, "inputs": job.inputs, **_about(job), "error": ""}
    began = time.process_time()
    try:
        outcome = run(job.request, writers=None if job.kept else _no_writers())
    except WorkbenchError as error:
        row["error"] = str(error)
    else:
        if outcome.summary["interrupted"]:
            raise KeyboardInterrupt
        frames = outcome.summary["frames"]
        row["metrics"] = metrics(outcome.summary)
        row["metrics"][COST] = 1e3 * (time.process_time() - began) / frames if frames else math.nan
    job.row.parent.mkdir(parents=True, exist_ok=True)
    part = job.row.with_suffix(".part")
    part.write_text(json.dumps(without_nan(row), indent=1), encoding="utf-8")
    part.replace(job.row)


def _about(job: Job) -> dict[str, Any]:
    return {"recording": job.request.path.name, "values": {k: _plain(v) for k, v in job.values.items()}}


def _plain(written: str) -> Any:
    """A value as a number where it is one, for the table."""
    try:
        value = parse_override(f"value={written}")["value"]
    except SettingsError:
        return written
    return value if isinstance(value, int | float | str | bool) else written


def _row_of(job: Job) -> Mapping[str, Any] | None:
    """The row of an earlier replay of the very same inputs; None where there is none."""
    with contextlib.suppress(OSError, ValueError):
        row: dict[str, Any] = json.loads(job.row.read_text(encoding="utf-8"))
        if row.get("inputs") == job.inputs and (not job.kept or _kept(job)):
            return row
    return None


def _kept(job: Job) -> bool:
    assert job.request.out is not None
    return (job.request.out / f"{job.name}.rrd").is_file()


class _Nothing:
    """Stands in for the writers of the recordings of a replay of which only the row counts."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


def _no_writers() -> Any:
    from workbench.session import Writers

    return Writers(_Nothing, _Nothing)


# ---------------------------------------------------------------------------------- tables


def table_of(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """The rows of a sweep as a table: recording, name, the axes, all metrics, error."""
    import pandas as pd

    flat = [
        {
            "recording": row["recording"],
            "name": row["name"],
            **row["values"],
            **{key: math.nan if value is None else value for key, value in row.get("metrics", {}).items()},
            "error": row["error"],
        }
        for row in rows
    ]
    table = pd.DataFrame(flat)
    counts = [name for name in table.columns if name.startswith(("verdict.", "alarm."))]
    done = table["error"] == ""
    table.loc[done, counts] = table.loc[done, counts].fillna(0.0)
    return table[[name for name in table.columns if name != "error"] + ["error"]]


def accuracy_of(table: pd.DataFrame) -> str:
    """The metric by which the rows of a sweep are ranked, empty where there is none."""
    return next((name for name in ACCURACIES if name in table and table[name].notna().any()), "")


def _tables(rows: Sequence[Mapping[str, Any]], folder: Path) -> Iterator[Path]:
    table = table_of(rows)
    mixed = [name for name in table.columns if table[name].dtype == object]
    table.to_csv(folder / "sweep.csv", index=False)
    yield folder / "sweep.csv"
    table.astype(dict.fromkeys(mixed, str)).to_parquet(folder / "sweep.parquet", index=False)
    yield folder / "sweep.parquet"
    accuracy = accuracy_of(table)
    if accuracy:
        yield _picture(table, accuracy, folder / "sweep")


def _picture(table: pd.DataFrame, accuracy: str, file: Path) -> Path:
    """Accuracy against cost of every row, one sign a recording, and the line of those that nothing beats in both."""
    from workbench.reproduce.drawing import BLACK, BLUE, GREEN, ORANGE, RED, figure_of, save

    done = table[table[accuracy].notna() & table[COST].notna()]
    higher = accuracy in ("share.OK", "ranging.converged_share")

    def draw() -> Any:
        figure, axes = figure_of(9.0, 6.0)
        plot = axes[0, 0]
        signs, colours = itertools.cycle("osD^v"), itertools.cycle((BLUE, ORANGE, GREEN, RED))
        for (recording, group), sign, colour in zip(done.groupby("recording"), signs, colours, strict=False):
            plot.plot(group[COST], group[accuracy], sign, color=colour, label=recording)
            best = group.loc[unbeaten(group[COST].tolist(), group[accuracy].tolist(), higher=higher)]
            plot.plot(best[COST], best[accuracy], "-", color=colour, alpha=0.5)
            for _, row in (group if len(group) <= 16 else best).iterrows():
                plot.annotate(row["name"], (row[COST], row[accuracy]), xytext=(5, 4), textcoords="offset points",
                              fontsize=7, color=BLACK)  # fmt: skip
        plot.set_xlabel("CPU time, ms a frame")
        plot.set_ylabel(accuracy + (" (higher is better)" if higher else " (lower is better)"))
        if not higher and (done[accuracy] > 0).all() and done[accuracy].max() > 20 * done[accuracy].min():
            plot.set_yscale("log")
        plot.set_xlim(left=0)
        plot.legend()
        return figure

    return save(file, draw)


def unbeaten(cost: Sequence[float], accuracy: Sequence[float], *, higher: bool) -> list[bool]:
    """Which points no other one beats in cost and accuracy at once (equal ones do not beat one another)."""
    sign = -1.0 if higher else 1.0
    points = [(c, sign * a) for c, a in zip(cost, accuracy, strict=True)]
    return [not any(o[0] <= p[0] and o[1] <= p[1] and o != p for o in points) for p in points]
