"""The pictures of paper B's experiments: like its Figs 6-8 and 10-12, and those of consistency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.ranging import montecarlo as mc
from workbench.reproduce.drawing import BLACK, BLUE, GREEN, ORANGE, RED, figure_of
from workbench.reproduce.ranging.robot import Robot
from workbench.reproduce.ranging.simulation import Accuracy, Consistency, Convergence, Scaling

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (BLACK, ORANGE, BLUE, GREEN, RED, "#CC79A7")
SIGNS = ("o", "s", "^", "D", "v", "*")
READINGS = {"as-printed": "(30) as printed", "exact": "noise on the measurements only"}


def _curves(axis: Axes, x: Any, curves: Sequence[tuple[str, Any]], *, every: int = 5) -> None:
    """Curves that differ in colour and sign."""
    for (label, y), colour, sign in zip(curves, COLOURS, SIGNS, strict=False):
        axis.plot(x, y, sign + "-", color=colour, ms=5, mfc="none", lw=1.2, markevery=every, label=label)


# ---------------------------------------------------------------------------- the simulation


def convergence(found: Convergence, varied: str, unit: str, title: str) -> Figure:
    """As Figs 6 and 7: mean range error over time, a panel for each pixel noise."""
    sigmas = list(dict.fromkeys(row.pixel_sigma for row in found.rows))
    figure, axes = figure_of(11.0, 4.2, 1, len(sigmas), sharey=True)
    for axis, r in zip(axes[0], sigmas, strict=True):
        rows = found.of(varied, r)
        _curves(axis, found.time_s, [(f"{row.value:g} {unit}", row.error_m) for row in rows])
        axis.axhline(0.8, color="grey", ls="--", lw=1, label="10 % of the range")
        axis.set_yscale("log")
        axis.set_ylim(0.03, 8)
        axis.set_title(f"pixel noise {r:g} px")
        axis.set_xlabel("time, s")
    axes[0, 0].set_ylabel("mean |range error|, m")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=7)
    figure.suptitle(title)
    return figure


def accuracy(found: Accuracy, scaling: Scaling | None) -> Figure:
    """As Fig. 8: relative error against L in both readings, with Table 2; beside it, the same L at other speeds."""
    figure, axes = figure_of(11.0, 4.6, 1, 2, width_ratios=(3, 2))
    axis = axes[0, 0]
    kept = [row for row in found.rows if row.reading == "exact" or row.pixel_sigma == mc.TABLE_2_PIXEL_SIGMA]
    labelled = [(f"{READINGS[row.reading]}, {row.pixel_sigma:g} px", 100 * np.array(row.rms)) for row in kept]
    _curves(axis, found.scale, labelled)
    columns = [found.scale[int(np.argmin(np.abs(np.array(found.time_s) - t)))] for t in mc.TABLE_2]
    axis.plot(columns, list(mc.TABLE_2.values()), "X", color=RED, ms=9, label="paper, Table 2")
    for row in kept:
        if row.reading == "exact":
            axis.plot(found.scale, 100 * np.array(row.bound), ":", color="grey", lw=1)
    axis.plot([], [], ":", color="grey", label="Cramér-Rao bounds")
    axis.set_yscale("log")
    axis.set_ylim(0.7, 60)
    axis.set_xlabel("L = V t / D₀")
    axis.set_ylabel("RMS relative error, %")
    axis.legend(fontsize=8)
    axis.set_title("as Fig. 8: error against L")
    _speeds(axes[0, 1], scaling)
    return figure


def _speeds(axis: Axes, scaling: Scaling | None) -> None:
    axis.set_title("the same L, noise of Table 1 as it is")
    axis.set_xlabel("speed, m/s")
    axis.set_ylabel("RMS relative error, %")
    if scaling is None:
        return
    for (r, colour), sign in zip(
        dict.fromkeys((row.pixel_sigma, c) for row, c in zip(scaling.rows, (BLACK,) * 3 + (BLUE,) * 3, strict=True)),
        SIGNS,
        strict=False,
    ):
        rows = [row for row in scaling.rows if row.pixel_sigma == r]
        axis.plot(
            [row.speed_mps for row in rows],
            [100 * row.rms for row in rows],
            sign + "-",
            color=colour,
            label=f"{r:g} px, L = {scaling.scale:.3f}",
        )
    axis.set_ylim(bottom=0)
    axis.legend(fontsize=8)


def consistency(found: Consistency) -> Figure:
    """RMS/CRB, NEES, NIS and coverage of the standard case over time, with their bands."""
    figure, axes = figure_of(11.0, 5.6, 2, 2, sharex=True)
    panels: tuple[tuple[str, str, float, tuple[float, float] | None, tuple[float, float]], ...] = (
        ("ratio", "RMS error / Cramér-Rao bound", 1.0, None, (0.9, 2.0)),
        ("nees", "mean NEES (3 degrees)", 3.0, found.nees_band, (2.0, 3.6)),
        ("nis", "mean NIS (2 degrees)", 2.0, found.nis_band, (1.4, 2.4)),
        ("coverage", "share within 2 σ_ξ", 0.954, None, (0.88, 1.0)),
    )
    for axis, (name, label, expected, band, limits) in zip(axes.flat, panels, strict=True):
        _curves(axis, found.time_s, [(f"pixel noise {row.pixel_sigma:g} px", getattr(row, name)) for row in found.rows])
        axis.axhline(expected, color="grey", ls="--", lw=1)
        if band:
            axis.axhspan(*band, color="grey", alpha=0.3, label=f"95 % band of {found.runs} runs")
        axis.set_ylim(*limits)
        axis.set_ylabel(label)
    for axis in axes[1]:
        axis.set_xlabel("time, s")
    figure.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.suptitle(f"Standard case S0, {found.runs} runs: is the filter as good as it says, and as good as can be?")
    return figure


# ----------------------------------------------------------------------------------- robot


def speeds(found: Robot) -> Figure:
    """As Fig. 10: measured speeds of the camera, as the filter used them."""
    figure, axes = figure_of(9.0, 4.4, 2, 1, sharex=True)
    linear, angular = axes[:, 0]
    linear.plot(found.run.frame_s, found.run.speed, color=BLUE, lw=0.8)
    linear.set_ylabel("speed V, m/s")
    angular.plot(found.run.frame_s, np.degrees(found.run.omega), color=RED, lw=0.8)
    angular.set_ylabel("turn ω, °/s")
    angular.set_xlabel("time, s")
    figure.suptitle("as Fig. 10: measured linear and angular speed of the camera, means from frame to frame")
    return figure


def depth(found: Robot) -> Figure:
    """As Fig. 11: range estimate with its band and the reference, the whole run and its first seconds."""
    run, begin = found.run, found.facts.start_s
    figure, axes = figure_of(9.0, 6.4, 2, 1)
    for axis, stop in ((axes[0, 0], math.inf), (axes[1, 0], begin + 4.0)):
        shown = np.array(run.frame_s) <= stop
        time = np.array(run.frame_s)[shown]
        far = np.minimum(np.array(run.far_m), 20.0)
        axis.fill_between(time, np.array(run.near_m)[shown], far[shown], color=BLUE, alpha=0.25, label="ξ ± 2 σ_ξ")
        axis.plot(time, np.array(run.estimate_m)[shown], "-", color=BLUE, lw=1.2, label="estimate")
        axis.plot(time, np.array(run.depth_m)[shown], "--", color=BLACK, lw=1.2, label="truth")
        every = slice(None, None, 1 if math.isfinite(stop) else 5)
        axis.plot(
            time[every], np.array(run.reference_m)[shown][every], "x", color=RED, ms=5, label="PnP from the board"
        )
        axis.axvline(begin, color="grey", ls=":", lw=1)
        axis.set_ylabel("range, m")
    axes[0, 0].set_ylim(3.4, 6.2)
    axes[1, 0].set_ylim(3, 12)
    axes[1, 0].text(begin + 0.03, 11.2, "starts to move", color="dimgrey", fontsize=8)
    axes[1, 0].set_xlabel("time, s")
    axes[0, 0].legend(ncols=4, loc="upper center")
    axes[0, 0].set_title("as Fig. 11: range to the board's upper-left corner; below, the first seconds")
    return figure


def errors(found: Robot) -> Figure:
    """As Fig. 12: error of ξ and its predicted σ; below, the square roots of P's diagonal."""
    run, time = found.run, found.run.frame_s
    figure, axes = figure_of(9.0, 6.4, 2, 1, sharex=True)
    upper, lower = axes[:, 0]
    sigma = np.array(run.sigma_xi)
    upper.fill_between(time, -2 * sigma, 2 * sigma, color=BLUE, alpha=0.15, label="± 2 σ_ξ")
    upper.fill_between(time, -sigma, sigma, color=BLUE, alpha=0.3, label="± σ_ξ predicted")
    upper.plot(time, run.xi_error, "-", color=RED, lw=1.2, label="actual error")
    upper.set_ylim(-0.012, 0.012)
    upper.set_ylabel("error of ξ, 1/m")
    upper.legend(ncols=3, loc="upper right")
    upper.set_title("as Fig. 12: actual and predicted error of the inverse depth; below, P's diagonal")
    _curves(lower, time, [("σ_x, px", run.sigma_x), ("σ_y, px", run.sigma_y), ("σ_ξ, 1/m", run.sigma_xi)], every=12)
    lower.set_yscale("log")
    lower.set_ylabel("√P_ii")
    lower.set_xlabel("time, s")
    lower.legend(ncols=3, loc="upper right")
    return figure


def table_3(found: Robot) -> Figure:
    """Table 3 beside the runs of the replica, and beside odometers of other noise."""
    figure, axes = figure_of(11.0, 4.6, 1, 2, sharex=True, sharey=True)
    left, right = axes[0]
    scale = [column.scale for column in found.table]
    low, middle, high, sigma, paper, reference = (
        [100 * getattr(column, name) for column in found.table]
        for name in ("low", "median", "high", "sigma", "paper", "reference")
    )
    left.fill_between(scale, low, high, color=BLUE, alpha=0.25, label="nine runs of ten")
    left.plot(scale, middle, "o-", color=BLUE, label=f"median of {found.seeds} runs")
    left.plot(scale, sigma, "--", color=GREEN, label="σ_ξ/ξ predicted")
    left.plot(scale, reference, ":", color=BLACK, label="PnP reference itself, RMS")
    for axis in (left, right):
        axis.plot(scale, paper, "X", color=RED, ms=9, label="paper, Table 3 (one run)")
        axis.set_yscale("log")
        axis.set_xlabel("L")
    left.set_ylabel("|relative error|, %")
    left.set_title("the replica")
    medians = [(f"σ_V = {row.sigma_speed:g}", 100 * np.array(row.median)) for row in found.implied]
    _curves(right, scale, medians, every=1)
    right.set_title("medians by the odometer's noise (m/s/√Hz)")
    left.legend(fontsize=8)
    right.legend(fontsize=8)
    return figure
