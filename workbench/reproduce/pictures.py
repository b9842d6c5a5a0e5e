"""The pictures of paper A's experiment: like its Figs 5 and 6, and those of correction, matrix and limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from workbench.reproduce.correction import READINGS, TRUTHS, Effect
from workbench.reproduce.drawing import BLACK, BLUE, GREEN, ORANGE, RED, figure_of
from workbench.reproduce.experiment import BEST, PAPER, PRINTED, PRIOR, Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINT_FRAMES = 25
"""The paper plots every 25th frame."""
COLOURS = {PAPER: RED, PRIOR: BLUE, PRINTED: ORANGE, BEST: GREEN}
SIGNS = {PAPER: "+", PRIOR: "*", PRINTED: "^", BEST: "o"}
LABELS = {
    PAPER: "without correction",
    PRIOR: "with correction (speed prior)",
    PRINTED: "with correction (as printed)",
    BEST: "best",
}


# ------------------------------------------------------------------------------ Figs 5 and 6


def trajectories(run: Run) -> Figure:
    """As paper A's Fig. 5: the true trajectory (*) and the estimated one (o), every 25th frame."""
    figure, axes = figure_of(10.0, 5.8, 2, 2, sharex=True, sharey=True)
    every = slice(None, None, POINT_FRAMES)
    true = run.truth[every] * 100
    for axis, method in zip(axes.flat, (PAPER, PRIOR, PRINTED, BEST), strict=True):
        pose = run.poses[method][every] * 100
        axis.plot(true[:, 0], true[:, 1], "*", color=BLACK, ms=5, label="true")
        axis.plot(pose[:, 0], pose[:, 1], "o", color=COLOURS[method], ms=7, mfc="none", label="estimated")
        axis.plot(*true[0, :2], "s", color=BLACK, ms=9, mfc="none", label="start")
        found = run.accuracies[method]
        title = LABELS[method] if method == BEST else f"paper-a {LABELS[method]}"
        axis.set_title(f"{title}\nrms {100 * found.rms_m:.2f} cm, end {100 * found.end_path:.3f} % of the path")
        axis.set_aspect("equal")
        axis.label_outer()
    for axis in axes[1]:
        axis.set_xlabel("X, cm")
    for axis in axes[:, 0]:
        axis.set_ylabel("Y, cm")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(_title(run, "as Fig. 5: trajectories, a point every 25 frames"))
    return figure


def errors(run: Run) -> Figure:
    """As paper A's Fig. 6: heading α (×) and Euclidean error without (+) and with (*) correction over time."""
    figure, axes = figure_of(9.0, 6.6, 3, 1, sharex=True, height_ratios=(1, 2, 1))
    every = slice(None, None, POINT_FRAMES)
    t_s = run.t_s[every]
    heading, error, fine = axes[:, 0]
    heading.plot(t_s, run.truth[every, 2], "x", color=BLACK, ms=5, label="true")
    heading.plot(t_s, run.poses[PAPER][every, 2], "-", color=RED, lw=1, label="paper-a")
    heading.set_ylabel("α, rad")
    for method in (PAPER, PRIOR, PRINTED):
        error.plot(t_s, 100 * distance(run, method)[every], SIGNS[method] + "-", color=COLOURS[method], ms=6, lw=0.7,
                   label=f"paper-a {LABELS[method]}")  # fmt: skip
    error.set_ylabel("Euclidean error, cm")
    fine.plot(t_s, 1000 * distance(run, BEST)[every], "o-", color=GREEN, ms=4, lw=0.7, mfc="none", label="best")
    fine.set_ylabel("error of best, mm")
    fine.set_xlabel("time, s")
    for axis in axes[:, 0]:
        axis.legend(loc="best", framealpha=0.9)
    error.set_ylim(bottom=0)
    fine.set_ylim(bottom=0)
    figure.suptitle(_title(run, "as Fig. 6: heading and error over time"))
    return figure


def distance(run: Run, method: str) -> Any:
    """Euclidean error [n] of a method in m."""
    return np.hypot(*(run.poses[method] - run.truth)[:, :2].T)


def _title(run: Run, text: str) -> str:
    cell = run.cell
    ground = Path(cell.surface).name
    return f"{text}\n{ground}, {cell.condition.name}: {cell.condition.meaning}, seed {cell.seed}, {cell.frames} frames"


# ------------------------------------------------------------------------------- correction


def correction(effects: Sequence[Effect]) -> Figure:
    """RMS error of every reading of the correction under every truth, without images."""
    figure, axes = figure_of(9.0, 4.6)
    axis = axes[0, 0]
    rms = np.array([100 * e.rms_m for e in effects]).reshape(len(TRUTHS), len(READINGS))
    width = 0.8 / len(READINGS)
    hatches = ("", "//", "..", "xx", "--")
    for k, (reading, colour, hatch) in enumerate(
        zip(READINGS, (BLACK, BLUE, GREEN, ORANGE, RED), hatches, strict=True)
    ):
        places = np.arange(len(TRUTHS)) + (k - 2) * width
        axis.bar(places, rms[:, k], width, label=reading, color=colour, hatch=hatch, edgecolor="white")
    axis.set_yscale("log")
    axis.set_ylabel("rms error, cm")
    axis.set_xticks(range(len(TRUTHS)), [_wrapped(truth.name) for truth in TRUTHS])
    axis.grid(visible=False, axis="x")
    axis.legend(title="correction", ncols=3, loc="upper left", framealpha=0.9)
    axis.set_ylim(top=8 * rms.max())
    axis.set_title("Correction (18)-(21) without images: where it helps and where it harms")
    return figure


def _wrapped(text: str) -> str:
    words, lines = text.replace(" %", "\u00a0%").split(" "), [""]
    for word in words:
        if len(lines[-1]) + len(word) > 16:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


# -------------------------------------------------------------------------- matrix and limits


def matrix(rows: Sequence[Mapping[str, str]], surfaces: Sequence[str]) -> Figure:
    """Failure rates and end errors of both presets: a row a surface, a column a trajectory at a speed."""
    columns = list(dict.fromkeys((row["trajectory"], float(row["speed_kmh"])) for row in rows))
    panels = ((PAPER, "failed"), (BEST, "failed"), (PAPER, "end_path"), (BEST, "end_path"))
    height = 2.4 + 0.62 * len(surfaces)
    figure, axes = figure_of(5.0 + 0.75 * len(columns), height, 2, 2, sharex=True, sharey=True)
    for axis, (preset, field) in zip(axes.flat, panels, strict=True):
        values = np.full((len(surfaces), len(columns)), np.nan)
        for row in rows:
            if row["preset"] == preset:
                where = columns.index((row["trajectory"], float(row["speed_kmh"])))
                values[list(surfaces).index(row["surface"]), where] = 100 * float(row[field])
        what = "failed motions between frames, %" if field == "failed" else "end-point error, % of the path"
        _heat(figure, axis, values, f"{preset}: {what}", low=0.1 if field == "failed" else 0.001)
        names = [f"{trajectory}\n{speed:g} km/h" for trajectory, speed in columns]
        axis.set_xticks(range(len(columns)), names, rotation=90)
        axis.set_yticks(range(len(surfaces)), [Path(s).name for s in surfaces])
    return figure


def limits(
    rates: Mapping[str, Mapping[int, float]], needed: Mapping[str, tuple[Sequence[str], Any]], surfaces: Sequence[str]
) -> Figure:
    """False peaks by surface and fragment, and the smallest fragment that will do.

    Args:
        rates: share of false peaks by surface and side.
        needed: by what is varied, the names of its values and the smallest sides [surfaces, values], infinite for none,
            NaN where that is not known.
        surfaces: the rows.
    """
    widths = (7, *(len(names) for names, _ in needed.values()))
    figure, axes = figure_of(13.0, 1.9 + 0.36 * len(surfaces), 1, len(widths), sharey=True, width_ratios=widths)
    sides = sorted({side for by_side in rates.values() for side in by_side})
    values = np.array([[100 * rates[s].get(side, np.nan) for side in sides] for s in surfaces])
    _heat(figure, axes[0, 0], values, "false peaks, %", low=0.1, bar=False)
    axes[0, 0].set_xticks(range(len(sides)), [str(side) for side in sides])
    axes[0, 0].set_xlabel("side N of the fragment, px")
    axes[0, 0].set_yticks(range(len(surfaces)), [Path(s).name for s in surfaces])
    for axis, (varied, (names, smallest)) in zip(axes[0, 1:], needed.items(), strict=True):
        _heat(figure, axis, smallest, "smallest N, ≤ 1 % false", low=4, high=40, bar=False, missing="> 31")
        axis.set_xticks(range(len(names)), names)
        axis.set_xlabel(varied)
    return figure


def _heat(
    figure: Figure,
    axis: Axes,
    values: Any,
    title: str,
    *,
    low: float,
    high: float = 100.0,
    bar: bool = True,
    missing: str = "",
) -> None:
    """A map of numbers in logarithmic colours, each written into its cell: NaN as nothing, infinity as `missing`."""
    from matplotlib.colors import LogNorm

    norm = LogNorm(low, high, clip=True)
    shown = np.ma.masked_invalid(np.clip(values, low, high))
    image = axis.imshow(shown, norm=norm, cmap="cividis", aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        if np.isnan(value):
            continue
        text = missing if np.isinf(value) else _short(value)
        dark = norm(np.clip(value, low, high)) < 0.55
        axis.text(column, row, text, ha="center", va="center", fontsize=7, color="white" if dark else "black")
    axis.grid(visible=False)
    axis.set_title(title)
    if bar:
        figure.colorbar(image, ax=axis, shrink=0.8, pad=0.01)


def _short(value: float) -> str:
    """A number in as few signs as tell its size."""
    if value == 0:
        return "0"
    if value >= 10:
        return f"{value:.0f}"
    return f"{value:.2g}" if value >= 0.01 else f"{value:.0e}".replace("e-0", "e-")
