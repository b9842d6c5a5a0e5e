"""The paper's simulation (section 4), part by part: Tables 1 and 2, Figs 6-8, scaling, consistency, what beats it.

Every part is a function of the number of runs; it calls `tick` for every scenario that it has run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.consistency import band
from pipelines.ranging import montecarlo as mc
from pipelines.ranging.inputs import Synchronisation
from pipelines.ranging.montecarlo import Runs, Scenario, cramer_rao, run
from workbench.reproduce.ranging.parts import Curve, Part
from workbench.reproduce.tasks import Tick

Floats = NDArray[np.float64]

TABLE_2_PIXELS = (mc.TABLE_2_PIXEL_SIGMA, 0.1, 0.5)
CURVE_PIXELS = (0.02, 0.1, 0.5)
OFFSETS_M = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
SPEEDS_MPS = (0.1, 0.3, 0.5, 0.8)
START_ERRORS_M = (1.0, 2.0, 3.0, 4.0)
"""The last is half of the range: the largest error of a triangulated start, says the paper."""
SETTLED_S = 2.0
"""From here on the filter is asked to be consistent."""
FIVE = ((0.8, 0.0, 8.0), (0.4, 0.4, 8.0), (-0.8, 0.8, 10.0), (-1.2, -0.6, 7.0), (0.3, -0.9, 12.0))
"""Landmarks of the joint filter; the first one lies where gyro noise eats the parallax of a filter of its own."""
PAIR = ((0.4, 0.4, 8.0), (-0.8, 0.8, 10.0))
"""Landmarks whose filters' errors are correlated, each filter by itself."""
MOST_JOINT = 1000
"""Runs of the joint filter and of the smoother, which are dearer than the filter."""


def curve(values: Iterable[float]) -> Curve:
    """Plain numbers."""
    return tuple(float(value) for value in values)


# --------------------------------------------------------------------------------- Table 2


class Accuracy(Part):
    """RMS of the relative error over time, by reading of (30) and pixel noise: Table 2, Fig. 8."""

    class Row(Part):
        """One reading at one pixel noise; `nees` is the mean after `SETTLED_S`."""

        reading: Literal["as-printed", "exact"]
        pixel_sigma: float
        rms: Curve
        bound: Curve
        nees: float
        converged_s: float

    time_s: Curve
    scale: Curve
    rows: tuple[Row, ...]


def accuracy(runs: int, tick: Tick) -> Accuracy:
    """Table 2 in both readings, at several noises of the image points."""
    rows = []
    scale: Floats = np.empty(0)
    readings: tuple[Literal["as-printed", "exact"], ...] = ("as-printed", "exact")
    for reading in readings:
        for r in TABLE_2_PIXELS:
            scenario = Scenario(pixel_sigma=r, steps=50, truth=reading, runs=runs)
            scale, found = mc.figure_8(scenario)
            rows.append(
                Accuracy.Row(
                    reading=reading,
                    pixel_sigma=r,
                    rms=curve(found.rms_relative),
                    bound=curve(cramer_rao(scenario)),
                    nees=float(found.nees[:, found.at(SETTLED_S) :].mean()),
                    converged_s=found.converged_s,
                )
            )
            tick()
    return Accuracy(time_s=curve(found.time_s), scale=curve(scale), rows=tuple(rows))


# ----------------------------------------------------------------------------- Figs 6 and 7


class Convergence(Part):
    """Mean range error over time by distance off the axis (Fig. 6), speed (Fig. 7) and error of the start."""

    class Row(Part):
        """One curve: what was varied, its value, the pixel noise."""

        varied: Literal["offset", "speed", "start", "axis"]
        value: float
        pixel_sigma: float
        error_m: Curve
        converged_s: float

    time_s: Curve
    rows: tuple[Row, ...]

    def of(self, varied: str, pixel_sigma: float) -> list[Row]:
        """The curves of one kind at one pixel noise."""
        return [row for row in self.rows if row.varied == varied and row.pixel_sigma == pixel_sigma]


def convergence(runs: int, tick: Tick) -> Convergence:
    """Figs 6, 7, the same by error of the start, and landmarks 0.8 m off the axis to the side and upwards."""
    base = Scenario(runs=runs)
    z = base.landmark_m[2]
    varied: dict[str, Mapping[float, dict[str, Any]]] = {
        "offset": {d: {"landmark_m": (d, d, z)} for d in OFFSETS_M},
        "speed": {v: {"speed": v} for v in SPEEDS_MPS},
        "start": {e: {"start_range_m": z + e, "start_sigma_xi": e / z**2} for e in START_ERRORS_M},
        "axis": {0.0: {"landmark_m": (0.8, 0.0, z)}, 90.0: {"landmark_m": (0.0, 0.8, z)}},
    }
    rows = []
    for r in CURVE_PIXELS:
        for name, cases in varied.items():
            for value, changes in cases.items():
                found = run(replace(base, pixel_sigma=r, **changes))
                rows.append(
                    Convergence.Row.model_validate(
                        {
                            "varied": name,
                            "value": value,
                            "pixel_sigma": r,
                            "error_m": curve(found.mean_abs_error_m),
                            "converged_s": found.converged_s,
                        }
                    )
                )
                tick()
    return Convergence(time_s=curve(base.time_s), rows=tuple(rows))


# --------------------------------------------------------------------------------- scaling


class Scaling(Part):
    """Greatest change of any relative error in any run under both laws, and what fixed noise makes of them."""

    class Row(Part):
        """RMS relative error at the same L, with the same spectral densities and frame rate."""

        speed_mps: float
        pixel_sigma: float
        rms: float

    space: float
    space_factor: float
    time: float
    time_factor: float
    scale: float
    rows: tuple[Row, ...]


SCALE_SPEEDS_MPS = (0.25, 0.5, 1.0)
SPACE_FACTOR, TIME_FACTOR = 25.0, 3.0


def scaling(runs: int, tick: Tick) -> Scaling:
    """Both exact laws, and the same L at several speeds with the noise left as it is."""
    base = Scenario(runs=min(runs, 300), omega=0.05)
    reference = run(base).relative_error
    space = run(mc.scaled_in_space(base, SPACE_FACTOR)).relative_error
    tick()
    pace = run(mc.scaled_in_time(base, TIME_FACTOR)).relative_error
    tick()
    way, rows = 1.5, []
    for r in (mc.TABLE_2_PIXEL_SIGMA, 0.5):
        for speed in SCALE_SPEEDS_MPS:
            scenario = Scenario(speed=speed, steps=round(way / speed / 0.1), pixel_sigma=r, runs=runs)
            rows.append(Scaling.Row(speed_mps=speed, pixel_sigma=r, rms=float(run(scenario).rms_relative[-1])))
            tick()
    return Scaling(
        space=float(np.abs(space - reference).max()),
        space_factor=SPACE_FACTOR,
        time=float(np.abs(pace - reference).max()),
        time_factor=TIME_FACTOR,
        scale=way / math.hypot(*base.landmark_m),
        rows=tuple(rows),
    )


# ----------------------------------------------------------------------------- consistency


class Consistency(Part):
    """The standard case: errors, bound and the bands in which a consistent filter's means lie."""

    class Row(Part):
        """One pixel noise. `nis_mean` is over frames 5 on, `above` its share above 5.99 (0.05 of χ²)."""

        pixel_sigma: float
        error_m: Curve
        ratio: Curve
        nees: Curve
        nis: Curve
        coverage: Curve
        nis_mean: float
        above: float
        diverged: float

    runs: int
    time_s: Curve
    nees_band: tuple[float, float]
    nis_band: tuple[float, float]
    rows: tuple[Row, ...]


CONSISTENCY_PIXELS = (0.1, 0.5)


def consistency(runs: int, tick: Tick) -> Consistency:
    """S0 at two pixel noises."""
    rows = []
    for r in CONSISTENCY_PIXELS:
        scenario = Scenario(pixel_sigma=r, steps=50, runs=runs)
        found = run(scenario)
        later = found.nis[:, 5:]
        rows.append(
            Consistency.Row(
                pixel_sigma=r,
                error_m=curve(found.mean_abs_error_m),
                ratio=curve(found.rms_relative / cramer_rao(scenario)),
                nees=curve(found.nees.mean(axis=0)),
                nis=curve(found.nis.mean(axis=0)),
                coverage=curve(found.coverage),
                nis_mean=float(later.mean()),
                above=float(np.mean(later > 5.99)),
                diverged=found.diverged,
            )
        )
        tick()
    return Consistency(
        runs=runs,
        time_s=curve(found.time_s),
        nees_band=band(3, runs),
        nis_band=band(2, runs),
        rows=tuple(rows),
    )


# -------------------------------------------------------------------------- what beats it


class Better(Part):
    """What beats the paper's filter, each beside the filter itself."""

    class Joint(Part):
        """Landmark [0.8 0 8] at 3 s: alone, with four others; log-depth correlation of independent filters."""

        pixel_sigma: float
        alone: float
        joint: float
        nees: float
        correlation: float

    class Slow(Part):
        """One method at 0.1 m/s after 25 s."""

        method: Literal["EKF", "lag-1", "MAP"]
        rms: float
        bias: float
        nees: float

    class Blunders(Part):
        """Medians of the relative error at the end: blunders at 3 s, a slip to another point at 4 s."""

        pixel_sigma: float
        clean: float
        gated: float
        bare: float
        gated_diverged: float
        bare_diverged: float
        slip_reset: float
        slip_gate: float
        slip_bare: float

    runs: int
    joint: tuple[Joint, ...]
    slow: tuple[Slow, ...]
    slow_bound: float
    blunders: tuple[Blunders, ...]


GATED: Mapping[str, Any] = {"gate": 13.8, "reset_after": 3}
BLUNDER_SHARE = 0.05


def better(runs: int, tick: Tick) -> Better:
    """Joint filter, lag-1 relinearisation and smoother, gate with reset."""
    fewer = min(runs, MOST_JOINT)
    joint = []
    for r in CONSISTENCY_PIXELS:
        joint.append(_joint(Scenario(pixel_sigma=r, runs=fewer)))
        tick()
    low = Scenario(speed=0.1, pixel_sigma=0.02, steps=250, runs=fewer)
    slow = []
    methods: dict[Literal["EKF", "lag-1", "MAP"], Callable[[], Runs]] = {
        "EKF": lambda: run(low),
        "lag-1": lambda: run(low, low.settings(relinearisations=3)),
        "MAP": lambda: mc.run_smoother(low),
    }
    for name, method in methods.items():
        found = method()
        slow.append(
            Better.Slow(
                method=name,
                rms=float(found.rms_relative[-1]),
                bias=float(found.relative_error[:, -1].mean()),
                nees=float(found.nees[:, -1].mean()),
            )
        )
        tick()
    blunders = []
    for r in CONSISTENCY_PIXELS:
        blunders.append(_blunders(Scenario(pixel_sigma=r, runs=runs)))
        tick()
    return Better(
        runs=fewer,
        joint=tuple(joint),
        slow=tuple(slow),
        slow_bound=float(cramer_rao(low)[-1]),
        blunders=tuple(blunders),
    )


def _joint(scenario: Scenario) -> Better.Joint:
    together = mc.run_joint(scenario, FIVE)
    alone = run(mc.joint_scenarios(scenario, FIVE)[0])
    pair = [run(s, landmark=i).mean[:, -1, 2] for i, s in enumerate(mc.joint_scenarios(scenario, PAIR))]
    return Better.Joint(
        pixel_sigma=scenario.pixel_sigma,
        alone=float(alone.rms_relative[-1]),
        joint=float(together.rms_relative[-1, 0]),
        nees=float(together.nees[:, alone.at(SETTLED_S) :].mean()),
        correlation=float(np.corrcoef(np.log(pair))[0, 1]),
    )


def _blunders(clean: Scenario) -> Better.Blunders:
    hit = replace(clean, blunder_share=BLUNDER_SHARE)
    slip = replace(clean, steps=40, slip_s=1.5)
    gated, bare = run(hit, hit.settings(**GATED)), run(hit)
    return Better.Blunders(
        pixel_sigma=clean.pixel_sigma,
        clean=median(run(clean)),
        gated=median(gated),
        bare=median(bare),
        gated_diverged=gated.diverged,
        bare_diverged=bare.diverged,
        slip_reset=median(run(slip, slip.settings(**GATED))),
        slip_gate=median(run(slip, slip.settings(gate=GATED["gate"]))),
        slip_bare=median(run(slip)),
    )


def median(runs: Runs) -> float:
    """Median of the last |relative error| over the runs; a lost landmark is infinitely far off."""
    off = np.abs(runs.relative_error[:, -1])
    return float(np.median(np.where(np.isnan(off), np.inf, off)))


# ------------------------------------------------------------------------------- misprints


class Misprints(Part):
    """What each formula of the text, taken to the letter, does at 3 s against the right one."""

    class Row(Part):
        """`rms` and `sigma` are factors over the right form, `bias` is the mean relative error."""

        name: str
        setting: str
        case: str
        rms: float
        sigma: float
        bias: float
        nees: float
        nis: float

    rows: tuple[Row, ...]

    def row(self, name: str) -> Row:
        """The row of that name."""
        return next(row for row in self.rows if row.name == name)


NO_DT, EULER_TURN, A_MISPRINT = "G without dt", "(21) frozen: Euler, ω = 0.1", "A[0,0] = V ξ dt / f"


def misprints(runs: int, tick: Tick) -> Misprints:
    """Every formula that the paper prints in another way than it must have meant."""
    fine = Scenario(pixel_sigma=0.1, runs=runs)
    coarse = replace(fine, pixel_sigma=0.5)
    centred = replace(coarse, centre_px=(640.0, 480.0))
    turning = replace(fine, omega=0.1)
    cases: Sequence[tuple[str, str, Scenario, dict[str, Any]]] = (
        ("right", "exact flow, A and G", fine, {}),
        (A_MISPRINT, "transition = as-printed", fine, {"transition": "as-printed"}),
        (NO_DT, "noise_gain = without-dt", fine, {"noise_gain": "without-dt"}),
        ("G without dt, r 0.5", "noise_gain = without-dt", coarse, {"noise_gain": "without-dt"}),
        ("G[0,0] with (x + c_x)²", "noise_gain = plus-centre", centred, {"noise_gain": "plus-centre"}),
        ("(21) frozen: Euler, ω = 0", "flow = euler", fine, {"flow": "euler"}),
        (EULER_TURN, "flow = euler", turning, {"flow": "euler"}),
        ("RK4, ω = 0.1 (no misprint)", "flow = rk4", turning, {"flow": "rk4"}),
        (
            "the appendix to the letter",
            "transition, noise_gain = as-printed, flow = rk4",
            centred,
            {"transition": "as-printed", "noise_gain": "as-printed", "flow": "rk4"},
        ),
    )
    rows = []
    for name, setting, scenario, forms in cases:
        right, found = run(scenario), run(scenario, scenario.settings(**forms))
        sigma = np.sqrt(found.covariance[:, -1, 2, 2] / right.covariance[:, -1, 2, 2])
        omega = np.ravel(scenario.omega)[0]
        rows.append(
            Misprints.Row(
                name=name,
                setting=setting,
                case=f"r {scenario.pixel_sigma:g}, c {scenario.centre_px[0]:g}, ω {omega:g}",
                rms=float(found.rms_relative[-1] / right.rms_relative[-1]),
                sigma=float(np.median(sigma)),
                bias=float(found.relative_error[:, -1].mean()),
                nees=float(found.nees[:, -1].mean()),
                nis=float(found.nis[:, 5:].mean()),
            )
        )
        tick()
    return Misprints(rows=tuple(rows))


# ---------------------------------------------------------------------------- asynchronous


class Asynchronous(Part):
    """Sensors of different rates: IMU 50, odometer 20, camera 5 Hz; relative errors at `TIMES_S`."""

    class Row(Part):
        """One way to take the speeds between two messages, at one pixel noise."""

        how: str
        pixel_sigma: float
        rms: tuple[float, float]
        bias: tuple[float, float]
        nees: float

    rows: tuple[Row, ...]

    def row(self, how: Synchronisation, pixel_sigma: float) -> Row:
        """The row of that way and noise."""
        return next(row for row in self.rows if (row.how, row.pixel_sigma) == (how.value, pixel_sigma))


TIMES_S = (5.0, 12.0)


def asynchronous(runs: int, tick: Tick) -> Asynchronous:
    """Every way to synchronise, at two pixel noises."""
    rows = []
    for r in CONSISTENCY_PIXELS:
        scenario = mc.Asynchronous(base=Scenario(pixel_sigma=r, runs=min(runs, MOST_JOINT)))
        for how in Synchronisation:
            found = mc.run_asynchronous(scenario, how)
            first, last = (found.at(t) for t in TIMES_S)
            bias = found.relative_error.mean(axis=0)
            rms = found.rms_relative
            rows.append(
                Asynchronous.Row(
                    how=how.value,
                    pixel_sigma=r,
                    rms=(float(rms[first]), float(rms[last])),
                    bias=(float(bias[first]), float(bias[last])),
                    nees=float(found.nees[:, -1].mean()),
                )
            )
            tick()
    return Asynchronous(rows=tuple(rows))
