"""Rules for runs of the range estimator."""

from __future__ import annotations

from workbench.diagnosis.finding import Rule

RULES: tuple[Rule, ...] = ()
