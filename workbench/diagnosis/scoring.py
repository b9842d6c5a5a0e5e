"""How well the rules name what is wrong: missions with a planted fault, scored over many seeds.

    python -m workbench.diagnosis.scoring --estimator correlation --seeds 20

prints the confusion matrix and writes it to docs/diagnosis-matrix-ESTIMATOR.md. An estimator's faults are a table of
`Planted`; how they are scored stands here for all.
"""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pipelines.verdict import Severity
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Bools, Case, Finding

MARGIN = 2
"""A finding counts as being at a fault's frames if it is at most so many frames beside."""
BAR = 0.95
CLEAN = "clean"
TABLES = {
    "correlation": "workbench.diagnosis.path_scoring",
    "range": "workbench.diagnosis.range_scoring",
    "semidirect": "workbench.diagnosis.visual_scoring",
}
"""The module of each estimator whose `planted(preset)` gives the table, and `LEFT_OUT` the faults without a trace."""
PRESETS = {"semidirect": "fast"}
"""The preset that is scored where none is given; of the others "best"."""


@dataclass(frozen=True)
class Trial:
    """One mission as the rules see it, and the frames [n] at which its fault is; none in a clean one."""

    case: Case
    at_fault: Bools


@dataclass(frozen=True, kw_only=True)
class Planted:
    """One kind of fault.

    Attributes:
        fault: its name.
        rule: the rule that is the right answer; "" for missions in which nothing grave is to be found.
        trial: makes the mission of a seed, of so and so many frames.
        strength: within what range the seeds vary it, for the table.
        also: rules that may rightly speak besides, of what the fault leads to; they count neither way.
    """

    fault: str
    rule: str
    trial: Callable[[int], Trial]
    strength: str
    also: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Scored:
    """What was found in one trial.

    Attributes:
        fault: name of the fault.
        right: the rule that is the right answer.
        seed: of the trial.
        here: the rules of the findings at the fault's frames.
        elsewhere: those of the others.
        errors: those with the severity "error".
    """

    fault: str
    right: str
    seed: int
    here: tuple[str, ...]
    elsewhere: tuple[str, ...]
    errors: tuple[str, ...]


def score(planted: Planted, seed: int) -> Scored:
    """Diagnose one trial."""
    trial = planted.trial(seed)
    found = [finding for finding in diagnose(trial.case) if finding.rule not in planted.also]
    here = [finding for finding in found if touches(finding, trial)]
    return Scored(
        fault=planted.fault,
        right=planted.rule,
        seed=seed,
        here=_names(here),
        elsewhere=_names(finding for finding in found if finding not in here),
        errors=_names(finding for finding in found if finding.severity is Severity.ERROR),
    )


def scores(estimator: str, preset: str, faults: Sequence[str], seeds: Sequence[int], jobs: int = 1) -> list[Scored]:
    """Diagnose the trials of some faults over some seeds; `jobs` processes share them."""
    pairs = [(fault, seed) for fault in faults for seed in seeds]
    one = partial(_one, estimator, preset)
    if jobs == 1:
        return [one(pair) for pair in pairs]
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(one, pairs, chunksize=2))


def _one(estimator: str, preset: str, pair: tuple[str, int]) -> Scored:
    fault, seed = pair
    return score(next(one for one in table_of(estimator, preset) if one.fault == fault), seed)


def table_of(estimator: str, preset: str) -> tuple[Planted, ...]:
    """The faults of an estimator."""
    found: tuple[Planted, ...] = importlib.import_module(TABLES[estimator]).planted(preset)
    return found


def touches(finding: Finding, trial: Trial) -> bool:
    """Whether a finding has a frame at the fault, `MARGIN` frames more or less."""
    return any(finding.covers(int(frame), MARGIN) for frame in trial.case.frame[trial.at_fault])


def _names(found: Iterable[Finding]) -> tuple[str, ...]:
    return tuple(finding.rule for finding in found)


# ------------------------------------------------------------------------------------ figures


@dataclass(frozen=True)
class Figures:
    """Of one kind of fault, over all its trials.

    Attributes:
        trials: how many.
        recall: share of the trials in which the right rule is among the findings at the fault's frames.
        precision: share of the findings at the fault's frames, of all trials together, that are of the right rule.
        rules: how many findings of each rule were at the fault's frames.
        elsewhere: findings beside them.
    """

    trials: int
    recall: float
    precision: float
    rules: Mapping[str, int]
    elsewhere: Mapping[str, int]

    @classmethod
    def of(cls, scored: Sequence[Scored]) -> Figures:
        """The figures of some trials of one fault."""
        hits = sum(one.right in one.here for one in scored)
        rules = _counted(name for one in scored for name in one.here)
        named = sum(rules.values())
        right = sum(count for name, count in rules.items() if name == scored[0].right)
        return cls(
            trials=len(scored),
            recall=hits / len(scored),
            precision=right / named if named else float("nan"),
            rules=rules,
            elsewhere=_counted(name for one in scored for name in one.elsewhere),
        )


def _counted(names: Iterable[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for name in names:
        counts[name] = counts.get(name, 0) + 1
    return dict(sorted(counts.items()))


def by_fault(scored: Iterable[Scored]) -> dict[str, list[Scored]]:
    """The trials of each fault, in the order in which they came."""
    grouped: dict[str, list[Scored]] = {}
    for one in scored:
        grouped.setdefault(one.fault, []).append(one)
    return grouped


def failures(scored: Iterable[Scored]) -> list[str]:
    """What misses the bar: recall and precision of each fault, and errors in clean missions."""
    found = []
    for fault, trials in by_fault(scored).items():
        figures = Figures.of(trials)
        if not trials[0].right:
            found += [f"{fault}, seed {one.seed}: error {name}" for one in trials for name in one.errors]
        elif not (figures.recall >= BAR and figures.precision >= BAR):
            found.append(f"{fault}: recall {figures.recall:.2f}, precision {figures.precision:.2f}")
    return found


# --------------------------------------------------------------------------------- as Markdown


def to_markdown(
    scored: Sequence[Scored], table: Sequence[Planted], left_out: Mapping[str, str], *, title: str, made: str
) -> str:
    """The page with the figures and the confusion matrix."""
    grouped = by_fault(scored)
    lines = [
        f"# {title}",
        "",
        f"Made by `python -m workbench.diagnosis.scoring {made}`; [diagnosis.md](diagnosis.md) says what is counted.",
        "",
        "| Fault | Strength | Right rule | Trials | Recall | Precision | Other rules at its frames | Elsewhere |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [_figures_row(planted, Figures.of(grouped[planted.fault])) for planted in table]
    for fault, trials in grouped.items():
        if not trials[0].right:
            errors = sum(len(one.errors) for one in trials)
            lines += ["", f'Findings of severity "error" in {len(trials)} missions "{fault}": {errors}.']
    if left_out:
        lines += ["", "## Without a trace", "", "| Fault | Why it cannot be told |", "|---|---|"]
        lines += [f"| {fault} | {why} |" for fault, why in left_out.items()]
    return "\n".join([*lines, "", "## Confusion matrix", "", *_matrix(table, grouped), ""])


def _figures_row(planted: Planted, figures: Figures) -> str:
    if not planted.rule:
        found = _listed(figures.elsewhere)
        return f"| {planted.fault} | {planted.strength} | none | {figures.trials} | | | | {found} |"
    others = {name: count for name, count in figures.rules.items() if name != planted.rule}
    return (
        f"| {planted.fault} | {planted.strength} | `{planted.rule}` | {figures.trials} | {figures.recall:.2f} | "
        f"{figures.precision:.2f} | {_listed(others)} | {_listed(figures.elsewhere)} |"
    )


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _matrix(table: Sequence[Planted], grouped: Mapping[str, Sequence[Scored]]) -> list[str]:
    """Rows: faults. Columns: rules by number. Cells: findings at the fault's frames; for clean ones all findings."""
    counts = {}
    for planted in table:
        figures = Figures.of(grouped[planted.fault])
        counts[planted.fault] = figures.rules if planted.rule else figures.elsewhere
    wanted = [planted.rule for planted in table if planted.rule]
    found = sorted({name for row in counts.values() for name in row} - set(wanted))
    rules = [*dict.fromkeys(wanted), *found]
    lines = [
        "Findings at the frames of each fault (of clean missions: all findings) by rule.",
        "",
        "| | " + " | ".join(rules) + " |",
        "|---|" + "---|" * len(rules),
    ]
    for fault, row in counts.items():
        lines.append(f"| {fault} | " + " | ".join(str(row.get(rule, "")) for rule in rules) + " |")
    return lines


# ------------------------------------------------------------------------------- command line


def main(arguments: Sequence[str] | None = None) -> int:
    """Score the rules of an estimator; 1 where a bar is missed."""
    parser = argparse.ArgumentParser(prog="python -m workbench.diagnosis.scoring", description=main.__doc__)
    parser.add_argument("--estimator", choices=sorted(TABLES), required=True)
    parser.add_argument("--preset", help="best, of semidirect fast, by default")
    parser.add_argument("--seeds", type=int, default=20, help="how many seeds a fault")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--fault", action="append", help="only this fault; may be repeated")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the trials")
    parser.add_argument(
        "-o", "--output", type=Path, help="Markdown file; docs/diagnosis-matrix-ESTIMATOR.md by default"
    )
    asked = parser.parse_args(arguments)
    module: Any = importlib.import_module(TABLES[asked.estimator])
    preset = asked.preset or PRESETS.get(asked.estimator, "best")
    table = [one for one in table_of(asked.estimator, preset) if not asked.fault or one.fault in asked.fault]
    seeds = range(asked.first_seed, asked.first_seed + asked.seeds)
    scored = scores(asked.estimator, preset, [one.fault for one in table], seeds, asked.jobs)
    page = to_markdown(
        scored,
        table,
        module.LEFT_OUT,
        title=f"Diagnosis of `{asked.estimator}`, preset `{preset}`: scored on planted faults",
        made=f"--estimator {asked.estimator} --seeds {asked.seeds} --first-seed {asked.first_seed}",
    )
    default = Path(__file__).parents[2] / "docs" / f"diagnosis-matrix-{asked.estimator}.md"
    if asked.output or not asked.fault:  # some faults only are no page of all
        (asked.output or default).write_text(page, encoding="utf-8")
    missed = failures(scored)
    sys.stdout.write(page + "".join(f"misses the bar: {line}\n" for line in missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
