"""Plots as SVG: curves that stretch with the page, axes whose letters do not, numbers that the page's script reads.

A plot stands in four cells: the axis' numbers left of it and below are drawings of their own, placed in percent, so
that on a narrow page curves shrink and letters stay.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.verdict import Severity
from workbench.diagnosis.finding import Finding
from workbench.report.curves import Chart, Strip, Ways
from workbench.report.markup import Element, el

Floats = NDArray[np.float64]

WIDE, HIGH = 2000, 1000
"""Size of a plot's own coordinates."""
ASPECT = 1.6
"""Width to height of the view from above."""
LEVELS = {Severity.FINE: 150, Severity.NOTICE: 400, Severity.WARNING: 700, Severity.ERROR: 1000}
"""Height of a verdict's bar by its severity."""


class Axis:
    """Values from `low` to `high` over a length in the plot's coordinates; `flip` for upwards."""

    def __init__(self, low: float, high: float, length: int, *, flip: bool = False) -> None:
        self.low, self.high, self.length, self.flip = low, high, length, flip

    def __call__(self, values: Floats | float) -> Floats:
        """Where values lie."""
        share = (np.asarray(values, np.float64) - self.low) / (self.high - self.low)
        return np.asarray((1 - share if self.flip else share) * self.length, np.float64)

    def ticks(self, most: int) -> list[float]:
        """Round values on the axis, at most about that many."""
        rough = (self.high - self.low) / max(most, 1)
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(power * m for m in (1, 2, 5, 10) if power * m >= rough)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def value_axis(values: Iterable[Floats], *, from_zero: bool, ceiling: float = math.inf) -> Axis:
    """The axis that holds all finite values up to a ceiling, with a little room."""
    finite = np.concatenate([v[np.isfinite(v)] for v in values] or [np.zeros(0)])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    low, high = min(low, 0.0) if from_zero else low, min(high, ceiling)
    room = 0.05 * (high - low) or max(abs(high), 1e-9) * 0.1
    return Axis(low if from_zero and low == 0 else low - room, high + room, HIGH, flip=True)


def number(value: float) -> str:
    """A number for an axis or a table: four digits, no needless zeros."""
    return "no value" if math.isnan(value) else f"{0.0 if abs(value) < 1e-12 else value:.4g}"


# ------------------------------------------------------------------------------------ plots


def chart_plot(chart: Chart, findings: Sequence[Finding]) -> Element:
    """A plot over the frames with the findings' frames shaded."""
    thin = chart.readable().thinned()
    x = frame_axis(thin.frame)
    y = value_axis((curve.values for curve in thin.curves), from_zero=chart.from_zero, ceiling=chart.ceiling)
    at = x(thin.frame.astype(np.float64))
    lines = [
        el("path", d=path(at, y(curve.values)), class_=f"curve {curve.role} c{k % 8}")
        for k, curve in enumerate(thin.curves)
    ]
    data = {
        "kind": "curves",
        "frame": thin.frame.tolist(),
        "t": _rounded(thin.t_s, 3),
        "x": [x.low, x.high],
        "y": [y.low, y.high],
        "unit": "" if thin.unit == "1" else thin.unit,
        "lines": [{"name": c.name, "values": _significant(c.values), "dot": c.role != "bound"} for c in thin.curves],
    }
    unit = "" if thin.unit == "1" else f", {thin.unit}"
    body = [shades(findings, x), grid(x, y), lines, cursor(sum(c.role != "bound" for c in thin.curves))]
    return figure(chart.key, chart.title + unit, chart.about, data, body, x, y, "frame", legend(chart))


def strip_plot(strip: Strip, findings: Sequence[Finding]) -> Element:
    """The verdicts over the frames: the graver, the higher and redder."""
    x = frame_axis(strip.frame)
    edges = _edges(x(strip.frame.astype(np.float64)))
    bars = []
    severities = [v.severity for v in strip.verdicts]
    for severity in Severity:
        boxes = "".join(
            f"M{a:.0f} {HIGH}V{HIGH - LEVELS[severity]}H{b:.0f}V{HIGH}z"
            for a, b, s in zip(edges[:-1], edges[1:], severities, strict=True)
            if s is severity
        )
        if boxes:
            bars.append(el("path", d=boxes, class_=f"bar {severity.name.lower()}"))
    names = list(dict.fromkeys(v.name or "OK" for v in strip.verdicts))
    data = {
        "kind": "names",
        "frame": strip.frame.tolist(),
        "t": _rounded(strip.t_s, 3),
        "x": [x.low, x.high],
        "names": names,
        "values": [names.index(v.name or "OK") for v in strip.verdicts],
    }
    about = "The gravest verdict of each stretch of frames: the graver, the higher."
    body = [shades(findings, x), bars, cursor(0)]
    kinds = [(f"severity {s.name.lower()}", s.name.lower()) for s in Severity if s in severities]
    return figure("verdicts", "Verdicts", about, data, body, x, None, "frame", _keys(kinds))


def ways_plot(ways: Ways, findings: Sequence[Finding]) -> Element:
    """The paths from above, equal axes, the findings' frames in their colour."""
    thin = ways.thinned()
    x, y = _equal_axes(np.concatenate([thin.estimate, thin.reference]))
    known = bool(np.isfinite(thin.reference).all(axis=1).any())
    lines = [el("path", d=path(x(thin.reference[:, 0]), y(thin.reference[:, 1])), class_="curve reference")] * known
    lines.append(el("path", d=path(x(thin.estimate[:, 0]), y(thin.estimate[:, 1])), class_="curve line c0"))
    lines += [_stretch(finding, ways, x, y) for finding in reversed(findings)]
    data = {
        "kind": "ways",
        "frame": thin.frame.tolist(),
        "t": _rounded(thin.t_s, 3),
        "x": [x.low, x.high],
        "y": [y.low, y.high],
        "unit": "m",
        "lines": [
            {"name": f"{name} {axis}", "values": _significant(values[:, k], 6)}
            for name, values in (("estimate", thin.estimate), ("reference", thin.reference))[: 1 + known]
            for k, axis in enumerate("xy")
        ],
    }
    keys = (
        [("c0", "estimate")] + [("reference", "reference")] * known + [("error", "frames of findings")] * bool(findings)
    )
    about = "From above, x to the right and y up, in m; equal axes."
    body = [grid(x, y), lines, cursor(1 + known, line=False)]
    return figure("path", "Path", about, data, body, x, y, "x in m", _keys(keys))


def _stretch(finding: Finding, ways: Ways, x: Axis, y: Axis) -> Element:
    """The frames of a finding on the path."""
    parts = []
    for first, last in finding.spans:
        rows = slice(int(np.searchsorted(ways.frame, first)), int(np.searchsorted(ways.frame, last, side="right")))
        points = ways.estimate[rows][:: max(1, (rows.stop - rows.start) // 200)]
        text = path(x(points[:, 0]), y(points[:, 1]))
        parts.append(text + "h0" if len(points) == 1 else text)
    return el("path", d="".join(parts), class_=f"curve stretch {finding.severity.name.lower()}")


def _equal_axes(points: Floats) -> tuple[Axis, Axis]:
    """Axes of equal scale around points [n, 2], WIDE / HIGH stretched to `ASPECT` on the page."""
    seen = points[np.isfinite(points).all(axis=1)]
    low, high = (seen.min(axis=0), seen.max(axis=0)) if len(seen) else (np.zeros(2), np.ones(2))
    middle, size = (low + high) / 2, (high - low) * 1.1
    tall = max(float(size[1]), float(size[0]) / ASPECT, 1e-6)
    x = Axis(float(middle[0] - ASPECT * tall / 2), float(middle[0] + ASPECT * tall / 2), WIDE)
    return x, Axis(float(middle[1] - tall / 2), float(middle[1] + tall / 2), HIGH, flip=True)


# ------------------------------------------------------------------------------------ parts


def frame_axis(frame: NDArray[np.int64]) -> Axis:
    """The axis of frame numbers."""
    first, last = float(frame[0]), float(frame[-1])
    return Axis(first, last if last > first else first + 1, WIDE)


def path(x: Floats, y: Floats) -> str:
    """A line through points; a gap where one is not finite."""
    words, drawing = [], False
    finite = np.isfinite(x) & np.isfinite(y)
    alone = finite & ~np.r_[False, finite[:-1]] & ~np.r_[finite[1:], False]
    for a, b, good, single in zip(x.tolist(), y.tolist(), finite.tolist(), alone.tolist(), strict=True):
        if good:
            words.append(f"{'L' if drawing else 'M'}{a:.0f} {b:.0f}{'h0' if single else ''}")
        drawing = good
    return "".join(words)


def shades(findings: Sequence[Finding], x: Axis) -> list[Element]:
    """The findings' frames as stripes behind the curves, those that lie together as one."""
    found = []
    for finding in reversed(findings):
        edges: list[list[float]] = []
        for first, last in finding.spans:
            a, b = float(x(first - 0.5)), float(x(last + 0.5))
            a, b = min(a, WIDE - 4.0), max(b, a + 4.0)
            if edges and a <= edges[-1][1]:
                edges[-1][1] = b
            else:
                edges.append([a, b])
        boxes = "".join(f"M{a:.0f} 0H{b:.0f}V{HIGH}H{a:.0f}z" for a, b in edges)
        found.append(el("path", el("title", finding.rule), d=boxes, class_=f"shade {finding.severity.name.lower()}"))
    return found


def grid(x: Axis, y: Axis) -> Element:
    """Lines at the axes' numbers."""
    text = "".join(f"M0 {float(y(v)):.0f}H{WIDE}" for v in y.ticks(5))
    return el("path", d=text + "".join(f"M{float(x(v)):.0f} 0V{HIGH}" for v in x.ticks(5)), class_="grid")


def cursor(dots: int, *, line: bool = True) -> Element:
    """What the script moves: a line, and a dot for every curve."""
    upright = [el("path", d=f"M0 0V{HIGH}", class_="upright")] if line else []
    return el("g", upright, [el("path", d="M0 0h0", class_="dot") for _ in range(dots)], class_="cursor", hidden="")


def figure(
    key: str,
    title: str,
    about: str,
    data: dict[str, Any],
    body: Sequence[Any],
    x: Axis,
    y: Axis | None,
    below: str,
    keys: Element,
) -> Element:
    """A plot with its title, axes, legend and the line that tells what is under the cursor."""
    plane = el(
        "svg", *body, viewBox=f"0 0 {WIDE} {HIGH}", preserveAspectRatio="none", class_="plane", aria_hidden="true"
    )
    return el(
        "figure",
        el("figcaption", el("strong", title), " ", el("span", about, class_="about")),
        keys,
        el(
            "div",
            el("svg", _left(y), class_="left", aria_hidden="true"),
            plane,
            el("svg", _below(x, below), class_="below", aria_hidden="true"),
            class_="plot",
            tabindex="0",
            role="application",
            aria_label=f"{title}: arrow keys move along the frames",
            aria_describedby=f"read-{key}",
            data_chart=json.dumps(data, separators=(",", ":"), allow_nan=False),
        ),
        el("p", class_="readout", id=f"read-{key}", aria_live="polite"),
        class_=f"chart {data['kind']}",
        id=f"plot-{key}",
    )


def _left(axis: Axis | None) -> list[Element]:
    if axis is None:
        return []
    places = [(100 * float(axis(v)) / axis.length, number(v)) for v in axis.ticks(5)]
    return [el("text", text, x="100%", y=f"{p:.2f}%", dy="0.35em", dx="-4") for p, text in places]


def _below(axis: Axis, name: str) -> list[Element]:
    places = [(100 * float(axis(v)) / axis.length, number(v)) for v in axis.ticks(5)]
    ends = {True: "start", False: "middle"}
    marks = [
        el("text", f"{v:.0f}" if name == "frame" else text, x=f"{p:.2f}%", y="14",
           text_anchor="end" if p > 95 else ends[p < 3])
        for (p, text), v in zip(places, axis.ticks(5), strict=True)
    ]  # fmt: skip
    return [*marks, el("text", name, x="100%", y="30", text_anchor="end", class_="unit")]


def legend(chart: Chart) -> Element:
    """The names of a chart's curves with their colours."""
    return _keys([(f"{c.role} c{k % 8}", c.name) for k, c in enumerate(chart.curves)])


def _keys(keys: Sequence[tuple[str, str]]) -> Element:
    return el(
        "ul",
        [
            el("li", el("svg", el("path", d="M1 5H23", class_=f"curve {kind}"), viewBox="0 0 24 10",
                        aria_hidden="true"), " ", name)
            for kind, name in keys
        ],
        class_="keys",
    )  # fmt: skip


def _edges(at: Floats) -> list[float]:
    """Borders half way between places."""
    return [0.0, *((at[:-1] + at[1:]) / 2).tolist(), float(WIDE)]


def _rounded(values: Floats, digits: int) -> list[float]:
    return [round(v, digits) for v in values.tolist()]


def _significant(values: Floats, digits: int = 5) -> list[float | None]:
    return [float(f"{v:.{digits}g}") if math.isfinite(v) else None for v in values.tolist()]
