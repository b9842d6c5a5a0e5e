"""The simulated sensors: what they measure is the motion, with errors of the stated size and no others."""

import functools
import itertools
import math
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.signal
from pydantic import BaseModel, ConfigDict, ValidationError
from scipy.spatial.transform import Rotation

from pipelines.geometry import earth_centred, from_local_enu, geodetic, heading_of_quat, local_enu
from pipelines.lens import pinhole
from pipelines.simulation import faults as wrong
from pipelines.simulation import sensors as on_board
from pipelines.simulation.channels import Channel
from pipelines.simulation.motion import FORWARD, Kinematics, Mount, Waypoints, looking, rotations
from pipelines.simulation.noise import in_ticks, random_walk, white
from pipelines.simulation.sensors import Gnss, Height, Imu, Odometer, Reference, Tracks
from pipelines.simulation.timing import Schedule, Timing, schedule
from readers.clock import StreamAudit
from readers.streams import Camera, Sample

START_NS = 1_700_000_000_123_456_789
G = 9.80665
GEO = ("latitude_rad", "longitude_rad", "altitude_m")
PLAN = {"start_ns": START_NS, "seed": 4}
QUIET_IMU = {"gyro_density": 0.0, "force_density": 0.0, "sampling": "instant"}
QUIET_WHEELS = {"speed_density": 0.0, "turn_density": 0.0, "sampling": "instant"}


class Round:
    """A drive on a circle with an angle φ = a t + b sin(c t): speed R φ', everything in closed form."""

    def __init__(self, duration_s: float = 8.0, radius_m: float = 3.0, a: float = 0.5, b: float = 0.0, c: float = 1.3):
        self.duration_s, self.radius_m, self.a, self.b, self.c = duration_s, radius_m, a, b, c

    def at(self, t_s: np.ndarray) -> Kinematics:
        t = np.asarray(t_s, dtype=float)
        turn = self.a * t + self.b * np.sin(self.c * t)
        rate, change = self.a + self.b * self.c * np.cos(self.c * t), -self.b * self.c**2 * np.sin(self.c * t)
        zero = np.zeros_like(t)
        along = np.column_stack([np.cos(turn), np.sin(turn), zero])
        left = np.column_stack([-np.sin(turn), np.cos(turn), zero])
        return Kinematics(
            t_s=t,
            position_m=self.radius_m * np.column_stack([np.sin(turn), 1 - np.cos(turn), zero + 0.1]),
            world_r_body=rotations(turn, zero, zero),
            velocity_mps=self.radius_m * rate[:, None] * along,
            acceleration_mps2=self.radius_m * (change[:, None] * along + rate[:, None] ** 2 * left),
            angular_velocity_radps=np.column_stack([zero, zero, rate]),
            angular_acceleration_radps2=np.column_stack([zero, zero, change]),
            heading_rad=turn,
        )


class Weave:
    """A drive along x = a t, y = b sin(c t), its heading along the way."""

    duration_s = 7.0

    def at(self, t_s: np.ndarray) -> Kinematics:
        t, zero = np.asarray(t_s, dtype=float), np.zeros(len(t_s))
        a, b, c = 0.8, 0.6, 1.1
        vy, ay, jerk = b * c * np.cos(c * t), -b * c**2 * np.sin(c * t), -b * c**3 * np.cos(c * t)
        heading, square = np.arctan2(vy, a), a**2 + vy**2
        rate = a * ay / square
        change = a * jerk / square - 2 * rate * vy * ay / square
        return Kinematics(
            t_s=t,
            position_m=np.column_stack([a * t, b * np.sin(c * t), zero]),
            world_r_body=rotations(heading, zero, zero),
            velocity_mps=np.column_stack([zero + a, vy, zero]),
            acceleration_mps2=np.column_stack([zero, ay, zero]),
            angular_velocity_radps=np.column_stack([zero, zero, rate]),
            angular_acceleration_radps2=np.column_stack([zero, zero, change]),
            heading_rad=heading,
        )


class Tumble:
    """A body that turns at a constant rate about a skew axis while its origin swings in space."""

    duration_s = 6.0
    rate = np.array([0.3, -0.5, 0.4])
    size, pace = np.array([1.0, 0.7, 0.2]), np.array([0.9, 1.4, 2.1])

    def at(self, t_s: np.ndarray) -> Kinematics:
        t = np.asarray(t_s, dtype=float)[:, None]
        turn = Rotation.from_rotvec(t * self.rate).as_matrix()
        return Kinematics(
            t_s=t[:, 0],
            position_m=self.size * np.sin(self.pace * t),
            world_r_body=turn,
            velocity_mps=self.size * self.pace * np.cos(self.pace * t),
            acceleration_mps2=-self.size * self.pace**2 * np.sin(self.pace * t),
            angular_velocity_radps=np.tile(self.rate, (len(t), 1)),
            angular_acceleration_radps2=np.zeros((len(t), 3)),
            heading_rad=np.unwrap(np.arctan2(turn[:, 1, 0], turn[:, 0, 0])),
        )


def standing(duration_s: float = 10.0, *, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Waypoints:
    return Waypoints(np.array([0, duration_s]), np.zeros((2, 3)), 0.2, roll_rad, pitch_rad)


def straight(duration_s: float = 10.0, speed_mps: float = 2.0) -> Waypoints:
    return Waypoints(np.array([0, duration_s]), np.array([[0, 0, 0], [speed_mps * duration_s, 0, 0]]), 0.2)


def samples(channel: Channel) -> list[Any]:
    columns = (channel.number.tolist(), channel.stamp_ns.tolist(), channel.received_ns.tolist())
    return [channel.sample(*message) for message in zip(*columns, strict=True)]


def column(found: Iterable[Sample], name: str) -> np.ndarray:
    return np.array([getattr(sample, name) for sample in found])


def times_s(found: Iterable[Sample]) -> np.ndarray:
    return (column(found, "t_ns") - START_NS) / 1e9


def imu(motion: Any, faults: Iterable[wrong.Fault] = (), seed: int = 4, **settings: Any) -> list[Any]:
    return samples(on_board.imu_channel(motion, Imu(**settings), start_ns=START_NS, seed=seed, faults=tuple(faults)))


def wheels(motion: Any, faults: Iterable[wrong.Fault] = (), seed: int = 4, **settings: Any) -> list[Any]:
    sensor = Odometer(**settings)
    return samples(on_board.odometer_channel(motion, sensor, start_ns=START_NS, seed=seed, faults=tuple(faults)))


# ---------------------------------------------------------------------------------- timing


def planned(duration_s: float = 1000.0, faults: Iterable[wrong.Fault] = (), seed: int = 1, **timing: Any) -> Schedule:
    settings = {"rate_hz": 20.0} | timing
    return schedule(
        Timing(**settings), duration_s=duration_s, start_ns=START_NS, seed=seed, stream="/s", faults=tuple(faults)
    )


def test_a_perfect_sensor_is_exact_in_whole_nanoseconds() -> None:
    plan = planned(3.0, rate_hz=60.0, start_s=0.5)
    assert len(plan.t_s) == 151
    assert plan.number.tolist() == list(range(151))
    expected = [START_NS + 500_000_000 + round(k * 1_000_000_000 / 60) for k in range(151)]
    assert plan.stamp_ns.tolist() == plan.received_ns.tolist() == expected
    assert plan.stamp_ns.dtype == plan.received_ns.dtype == plan.number.dtype == np.int64
    np.testing.assert_array_equal(plan.t_s, 0.5 + np.arange(151) / 60)


@pytest.mark.parametrize("rate_hz", [3.0, 7.0, 60.0, 1000 / 3])
@pytest.mark.parametrize("n", [1, 2, 100, 2111])
def test_a_mission_of_n_frames_has_n_frames(rate_hz: float, n: int) -> None:
    duration_s = (n - 1) / rate_hz
    assert len(planned(duration_s, rate_hz=rate_hz).t_s) == n
    assert planned(duration_s, rate_hz=rate_hz).t_s.max() <= duration_s
    assert len(planned(duration_s + 0.9 / rate_hz, rate_hz=rate_hz).t_s) == n


def test_the_last_measurement_is_at_the_end_whatever_the_last_digit() -> None:
    assert (1 / 49) * 49 < 1
    assert planned(1 / 49, rate_hz=49.0).t_s.tolist() == [0, 1 / 49]
    assert 0.1 + 2 / 10 > 0.3
    assert planned(0.3, rate_hz=10.0, start_s=0.1).t_s.tolist() == [0.1, 0.2, 0.3]


def test_latency_and_its_jitter() -> None:
    steady = planned(latency_s=0.25)
    assert np.all(steady.received_ns - steady.stamp_ns == 250_000_000)
    shaky = planned(4000.0, rate_hz=5.0, latency_s=0.25, latency_jitter_s=0.01)
    delay = (shaky.received_ns - shaky.stamp_ns) / 1e9 - 0.25
    assert delay.min() >= -1e-9
    assert delay.mean() == pytest.approx(0.01, rel=5 / math.sqrt(20000))
    assert delay.std() == pytest.approx(0.01, rel=0.05)
    assert np.array_equal(shaky.stamp_ns, planned(4000.0, rate_hz=5.0).stamp_ns)


def test_messages_queue_behind_a_late_one() -> None:
    plan = planned(latency_jitter_s=0.2)  # four times the interval
    assert np.all(np.diff(plan.received_ns) >= 1)
    assert np.array_equal(plan.number, np.arange(20001))
    assert np.all(plan.received_ns >= plan.stamp_ns)
    assert np.mean(np.diff(plan.received_ns) < 1000) > 0.3  # many come right behind the one ahead


def test_drops_and_duplicates_have_their_shares() -> None:
    n = 20001
    dropped = planned(drop_share=0.2)
    assert 1 - len(dropped.number) / n == pytest.approx(0.2, abs=5 * math.sqrt(0.2 * 0.8 / n))
    assert np.all(np.diff(dropped.number) >= 1)
    assert len(planned(drop_share=1.0).number) == 0
    twice = planned(duplicate_share=0.1)
    repeats = np.diff(twice.number) == 0
    assert np.mean(repeats) * len(twice.number) / n == pytest.approx(0.1, abs=5 * math.sqrt(0.09 / n))
    assert np.array_equal(np.diff(twice.stamp_ns) == 0, repeats)
    assert np.all(np.diff(twice.received_ns)[repeats] == 1)
    audit = audited(twice)
    assert audit.counts == {"duplicate_stamp": np.sum(repeats)}
    assert len(planned(duplicate_share=1.0).number) == 2 * n


def test_clock_offset_and_drift() -> None:
    plan = planned(clock_offset_s=-0.125, clock_drift_ppm=40.0)
    lead_ns = plan.stamp_ns - planned().stamp_ns
    slope, offset = np.polyfit(plan.t_s, lead_ns, 1)
    assert slope / 1e3 == pytest.approx(40.0, abs=1e-4)
    assert offset / 1e9 == pytest.approx(-0.125, abs=1e-9)
    assert lead_ns[-1] == -125_000_000 + 40_000_000
    assert np.array_equal(plan.received_ns, planned().received_ns)


def test_stamp_jitter() -> None:
    jitter = (planned(stamp_jitter_s=0.003).stamp_ns - planned().stamp_ns) / 1e9
    assert jitter.std() == pytest.approx(0.003, rel=0.03)
    assert abs(jitter.mean()) < 5 * 0.003 / math.sqrt(len(jitter))
    assert abs(np.corrcoef(jitter[1:], jitter[:-1])[0, 1]) < 5 / math.sqrt(len(jitter))


def audited(plan: Schedule) -> StreamAudit:
    audit = StreamAudit("/s")
    for t_ns, received_ns in zip(plan.stamp_ns.tolist(), plan.received_ns.tolist(), strict=True):
        audit.add(Sample(stream="/s", t_ns=t_ns, received_ns=received_ns))
    return audit


def test_disorder_is_what_an_audit_counts() -> None:
    n = 20001
    plan = planned(disorder_share=0.1)
    audit = audited(plan)
    assert set(audit.counts) == {"out_of_order"}
    assert audit.counts["out_of_order"] / n == pytest.approx(0.1, abs=5 * math.sqrt(0.1 / n))
    assert np.all(np.diff(plan.received_ns) > 0)
    assert np.array_equal(np.sort(plan.stamp_ns), planned().stamp_ns)
    assert np.array_equal(plan.stamp_ns, planned().stamp_ns[plan.number])  # a message keeps its own stamp
    assert audited(planned(disorder_share=0.5)).counts["out_of_order"] == n // 2
    assert not audited(planned()).counts


def test_one_disturbance_does_not_change_another() -> None:
    both = planned(drop_share=0.2, latency_jitter_s=0.001, stamp_jitter_s=0.001, duplicate_share=0.1)
    assert np.array_equal(np.unique(both.number), planned(drop_share=0.2).number)
    jittered = planned(stamp_jitter_s=0.001).stamp_ns
    assert np.array_equal(both.stamp_ns, jittered[both.number])


def test_schedules_are_seeded() -> None:
    options = {"drop_share": 0.1, "latency_jitter_s": 0.01, "stamp_jitter_s": 0.01, "disorder_share": 0.1}
    one, again, other = planned(**options), planned(**options), planned(seed=2, **options)
    for name in ("number", "stamp_ns", "received_ns"):
        assert np.array_equal(getattr(one, name), getattr(again, name))
        assert len(getattr(one, name)) != len(getattr(other, name)) or np.any(
            getattr(one, name) != getattr(other, name)
        )
        with pytest.raises(ValueError, match="read-only"):
            getattr(one, name)[0] = 0


BAD_TIMING = [
    {"rate_hz": -5.0},
    {"rate_hz": 0.0},
    {"rate_hz": math.nan},
    {"rate_hz": math.inf},
    {"start_s": -1.0},
    {"latency_s": -0.1},
    {"latency_jitter_s": -0.1},
    {"stamp_jitter_s": -0.1},
    {"drop_share": 1.1},
    {"drop_share": -0.1},
    {"duplicate_share": 2.0},
    {"disorder_share": 0.6},
    {"clock_offset_s": math.inf},
    {"clock_drift_ppm": math.nan},
]


@pytest.mark.parametrize("bad", BAD_TIMING, ids=str)
def test_a_bad_timing_is_named(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"Timing: {next(iter(bad))} is "):
        Timing(**({"rate_hz": 10.0} | bad))


def test_a_sensor_that_starts_after_the_mission_is_refused() -> None:
    with pytest.raises(ValueError, match=r"start_s is 5\.0"):
        planned(3.0, start_s=5.0)


# ---- faults of the images' transport


def test_dropped_and_duplicate_frames() -> None:
    plan = planned(
        1.0,
        [wrong.DroppedFrames(start_s=0.15, stop_s=0.25), wrong.DuplicateFrames(start_s=0.4, stop_s=0.6)],
    )
    clean = planned(1.0)
    assert plan.number.tolist() == [0, 1, 2, 5, 6, 7, 7, 7, 7, 7, *range(12, 21)]
    assert plan.stamp_ns.tolist() == np.delete(clean.stamp_ns, [3, 4]).tolist()
    assert np.array_equal(plan.stamp_ns, plan.received_ns)


def test_a_repeat_shows_what_was_sent_before_it() -> None:
    after_a_gap = [wrong.DroppedFrames(start_s=0.1, stop_s=0.2), wrong.DuplicateFrames(start_s=0.2, stop_s=0.3)]
    assert planned(0.4, after_a_gap).number.tolist() == [0, 1, 1, 1, 6, 7, 8]
    chained = [wrong.DuplicateFrames(start_s=0.1, stop_s=0.2), wrong.DuplicateFrames(start_s=0.2, stop_s=0.3)]
    assert planned(0.4, chained).number.tolist() == [0, 1, 1, 1, 1, 1, 6, 7, 8]
    assert planned(0.2, [wrong.DuplicateFrames(start_s=0.0, stop_s=0.1)]).number.tolist() == [0, 0, 2, 3, 4]


def test_late_images_come_and_are_stamped_late() -> None:
    late = planned(1.0, [wrong.LateImages(start_s=0.5, stop_s=0.7, latency_s=0.08)], latency_s=0.01)
    held = (late.t_s >= 0.5) & (late.t_s < 0.7)
    shift = late.stamp_ns - planned(1.0).stamp_ns
    assert held.sum() == 4
    assert np.array_equal(shift, np.where(held, 80_000_000, 0))
    assert late.received_ns[held].tolist() == (late.stamp_ns[held] + 10_000_000).tolist()
    assert np.all(np.diff(late.received_ns) > 0)
    assert audited(late).counts["out_of_order"] == 1  # the first image after the fault


def test_swapped_stamps() -> None:
    swapped = planned(1.0, [wrong.SwappedStamps(start_s=0.2, stop_s=0.45)])  # five images: two pairs
    order = list(range(21))
    order[4:8] = [5, 4, 7, 6]
    assert swapped.stamp_ns.tolist() == planned(1.0).stamp_ns[order].tolist()
    assert swapped.number.tolist() == list(range(21))
    assert np.array_equal(swapped.received_ns, planned(1.0).received_ns)


# ----------------------------------------------------------------------------------- noise


@pytest.mark.parametrize("rate_hz", [50.0, 200.0])
def test_white_noise_has_its_density_at_any_rate(rate_hz: float) -> None:
    noise = white(np.random.default_rng(0), (40000, 2), 0.03, rate_hz)
    assert noise.std() == pytest.approx(0.03 * math.sqrt(rate_hz), rel=5 / math.sqrt(2 * 80000))
    _, spectrum = scipy.signal.welch(noise[:, 0], rate_hz, nperseg=256, detrend=False, return_onesided=False)
    assert np.mean(spectrum) == pytest.approx(0.03**2, rel=0.04)  # unit²/Hz, two-sided
    bands = np.mean(np.fft.fftshift(spectrum).reshape(8, -1), axis=1)
    assert np.max(np.abs(bands / np.mean(bands) - 1)) < 5 / math.sqrt(2 * 40000 / 256 * 32 / 2)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 5 / math.sqrt(len(noise))


@pytest.mark.parametrize("rate_hz", [10.0, 40.0])
def test_the_variance_of_a_random_walk_grows_with_time(rate_hz: float) -> None:
    walks = random_walk(np.random.default_rng(0), (401, 3000), 0.2, rate_hz)
    assert np.all(walks[0] == 0)
    t = np.arange(401) / rate_hz
    np.testing.assert_allclose(np.var(walks[1:], axis=1), 0.04 * t[1:], rtol=5 * math.sqrt(2 / 3000))
    steps = np.diff(walks, axis=0)
    assert abs(np.mean(steps[1:] * steps[:-1]) / np.var(steps)) < 5 / math.sqrt(steps.size)


def test_ticks_keep_the_way_and_are_whole() -> None:
    speeds = np.abs(np.random.default_rng(1).normal(0.5, 0.3, (2000, 2))) - 0.2
    told = in_ticks(np.random.default_rng(0), speeds, 0.01, 50.0)
    counts = told / (0.01 * 50)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    way, told_way = np.cumsum(speeds, axis=0) / 50, np.cumsum(told, axis=0) / 50
    error = way - told_way
    assert np.max(np.abs(error)) <= 0.01
    np.testing.assert_allclose(np.ptp(error, axis=0), 0.01, rtol=0.01)  # the remainder takes every value
    assert not np.allclose(told, speeds, atol=0.1)


# ------------------------------------------------------------------------------------- IMU


def test_a_standing_imu_feels_gravity_upwards() -> None:
    for sample in imu(standing(0.1), **QUIET_IMU):
        np.testing.assert_allclose(sample.linear_acceleration_mps2, [0, 0, G], atol=1e-12)
        np.testing.assert_allclose(sample.angular_velocity_radps, 0, atol=1e-12)
        assert np.all(np.isnan(sample.quat_xyzw))


def test_a_tilted_imu_feels_gravity_where_up_is() -> None:
    nose_down = imu(standing(0.1, pitch_rad=0.3), **QUIET_IMU)[0].linear_acceleration_mps2
    left_up = imu(standing(0.1, roll_rad=0.3), **QUIET_IMU)[0].linear_acceleration_mps2
    on_its_side = imu(standing(0.1), yaw_pitch_roll_rad=(0, 0, math.pi / 2), **QUIET_IMU)[0].linear_acceleration_mps2
    np.testing.assert_allclose(nose_down, [-G * math.sin(0.3), 0, G * math.cos(0.3)], atol=1e-12)
    np.testing.assert_allclose(left_up, [0, G * math.sin(0.3), G * math.cos(0.3)], atol=1e-12)
    np.testing.assert_allclose(on_its_side, [0, G, 0], atol=1e-12)  # its y points up


def test_centripetal_and_tangential_acceleration_at_a_lever_arm() -> None:
    motion, lever = Round(b=0.2), np.array([0.4, -0.3, 0.7])
    found = imu(motion, position_m=tuple(lever), **QUIET_IMU)
    t = times_s(found)
    rate, change = 0.5 + 0.26 * np.cos(1.3 * t), -0.2 * 1.69 * np.sin(1.3 * t)
    forward = 3 * change - rate**2 * lever[0] - change * lever[1]
    left = 3 * rate**2 + change * lever[0] - rate**2 * lever[1]
    expected = np.column_stack([forward, left, np.full_like(t, G)])
    np.testing.assert_allclose(column(found, "linear_acceleration_mps2"), expected, atol=1e-7)  # stamps: 1e-9 s
    np.testing.assert_allclose(column(found, "angular_velocity_radps")[:, 2], rate, atol=1e-8)


def strapdown(found: list[Any], start: Kinematics, world_r_imu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Attitude and position at the end, by trapezoids, of IMU samples from a known start."""
    t = times_s(found)
    rates, forces = column(found, "angular_velocity_radps"), column(found, "linear_acceleration_mps2")
    turn, place, speed = Rotation.from_matrix(world_r_imu), start.position_m[0], start.velocity_mps[0]
    pull = turn.apply(forces[0]) - [0, 0, G]
    for k, dt in enumerate(np.diff(t)):
        turn = turn * Rotation.from_rotvec(dt * (rates[k] + rates[k + 1]) / 2)
        ahead = turn.apply(forces[k + 1]) - [0, 0, G]
        faster = speed + dt * (pull + ahead) / 2
        place = place + dt * (speed + faster) / 2
        pull, speed = ahead, faster
    return turn.as_matrix(), place


@pytest.mark.parametrize("sampling", ["mean", "instant"])
@pytest.mark.parametrize("motion", [Round(b=0.3), Weave(), Tumble()], ids=["round", "weave", "tumble"])
def test_imu_samples_integrate_to_the_truth_at_second_order(motion: Any, sampling: str) -> None:
    lever, angles = (0.3, -0.2, 0.5), (0.4, -0.3, 0.2)
    body_r_imu = looking(np.eye(3), yaw_rad=0.4, pitch_rad=-0.3, roll_rad=0.2)
    start, end = (motion.at(np.array([t])).at_point(np.array(lever)) for t in (0.0, motion.duration_s))
    errors = []
    for rate_hz in (50.0, 100.0):
        found = imu(motion, timing=Timing(rate_hz=rate_hz), position_m=lever, yaw_pitch_roll_rad=angles, **QUIET_IMU)
        turn, place = strapdown(found, start, start.world_r_body[0] @ body_r_imu)
        errors.append([np.abs(turn - end.world_r_body[0] @ body_r_imu).max(), np.abs(place - end.position_m[0]).max()])
    (turned, moved), (turned_fine, moved_fine) = errors
    assert moved < 5e-3
    assert moved / moved_fine == pytest.approx(4, rel=0.05)
    assert turned < 1e-12 or turned / turned_fine == pytest.approx(4, rel=0.05)


def test_a_mean_sample_is_the_mean_of_the_instants_in_its_interval() -> None:
    motion, lever = Round(b=0.4), (0.4, -0.3, 0.7)
    means = imu(motion, timing=Timing(rate_hz=4.0), position_m=lever, **QUIET_IMU | {"sampling": "mean"})
    fine = (np.arange(3200) + 0.5) / 400
    state = motion.at(fine).at_point(np.array(lever))
    for k, sample in enumerate(means):
        window = np.abs(fine - k / 4) < 0.125  # half as long at both ends
        assert window.sum() == (50 if k in (0, 32) else 100)
        here = motion.at(np.array([k / 4])).world_r_body[0]
        expected = here.T @ (state.acceleration_mps2[window].mean(axis=0) + np.array([0, 0, G]))
        np.testing.assert_allclose(sample.linear_acceleration_mps2, expected, atol=1e-4)
        expected = state.angular_velocity_radps[window].mean(axis=0)
        np.testing.assert_allclose(sample.angular_velocity_radps, expected, atol=1e-5)


def test_mean_samples_miss_nothing_of_a_jerky_drive() -> None:
    rng = np.random.default_rng(5)
    x, heading = np.cumsum(rng.uniform(0, 0.1, 241)), np.cumsum(rng.normal(0, 0.01, 241))
    jerky = Waypoints(np.arange(241) / 60, np.column_stack([x - x[0], 0 * x, 0 * x]))
    coarse = Timing(rate_hz=7.25)
    driven = wheels(jerky, timing=coarse, **QUIET_WHEELS | {"sampling": "mean"})[-1]
    np.testing.assert_allclose(driven.position_m, [x[-1] - x[0], 0, 0], atol=1e-12)
    felt = imu(jerky, timing=coarse, **QUIET_IMU | {"sampling": "mean"})
    pushes = np.trapezoid(column(felt, "linear_acceleration_mps2")[:, 0], np.arange(30) / 7.25)
    assert pushes == pytest.approx(-(x[1] - x[0]) * 60, abs=1e-9)  # it ends at rest
    turning = Waypoints(np.arange(241) / 60, np.column_stack([0 * x, 0 * x, heading]))
    turned = imu(turning, timing=coarse, **QUIET_IMU | {"sampling": "mean"})
    angle = np.trapezoid(column(turned, "angular_velocity_radps")[:, 2], np.arange(30) / 7.25)
    assert angle == pytest.approx(heading[-1] - heading[0], abs=1e-12)
    instants = wheels(jerky, timing=coarse, **QUIET_WHEELS)[-1]
    assert abs(instants.position_m[0] - driven.position_m[0]) > 0.05


def test_a_mission_of_one_moment_has_samples() -> None:
    moment = Waypoints(np.zeros(1), np.zeros((1, 3)))
    np.testing.assert_allclose(imu(moment, gyro_density=0.0, force_density=0.0)[0].linear_acceleration_mps2, [0, 0, G])


SEEDS = range(200)


def normalised(errors: np.ndarray, sigma: float) -> None:
    """The errors [n] are Gaussian of standard deviation sigma and mean 0: none too large, and not too small."""
    chi = errors / sigma
    n = len(chi)
    assert np.max(np.abs(chi)) < 4.2
    assert np.mean(chi**2) == pytest.approx(1, abs=5 * math.sqrt(2 / n))
    assert abs(np.mean(chi)) < 5 / math.sqrt(n)


def integrals(channel_of_seed: Any, name: str, axis: int, motion: Any) -> np.ndarray:
    found = [samples(channel_of_seed(seed)) for seed in SEEDS]
    values = np.array([column(run, name)[:, axis] for run in found])
    return np.trapezoid(values, times_s(found[0]), axis=1)


@pytest.mark.parametrize("rate_hz", [20.0, 80.0])
def test_integrated_gyro_noise_is_density_times_root_of_time(rate_hz: float) -> None:
    motion = Round(4.0)
    sensor = Imu(timing=Timing(rate_hz=rate_hz), gyro_density=2e-3)

    def channel(seed: int) -> Channel:
        return on_board.imu_channel(motion, sensor, start_ns=START_NS, seed=seed)

    heading = integrals(channel, "angular_velocity_radps", 2, motion)
    normalised(heading - 0.5 * 4.0, 2e-3 * math.sqrt(4.0 - 0.5 / rate_hz))  # the ends count half


def test_integrated_force_noise_is_density_times_root_of_time() -> None:
    sensor = Imu(timing=Timing(rate_hz=25.0), force_density=5e-3)
    rest = standing(4.0)

    def channel(seed: int) -> Channel:
        return on_board.imu_channel(rest, sensor, start_ns=START_NS, seed=seed)

    for axis, gravity in ((0, 0.0), (2, G)):
        speed = integrals(channel, "linear_acceleration_mps2", axis, rest)
        normalised(speed - 4 * gravity, 5e-3 * math.sqrt(3.98))


def test_bias_and_scale_of_the_imu() -> None:
    motion = Round()
    clean = imu(motion, **QUIET_IMU)
    bad = imu(
        motion,
        gyro_bias_radps=(0.01, 0.02, 0.03),
        gyro_scale=0.05,
        force_bias_mps2=(0.1, 0.2, 0.3),
        force_scale=-0.02,
        **QUIET_IMU,
    )
    for name, bias, scale in (
        ("angular_velocity_radps", [0.01, 0.02, 0.03], 0.05),
        ("linear_acceleration_mps2", [0.1, 0.2, 0.3], -0.02),
    ):
        np.testing.assert_allclose(column(bad, name), (1 + scale) * column(clean, name) + bias, atol=1e-12)


def test_the_walk_of_the_gyro_bias() -> None:
    ends = [imu(standing(5.0), seed=s, timing=Timing(rate_hz=5.0), gyro_density=0.0, gyro_walk=1e-3)[-1] for s in SEEDS]
    rates = column(ends, "angular_velocity_radps")
    normalised(rates.ravel(), 1e-3 * math.sqrt(5.0))
    ends = [
        imu(standing(5.0), seed=s, timing=Timing(rate_hz=5.0), force_density=0.0, force_walk=0.1)[-1] for s in SEEDS
    ]
    normalised((column(ends, "linear_acceleration_mps2") - [0, 0, G]).ravel(), 0.1 * math.sqrt(5.0))


def test_a_gyro_bias_acts_in_its_interval_about_the_axes_of_the_body() -> None:
    fault = wrong.GyroBias(start_s=2.0, stop_s=3.0, bias_radps=(0.1, -0.2, 0.3))
    for angles in ((0.0, 0.0, 0.0), (0.4, -0.3, 0.2)):
        clean, bad = (imu(Round(), f, yaw_pitch_roll_rad=angles) for f in ((), (fault,)))
        extra = column(bad, "angular_velocity_radps") - column(clean, "angular_velocity_radps")
        body_r_imu = looking(np.eye(3), yaw_rad=angles[0], pitch_rad=angles[1], roll_rad=angles[2])
        held = (times_s(bad) >= 2) & (times_s(bad) < 3)
        assert held.sum() == 100
        np.testing.assert_allclose(extra[held] @ body_r_imu.T, np.tile(fault.bias_radps, (100, 1)), atol=1e-12)
        assert not np.any(extra[~held])
        forces = [column(run, "linear_acceleration_mps2") for run in (clean, bad)]
        assert np.array_equal(*forces)


def test_the_orientation_of_the_imu() -> None:
    motion = Tumble()
    found = imu(motion, orientation=True, yaw_pitch_roll_rad=(0.4, -0.3, 0.2))
    truth = motion.at(times_s(found)).world_r_body @ looking(np.eye(3), yaw_rad=0.4, pitch_rad=-0.3, roll_rad=0.2)
    told = Rotation.from_quat(column(found, "quat_xyzw"))
    np.testing.assert_allclose(told.as_matrix(), truth, atol=1e-8)
    noisy = Rotation.from_quat(column(imu(motion, orientation=True, orientation_noise_rad=0.02), "quat_xyzw"))
    errors = (Rotation.from_matrix(motion.at(times_s(found)).world_r_body).inv() * noisy).as_rotvec()
    np.testing.assert_allclose(errors.std(axis=0), 0.02, rtol=0.15)


# -------------------------------------------------------------------------- wheel odometer


def test_the_odometer_tells_forward_speed_and_yaw_rate() -> None:
    motion = Round(b=0.2)
    found = wheels(motion, **QUIET_WHEELS)
    rate = 0.5 + 0.26 * np.cos(1.3 * times_s(found))
    zero = np.zeros_like(rate)
    np.testing.assert_allclose(column(found, "linear_velocity_mps"), np.column_stack([3 * rate, zero, zero]), atol=1e-8)
    np.testing.assert_allclose(column(found, "angular_velocity_radps"), np.column_stack([zero, zero, rate]), atol=1e-8)


def test_the_odometer_does_not_feel_a_sideslip() -> None:
    crab = Waypoints(np.array([0.0, 4.0]), np.array([[0, 0, 0.5], [4 * math.cos(0.7), 4 * math.sin(0.7), 0.5]]))
    last = wheels(crab, **QUIET_WHEELS)[-2]
    np.testing.assert_allclose(last.linear_velocity_mps, [math.cos(0.2), 0, 0], atol=1e-12)
    np.testing.assert_allclose(last.position_m, [math.cos(0.2) * 3.98, 0, 0], atol=1e-9)


@pytest.mark.parametrize("sampling", ["mean", "instant"])
def test_odometer_samples_integrate_to_the_truth_at_second_order(sampling: str) -> None:
    motion = Weave()
    errors = []
    for rate_hz in (20.0, 40.0):
        last = wheels(motion, timing=Timing(rate_hz=rate_hz), **QUIET_WHEELS | {"sampling": sampling})[-1]
        start, end = (motion.at(np.array([t])) for t in (0.0, motion.duration_s))
        reckoned = start.position_m[0] + start.world_r_body[0] @ last.position_m
        turned = heading_of_quat(last.quat_xyzw) - (end.heading_rad - start.heading_rad)[0]
        errors.append([np.linalg.norm(reckoned - end.position_m[0]), abs(turned)])
    (moved, turned), (moved_fine, turned_fine) = errors
    assert moved < 0.02
    assert moved / moved_fine == pytest.approx(4, rel=0.05)
    assert turned < 1e-12 or turned / turned_fine == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("sampling", ["mean", "instant"])
def test_a_steady_arc_is_reckoned_exactly(sampling: str) -> None:
    motion = Round()
    found = wheels(motion, timing=Timing(rate_hz=2.0), **QUIET_WHEELS | {"sampling": sampling})
    truth = motion.at(times_s(found))
    np.testing.assert_allclose(column(found, "position_m")[:, :2], truth.position_m[:, :2], atol=1e-12)
    told = Rotation.from_quat(column(found, "quat_xyzw")).as_matrix()
    np.testing.assert_allclose(told, truth.world_r_body, atol=1e-12)


def test_dead_reckoning_errs_as_its_noise_says() -> None:
    timing = Timing(rate_hz=20.0)
    ends = []
    for seed in SEEDS:
        at_4_s = wheels(straight(5.0), seed=seed, timing=timing, speed_density=0.02, turn_density=0.002)[80]
        ends.append([*at_4_s.position_m[:2], heading_of_quat(at_4_s.quat_xyzw)])
    x, y, heading = np.array(ends).T
    normalised(x - 8.0, 0.02 * math.sqrt(3.975))
    normalised(y, 2.0 * 0.002 * math.sqrt(4.0**3 / 3))  # V ∫∫ white noise
    normalised(heading, 0.002 * math.sqrt(3.975))


def test_bias_scale_walk_and_scale_faults_of_the_odometer() -> None:
    motion = Round(b=0.2)
    clean = wheels(motion, **QUIET_WHEELS)
    bad = wheels(
        motion,
        speed_bias_mps=0.1,
        speed_scale=0.02,
        turn_bias_radps=-0.05,
        turn_scale=0.01,
        **QUIET_WHEELS,
    )
    speed, turn = ((column(run, "linear_velocity_mps"), column(run, "angular_velocity_radps")) for run in (clean, bad))
    np.testing.assert_allclose(turn[0][:, 0], 1.02 * speed[0][:, 0] + 0.1, atol=1e-12)
    np.testing.assert_allclose(turn[1][:, 2], 1.01 * speed[1][:, 2] - 0.05, atol=1e-12)
    ends = [wheels(standing(5.0), seed=s, timing=Timing(rate_hz=4), speed_walk=0.1, turn_walk=0.01) for s in range(150)]
    walked = np.array([[run[-1].linear_velocity_mps[0], run[-1].angular_velocity_radps[2]] for run in ends])
    white_part = 2 * np.array([0.01, 0.01])  # density · √4 Hz
    normalised(walked[:, 0], math.hypot(0.1 * math.sqrt(5.0), white_part[0]))
    normalised(walked[:, 1], math.hypot(0.01 * math.sqrt(5.0), white_part[1]))


def test_an_odometer_scale_fault_acts_in_its_interval() -> None:
    fault = wrong.OdometerScale(start_s=1.0, stop_s=2.0, factor=1.1)
    clean, bad = (wheels(Round(), f) for f in ((), (fault,)))
    ratio = column(bad, "linear_velocity_mps")[:, 0] / column(clean, "linear_velocity_mps")[:, 0]
    held = (times_s(bad) >= 1) & (times_s(bad) < 2)
    assert held.sum() == 50
    np.testing.assert_allclose(ratio, np.where(held, 1.1, 1.0), rtol=1e-12)
    assert np.array_equal(column(clean, "angular_velocity_radps"), column(bad, "angular_velocity_radps"))
    longer = bad[-1].position_m != clean[-1].position_m  # the pose is that of the values which it sends
    assert np.any(longer)


def test_ticks_of_the_wheels() -> None:
    motion = Round(radius_m=1.0)
    found = wheels(motion, timing=Timing(rate_hz=20.0), tick_m=0.002, track_m=0.4, **QUIET_WHEELS)
    speed, turn = column(found, "linear_velocity_mps")[:, 0], column(found, "angular_velocity_radps")[:, 2]
    for wheel, true in ((speed - 0.2 * turn, 0.4), (speed + 0.2 * turn, 0.6)):
        counts = wheel / (0.002 * 20)
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
        assert abs(np.sum(wheel) / 20 - len(wheel) * true / 20) <= 0.002
    heading = heading_of_quat(found[-1].quat_xyzw)
    assert 0 < abs(heading - (4.0 - 2 * math.pi * round(4.0 / 2 / math.pi))) < 0.02  # 4 ticks over the track


def test_a_twist_has_no_pose() -> None:
    channel = on_board.odometer_channel(Round(), Odometer(message="twist"), **PLAN)
    assert (channel.type, channel.frame) == ("geometry_msgs/msg/TwistStamped", "base_link")
    posed = on_board.odometer_channel(Round(), Odometer(), **PLAN)
    assert (posed.type, posed.frame) == ("nav_msgs/msg/Odometry", "odom")
    one, other = samples(channel)[7], samples(posed)[7]
    assert np.all(np.isnan(one.position_m))
    assert np.all(np.isnan(one.quat_xyzw))
    assert np.array_equal(one.linear_velocity_mps, other.linear_velocity_mps)


# ------------------------------------------------------------------- reference and truth


def test_a_reference_without_noise_is_the_truth() -> None:
    motion, point = Tumble(), (0.3, 0.1, -0.2)
    channel = on_board.reference_channel(motion, Reference(point_m=point, child_frame="prism"), **PLAN)
    found = samples(channel)
    truth = motion.at(channel.number / 60.0).at_point(np.array(point))
    np.testing.assert_allclose(column(found, "position_m"), truth.position_m, atol=1e-14)
    told = Rotation.from_quat(column(found, "quat_xyzw")).as_matrix()
    np.testing.assert_allclose(told, truth.world_r_body, atol=1e-14)
    assert (channel.type, found[0].parent_frame, found[0].child_frame) == (
        "geometry_msgs/msg/PoseStamped",
        "world",
        "prism",
    )
    assert np.all(np.isnan(found[0].covariance))


def test_the_noise_and_covariance_of_a_reference() -> None:
    motion = standing(100.0, pitch_rad=0.2)
    settings = Reference(position_noise_m=0.02, heading_noise_rad=0.01, with_covariance=True)
    channel = on_board.reference_channel(motion, settings, **PLAN)
    found = samples(channel)
    errors = column(found, "position_m") - [0, 0, 0.2]
    np.testing.assert_allclose(np.cov(errors.T), 0.02**2 * np.eye(3), atol=0.02**2 * 0.08)
    headings = [heading_of_quat(sample.quat_xyzw) for sample in found]
    assert np.std(headings) == pytest.approx(0.01, rel=0.05)
    tilts = Rotation.from_quat(column(found, "quat_xyzw")).as_euler("ZYX")
    np.testing.assert_allclose(tilts[:, 1:], [[0.2, 0]] * len(found), atol=1e-12)  # nothing but the heading errs
    assert channel.type == "geometry_msgs/msg/PoseWithCovarianceStamped"
    np.testing.assert_allclose(found[3].covariance, np.diag([4e-4, 4e-4, 4e-4, 0, 0, 1e-4]), atol=1e-18)


def test_the_truth_has_exact_velocities_in_body_axes() -> None:
    motion, point = Tumble(), (0.2, 0.0, 0.1)
    channel = on_board.truth_channel(motion, Timing(rate_hz=100.0, start_s=0.25), point_m=point, **PLAN)
    found = samples(channel)
    t, h = 0.25 + channel.number / 100.0, 1e-5
    assert (found[0].t_ns, channel.type) == (START_NS + 250_000_000, "nav_msgs/msg/Odometry")
    before, here, after = (motion.at(t + dt).at_point(np.array(point)) for dt in (-h, 0, h))
    np.testing.assert_allclose(column(found, "position_m"), here.position_m, atol=1e-15)
    velocity = (after.position_m - before.position_m) / (2 * h)
    told = Rotation.from_quat(column(found, "quat_xyzw"))
    np.testing.assert_allclose(told.apply(column(found, "linear_velocity_mps")), velocity, atol=1e-8)
    turned = Rotation.from_matrix(before.world_r_body).inv() * Rotation.from_matrix(after.world_r_body)
    np.testing.assert_allclose(column(found, "angular_velocity_radps"), turned.as_rotvec() / (2 * h), atol=1e-8)


# ---------------------------------------------------------------------------------- height


def ranges(motion: Any, mount: Mount, ground: Any = on_board.level_ground, **settings: Any) -> np.ndarray:
    channel = on_board.height_channel(motion, Height(**settings), mount, ground=ground, **PLAN)
    return column(samples(channel), "range_m")


def test_the_height_of_a_tilted_camera() -> None:
    mount = Mount(position_m=np.array([0.3, 0.0, 0.1]))
    motion = standing(0.5, pitch_rad=0.2, roll_rad=0.1)
    height = 0.2 - 0.3 * math.sin(0.2) + 0.1 * math.cos(0.2) * math.cos(0.1)
    np.testing.assert_allclose(ranges(motion, mount), height, atol=1e-14)
    along = height / (math.cos(0.2) * math.cos(0.1))
    np.testing.assert_allclose(ranges(motion, mount, direction="axis"), along, atol=1e-12)


def test_the_height_over_a_relief() -> None:
    def slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.1 * x - 0.05 * y + 0.02

    motion, tilt = straight(2.0), Mount(body_r_camera=looking(np.diag([1.0, -1, -1]), pitch_rad=-0.4))
    x = 2.0 * np.arange(121) / 60
    np.testing.assert_allclose(ranges(motion, tilt, lambda x, y: slope(x, y) - 1), 1.18 - 0.1 * x, atol=1e-12)
    # the ray (x + d sin 0.4, 0.2 - d cos 0.4) meets the plane z = 0.1 x - 0.98
    along = (1.18 - 0.1 * x) / (math.cos(0.4) + 0.1 * math.sin(0.4))
    np.testing.assert_allclose(ranges(motion, tilt, lambda x, y: slope(x, y) - 1, direction="axis"), along, atol=1e-10)

    def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.02 * np.sin(7 * x) + 0.01 * np.cos(5 * y)

    found = ranges(motion, tilt, waves, direction="axis")
    hit = np.column_stack([x + found * math.sin(0.4), 0 * x, 0.2 - found * math.cos(0.4)])
    np.testing.assert_allclose(hit[:, 2], waves(hit[:, 0], hit[:, 1]), atol=1e-10)


def test_noise_bias_and_limits_of_the_height() -> None:
    found = ranges(standing(200.0), Mount(), noise_m=0.003, bias_m=0.05)
    assert np.mean(found) == pytest.approx(0.25, abs=5 * 0.003 / math.sqrt(len(found)))
    assert np.std(found) == pytest.approx(0.003, rel=0.05)
    assert np.all(ranges(standing(0.1), Mount(), max_range_m=0.1) == np.inf)
    assert np.all(ranges(standing(0.1), Mount(), min_range_m=0.3) == -np.inf)
    ahead = Mount(body_r_camera=FORWARD)
    assert np.all(ranges(standing(0.1), ahead, direction="axis") == np.inf)
    np.testing.assert_allclose(ranges(standing(0.1), ahead), 0.2)


def test_a_camera_in_the_ground_and_a_cliff_are_refused() -> None:
    with pytest.raises(ValueError, match=r"0\.1 m below the ground"):
        ranges(standing(0.1), Mount(position_m=np.array([0, 0, -0.3])))
    steep = Mount(body_r_camera=looking(np.diag([1.0, -1, -1]), pitch_rad=-1.2))
    with pytest.raises(ValueError, match="steeper than the camera's axis"):
        ranges(straight(), steep, lambda x, y: 0.1 * np.sin(40 * x), direction="axis")


def test_a_ridge_before_the_ground_that_is_found_is_noticed() -> None:
    slanting = Mount(body_r_camera=looking(np.diag([1.0, -1, -1]), pitch_rad=-0.8))  # meets z = 0 at x = 0.206
    with pytest.raises(ValueError, match="steeper than the camera's axis"):
        ranges(standing(0.1), slanting, lambda x, y: np.where(np.abs(x - 0.1) < 0.01, 0.15, 0.0), direction="axis")


# --------------------------------------------------------------------- calibration and GNSS


def lensed(**settings: Any) -> Camera:
    return pinhole(640, 480, 400.0, **settings)


def test_a_wrong_calibration_is_sent_in_its_interval_and_the_camera_stays() -> None:
    camera = lensed(distortion=(-0.1, 0.02))
    fault = wrong.WrongCalibration(start_s=1.0, stop_s=2.0, focal_factor=1.02, centre_px=(3.0, -4.0))
    channel = on_board.camera_info_channel(camera, Timing(rate_hz=10.0), duration_s=3.0, faults=[fault], **PLAN)
    found = samples(channel)
    for k, sample in enumerate(found):
        if 10 <= k < 20:
            expected = [[408, 0, 322.5], [0, 408, 235.5], [0, 0, 1]]
        else:
            expected = [[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]]
        np.testing.assert_allclose(sample.camera.matrix, expected, atol=1e-12)
        np.testing.assert_allclose(sample.camera.projection, np.column_stack([expected, np.zeros(3)]), atol=1e-12)
        assert np.array_equal(sample.camera.distortion, camera.distortion)
    assert (len(found), channel.type, channel.frame) == (31, "sensor_msgs/msg/CameraInfo", "camera")
    assert camera.matrix[0, 0] == 400


def test_positions_on_the_earth_there_and_back() -> None:
    rng = np.random.default_rng(0)
    latitude, longitude = rng.uniform(-1.57, 1.57, 200), rng.uniform(-3.14, 3.14, 200)
    altitude = rng.uniform(-500, 9000, 200)
    back = geodetic(earth_centred(latitude, longitude, altitude))
    for found, expected, atol in zip(back, (latitude, longitude, altitude), (1e-14, 1e-14, 1e-8), strict=True):
        np.testing.assert_allclose(found, expected, atol=atol)
    np.testing.assert_allclose(geodetic(np.array([[0, 0, 6356752.314245 + 10]]))[2], 10, atol=1e-5)
    enu = np.vstack([np.zeros(3), rng.uniform(-3000, 3000, (50, 3))])
    np.testing.assert_allclose(local_enu(*from_local_enu(enu, -0.6, 2.1, 250.0)), enu, atol=1e-8)


def test_gnss_fixes_are_the_way_about_the_origin() -> None:
    motion = Round(radius_m=80.0)
    quiet = Gnss(latitude_rad=0.9, longitude_rad=0.2, altitude_m=40.0, horizontal_noise_m=0, vertical_noise_m=0)
    channel = on_board.gnss_channel(motion, quiet, **PLAN)
    found = samples(channel)
    assert np.all(np.isnan(found[0].covariance_m2))
    geo = [np.array([v, *column(found, name)]) for v, name in zip((0.9, 0.2, 40.0), GEO, strict=True)]
    truth = motion.at(channel.number / 5.0).position_m
    np.testing.assert_allclose(local_enu(*geo)[1:], truth, atol=1e-8)


def test_gnss_noise() -> None:
    channel = on_board.gnss_channel(standing(1000.0), Gnss(), **PLAN)
    found = samples(channel)
    origin = (Gnss().latitude_rad, Gnss().longitude_rad, Gnss().altitude_m)
    enu = local_enu(*(np.array([v, *column(found, name)]) for v, name in zip(origin, GEO, strict=True)))[1:]
    np.testing.assert_allclose(np.std(enu, axis=0), [1, 1, 2], rtol=0.05)
    np.testing.assert_array_equal(found[0].covariance_m2, np.diag([1.0, 1.0, 4.0]))


# ----------------------------------------------------------------------------------- tracks

FRONT = Mount(position_m=np.array([0.2, 0.0, 0.5]), body_r_camera=looking(FORWARD, yaw_rad=0.05, pitch_rad=0.1))


@functools.cache
def landmarks() -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(-5, 25, 120), rng.uniform(-6, 6, 120), rng.uniform(-1, 3, 120)])


def tracked(
    faults: Iterable[wrong.Fault] = (), camera: Camera | None = None, points: Any = None, **settings: Any
) -> Channel:
    return on_board.tracks_channel(
        straight(4.0),
        Tracks(**({"noise_px": 0.0} | settings)),
        camera or lensed(),
        FRONT,
        landmarks() if points is None else points,
        faults=tuple(faults),
        **PLAN,
    )


@pytest.mark.parametrize("distortion", [(), (-0.12, 0.03, 0.001, -0.002, 0.0)], ids=["plain", "distorted"])
def test_tracks_are_what_opencv_projects(distortion: tuple[float, ...]) -> None:
    camera = lensed(distortion=distortion)
    for number, sample in enumerate(samples(tracked(camera=camera))):
        world_r_camera, place = FRONT.world_t_camera(straight(4.0).at(np.array([number / 5.0])))
        camera_r_world = world_r_camera[0].T
        in_camera = (landmarks() - place[0]) @ camera_r_world.T
        rotation, _ = cv2.Rodrigues(camera_r_world)
        pixels, _ = cv2.projectPoints(
            landmarks(), rotation, -camera_r_world @ place[0], camera.matrix, np.array(distortion or [0.0] * 5)
        )
        u, v = pixels[:, 0].T
        # beyond this angle the lens model folds back into the image
        near = np.hypot(*in_camera[:, :2].T) < 1.2 * in_camera[:, 2]
        inside = (u > -0.5) & (u < 639.5) & (v > -0.5) & (v < 479.5) & (in_camera[:, 2] > 0) & near
        assert sample.ids.tolist() == np.flatnonzero(inside).tolist()
        assert sample.ids.dtype == np.int64
        assert 10 < len(sample.ids) < 110
        np.testing.assert_allclose(sample.points_px, pixels[inside, 0], atol=1e-7)


def shared(one: Any, other: Any) -> tuple[np.ndarray, np.ndarray]:
    """The pixels in two frames of the tracks that are in both."""
    ids = np.intersect1d(one.ids, other.ids)
    return one.points_px[np.searchsorted(one.ids, ids)], other.points_px[np.searchsorted(other.ids, ids)]


def test_pixel_noise_of_tracks_is_white() -> None:
    timing = Timing(rate_hz=50.0)
    clean, noisy = (samples(tracked(timing=timing, noise_px=noise)) for noise in (0.0, 0.5))
    errors = np.vstack([np.subtract(*reversed(shared(a, b))) for a, b in zip(clean, noisy, strict=True)])
    assert errors.std() == pytest.approx(0.5, rel=0.03)
    assert abs(np.corrcoef(errors.T)[0, 1]) < 5 / math.sqrt(len(errors))
    assert abs(np.corrcoef(errors[1:, 0], errors[:-1, 0])[0, 1]) < 5 / math.sqrt(len(errors))
    one, two = (samples(tracked(timing=timing, noise_px=0.5))[k] for k in (3, 4))
    assert not np.array_equal(*shared(one, two))


def test_a_slip_moves_one_track_to_another_point_of_the_scene() -> None:
    clean = samples(tracked())
    ahead = next(i for i in clean[0].ids.tolist() if i in clean[12].ids and landmarks()[i, 0] > 15)
    fault = wrong.TrackSlip(start_s=0.5, stop_s=2.0, track=ahead, offset_px=(6.0, -3.0))
    for camera in (lensed(), lensed(distortion=(-0.05, 0.01))):
        clean, bad = samples(tracked(camera=camera)), samples(tracked([fault], camera=camera))
        offsets = []
        for k, (a, b) in enumerate(zip(clean, bad, strict=True)):
            others = a.ids != ahead
            assert np.array_equal(a.points_px[others], b.points_px[b.ids != ahead])
            offset = b.points_px[b.ids == ahead] - a.points_px[a.ids == ahead]
            if 3 <= k < 10:
                offsets.append(offset[0])
            else:
                assert not np.any(offset)
        np.testing.assert_allclose(offsets[0], [6, -3], atol=1e-7)
        lengths = np.linalg.norm(offsets, axis=1)
        assert np.all(np.diff(lengths) > 0.01)  # a point of the scene comes nearer, as the landmark does


def test_a_slip_of_a_landmark_that_is_not_seen_is_refused() -> None:
    points = np.vstack([[-3.0, 0, 1], landmarks()[:5]])
    with pytest.raises(ValueError, match="track-slip: landmark 0 is not seen from 1 s to 4 s"):
        tracked([wrong.TrackSlip(start_s=1, stop_s=4, track=0)], points=points)


def test_outliers_have_their_share_and_size() -> None:
    centre = np.array([30.0, 0.0, -1.0]) + np.random.default_rng(0).uniform(-3, 3, (400, 3))
    fault = wrong.TrackOutliers(start_s=1.0, stop_s=3.0, share=0.2, size_px=50.0)
    clean, bad = samples(tracked(points=centre)), samples(tracked([fault], points=centre))
    errors = []
    for k, (a, b) in enumerate(zip(clean, bad, strict=True)):
        if 5 <= k < 15:
            errors.append(np.subtract(*shared(a, b)))
        else:
            assert np.array_equal(a.points_px, b.points_px)
    off = np.vstack(errors)
    hit = np.any(off != 0, axis=1)
    assert np.mean(hit) == pytest.approx(0.2, abs=5 * math.sqrt(0.16 / len(off)))
    assert 49 < np.max(np.abs(off)) <= 50
    assert np.std(off[hit]) == pytest.approx(50 / math.sqrt(3), rel=0.05)
    counts = [np.sum(np.any(e != 0, axis=1)) for e in errors]
    assert len(set(counts)) > 1  # drawn anew in every image


def test_bad_landmarks_and_slips_are_named() -> None:
    with pytest.raises(ValueError, match="track is 120, there are 120 landmarks"):
        tracked([wrong.TrackSlip(start_s=0, stop_s=1, track=120)])
    with pytest.raises(ValueError, match="landmarks_m has the shape"):
        tracked(points=np.zeros(3))


# ----------------------------------------------------------------------------------- faults


def test_the_list_of_faults_is_a_sample() -> None:
    fault = wrong.MotionBlur(start_s=1.0, stop_s=2.0, exposure=0.5)
    channel = on_board.faults_channel([fault], start_ns=START_NS, scenario={"name": "demo"})
    (sample,) = samples(channel)
    assert (channel.stream, channel.type, sample.t_ns) == ("/truth/faults", "std_msgs/msg/String", START_NS)
    (record,) = wrong.from_text(sample.text)
    assert (record.name, record.start_ns) == ("motion-blur", START_NS + 1_000_000_000)


# -------------------------------------------------------------------------------- all alike


def channels(seed: int) -> list[Channel]:
    plan = {"start_ns": START_NS, "seed": seed}
    timing = Timing(rate_hz=10.0, drop_share=0.1, duplicate_share=0.1, disorder_share=0.1, latency_jitter_s=0.02)
    faults = (
        wrong.TrackOutliers(start_s=0.5, stop_s=1.0),
        wrong.WrongCalibration(start_s=0.5, stop_s=1.0, focal_factor=1.1),
    )
    motion = straight(3.0)
    camera = lensed()
    return [
        on_board.imu_channel(motion, Imu(timing=timing, orientation=True, gyro_walk=1e-3), **plan),
        on_board.odometer_channel(motion, Odometer(timing=timing, tick_m=0.01), **plan),
        on_board.reference_channel(
            motion, Reference(timing=timing, position_noise_m=0.1, heading_noise_rad=0.1), **plan
        ),
        on_board.truth_channel(motion, timing, **plan),
        on_board.height_channel(motion, Height(timing=timing, noise_m=0.01), Mount(), **plan),
        on_board.camera_info_channel(camera, timing, duration_s=3.0, faults=faults, **plan),
        on_board.gnss_channel(motion, Gnss(timing=timing), **plan),
        on_board.tracks_channel(motion, Tracks(timing=timing), camera, FRONT, landmarks(), faults=faults, **plan),
    ]


def printed(sample: Any) -> bytes:
    """All that a sample holds, as bytes."""
    fields = (getattr(sample, name) for name in sample.__dataclass_fields__)
    return b"|".join(f.tobytes() if isinstance(f, np.ndarray) else repr(f).encode() for f in fields)


def test_samples_are_the_same_in_any_order() -> None:
    for one, again in zip(channels(7), channels(7), strict=True):
        forwards = [printed(sample) for sample in samples(one)]
        messages = list(zip(again.number.tolist(), again.stamp_ns.tolist(), again.received_ns.tolist(), strict=True))
        order = np.random.default_rng(0).permutation(len(messages))
        for k in itertools.chain(order, order[::-1]):
            assert printed(again.sample(*messages[k])) == forwards[k], one.stream


def test_another_seed_is_another_noise() -> None:
    quiet = {on_board.TRUTH, on_board.CALIBRATION}
    for one, other in zip(channels(7), channels(8), strict=True):
        if one.stream not in quiet:
            assert printed(one.sample(3, 1, 2)) != printed(other.sample(3, 1, 2)), one.stream


def test_a_duplicate_is_the_same_sample_received_again() -> None:
    for channel in channels(7):
        found = samples(channel)
        twins = [(a, b) for a, b in itertools.pairwise(found) if a.t_ns == b.t_ns]
        assert twins, channel.stream
        for a, b in twins:
            assert a.received_ns < b.received_ns
            assert printed(channel.sample(5, a.t_ns, 0)) == printed(channel.sample(5, b.t_ns, 0))


BAD = [
    (Imu, {"gyro_density": -1.0}),
    (Imu, {"force_walk": -1.0}),
    (Imu, {"gyro_bias_radps": (0.0, math.nan, 0.0)}),
    (Imu, {"orientation_noise_rad": -0.1}),
    (Imu, {"sampling": "median"}),
    (Odometer, {"speed_density": -1.0}),
    (Odometer, {"tick_m": -0.1}),
    (Odometer, {"track_m": 0.0}),
    (Odometer, {"message": "text"}),
    (Odometer, {"sampling": "median"}),
    (Reference, {"position_noise_m": -1.0}),
    (Reference, {"with_covariance": True}),
    (Height, {"noise_m": -1.0}),
    (Height, {"max_range_m": 0.0}),
    (Height, {"direction": "up"}),
    (Gnss, {"horizontal_noise_m": -1.0}),
    (Gnss, {"latitude_rad": 2.0}),
    (Tracks, {"noise_px": -1.0}),
]


@pytest.mark.parametrize(("sensor", "bad"), BAD, ids=lambda x: str(getattr(x, "__name__", x)))
def test_a_bad_parameter_is_named(sensor: type, bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{sensor.__name__}: {next(iter(bad))} is "):
        sensor(**bad)


def test_sensors_nest_in_a_settings_model() -> None:
    class Scenario(BaseModel):
        model_config = ConfigDict(frozen=True, extra="forbid")

        imu: Imu = Imu()
        height: Height = Height()

    told = Scenario.model_validate({"imu": {"timing": {"rate_hz": 50}, "position_m": [1, 2, 3]}})
    assert told.imu == Imu(timing=Timing(rate_hz=50.0), position_m=(1.0, 2.0, 3.0))
    assert Scenario.model_validate(told.model_dump()) == told
    with pytest.raises(ValidationError, match=r"drop_share is 3\.0, it must be a share"):
        Scenario.model_validate({"imu": {"timing": {"rate_hz": 50, "drop_share": 3}}})
    with pytest.raises(ValidationError, match="gyro_densty"):
        Scenario.model_validate({"imu": {"gyro_densty": 1}})
