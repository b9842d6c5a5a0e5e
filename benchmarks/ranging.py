"""Our range filter beside plain numpy and filterpy's extended Kalman filter, in one process, one thread.

    python benchmarks/ranging.py [--landmarks 1000] [--runs 1000] [--passes 5]

Told is the CPU time of one predict and update of one landmark, of the least disturbed of several passes; every
method takes the same inputs and image points (standard case S0, landmarks spread over the image), and its ranges
are compared with the first row's. Peers:

- numpy, the paper's form: one landmark, Runge-Kutta, the appendix's A and G with their misprints put right, an
  inverse (paper B (21)-(29));
- filterpy: `ExtendedKalmanFilter` with the exact flow, A and G as Python functions; left out where filterpy is
  not installed (pip install filterpy);
- numpy, batched: n landmarks as stacks [n, 3, 3].

Then the Monte Carlo: runs x 30 steps, simulated, filtered and judged by NEES. Bars: 0.1 µs a landmark-update in a
bank of 1000 (the paper: 60 µs), 0.2 s for 1000 runs.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import equations as eq
from pipelines.ranging import filter as range_filter
from pipelines.ranging import joint, montecarlo
from pipelines.ranging.bank import Bank
from pipelines.ranging.filter import Inputs, Landmarks
from pipelines.ranging.montecarlo import Scenario
from pipelines.ranging.settings import FilterSettings, Model
from pipelines.ranging.start import Start

Floats = NDArray[np.float64]

FOCAL, DT, STEPS, R = 800.0, 0.1, 30, 0.25
H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
PAPER_MICROS = 60.0
SLOW_LANDMARKS = 20
"""A method that handles one landmark a call is timed on so many of them."""


class Case(NamedTuple):
    """n landmarks: starts, inputs of each step, image points [m, n, 2]."""

    starts: list[Start]
    inputs: list[Inputs]
    pixel: Floats

    def of(self, count: int) -> Case:
        """The first landmarks of the case."""
        return Case(self.starts[:count], self.inputs, np.ascontiguousarray(self.pixel[:, :count]))


class Row(NamedTuple):
    """One line of the table: name, µs a landmark-update, largest relative difference of ξ at the end."""

    name: str
    micros: float
    difference: float


def made_case(count: int) -> Case:
    """Landmarks over the whole image, S0's speeds and noise."""
    rng = np.random.default_rng(0)
    point = rng.uniform([-2, -1.5, 5], [2, 1.5, 12], (count, 3))
    omega, speed = rng.normal(0, 1e-3 / DT**0.5, STEPS), 0.5 + rng.normal(0, 1e-2 / DT**0.5, STEPS)
    pixels, still = [], eq.held(0.0, 0.5, DT)
    for _ in range(STEPS + 1):
        pixels.append(eq.project(point, FOCAL, (0.0, 0.0))[:, :2] + rng.normal(0, R**0.5, (count, 2)))
        point = eq.carried(point, still)
    starts = [Start(np.array([*z, 1 / 11]), np.diag([10, 10, (3 / 64) ** 2])) for z in pixels[0]]
    return Case(starts, [Inputs(w, v, DT) for w, v in zip(omega, speed, strict=True)], np.array(pixels[1:]))


# ------------------------------------------------------------------------------------ peers


def numpy_paper(case: Case) -> Floats:
    """One landmark after another, as the paper's equations read."""
    q = np.diag([1e-6, 1e-4])
    found = []
    for i, start in enumerate(case.starts):
        x, p = start.state.copy(), start.covariance.copy()
        for inputs, z in zip(case.inputs, case.pixel[:, i], strict=True):
            w, v = inputs.omega, inputs.speed

            def rate(s: Floats, w: float = w, v: float = v) -> Floats:
                return np.array(
                    [
                        -(FOCAL + s[0] ** 2 / FOCAL) * w + v * s[2] * s[0],
                        v * s[2] * s[1] - w * s[0] * s[1] / FOCAL,
                        v * s[2] ** 2 - w * s[2] * s[0] / FOCAL,
                    ]
                )

            across = w * DT * x[0] / FOCAL
            a = np.array(
                [
                    [1 - 2 * across + v * x[2] * DT, 0, v * x[0] * DT],
                    [-w * x[1] * DT / FOCAL, 1 + v * x[2] * DT - across, v * x[1] * DT],
                    [-w * x[2] * DT / FOCAL, 0, 1 + 2 * v * x[2] * DT - across],
                ]
            )
            g = DT * np.array(
                [
                    [FOCAL + x[0] ** 2 / FOCAL, -x[2] * x[0]],
                    [x[0] * x[1] / FOCAL, -x[2] * x[1]],
                    [x[2] * x[0] / FOCAL, -(x[2] ** 2)],
                ]
            )
            k1 = rate(x)
            k2 = rate(x + DT / 2 * k1)
            k3 = rate(x + DT / 2 * k2)
            x = x + DT / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + DT * k3))
            p = a @ p @ a.T + g @ (q / DT) @ g.T
            k = p @ H.T @ np.linalg.inv(H @ p @ H.T + R * np.eye(2))
            x = x + k @ (z - H @ x)
            p = (np.eye(3) - k @ H) @ p
        found.append(x[2])
    return np.array(found)


def exact_matrices(x: Floats, inputs: Inputs) -> tuple[Floats, Floats, Floats]:
    """Flow, A and G of one state as arrays."""
    p, h = eq.Point(x[0], x[1], x[2]), eq.held(*inputs[:3])
    a = eq.exact_transition(p, h, FOCAL)
    full = np.array([[a.xx, 0.0, a.xk], [a.yx, a.yy, a.yk], [a.kx, 0.0, a.kk]])
    return np.array(eq.exact_flow(p, h, FOCAL)), full, np.array(eq.exact_noise_gain(p, h, FOCAL)).reshape(3, 2)


def filterpy_ekf(case: Case) -> Floats:
    """filterpy's filter, its prediction overridden as its documentation asks."""
    from filterpy.kalman import ExtendedKalmanFilter

    class Ranging(ExtendedKalmanFilter):
        def predict_x(self, u: Inputs) -> None:
            self.x, self.F, g = exact_matrices(self.x, u)
            self.Q = g @ (np.diag([1e-6, 1e-4]) / u.dt) @ g.T

    found = []
    for i, start in enumerate(case.starts):
        ekf = Ranging(3, 2)
        ekf.x, ekf.P, ekf.R = start.state.copy(), start.covariance.copy(), R * np.eye(2)
        for inputs, z in zip(case.inputs, case.pixel[:, i], strict=True):
            ekf.predict(inputs)
            ekf.update(z, lambda _: H, lambda x: x[:2])
        found.append(ekf.x[2])
    return np.array(found)


def numpy_batched(case: Case) -> Floats:
    """All landmarks as stacks of matrices."""
    x = np.array([s.state for s in case.starts])
    p = np.array([s.covariance for s in case.starts])
    n = len(x)
    q = np.array([1e-6, 1e-4]) / DT
    for inputs, z in zip(case.inputs, case.pixel, strict=True):
        h = eq.held(*inputs[:3])
        a, g = np.zeros((n, 3, 3)), np.empty((n, 3, 2))
        state = eq.Point(x[:, 0], x[:, 1], x[:, 2])
        t = eq.exact_transition.py_func(state, h, FOCAL)
        a[:, 0, 0], a[:, 0, 2], a[:, 1, 0], a[:, 1, 1] = t.xx, t.xk, t.yx, t.yy
        a[:, 1, 2], a[:, 2, 0], a[:, 2, 2] = t.yk, t.kx, t.kk
        for column, value in enumerate(eq.exact_noise_gain.py_func(state, h, FOCAL)):
            g[:, column // 2, column % 2] = value
        x = np.stack(eq.exact_flow.py_func(state, h, FOCAL), axis=1)
        p = a @ p @ a.transpose(0, 2, 1) + (g * q) @ g.transpose(0, 2, 1)
        k = p[:, :, :2] @ np.linalg.inv(p[:, :2, :2] + R * np.eye(2))
        x = x + (k @ (z - x[:, :2])[..., None])[..., 0]
        p = p - k @ p[:, :2]
    return x[:, 2]


# ------------------------------------------------------------------------------------- ours


def ours_bank(model: Model, case: Case) -> Callable[[], Floats]:
    """The bank; its image points are handed over in the layout that it takes."""
    landmarks, variance = Landmarks.of(case.starts), np.full(len(case.starts), R)
    pixels = [np.ascontiguousarray(z.T) for z in case.pixel]

    def work() -> Floats:
        bank = Bank(model, landmarks)
        for inputs, z in zip(case.inputs, pixels, strict=True):
            bank.advance(inputs, z, variance)
        return bank.state[2]

    return work


def ours_recorded(model: Model, case: Case) -> Callable[[], Floats]:
    """The step with its full record."""
    first = Landmarks.of(case.starts)

    def work() -> Floats:
        landmarks = first
        for inputs, z in zip(case.inputs, case.pixel, strict=True):
            landmarks, _ = range_filter.step(model, landmarks, inputs, z, R)
        return landmarks.state[2]

    return work


def ours_joint(model: Model, case: Case) -> Callable[[], Floats]:
    """The joint filter; its ranges differ, because it knows more."""
    variance = np.full(len(case.starts), R)

    def work() -> Floats:
        state = joint.Joint.of(case.starts)
        for inputs, z in zip(case.inputs, case.pixel, strict=True):
            state, _ = joint.step(model, state, inputs, z, variance)
        return state.mean[:, 2]

    return work


# -------------------------------------------------------------------------------- judgement


def timed(name: str, work: Callable[[], Floats], count: int, passes: int, reference: Floats) -> Row:
    """The least of several passes, after one that compiles."""
    found, taken = work(), []
    for _ in range(passes):
        begin = time.thread_time()
        work()
        taken.append(time.thread_time() - begin)
    off = float(np.max(np.abs(found / reference[:count] - 1)))
    return Row(name, 1e6 * min(taken) / (count * STEPS), off)


def monte_carlo(runs: int, passes: int) -> float:
    """Seconds for simulating, filtering and judging `runs` runs of S0."""
    taken = []
    for _ in range(passes + 1):
        begin = time.thread_time()
        found = montecarlo.run(Scenario(runs=runs))
        found.nees.mean(), found.rms_relative.max()
        taken.append(time.thread_time() - begin)
    return min(taken[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=1000, help="landmarks of the bank")
    parser.add_argument("--runs", type=int, default=1000, help="runs of the Monte Carlo")
    parser.add_argument("--passes", type=int, default=5, help="passes, of which the least counts")
    arguments = parser.parse_args()
    n, passes = arguments.landmarks, arguments.passes
    few = min(SLOW_LANDMARKS, n)
    model = FilterSettings(gate="off", reset_after=0).model(FOCAL)
    gated = FilterSettings().model(FOCAL)
    case = made_case(n)
    reference = ours_bank(model, case)()

    rows = [
        timed(f"bank of {n}", ours_bank(model, case), n, 20 * passes, reference),
        timed(f"bank of {n}, gate and reset", ours_bank(gated, case), n, 20 * passes, reference),
        timed("bank of 1", ours_bank(model, case.of(1)), 1, 20 * passes, reference),
        timed(f"step of {few}, all recorded", ours_recorded(model, case.of(few)), few, passes, reference),
        timed("step of 1, all recorded", ours_recorded(model, case.of(1)), 1, passes, reference),
        timed("joint of 5", ours_joint(model, case.of(5)), 5, passes, reference),
        timed("joint of 20", ours_joint(model, case.of(20)), 20, passes, reference),
        timed(f"numpy batched, {n}", lambda: numpy_batched(case), n, passes, reference),
        timed("numpy, the paper's form", lambda: numpy_paper(case.of(few)), few, passes, reference),
    ]
    if importlib.util.find_spec("filterpy"):
        rows.append(timed("filterpy", lambda: filterpy_ekf(case.of(few)), few, passes, reference))
    else:
        print("filterpy is not installed: pip install filterpy adds its row")
    print(f"{'method':<32}{'µs/update':>12}{'x bank':>10}{'paper / it':>12}{'Δξ/ξ at end':>14}")
    for row in rows:
        ratio, paper = row.micros / rows[0].micros, PAPER_MICROS / row.micros
        print(f"{row.name:<32}{row.micros:>12.3f}{ratio:>10.1f}{paper:>12.1f}{row.difference:>14.1e}")

    runs = arguments.runs
    seconds = monte_carlo(runs, passes)
    slow = next(row for row in rows if row.name.startswith("numpy, the paper"))
    per_run = slow.micros * 1e-6 * STEPS
    print(f"\nMonte Carlo, {runs} runs x {STEPS} steps with NEES: {1e3 * seconds:.1f} ms (bar 200 ms)")
    print(f"numpy, the paper's form, filtering alone at its rate above: {1e3 * per_run * runs:.0f} ms", end="")
    print(f", {per_run * runs / seconds:.0f} x")
    small = Scenario(runs=20)
    begin = time.thread_time()
    montecarlo.run_joint(
        small, [replace(small, landmark_m=(x, 0.4, 8.0)).landmark_m for x in (-0.8, -0.4, 0.4, 0.8, 1.2)]
    )
    print(f"joint Monte Carlo, 5 landmarks: {1e3 * (time.thread_time() - begin) / 20:.2f} ms a run")


if __name__ == "__main__":
    main()
