"""Why an estimator failed: rules look at a run's numbers and name frames, cause and remedy.

findings = diagnose(Case.of_run(open_run("results/mission")))
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Iterable

import numpy as np

from pipelines.evaluation import path_lengths
from pipelines.verdict import Severity
from workbench.diagnosis.finding import Case, Finding, Rule

GRAVE_SHARE = 0.01
"""A finding whose frames add more than this share of the path to the end-point error is an error, whatever its rule."""


_MODULES = {"correlation": "path_rules", "range": "range_rules", "semidirect": "visual_rules", "ptam": "visual_rules"}
"""Where the rules for each estimator are; they are imported for its runs alone."""


def all_rules() -> tuple[Rule, ...]:
    """Every rule that there is."""
    return tuple(rule for estimator in _MODULES for rule in rules_of(estimator))


def rules_of(estimator: str) -> tuple[Rule, ...]:
    """The rules for runs of one estimator; none for one that has none."""
    if estimator not in _MODULES:
        return ()
    rules: tuple[Rule, ...] = importlib.import_module(f"{__name__}.{_MODULES[estimator]}").RULES
    return tuple(rule for rule in rules if rule.estimator == estimator)


def diagnose(case: Case, rules: Iterable[Rule] | None = None) -> list[Finding]:
    """All findings in a case, those that did the most harm first, then the gravest, then the earliest."""
    chosen = rules_of(case.estimator) if rules is None else rules
    found = [_with_harm(case, finding) for rule in chosen for finding in rule.find(case, rule)]
    return sorted(found, key=_rank)


def _with_harm(case: Case, finding: Finding) -> Finding:
    """The finding with what its frames add to the end-point error; an error where that is much of the path."""
    covered = np.array([finding.covers(int(frame)) for frame in case.frame])
    harm = case.harm_m[covered]
    known = np.isfinite(harm)
    if not known.any():
        return finding
    total = float(harm[known].sum())
    grave = abs(total) > GRAVE_SHARE * _path_m(case)
    severity = max(finding.severity, Severity.ERROR) if grave else finding.severity
    return dataclasses.replace(finding, harm_m=total, severity=severity)


def _path_m(case: Case) -> float:
    """Length of the reference path, infinite where it is not known."""
    places = case.reference[np.isfinite(case.reference[:, :2]).all(axis=1), :2]
    return float(path_lengths(places)[-1]) if len(places) > 1 else math.inf


def _rank(finding: Finding) -> tuple[float, float, int]:
    harm = 0.0 if math.isnan(finding.harm_m) else abs(finding.harm_m)
    return (-harm, -float(finding.severity), finding.worst_frame)
