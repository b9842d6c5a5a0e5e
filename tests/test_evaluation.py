"""Association, alignment and errors of a path: by hand, by properties, and against evo as an oracle."""

import copy
import math

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray

from pipelines.consistency import Consistency
from pipelines.evaluation import (
    EvaluationError,
    Trajectory,
    align,
    associate,
    evaluate,
    path_lengths,
    pose_nees,
    relative_error,
    round_down,
)
from pipelines.geometry import local_enu, quat_of_heading, wrap_angle, wrap_angles
from readers.streams import UNKNOWN_COV6, UNKNOWN_QUAT, PoseSample, array

Floats = NDArray[np.float64]
SECOND = 1_000_000_000


def random_pair(seed: int, n: int = 200) -> tuple[Trajectory, Trajectory]:
    """A wandering reference and a turned, shifted, noisy and drifting estimate of it."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.integers(5_000_000, 40_000_000, n)) + 1_700_000_000 * SECOND
    heading = np.cumsum(rng.normal(0, 0.05, n)) + rng.uniform(-3, 3)
    step = rng.uniform(0.0, 0.2, n)
    xy = np.cumsum(step[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    noisy = xy @ np.array([[c, s], [-s, c]]) + rng.uniform(-50, 50, 2) + np.cumsum(rng.normal(0, 0.01, (n, 2)), axis=0)
    return (
        Trajectory.of(t, np.column_stack([noisy, heading + turn + np.cumsum(rng.normal(0, 0.002, n))])),
        Trajectory.of(t, np.column_stack([xy, heading])),
    )


def as_evo(path: Trajectory) -> PoseTrajectory3D:
    quats = np.array([quat_of_heading(h) for h in path.pose[:, 2]])
    return PoseTrajectory3D(
        positions_xyz=np.column_stack([path.pose[:, :2], np.zeros(len(path))]),
        orientations_quat_wxyz=quats[:, [3, 0, 1, 2]],
        timestamps=path.t_ns / 1e9,
    )


def evo_statistics(metric: metrics.PE) -> dict[str, float]:
    return {name.value: value for name, value in ((s, metric.get_statistic(s)) for s in metrics.StatisticsType)}


# ---------------------------------------------------------------------------- the oracle


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("with_scale", [False, True])
def test_ape_agrees_with_evo(seed: int, with_scale: bool) -> None:
    estimate, reference = random_pair(seed)
    ours = evaluate(estimate, reference, with_scale=with_scale)
    theirs_reference, theirs = as_evo(reference), copy.deepcopy(as_evo(estimate))
    theirs.align(theirs_reference, correct_scale=with_scale)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((theirs_reference, theirs))
    expected = evo_statistics(ape)
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours.ape_m, name) == pytest.approx(expected[name], abs=1e-9, rel=1e-9)
    turn = metrics.APE(metrics.PoseRelation.rotation_angle_rad)
    turn.process_data((theirs_reference, theirs))
    assert ours.ape_heading_rad.max == pytest.approx(evo_statistics(turn)["max"], abs=1e-7)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("frames", [1, 7])
def test_rpe_agrees_with_evo(seed: int, frames: int) -> None:
    estimate, reference = random_pair(seed)
    ours = relative_error(estimate.pose, reference.pose, np.arange(len(estimate), dtype=float), frames, "frames")
    assert (ours.compared, ours.unit, ours.translation_m.count) == ("pose", "frames", len(estimate) - frames)
    for relation, got in (
        (metrics.PoseRelation.translation_part, ours.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, ours.heading_rad),
    ):
        rpe = metrics.RPE(relation, delta=frames, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((as_evo(reference), as_evo(estimate)))
        expected = evo_statistics(rpe)
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(got, name) == pytest.approx(expected[name], abs=1e-7)


def test_rpe_of_positions_agrees_with_evo() -> None:
    estimate, reference = random_pair(3)
    blind = Trajectory.of(reference.t_ns, reference.pose[:, :2])
    ours = relative_error(estimate.pose, blind.pose, np.arange(len(blind), dtype=float), 5, "frames")
    rpe = metrics.RPE(metrics.PoseRelation.point_distance, delta=5, delta_unit=metrics.Unit.frames, all_pairs=True)
    rpe.process_data((as_evo(reference), as_evo(estimate)))
    assert ours.compared == "distance"
    assert ours.translation_m.rmse == pytest.approx(evo_statistics(rpe)["rmse"], abs=1e-9)
    assert math.isnan(ours.heading_rad.rmse)


def test_nearest_association_agrees_with_evo() -> None:
    estimate, reference = random_pair(5)
    rng = np.random.default_rng(1)
    shifted = Trajectory(np.sort(reference.t_ns + rng.integers(-3_000_000, 3_000_000, len(reference))), reference.pose)
    at = associate(estimate.t_ns, shifted, method="nearest", max_gap_ns=2_000_000)
    theirs, _ = sync.associate_trajectories(as_evo(shifted), as_evo(estimate), max_diff=0.002)
    got = at[np.isfinite(at[:, 0])]
    assert 0 < len(got) < len(estimate)
    np.testing.assert_array_equal(got[:, :2], theirs.positions_xyz[:, :2])


# --------------------------------------------------------------------------- association


def line(times_s: list[float], speed: float = 1.0, heading: float = 0.0) -> Trajectory:
    t = np.array([round(s * SECOND) for s in times_s])
    return Trajectory.of(t, np.column_stack([t / 1e9 * speed, t * 0.0, t * 0.0 + heading]))


def test_interpolation_hits_a_straight_line() -> None:
    at = associate(np.array([SECOND // 4, SECOND]), line([0, 1, 2], 8.0))
    np.testing.assert_allclose(at[:, 0], [2.0, 8.0])


def test_interpolated_headings_take_the_shorter_turn() -> None:
    reference = Trajectory.of([0, 2 * SECOND], np.array([[0, 0, 3.1], [0, 0, -3.1]]))
    at = associate(np.array([SECOND]), reference)
    assert abs(wrap_angle(at[0, 2] - np.pi)) < 1e-12


def test_nothing_is_extrapolated_and_gaps_are_not_bridged() -> None:
    reference = line([0, 1, 2, 3, 4, 20, 21, 22])
    at = associate(np.array([-1, 2 * SECOND, 10 * SECOND, 21 * SECOND, 23 * SECOND]), reference)
    assert np.isfinite(at[:, 0]).tolist() == [False, True, False, True, False]
    wide = associate(np.array([10 * SECOND]), reference, max_gap_ns=16 * SECOND)
    np.testing.assert_allclose(wide[0, 0], 10.0)


def test_a_pose_at_the_same_stamp_is_taken_as_it_is() -> None:
    reference = Trajectory.of([0, SECOND, 2 * SECOND], np.array([[0, 0, 1.0], [1, 0, 2.0], [2, 0, np.nan]]))
    at = associate(np.array([SECOND]), reference)
    np.testing.assert_array_equal(at, [[1, 0, 2.0]])


def test_the_offset_is_added_to_the_estimates_times() -> None:
    estimate = line([1, 2, 3])
    late = Trajectory(estimate.t_ns + SECOND // 2, estimate.pose)
    result = evaluate(late, line([0, 1, 2, 3, 4]), offset_ns=-SECOND // 2)
    assert result.ape_m.max < 1e-12
    assert result.matched == 3


def test_a_reference_of_one_pose_or_none() -> None:
    one = Trajectory.of([5], np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_array_equal(associate(np.array([4, 5, 6]), one)[1], [1, 2, 3])
    none = Trajectory.of([], np.zeros((0, 3)))
    assert np.isnan(associate(np.array([4, 5, 6]), none)).all()


def test_too_few_associated_poses_are_refused_with_their_count() -> None:
    estimate = line([0, 1, 2, 3, 4, 5, 6, 7, 8, 9])
    with pytest.raises(EvaluationError, match="4 of 10 poses"):
        evaluate(estimate, line([0, 1, 2, 3]))
    assert evaluate(estimate, line([0, 1, 2, 3, 4])).matched == 5
    with pytest.raises(EvaluationError, match="1 of 1 poses"):
        evaluate(line([1]), line([0, 1, 2]))


def test_nanoseconds_taken_for_seconds_are_visible_in_the_error() -> None:
    estimate = line([0, 1, 2])
    with pytest.raises(EvaluationError, match=r"from 0.000 to 2.000 s.*from 0.000 to 2000000000.000 s"):
        evaluate(estimate, Trajectory(estimate.t_ns * SECOND, estimate.pose), max_gap_ns=1)


def test_a_trajectory_sorts_and_drops_what_cannot_be_used() -> None:
    path = Trajectory.of([3, 1, 3, 2], np.array([[3.0, 0], [1, 0], [9, 0], [np.nan, 0]]))
    assert path.t_ns.tolist() == [1, 3]
    assert path.pose[:, 0].tolist() == [1, 3]
    assert np.isnan(path.pose[:, 2]).all()


def test_a_trajectory_of_pose_samples() -> None:
    def sample(t_ns: int, quat: Floats) -> PoseSample:
        return PoseSample(
            stream="/p", t_ns=t_ns, received_ns=0, position_m=array(1, 2, 3), quat_xyzw=quat, covariance=UNKNOWN_COV6
        )

    path = Trajectory.of_poses([sample(5, quat_of_heading(0.7)), sample(2, UNKNOWN_QUAT)])
    assert path.t_ns.tolist() == [2, 5]
    np.testing.assert_allclose(path.pose, [[1, 2, np.nan], [1, 2, 0.7]])
    assert len(Trajectory.of_poses([])) == 0


# ------------------------------------------------------------------------------ alignment


@pytest.mark.parametrize("scale", [1.0, 0.02])
def test_alignment_recovers_a_known_transform(scale: float) -> None:
    _, reference = random_pair(1)
    c, s = np.cos(-2.5), np.sin(-2.5)
    moved = reference.pose.copy()
    moved[:, :2] = (reference.pose[:, :2] @ np.array([[c, -s], [s, c]]).T + [3, -4]) / scale
    moved[:, 2] -= 2.5
    alignment = align(moved, reference.pose, with_scale=scale != 1.0)
    assert alignment.rotation_rad == pytest.approx(2.5)
    assert alignment.scale == pytest.approx(scale)
    np.testing.assert_allclose(alignment(moved)[:, :2], reference.pose[:, :2], atol=1e-9)
    result = evaluate(Trajectory(reference.t_ns, moved), reference, with_scale=scale != 1.0)
    assert result.drift < 1e-9
    assert result.ape_heading_rad.max < 1e-9
    assert result.path_m == pytest.approx(result.reference_path_m)


def test_a_motionless_reference_divides_by_nothing() -> None:
    t = np.arange(10) * SECOND
    still = Trajectory.of(t, np.tile([1.0, 2.0, 0.3], (10, 1)))
    creeping = Trajectory.of(t, np.column_stack([t * 1e-12, t * 0.0, t * 0.0]))
    result = evaluate(creeping, still)
    assert math.isnan(result.drift)
    assert math.isnan(result.yaw_drift_rad_per_m)
    assert result.end_error_m == pytest.approx(0.009)
    assert not result.alignment.determined
    assert result.alignment.rotation_rad == pytest.approx(0.3)
    assert any("does not move" in note for note in result.notes)
    both = evaluate(still, still, with_scale=True)
    assert both.alignment.scale == 1.0
    assert both.ape_m.max < 1e-12


def test_a_noisy_standstill_says_that_drift_means_little() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(500) * SECOND
    noise = Trajectory.of(t, np.column_stack([rng.normal(0, 0.001, (500, 2)), np.zeros(500)]))
    assert any("mostly noise" in note for note in evaluate(noise, noise).notes)


def test_positions_only_are_enough() -> None:
    estimate, reference = random_pair(2)
    blind = Trajectory.of(reference.t_ns, reference.pose[:, :2])
    full, result = evaluate(estimate, reference), evaluate(estimate, blind)
    assert result.ape_m == full.ape_m
    assert math.isnan(result.ape_heading_rad.rmse)
    assert math.isnan(result.yaw_drift_rad)
    assert math.isfinite(result.drift)
    assert any("no heading" in note for note in result.notes)


def test_a_mounting_angle_is_named() -> None:
    reference = line([0, 1, 2, 3, 4, 5])
    turned = Trajectory(reference.t_ns, reference.pose + np.array([0, 0, 0.5]))
    notes = evaluate(turned, reference).notes
    assert any("28.6 degrees" in note for note in notes)
    assert not evaluate(reference, reference).notes


# ----------------------------------------------------------------------- errors by hand


def test_scale_error_gives_the_drift_it_should() -> None:
    reference = line([n / 10 for n in range(101)])
    estimate = Trajectory(reference.t_ns, reference.pose * [1.02, 1, 1])
    result = evaluate(estimate, reference, rpe_m=[2.0], rpe_s=[1.0])
    assert result.drift == pytest.approx(0.02)
    assert result.end_error_m == pytest.approx(0.2)
    assert result.reference_path_m == pytest.approx(10)
    assert result.path_m == pytest.approx(10.2)
    by_distance, by_time = result.rpe
    assert by_distance.translation_m.rmse == pytest.approx(0.04)
    assert by_distance.translation_m.count == 81
    assert by_time.translation_m.max == pytest.approx(0.02)


def test_yaw_drift_is_a_change_and_not_an_offset() -> None:
    reference = line([n / 10 for n in range(101)])
    estimate = Trajectory(reference.t_ns, reference.pose + np.linspace([0, 0, 0.4], [0, 0, 0.5], 101))
    result = evaluate(estimate, reference)
    assert result.yaw_drift_rad == pytest.approx(0.1)
    assert result.yaw_drift_rad_per_m == pytest.approx(0.01)


def test_yaw_drift_counts_whole_turns() -> None:
    reference = line([n / 10 for n in range(101)])
    estimate = Trajectory(reference.t_ns, reference.pose + np.linspace([0, 0, 0.0], [0, 0, 7.0], 101))
    assert evaluate(estimate, reference).yaw_drift_rad == pytest.approx(7.0)


def test_errors_are_rows_of_the_matched_frames() -> None:
    estimate, reference = random_pair(4)
    late = Trajectory(reference.t_ns[20:], reference.pose[20:])
    result = evaluate(estimate, late)
    assert result.index.tolist() == list(range(20, 200))
    assert result.errors.shape == (180, 4)
    np.testing.assert_allclose(result.errors[:, 2], np.hypot(*result.errors[:, :2].T))
    assert result.ape_m.max == pytest.approx(result.errors[:, 2].max())


@pytest.mark.parametrize(("value", "nice"), [(0.7, 0.5), (5.0, 5.0), (19.9, 10.0), (2.0, 2.0), (0.001, 0.001)])
def test_round_down_gives_one_two_five(value: float, nice: float) -> None:
    assert round_down(value) == pytest.approx(nice)


def test_path_lengths_sum_the_steps() -> None:
    np.testing.assert_allclose(path_lengths(np.array([[0.0, 0], [3, 4], [3, 4], [3, 5]])), [0, 5, 5, 6])


# ---------------------------------------------------------------------------- consistency


def noisy_drive(seed: int, sigma: Floats) -> tuple[Trajectory, Floats, Trajectory]:
    """An estimate that starts elsewhere, turned, with its covariances by the chain rule; and its reference."""
    rng = np.random.default_rng(seed)
    true = np.tile([0.1, 0.02, 0.03], (40, 1))
    made = true + rng.normal(0, 1, (40, 3)) * sigma
    paths = []
    for steps, start in ((made, (5.0, 3.0, 2.0)), (true, (0.0, 1.0, -0.5))):
        poses, covariances = [np.array(start)], [np.zeros((3, 3))]
        for x, y, turn in steps:
            c, s = np.cos(poses[-1][2]), np.sin(poses[-1][2])
            move = np.array([c * x - s * y, s * x + c * y, turn])
            by_pose = np.array([[1, 0, -move[1]], [0, 1, move[0]], [0, 0, 1]])
            by_step = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            covariances.append(by_pose @ covariances[-1] @ by_pose.T + by_step @ np.diag(sigma**2) @ by_step.T)
            poses.append(poses[-1] + move)
        paths.append((Trajectory.of(np.arange(41) * SECOND, np.array(poses)), np.array(covariances)))
    return *paths[0], paths[1][0]


def test_nees_of_poses_is_chi_squared() -> None:
    sigma = np.array([0.004, 0.001, 0.002])
    last = []
    for seed in range(300):
        index, nees = pose_nees(*noisy_drive(seed, sigma))
        assert index.tolist() == list(range(41))
        assert math.isnan(nees[0])  # nothing is uncertain at the start
        assert np.isfinite(nees[1:]).all()
        last.append(nees[-1])
    found = Consistency.of(np.array(last), 3, confidence=0.999)
    assert found.consistent, found
    estimate, covariance, reference = noisy_drive(0, sigma)
    covariance[7] = np.nan
    _, halved = pose_nees(estimate, covariance / 2, reference)
    assert halved[40] == pytest.approx(2 * last[0])
    assert math.isnan(halved[7])
    with pytest.raises(ValueError, match="for 41 poses"):
        pose_nees(estimate, covariance[1:], reference)


# ------------------------------------------------------------------------------- geometry


def test_wrapped_angles_are_the_same_angles() -> None:
    angles = np.linspace(-20, 20, 101)
    wrapped = wrap_angles(angles)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)
    assert np.isnan(wrap_angles(np.array([np.nan]))).all()


def test_local_enu_against_the_lengths_of_a_degree() -> None:
    # one degree at 45 degrees north on WGS 84: 78 846.8 m of longitude, 111 131.8 m of latitude
    minute = math.radians(1 / 60)
    lat = math.radians(45) + np.array([0.0, minute, 0.0, 0.0, 0.0])
    lon = math.radians(10) + np.array([0.0, 0.0, minute, 0.0, 0.0])
    height = np.array([100.0, 100.0, 100.0, 130.0, np.nan])
    enu = local_enu(lat, lon, height)
    np.testing.assert_allclose(enu[0], 0, atol=1e-9)
    assert enu[1, 1] == pytest.approx(111_131.8 / 60 * (1 + 100 / 6.367e6), rel=1e-4)
    assert enu[2, 0] == pytest.approx(78_846.8 / 60 * (1 + 100 / 6.388e6), rel=1e-5)
    np.testing.assert_allclose(enu[3], [0, 0, 30], atol=1e-8)
    np.testing.assert_allclose(enu[4], 0, atol=1e-8)
