"""Why an estimator failed: rules look at a run's numbers and name frames, cause and remedy.

findings = diagnose(Case.of_run(open_run("results/mission")))
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np

from workbench.diagnosis.finding import Case, Finding, Rule


def all_rules() -> tuple[Rule, ...]:
    """Every rule that there is."""
    from workbench.diagnosis import path_rules, range_rules

    return (*path_rules.RULES, *range_rules.RULES)


def rules_of(estimator: str) -> tuple[Rule, ...]:
    """The rules for runs of one estimator."""
    return tuple(rule for rule in all_rules() if rule.estimator == estimator)


def diagnose(case: Case, rules: Iterable[Rule] | None = None) -> list[Finding]:
    """All findings in a case, those that did the most harm first, then the gravest, then the earliest."""
    chosen = rules_of(case.estimator) if rules is None else rules
    found = [_with_harm(case, finding) for rule in chosen for finding in rule.find(case, rule)]
    return sorted(found, key=_rank)


def _with_harm(case: Case, finding: Finding) -> Finding:
    """The finding with what its frames add to the end-point error."""
    covered = np.array([finding.covers(int(frame)) for frame in case.frame])
    harm = case.harm_m[covered]
    known = np.isfinite(harm)
    return dataclasses.replace(finding, harm_m=float(harm[known].sum())) if known.any() else finding


def _rank(finding: Finding) -> tuple[float, float, int]:
    harm = 0.0 if math.isnan(finding.harm_m) else abs(finding.harm_m)
    return (-harm, -float(finding.severity), finding.worst_frame)
