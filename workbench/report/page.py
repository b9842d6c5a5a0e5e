"""The facts of a run as one page that needs nothing but itself: no request ever leaves it."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from importlib import resources

import numpy as np

from pipelines.verdict import Severity
from workbench.diagnosis.finding import Evidence, Finding
from workbench.judgement import Drift
from workbench.report import plots
from workbench.report.curves import Chart, Curve, seconds
from workbench.report.facts import Counted, Facts, Metric, commands, drift_text, harm_text, length, spans_text
from workbench.report.markup import Content, Element, el, page
from workbench.report.pictures import Picture

FIRST = 3
"""Findings at the top."""
PICTURED = 12
"""Findings with a picture."""
DETAILED = 40
"""Findings with a section of their own."""
WORST = 12
"""Rows of the drift budget."""

WORDS = {Severity.FINE: "fine", Severity.NOTICE: "notice", Severity.WARNING: "warning", Severity.ERROR: "error"}


def html(facts: Facts, pictures: Mapping[int, Picture]) -> str:
    """The page of a run, with the pictures of some frames."""
    sections = [one for one in _sections(facts, pictures) if one is not None]
    spans = json.dumps([[f.rule, [list(span) for span in f.spans]] for f in facts.findings], separators=(",", ":"))
    return framed(facts.title, "report of a run", sections, spans)


def framed(title: str, kind: str, sections: Sequence[Element], findings: str = "[]") -> str:
    """A whole page: head, table of contents, sections.

    Args:
        title: of the page.
        kind: what it is a page of.
        sections: of `section`.
        findings: the spans of frames that plots shade, as JSON.
    """
    style, script = (resources.files(__package__).joinpath(f"page.{end}").read_text("utf-8") for end in ("css", "js"))
    root = el(
        "html",
        el(
            "head",
            el("meta", charset="utf-8"),
            el("meta", http_equiv="Content-Security-Policy", content=_policy(style, script)),
            el("meta", name="viewport", content="width=device-width, initial-scale=1"),
            el("meta", name="color-scheme", content="light dark"),
            el("title", title),
            el("style", style),
        ),
        el(
            "body",
            el("a", "Skip to the report", href=f"#{sections[0].get('id')}", class_="skip"),
            el("header", el("p", f"Estimator workbench: {kind}", class_="kind"), el("h1", title)),
            el("nav", el("ul", [el("li", el("a", _heading(s), href=f"#{s.get('id')}")) for s in sections]),
               aria_label="Contents"),
            el("main", sections),
            el("script", script),
            data_findings=findings,
        ),
        lang="en",
    )  # fmt: skip
    return page(root)


def _policy(style: str, script: str) -> str:
    """A policy that lets this page's own style and script in, images that it holds, and nothing else."""

    def digest(text: str) -> str:
        return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"

    return (
        f"default-src 'none'; img-src data:; style-src {digest(style)}; script-src {digest(script)}; "
        "base-uri 'none'; form-action 'none'"
    )


def _heading(section: Element) -> str:
    found = section.find("h2")
    assert found is not None
    return found.text or ""


def section(key: str, title: str, *content: Content) -> Element:
    """A section with its heading."""
    return el("section", el("h2", title, id=f"{key}-title"), *content, id=key, aria_labelledby=f"{key}-title")


def _sections(facts: Facts, pictures: Mapping[int, Picture]) -> list[Element | None]:
    errors = [chart for chart in facts.charts if chart.key in ("position-error", "heading-error", "range-error")]
    others = [chart for chart in facts.charts if chart not in errors]
    return [
        _verdict(facts, errors[:1]),
        _missing(facts),
        _path(facts, errors),
        _findings(facts, pictures),
        _drift(facts),
        _metrics(facts),
        section("verdicts", "Verdicts of the frames", _counts("Verdicts", facts.verdicts),
                 _counts("Alarms (a frame can have several)", facts.alarms)),
        _estimator(facts, others),
        _run(facts),
        _settings(facts),
        _recording(facts),
        _versions(facts),
    ]  # fmt: skip


# ------------------------------------------------------------------------------------ at the top


def _verdict(facts: Facts, errors: Sequence[Chart]) -> Element:
    """The verdict, what did the most harm, and the error with the findings' frames."""
    known = any(math.isfinite(f.harm_m) for f in facts.findings) or not facts.findings
    first = [_card(facts, k, f) for k, f in enumerate(facts.findings[:FIRST])]
    found: Content = el("ol", first, class_="cards") if first else el("p", "The diagnosis found nothing.")
    return section(
        "verdict",
        "Verdict",
        el("p", el("strong", WORDS[facts.gravity], class_=f"badge {WORDS[facts.gravity]}"), " ", facts.upshot,
           class_="upshot"),
        listed(facts.advice[1:]),
        el("h3", "What did the most harm" if known else "The gravest findings"),
        found,
        el("p", "Plots: hover, or focus one and use the arrow keys (with Shift ten points, Home and End). Frames of "
           "findings are shaded.", class_="help"),
        [plots.chart_plot(chart, facts.findings) for chart in errors],
        plots.strip_plot(facts.strip, facts.findings),
    )  # fmt: skip


def _card(facts: Facts, place: int, finding: Finding) -> Element:
    word = WORDS[finding.severity]
    did = harm_text(facts, finding)
    harm: Content = (": ", el("strong", did)) if did else None
    return el(
        "li",
        el("p", el("strong", word, class_=f"badge {word}"), " ",
           el("a", finding.rule, href=f"#finding-{place + 1}"), harm),
        el("p", finding.sentence),
        el("p", f"Frames {spans_text(finding, 3)}; worst: {finding.worst_frame}.", class_="where"),
    )  # fmt: skip


def _missing(facts: Facts) -> Element | None:
    return section("missing", "What this report cannot tell", listed(facts.missing)) if facts.missing else None


def _path(facts: Facts, errors: Sequence[Chart]) -> Element | None:
    figures = [] if facts.ways is None else [plots.ways_plot(facts.ways, facts.findings)]
    figures += [plots.chart_plot(chart, facts.findings) for chart in errors[1:]]
    return section("path", "Path", figures) if figures else None


# ------------------------------------------------------------------------------------ findings


def _findings(facts: Facts, pictures: Mapping[int, Picture]) -> Element:
    if not facts.findings:
        return section("findings", "Findings", el("p", "The diagnosis found nothing in this run."))
    rows = table(
        "Findings, those that did the most harm first, then the gravest",
        ("#", "finding", "severity", "frames", "worst frame", "harm"),
        [
            (str(k + 1), el("a", f.rule, href=f"#finding-{k + 1}") if k < DETAILED else f.rule, WORDS[f.severity],
             str(f.frames), str(f.worst_frame), length(f.harm_m))
            for k, f in enumerate(facts.findings)
        ],
        right=(0, 3, 4, 5),
    )  # fmt: skip
    details = [_finding(facts, k, f, pictures.get(f.worst_frame)) for k, f in enumerate(facts.findings[:DETAILED])]
    rest = len(facts.findings) - len(details)
    more = el("p", f"{rest} more are only in the table; workbench explain shows each.") if rest > 0 else None
    return section("findings", "Findings", rows, details, more)


def _finding(facts: Facts, place: int, finding: Finding, picture: Picture | None) -> Element:
    word = WORDS[finding.severity]
    return el(
        "article",
        el("h3", f"{place + 1}. {finding.rule} ", el("span", word, class_=f"badge {word}")),
        el("p", finding.sentence, class_="sentence"),
        el(
            "dl",
            [
                (el("dt", name), el("dd", text))
                for name, text in (
                    ("Harm", harm_text(facts, finding)),
                    ("Frames", f"{spans_text(finding)} ({finding.frames} in all); the worst is {finding.worst_frame}"),
                    ("Likely cause", finding.cause),
                    ("What to try", finding.remedy),
                )
                if text
            ],
        ),
        _evidence(finding.evidence),
        el("p", "Look into it:"),
        el("pre", [el("code", line + "\n") for line in commands(facts, finding)], tabindex="0"),
        _pictures(picture),
        id=f"finding-{place + 1}",
        class_=f"finding {word}",
    )


def _evidence(evidence: Sequence[Evidence]) -> Element | None:
    if not evidence:
        return None
    rows = [
        (e.name, _number(e.value), _number(e.usual), _number(e.bound), "" if e.unit == "1" else e.unit)
        for e in evidence
    ]
    return table("Evidence at the worst frame", ("what", "there", "usual", "bound", "unit"), rows, right=(1, 2, 3))


def _pictures(picture: Picture | None) -> Element | None:
    if picture is None:
        return None
    parts = ((picture.image, picture.caption), (picture.closer, picture.closer_caption))
    figures = [el("figure", drawing, el("figcaption", text)) for drawing, text in parts if text]
    columns = range(1, len(picture.heads))
    rows = table(f"Numbers of frame {picture.frame}", picture.heads, picture.rows, columns) if picture.rows else None
    return el("div", el("div", figures, class_="pictures"), rows)


# ------------------------------------------------------------------------------------ numbers


def _drift(facts: Facts) -> Element | None:
    """The drift budget: along the run as sums, and the frames that did most."""
    budget = facts.drift
    if budget is None:
        return None
    shift, heading = (np.nancumsum(part) for part in (budget.shift_m, budget.heading_m))
    curves = (Curve("shift and heading", shift + heading), Curve("wrong shifts", shift), Curve("wrong turns", heading))
    about = f"What the frames up to here add to {budget.whole}."
    chart = Chart("drift", "Harm so far", "m", about, facts.run.frames, seconds(facts.run), curves)
    return section("drift", "Drift budget", el("p", drift_text(budget)), plots.chart_plot(chart, facts.findings),
                    _worst(facts, budget))  # fmt: skip


def _worst(facts: Facts, budget: Drift) -> Element:
    harm = np.nan_to_num(budget.harm_m, nan=-np.inf)
    order = [row for row in np.argsort(-harm, kind="stable")[:WORST].tolist() if harm[row] > 0]
    rows = []
    for row in order:
        frame = int(facts.run.frames[row])
        by = ", ".join(f.rule for f in facts.findings if f.covers(frame)) or "-"
        parts = (float(part[row]) for part in (budget.harm_m, budget.shift_m, budget.heading_m))
        rows.append((str(frame), *(length(part) for part in parts), facts.run.verdicts[row].name or "OK", by))
    heads = ("frame", "harm", "by shift", "by heading", "verdict", "finding")
    return table("Frames that did the most harm", heads, rows, right=(0, 1, 2, 3))


def _metrics(facts: Facts) -> Element | None:
    if not facts.metrics:
        return None
    return section("metrics", "Metrics", table("Evaluation", *metric_rows(facts.metrics), right=range(1, 6)))


def metric_rows(metrics: Sequence[Metric]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads and rows of the table of metrics."""
    rows = [
        (m.name, *map(_number, (m.value, m.rms, m.mean, m.median, m.largest)), "" if m.unit == "1" else m.unit)
        for m in metrics
    ]
    return ("metric", "value", "RMS", "mean", "median", "largest", "unit"), rows


def _number(value: float) -> str:
    return "" if math.isnan(value) else plots.number(value)


def _counts(title: str, counted: Sequence[Counted]) -> Element:
    if not counted:
        return el("p", f"{title.partition(' ')[0]}: none.")
    rows = [(c.name, str(c.frames), WORDS[c.severity], c.sentence) for c in counted]
    return table(title, ("name", "frames", "severity", "what it says"), rows, right=(1,))


def _estimator(facts: Facts, charts: Sequence[Chart]) -> Element | None:
    figures = [plots.chart_plot(chart, facts.findings) for chart in charts]
    return section("estimator", "What the estimator computed", figures) if figures else None


# ------------------------------------------------------------------------------------ where it comes from


def _run(facts: Facts) -> Element:
    rows = [(el("dt", name), el("dd", text)) for name, text in facts.about]
    return section("run", "Mission and run", el("dl", rows), listed(facts.notes))


def _settings(facts: Facts) -> Element:
    title, preset = "Changed settings", facts.run.preset
    if not facts.settings:
        return section("settings", title, el("p", f"All settings are those of the preset {preset}."))
    rows = table(f"Settings that differ from the preset {preset}", ("setting", "here", "preset"), facts.settings)
    return section("settings", title, rows)


def _recording(facts: Facts) -> Element:
    unknown = "" if facts.run.summary else "Not known: the replay did not come to its end."
    damage: Content = listed(facts.damage) or el("p", unknown or "No damage was found in what was read.")
    oddities: Content = listed(facts.oddities) or el("p", unknown or "Nothing odd was found about clocks and streams.")
    return section("recording", "Damage and clocks", el("h3", "Damage"), damage, el("h3", "Clocks and streams"),
                    oddities)  # fmt: skip


def _versions(facts: Facts) -> Element:
    return section(
        "versions",
        "Versions and digests",
        table("Versions", ("what", "version"), facts.versions),
        table("SHA-256", ("file", "size", "digest"), [(n, s, el("code", d)) for n, s, d in facts.digests], right=(1,)),
    )


# ------------------------------------------------------------------------------------ parts


def listed(texts: Sequence[str]) -> Element | None:
    """Texts as a list, None of none."""
    return el("ul", [el("li", text) for text in texts]) if texts else None


def table(caption: str, heads: Sequence[str], rows: Sequence[Sequence[Content]], right: Sequence[int] = ()) -> Element:
    """A table; the first cell of a row is its heading, the columns `right` hold numbers."""

    def kind(k: int) -> str | None:
        return "number" if k in right else None

    head = el("tr", [el("th", name, scope="col", class_=kind(k)) for k, name in enumerate(heads)])
    body = [
        el("tr", [el("th" if k == 0 else "td", cell, scope="row" if k == 0 else None, class_=kind(k))
                  for k, cell in enumerate(row)])
        for row in rows
    ]  # fmt: skip
    table = el("table", el("caption", caption), el("thead", head), el("tbody", body))
    return el("div", table, class_="scroll", tabindex="0", role="region", aria_label=caption)
