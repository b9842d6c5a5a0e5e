"""All that a report says about a run, as plain data: the page, the Markdown and the JSON are made from it."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.verdict import Severity, Verdict, flags
from readers.streams import WorkbenchError
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Case, Finding
from workbench.judgement import REFERENCE, WHOLES, Drift, drift_of
from workbench.report import curves
from workbench.runs import Run
from workbench.summary import NOTABLE_DRIFT
from workbench.terminal import moment

Floats = NDArray[np.float64]
T = TypeVar("T")

"""Times from here on are dates."""
WINDOW_FRAMES = 100
"""Frames of a finding that are proposed for a replay."""
LEAD_FRAMES = 10
"""Frames before and behind them."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A row of numbers: RMS, mean, median and largest of an error, or a single `value`; NaN where there is none."""

    name: str
    unit: str
    rms: float = math.nan
    mean: float = math.nan
    median: float = math.nan
    largest: float = math.nan
    value: float = math.nan


@dataclass(frozen=True, slots=True)
class Counted:
    """How many frames have a verdict or an alarm."""

    name: str
    frames: int
    severity: Severity
    sentence: str


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What there is to say about a run.

    Attributes:
        name: of the run.
        recording: name of its mission.
        path: as the run was named on the command line.
        upshot: the verdict in a sentence.
        gravity: how grave it is.
        about: facts of mission and run, name and text.
        missing: what the report cannot tell, why, and the cure.
        settings: changed settings: name, value here, value of the preset.
        advice: what the replay said on how far method and data suit each other.
        notes: what the replay noted.
        damage: what of the recording could not be read.
        oddities: what is odd about its clocks and streams.
        metrics: numbers of the evaluation.
        verdicts: frames by verdict, most frequent first.
        alarms: frames by alarm.
        findings: what the diagnosis found, ranked.
        drift: the drift budget; None where there is none.
        versions: of everything that took part.
        digests: SHA-256 of the recording and of the files.
        ways: the paths; None where there are none.
        charts: errors first, then what the estimator says of itself.
        strip: the verdicts along the run.
        run: the run itself, for the pictures.
    """

    name: str
    recording: str
    path: str
    upshot: str
    gravity: Severity
    about: Sequence[tuple[str, str]]
    missing: Sequence[str]
    settings: Sequence[tuple[str, str, str]]
    advice: Sequence[str]
    notes: Sequence[str]
    damage: Sequence[str]
    oddities: Sequence[str]
    metrics: Sequence[Metric]
    verdicts: Sequence[Counted]
    alarms: Sequence[Counted]
    findings: Sequence[Finding]
    drift: Drift | None
    versions: Sequence[tuple[str, str]]
    digests: Sequence[tuple[str, str, str]]
    ways: curves.Ways | None = field(repr=False)
    charts: Sequence[curves.Chart] = field(repr=False)
    strip: curves.Strip = field(repr=False)
    run: Run = field(repr=False)

    @property
    def title(self) -> str:
        """Mission and run in a line."""
        return f"{PurePath(self.recording).name or self.recording}: run {self.name}"


def facts_of(
    run: Run, path: str | None = None, *, findings: Sequence[Finding] | None = None, drift: Drift | None = None
) -> Facts:
    """Gather all that a report says.

    Args:
        run: the run.
        path: how commands shall name it; its file by default.
        findings: what to report instead of what the diagnosis finds.
        drift: the drift budget by frame, instead of the run's own.

    Raises:
        RecordingError: the run's own file cannot be read.
    """
    run.columns(run.fields)  # at once: a file with a torn end is mended anew for each reading
    missing = _missing(run)
    drift = _attempt(lambda: drift_of(run), None, "the drift budget", missing) if drift is None else drift
    harm = None if drift is None else drift.harm_m
    found = diagnose(_case(run, harm, missing)) if findings is None else findings
    no_charts: list[curves.Chart] = []
    charts = [*_attempt(lambda: curves.errors(run), no_charts, "errors", missing), *curves.own(run)]
    paths = _attempt(lambda: curves.ways(run), None, "the path", missing)
    upshot, gravity = _upshot(run, found)
    summary = run.summary
    return Facts(
        name=run.name,
        recording=str(run.toml["run"].get("recording", summary.get("recording", "?"))),
        path=path or str(run.file),
        upshot=upshot,
        gravity=gravity,
        about=_about(run),
        missing=missing,
        settings=[(k, _shown(here), _shown(usual)) for k, (here, usual) in _changed(run, missing).items()],
        advice=list(summary.get("suitability", ())),
        notes=list(summary.get("notes", ())),
        damage=list(summary.get("damage", ())),
        oddities=list(summary.get("facts", ())),
        metrics=_metrics(summary),
        verdicts=_counted(Counter(run.verdicts)),
        alarms=_counted(Counter(flag for alarms in run.alarms for flag in flags(alarms))),
        findings=found,
        drift=drift,
        versions=[(k, str(v)) for k, v in run.toml.get("versions", {}).items()],
        digests=_digests(run),
        ways=paths,
        charts=charts,
        strip=curves.strip(run),
        run=run,
    )


def _case(run: Run, harm_m: Floats | None, missing: list[str]) -> Case:
    """What the diagnosis looks at; without the reference where its file cannot be read."""
    case = _attempt(lambda: Case.of_run(run, harm_m), None, "the reference", missing)
    if case is not None:
        return case
    nothing = np.full((len(run.frames), 4), np.nan)
    return Case(
        estimator=run.estimator,
        settings=run.settings,
        frame=run.frames,
        t_ns=run.t_ns,
        reference=nothing[:, :3],
        harm_m=nothing[:, 3] if harm_m is None else harm_m,
        facts=tuple(run.summary.get("facts", ())),
        get=run.column,
    )


def _attempt(make: Callable[[], T], instead: T, what: str, missing: list[str]) -> T:
    """What `make` gives; where a file cannot be read `instead`, and a line among what is missing."""
    try:
        return make()
    except WorkbenchError as error:
        missing.append(f"{what}: {error}")
        return instead


# ------------------------------------------------------------------------------ the upshot


def _upshot(run: Run, findings: Sequence[Finding]) -> tuple[str, Severity]:
    """The verdict on a run in a sentence, and how grave it is."""
    counts = Counter(finding.severity for finding in findings)
    said = next(iter(run.summary.get("suitability", ())), "")
    parts = [said] if said else []
    evaluation = run.summary.get("evaluation", {})
    far = evaluation.get("drift_percent", 0.0) > 100 * NOTABLE_DRIFT
    if math.isfinite(evaluation.get("end_error_m", math.nan)):
        end = f"the end is {length(evaluation['end_error_m'])} off, {evaluation['drift_percent']:.3g} % of the path"
        parts.insert(*((0, f"do not trust this path: {end}") if far else (1, end)))
    parts = [*_cut_short(run), *parts]
    if findings:
        parts.append("found: " + ", ".join(_many(counts[s], s.name.lower()) for s in sorted(counts, reverse=True)))
    text = "; ".join(parts) or "the replay concluded nothing"
    if far or counts[Severity.ERROR] or said.startswith(("do not trust", "no range counts")):
        return text, Severity.ERROR
    doubtful = counts[Severity.WARNING] > 0 or "look at what follows" in said or bool(_cut_short(run))
    return text, Severity.WARNING if doubtful else Severity.FINE


def _cut_short(run: Run) -> list[str]:
    """Why a run does not reach the recording's end, where it does not."""
    if not run.complete:
        return ["incomplete: the replay was killed before its end"]
    if run.summary.get("stopped_early"):
        return [f"in part: {run.summary['stopped_early']}"]
    return ["in part: the replay was stopped before the recording's end"] * bool(run.summary.get("interrupted"))


def _many(count: int, thing: str) -> str:
    return f"{count} {thing}" + "s" * (count != 1)


def length(metres: float) -> str:
    """A length in the unit that suits it."""
    if math.isnan(metres):
        return "unknown"
    size = abs(metres)
    for unit, factor in (("m", 1.0), ("mm", 1e3), ("µm", 1e6)):
        if size * factor >= 0.1 or unit == "µm":
            return f"{metres * factor:.3g} {unit}"
    return f"{metres:.3g} m"


# ------------------------------------------------------------------------------ the run


def _missing(run: Run) -> list[str]:
    """What a run lacks that a whole one has."""
    found = []
    if not run.complete:
        found.append("summary: the replay was killed before its end; replay the recording again for a whole run")
    elif run.summary.get("interrupted"):
        found.append("the rest of the recording: the replay was interrupted; replay it again for a whole run")
    if not run.sensors_file.is_file():
        found.append(
            f"images and reference: {run.sensors_file.name} is not beside the run; put it back, or replay again"
        )
    elif run.complete and not run.toml["run"].get("reference_stream"):
        found.append(
            "errors: the recording has no reference; name one with replay --reference TOPIC where there is one"
        )
    return found


def _changed(run: Run, missing: list[str]) -> dict[str, tuple[Any, Any]]:
    nothing: dict[str, tuple[Any, Any]] = {}
    return _attempt(run.changed_settings, nothing, "changed settings", missing)


def _shown(value: Any) -> str:
    return "not set" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _about(run: Run) -> list[tuple[str, str]]:
    """Facts of mission and run."""
    summary, asked = run.summary, run.toml["run"]
    span_s = float(run.t_ns[-1] - run.t_ns[0]) / 1e9
    found = [
        ("recording", f"{asked.get('recording', '?')} ({summary['format']})" if "format" in summary else
         str(asked.get("recording", "?"))),
        ("run", f"{run.name}: estimator {run.estimator}, preset {run.preset}"),
        ("frames", f"{len(run.frames)}, numbers {run.frames[0]} to {run.frames[-1]}, over {span_s:.3f} s"),
        ("begins", moment(int(run.t_ns[0]))),
        ("images", str(asked.get("image_stream") or "none")),
        ("reference", str(summary.get("reference") or asked.get("reference_stream") or "none")),
    ]  # fmt: skip
    window = {k: v for k, v in run.toml.get("window", {}).items() if (k, v) != ("stride", 1)}
    if window:
        found.append(("window", ", ".join(f"{k} {v}" for k, v in window.items())))
    if "path_length" in summary:
        found.append(("path length", f"{summary['path_length']:.4g} {summary['unit']}"))
        found.append(("scale", str(summary["scale"])))
    calibration = summary.get("calibration")
    if calibration:
        found += [("calibration", text) for text in calibration.get("sentences", [calibration["sentence"]])]
    return found


def _counted(counts: Mapping[Verdict, int]) -> list[Counted]:
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0].value))
    return [Counted(v.name or "OK", n, v.severity, v.sentence) for v, n in ordered]


def _digests(run: Run) -> list[tuple[str, str, str]]:
    """Name, size and SHA-256 of the recording and of the run's files."""
    found = [("recording", "", run.digest)]
    files = (run.sensors_file, run.file, run.file.with_suffix(".toml"), run.file.with_suffix(".tum"))
    found += [(file.name, f"{file.stat().st_size / 1e6:.2f} MB", _sha256(file)) for file in files if file.is_file()]
    return found


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# ------------------------------------------------------------------------------ metrics


def _metrics(summary: Mapping[str, Any]) -> list[Metric]:
    """Numbers of the evaluation as a table."""
    evaluation, ranging = summary.get("evaluation"), summary.get("ranging")
    found: list[Metric] = []
    if evaluation:
        found.append(_statistics("APE: distance after alignment", "m", evaluation["ape_m"]))
        found.append(_statistics("APE: heading", "°", evaluation["ape_heading_deg"]))
        for relative in evaluation["rpe"]:
            over = f"over {relative['delta']:g} {relative['unit']}"
            found.append(_statistics(f"RPE {over}: distance", "m", relative["translation_m"]))
            found.append(_statistics(f"RPE {over}: heading", "°", relative["heading_deg"]))
        found += [
            Metric("end-point error", "m", value=evaluation["end_error_m"]),
            Metric("drift", "% of the path", value=evaluation["drift_percent"]),
            Metric("yaw drift", "°", value=evaluation["yaw_drift_deg"]),
            Metric("yaw drift per metre", "°/m", value=evaluation["yaw_drift_deg_per_m"]),
        ]
    if ranging:
        found += _ranging(ranging)
    return [m for m in found if any(map(math.isfinite, (m.rms, m.mean, m.median, m.largest, m.value)))]


def _statistics(name: str, unit: str, values: Mapping[str, float]) -> Metric:
    return Metric(name, unit, values["rmse"], values["mean"], values["median"], values["max"])


def _ranging(ranging: Mapping[str, Any]) -> list[Metric]:
    found = [
        Metric("landmarks", "1", value=ranging["landmarks"]),
        Metric("landmarks that converged", "1", value=ranging["converged_landmarks"]),
        Metric("time to converge", "s", median=ranging["time_to_converge_s"]),
        Metric("ranges that count", "%", value=100 * ranging["converged_share"]),
        Metric(f"NIS ({ranging['nis']['expected']:g} expected)", "1", mean=ranging["nis"]["mean"]),
        Metric("updates", "1", value=ranging["updates"]),
        Metric("rejected updates", "1", value=ranging["rejected"]),
        Metric("resets", "1", value=ranging["resets"]),
        Metric("landmarks lost", "1", value=ranging["lost"]),
    ]
    error = ranging.get("error")
    if error:
        found += [
            Metric("range error", "%", rms=error["rms_percent"], mean=error["bias_percent"],
                   median=error["median_percent"]),
            Metric("NEES (1 expected)", "1", mean=error["nees"]),
            Metric("within 2σ (95 % expected)", "%", value=100 * error["coverage"]),
        ]  # fmt: skip
    return found


# ------------------------------------------------------------------------------ findings


def spans_text(finding: Finding, most: int = 8) -> str:
    """The frames of a finding in words."""
    words = [f"{a}" if a == b else f"{a}-{b}" for a, b in finding.spans]
    more = f" and {len(words) - most} more stretches" if len(words) > most else ""
    return ", ".join(words[:most]) + more


def harm_text(facts: Facts, finding: Finding) -> str:
    """What a finding did, in metres; nothing where that is not known."""
    if math.isnan(finding.harm_m):
        return ""
    return f"{length(finding.harm_m)} of {WHOLES[REFERENCE] if facts.drift is None else facts.drift.whole}"


def drift_text(drift: Drift) -> str:
    """A drift budget in a sentence or two."""
    shift, heading = (length(float(np.nansum(part))) for part in (drift.shift_m, drift.heading_m))
    apart = length(drift.end_error_m)
    end = f"The end is {apart} off" if drift.source == REFERENCE else f"Forward and backward replay end {apart} apart"
    return f"{end}: {shift} by wrong shifts, {heading} by wrong turns carried to the end. {drift.about}".rstrip()


def commands(facts: Facts, finding: Finding) -> list[str]:
    """Command lines that look into a finding and try its remedy."""
    run = shlex.quote(facts.path)
    here = (finding.worst_frame, finding.worst_frame)
    first, last = next((span for span in finding.spans if span[0] <= finding.worst_frame <= span[1]), here)
    begin = max(first, finding.worst_frame - WINDOW_FRAMES // 2) - LEAD_FRAMES
    begin = max(begin, int(facts.run.frames[0]))
    stop = min(last, finding.worst_frame + WINDOW_FRAMES // 2) + LEAD_FRAMES
    sets = "".join(f" --set {key}={value}" for key, value in trials(finding.remedy, facts.run))
    found = [f"workbench explain {run} --frame {finding.worst_frame}"]
    if sets:
        found.append(f"workbench whatif {run} --from {begin} --to {stop}{sets}")
    return found


def trials(remedy: str, run: Run) -> list[tuple[str, str]]:
    """Settings that a remedy names, with a value to try: twice for "raise", half for "lower", the other of two.

    Whatever the settings would refuse is left out.
    """
    found: dict[str, str] = {}
    for direction, key in re.findall(r"(?:\b(raise|lower)\s+)?\b([a-z]\w*_\w+)\b", remedy):
        value = run.settings.get(key)
        tried = not value if isinstance(value, bool) else _tried(value, direction)
        if tried is not None and _accepted(run, key, tried):
            found[key] = str(tried).lower()
    return list(found.items())


def _tried(value: Any, direction: str) -> int | float | None:
    """A number twice or half as large, an odd one odd again; None without a direction."""
    if not direction or not isinstance(value, int | float):
        return None
    changed = value * (2.0 if direction == "raise" else 0.5)
    if isinstance(value, float):
        return float(f"{changed:.6g}")
    return int(changed) | 1 if value % 2 else int(changed)


def _accepted(run: Run, key: str, value: Any) -> bool:
    try:
        run.plugin.settings.model_validate({**run.settings, key: value})
    except (ValueError, WorkbenchError):
        return False
    return True


# ------------------------------------------------------------------------------ as values


def values(facts: Facts) -> dict[str, Any]:
    """The facts as plain values for JSON, without curves and pictures."""
    kept = {
        f.name: getattr(facts, f.name)
        for f in dataclasses.fields(facts)
        if f.name not in ("ways", "charts", "strip", "run", "drift", "findings", "gravity")
    }
    return {
        **{name: _plain(value) for name, value in kept.items()},
        "gravity": facts.gravity.name,
        "findings": [_plain(finding) | {"frames": finding.frames} for finding in facts.findings],
        "drift": None if facts.drift is None else _drift_values(facts.run, facts.drift),
    }


def _drift_values(run: Run, drift: Drift) -> dict[str, Any]:
    rows = zip(run.frames.tolist(), drift.shift_m.tolist(), drift.heading_m.tolist(), strict=True)
    by_frame = [{"frame": f, "shift_m": s, "heading_m": h} for f, s, h in rows if math.isfinite(s) and math.isfinite(h)]
    return {"source": drift.source, "end_error_m": drift.end_error_m, "by_frame": by_frame}


def _plain(value: Any) -> Any:
    if isinstance(value, Severity):
        return value.name
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value
