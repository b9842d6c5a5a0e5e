"""The pictures of paper C's flights: like its Figs 3-5, and the scale along the path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from workbench.reproduce.drawing import BLACK, BLUE, GREEN, ORANGE, figure_of
from workbench.reproduce.flights.flying import Flown, methods_flown
from workbench.reproduce.flights.methods import ACCURATE, BASELINE, FAST, KLT
from workbench.reproduce.flights.results import SVO

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {FAST: BLUE, ACCURATE: GREEN, BASELINE: ORANGE, KLT: BLACK}
SIGNS = {FAST: "o", ACCURATE: "s", BASELINE: "^", KLT: "D"}
LABELS = {FAST: "fast", ACCURATE: "accurate", BASELINE: "baseline (PTAM-style)", KLT: "OpenCV KLT"}
LEAST_SHARE = 1e-6


def along(flight: Flown) -> Figure:
    """Over the true path: position error (Fig. 4), attitude error (Fig. 5), and the estimate's scale."""
    figure, axes = figure_of(9.0, 8.0, 3, 1, sharex=True)
    for result in flight.results:
        look = _look(result.method)
        share = np.maximum(np.array(result.position_m) / flight.path_m, LEAST_SHARE)
        axes[0, 0].plot(result.path_m, 100 * share, **look)
        axes[1, 0].plot(result.path_m, np.degrees(result.attitude_rad), **look)
        axes[2, 0].plot(result.scale_path_m, 100 * (np.array(result.scale) - 1), **look)
    axes[0, 0].set(yscale="log", ylabel="position error, % of the flight")
    axes[1, 0].set(yscale="log", ylabel="attitude error, °")
    axes[2, 0].set(ylabel="scale - median, %", xlabel="way flown, m", xlim=(0, flight.path_m))
    axes[0, 0].legend(loc="lower right", ncols=4, fontsize=8)
    axes[0, 0].set_title(f"{flight.flight}: errors after Sim(3) alignment (as Figs 4 and 5)")
    return figure


def _look(method: str) -> dict[str, Any]:
    """Line, colour and sign of a method."""
    return {
        "color": COLOURS[method],
        "marker": SIGNS[method],
        "markevery": 0.1,
        "ms": 4,
        "mfc": "none",
        "lw": 1.1,
        "label": LABELS[method],
    }


def bars(flights: Sequence[Flown]) -> Figure:
    """Flight by flight: error, outliers of the map (Fig. 3), frames/s beside the paper's."""
    figure, axes = figure_of(10.0, 9.0, 3, 1, sharex=True)
    methods = methods_flown(flights)
    width = 0.8 / max(len(methods), 1)
    for place, method in enumerate(methods):
        found = [flight.of(method) for flight in flights]
        x = np.arange(len(flights)) + (place - (len(methods) - 1) / 2) * width
        look: dict[str, Any] = {"width": width, "color": COLOURS[method], "label": LABELS[method]}
        errors = [math.nan if r is None else 100 * r.accuracy.ate_share for r in found]
        axes[0, 0].bar(x, errors, **look)
        if method != KLT:
            outliers = [math.nan if r is None else r.map_errors.outliers for r in found]
            axes[1, 0].bar(x, outliers, **look)
        axes[2, 0].bar(x, [math.nan if r is None else r.work.frames_per_s for r in found], **look)
    for method in (FAST, BASELINE):
        axes[2, 0].axhline(SVO[method].laptop_fps, color=COLOURS[method], ls="--", lw=1)
        text = f"paper, {LABELS[method]}"
        axes[2, 0].annotate(
            text, (0, SVO[method].laptop_fps), xycoords=("axes fraction", "data"), fontsize=7, va="bottom"
        )
    axes[0, 0].set(yscale="log", ylabel="ATE, % of the flight")
    axes[1, 0].set(ylabel="outliers in the map (Fig. 3)")
    axes[1, 0].set_yscale("symlog", linthresh=1)
    axes[2, 0].set(yscale="log", ylabel="tracking, frames/s of CPU time")
    axes[2, 0].set_xticks(np.arange(len(flights)), [flight.flight.removeprefix("flight-") for flight in flights])
    axes[0, 0].legend(loc="upper left", ncols=4, fontsize=8)
    return figure
