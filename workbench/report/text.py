"""The facts of a run as short Markdown, for a pull request."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from workbench.report.facts import Facts, commands, drift_text, harm_text, spans_text
from workbench.report.page import WORDS, metric_rows
from workbench.safe_text import printable

FINDINGS = 10
"""Findings that are told in full."""


def markdown(facts: Facts, pictures: Mapping[int, Sequence[str]]) -> str:
    """The facts as Markdown; `pictures` are links to files by frame."""
    return "\n\n".join(block for block in _blocks(facts, pictures) if block) + "\n"


def _blocks(facts: Facts, pictures: Mapping[int, Sequence[str]]) -> Iterable[str]:
    yield f"## {plain(facts.title)}"
    yield f"**{WORDS[facts.gravity]}**: {plain(facts.upshot)}"
    yield _bullets(facts.advice[1:])
    yield _titled("Not in this report", _bullets(facts.missing))
    yield _table(("fact", ""), facts.about)
    yield _titled("Changed settings", _table(("setting", "here", "preset"), facts.settings) if facts.settings else "")
    yield _titled("Damage and clocks", _bullets([*facts.damage, *facts.oddities]))
    if facts.metrics:
        yield _titled("Metrics", _table(*metric_rows(facts.metrics)))
    yield _titled("Verdicts", ", ".join(f"{c.name} {c.frames}" for c in facts.verdicts))
    if facts.drift is not None:
        yield f"Drift budget: {plain(drift_text(facts.drift))}"
    yield "### Findings"
    yield from _findings(facts, pictures)
    versions = ", ".join(plain(f"{name} {version}") for name, version in facts.versions[:3])
    yield f"Recording SHA-256 {_code(facts.run.digest[:16])}…; {versions}"


def _findings(facts: Facts, pictures: Mapping[int, Sequence[str]]) -> Iterable[str]:
    if not facts.findings:
        yield "The diagnosis found nothing."
    for k, f in enumerate(facts.findings[:FINDINGS]):
        grave = ", ".join(filter(None, (WORDS[f.severity], harm_text(facts, f))))
        cause, remedy = (plain(text).rstrip(".") for text in (f.cause, f.remedy))
        lines = [
            f"{k + 1}. **{plain(f.rule)}** ({grave}): {plain(f.sentence)}",
            f"   Frames {spans_text(f, 4)}; worst {f.worst_frame}. Likely cause: {cause}. Try: {remedy}.",
            *(f"   {_code(line)}  " for line in commands(facts, f)),
            *(f"   ![frame {f.worst_frame}]({link})" for link in pictures.get(f.worst_frame, ())),
        ]
        yield "\n".join(lines)
    rest = len(facts.findings) - FINDINGS
    if rest > 0:
        yield f"{rest} more findings are in the HTML report."


def plain(text: str) -> str:
    """A text that Markdown and HTML take as it stands: on one line, every mark of theirs escaped."""
    line = " ".join(printable(text).split())
    return re.sub(r"([\\`*_\[\]<>|#~&@])", r"\\\1", line).replace("\\<", "&lt;").replace("\\>", "&gt;")


def _code(text: str) -> str:
    """A text as code, with a fence longer than any row of back quotes in it."""
    line = " ".join(printable(text).split())
    fence = "`" * (max((len(run) for run in re.findall("`+", line)), default=0) + 1)
    pad = " " if "`" in line else ""
    return f"{fence}{pad}{line}{pad}{fence}"


def _titled(title: str, body: str) -> str:
    return f"### {title}\n\n{body}" if body else ""


def _bullets(texts: Sequence[str]) -> str:
    return "\n".join(f"- {plain(text)}" for text in texts)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *(f"| {' | '.join(map(plain, row))} |" for row in rows)])
