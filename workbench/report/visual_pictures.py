"""The picture of a frame of visual odometry: its image with points by what became of them, and filters' segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.semidirect.step import Feature, Stage
from workbench.report.markup import Element, el
from workbench.runs import Run
from workbench.visual_traces import FEATURE_COLOURS, FILTER_COLOURS, STOP_NAMES, UNSEEN, found, level_costs

_POINTS = ("predicted_px", "found_px", "outcome", "error_px", "level")
_FILTERS = ("epipolar_px", "filter_outcome")
_ALIGNMENT = ("align_cost", "align_iterations", "align_stop")
HALF = 0.5
"""From the Step's pixels, whose first has its centre at 0, to the picture's."""


def fields(run: Run) -> tuple[str, ...]:
    """The lists that a picture needs."""
    return tuple(name for name in (*_POINTS, *_FILTERS, *_ALIGNMENT) if name in run.lists)


def marks(here: Mapping[str, NDArray[Any]]) -> list[Element]:
    """Points and segments of a frame."""
    drawn = [] if "epipolar_px" not in here else _segments(here["epipolar_px"], here["filter_outcome"])
    matched = found(here["outcome"])
    at = np.where(matched[:, None], here["found_px"], here["predicted_px"]) + HALF
    for (u, v), outcome, seen in zip(at.tolist(), here["outcome"].tolist(), matched.tolist(), strict=True):
        if u == u and v == v:
            colour = _hex(FEATURE_COLOURS[Feature(outcome)])
            drawn.append(el("circle", cx=f"{u:.1f}", cy=f"{v:.1f}", r="4" if seen else "2.5", fill="none",
                            stroke=colour, stroke_width="1.6"))  # fmt: skip
    return drawn


def _segments(ends: NDArray[np.float64], outcome: NDArray[np.int64]) -> list[Element]:
    shown = np.isfinite(ends).all(axis=1) & (outcome != UNSEEN)
    drawn = []
    for (u, v, x, y), kind in zip((ends[shown] + HALF).tolist(), outcome[shown].tolist(), strict=True):
        colour = _hex(FILTER_COLOURS[min(kind, len(FILTER_COLOURS) - 1)])
        path = f"M{u:.1f} {v:.1f}L{x:.1f} {y:.1f}"
        drawn.append(el("path", d=path, stroke=colour, stroke_width="1", fill="none"))
    return drawn


def caption(frame: int, stage: int, here: Mapping[str, NDArray[Any]]) -> str:
    """What the picture shows."""
    segments = "; lines: epipolar segments of the depth filters by outcome" if "epipolar_px" in here else ""
    return (
        f"Frame {frame} ({Stage(stage).name.lower()}): points found (large circles, green: they agree with the pose, "
        f"red: they do not), points expected and not found (small, by cause){segments}."
    )


def table(here: Mapping[str, NDArray[Any]]) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Points by what became of them; of the semi-direct odometry also the levels of the alignment."""
    counts = np.bincount(here["outcome"], minlength=len(Feature))
    rows = [
        (feature.name.lower().replace("_", " "), str(int(count)), _median(here["error_px"], here["outcome"], feature))
        for feature, count in zip(Feature, counts, strict=True)
        if count
    ]
    levels = _levels(here) if "align_cost" in here else []
    return ("points", "how many", "median error px"), (*rows, *levels)


def _levels(here: Mapping[str, NDArray[Any]]) -> list[tuple[str, str, str]]:
    """Each level of the alignment: how it ended, iterations, cost before and after."""
    costs = level_costs({"align_cost": np.array([here["align_cost"]])})[0].reshape(-1, 2)
    steps = zip(here["align_iterations"].tolist(), here["align_stop"].tolist(), costs.tolist(), strict=True)
    return [
        (f"alignment {k + 1}, from the coarsest: {STOP_NAMES[stop]}", str(n), f"{before:.4g} → {after:.4g} grey²")
        for k, (n, stop, (before, after)) in enumerate(steps)
    ]


def _median(errors: NDArray[np.float64], outcome: NDArray[np.int64], feature: Feature) -> str:
    known = errors[(outcome == feature) & np.isfinite(errors)]
    return f"{np.median(known):.3g}" if len(known) else "–"


def _hex(colour: int) -> str:
    return f"#{colour >> 8:06x}"


def lists_of(run: Run, frames: Sequence[int]) -> dict[int, dict[str, NDArray[Any]]]:
    """The lists of some frames, by frame.

    Raises:
        RecordingError: the run's file cannot be read.
    """
    wanted = fields(run)
    return {frame: {name: values for name, values in run.lists_at(frame).items() if name in wanted} for frame in frames}
