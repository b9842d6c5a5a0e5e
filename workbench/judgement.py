"""What is concluded of a finished run: its drift budget and the findings of its diagnosis.

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
from workbench import diagnosis
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Case, Evidence, Finding
from workbench.runs import Run


@dataclass(frozen=True)
class Judgement:
    """Findings, the worst first; harm of each frame in m [n], None without a reference.

    The harm of a frame is signed: what it adds to the length of the end-point error.
    """

    findings: tuple[Finding, ...]
    harm_m: NDArray[np.float64] | None


def judged(run: Run) -> Judgement:
    """Judge a run, or take what was concluded before.

    Raises:
        RecordingError: its files cannot be read.
    """
    key = _key(run)
    kept = _kept(run, key)
    if kept is not None:
        return kept
    budget = budget_of(run)
    harm = None if budget is None else harm_of(run, budget)
    made = Judgement(tuple(diagnose(Case.of_run(run, harm))), harm)
    _keep(run, key, made)
    return made


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


def harm_of(run: Run, budget: DriftBudget) -> NDArray[np.float64]:
    """The harm of every frame of a run in m [n]; NaN of frames that the budget does not know."""
    estimate = run.trajectory
    assert estimate is not None
    harm = np.full(len(run.frames), np.nan)
    rows = np.searchsorted(run.t_ns, estimate.t_ns[budget.index])
    harm[rows] = budget.harm_m
    return harm


# ------------------------------------------------------------------------------ what is kept


def _file(run: Run) -> Path:
    return run.path("judgement.json")


def _key(run: Run) -> str:
    """What a conclusion was made of: the run's files by size and time, the rules by their text."""
    total = hashlib.sha256()
    for file in (run.file, run.path("toml"), run.sensors_file):
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
        return Judgement(tuple(map(_finding, values["findings"])), harm)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _keep(run: Run, key: str, made: Judgement) -> None:
    """Keep a conclusion; where the folder cannot be written, it is made again the next time."""
    harm = None if made.harm_m is None else base64.b64encode(made.harm_m.tobytes()).decode("ascii")
    values = {"key": key, "harm_m": harm, "findings": [dataclasses.asdict(finding) for finding in made.findings]}
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
