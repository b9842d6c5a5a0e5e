"""Backward replay and revisits of a place: what a mission says of its own drift."""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.revisit import ImageMotions
from pipelines.correlation.settings import CorrelationSettings
from pipelines.drift import drift_budget
from pipelines.evaluation import Trajectory, motions
from pipelines.replay import replay
from pipelines.self_consistency import (
    Loop,
    Reversed,
    Revisit,
    close_loops,
    forward_backward,
    in_forward_time,
    revisits,
    suspects,
)
from pipelines.simulation.mission import SimulatedMission
from readers.streams import (
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    ImuSample,
    OdometrySample,
    Recording,
    Sample,
    ScalarSample,
    StreamError,
    StreamInfo,
    array,
)
from workbench import scenarios

Floats = NDArray[np.float64]
IMAGES = "/camera/image_raw"
SMALL = ("ground.size_px=1024", "camera.width_px=160", "camera.height_px=120", "camera.focal_px=100")
EIGHT = ("trajectory.parameters={length_m=1.2,width_m=0.6}", "trajectory.profile=constant", "trajectory.speed_kmh=7.2")


@cache
def eight(*overrides: str) -> SimulatedMission:
    """Twice round a small figure eight, so that every place is come back to."""
    return scenarios.mission(scenarios.load("figure-eight", overrides=[*SMALL, *EIGHT, *overrides]))


def settings(mission: SimulatedMission) -> CorrelationSettings:
    given = {"metres_per_px": mission.metres_per_px, "start_pose": tuple(mission.truth_poses[0])}
    return CorrelationSettings.model_validate(CorrelationSettings.preset("best").model_dump() | given)


def odometry(recording: Recording, chosen: CorrelationSettings) -> Trajectory:
    steps = [r.step for r in replay(recording, CorrelationOdometry(chosen), image_stream=IMAGES)]
    return Trajectory.of([s.t_ns for s in steps], np.array([s.pose for s in steps]))  # type: ignore[attr-defined]


def with_error(poses: Floats, k: int, error: Floats) -> Floats:
    """Poses with an error [3] in the increment to pose k."""
    rows = np.arange(len(poses))
    steps = motions(poses, rows[:-1], rows[1:])
    steps[k - 1] += error
    heading = poses[0, 2] + np.concatenate([[0], np.cumsum(steps[:, 2])])
    place = np.cumsum((steps[:, 0] + 1j * steps[:, 1]) * np.exp(1j * heading[:-1]))
    place = poses[0, 0] + 1j * poses[0, 1] + np.concatenate([[0], place])
    return np.column_stack([place.real, place.imag, heading])


# ------------------------------------------------------------------------- a recording backward


class Log(Recording):
    """A recording of the samples that it is given."""

    path, format = Path("log"), "samples"

    def __init__(self, *samples: Sample) -> None:
        self._samples = sorted(samples, key=lambda s: s.t_ns)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        return ()

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        low, high = -(2**62) if start_ns is None else start_ns, 2**62 if stop_ns is None else stop_ns
        for sample in self._samples:
            if (streams is None or sample.stream in streams) and low <= sample.t_ns < high:
                yield sample


def number(stream: str, t_ns: int, value: float) -> ScalarSample:
    return ScalarSample(stream=stream, t_ns=t_ns, received_ns=t_ns + 1, value=value)


def test_time_runs_backward_within_a_half_open_range() -> None:
    log = Log(*(number("/a", t, t) for t in range(0, 1000, 3)), number("/b", 500, -1))
    back = Reversed(log, ["/a", "/b"])
    assert back.pivot_ns == 999
    samples = list(back.read())
    assert [s.t_ns for s in samples] == sorted(s.t_ns for s in samples)
    assert [s.value for s in samples if s.stream == "/a"] == [float(t) for t in range(999, -1, -3)]  # type: ignore[attr-defined]
    assert all(s.t_ns == 1998 - (500 if s.stream == "/b" else s.value) for s in samples)  # type: ignore[attr-defined]
    assert {s.received_ns for s in samples if s.stream == "/b"} == {1998 - 501}
    assert [s.t_ns for s in back.read(["/a"], 999, 1005)] == [999, 1002]
    assert back.count_before("/a", 1005) == 2
    window = Reversed(log, ["/a"], start_ns=30, stop_ns=36)
    assert [(s.t_ns, s.value) for s in window.read()] == [(33, 33.0), (36, 30.0)]  # type: ignore[attr-defined]
    with pytest.raises(StreamError, match="was not prepared"):
        list(back.read(["/c"]))
    with pytest.raises(StreamError, match="no sample of /a"):
        Reversed(log, ["/a"], start_ns=2000)


def test_held_values_hold_for_the_same_frames_both_ways() -> None:
    frames = [number("/frame", t, t) for t in (5, 10, 15, 20, 25, 40)]
    heights = [number("/height", t, t) for t in (0, 10, 17, 30)]

    def seen(recording: Recording) -> dict[float, float]:
        latest, result = float("nan"), {}
        for sample in recording.read():
            assert isinstance(sample, ScalarSample)
            if sample.stream == "/height":
                latest = sample.value
            else:
                result[sample.value] = latest
        return result

    forward = seen(Log(*heights, *frames))
    assert forward == {5: 0, 10: 10, 15: 10, 20: 17, 25: 17, 40: 30}
    assert seen(Reversed(Log(*heights, *frames), ["/frame", "/height"], held=["/height"])) == forward


def test_velocities_turn_round_and_accelerations_stay() -> None:
    odometry = OdometrySample(
        stream="/o",
        t_ns=0,
        received_ns=0,
        linear_velocity_mps=array(1, 2, 3),
        angular_velocity_radps=array(0, 0, 1),
        position_m=UNKNOWN_VEC3,
        quat_xyzw=UNKNOWN_QUAT,
    )
    imu = ImuSample(
        stream="/i",
        t_ns=5,
        received_ns=5,
        angular_velocity_radps=array(0, 0, 2),
        linear_acceleration_mps2=array(1, 0, 9.8),
        quat_xyzw=UNKNOWN_QUAT,
    )
    first, second = Reversed(Log(odometry, imu), ["/o", "/i"]).read()
    assert isinstance(first, ImuSample)
    assert isinstance(second, OdometrySample)
    assert first.angular_velocity_radps.tolist() == [0, 0, -2]
    assert first.linear_acceleration_mps2.tolist() == [1, 0, 9.8]
    assert second.linear_velocity_mps.tolist() == [-1, -2, -3]
    assert second.angular_velocity_radps.tolist() == [0, 0, -1]


# ---------------------------------------------------------------------------- backward replay


def test_forward_and_backward_agree_on_a_clean_mission_and_name_the_frame_of_an_error() -> None:
    mission = eight("frames=40")
    chosen = settings(mission)
    forward = odometry(mission, chosen)
    back = Reversed(mission, [IMAGES])
    backward = odometry(back, chosen)
    clean = forward_backward(forward, backward, back.pivot_ns)
    assert len(clean.index) == 39
    assert np.abs(clean.increment_error[:, :2]).max() < 0.02 * mission.metres_per_px * 5
    assert np.hypot(*clean.end_error_m) < 1e-3
    jumped = Trajectory(forward.t_ns, with_error(forward.pose, 23, np.array([0.0, 0.01, 0.0])))
    found = forward_backward(jumped, backward, back.pivot_ns)
    assert found.index[found.ranked()[0]] == 23
    assert found.increment_error[22, 1] == pytest.approx(0.01, abs=1e-4)
    assert found.residual_m < 1e-9
    turned = in_forward_time(backward, back.pivot_ns)
    np.testing.assert_array_equal(turned.t_ns, forward.t_ns)


def test_disagreement_tells_of_true_errors() -> None:
    rng = np.random.default_rng(0)
    poses = eight().truth_poses
    t = eight().truth_t_ns
    noise = rng.normal(0, 1e-5, (len(poses), 3))
    truth = Trajectory(t, poses)
    forward = Trajectory(t, with_error(poses + np.cumsum(noise, axis=0), 70, np.array([0.03, 0, 0])))
    backward = Trajectory(2 * 10**18 - t[::-1], poses[::-1])
    ours = forward_backward(forward, backward, 10**18)
    np.testing.assert_allclose(ours.contribution_m, drift_budget(forward, truth).contribution_m, atol=1e-12)


# ------------------------------------------------------------------------------------ revisits


def test_revisits_are_close_in_place_and_far_along_the_path() -> None:
    mission = eight()
    path = Trajectory(mission.truth_t_ns, mission.truth_poses)
    found = revisits(path, within_m=0.1, loop_m=1.0, at_most=1000)
    assert len(found) > 10
    for pair in found:
        a, b = path.pose[[pair.first, pair.second]]
        assert pair.first < pair.second
        assert np.hypot(*(a - b)[:2]) == pytest.approx(pair.apart_m)
        assert pair.apart_m <= 0.1
        assert pair.loop_m >= 1.0
        assert a[2] + pair.expected[2] - b[2] == pytest.approx(2 * np.pi * round((a[2] - b[2]) / (2 * np.pi)), abs=1e-6)
    assert [p.apart_m for p in found] == sorted(p.apart_m for p in found)
    assert any(abs(p.expected[2]) > 1 for p in found)  # the crossing of the eight
    along = revisits(path, within_m=0.1, loop_m=1.0, turn_rad=0.3, at_most=1000)
    assert 0 < len(along) < len(found)
    assert max(abs(p.expected[2]) for p in along) <= 0.3
    assert [p.first for p in revisits(path, within_m=0.1, loop_m=1.0, at_most=3)] == [p.first for p in found[:3]]
    assert revisits(path, within_m=0.1, loop_m=1000.0) == []
    assert revisits(Trajectory.of([], np.zeros((0, 3))), within_m=1, loop_m=1) == []
    with pytest.raises(ValueError, match="positive"):
        revisits(path, within_m=0, loop_m=1)
    with pytest.raises(ValueError, match="heading"):
        revisits(Trajectory.of(path.t_ns, path.pose[:, :2]), within_m=1, loop_m=1)


def test_standing_still_gives_one_revisit_and_not_thousands() -> None:
    x = np.concatenate([np.linspace(0, 5, 200), np.full(3000, 5.0), np.linspace(5, 0, 200), np.zeros(3000)])
    path = Trajectory(np.arange(len(x)) * 10, np.column_stack([x, 0 * x, 0 * x]))
    found = revisits(path, within_m=0.5, loop_m=3.0, at_most=1000)
    assert 3 < len(found) < 40


@pytest.mark.parametrize("mounting_yaw_rad", [0.0, 0.7])
def test_loops_measure_the_drift_of_the_chain_and_bracket_its_source(mounting_yaw_rad: float) -> None:
    mission = eight()
    chosen = settings(mission).model_copy(update={"mounting_yaw_rad": mounting_yaw_rad})
    turned = mission.truth_poses - np.array([0, 0, mounting_yaw_rad])  # the body's heading is the camera's less its yaw
    error = np.array([0.05, 0.0, 0.02])
    path = Trajectory(mission.truth_t_ns, with_error(turned, 101, error))
    measure = ImageMotions(chosen, grey_of=mission.frame, metres_per_px=lambda k: mission.metres_per_px)
    found = revisits(path, within_m=0.15, loop_m=1.0, at_most=40)
    loops = close_loops(found, measure)
    assert len(loops) >= 20
    for loop in loops:
        first, second = loop.revisit.first, loop.revisit.second
        truth = motions(turned, np.array([first]), np.array([second]))[0]
        np.testing.assert_allclose(loop.measured[:2], truth[:2], atol=2e-4)
        assert abs(np.angle(np.exp(1j * (loop.measured[2] - truth[2])))) < 1e-3
        over = first <= 100 and second >= 101
        assert (loop.drift_m > 0.03) == over
        assert loop.drift[2] == pytest.approx(0.02 if over else 0.0, abs=1e-3)
        assert loop.share == pytest.approx(loop.drift_m / loop.revisit.loop_m)
    worst = suspects(loops)[0]
    assert worst.start <= 100 < worst.stop
    assert worst.stop - worst.start < 60  # of 481
    assert worst.explained > 0.8


def test_a_place_that_looks_otherwise_is_not_measured() -> None:
    mission = eight()
    measure = ImageMotions(settings(mission), grey_of=mission.frame, metres_per_px=lambda k: mission.metres_per_px)
    assert measure(0, 60, np.zeros(3)) is None
    pair = Revisit(first=0, second=60, loop_m=2.0, apart_m=0.0, expected=np.zeros(3))
    assert close_loops([pair], measure) == []
    sizes = ImageMotions(
        settings(mission), grey_of=lambda k: mission.frame(0)[: 120 - k], metres_per_px=lambda k: mission.metres_per_px
    )
    assert sizes(0, 20, np.zeros(3)) is None


def test_a_wrong_expectation_is_mended_by_the_global_search() -> None:
    mission = eight()
    measure = ImageMotions(settings(mission), grey_of=mission.frame, metres_per_px=lambda k: mission.metres_per_px)
    (truth,) = motions(mission.truth_poses, np.array([10]), np.array([12]))
    found = measure(10, 12, truth + array(0.0, 0.06, 0.05))
    assert found is not None
    np.testing.assert_allclose(found, truth, atol=5e-4)


def test_images_and_bodies_move_the_inverse_ways() -> None:
    measure = ImageMotions(
        CorrelationSettings(metres_per_px=0.01, mounting_yaw_rad=0.4), grey_of=lambda k: np.empty((0, 0), np.uint8),
        metres_per_px=lambda k: 0.01,
    )  # fmt: skip
    pose = np.array([0.3, -0.2, 1.1])
    np.testing.assert_allclose(measure.pose_of(measure.motion_of(pose, 0.01), 0.01), pose, atol=1e-12)
    ahead = measure.motion_of(np.array([0.5, 0.0, 0.0]), 0.01)
    assert (ahead.u, ahead.v) == pytest.approx((-50 * np.cos(0.4), -50 * np.sin(0.4)))


def loop(first: int, second: int, drift_m: float) -> Loop:
    revisit = Revisit(first=first, second=second, loop_m=1.0, apart_m=0.0, expected=np.zeros(3))
    return Loop(revisit=revisit, measured=np.zeros(3), drift=np.array([drift_m, 0, 0]))


def test_suspects_are_what_all_bad_loops_and_no_good_one_go_over() -> None:
    loops = [loop(0, 50, 0.3), loop(20, 90, 0.31), loop(0, 30, 0.0), loop(40, 90, 0.01)]
    worst = suspects(loops)[0]
    assert (worst.start, worst.stop, worst.loops) == (30, 40, 2)
    assert worst.explained > 0.99
    assert worst.mean_m == pytest.approx(0.305)
    assert suspects([]) == []
    assert suspects([loop(0, 5, 0.0)]) == []
