"""How well the rules of the range estimator tell planted failures: recall, precision, the confusion matrix.

    python -m workbench.diagnosis.range_scoring --seeds 20

prints the matrix and writes docs/diagnosis-matrix-range.md. Same seeds, same text.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pipelines.verdict import Severity
from workbench.diagnosis import diagnose, range_rules
from workbench.diagnosis.range_missions import CLEAN, MISSIONS, OTHERS, replayed

MARGIN = 2
"""Frames beside those of a failure at which a finding still counts as at its frames."""
PAGE = Path(__file__).parents[2] / "docs" / "diagnosis-matrix-range.md"


class Told(NamedTuple):
    """The names of the findings of one mission: at the failure's frames, elsewhere, and those of severity error."""

    at: tuple[str, ...]
    elsewhere: tuple[str, ...]
    errors: tuple[str, ...]


@dataclass(frozen=True)
class Score:
    """What was told of the missions of one failure.

    Attributes:
        failure: its name, which is that of the right rule; one of `OTHERS` has none.
        missions: one entry a seed.
    """

    failure: str
    missions: tuple[Told, ...]

    @property
    def counts(self) -> Counter[str]:
        """How many findings of each rule there are at the failure's frames."""
        return Counter(name for told in self.missions for name in told.at)

    @property
    def elsewhere(self) -> Counter[str]:
        """How many findings of each rule there are at other frames only."""
        return Counter(name for told in self.missions for name in told.elsewhere)

    @property
    def recall(self) -> float:
        """Share of the missions in which the right rule is among the findings at the failure's frames."""
        return sum(self.failure in told.at for told in self.missions) / len(self.missions)

    @property
    def precision(self) -> float:
        """Share of the findings at the failure's frames that are of the right rule; NaN where there are none."""
        total = self.counts.total()
        return self.counts[self.failure] / total if total else math.nan

    @property
    def errors(self) -> int:
        """Findings of severity error, anywhere in the missions."""
        return sum(len(told.errors) for told in self.missions)


def told_of(failure: str, seed: int, mode: str = "independent") -> Told:
    """Make, replay and diagnose one mission."""
    made = replayed(failure, seed, mode=mode)
    findings = diagnose(made.case, range_rules.RULES)
    here = {id(f) for f in findings if any(f.covers(int(frame), MARGIN) for frame in made.wrong)}
    return Told(
        tuple(f.rule for f in findings if id(f) in here),
        tuple(f.rule for f in findings if id(f) not in here),
        tuple(f.rule for f in findings if f.severity is Severity.ERROR),
    )


def scored(failures: Iterable[str], seeds: Sequence[int], *, mode: str = "independent", jobs: int = 1) -> list[Score]:
    """The scores of some failures over some seeds; `jobs` processes share the missions."""
    names = list(failures)
    pairs = [(name, seed) for name in names for seed in seeds]
    arguments = [name for name, _ in pairs], [seed for _, seed in pairs]
    one = partial(told_of, mode=mode)
    if jobs == 1:
        told = list(map(one, *arguments))
    else:
        with ProcessPoolExecutor(jobs) as pool:
            told = list(pool.map(one, *arguments, chunksize=4))
    width = len(seeds)
    return [Score(name, tuple(told[k * width : (k + 1) * width])) for k, name in enumerate(names)]


# ------------------------------------------------------------------------------ as a page


def _words(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {counts[name]}" for name in sorted(counts)) or "–"


def page(scores: Sequence[Score], seeds: Sequence[int], mode: str) -> str:
    """The scores as a page of Markdown."""
    rules = [rule.name for rule in range_rules.RULES]
    planted = [score for score in scores if score.failure in MISSIONS]
    others = [score for score in scores if score.failure not in MISSIONS]
    lines = [
        "# Failures of the range filter: planted and told",
        "",
        f"Made by `python -m workbench.diagnosis.range_scoring --seeds {len(seeds)} --first {seeds[0]}"
        + ("" if mode == "independent" else f" --mode {mode}")
        + "`; do not edit.",
        f"{len(seeds)} missions each, seeds {seeds[0]}-{seeds[-1]}; mode `{mode}`. What is planted, and what recall",
        "and precision are, is in [diagnosis-range.md](diagnosis-range.md#scores).",
        "",
        "| planted | recall | precision | findings elsewhere |",
        "|---|---|---|---|",
    ]
    lines += [f"| {s.failure} | {s.recall:.2f} | {s.precision:.2f} | {_words(s.elsewhere)} |" for s in planted]
    lines += ["", "| nothing to be found | findings of severity error | all findings |", "|---|---|---|"]
    for s in others:
        lines.append(f"| {s.failure} | {s.errors} | {_words(s.counts + s.elsewhere)} |")
    lines += [
        "",
        "## Confusion matrix",
        "",
        "Findings at the frames of the planted failure, ±2; columns are the rules:",
        "",
    ]
    lines.append(" · ".join(f"{k + 1} {name}" for k, name in enumerate(rules)))
    lines += [
        "",
        "| planted | " + " | ".join(str(k + 1) for k in range(len(rules))) + " |",
        "|---" * (len(rules) + 1) + "|",
    ]
    for s in sorted(planted, key=lambda s: rules.index(s.failure)):
        cells = (str(s.counts[name] or "") for name in rules)
        lines.append(f"| {rules.index(s.failure) + 1} {s.failure} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Score all failures; write the page and print it."""
    parser = argparse.ArgumentParser(description="Score the rules of the range estimator on planted failures.")
    parser.add_argument("--seeds", type=int, default=20, help="missions of each failure")
    parser.add_argument("--first", type=int, default=0, help="first seed; the rules were tuned on 100 and above")
    parser.add_argument("--mode", choices=("independent", "joint"), default="independent", help="of the filter")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--only", nargs="*", choices=[*MISSIONS, *OTHERS], help="some failures; no page is written")
    parser.add_argument("-o", "--out", type=Path, default=PAGE, help="the page")
    given = parser.parse_args(arguments)
    if given.seeds < 1 or given.first < 0 or given.jobs < 1:
        parser.error("--seeds and --jobs are 1 or more, --first is 0 or more")
    seeds = range(given.first, given.first + given.seeds)
    found = scored(given.only or [*MISSIONS, *OTHERS], seeds, mode=given.mode, jobs=given.jobs)
    text = page(found, seeds, given.mode)
    if not given.only:
        given.out.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


__all__ = ["CLEAN", "MARGIN", "Score", "Told", "main", "page", "scored", "told_of"]

if __name__ == "__main__":
    main()
