"""The report of the experiment: tables, pictures and statements as Markdown; the same values as JSON and CSV."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from workbench.reproduce import correction, limits, pictures
from workbench.reproduce.conditions import (
    CONDITIONS,
    METRES_PER_PX,
    NOISE_GREY,
    RATE_HZ,
    SPEED_MPS,
    TAU_FRAMES,
)
from workbench.reproduce.correction import READINGS, SHIFT_NOISE_PX, TRUTHS, TURN_NOISE_RAD, Effect
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
from workbench.reproduce.experiment import METHODS, Run
from workbench.reproduce.judged import Statement
from workbench.reproduce.matrix import PRESETS
from workbench.reproduce.measures import Accuracy
from workbench.reproduce.statements import END, RELATIVE, spread, statements
from workbench.session import versions


@dataclass(frozen=True, kw_only=True)
class Results:
    """All that was computed; what was not is empty.

    `matrix` are rows of `matrix.csv`, `limits` shares of false peaks by case and side, `logs` folders of logged runs.
    """

    command: str
    surface: str
    frames: int
    seeds: tuple[int, ...]
    runs: Sequence[Run] = ()
    effects: Sequence[Effect] = ()
    matrix: Sequence[Mapping[str, str]] = ()
    limits: Mapping[limits.Case, Mapping[int, float]] = field(default_factory=dict)
    logs: Sequence[Path] = ()
    unfinished: Sequence[str] = ()

    @property
    def found(self) -> dict[str, list[Mapping[str, Accuracy]]]:
        """Accuracies by condition and seed."""
        by_condition: dict[str, list[Mapping[str, Accuracy]]] = {}
        for run in self.runs:
            by_condition.setdefault(run.cell.condition.name, []).append(run.accuracies)
        return by_condition

    @property
    def statements(self) -> list[Statement]:
        """What the numbers say."""
        return statements(self.found, self.effects) if self.runs else []


# ---------------------------------------------------------------------------------- tables


def experiment_table(results: Results) -> Table:
    """Paper A's quantities by condition and method, medians over the seeds, the paper's own first."""
    heads = ("condition", "method", "rel X", "rel Y", "rel Euclid", "mean X Y", "rms cm", "end X", "end Y", "end %",
             "yaw °", "shift px", "Δα mrad", "block", "failed")  # fmt: skip
    paper = [f"{bar}" for _, bar in RELATIVE.values()]
    end = [f"< {bar}" for _, bar in END.values()]
    rows = [("paper A", "printed", *paper, paper[2], "", *end, "", "", "", "", "", "")]
    for name, runs in results.found.items():
        rows += [(name, method, *_accuracy_row(runs, method)) for method in METHODS]
    return heads, rows


def _accuracy_row(runs: Sequence[Mapping[str, Accuracy]], method: str) -> Iterator[str]:
    def median(quantity: str) -> float:
        return spread(runs, method, quantity).median

    for quantity in ("relative_x", "relative_y", "relative_euclid", "relative_mean"):
        yield f"{median(quantity):.4f}"
    yield f"{100 * median('rms_m'):.2f}"
    yield f"{median('end_x'):.4f}"
    yield f"{median('end_y'):.4f}"
    yield f"{100 * median('end_path'):.3f}"
    yield f"{math.degrees(np.median([abs(run[method].yaw_rad) for run in runs])):.3f}"
    yield f"{median('shift_px'):.4f}"
    yield f"{1e3 * median('turn_rad'):.4f}"
    yield f"{median('block_ratio'):.2f}"
    yield f"{sum(run[method].failures for run in runs)}"


def scatter_table(results: Results) -> Table:
    """Least, median and largest relative errors over the seeds, of paper-a without correction."""
    heads = ("condition", "disturbance", "seeds", *(f"rel {label} (paper {bar})" for label, bar in RELATIVE.values()))
    meanings = {c.name: c.meaning for c in CONDITIONS}
    rows = [
        (name, meanings[name], str(len(runs)), *(str(spread(runs, "paper-a", quantity)) for quantity in RELATIVE))
        for name, runs in results.found.items()
    ]
    return heads, rows


def correction_table(effects: Sequence[Effect]) -> Table:
    """RMS / end-point error in cm by truth and reading."""
    cells = {(e.truth, e.reading): f"{100 * e.rms_m:.2f} / {100 * e.end_m:.2f}" for e in effects}
    rows = [(t.name, *(cells[t.name, reading] for reading in READINGS)) for t in TRUTHS]
    return ("truth (rms / end cm)", *READINGS), rows


def matrix_table(rows: Sequence[Mapping[str, str]]) -> Table:
    """Failed motions and end errors by surface and speed: the worst and the median of the trajectories."""
    groups: dict[tuple[str, str, str], list[Mapping[str, str]]] = {}
    for row in rows:
        groups.setdefault((row["surface"], row["speed_kmh"], row["preset"]), []).append(row)
    heads = (
        "surface",
        "km/h",
        *(f"{p}: {q}" for p in PRESETS for q in ("failed % worst", "end % median", "end % worst")),
    )
    lines = []
    for surface, speed in dict.fromkeys((s, v) for s, v, _ in groups):
        cells: list[str] = []
        for preset in PRESETS:
            found = groups.get((surface, speed, preset), [])
            failed = [100 * float(row["failed"]) for row in found] or [math.nan]
            end = [100 * float(row["end_path"]) for row in found] or [math.nan]
            cells += [f"{max(failed):.1f}", f"{np.median(end):.3g}", f"{max(end):.3g}"]
        lines.append((Path(surface).name, speed, *cells))
    return heads, lines


def limits_tables(found: Mapping[limits.Case, Mapping[int, float]]) -> dict[str, Table]:
    """By what is varied: false peaks in % by value and side, and the smallest side that will do."""
    heads = ("surface", "value", *(f"N = {side}" for side in limits.SIDES_PX), "N needed")
    tables: dict[str, Table] = {}
    for varied in VARIED:
        rows = []
        surfaces = list(dict.fromkeys(case.surface for case in found))
        for case in sorted(found, key=partial(_place, surfaces, varied.field)):
            rates = found[case]
            if rates and varied.holds(case):
                needed = limits.smallest_side(rates)
                cells = [f"{100 * rates[side]:.1f}" for side in limits.SIDES_PX]
                text = f"> {limits.SIDES_PX[-1]}" if needed is None else str(needed)
                rows.append((Path(case.surface).name, varied.label(case), *cells, text))
        tables[varied.name] = heads, rows
    return tables


@dataclass(frozen=True, slots=True)
class Varied:
    """One of the three quantities that the limits vary, the other two as usual."""

    name: str
    field: str

    def holds(self, case: limits.Case) -> bool:
        """Whether the other two are as usual."""
        return all(getattr(case, f) == usual for f, usual in _USUAL.items() if f != self.field)

    def label(self, case: limits.Case) -> str:
        """The value, as text."""
        value = getattr(case, self.field)
        speeds = [speed for speed, radius in limits.REACH_OF_SPEED.items() if radius == value]
        return f"{value:g}" + (f" ({speeds[0]})" if self.field == "radius_px" and speeds else "")


_USUAL = {
    "noise_grey": limits.USUAL_NOISE,
    "radius_px": limits.USUAL_RADIUS,
    "rotation_deg": limits.USUAL_ROTATION,
}
VARIED = (
    Varied("noise, grey levels", "noise_grey"),
    Varied("search radius, px (speed it reaches without prediction)", "radius_px"),
    Varied("rotation between frames, °", "rotation_deg"),
)


# ---------------------------------------------------------------------------------- report


def write(results: Results, folder: Path) -> Path:
    """Write report.md, its pictures, report.json and the CSV files; returns the report."""
    write_json(values(results), folder / "report.json")
    write_csv([_run_values(run, method) for run in results.runs for method in METHODS], folder / "experiment.csv")
    return write_report(_lines(results, folder), folder)


def values(results: Results) -> dict[str, Any]:
    """All results as plain values."""
    return {
        "command": results.command,
        "surface": results.surface,
        "frames": results.frames,
        "seeds": list(results.seeds),
        "versions": versions(),
        "paper": {name: bar for name, (_, bar) in (RELATIVE | END).items()},
        "conditions": [dataclasses.asdict(c) for c in CONDITIONS],
        "experiment": [_run_values(run, method) for run in results.runs for method in METHODS],
        "correction": [dataclasses.asdict(e) for e in results.effects],
        "matrix": [dict(row) for row in results.matrix],
        "limits": [
            dataclasses.asdict(case) | {"false": {str(side): rate for side, rate in rates.items()}}
            | {"needed_px": limits.smallest_side(rates)}
            for case, rates in results.limits.items()
        ],
        "statements": [dataclasses.asdict(s) for s in results.statements],
        "logs": [str(log) for log in results.logs],
        "unfinished": list(results.unfinished),
    }  # fmt: skip


def _run_values(run: Run, method: str) -> dict[str, Any]:
    names = {"condition": run.cell.condition.name, "seed": run.cell.seed, "method": method}
    return names | dataclasses.asdict(run.accuracies[method])


def _lines(results: Results, folder: Path) -> Iterator[str]:
    yield "# Paper A, experiment 3.2, on simulated frames"
    yield from ("", f"`{results.command}`", "")
    if results.unfinished:
        yield from (f"**Not finished**: {', '.join(results.unfinished)}. The same command goes on.", "")
    yield from _set_up(results)
    if results.runs:
        yield from ("", "## What the numbers say", "", *statement_lines(results.statements))
        yield from ("", "## The paper's quantities", "", *markdown(experiment_table(results)), "", *QUANTITIES)
        yield from ("", "Over the seeds, paper-a without correction: median (least … largest).", "")
        yield from markdown(scatter_table(results))
        yield from _run_pictures(results, folder)
    if results.effects:
        yield from ("", "## The correction, without images", "", *CORRECTION, "")
        yield from markdown(correction_table(results.effects))
        yield from picture(folder, "correction", lambda: pictures.correction(results.effects))
    if results.matrix:
        yield from _matrix_lines(results, folder)
    if results.limits:
        yield from _limits_lines(results, folder)
    yield from version_lines()


def _set_up(results: Results) -> Iterator[str]:
    yield (
        f"{results.frames} frames at {RATE_HZ:g} Hz, {Path(results.surface).name}, figure eight at {SPEED_MPS:g} m/s "
        f'(the paper\'s "2 km/h"), noise {NOISE_GREY:g} grey levels, W = {100 * METRES_PER_PX:.4f} cm/px, K = 25, '
        f"seeds {', '.join(map(str, results.seeds))}."
    )
    yield ""
    for condition in CONDITIONS:
        yield f"- {condition.name}: {condition.meaning}"
    yield ""
    yield (
        f"Tilt and height are Gaussian, correlated over {TAU_FRAMES:g} frames; the speed has 10 % jitter and a start "
        "within 40 frames. The authors' own frames, mount and thresholds are not published: what is reproduced is the "
        "method on ground, motion and disturbances of the published kind."
    )


QUANTITIES = (
    "rel: sqrt(Σ e² / Σ (g - g₀)²) about the start; mean X Y: what the paper's third figure, 0.0569, is of its first "
    "two; end X, end Y: of the range of the coordinate; end %: of the path; yaw: magnitude at the end; shift, Δα: rms "
    "per frame against the motion at the nominal height; block: sums of 50 errors of Δα against independent ones; "
    "failed: motions more than 1 px off. Medians over the seeds.",
)
CORRECTION = (
    f"A front end with white noise of {SHIFT_NOISE_PX:g} px and {1e3 * TURN_NOISE_RAD:g} mrad, (14)-(17) as the paper "
    f"has them; medians over {correction.SEEDS} seeds. The reference speed is the nominal one; (20) with magnitudes, "
    "its thresholds are 0.1 and 0.2 cm.",
)


def _run_pictures(results: Results, folder: Path) -> Iterator[str]:
    logged = {log.name for log in results.logs}
    for run in results.runs:
        if f"log-{run.cell.name}" not in logged:
            continue
        name = run.cell.name
        yield from ("", f"## {name}: {run.cell.condition.meaning}")
        yield from picture(folder, f"fig5-{name}", partial(pictures.trajectories, run))
        yield from picture(folder, f"fig6-{name}", partial(pictures.errors, run))
        yield from ("", f"Logged: `workbench view {folder / f'log-{name}'}`")


def _matrix_lines(results: Results, folder: Path) -> Iterator[str]:
    surfaces = list(dict.fromkeys(row["surface"] for row in results.matrix))
    frames = sorted({row["frames"] for row in results.matrix})
    yield from ("", "## Surfaces, speeds, trajectories", "")
    yield from (f"Drives of {', '.join(frames)} frames without disturbance, both presets.", "")
    yield from markdown(matrix_table(results.matrix))
    yield from picture(folder, "matrix", lambda: pictures.matrix(results.matrix, surfaces))


def _limits_lines(results: Results, folder: Path) -> Iterator[str]:
    samples = sorted({case.samples for case in results.limits})
    yield from ("", "## Which fragment is needed where", "")
    yield (
        f"False peaks (more than {limits.FALSE_PX:g} px off) in % of {', '.join(map(str, samples))} fragments a cell. "
        f"Usual: noise {limits.USUAL_NOISE:g}, search radius {limits.USUAL_RADIUS} px, rotation "
        f"{limits.USUAL_ROTATION:g}°. N needed: the smallest with at most 1 %."
    )
    for varied, table in limits_tables(results.limits).items():
        yield from ("", f"### By {varied}", "", *markdown(table))
    yield from picture(folder, "limits", lambda: pictures.limits(*_limits_maps(results.limits)))


def _limits_maps(found: Mapping[limits.Case, Mapping[int, float]]) -> tuple[Any, Any, list[str]]:
    """What `pictures.limits` draws."""
    surfaces = list(dict.fromkeys(case.surface for case in found))
    usual = {case.surface: rates for case, rates in found.items() if all(v.holds(case) for v in VARIED)}
    rates = {surface: usual.get(surface, {}) for surface in surfaces}
    needed = {}
    for varied in VARIED:
        cases = {(c.surface, getattr(c, varied.field)): r for c, r in found.items() if varied.holds(c)}
        names = sorted({value for _, value in cases})
        smallest = np.full((len(surfaces), len(names)), np.nan)
        for (surface, value), by_side in cases.items():
            side = limits.smallest_side(by_side)
            smallest[surfaces.index(surface), names.index(value)] = math.inf if side is None else side
        needed[varied.name.partition(" (")[0]] = ([f"{name:g}" for name in names], smallest)
    return rates, needed, surfaces


def _place(surfaces: Sequence[str], field: str, case: limits.Case) -> tuple[int, float]:
    """Where a case stands in a table: by surface, then by what is varied."""
    return surfaces.index(case.surface), float(getattr(case, field))
