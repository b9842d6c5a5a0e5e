"""An evaluated flight in words and files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from readers.streams import RecordingError
from workbench.patrol import page
from workbench.patrol.evaluating import Evaluation
from workbench.summary import without_nan


def write(done: Evaluation, values: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write evaluation.json, evaluation.html and coverage.rrd; returns them.

    Raises:
        RecordingError: they cannot be written.
    """
    from workbench.patrol import rrd_patrol

    report, shown = folder / "evaluation.json", folder / "evaluation.html"
    told = sentences(values)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        report.write_text(json.dumps(without_nan(values), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        shown.write_text(page.html(f"Coverage of {folder.name}", done, values, told), encoding="utf-8")
    except OSError as error:
        problem = f"no results can be written there ({error.strerror or error})"
        raise RecordingError(folder, problem, "choose another folder with -o") from error
    lines = ["# What the flight has seen", "", *(f"- {line}" for line in told)]
    return [report, shown, rrd_patrol.write_flight(folder / "coverage.rrd", done, "\n".join(lines))]


def sentences(values: Mapping[str, Any]) -> list[str]:
    """The evaluation in words."""
    times, fine, ahead = values["times_seen"], values["sample_distance_m"], values["forward_overlap"]
    lines = [
        f"{values['footprints']} of {values['pictures']} pictures have a footprint; "
        f"{values['flown_m']:.0f} m flown in {values['flown_s'] / 60:.1f} min, {_span(values['height_m'], 'm')} high",
        f"seen: {values['seen_m2']:.0f} m², each place {_span(times, 'times')}; "
        f"{values['seen_once_m2']:.0f} m² once only, {values['seen_three_times_m2']:.0f} m² three times or more",
    ]
    if "target_m2" in values:
        lines.append(
            f"covers {values['covered_share']:.2%} of the area of {values['target_m2']:.0f} m², "
            f"and {values['seen_outside_m2']:.0f} m² outside"
        )
    if not math.isnan(fine["median"]):
        lines.append("a pixel is " + _span({k: 100 * v for k, v in fine.items()}, "cm") + " of ground at its finest")
    if not math.isnan(ahead["median"]):
        shares = _span({k: 100 * v for k, v in ahead.items()}, "%")
        lines.append(f"a picture overlaps the one before by {shares}; {values['steps_without_overlap']} do not at all")
    where = ", ".join(f"{g['area_m2']:.0f} m² at ({g['x_m']:.0f}, {g['y_m']:.0f})" for g in values["largest_gaps"])
    lines.append(f"{values['gaps']} gaps of {values['gaps_m2']:.0f} m²" + (f": {where}" if where else ""))
    if "against_plan" in values:
        plan = values["against_plan"]
        lines += [
            f"planned {plan['planned_m']:.0f} m in {plan['planned_s'] / 60:.2f} min; "
            f"{plan['passes_flown']} of {plan['passes']} passes flown",
            f"beside the passes: {plan['cross_track_rms_m']:.2f} m rms, 95 % within {plan['cross_track_p95_m']:.2f} m, "
            f"{plan['cross_track_max_m']:.2f} m at most",
        ]
    return [*lines, *values["notes"]]


def _span(spread: Mapping[str, float], unit: str) -> str:
    return f"{spread['least']:.3g} to {spread['most']:.3g} (median {spread['median']:.3g}) {unit}"
