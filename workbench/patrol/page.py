"""What a flight has seen, as one page that opens without a network."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from readers.streams import WorkbenchError
from workbench.patrol.areas import rings_of
from workbench.patrol.colours import Scale
from workbench.patrol.evaluating import Evaluation
from workbench.report.markup import Element, el
from workbench.report.page import framed, listed, section, table

Floats = NDArray[np.float64]

MOST_PX = 900
LINES = {"area": "#ffffff", "no-go": "#ff5252", "pass": "#4fc3f7", "flown": "#ffd54f", "gap": "#ff4081"}
CASING = "#121418"
"""The dark line below each line, so that it stands out from bright cells."""
BAR_STEPS = 32


def html(title: str, done: Evaluation, values: Mapping[str, Any], told: Sequence[str]) -> str:
    """The page of an evaluated flight.

    Args:
        title: of the page.
        done: the evaluation.
        values: its numbers.
        told: the evaluation in words.
    """
    found = done.found
    count = Scale.of_counts(found.count)
    maps = [
        _map("How often each place was seen", done, count, np.where(found.count > 0, found.count, np.nan), "times", 1)
    ]
    finest = found.best_m[np.isfinite(found.best_m)]
    if len(finest):
        maps.append(
            _map("Ground that a pixel covers, at its finest", done, Scale.of_sizes(finest), found.best_m, "cm", 100)
        )
    gaps = [(f"{g['area_m2']:.1f}", f"{g['x_m']:.1f}", f"{g['y_m']:.1f}") for g in values["largest_gaps"]]
    parts = [
        section("seen", "What the flight has seen", listed(list(told))),
        section("maps", "Maps", el("p", _key(done), class_="help"), maps),
        section("gaps", "Gaps", table("The largest gaps", ("area, m²", "x, m", "y, m"), gaps, right=(0, 1, 2)))
        if gaps
        else None,
    ]
    return framed(title, "coverage of a flight", [part for part in parts if part is not None])


def _key(done: Evaluation) -> str:
    words = ["x to the right, y up, in metres", "the flown path is yellow", "gaps are outlined in pink"]
    words += ["planned passes are blue"] if done.plan is not None else []
    words += ["the area is outlined in white"] if done.target is not None else []
    return "; ".join(words) + "."


def _map(title: str, done: Evaluation, scale: Scale, numbers: Floats, unit: str, factor: float) -> Element:
    """A map: the cells in colours, lines over them, and the bar of the colours."""
    x, y = done.found.origin_m
    rows, columns = numbers.shape
    width, height = columns * done.found.cell_m, rows * done.found.cell_m
    stroke = max(width, height) / 400

    def lines(name: str, shapes: Iterable[Floats]) -> list[Element]:
        # y of an svg counts downwards
        moved = (np.column_stack([points[:, 0] - x, y + height - points[:, 1]]) for points in shapes)
        texts = [" ".join(f"{u:.2f},{v:.2f}" for u, v in points) for points in moved]
        return [
            el("polyline", points=text, fill="none", stroke=colour, stroke_width=wide * stroke, stroke_linejoin="round")
            for colour, wide in ((CASING, 2.2), (LINES[name], 1.0))
            for text in texts
        ]

    over: list[Element] = []
    if done.plan is not None:
        over += lines("no-go", [ring for zone in done.plan.task.area.no_go for ring in rings_of(zone)])
        over += lines("pass", [leg.points for flight in done.plan.flights for leg in flight.legs if leg.sweeping])
    if done.target is not None:
        over += lines("area", rings_of(done.target))
    over += lines("flown", [done.track.position_m[:, :2]])
    over += lines("gap", [ring for gap in done.gaps for ring in rings_of(gap)])
    picture = el(
        "image", href=_picture(scale, numbers), x=0, y=0, width=width, height=height, preserveAspectRatio="none"
    )
    low, high = scale.low * factor, scale.high * factor
    return el(
        "figure",
        el(
            "figcaption",
            el("strong", title),
            f", {width:.0f} x {height:.0f} m; {low:.3g} to {high:.3g} {unit}: ",
            _bar(scale),
        ),
        el("svg", picture, *over, viewBox=f"0 0 {width:.3f} {height:.3f}", width="100%", role="img", aria_label=title),
    )


def _bar(scale: Scale) -> Element:
    """The colours from low to high."""
    colours = scale.colours(np.linspace(scale.low, scale.high, BAR_STEPS)[None])[0]
    steps = [
        el("rect", x=k, y=0, width=1.05, height=3, fill="#{:02x}{:02x}{:02x}".format(*rgb.tolist()))
        for k, rgb in enumerate(colours)
    ]
    return el("svg", *steps, viewBox=f"0 0 {BAR_STEPS} 3", width=160, height=15, aria_hidden="true")


def _picture(scale: Scale, numbers: Floats) -> str:
    """Cells as a PNG in a data address, the top row first, at most `MOST_PX` a side."""
    rgb = scale.colours(numbers)[::-1]
    step = -(-max(rgb.shape[:2]) // MOST_PX)
    good, data = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(rgb[::step, ::step]), cv2.COLOR_RGB2BGR))
    if not good:
        raise WorkbenchError("the map of the coverage cannot be written as PNG")
    return "data:image/png;base64," + base64.b64encode(data.tobytes()).decode("ascii")
