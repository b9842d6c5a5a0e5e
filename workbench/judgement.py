"""What is concluded of a finished run: its drift budget and the findings of its diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.drift import DriftBudget, drift_budget
from pipelines.evaluation import EvaluationError
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Case, Finding
from workbench.runs import Run


@dataclass(frozen=True)
class Judgement:
    """Findings, the worst first; the drift budget, None without a reference; harm of each frame in m [n] or None.

    The harm of a frame is signed: what it adds to the length of the end-point error.
    """

    findings: tuple[Finding, ...]
    budget: DriftBudget | None
    harm_m: NDArray[np.float64] | None


def judged(run: Run) -> Judgement:
    """Judge a run.

    Raises:
        RecordingError: its files cannot be read.
    """
    budget = budget_of(run)
    harm = None if budget is None else harm_of(run, budget)
    return Judgement(tuple(diagnose(Case.of_run(run, harm))), budget, harm)


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
