"""The report of paper C's flights: tables, statements and pictures as Markdown, and the values as JSON and CSV."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from pipelines.semidirect import scoring
from workbench.reproduce.documents import (
    Table,
    markdown,
    picture,
    statement_lines,
    version_lines,
    write_csv,
    write_json,
    write_report,
)
from workbench.reproduce.flights import pictures
from workbench.reproduce.flights.flying import Flown, Result
from workbench.reproduce.flights.results import SVO, Results
from workbench.reproduce.flights.statements import statements
from workbench.session import versions


def write(results: Results, folder: Path) -> Path:
    """Write report.md, its pictures, report.json and flights.csv; returns the report."""
    write_json(values(results), folder / "report.json")
    write_csv([_row(flight, result) for flight, result in results.results()], folder / "flights.csv")
    return write_report(_lines(results, folder), folder)


def values(results: Results) -> dict[str, Any]:
    """All results but the curves as plain values."""
    return {
        "command": results.command,
        "methods": list(results.methods),
        "versions": versions(),
        "outlier_share_of_height": scoring.OUTLIER,
        "published": {method: dataclasses.asdict(numbers) for method, numbers in SVO.items()},
        "flights": [_row(flight, result) for flight, result in results.results()],
        "statements": [dataclasses.asdict(statement) for statement in statements(results)],
        "unfinished": list(results.unfinished),
    }


def _row(flight: Flown, result: Result) -> dict[str, Any]:
    """A flight with one method, flat."""
    errors = result.map_errors
    return {
        "flight": flight.flight,
        "method": result.method,
        **dataclasses.asdict(result.accuracy),
        "map_points": errors.points,
        "map_outliers": errors.outliers,
        "map_outlier_share": errors.share,
        "map_judged": errors.judged,
        "map_misplaced": errors.misplaced,
        **{f"tracking_{name}": value for name, value in dataclasses.asdict(result.work).items()},
        "tracking_frames_per_s": result.work.frames_per_s,
    }


# ---------------------------------------------------------------------------------- tables


def tables(results: Results) -> dict[str, Table]:
    """Accuracy, losses, map and work by flight and method."""
    return {
        "accuracy": accuracy_table(results),
        "losses": losses_table(results),
        "map": map_table(results),
        "work": work_table(results),
    }


def accuracy_table(results: Results) -> Table:
    """Errors after Sim(3); the published relative errors below."""
    heads = ("flight", "method", "ATE, % of path", "worst, %", "attitude, °", "worst, °", "RPE, m/s", "median",
             "RPE, °/s", "median", "scale drift, %")  # fmt: skip
    rows = []
    for flight, result in results.results():
        a = result.accuracy
        shares = (100 * a.ate_share, 100 * a.worst_share)
        turns = (math.degrees(a.attitude_rad), math.degrees(a.attitude_worst_rad))
        rpe = (a.rpe_mps, a.rpe_median_mps, math.degrees(a.rpe_radps), math.degrees(a.rpe_median_radps))
        cells = (*(f"{x:.4f}" for x in shares), *(f"{x:.3f}" for x in turns), *(f"{x:.4f}" for x in rpe))
        rows.append((flight.flight, result.method, *cells, f"{100 * a.scale_drift:+.2f}"))
    for method, paper in SVO.items():
        rpe = (*paper.rpe_mps, *paper.rpe_degps)
        rows.append(("published, 84 m", method, "", "", "", "", *(f"{x:.4f}" for x in rpe), ""))
    return heads, rows


def losses_table(results: Results) -> Table:
    """How much of each flight a method stands by."""
    heads = ("flight", "method", "frames", "accepted", "first", "losses", "lost frames", "relocalised", "maps",
             "path covered, %", "wrong unnoticed, frames", "note")  # fmt: skip
    rows = []
    for flight, result in results.results():
        a = result.accuracy
        counts = (a.frames, a.accepted, a.first, a.losses, a.lost_frames, a.relocalisations, a.maps)
        covered = f"{100 * a.covered:.1f}"
        rows.append((flight.flight, result.method, *map(str, counts), covered, str(a.longest_unnoticed), a.note))
    return heads, rows


def map_table(results: Results) -> Table:
    """Points of the maps and those that are wrong; methods without a map are left out."""
    heads = ("flight", "method", "points", "outliers", "%", "judged by depth", "misplaced", "%")
    rows: list[tuple[str, ...]] = []
    for flight, result in results.results():
        m = result.map_errors
        if m.points:
            cells = (str(m.points), str(m.outliers), f"{100 * m.share:.2f}")
            more = (str(m.judged), str(m.misplaced), f"{100 * m.misplaced_share:.2f}")
            rows.append((flight.flight, result.method, *cells, *more))
    return heads, rows


def work_table(results: Results) -> Table:
    """CPU time of the tracking; the published rates below."""
    heads = ("flight", "method", "median, ms", "95 %, ms", "mean, ms", "with mapping, ms", "frames/s")
    rows = []
    for flight, result in results.results():
        w = result.work
        times = (w.median_ms, w.most_ms, w.mean_ms, w.whole_mean_ms)
        rows.append((flight.flight, result.method, *(f"{x:.2f}" for x in times), f"{w.frames_per_s:.0f}"))
    for method, paper in SVO.items():
        board = f" ({paper.board_fps:.0f} on a single board)" if math.isfinite(paper.board_fps) else ""
        rows.append(("published, laptop", method, "", "", "", "", f"{paper.laptop_fps:.0f}{board}"))
    return heads, rows


# ---------------------------------------------------------------------------------- report


def _lines(results: Results, folder: Path) -> Iterator[str]:
    yield "# Paper C: visual odometries on flights of a small UAV"
    yield from ("", f"`{results.command}`", "")
    if results.unfinished:
        yield from (f"**Not finished**: {', '.join(results.unfinished)}. The same command goes on.", "")
    for flight in results.flights:
        yield f"- `{flight.flight}`: {flight.about}; {flight.frames} frames, {flight.path_m:.1f} m"
    yield from ("", *SET_UP)
    if results.flights:
        yield from ("", "## What the numbers say", "", *statement_lines(statements(results)))
        found = tables(results)
        for (name, table), (title, text) in zip(found.items(), EXPLAINED.items(), strict=True):
            assert name == title
            yield from ("", f"## {name.capitalize()}", "", text, "", *markdown(table))
        yield from picture(folder, "flights", partial(pictures.bars, results.flights))
        for flight in results.flights:
            yield from ("", f"## {flight.flight}", "", f"See it: `workbench replay sim:{flight.flight} -e semidirect`")
            yield from picture(folder, flight.flight, partial(pictures.along, flight))
    yield from version_lines()


SET_UP = (
    "752 x 480 px, f = 420 px, 60 Hz, 1.5 m above the ground, looking down; roll and pitch of 2° and height of 6 cm "
    "(standard deviations), noise of 2 grey levels. Every frame is rendered once and given to all methods in turns. "
    "The scale comes from the true height at the start; all errors are those after one Sim(3) over the poses that a "
    "method stands by.",
)
EXPLAINED = {
    "accuracy": "ATE: rmse of the position over the whole flight's length (as Fig. 4); attitude: rmse (as Fig. 5); "
    "RPE: over 1 s, rmse and median; scale drift: growth of the scale from begin to end, Theil-Sen line through the "
    f"ratio of chords of {scoring.SCALE_WINDOW_M:g} m. Published: C. Forster et al., ICRA 2014, Table II, whose text "
    "paper C follows; `baseline` is there the modified PTAM.",
    "losses": "accepted: frames whose pose the method stands by, `first` the first of them; lost frames: the others "
    "after it. Poses held while lost are not scored. Wrong unnoticed: most frames in a row that it stands by though "
    f"its motion over {scoring.NOTICE_FRAMES} frames is off by more than {scoring.WRONG:.0%} and "
    f"{100 * scoring.WRONG_M:g} cm.",
    "map": "All points that ever were in the map, at their last places. Outliers (Fig. 3): farther than "
    f"{scoring.OUTLIER:.0%} of the height off the true ground after the path's Sim(3), so that the path's own drift "
    "counts too. Misplaced: without that drift, points whose depth in the frame that saw them last is off by more than "
    f"{scoring.OUTLIER:.0%} of it against the others' median.",
    "work": "CPU time of the tracking thread for a frame, decoding left out, pyramid included; with mapping: of all "
    "work.",
}
