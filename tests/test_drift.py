"""The drift budget: exact sums, planted errors that rank first, gaps, slow references, and real replays."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import CorrelationSettings
from pipelines.drift import DriftBudget, derived_headings, drift_budget
from pipelines.evaluation import EvaluationError, Trajectory, evaluate, motions
from pipelines.replay import replay
from workbench import scenarios

Floats = NDArray[np.float64]
SECOND = 1_000_000_000


def chain(increments: Floats, start: tuple[float, float, float] = (0, 0, 0)) -> Floats:
    """Poses [n + 1, 3] from increments [n, 3] in the axes of the body, as complex numbers."""
    heading = start[2] + np.concatenate([[0], np.cumsum(increments[:, 2])])
    steps = (increments[:, 0] + 1j * increments[:, 1]) * np.exp(1j * heading[:-1])
    place = start[0] + 1j * start[1] + np.concatenate([[0], np.cumsum(steps)])
    return np.column_stack([place.real, place.imag, heading])


def drive(seed: int, n: int = 300) -> Floats:
    """Increments of a wandering drive."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 0.2, n), rng.normal(0, 0.01, n), rng.normal(0, 0.05, n)])


def paths(truth: Floats, wrong: Floats) -> tuple[Trajectory, Trajectory]:
    """An estimate that starts elsewhere, and its reference, from their increments."""
    t = np.arange(len(truth) + 1) * SECOND // 10
    return Trajectory.of(t, chain(wrong, (5, -3, 2))), Trajectory.of(t, chain(truth, (1, 2, -0.7)))


def end_vector(budget: DriftBudget) -> Floats:
    return budget.start_m + budget.contribution_m.sum(axis=0)


# --------------------------------------------------------------------------------- exact sums


@pytest.mark.parametrize("seed", range(6))
def test_contributions_sum_to_the_end_error_of_random_chains(seed: int) -> None:
    truth = drive(seed)
    wrong = truth + np.random.default_rng(seed).normal(0, 1, truth.shape) * [0.02, 0.02, 0.05]
    estimate, reference = paths(truth, wrong)
    budget = drift_budget(estimate, reference)
    error = evaluate(estimate, reference).end_error_m
    assert math.hypot(*budget.end_error_m) == pytest.approx(error, abs=1e-9)
    assert error > 0.5
    np.testing.assert_allclose(end_vector(budget), budget.end_error_m, atol=1e-9)
    assert budget.residual_m < 1e-9
    assert budget.harm_m.sum() == pytest.approx(error, abs=1e-9)
    np.testing.assert_allclose(budget.shift_harm_m + budget.heading_harm_m, budget.harm_m, atol=1e-12)
    np.testing.assert_allclose(budget.start_m, 0, atol=1e-9)
    assert budget.size_m.sum() > error


@pytest.mark.parametrize("k", [0, 1, 150, 299])
def test_a_contribution_is_the_end_of_the_mixed_chain_less_that_of_the_one_before(k: int) -> None:
    truth = drive(1)
    wrong = truth + np.random.default_rng(9).normal(0, 0.03, truth.shape)
    start = (1.0, 2.0, -0.7)
    with_k = chain(np.concatenate([wrong[: k + 1], truth[k + 1 :]]), start)[-1, :2]
    without = chain(np.concatenate([wrong[:k], truth[k:]]), start)[-1, :2]
    shift_only = wrong[k] * [1, 1, 0] + truth[k] * [0, 0, 1]
    moved = chain(np.concatenate([wrong[:k], shift_only[None], truth[k + 1 :]]), start)[-1, :2]
    budget = drift_budget(*paths(truth, wrong))
    np.testing.assert_allclose(budget.contribution_m[k], with_k - without, atol=1e-9)
    np.testing.assert_allclose(budget.shift_m[k], moved - without, atol=1e-9)
    np.testing.assert_allclose(budget.heading_m[k], with_k - moved, atol=1e-9)
    np.testing.assert_allclose(budget.increment_error[k], wrong[k] - truth[k], atol=1e-9)


def test_a_scale_is_taken_out_first() -> None:
    truth = drive(2)
    estimate, reference = paths(truth, truth * [50, 50, 1])
    assert math.hypot(*drift_budget(estimate, reference, with_scale=True).end_error_m) < 1e-9
    bad = truth.copy()
    bad[40, 2] += 0.3
    estimate, reference = paths(truth, bad * [50, 50, 1])
    budget = drift_budget(estimate, reference, with_scale=True)
    expected = evaluate(estimate, reference, with_scale=True).end_error_m
    assert budget.harm_m.sum() == pytest.approx(expected, abs=1e-9)
    assert budget.ranked()[0] == 40


def test_a_perfect_path_has_nothing_to_share_out() -> None:
    budget = drift_budget(*paths(drive(0), drive(0)))
    assert budget.size_m.max() < 1e-9
    reference = paths(drive(0), drive(0))[1]
    exact = drift_budget(reference, reference)
    assert exact.harm_m.max() == 0
    assert exact.ape_m.max() < 1e-9


# ------------------------------------------------------------------------------- planted errors


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("axis", "size"), [(0, 0.4), (1, -0.4), (2, 0.15)])
def test_a_planted_error_ranks_first(seed: int, axis: int, size: float) -> None:
    truth = drive(seed)
    noise = np.random.default_rng(seed).normal(0, 1, truth.shape) * [0.001, 0.001, 0.0002]
    k = 30 + 7 * seed
    wrong = truth + noise
    wrong[k, axis] += size
    budget = drift_budget(*paths(truth, wrong))
    assert budget.index[budget.ranked()[0]] == k + 1
    assert budget.index[budget.ranked("size")[0]] == k + 1
    assert budget.increment_error[k, axis] == pytest.approx(size, abs=0.01)
    own, other = (budget.heading_harm_m, budget.shift_harm_m)[:: 1 if axis == 2 else -1]
    assert own[k] > 0.8 * budget.harm_m.sum()
    assert abs(other[k]) < 0.05 * own[k]


def test_an_early_turn_harms_as_far_as_the_way_to_the_end() -> None:
    truth = np.tile([0.1, 0.0, 0.0], (200, 1))
    for k, way in ((10, 18.9), (150, 4.9)):
        wrong = truth.copy()
        wrong[k, 2] += 0.1
        budget = drift_budget(*paths(truth, wrong))
        assert budget.heading_harm_m[k] == pytest.approx(2 * math.sin(0.05) * way, rel=1e-9)
        assert abs(budget.shift_harm_m).max() < 1e-9


def test_an_error_that_is_taken_back_has_negative_harm() -> None:
    truth = np.tile([0.1, 0.0, 0.0], (100, 1))
    wrong = truth.copy()
    wrong[20, 0] += 0.5
    wrong[60, 0] -= 0.2
    budget = drift_budget(*paths(truth, wrong))
    assert budget.harm_m[[20, 60]] == pytest.approx([0.5, -0.2])
    assert budget.ranked()[[0, -1]].tolist() == [20, 60]
    assert budget.ranked("size")[:2].tolist() == [20, 60]


# -------------------------------------------------------------------------- absolute error


def test_shares_of_the_aligned_error_sum_to_it_and_name_the_frame() -> None:
    truth = drive(3)
    wrong = truth + np.random.default_rng(3).normal(0, 1, truth.shape) * [0.001, 0.001, 0.0002]
    wrong[150, 1] += 0.5
    estimate, reference = paths(truth, wrong)
    budget = drift_budget(estimate, reference)
    assert budget.ape_rmse_m == pytest.approx(evaluate(estimate, reference).ape_m.rmse)
    assert budget.ape_m.sum() + budget.ape_alignment_m == pytest.approx(budget.ape_rmse_m)
    assert abs(budget.ape_alignment_m) < 0.01 * budget.ape_rmse_m
    assert np.argmax(budget.ape_m) == 150
    assert budget.ape_m[150] > 0.9 * budget.ape_rmse_m


def test_shares_are_those_of_the_contributions_carried_to_every_pose() -> None:
    truth = drive(4, 40)
    wrong = truth + np.random.default_rng(5).normal(0, 0.02, truth.shape)
    estimate, reference = paths(truth, wrong)
    alignment = evaluate(estimate, reference).alignment
    aligned = alignment(estimate.pose)[:, :2] - reference.pose[:, :2]
    shares = np.zeros(40)
    for j in range(2, 41):
        part = drift_budget(*(Trajectory(p.t_ns[: j + 1], p.pose[: j + 1]) for p in (estimate, reference)))
        shares[:j] += part.contribution_m @ aligned[j]
    one = drift_budget(*paths(truth[:1], wrong[:1])).contribution_m[0]
    shares[0] += one @ aligned[1]
    budget = drift_budget(estimate, reference)
    np.testing.assert_allclose(budget.ape_m, shares / 41 / budget.ape_rmse_m, atol=1e-9)


# ------------------------------------------------------------- references with less in them


def test_a_gap_of_the_reference_is_one_contribution() -> None:
    truth = drive(5)
    wrong = truth.copy()
    wrong[120, 0] += 1.0
    estimate, reference = paths(truth, wrong)
    seen = np.r_[5:100, 140:295]
    gappy = Trajectory(reference.t_ns[seen], reference.pose[seen])
    budget = drift_budget(estimate, gappy)
    worst = budget.ranked()[0]
    assert (budget.since[worst], budget.index[worst], budget.frames[worst]) == (99, 140, 41)
    assert (budget.frames == 1).sum() == len(budget.frames) - 1
    assert budget.unjudged == (5, 6)
    assert budget.residual_m < 1e-9
    assert budget.harm_m[worst] == pytest.approx(1.0, abs=0.02)


def test_a_slow_reference_is_interpolated_and_the_sum_stays_exact() -> None:
    truth = drive(6) * [1, 0.2, 0.3]
    wrong = truth.copy()
    wrong[83, 2] += 0.2
    estimate, reference = paths(truth, wrong)
    slow = Trajectory(reference.t_ns[::10], reference.pose[::10])
    budget = drift_budget(estimate, slow)
    assert len(budget.index) == 300
    assert budget.residual_m < 1e-9
    assert budget.index[budget.ranked()[0]] == 84
    blocks = budget.over(10)
    np.testing.assert_allclose(blocks.contribution_m.sum(axis=0), budget.contribution_m.sum(axis=0), atol=1e-12)
    assert (blocks.since[8], blocks.index[8], blocks.ranked()[0]) == (80, 90, 8)
    with pytest.raises(ValueError, match="frames"):
        budget.over(0)


def test_a_reference_without_headings_still_finds_the_turn() -> None:
    truth = np.tile([0.1, 0.0, 0.004], (400, 1))
    wrong = truth + np.random.default_rng(0).normal(0, 1, truth.shape) * [0.0005, 0.0005, 0.0002]
    wrong[150, 2] += 0.3
    estimate, reference = paths(truth, wrong)
    blind = Trajectory.of(reference.t_ns, reference.pose[:, :2])
    budget = drift_budget(estimate, blind, baseline_m=1.0)
    assert (budget.headings, drift_budget(estimate, reference).headings) == ("derived", "reference")
    assert budget.residual_m < 1e-9
    assert math.hypot(*budget.end_error_m) == pytest.approx(evaluate(estimate, blind).end_error_m, abs=1e-9)
    # the turn is found to the baseline of 10 frames: what the blocks around it hold is nearly all the heading's harm
    blocks = budget.over(20)
    around = np.flatnonzero((blocks.since <= 165) & (blocks.index >= 135))
    inside = np.hypot(*blocks.heading_m[around].sum(axis=0))
    full = np.hypot(*drift_budget(estimate, reference).heading_m[150])
    assert inside == pytest.approx(full, rel=0.1)


def test_derived_headings_are_those_of_a_smooth_path_and_hold_while_it_stands() -> None:
    truth = np.tile([0.1, 0.0, 0.01], (200, 1))
    truth[100:120] = 0
    reference = chain(truth, (0, 0, 0.4))
    estimate = chain(truth + np.array([0, 0, 0.001]), (0, 0, 0.4))
    derived = derived_headings(estimate, reference * [1, 1, np.nan], 1.0)
    turn = np.angle(np.exp(1j * (derived[:, 2] - reference[:, 2])))
    assert np.abs(turn).max() < 0.02
    still = derived_headings(estimate[100:110], reference[100:110], 1.0)
    np.testing.assert_allclose(still[:, 2], np.angle(np.exp(1j * estimate[100:110, 2])), atol=1e-12)


def test_what_cannot_be_shared_out_is_refused() -> None:
    estimate, reference = paths(drive(0), drive(0))
    with pytest.raises(ValueError, match="heading of every pose"):
        drift_budget(Trajectory.of(estimate.t_ns, estimate.pose[:, :2]), reference)
    with pytest.raises(EvaluationError, match="poses have a reference"):
        drift_budget(estimate, Trajectory(reference.t_ns[:50], reference.pose[:50]))


# ------------------------------------------------------------------------------- real replays


def odometry_of(name: str, *overrides: str, **settings: Any) -> tuple[Trajectory, Trajectory]:
    """The path of the correlation odometry over a scenario, and the truth."""
    small = ("ground.size_px=512", "camera.width_px=160", "camera.height_px=120", "camera.focal_px=100")
    mission = scenarios.mission(scenarios.load(name, overrides=[*small, "frames=90", *overrides]))
    chosen = CorrelationSettings.preset("best").model_dump() | {
        "metres_per_px": mission.metres_per_px,
        "start_pose": tuple(mission.truth_poses[0]),
        **settings,
    }
    odometry = CorrelationOdometry(CorrelationSettings.model_validate(chosen))
    steps = [r.step for r in replay(mission, odometry, image_stream="/camera/image_raw")]
    estimate = Trajectory.of([s.t_ns for s in steps], np.array([s.pose for s in steps]))  # type: ignore[attr-defined]
    return estimate, Trajectory.of(mission.truth_t_ns, mission.truth_poses)


@pytest.mark.parametrize("name", ["figure-eight", "fault-shift-jump", "fault-dropped-frames", "s-curve"])
def test_the_budget_of_a_scenario_sums_to_its_end_error(name: str) -> None:
    fault = name.removeprefix("fault-")
    faults = () if fault == name else (f"faults=[{{kind='{fault}',start_s=0.5,stop_s=0.7}}]",)
    estimate, truth = odometry_of(name, *faults)
    budget = drift_budget(estimate, truth)
    error = evaluate(estimate, truth).end_error_m
    assert error > 0
    assert abs(budget.harm_m.sum() - error) < 0.01 * error
    assert np.hypot(*(end_vector(budget) - budget.end_error_m)) < 1e-9
    rows = np.arange(len(estimate))
    steps = motions(estimate.pose, rows[:-1], rows[1:])
    for axis, size in ((0, 0.03), (2, 0.1)):  # an error of one frame, planted into what the estimator found
        planted = steps.copy()
        planted[19, axis] += size
        start = (float(estimate.pose[0, 0]), float(estimate.pose[0, 1]), float(estimate.pose[0, 2]))
        found = drift_budget(Trajectory(estimate.t_ns, chain(planted, start)), truth)
        assert found.index[found.ranked()[0]] == 20
        assert abs(found.harm_m.sum() - np.hypot(*found.end_error_m)) < 1e-9


def test_the_code_on_the_page_of_evaluation_runs(capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(__file__).parents[1] / "docs" / "evaluation.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    exec(compile(block, "evaluation.md", "exec"), {})
    assert capsys.readouterr().out == "frame 31: 0.350 m of 0.350 m\n"
