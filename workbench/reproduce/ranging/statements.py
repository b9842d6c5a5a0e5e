"""What the numbers say of paper B's claims and of the bars: every sentence and verdict is computed from them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from pipelines.ranging import montecarlo as mc
from pipelines.ranging.inputs import Synchronisation
from workbench.reproduce.judged import Statement, Upshot, worst
from workbench.reproduce.ranging import simulation as sim
from workbench.reproduce.ranging.results import Results
from workbench.reproduce.ranging.robot import PRINTED, TABLE_3, Robot
from workbench.reproduce.ranging.simulation import (
    Accuracy,
    Asynchronous,
    Better,
    Consistency,
    Convergence,
    Misprints,
    Scaling,
)

TABLE_2_TOLERANCE = 0.07
MEASURED_BARS = (2.4, 1.6, 1.30, 1.12, 1.00)
"""Table 2's columns with noise on the measurements only, %."""
STANDARD = {0.1: (0.282, 0.118, 0.076), 0.5: (1.115, 0.394, 0.203)}
"""Mean |error| of S0 in m at 1, 2, 3 s by pixel noise."""
STANDARD_TOLERANCE, RATIO_BAR = 0.08, 1.15
NEES_OFF, NIS_OFF, COVERAGE, COVERAGE_OFF = 0.2, 0.05, 0.95, 0.02
FIGURE_6 = {0.2: 2.2, 0.4: 1.4, 0.8: 0.9, 1.6: 0.5}
FIGURE_7 = {0.1: math.inf, 0.3: 2.0, 0.5: 1.4, 0.8: 1.0}
"""Times to 10 % of the range at 0.5 px, s."""
TIME_TOLERANCE_S = 0.2
PAPER_CONVERGED_S = (1.5, 2.0)
SCALING_BAR = 1e-9
JOINT_BARS = {0.1: 1.45, 0.5: 2.8}
LAG_BAR, SMOOTHER_BAR = 2.3, 2.1
BLUNDER_FACTOR, SLIP_BAR = 1.1, {0.1: 2.0, 0.5: 6.0}
HELD = (2.34, 1.14)
HELD_TOLERANCE, PRINTED_BIAS = 0.10, -0.60
LIKELY = 0.05
"""What fewer runs than this share do is not put down to chance."""
ROUNDING = 1e-9


def statements(results: Results) -> list[Statement]:
    """All that can be said of what was computed."""
    made: list[Statement] = []
    if results.accuracy:
        made += of_table_2(results.accuracy)
    if results.convergence:
        made += of_figures(results.convergence)
    if results.accuracy and results.convergence:
        made.append(of_convergence_time(results.accuracy, results.convergence))
    if results.scaling:
        made += of_scaling(results.scaling)
    if results.consistency:
        made += of_consistency(results.consistency)
    if results.better:
        made += of_better(results.better)
    if results.misprints:
        made += of_misprints(results.misprints)
    if results.asynchronous:
        made.append(of_synchronisation(results.asynchronous))
    if results.robot:
        made += of_robot(results.robot)
    return made


def judged(claim: str, holds: bool, numbers: str) -> Statement:
    """A statement that is reached or missed."""
    return Statement(claim, Upshot.REACHED if holds else Upshot.MISSED, numbers)


def listed(values: Iterable[float], form: str = "{:.2f}") -> str:
    """Numbers in a row; infinity as ``never``."""
    return " / ".join("never" if math.isinf(value) else form.format(value) for value in values)


def percent(values: Iterable[float], form: str = "{:.2f}") -> str:
    """Shares in a row, in %."""
    return f"{listed((100 * value for value in values), form)} %"


# --------------------------------------------------------------------------------- Table 2


def table_2_columns(found: Accuracy, row: Accuracy.Row) -> list[float]:
    """RMS relative error at the times of Table 2."""
    times = np.array(found.time_s)
    return [row.rms[int(np.argmin(np.abs(times - t)))] for t in mc.TABLE_2]


def of_table_2(found: Accuracy) -> Iterator[Statement]:
    """Both readings at the noise that Table 2 asks for, the noise of real tracks, consistency of the printed one."""
    rows = {(row.reading, row.pixel_sigma): row for row in found.rows}
    paper = [value / 100 for value in mc.TABLE_2.values()]
    fine = mc.TABLE_2_PIXEL_SIGMA
    printed, exact = rows["as-printed", fine], rows["exact", fine]
    ours = table_2_columns(found, printed)
    off = max(abs(a / b - 1) for a, b in zip(ours, paper, strict=True))
    yield judged(
        f"Table 2 within {100 * TABLE_2_TOLERANCE:.0f} %, (30) as printed: the truth moves by noisy speeds, pixels of "
        f"{fine:g} px",
        off <= TABLE_2_TOLERANCE,
        f"{percent(ours)}, paper {percent(paper)}; largest deviation {100 * off:.1f} %",
    )
    measured = table_2_columns(found, exact)
    gain = float(np.median(np.array(ours) / measured))
    yield judged(
        f"noise on the measurements only, {fine:g} px: at most {listed(MEASURED_BARS)} %",
        all(100 * value <= bar for value, bar in zip(measured, MEASURED_BARS, strict=True)),
        f"{percent(measured)}, {gain:.2f} times better than (30) as printed, whose speeds carry the noise twice",
    )
    consistent = abs(printed.nees - 3) <= NEES_OFF
    yield judged(
        "the filter of Table 2, (30) as printed, knows its own error (NEES 3)",
        consistent,
        f"NEES {printed.nees:.2f} as printed, {exact.nees:.2f} with noise on the measurements only"
        + ("" if consistent else "; the truth's own noise is not in Q"),
    )
    coarse = rows["exact", max(sim.TABLE_2_PIXELS)]
    errors = table_2_columns(found, coarse)
    holds = all(a <= b * (1 + TABLE_2_TOLERANCE) for a, b in zip(errors, paper, strict=True))
    bound = table_2_columns(found, coarse.model_copy(update={"rms": coarse.bound}))
    yield judged(
        f"Table 2 with the pixel noise of real tracks, {coarse.pixel_sigma:g} px at f = 800",
        holds,
        f"{percent(errors)}; the Cramér-Rao bound is {percent(bound)}"
        + (": no filter can" if all(a > b for a, b in zip(bound, paper, strict=True)) else ""),
    )


# ----------------------------------------------------------------------------- Figs 6 and 7


def of_figures(found: Convergence) -> Iterator[Statement]:
    """Times to 10 % against the study's; what distance from the focus means; the error of the start."""
    r = max(sim.CURVE_PIXELS)
    for name, varied, wanted, what in (
        ("Fig. 6", "offset", FIGURE_6, "the farther from the focus of expansion, the faster"),
        ("Fig. 7", "speed", FIGURE_7, "the faster the camera, the faster"),
    ):
        times = {row.value: row.converged_s for row in found.of(varied, r)}
        ours = [times[value] for value in wanted]
        near = all(
            a == b or abs(a - b) <= TIME_TOLERANCE_S + ROUNDING for a, b in zip(ours, wanted.values(), strict=True)
        )
        yield judged(
            f"{name}: {what}; times to 10 % at {r:g} px within {TIME_TOLERANCE_S:g} s of the study's",
            near and ours == sorted(ours, reverse=True),
            f"{listed(ours, '{:.1f}')} s for {listed(wanted, '{:g}')} {'m' if varied == 'offset' else 'm/s'}, "
            f"study {listed(wanted.values(), '{:.1f}')} s",
        )
    across, up = (row.error_m[-1] for row in found.of("axis", r))
    holds = across <= 1.2 * up
    yield judged(
        "distance from the optical axis counts, whichever its direction",
        holds,
        f"mean error after 3 s: {across:.2f} m 0.8 m to the side, {up:.2f} m 0.8 m up"
        + ("" if holds else "; the gyro's noise eats parallax in x, distance counts in y"),
    )
    starts = found.of("start", r)
    later = [row.error_m[-1] for row in starts]
    times_s = [row.converged_s for row in starts]
    yield judged(
        "a smaller error of the start converges faster, one of half the range is still coped with",
        times_s == sorted(times_s) and math.isfinite(times_s[-1]),
        f"{listed(times_s, '{:.1f}')} s to 10 % from {listed((row.value for row in starts), '{:g}')} m too far; "
        f"error after 3 s {listed(later)} m",
    )


def of_convergence_time(accuracy: Accuracy, found: Convergence) -> Statement:
    """The paper's 1.5-2 s in the simulation, at the noise that its Table 2 needs and at that of real tracks."""
    low, high = PAPER_CONVERGED_S
    needed = next(
        row for row in accuracy.rows if (row.reading, row.pixel_sigma) == ("as-printed", mc.TABLE_2_PIXEL_SIGMA)
    )
    coarse = next(row for row in found.of("speed", max(sim.CURVE_PIXELS)) if row.value == 0.5)
    holds = low - TIME_TOLERANCE_S <= needed.converged_s <= high + TIME_TOLERANCE_S
    text = (
        f"{needed.converged_s:.1f} s at the {needed.pixel_sigma:g} px that Table 2 asks for, "
        f"{coarse.converged_s:.1f} s at {coarse.pixel_sigma:g} px"
    )
    return judged(
        f"the simulated filter of Table 2 and Fig. 8 converges in {low:g}-{high:g} s",
        holds,
        text + ("" if holds else ": the paper's Table 2 and its convergence time belong to different pixel noises"),
    )


# --------------------------------------------------------------------------------- scaling


def of_scaling(found: Scaling) -> Iterator[Statement]:
    """The exact laws, and the paper's reading of them."""
    yield judged(
        f"scaling of space (noise σ_V too) and of time (frames and noise too) is exact to {SCALING_BAR:g}",
        max(found.space, found.time) < SCALING_BAR,
        f"largest change of any relative error: {found.space:.1e} for space x {found.space_factor:g}, {found.time:.1e} "
        f"for {found.time_factor:g} times as fast",
    )
    for r in dict.fromkeys(row.pixel_sigma for row in found.rows):
        rows = [row for row in found.rows if row.pixel_sigma == r]
        errors = [row.rms for row in rows]
        holds = max(errors) <= (1 + TABLE_2_TOLERANCE) * min(errors)
        cause = (
            "faster is better, the odometer's noise counts less"
            if errors[-1] < errors[0]
            else "faster is worse, fewer frames"
        )
        yield judged(
            f"the error at the same L is the same at every speed ({r:g} px, the noise and frame rate of Table 1)",
            holds,
            f"at L = {found.scale:.3f} {percent(errors)} at {listed((row.speed_mps for row in rows), '{:g}')} m/s"
            + ("" if holds else f": {cause}"),
        )


# ----------------------------------------------------------------------------- consistency


def of_consistency(found: Consistency) -> Iterator[Statement]:
    """S0: errors, efficiency, NEES, NIS, coverage, divergence."""
    times = np.array(found.time_s)
    later = times >= sim.SETTLED_S - ROUNDING
    for row in found.rows:
        wanted = STANDARD[row.pixel_sigma]
        ours = [row.error_m[int(np.argmin(np.abs(times - t)))] for t in (1.0, 2.0, 3.0)]
        off = max(abs(a / b - 1) for a, b in zip(ours, wanted, strict=True))
        yield judged(
            f"standard case, {row.pixel_sigma:g} px: mean errors within {100 * STANDARD_TOLERANCE:.0f} % of the "
            "study's",
            off <= STANDARD_TOLERANCE,
            f"{listed(ours, '{:.3f}')} m at 1 / 2 / 3 s, study {listed(wanted, '{:.3f}')} m",
        )
        ratio = np.array(row.ratio)[later]
        yield judged(
            f"standard case, {row.pixel_sigma:g} px: RMS/CRB at most {RATIO_BAR:g} from {sim.SETTLED_S:g} s",
            bool(ratio.max() <= RATIO_BAR),
            f"{ratio.min():.2f} … {ratio.max():.2f}",
        )
        nees, coverage = np.array(row.nees)[later], np.array(row.coverage)[later]
        low, high = found.nees_band
        yield judged(
            f"standard case, {row.pixel_sigma:g} px: consistent from {sim.SETTLED_S:g} s, none diverged",
            bool(
                np.abs(nees - 3).max() <= NEES_OFF
                and abs(row.nis_mean - 2) <= NIS_OFF
                and np.abs(coverage - COVERAGE).max() <= COVERAGE_OFF
                and row.diverged == 0
            ),
            f"NEES {nees.min():.2f} … {nees.max():.2f} (95 % band {low:.2f} … {high:.2f}), "
            f"mean NIS {row.nis_mean:.3f}, {100 * row.above:.1f} % of NIS above 5.99, "
            f"2σ coverage {coverage.min():.3f} … {coverage.max():.3f}, "
            f"{100 * row.diverged:.1f} % diverged",
        )


# -------------------------------------------------------------------------- what beats it


def of_better(found: Better) -> Iterator[Statement]:
    """The bars of the joint filter, lag-1, the smoother, the gate."""
    for joint in found.joint:
        bar = JOINT_BARS[joint.pixel_sigma]
        yield judged(
            f"joint filter of 5, landmark [0.8 0 8], {joint.pixel_sigma:g} px: at most {bar:g} % after 3 s",
            100 * joint.joint <= bar,
            f"{percent([joint.joint])} in place of {percent([joint.alone])}; NEES per degree {joint.nees:.2f}; "
            f"log depths of independent filters correlate {joint.correlation:.2f}",
        )
    slow: dict[str, Better.Slow] = {row.method: row for row in found.slow}
    for method, bar in (("lag-1", LAG_BAR), ("MAP", SMOOTHER_BAR)):
        row, plain = slow[method], slow["EKF"]
        yield judged(
            f"{method} at 0.1 m/s, 0.02 px, after 25 s: at most {bar:g} %",
            100 * row.rms <= bar,
            f"{percent([row.rms])}, bias {percent([row.bias])}, NEES {row.nees:.1f}; EKF {percent([plain.rms])}, bias "
            f"{percent([plain.bias])}, NEES {plain.nees:.1f}; Cramér-Rao bound {percent([found.slow_bound])}",
        )
    for hit in found.blunders:
        r, bar = hit.pixel_sigma, SLIP_BAR[hit.pixel_sigma]
        yield judged(
            f"gate and reset, {r:g} px: {100 * sim.BLUNDER_SHARE:.0f} % blunders within 10 % of clean, a slipped track "
            f"below {bar:g} %",
            hit.gated <= BLUNDER_FACTOR * hit.clean and 100 * hit.slip_reset < bar,
            f"medians: clean {percent([hit.clean])}, blunders gated {percent([hit.gated])}, not gated "
            f"{percent([hit.bare])} ({100 * hit.bare_diverged:.0f} % diverged); slip with reset "
            f"{percent([hit.slip_reset])}, gate alone {percent([hit.slip_gate])}, neither {percent([hit.slip_bare])}",
        )


# ------------------------------------------------------------------ misprints, synchronisation


def of_misprints(found: Misprints) -> Iterator[Statement]:
    """The three misprints that the study has figures for."""
    row = found.row(sim.NO_DT)
    yield judged(
        "G without dt, as printed, gives an honest σ_ξ",
        row.nees >= 3 - NEES_OFF,
        f"σ_ξ {row.sigma:.1f} times as large, NEES {row.nees:.2f}, NIS {row.nis:.2f}, RMS {row.rms:.2f} times",
    )
    row = found.row(sim.EULER_TURN)
    yield judged(
        "(21) with its integrand frozen, as printed, will do while turning",
        abs(row.bias) < 0.01 and row.nees <= 3 + NEES_OFF,
        f"bias {percent([row.bias])}, NEES {row.nees:.1f} at ω = 0.1 rad/s",
    )
    row = found.row(sim.A_MISPRINT)
    yield judged(
        "V ξ dt / f in A[0,0], as printed, changes the RMS error by less than 0.1 %",
        abs(row.rms - 1) < 1e-3,
        f"{100 * (row.rms - 1):+.3f} %",
    )


def of_synchronisation(found: Asynchronous) -> Statement:
    """Hold both against the study, and the paper's own way."""
    r = min(sim.CONSISTENCY_PIXELS)
    held, printed = found.row(Synchronisation.HOLD_BOTH, r), found.row(Synchronisation.AS_PRINTED, r)
    near = all(abs(100 * a / b - 1) <= HELD_TOLERANCE for a, b in zip(held.rms, HELD, strict=True))
    return judged(
        f"sensors of different rates, {r:g} px: both speeds held within 10 % of the study's, as printed worse than "
        f"{100 * PRINTED_BIAS:.0f} %",
        near and max(printed.bias) < PRINTED_BIAS,
        f"held {percent(held.rms)} after 5 / 12 s, study {listed(HELD)} %; as printed bias "
        f"{percent(printed.bias, '{:.0f}')}",
    )


# ----------------------------------------------------------------------------------- robot


def of_robot(found: Robot) -> Iterator[Statement]:
    """Table 3, Figs 11 and 12, what the paper's last columns ask of odometer and reference."""
    yield worst_column(found.table)
    printed, ours = (
        next(row for row in found.implied if row.sigma_speed == s)
        for s in (max(_sigmas(found)), found.facts.sigma_speed)
    )
    yield judged(
        f"Table 3's last two columns are to be had with Table 1's odometer, σ_V = {printed.sigma_speed:g} m/s/√Hz",
        printed.as_good >= LIKELY,
        f"{percent([printed.as_good], '{:.1f}')} of simulated runs are as good there, with {ours.sigma_speed:g} "
        f"m/s/√Hz {percent([ours.as_good], '{:.1f}')}; at the last L the bound is {percent([printed.bound[-1]])} and "
        f"{percent([ours.bound[-1]])}"
        + ("" if printed.as_good >= LIKELY else ": the figures are those of one run, and of a better odometer"),
    )
    low, high = PAPER_CONVERGED_S
    middle = float(np.median(found.converged_s))
    yield judged(
        f"Fig. 11: the range is within 10 % for good {low:g}-{high:g} s after the robot starts to move",
        middle <= high + ROUNDING,
        f"median {middle:.1f} s, {min(found.converged_s):.1f} … {max(found.converged_s):.1f} s over {found.seeds} runs",
    )
    yield judged(
        "Fig. 12: the error of ξ stays within what the filter predicts (0.68 within σ_ξ, 0.95 within 2 σ_ξ)",
        abs(found.within_one - 0.683) <= 0.1 and abs(found.within_two - 0.954) <= 0.05,
        f"{found.within_one:.2f} within σ_ξ, {found.within_two:.2f} within 2 σ_ξ, while moving",
    )
    last = found.table[-1]
    yield judged(
        f"perspective-n-point from the board can tell an error of {100 * last.paper:g} % (a third of it at most)",
        3 * last.reference <= last.paper,
        f"its own RMS error at L = {last.scale:g} is {percent([last.reference])} with the replica's board and corners "
        f"of {found.facts.pixel_sigma:g} px",
    )
    way = next(way for way in found.ways if way.name == PRINTED)
    yield judged(
        "the paper's synchronisation, to the letter, gives Table 3",
        way.last <= 2 * max(TABLE_3.values()) / 100,
        f"error {percent([way.last], '{:.0f}')} at L = {last.scale:g}; {found.ways[0].name}: "
        f"{percent([found.ways[0].last])}",
    )


def _sigmas(found: Robot) -> list[float]:
    return [row.sigma_speed for row in found.implied]


def worst_column(table: Sequence[Robot.Column]) -> Statement:
    """Table 3: the median over the runs no worse than the paper's one run, else within the runs' scatter."""
    upshots = [
        Upshot.REACHED if c.median <= c.paper else Upshot.IN_SCATTER if c.low <= c.paper else Upshot.MISSED
        for c in table
    ]
    texts = [
        f"L {c.scale:g}: {100 * c.median:.2f} % ({100 * c.low:.2f} … {100 * c.high:.2f}), paper {100 * c.paper:g}"
        for c in table
    ]
    return Statement(
        "Table 3: errors over L as the paper's one run has them; median and nine of ten of ours",
        worst(upshots),
        "; ".join(texts),
    )
