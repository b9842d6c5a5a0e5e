"""The numbers by which runs are compared, checked and swept: a run's summary as names and numbers.

Names are dotted: ``frames``, ``verdict.PEAK_AMBIGUOUS`` and ``alarm.…`` (frames), ``share.OK`` (%),
``drift_percent``, ``ape_m.rmse``, ``rpe.1 s.translation_m.rmse``, ``ranging.error.median_percent``,
``odometry.losses``, ``finding.motion-blur`` and ``findings.error`` (how many).
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from pipelines.verdict import Verdict
from readers.streams import WorkbenchError
from workbench.diagnosis.finding import Finding

COUNTED = {"verdicts": "verdict", "alarms": "alarm"}
EPISODES = ("losses", "relocalised", "starts")
"""Of a visual odometry: how often."""
NOT_NUMBERS = ("total", "matched")


class MetricError(WorkbenchError):
    """A metric that a run does not have; the text names those that are alike."""


def metrics(summary: Mapping[str, Any], findings: Iterable[Finding] | None = None) -> dict[str, float]:
    """Every number of a run's summary by its name; those of `findings`, where they are given.

    Args:
        summary: the table ``summary`` of RUN.toml.
        findings: those of the run's diagnosis.
    """
    found: dict[str, float] = {}
    for key in ("frames", "duration_s", "path_length"):
        if key in summary:
            found[key] = float(summary[key])
    for table, name in COUNTED.items():
        found |= {f"{name}.{flag}": float(count) for flag, count in summary.get(table, {}).items()}
    frames = found.get("frames", 0.0)
    if frames:
        found["share.OK"] = 100 * summary.get("verdicts", {}).get("OK", 0) / frames
    evaluation = dict(summary.get("evaluation") or {})
    for relative in evaluation.pop("rpe", ()):
        span = f"rpe.{relative['delta']:g} {relative['unit']}"
        found |= _flat({k: relative[k] for k in ("translation_m", "heading_deg") if k in relative}, f"{span}.")
    found |= _flat(evaluation, "")
    if "ranging" in summary:
        found |= _flat({k: v for k, v in summary["ranging"].items() if k != "per_landmark"}, "ranging.")
    if "odometry" in summary:
        found |= _flat(summary["odometry"], "odometry.")
        found |= {f"odometry.{name}": float(len(summary["odometry"][name])) for name in EPISODES}
    if findings is not None:
        found |= _of_findings(list(findings))
    return found


def _of_findings(findings: list[Finding]) -> dict[str, float]:
    rules = Counter(finding.rule for finding in findings)
    grades = Counter(finding.severity.name.lower() for finding in findings)
    grades |= Counter(dict.fromkeys(("notice", "warning", "error"), 0))
    return {
        **{f"finding.{name}": float(count) for name, count in rules.items()},
        **{f"findings.{name}": float(grades[name]) for name in ("notice", "warning", "error")},
    }


def _flat(values: Mapping[str, Any], before: str) -> dict[str, float]:
    """The numbers of nested tables with dotted names; texts and lists are left out."""
    found: dict[str, float] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{before}{key}.")
        elif isinstance(value, int | float) and not isinstance(value, bool) and key not in NOT_NUMBERS:
            found[before + key] = float(value)
    return found


def metric(found: Mapping[str, float], name: str) -> float:
    """One number by its name; 0 for a verdict, an alarm or a finding that did not occur; NaN where it is unknown.

    Raises:
        MetricError: runs of this kind have no such number.
    """
    if name in found:
        return found[name]
    head, _, tail = name.partition(".")
    if head in COUNTED.values() and tail in Verdict.__members__:
        return 0.0
    if head == "finding" and tail in _rule_names():
        return 0.0
    near = difflib.get_close_matches(name, _known(found), n=3, cutoff=0.5)
    cure = f"did you mean {' or '.join(near)}?" if near else "workbench check RUN --list prints all names"
    raise MetricError(f"there is no metric {name!r} in this run; {cure}")


def _known(found: Mapping[str, float]) -> list[str]:
    flags = [f"{head}.{name}" for head in COUNTED.values() for name in Verdict.__members__]
    return [*found, *flags, *(f"finding.{name}" for name in _rule_names())]


def _rule_names() -> set[str]:
    from workbench.diagnosis import all_rules

    return {rule.name for rule in all_rules()}
