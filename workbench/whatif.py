"""What if: a window of a run once more with other settings, from the state that the run had then.

The state before the window comes from the nearest checkpoint, carried on with the run's own settings; from there the
window is replayed with the new ones on the logged samples. Nothing of the original recording is needed. Numbers that
stay the same are the same bit for bit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from pipelines.estimator import Estimator, EstimatorError, Resumable, Step
from pipelines.planar import wrap_angle
from pipelines.replay import stepped
from pipelines.verdict import Verdict, flags
from readers.streams import RecordingError, Sample, StreamError
from workbench import checkpoints, manifest
from workbench.runs import Run, open_run
from workbench.schema import CLOCKED, Archetype, schema_of
from workbench.settings import (
    Layer,
    Plugin,
    SettingsError,
    parse_override,
    plugin,
    read_settings,
    settings_values,
    to_toml,
    validated,
)

Floats = NDArray[np.float64]
Table = Mapping[str, Sequence[Any]]
"""Fields of logged steps: one value per frame."""

AGAIN = "replay the recording again"
GIVE = "give the RUN.rrd of a replay"
_SELDOM = frozenset({"frame", "t_ns", "received_ns", "verdict", "alarms"}) | CLOCKED
_NUMBERS = (Archetype.SCALARS, Archetype.INTEGERS, Archetype.LISTS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What a user asks.

    `start` and `stop` are a frame's number (``120``) or a time: seconds after the run's first frame (``12.5s``),
    nanoseconds (15 digits or more) or ISO 8601; the window is half-open. `overrides` and `settings_file` are laid
    over the run's settings. `name` is that of the answer; None: made of the settings. `fields` are those to show.
    """

    run: Path
    start: str | None = None
    stop: str | None = None
    overrides: tuple[str, ...] = ()
    settings_file: Path | None = None
    name: str | None = None
    fields: tuple[str, ...] = ()


class Change(NamedTuple):
    """A number of a field that differs: where it stands, before, after, and the difference by the field's usual size.

    A number that comes or goes (the other is NaN) counts as that usual size.
    """

    field: str
    old: float
    new: float
    size: float


@dataclass(frozen=True, slots=True)
class Row:
    """One frame, old against new.

    `distance_m` and `turn_rad` are the differences of the poses (NaN where the steps have none), `range_share` the
    largest relative difference of a landmark's range; `changes` one entry for each field that differs, the largest
    first.
    """

    frame: int
    t_ns: int
    old: Verdict
    new: Verdict
    distance_m: float
    turn_rad: float
    range_share: float
    changes: tuple[Change, ...]


@dataclass(frozen=True, slots=True)
class Answer:
    """Old against new, frame by frame.

    `steps` are the new ones and `logged` the fields of the old ones, `fields` those that were asked for, `summary`
    what it comes to.
    """

    run: Run
    name: str
    estimator: Estimator[Any]
    rows: tuple[Row, ...]
    steps: tuple[Step, ...]
    logged: Table
    fields: tuple[str, ...]
    summary: Mapping[str, Any]

    @property
    def run_file(self) -> Path:
        """The recording of the new steps."""
        return self.run.folder / f"{self.name}.rrd"

    @property
    def files(self) -> tuple[Path, ...]:
        """What to open in the viewer: measurements, old steps, new steps."""
        return self.run.folder / "sensors.rrd", self.run.path("rrd"), self.run_file


# ------------------------------------------------------------------------------ the answer


def ask(question: Question) -> Answer:
    """Replay a window of a run with other settings.

    Raises:
        WorkbenchError: it cannot be done; the text says what is missing, where, and the cure.
    """
    from workbench.rrd_sensors import sensors_of

    run = open_run(question.run)
    chosen = plugin(run.about["estimator"])
    old_settings = run.model
    new_settings = _changed(chosen, old_settings, question)
    old, new = chosen.build(old_settings), chosen.build(new_settings)
    name = _name(run, question)
    _check_fields(question, new.step_type)
    with sensors_of(run) as sensors:
        _check_height(run, new_settings)
        window = Window.of(question, sensors.frames, sensors.t_ns)
        steps, verified = _replayed(run, sensors, window, old, new)
        reference = _reference(run, window)
    logged = _logged(run, window, new.step_type)
    settled = _differences(old_settings, new_settings)
    rows = tuple(_rows(logged, steps, settled))
    summary = _summary(run, name, window, rows, steps, logged, reference, verified)
    summary |= {"changed_settings": settled}
    return Answer(run, name, new, rows, tuple(steps), logged, question.fields, summary)


class Window(NamedTuple):
    """Frames of a run: numbers and places in the list of all frames, half-open."""

    frames: NDArray[np.int64]
    first: int
    stop: int

    @classmethod
    def of(cls, question: Question, frames: NDArray[np.int64], t_ns: NDArray[np.int64]) -> Window:
        """The window that is asked for.

        Raises:
            StreamError: no frame lies in it.
        """
        first = 0 if question.start is None else _place(question.start, frames, t_ns)
        stop = len(frames) if question.stop is None else _place(question.stop, frames, t_ns)
        if stop <= first:
            raise StreamError(
                f"{question.run}: no frame from {question.start or 'the start'} to {question.stop or 'the end'}; "
                f"the run has frames {frames[0]} to {frames[-1]}, "
                f"{(t_ns[-1] - t_ns[0]) / 1e9:.3f} s after the first; write 120 for a frame, 12.5s for a time"
            )
        return cls(frames, first, stop)

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The numbers of its frames."""
        return self.frames[self.first : self.stop]


def _place(text: str, frames: NDArray[np.int64], t_ns: NDArray[np.int64]) -> int:
    """Place of the first frame from a number or a time on."""
    from workbench.inputs import parse_time

    if re.fullmatch(r"-?\d{1,14}", text):
        return int(np.searchsorted(frames, int(text)))
    later = t_ns >= parse_time(text.removesuffix("s"), int(t_ns[0]))
    return int(np.argmax(later)) if later.any() else len(frames)


def _changed(chosen: Plugin, old: BaseModel, question: Question) -> BaseModel:
    file = question.settings_file
    layers = [] if file is None else [Layer(str(file), read_settings(file, chosen.settings))]
    layers += [Layer(f"--set {text}", parse_override(text)) for text in question.overrides]
    return validated(old, layers).settings


def _name(run: Run, question: Question) -> str:
    """The name of the new run: that of the old one and what is asked.

    Raises:
        SettingsError: it cannot be a name.
    """
    words = (
        question.name
        or "_".join(question.overrides)
        or (question.settings_file.stem if question.settings_file else "same")
    )
    name = words if question.name else re.sub(r"[^A-Za-z0-9.]+", "-", words).strip("-.")[:60]
    whole = f"{run.name}.whatif-{name}"
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,99}", whole):
        raise SettingsError(f"--name {name!r}: use letters, digits, dot, dash, underscore")
    return whole


def _check_fields(question: Question, step_type: type[Step]) -> None:
    known = [row.field for row in schema_of(step_type).rows if row.archetype is not Archetype.SURFACES]
    for name in question.fields:
        if name not in known:
            raise StreamError(f"--fields {name}: the steps have no such number; they have {', '.join(known)}")


def _check_height(run: Run, settings: BaseModel) -> None:
    """See that the run read the stream of heights that its new settings name.

    Raises:
        StreamError: it did not.
    """
    height = getattr(settings, "height_stream", "")
    if height and height not in run.about["other_streams"]:
        raise StreamError(f"height_stream = {height!r}: the run {run.name} did not read it; {AGAIN} with it")


def _replayed(
    run: Run, sensors: Any, window: Window, old: Estimator[Any], new: Estimator[Any]
) -> tuple[list[Step], int]:
    """The steps of the window under the new settings; and on how many frames before it the log was met exactly.

    Raises:
        RecordingError: there is no state to begin with, or it does not lead to the numbers of the log.
        EstimatorError: the new settings cannot go on from the old state.
    """
    others = run.about["other_streams"]
    last = sensors.order_of(int(window.frames[window.stop - 1]))
    if window.first == 0:
        samples = sensors.samples(others, -1, last)
        return _carried(new, new.start(), samples)[1], 0
    before = int(window.frames[window.first - 1])
    about = {"digest": run.about["digest"], "run": run.name, "estimator": run.about["estimator"]}
    kept = checkpoints.nearest(run.path("checkpoints"), int(window.frames[window.first]), about)
    state = old.unpacked(kept.state, sensors.grey) if isinstance(old, Resumable) else kept.state
    begin, switch = (sensors.order_of(kept.frame) if kept.frame >= 0 else -1), sensors.order_of(before)
    state, earlier = _carried(old, state, sensors.samples(others, begin, switch))
    _verify(run, earlier)
    if old.settings != new.settings:
        if not isinstance(new, Resumable):
            raise EstimatorError(
                f"the estimator {new.name!r} cannot go on from a state under other settings: it has no `adopted`; "
                "leave out --from, so that the window begins with the first frame"
            )
        state = new.adopted(state)
    return _carried(new, state, sensors.samples(others, switch, last))[1], len(earlier)


def _carried(estimator: Estimator[Any], state: Any, samples: Iterable[Sample]) -> tuple[Any, list[Step]]:
    """The state after some samples, and the steps on the way."""
    steps: list[Step] = []
    for sample in samples:
        state, step = stepped(estimator, state, sample)
        if step is not None:
            steps.append(step)
    return state, steps


def _verify(run: Run, steps: Sequence[Step]) -> None:
    """See that steps are those of the log, bit for bit.

    Raises:
        RecordingError: they are not: another version, or another kind of machine, wrote the run.
    """
    if not steps:
        return
    logged = _read(run, steps[0].frame, steps[-1].frame + 1, type(steps[0]))
    for row in _rows(logged, steps):
        if row.changes or row.old != row.new:
            what = row.changes[0].field if row.changes else "verdict"
            problem = f"frame {row.frame} does not come out as it was logged ({what})"
            raise RecordingError(run.path("rrd"), problem, f"another version or machine wrote it; {AGAIN}")


# ------------------------------------------------------------------------------- the log


def _logged(run: Run, window: Window, step_type: type[Step]) -> Table:
    numbers = window.numbers
    return _read(run, int(numbers[0]), int(numbers[-1]) + 1, step_type)


def _read(run: Run, first: int, stop: int, step_type: type[Step]) -> Table:
    """The fields of the logged steps, without surfaces, of a half-open range of frames."""
    from workbench.rrd import read_fields
    from workbench.rrd_excerpt import RrdParts

    schema = schema_of(step_type)
    fields = [row.field for row in schema.rows if row.archetype is not Archetype.SURFACES]
    root = f"/runs/{run.name}/{run.about['estimator']}/"
    entities = {root + row.entity for row in schema.rows if row.archetype in _NUMBERS}
    with RrdParts(run.path("rrd")) as parts:
        wanted = [place for place in parts.of(entities) if place.overlaps(first, stop)]
        if not wanted:
            raise RecordingError(run.path("rrd"), f"holds no frames {first} to {stop - 1}", AGAIN)
        table = read_fields(parts.excerpt(wanted), run.name, step_type, fields)
    inside = [i for i, frame in enumerate(table["frame"]) if first <= frame < stop]
    return {name: [values[i] for i in inside] for name, values in table.items()}


def _reference(run: Run, window: Window) -> Any:
    """The reference's poses (times [n], x, y (m) and heading (rad) [n, 3]); None where the run has none in metres."""
    if run.toml.get("summary", {}).get("unit") != "m":
        return None
    from workbench.rrd_sensors import read_reference

    return read_reference(run.folder / "sensors.rrd")


# ---------------------------------------------------------------------------- comparison


def _rows(logged: Table, steps: Sequence[Step], settled: Container[str] = ()) -> Iterator[Row]:
    """Each frame, old against new; fields that repeat a changed setting are no news."""
    places = {frame: i for i, frame in enumerate(logged["frame"])}
    fields = [name for name in logged if name not in _SELDOM and name not in settled]
    usual = {name: _size(logged[name]) for name in fields}
    for step in steps:
        i = places.get(step.frame)
        if i is None:
            raise RecordingError(Path("the log"), f"holds no frame {step.frame}", AGAIN)
        before = {name: logged[name][i] for name in logged}
        changes = [c for name in fields if (c := _change(name, before[name], getattr(step, name), usual[name]))]
        distance, turn = _apart(before.get("pose"), getattr(step, "pose", None))
        yield Row(
            step.frame,
            step.t_ns,
            Verdict(int(before["verdict"])),
            step.verdict,
            distance,
            turn,
            _ranges_apart(before, step),
            tuple(sorted(changes, key=lambda change: -change.size)),
        )


def _size(values: Sequence[Any]) -> float:
    """The largest finite number of a field in the window, 1 where there is none but 0."""
    flat = np.concatenate([np.abs(np.asarray(value, np.float64)).ravel() for value in values])
    flat = flat[np.isfinite(flat)]
    largest = float(flat.max(initial=0.0))
    return largest if largest > 0 else 1.0


def _change(name: str, old: Any, new: Any, usual: float) -> Change | None:
    """The largest difference in a field, None where all its bits are equal."""
    a, b = (np.ascontiguousarray(value, np.float64) for value in (old, new))
    if a.shape[1:] == b.shape[1:] and len(a) != len(b):
        return Change(f"{name}: length", float(len(a)), float(len(b)), abs(len(a) - len(b)) / max(len(a), len(b)))
    if a.shape != b.shape:
        return Change(f"{name}: shape", float(a.size), float(b.size), math.inf)
    if a.tobytes() == b.tobytes():
        return None
    differs = a.view(np.int64).ravel() != b.view(np.int64).ravel()
    with np.errstate(invalid="ignore"):
        size = np.abs(b - a).ravel() / usual
    one_sided = np.isnan(a).ravel() != np.isnan(b).ravel()
    size = np.where(differs, np.where(one_sided, 1.0, np.nan_to_num(size, nan=0.0, posinf=np.inf)), -1.0)
    at = int(size.argmax())
    index = ",".join(map(str, np.unravel_index(at, a.shape))) if np.ndim(old) else ""
    return Change(f"{name}[{index}]" if index else name, float(a.ravel()[at]), float(b.ravel()[at]), float(size[at]))


def _apart(old: Any, new: Any) -> tuple[float, float]:
    """Distance (m) and turn (rad) from one pose to another."""
    if old is None or new is None:
        return math.nan, math.nan
    return float(math.hypot(new[0] - old[0], new[1] - old[1])), float(wrap_angle(float(new[2] - old[2])))


def _ranges_apart(old: Mapping[str, Any], step: Step) -> float:
    """Largest relative difference of a landmark's range, NaN where none is in both."""
    new = getattr(step, "range_m", None)
    if new is None or "range_m" not in old:
        return math.nan
    before = dict(zip(np.asarray(old["landmark_id"]).tolist(), np.asarray(old["range_m"]).tolist(), strict=True))
    after = dict(zip(step.landmark_id.tolist(), new.tolist(), strict=True))  # type: ignore[attr-defined]
    shares = [abs(after[k] / before[k] - 1.0) for k in after if k == k and before.get(k)]
    return float(np.nanmax(shares)) if np.isfinite(shares).any() else math.nan


# ------------------------------------------------------------------------------- summary


def _summary(
    run: Run,
    name: str,
    window: Window,
    rows: Sequence[Row],
    steps: Sequence[Step],
    logged: Table,
    reference: Any,
    verified: int,
) -> dict[str, Any]:
    last = rows[-1]
    found: dict[str, Any] = {
        "run": run.name,
        "whatif": name,
        "first_frame": rows[0].frame,
        "last_frame": last.frame,
        "frames": len(rows),
        "frames_verified": verified,
        "verdicts_changed": sum(row.old != row.new for row in rows),
        "frames_changed": sum(bool(row.changes) or row.old != row.new for row in rows),
        "verdicts_old": _named(row.old for row in rows),
        "verdicts_new": _named(row.new for row in rows),
    }
    if math.isfinite(last.distance_m):
        found |= {"end_distance_m": last.distance_m, "end_turn_rad": last.turn_rad}
    shares = [row.range_share for row in rows if math.isfinite(row.range_share)]
    if shares:
        found |= {"end_range_share": last.range_share, "median_range_share": float(np.median(shares))}
    if reference is not None and math.isfinite(last.distance_m):
        at_ns, truth = reference
        offset_ns = round(run.about.get("reference_offset_s", 0.0) * 1e9)
        t_ns = np.array([step.t_ns for step in steps], np.int64) + offset_ns
        old, new = np.array(logged["pose"]), np.array([getattr(step, "pose") for step in steps])  # noqa: B009
        found["error_old"] = _reference_error(t_ns, at_ns, truth, old)
        found["error_new"] = _reference_error(t_ns, at_ns, truth, new)
    return found


def _named(verdicts: Iterable[Verdict]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for verdict in verdicts:
        key = _verdict(verdict)
        counts[key] = counts.get(key, 0) + 1
    return dict(sorted(counts.items()))


def _reference_error(t_ns: Any, at_ns: Any, reference: Floats, poses: Floats) -> dict[str, float] | None:
    """How the way from the first to the last frame of the window differs from the reference's, in m and rad.

    Both ways are taken in the axes of their own first pose; None where the reference does not cover the window.
    """
    inside = np.flatnonzero((t_ns >= at_ns[0]) & (t_ns <= at_ns[-1]))
    if len(inside) < 2:
        return None
    ends = inside[[0, -1]]
    since, known = (t_ns[ends] - at_ns[0]).astype(float), (at_ns - at_ns[0]).astype(float)
    heading = np.unwrap(reference[:, 2])
    true = np.column_stack([np.interp(since, known, v) for v in (reference[:, 0], reference[:, 1], heading)])
    (x, y, a), (tx, ty, ta) = _way(poses[ends]), _way(true)
    return {"distance_m": math.hypot(x - tx, y - ty), "turn_rad": float(wrap_angle(a - ta))}


def _way(ends: Floats) -> tuple[float, float, float]:
    """The second pose in the axes of the first."""
    (x0, y0, a), (x1, y1, b) = ends
    c, s = math.cos(a), math.sin(a)
    return c * (x1 - x0) + s * (y1 - y0), -s * (x1 - x0) + c * (y1 - y0), wrap_angle(b - a)


def _differences(old: BaseModel, new: BaseModel) -> dict[str, list[Any]]:
    """The settings that differ, before and after."""
    a, b = settings_values(old), settings_values(new)
    return {key: [a[key], b[key]] for key in a if repr(a[key]) != repr(b[key])}


# --------------------------------------------------------------------------- for reading

_WIDTH = 60
"""Of a frame's changed fields so many stand in the table as go into this width."""


def cells(answer: Answer) -> tuple[list[str], list[list[str]]]:
    """The table: its heads, and a row for each frame."""
    path = any(math.isfinite(row.distance_m) for row in answer.rows)
    apart = ["apart", "turned"] if path else ["ranges"]
    heads = ["frame", "time", "old", "new", *apart, *answer.fields, "" if answer.fields else "changed most"]
    places = {frame: i for i, frame in enumerate(answer.logged["frame"])}
    rows = []
    for row, step in zip(answer.rows, answer.steps, strict=True):
        shown = [f"{(row.t_ns - answer.rows[0].t_ns) / 1e9:.3f} s", _verdict(row.old), _verdict(row.new)]
        shown += [_metres(row.distance_m), _degrees(row.turn_rad)] if path else [_share(row.range_share)]
        for name in answer.fields:
            shown.append(f"{_value(answer.logged[name][places[row.frame]])} → {_value(getattr(step, name))}")
        rows.append([str(row.frame), *shown, "" if answer.fields else _most(row.changes)])
    return heads, rows


def _most(changes: Sequence[Change]) -> str:
    """The fields that changed most."""
    said = ""
    for change in changes:
        longer = f"{said}{', ' if said else ''}{change.field} {change.old:.4g} → {change.new:.4g}"
        if said and len(longer) > _WIDTH:
            break
        said = longer
    return said or "nothing"


def summary_lines(answer: Answer) -> list[str]:
    """What the answer comes to, a line each."""
    s = answer.summary
    said = [f"{key}: {old} → {new}" for key, (old, new) in s["changed_settings"].items()]
    lines = [
        f"settings     {'; '.join(said) or 'as they were'}",
        f"window       frames {s['first_frame']} to {s['last_frame']}, {s['frames']} of them; "
        f"{s['frames_verified']} before it came out as logged",
        f"verdict      changed in {s['verdicts_changed']} frames; numbers in {s['frames_changed']}",
        f"old          {_counts(s['verdicts_old'])}",
        f"new          {_counts(s['verdicts_new'])}",
    ]
    if "end_distance_m" in s:
        lines.append(f"at its end   {_metres(s['end_distance_m'])} apart, turned by {_degrees(s['end_turn_rad'])}")
    if "end_range_share" in s:
        share, median = _share(s["end_range_share"]), _share(s["median_range_share"])
        lines.append(f"ranges       differ by up to {share} at its end, by up to {median} in the median frame")
    if s.get("error_old") and s.get("error_new"):
        old, new = (f"{_metres(e['distance_m'])}, {_degrees(e['turn_rad'])}" for e in (s["error_old"], s["error_new"]))
        lines.append(f"reference    error over the window {old} before, {new} now")
    return [*lines, f"result       {answer.run_file}"]


def values_of(answer: Answer) -> dict[str, Any]:
    """The answer as plain values: the summary, and a row for each frame."""
    places = {frame: i for i, frame in enumerate(answer.logged["frame"])}

    def fields(row: Row, step: Step) -> dict[str, Any]:
        return {
            name: {
                "old": np.asarray(answer.logged[name][places[row.frame]]).tolist(),
                "new": np.asarray(getattr(step, name)).tolist(),
            }
            for name in answer.fields
        }

    rows = [
        {
            "frame": row.frame,
            "t_ns": row.t_ns,
            "old": _verdict(row.old),
            "new": _verdict(row.new),
            "distance_m": row.distance_m,
            "turn_rad": row.turn_rad,
            "range_share": row.range_share,
            "changes": [{**change._asdict()} for change in row.changes],
            "fields": fields(row, step),
        }
        for row, step in zip(answer.rows, answer.steps, strict=True)
    ]
    return {"summary": dict(answer.summary), "run_file": str(answer.run_file), "frames": rows}


def _verdict(verdict: Verdict) -> str:
    return "+".join(str(flag.name) for flag in flags(verdict)) or "OK"


def _counts(verdicts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in verdicts.items())


def _metres(value: float) -> str:
    return "-" if not math.isfinite(value) else "0" if value == 0 else f"{value:.3g} m"


def _degrees(value: float) -> str:
    return "-" if not math.isfinite(value) else "0" if value == 0 else f"{math.degrees(value):.3g}°"


def _share(value: float) -> str:
    return "-" if not math.isfinite(value) else "0" if value == 0 else f"{100 * value:.3g} %"


def _value(value: Any) -> str:
    """A number, or the smallest and largest of several."""
    flat = np.asarray(value, np.float64).ravel()
    finite = flat[np.isfinite(flat)]
    if not len(finite):
        return "nan"
    if len(flat) == 1:
        return f"{flat[0]:.4g}"
    return f"{finite.min():.4g}…{finite.max():.4g}"


# -------------------------------------------------------------------------------- writing


def write(answer: Answer) -> None:
    """Write the new steps as a run of its own beside the old one: the recording, its TOML, and its manifest.

    That knows of the sensors' file what the old run's manifest knows.

    Raises:
        WorkbenchError: they cannot be written.
    """
    from workbench.rrd import RunWriter

    run, new = answer.run, answer.estimator
    flat = {k: v if isinstance(v, int | float | str) else str(v) for k, v in answer.summary.items()}
    with RunWriter(
        answer.run_file,
        recording_id=str(run.about["digest"])[:32],
        run=answer.name,
        estimator=new.name,
        step_type=new.step_type,
        settings_text=to_toml(settings_values(new.settings)),
    ) as writer:
        for step in answer.steps:
            writer.step(step)
        writer.finish(flat, None)
    ends = {"first_frame": answer.steps[0].frame, "last_frame": answer.steps[-1].frame}
    values = {
        **run.toml,
        "run": {**run.about, "name": answer.name},
        "window": {**run.toml.get("window", {}), **ends},
        "settings": settings_values(new.settings),
        "summary": answer.summary,
    }
    part = run.folder / f"{answer.name}.toml.part"
    part.write_text(to_toml(values), encoding="utf-8")
    part.replace(run.folder / f"{answer.name}.toml")
    known = manifest.read(run.folder, run.name) if manifest.file_of(run.folder, run.name).is_file() else None
    manifest.write(run.folder, answer.name, manifest.taken(run.folder, answer.name, known=known))
