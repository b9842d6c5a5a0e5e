"""Paper C's Table 2: patrol of a square by a snake and by two spirals, and what such paths really sweep."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.patrol import spirals
from pipelines.patrol.footprint import swath
from pipelines.patrol.spirals import Row
from workbench.reproduce import documents, drawing
from workbench.reproduce.judged import Statement, Upshot
from workbench.reproduce.plans import Reproduced

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BAR = 0.005
"""Greatest relative difference from the printed numbers."""
HEIGHT_M, VIEW_RAD = 13.0, math.radians(60)
TURN_S, CORNERS = 2.0, 14


@dataclass(frozen=True, slots=True)
class Results:
    """The rows of the table, variants of them, and what is said of them."""

    rows: list[Row]
    variants: list[Row]
    statements: list[Statement]


def reproduce(folder: Path) -> Reproduced[Results]:
    """Recompute the table and write the report into a folder.

    Raises:
        RecordingError: the folder cannot be made.
    """
    documents.made_folder(folder)
    rows, variants = spirals.table_2(), [spirals.tight_snake(), *spirals.pulled_in()]
    results = Results(rows, variants, statements(rows, variants))
    documents.write_json(values(results), folder / "report.json")
    documents.write_csv([asdict(row) for row in (*rows, *variants)], folder / "table-2.csv")
    return Reproduced(folder, documents.write_report(_lines(results, folder), folder), results, interrupted=False)


def values(results: Results) -> dict[str, Any]:
    """The results as plain values."""
    return {
        "rows": [{**asdict(row), "printed": list(row.printed)} for row in results.rows],
        "variants": [asdict(row) for row in results.variants],
        "statements": [asdict(statement) for statement in results.statements],
    }


def errors(row: Row) -> tuple[float, float, float]:
    """Relative differences of length, area and time from the printed ones."""
    ours = (row.length_m, row.area_m2, row.time_min)
    length, area, time = ((mine - printed) / printed for mine, printed in zip(ours, row.printed, strict=True))
    return length, area, time


def statements(rows: Sequence[Row], variants: Sequence[Row]) -> list[Statement]:
    """What the numbers say of the paper's."""
    made = [_row_statement(row) for row in rows]
    wide = swath(HEIGHT_M, VIEW_RAD)
    made.append(
        Statement(
            "At 13 m and 60° the swath is 15 m",
            _judged(abs(wide / spirals.SWATH_M - 1) <= BAR),
            f"2 h tan(α/2) = {wide:.3f} m",
        )
    )
    named = {row.name: row for row in (*rows, *variants)}
    made += [
        Statement(
            f"{name}: the area is what is swept",
            _judged(abs(named[name].swept_m2 / named[name].printed[1] - 1) <= BAR),
            f"printed {named[name].printed[1]:.0f} m², the area of the outermost circle; a strip along the path "
            f"sweeps {named[name].swept_m2:.0f} m²",
        )
        for name in ("spiral 1", "spiral 2")
    ]
    snake, tight = named["snake"], named["snake, spread evenly"]
    made.append(
        Statement(
            "The snake needs 805 m",
            _judged(tight.length_m / snake.printed[0] >= 1 - BAR),
            f"{tight.length_m:.0f} m sweep all of the square: {tight.reading}, where the paper's number counts as many "
            "steps as lanes",
        )
    )
    longer = snake.time_min + TURN_S * CORNERS / 60
    made.append(
        Statement(
            "Turns take no time worth counting",
            _judged(longer / snake.printed[2] <= 1 + BAR),
            f"with {TURN_S:g} s at each of {CORNERS} corners the snake takes {longer:.2f} min",
        )
    )
    best = max((snake, named["spiral 1"], named["spiral 2"]), key=lambda row: row.useful_m2_per_m)
    made.append(
        Statement(
            "The snake is the best for the square",
            _judged(best is snake),
            "swept square a metre of path: "
            + ", ".join(f"{row.name} {row.useful_m2_per_m:.1f} m" for row in rows)
            + f"; it leaves nothing out, spiral 2 leaves {1 - named['spiral 2'].square_share:.1%}",
        )
    )
    return made


def _row_statement(row: Row) -> Statement:
    length, area, time = errors(row)
    return Statement(
        f"{row.name}: length, area and time are those of Table 2",
        _judged(max(map(abs, (length, area, time))) <= BAR),
        f"{row.length_m:.1f} m ({length:+.2%}), {row.area_m2:.0f} m² ({area:+.2%}), {row.time_min:.3f} min "
        f"({time:+.2%}); {row.reading}",
    )


def _judged(holds: bool) -> Upshot:
    return Upshot.REACHED if holds else Upshot.MISSED


def tables(results: Results) -> list[documents.Table]:
    """Table 2 beside the paper's, and what is swept."""
    beside: list[tuple[str, ...]] = [
        (
            row.name,
            f"{row.length_m:.1f} ({row.printed[0]:.0f})",
            f"{row.area_m2:.0f} ({row.printed[1]:.0f})",
            f"{row.time_min:.2f} ({row.printed[2]:.2f})",
            f"{max(map(abs, errors(row))):.2%}",
        )
        for row in results.rows
    ]
    strips: list[tuple[str, ...]] = [
        (
            row.name,
            f"{row.length_m:.1f}",
            f"{row.swept_m2:.0f}",
            f"{row.square_share:.2%}",
            f"{row.useful_m2_per_m:.2f}",
        )
        for row in (*results.rows, *results.variants)
    ]
    return [
        (("ours (printed)", "length, m", "area, m²", "time, min", "worst difference"), beside),
        (("really swept", "length, m", "swept, m²", "of the square", "m² of it a metre"), strips),
    ]


def _lines(results: Results, folder: Path) -> Iterator[str]:
    yield from ("# Paper C, Table 2: patrol methods", "")
    for part in tables(results):
        yield from (*documents.markdown(part), "")
    yield from documents.statement_lines(results.statements)
    yield from documents.picture(folder, "paths", _draw)
    yield from documents.version_lines()


def _draw() -> Figure:
    from pipelines.patrol.area import parts
    from pipelines.patrol.lanes import swept

    side, width = spirals.SIDE_M, spirals.SWATH_M
    centre, outer = (side / 2, side / 2), side / 2 * spirals.PRINTED_ROOT
    snake = spirals.paper_snake()
    paths = {"snake": (snake, swept(snake, width))} | {
        name: (spirals.spiral(centre, r, width)[1:], spirals.spiral_strip(centre, r, width))
        for name, r in (("spiral 1", outer), ("spiral 2", side / 2))
    }
    figure, axes = drawing.figure_of(9.0, 3.4, columns=3, sharex=True, sharey=True)
    for axis, (name, (path, strip)) in zip(axes[0], paths.items(), strict=True):
        for part in parts(strip):
            axis.fill(*part.exterior.xy, color=drawing.BLUE, alpha=0.25, label="swept")
            for ring in part.interiors:
                axis.fill(*ring.xy, color="white")
        axis.plot(*path.T, color=drawing.BLUE, linewidth=1.0, label="path")
        axis.plot([0, side, side, 0, 0], [0, 0, side, side, 0], color=drawing.BLACK, linestyle="--", label="square")
        axis.set(title=name, aspect="equal", xlabel="x, m")
    axes[0, 0].set_ylabel("y, m")
    axes[0, 0].legend(loc="upper left", fontsize=7)
    return figure
