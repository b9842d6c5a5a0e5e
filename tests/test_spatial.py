"""Errors of paths in space, against evo as an oracle on TUM files, and by properties."""

import copy
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.core import filters, metrics, sync
from evo.core.sync_method import SyncMethod
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from pipelines import evaluation as planar
from pipelines.consistency import Consistency, band, nees_of
from pipelines.evaluation import EvaluationError, Statistics, Trajectory
from pipelines.spatial import (
    SpatialPath,
    absolute_error,
    align,
    associated,
    pairs_by_frames,
    pairs_by_measure,
    path_lengths,
    relative_error,
    segment_drift,
    umeyama,
)
from readers.streams import UNKNOWN_COV6, UNKNOWN_QUAT, PoseSample, array
from workbench.trajectory_files import read_tum, write_tum

Floats = NDArray[np.float64]
SECOND = 1_000_000_000
NAMES = ("rmse", "mean", "median", "max")


def flight(seed: int, n: int = 400, *, plane: bool = False) -> tuple[SpatialPath, SpatialPath]:
    """A reference of uneven rate, and a turned, shifted, drifting and noisy estimate at every third of its times."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.integers(5_000_000, 15_000_000, n)) + 1_700_000_000 * SECOND
    axes = np.array([0, 0, 1]) if plane else np.array([0.3, 0.3, 1])
    turns = [Rotation.identity()]
    for turn in Rotation.from_rotvec(rng.normal(0, 0.05, (n - 1, 3)) * axes):
        turns.append(turns[-1] * turn)
    rotation = Rotation.concatenate(turns)
    step = rotation.apply(np.column_stack([rng.uniform(0, 0.2, n), np.zeros((n, 2))]))
    place = np.cumsum(step, axis=0)
    reference = SpatialPath.of(t, place, rotation.as_quat())
    world = Rotation.from_rotvec(rng.normal(0, 1, 3) * (axes == 1 if plane else 1))
    flat = np.array([1, 1, 0]) if plane else 1
    noisy = place + np.cumsum(rng.normal(0, 0.01, (n, 3)) * flat, axis=0)
    wrong = rotation * Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.002, (n, 3)) * axes, axis=0))
    kept = slice(2, None, 3)
    moved = 1.3 * world.apply(noisy[kept]) + rng.uniform(-20, 20, 3) * flat
    return SpatialPath.of(t[kept], moved, (world * wrong[kept]).as_quat()), reference


def as_evo(path: SpatialPath, file: Path) -> PoseTrajectory3D:
    """A path as evo reads it from our TUM file."""
    write_tum(file, path)
    return file_interface.read_tum_trajectory_file(file)


@pytest.fixture(params=["space", "plane", "late"])
def pair(request: Any, tmp_path: Path) -> tuple[SpatialPath, SpatialPath, PoseTrajectory3D, PoseTrajectory3D]:
    """Associated estimate and reference, ours and evo's, by way of TUM files."""
    estimate, reference = flight(1, plane=request.param == "plane")
    offset_ns = -250_000_000 if request.param == "late" else 0
    estimate = SpatialPath(estimate.t_ns - offset_ns, estimate.position_m, estimate.quat_xyzw)
    theirs_reference, theirs = as_evo(reference, tmp_path / "r.tum"), as_evo(estimate, tmp_path / "e.tum")
    theirs_reference, theirs = sync.associate_trajectories(
        theirs_reference, theirs, max_diff=0.001, offset_2=offset_ns / 1e9
    )
    back = read_tum(tmp_path / "e.tum"), read_tum(tmp_path / "r.tum")
    ours, truth = associated(*back, offset_ns=offset_ns, method="nearest", max_gap_ns=1_000_000)
    assert len(ours) == theirs.num_poses == len(estimate)
    return ours, truth, theirs, theirs_reference


def same_statistics(ours: Statistics, theirs: metrics.PE) -> None:
    expected = theirs.get_all_statistics()
    assert expected["max"] > 1e-6
    for name in NAMES:
        assert getattr(ours, name) == pytest.approx(expected[name], abs=1e-9, rel=1e-9)


# ---------------------------------------------------------------------------- the oracle


@pytest.mark.parametrize("fit", ["none", "origin", "se3", "sim3", "scale"])
def test_ape_is_evos(pair: tuple[Any, ...], fit: Any) -> None:
    ours, truth, theirs, theirs_reference = pair
    theirs = copy.deepcopy(theirs)
    if fit == "origin":
        theirs.align_origin(theirs_reference)
    elif fit != "none":
        theirs.align(theirs_reference, correct_scale=fit == "sim3", correct_only_scale=fit == "scale")
    found = absolute_error(align(ours, truth, fit)(ours), truth)
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, found.translation),
        (metrics.PoseRelation.rotation_angle_rad, found.rotation),
    ):
        ape = metrics.APE(relation)
        ape.process_data((theirs_reference, theirs))
        same_statistics(statistics, ape)


@pytest.mark.parametrize("every", [True, False])
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (10, "frames"), (2.5, "meters"), (0.7, "meters")])
def test_rpe_is_evos(pair: tuple[Any, ...], delta: float, unit: str, every: bool) -> None:
    ours, truth, theirs, theirs_reference = pair
    if unit == "frames":
        pairs = pairs_by_frames(len(ours), int(delta), every=every)
    else:
        pairs = pairs_by_measure(path_lengths(ours), delta, every=every)
    found = relative_error(ours, truth, pairs)
    for relation, statistics in (
        (metrics.PoseRelation.translation_part, found.translation),
        (metrics.PoseRelation.rotation_angle_rad, found.rotation),
    ):
        rpe = metrics.RPE(
            relation, delta=delta, delta_unit=metrics.Unit(unit[0] if unit == "meters" else unit), all_pairs=every
        )
        rpe.process_data((theirs_reference, theirs))
        assert len(rpe.error) == len(pairs) > 3
        same_statistics(statistics, rpe)


@pytest.mark.parametrize("every", [True, False])
@pytest.mark.parametrize("delta", [0.25, 1.0, 4.0])
def test_pairs_of_metres_are_evos_even_where_nothing_moves(every: bool, delta: float) -> None:
    rng = np.random.default_rng(3)
    steps = rng.choice([0.0, 0.0, 0.125, 0.25, 0.75], 300)  # exact in binary: ties are ties
    poses = np.tile(np.eye(4), (301, 1, 1))
    poses[1:, 0, 3] = np.cumsum(steps)
    expected = filters.filter_pairs_by_path(poses, delta, 0.1 * delta, every)
    along = poses[:, 0, 3]
    assert pairs_by_measure(along, delta, every=every).tolist() == [list(p) for p in expected]


def test_pairs_that_cannot_be() -> None:
    assert pairs_by_frames(5, 5).tolist() == pairs_by_frames(0, 1, every=False).tolist() == []
    for every in (True, False):
        assert pairs_by_measure(np.array([0.0]), 1.0, every=every).shape == (0, 2)
        assert pairs_by_measure(np.array([]), 1.0, every=every).shape == (0, 2)
        with pytest.raises(ValueError, match="delta"):
            pairs_by_frames(5, 0, every=every)
        with pytest.raises(ValueError, match="delta"):
            pairs_by_measure(np.zeros(3), 0.0, every=every)


@pytest.mark.parametrize("offset_s", [0.0, 0.05])
def test_interpolated_association_is_evos(tmp_path: Path, offset_s: float) -> None:
    estimate, reference = flight(2)
    inside = np.arange(5, len(estimate) - 5)
    estimate = estimate.at(inside)
    shifted = SpatialPath(estimate.t_ns + 1_234_567, estimate.position_m, estimate.quat_xyzw)
    ours, truth = associated(shifted, reference, offset_ns=round(offset_s * 1e9))
    theirs, _ = sync.associate_trajectories(
        as_evo(reference, tmp_path / "r.tum"),
        as_evo(shifted, tmp_path / "e.tum"),
        sync_method=SyncMethod.interpolation,
        offset_2=offset_s,
    )
    assert len(ours) == theirs.num_poses
    # evo's times are doubles: to 2e-7 s, that is 4e-6 m at these speeds
    np.testing.assert_allclose(truth.position_m, theirs.positions_xyz, atol=1e-5)
    quats = theirs.orientations_quat_wxyz[:, [1, 2, 3, 0]]
    assert (truth.rotation.inv() * Rotation.from_quat(quats)).magnitude().max() < 1e-5


# ------------------------------------------------------------------------------ alignment


@pytest.mark.parametrize("fit", ["se3", "sim3", "yaw", "origin"])
def test_alignment_recovers_a_known_transform(fit: Any) -> None:
    _, reference = flight(3)
    turn = Rotation.from_euler("z", 2.0) if fit == "yaw" else Rotation.from_rotvec([0.3, -1.0, 2.0])
    scale = 0.1 if fit == "sim3" else 1.0
    moved = SpatialPath(
        reference.t_ns, turn.apply(reference.position_m / scale) + array(1, 2, 3), (turn * reference.rotation).as_quat()
    )
    alignment = align(moved, reference, fit)
    assert alignment.scale == pytest.approx(scale)
    np.testing.assert_allclose(alignment.rotation, turn.inv().as_matrix(), atol=1e-9)
    found = absolute_error(alignment(moved), reference)
    assert max(found.translation.max, found.rotation.max) < 1e-9


def test_yaw_alignment_leaves_roll_and_pitch_and_is_the_best_of_its_kind() -> None:
    ours, truth = associated(*flight(4))
    alignment = align(ours, truth, "yaw")
    np.testing.assert_allclose(alignment.rotation[2], [0, 0, 1], atol=1e-15)
    best = absolute_error(alignment(ours), truth).translation.rmse
    for change in (-0.01, 0.01):
        turn = Rotation.from_euler("z", change).as_matrix() @ alignment.rotation
        shift = truth.position_m.mean(axis=0) - turn @ ours.position_m.mean(axis=0)
        other = type(alignment)(rotation=turn, translation_m=shift)
        assert absolute_error(other(ours), truth).translation.rmse > best


def test_a_mirrored_cloud_is_turned_and_not_mirrored() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    rotation, _, _ = umeyama(points, points * [1, 1, -1], with_scale=False)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_positions_that_tell_no_rotation_are_refused() -> None:
    _, reference = flight(0)
    line = SpatialPath(reference.t_ns, np.outer(np.arange(len(reference)), [1.0, 2, 3]), reference.quat_xyzw)
    with pytest.raises(ValueError, match="one line or in one point"):
        align(line, line, "se3")
    assert absolute_error(align(line, line, "yaw")(line), line).translation.max < 1e-9


def test_too_few_poses_in_common_are_refused() -> None:
    estimate, reference = flight(0)
    with pytest.raises(EvaluationError, match="poses have a reference"):
        associated(estimate, reference.at(np.arange(100)))
    empty = reference.at(np.arange(0))
    with pytest.raises(EvaluationError, match="reference is empty"):
        associated(estimate, empty)


# ------------------------------------------------------------------- planar and spatial agree


def test_space_and_plane_give_the_same_numbers() -> None:
    estimate, reference = flight(5, plane=True)
    flat = estimate.from_above(), reference.from_above()
    result = planar.evaluate(*flat)
    ours, truth = associated(estimate, reference)
    found = absolute_error(align(ours, truth, "se3")(ours), truth)
    for name in NAMES:
        assert getattr(found.translation, name) == pytest.approx(getattr(result.ape_m, name), abs=1e-9)
        assert getattr(found.rotation, name) == pytest.approx(getattr(result.ape_heading_rad, name), abs=1e-9)
    back = SpatialPath.of_plane(flat[0])
    np.testing.assert_allclose(back.position_m, estimate.position_m, atol=1e-12)
    assert (back.rotation.inv() * estimate.rotation).magnitude().max() < 1e-9


def test_paths_from_samples_leave_unknown_poses_out() -> None:
    def sample(t_ns: int, quat: Floats) -> PoseSample:
        return PoseSample(
            stream="/p", t_ns=t_ns, received_ns=0, position_m=array(1, 2, 3), quat_xyzw=quat, covariance=UNKNOWN_COV6
        )

    path = SpatialPath.of_poses([sample(5, array(0, 0, 0, 2)), sample(2, UNKNOWN_QUAT), sample(1, array(0, 0, 0, 0))])
    assert (path.t_ns.tolist(), path.quat_xyzw.tolist()) == ([5], [[0, 0, 0, 1]])
    assert len(SpatialPath.of_poses([])) == 0
    blind = Trajectory.of([0, 1], np.array([[0, 0, np.nan], [1, 2, 0.5]]))
    np.testing.assert_allclose(SpatialPath.of_plane(blind).from_above().pose, [[1, 2, 0.5]])


# ------------------------------------------------------------------------------------ drift


def kitti_as_defined(
    estimate: list[Floats], truth: list[Floats], lengths: list[float], step: int
) -> tuple[float, float]:
    """The benchmark's definition, one segment after the other."""
    distance = [0.0]
    for a, b in pairwise(truth):
        distance.append(distance[-1] + float(np.linalg.norm(b[:3, 3] - a[:3, 3])))
    shifts, turns = [], []
    for first in range(0, len(truth), step):
        for length in lengths:
            last = next((i for i in range(first, len(truth)) if distance[i] > distance[first] + length), None)
            if last is None:
                continue
            moved_truth = np.linalg.inv(truth[first]) @ truth[last]
            moved = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(moved) @ moved_truth
            shifts.append(np.linalg.norm(error[:3, 3]) / length)
            cosine = 0.5 * (np.trace(error[:3, :3]) - 1)
            turns.append(math.acos(max(min(cosine, 1.0), -1.0)) / length)
    return float(np.mean(shifts)), float(np.mean(turns))


def test_drift_over_segments_is_the_benchmarks(tmp_path: Path) -> None:
    estimate, reference = associated(*flight(6, 900))
    lengths = [2.0, 4.0, 8.0, 500.0]
    found = segment_drift(estimate, reference, lengths_m=lengths, step=7)
    matrices = [as_evo(p, tmp_path / "p.tum").poses_se3 for p in (estimate, reference)]
    shift, turn = kitti_as_defined(*matrices, lengths, 7)
    assert found.drift == pytest.approx(shift, rel=1e-9)
    assert found.rad_per_m == pytest.approx(turn, rel=1e-6)
    assert [s.count > 0 for s in found.by_length] == [True, True, True, False]
    assert math.isnan(found.by_length[3].drift)
    assert found.count == sum(s.count for s in found.by_length)


def test_drift_of_a_scale_and_of_a_turn() -> None:
    t = np.arange(1000) * SECOND
    x = np.arange(1000) * 0.5
    still = np.tile([0.0, 0, 0, 1], (1000, 1))
    reference = SpatialPath.of(t, np.column_stack([x, 0 * x, 0 * x]), still)
    longer = SpatialPath.of(t, reference.position_m * 1.02, still)
    # the segment of 100 m ends at the first pose beyond it, at 100.5 m
    assert segment_drift(longer, reference, lengths_m=[100.0]).drift == pytest.approx(0.02 * 1.005)
    turning = SpatialPath.of(t, reference.position_m, Rotation.from_rotvec(np.outer(0.001 * x, [0, 0, 1])).as_quat())
    assert segment_drift(turning, reference, lengths_m=[100.0]).rad_per_m == pytest.approx(0.001 * 1.005)
    short = segment_drift(longer.at(np.arange(50)), reference.at(np.arange(50)))
    assert (short.count, math.isnan(short.drift)) == (0, True)
    with pytest.raises(ValueError, match="step"):
        segment_drift(longer, reference, step=0)


# ------------------------------------------------------------------------------ consistency


def test_consistency_of_right_and_of_overconfident_covariances() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[2.0, 0.3, 0], [0.3, 1.0, 0.1], [0, 0.1, 0.5]])
    error = rng.multivariate_normal(np.zeros(3), covariance, 500)
    squared = nees_of(error, np.tile(covariance, (500, 1, 1)))
    np.testing.assert_allclose(squared[7], error[7] @ np.linalg.inv(covariance) @ error[7])
    right = Consistency.of(np.append(squared, np.nan), 3)
    assert (right.consistent, right.count, right.expected) == (True, 500, 3.0)
    assert (right.low, right.high) == band(3, 500)
    assert band(3, 500) == pytest.approx((chi2.ppf(0.025, 1500) / 500, chi2.ppf(0.975, 1500) / 500), rel=1e-12)
    proud = Consistency.of(nees_of(error, np.tile(covariance / 2, (500, 1, 1))), 3)
    assert not proud.consistent
    assert proud.ratio == pytest.approx(2 * right.ratio)
    none = Consistency.of(np.array([np.nan]), 3)
    assert (none.count, none.consistent, math.isnan(none.low)) == (0, False, True)
