"""What is concluded of a finished run: its drift budget and the findings of its diagnosis.

Without a reference the harm of a frame is what it adds to the disagreement of the run with its backward replay, where
`workbench.consistency` was asked for it.

The conclusion of a long run takes seconds, and so it is kept beside the run, in RUN.judgement.json, for the next who
asks. It counts as long as the run's files and the rules are those that it was made of; it can be deleted at any time.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.drift import DriftBudget, drift_budget
from pipelines.evaluation import EvaluationError
from pipelines.verdict import Severity
from readers.streams import RecordingError
from workbench import consistency, diagnosis
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Case, Evidence, Finding
from workbench.runs import Run

Floats = NDArray[np.float64]


REFERENCE, BACKWARD = "reference", "backward replay"
WHOLES = {REFERENCE: "the end-point error", BACKWARD: "what forward and backward replay end apart"}
"""What a harm can be held against, and what all harm is then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """The drift budget by frame: what each adds to the end-point error [n], in m, of wrong shifts and of wrong turns.

    NaN for a frame that has no share; `end_error_m` is what all sum to, `about` how to read it. The error is that
    against the `source`: the reference or the backward replay.
    """

    shift_m: Floats
    heading_m: Floats
    end_error_m: float
    about: str = ""
    source: str = REFERENCE

    @classmethod
    def of_rows(
        cls,
        count: int,
        rows: NDArray[np.int64],
        shift_m: Floats,
        heading_m: Floats,
        end_error_m: float,
        about: str = "",
        source: str = REFERENCE,
    ) -> Drift:
        """The budget of a run of `count` frames, given for some of its rows [m] only.

        Args:
            count: frames of the run.
            rows: which of them have a share, ascending.
            shift_m: their shares of wrong shifts along the end-point error.
            heading_m: those of wrong turns.
            end_error_m: length of the end-point error.
            about: how to read it.
            source: what it is an error against.
        """
        shift, heading = np.full((2, count), np.nan)
        shift[rows], heading[rows] = shift_m, heading_m
        return cls(shift_m=shift, heading_m=heading, end_error_m=end_error_m, about=about, source=source)

    @property
    def harm_m(self) -> Floats:
        """Shift and heading together [n]."""
        return self.shift_m + self.heading_m

    @property
    def whole(self) -> str:
        """What all shares together are, in words."""
        return WHOLES[self.source]


@dataclass(frozen=True)
class Judgement:
    """Findings, the worst first; harm of each frame in m [n], None where nothing tells it.

    The harm of a frame is signed: what it adds to the length of the end-point error, against the reference or the
    backward replay, as `harm_from` says. `note` says why a harm that was asked for is not told.
    """

    findings: tuple[Finding, ...]
    harm_m: Floats | None
    harm_from: str = ""
    note: str = ""


def judged(run: Run) -> Judgement:
    """Judge a run, or take what was concluded before.

    Raises:
        RecordingError: its files cannot be read.
    """
    key = _key(run)
    kept = _kept(run, key)
    if kept is not None:
        return kept
    made = _judged(run)
    _keep(run, key, made)
    return made


def _judged(run: Run) -> Judgement:
    drift, note = _reference_drift(run), ""
    if drift is None:
        try:
            drift = _backward_drift(run)
        except RecordingError as error:
            note = str(error)
    harm = None if drift is None else drift.harm_m
    found = tuple(diagnose(Case.of_run(run, harm)))
    return Judgement(found, harm, "" if drift is None else drift.source, note)


def drift_of(run: Run) -> Drift | None:
    """The drift budget of a run by frame; None where neither a reference nor a backward replay tells it.

    Raises:
        RecordingError: its files cannot be read; or what `workbench.consistency` kept is not of this replay.
    """
    return _reference_drift(run) or _backward_drift(run)


def _reference_drift(run: Run) -> Drift | None:
    budget, estimate = budget_of(run), run.trajectory
    if budget is None or estimate is None:
        return None
    derived = "the reference has no headings: they are derived from its path, and turns are told less sharply"
    return Drift.of_rows(
        len(run.frames),
        np.searchsorted(run.t_ns, estimate.t_ns[budget.index]),
        budget.shift_harm_m,
        budget.heading_harm_m,
        float(np.hypot(*budget.end_error_m)),
        derived if budget.headings == "derived" else "",
    )


def _backward_drift(run: Run) -> Drift | None:
    found = consistency.read(run)
    if found is None:
        return None
    if found.unit != "m":
        problem = "has no scale, so that no harm in metres can be told"
        raise RecordingError(run.file, problem, "replay with metres_per_px, then run workbench consistency")
    return Drift.of_rows(
        len(run.frames),
        np.searchsorted(run.frames, found.frame),
        found.shift_m,
        found.heading_m,
        found.end_m,
        "Without a reference a frame is held against the backward replay, in which it may be the wrong one as well.",
        BACKWARD,
    )


def budget_of(run: Run) -> DriftBudget | None:
    """The drift budget of a run; None where it has no path, no reference, or the two do not associate."""
    estimate, reference = run.trajectory, run.reference
    if estimate is None or reference is None:
        return None
    offset_ns = round(float(run.toml["run"].get("reference_offset_s", 0.0)) * 1e9)
    with_scale = run.summary.get("unit", "m") != "m"
    try:
        return drift_budget(estimate, reference, offset_ns=offset_ns, with_scale=with_scale)
    except EvaluationError:
        return None


# ------------------------------------------------------------------------------ what is kept


def _file(run: Run) -> Path:
    return run.path("judgement.json")


def _key(run: Run) -> str:
    """What a conclusion was made of: the run's files by size and time, the rules by their text."""
    total = hashlib.sha256()
    for file in (run.file, run.path("toml"), run.sensors_file, consistency.file_of(run)):
        about = file.stat() if file.is_file() else None
        total.update(repr((file.name, about and (about.st_size, about.st_mtime_ns))).encode())
    rules = Path(diagnosis.__file__).parent
    for file in sorted(rules.glob("*.py")):
        total.update(file.read_bytes())
    return total.hexdigest()


def _kept(run: Run, key: str) -> Judgement | None:
    """An earlier conclusion, None where there is none that still counts."""
    try:
        values = json.loads(_file(run).read_text(encoding="utf-8"))
        if values["key"] != key:
            return None
        harm = None if values["harm_m"] is None else np.frombuffer(base64.b64decode(values["harm_m"]))
        return Judgement(tuple(map(_finding, values["findings"])), harm, values["harm_from"], values["note"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _keep(run: Run, key: str, made: Judgement) -> None:
    """Keep a conclusion; where the folder cannot be written, it is made again the next time."""
    harm = None if made.harm_m is None else base64.b64encode(made.harm_m.tobytes()).decode("ascii")
    findings = [dataclasses.asdict(finding) for finding in made.findings]
    values = {"key": key, "harm_m": harm, "harm_from": made.harm_from, "note": made.note, "findings": findings}
    part = _file(run).with_suffix(".part")
    with contextlib.suppress(OSError):
        part.write_text(json.dumps(values), encoding="utf-8")
        part.replace(_file(run))


def _finding(values: Mapping[str, Any]) -> Finding:
    """A finding of its plain values."""
    return Finding(
        **{
            **values,
            "severity": Severity(values["severity"]),
            "spans": tuple((first, last) for first, last in values["spans"]),
            "evidence": tuple(Evidence(**one) for one in values["evidence"]),
        }
    )
