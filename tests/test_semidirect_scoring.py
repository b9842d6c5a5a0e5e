"""Scores of a visual odometry: paths with known errors, known scale, known losses; map points at known places."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from visual_steps import visual_step

from pipelines.geometry import Floats
from pipelines.semidirect import scoring
from pipelines.semidirect.scoring import MapNotes, Track, Work, scored
from pipelines.semidirect.step import Stage, VisualStep
from pipelines.simulation.sensors import level_ground
from pipelines.spatial import SpatialPath, path_lengths

HEIGHT_M, N = 1.5, 600
NADIR = np.diag([1.0, -1.0, -1.0])
TURN = Rotation.from_euler("xyz", [0.2, -0.1, 0.7])
SHIFT = np.array([3.0, -2.0, 0.5])


def flight(n: int = N) -> SpatialPath:
    """A way of waves at 1.6 m/s and 60 Hz, rising and tilting."""
    t = np.arange(n) / 60
    places = np.column_stack([1.6 * t, 0.8 * np.sin(0.9 * t), HEIGHT_M + 0.1 * np.sin(2 * t)])
    tilt = np.column_stack([0.4 * np.sin(0.5 * t), 0.05 * np.sin(3 * t), 0.05 * np.cos(2 * t)])
    quats = (Rotation.from_euler("zyx", tilt) * Rotation.from_matrix(NADIR)).as_quat()
    return SpatialPath((t * 1e9).astype(np.int64), places, quats)


def moved(path: SpatialPath, scale: float = 0.5) -> SpatialPath:
    """The same flight in another world of another scale."""
    return SpatialPath(path.t_ns, scale * TURN.apply(path.position_m) + SHIFT, (TURN * path.rotation).as_quat())


def track(path: SpatialPath, accepted: Any = True, stage: Any = Stage.TRACKED, number: Any = 0) -> Track:
    n = len(path)
    wide = (np.broadcast_to(np.asarray(x), n).copy() for x in (accepted, stage, number))
    said, stages, numbers = wide
    return Track(path.t_ns, said, path.position_m, path.quat_xyzw, stages, numbers)


# ------------------------------------------------------------------------------ trajectory


def test_another_world_and_scale_is_no_error() -> None:
    truth = flight()
    accuracy, curves, fit = scored(track(moved(truth)), truth)
    assert fit is not None
    assert accuracy.scale == pytest.approx(2.0, abs=1e-12)
    assert accuracy.ate_m == pytest.approx(0, abs=1e-12)
    assert accuracy.attitude_worst_rad == pytest.approx(0, abs=1e-7)
    assert (accuracy.rpe_mps, accuracy.scale_drift) == pytest.approx((0, 0), abs=1e-10)
    assert (accuracy.covered, accuracy.losses, accuracy.maps, accuracy.first) == (pytest.approx(1), 0, 1, 0)
    np.testing.assert_allclose(curves.scale, 1, atol=1e-12)
    np.testing.assert_allclose(curves.path_m, path_lengths(truth))


def test_white_noise_comes_back_as_rmse() -> None:
    """σ of three coordinates is an rmse of √3 σ, less the seven freedoms of the fit; a motion has √2 of that."""
    truth, sigma = flight(), 0.01
    noisy = moved(dataclasses.replace(truth, position_m=truth.position_m + sigma * noise(1)))
    accuracy, curves, _ = scored(track(noisy), truth)
    length = path_lengths(truth)[-1]
    assert accuracy.path_m == pytest.approx(length)
    assert accuracy.ate_m == pytest.approx(math.sqrt(3) * sigma, rel=0.05)
    assert accuracy.ate_share == pytest.approx(accuracy.ate_m / length)
    assert accuracy.worst_share == pytest.approx(curves.position_m.max() / length)
    assert accuracy.rpe_mps == pytest.approx(math.sqrt(6) * sigma, rel=0.05)
    assert accuracy.rpe_median_mps < accuracy.rpe_mps


def noise(seed: int) -> Floats:
    return np.random.default_rng(seed).standard_normal((N, 3))


def test_a_tilted_camera_is_an_attitude_error() -> None:
    truth, tilt = flight(), math.radians(2)
    tilted = (truth.rotation * Rotation.from_rotvec([tilt, 0, 0])).as_quat()
    accuracy, _, _ = scored(track(moved(dataclasses.replace(truth, quat_xyzw=tilted))), truth)
    assert (accuracy.attitude_rad, accuracy.attitude_worst_rad) == pytest.approx((tilt, tilt), rel=1e-6)
    assert accuracy.ate_m == pytest.approx(0, abs=1e-12)


def test_a_turn_that_grows_is_a_rate() -> None:
    truth, rate = flight(), 0.003
    turned = Rotation.from_rotvec(np.outer(1e-9 * truth.t_ns, [0, 0, rate])) * truth.rotation
    accuracy, _, _ = scored(track(dataclasses.replace(truth, quat_xyzw=turned.as_quat())), truth)
    assert (accuracy.rpe_radps, accuracy.rpe_median_radps) == pytest.approx((rate, rate), rel=1e-4)


@pytest.mark.parametrize("drift", [-0.04, 0.01])
def test_a_scale_that_shrinks_on_the_way(drift: float) -> None:
    """Every step is exp(k s) times as long: the drift over the flight is exp(k S) - 1."""
    truth = flight(3000)
    along = path_lengths(truth)
    gain = np.exp(math.log1p(drift) * along / along[-1])
    steps = np.diff(truth.position_m, axis=0) * (gain[1:] + gain[:-1])[:, None] / 2
    shrunk = dataclasses.replace(truth, position_m=np.cumsum(np.vstack([truth.position_m[:1], steps]), axis=0))
    accuracy, curves, _ = scored(track(moved(shrunk)), truth)
    assert accuracy.scale_drift == pytest.approx(drift, rel=0.02)
    assert curves.scale[-1] / curves.scale[0] - 1 == pytest.approx(drift, rel=0.1)


def test_a_jump_is_no_drift_of_the_scale() -> None:
    truth = flight(1200)
    jumped = truth.position_m.copy()
    jumped[600:] += [0.5, 0.3, 0]
    accuracy, _, _ = scored(track(dataclasses.replace(truth, position_m=jumped)), truth)
    assert abs(accuracy.scale_drift) < 0.002
    assert accuracy.ate_m > 0.05


def test_the_drift_of_the_scale_needs_two_places() -> None:
    assert math.isnan(scoring.scale_drift(np.array([1.0]), np.array([1.0]), 10))


# ---------------------------------------------------------------------------------- losses


def test_losses_are_counted_and_held_poses_are_not_scored() -> None:
    truth = flight()
    accepted, stage = np.ones(N, np.bool_), np.full(N, int(Stage.TRACKED))
    accepted[:30], stage[:30] = False, Stage.STARTING
    accepted[200:250], stage[200:250] = False, Stage.LOST
    stage[250] = Stage.RELOCALISED
    accepted[400], stage[400] = False, Stage.SKIPPED  # a frame that cannot be used is no loss
    held = truth.position_m.copy()
    held[200:250] = held[199]
    accuracy, curves, _ = scored(track(dataclasses.replace(truth, position_m=held), accepted, stage), truth)
    assert (accuracy.first, accuracy.losses, accuracy.relocalisations) == (30, 1, 1)
    assert (accuracy.accepted, accuracy.lost_frames) == (N - 81, 51)
    assert accuracy.ate_m == pytest.approx(0, abs=1e-12)
    assert accuracy.covered == pytest.approx(1 - (30 + 51 + 2) / N, abs=0.01)
    assert len(curves.position_m) == accuracy.accepted
    assert curves.path_m[0] == pytest.approx(path_lengths(truth)[30])


def test_a_motion_that_is_claimed_and_wrong_is_found() -> None:
    """For 60 frames the estimate stands still and says nothing; the rest of the way it is right."""
    truth = flight(1200)
    places = truth.position_m.copy()
    places[300:360] = places[300]
    places[360:] += places[300] - truth.position_m[360]
    accuracy, _, _ = scored(track(dataclasses.replace(truth, position_m=places)), truth)
    assert 50 <= accuracy.longest_unnoticed <= 65
    good, _, _ = scored(track(truth), truth)
    assert good.longest_unnoticed == 0


def test_maps_are_counted() -> None:
    number = np.repeat([0, 1, 2], N // 3)
    accuracy, _, _ = scored(track(flight(), number=number), flight())
    assert accuracy.maps == 3


@pytest.mark.parametrize("kind", ["never", "one place", "a line"])
def test_what_cannot_be_scored_is_said(kind: str) -> None:
    truth = flight()
    said = track(truth, accepted=kind != "never")
    if kind != "never":
        line = np.zeros(3) if kind == "one place" else np.arange(N)[:, None] * np.array([1.0, 0.5, 0.1])
        said = dataclasses.replace(said, position_m=np.broadcast_to(line, (N, 3)))
    accuracy, curves, fit = scored(said, truth)
    assert fit is None
    assert math.isnan(accuracy.ate_share)
    assert accuracy.note
    assert not len(curves.path_m)
    assert accuracy.frames == N


def test_steps_and_truth_belong_together() -> None:
    with pytest.raises(ValueError, match="600 steps for 599 true poses"):
        scored(track(flight()), flight(599))


# ------------------------------------------------------------------------------------- map


def hills(x: Floats, y: Floats) -> Floats:
    return 0.1 * np.sin(x) * np.cos(y)


def step_of(path: SpatialPath, k: int, points: Floats, **more: Any) -> VisualStep:
    fields = {"map_id": np.arange(len(points)), "map_point_m": points, "position_m": path.position_m[k]}
    return visual_step(**{"accepted": True, "quat_xyzw": path.quat_xyzw[k], **fields, **more})


def seen_from(truth: SpatialPath, k: int, ground: scoring.Ground, count: int, seed: int) -> Floats:
    """True places [count, 3] of points that camera k sees."""
    xy = truth.position_m[k, :2] + np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 2))
    return np.column_stack([xy, ground(xy[:, 0], xy[:, 1])])


@pytest.mark.parametrize("ground", [level_ground, hills])
def test_outliers_of_the_map_are_counted(ground: scoring.Ground) -> None:
    """Of 200 points 7 lie 9 cm too high, more than 5 % of the height; 5 lie 5 cm too high, which is less."""
    truth = flight()
    estimate, k = moved(truth), 300
    points = seen_from(truth, k, ground, 200, 1)
    points[:7, 2] += 0.09
    points[7:12, 2] += 0.05
    notes = MapNotes(ground, (0.9, 0.6))
    step = step_of(estimate, k, 0.5 * TURN.apply(points) + SHIFT)
    turns = [p.rotation[k].as_matrix() for p in (estimate, truth)]
    notes.add(step, *turns, truth.position_m[k])
    _, _, fit = scored(track(estimate), truth)
    errors = notes.errors(fit, HEIGHT_M)
    assert (errors.points, errors.outliers, errors.judged, errors.misplaced) == (200, 7, 200, 7)
    assert (errors.share, errors.misplaced_share) == (0.035, 0.035)


def test_a_path_that_drifts_makes_outliers_but_misplaces_nothing() -> None:
    truth, k = flight(), 300
    sunk = dataclasses.replace(truth, position_m=truth.position_m - [0, 0, 0.2])
    points = seen_from(truth, k, level_ground, 50, 2) - [0, 0, 0.2]
    notes = MapNotes(level_ground, (0.9, 0.6))
    turn = truth.rotation[k].as_matrix()
    notes.add(step_of(sunk, k, points), turn, turn, truth.position_m[k])
    _, _, straight = scored(track(truth), truth)
    errors = notes.errors(straight, HEIGHT_M)
    assert (errors.outliers, errors.judged, errors.misplaced) == (50, 50, 0)


def test_a_point_counts_once_at_its_last_place_and_each_map_by_itself() -> None:
    truth, k = flight(), 300
    points, turn = seen_from(truth, k, level_ground, 20, 3), truth.rotation[k].as_matrix()
    notes = MapNotes(level_ground, (0.9, 0.6))
    notes.add(step_of(truth, k, points + np.array([0, 0, 0.5]), map_number=0), turn, turn, truth.position_m[k])
    notes.add(step_of(truth, k, points[:15], map_number=0), turn, turn, truth.position_m[k])
    notes.add(step_of(truth, k, points, map_number=1), turn, turn, truth.position_m[k])
    _, _, fit = scored(track(truth), truth)
    errors = notes.errors(fit, HEIGHT_M)
    assert (errors.points, errors.outliers) == (40, 5)


def test_points_out_of_view_and_of_lost_frames_are_not_judged_by_depth() -> None:
    truth, k = flight(), 300
    turn = truth.rotation[k].as_matrix()
    points = seen_from(truth, k, level_ground, 10, 4)
    points[:4] += [5, 0, 0]
    points[4] = truth.position_m[k] + [0, 0, 1]  # behind the camera
    notes = MapNotes(level_ground, (0.9, 0.6))
    notes.add(step_of(truth, k, points, accepted=False), turn, turn, truth.position_m[k])
    assert notes.errors(None, HEIGHT_M).judged == 0
    notes.add(step_of(truth, k, points), turn, turn, truth.position_m[k])
    assert notes.errors(None, HEIGHT_M).judged == 5


def test_a_map_without_a_path_is_all_outliers_and_no_map_has_no_share() -> None:
    truth = flight()
    notes = MapNotes(level_ground, (0.9, 0.6))
    assert math.isnan(notes.errors(None, HEIGHT_M).share)
    points = seen_from(truth, 0, level_ground, 5, 5)
    notes.add(step_of(truth, 0, points), np.eye(3), np.eye(3), truth.position_m[0])
    assert notes.errors(None, HEIGHT_M).outliers == 5


# ------------------------------------------------------------------------------------ work


def test_the_mapping_is_no_work_of_the_tracking() -> None:
    cpu, stages = np.array([10.0, 8.0, 6.0]), np.array([[1.0, 2.0, 2.5], [2.0, 2.0, math.nan], [math.nan] * 3])
    np.testing.assert_allclose(scoring.tracking_ms(cpu, stages), [7.5, 8.0, 6.0])
    np.testing.assert_allclose(scoring.tracking_ms(cpu, np.empty((3, 0))), cpu)
    work = Work.of(cpu, stages)
    assert (work.median_ms, work.mean_ms, work.whole_mean_ms) == pytest.approx((7.5, 21.5 / 3, 8))
    assert work.frames_per_s == pytest.approx(1e3 / 7.5)
