"""Messages for the range filter by hand, and those of the study's asynchronous run."""

import functools

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging import montecarlo as mc
from pipelines.ranging.inputs import Synchronisation
from pipelines.ranging.range_filter import RangeFilter
from pipelines.ranging.range_settings import RangeSettings
from pipelines.ranging.step import RangeStep
from pipelines.simulation.channels import rng_of
from pipelines.verdict import Verdict
from readers.streams import ImuSample, OdometrySample, Sample, TrackSample, array

Floats = NDArray[np.float64]
NAN3, NAN4 = array(*[np.nan] * 3), array(*[np.nan] * 4)


def ns(t_s: float) -> int:
    return 1_000_000_000 + round(t_s * 1e9)


def odometry(t_s: float, velocity, turn=(0.0, 0.0, 0.0)) -> OdometrySample:
    t = ns(t_s)
    return OdometrySample(
        stream="odometry",
        t_ns=t,
        received_ns=t,
        linear_velocity_mps=np.array(velocity, dtype=float),
        angular_velocity_radps=np.array(turn, dtype=float),
        position_m=NAN3,
        quat_xyzw=NAN4,
    )


def imu(t_s: float, turn) -> ImuSample:
    t = ns(t_s)
    return ImuSample(
        stream="imu",
        t_ns=t,
        received_ns=t,
        angular_velocity_radps=np.array(turn, dtype=float),
        linear_acceleration_mps2=NAN3,
        quat_xyzw=NAN4,
    )


def tracks(t_s: float, points: Floats, ids=None) -> TrackSample:
    t, points = ns(t_s), np.asarray(points, dtype=float).reshape(-1, 2)
    ids = np.arange(len(points)) if ids is None else np.asarray(ids)
    return TrackSample(stream="tracks", t_ns=t, received_ns=t, ids=ids.astype(np.int64), points_px=points)


def replayed(settings: RangeSettings, samples) -> list[RangeStep]:
    estimator = RangeFilter(settings)
    state, steps = estimator.start(), []
    for sample in samples:
        state, step = estimator.step(state, sample)
        if step is not None:
            steps.append(step)
    return steps


def alarms(steps: list[RangeStep]) -> Verdict:
    found = Verdict.OK
    for step in steps:
        found |= step.alarms
    return found


# ------------------------------------------------------------------------ the study's asynchronous run

RUNS = 2
ASYNCHRONOUS = mc.Asynchronous(base=mc.Scenario(pixel_sigma=0.1, runs=RUNS))


@functools.cache
def asynchronous_batch(how: str) -> mc.Runs:
    """The runs as the study's own batch filters them."""
    return mc.run_asynchronous(ASYNCHRONOUS, Synchronisation(how))


def asynchronous_settings(how: str, **changes) -> RangeSettings:
    """The settings that make the estimator the batch's filter."""
    base = ASYNCHRONOUS.base
    made = {
        "focal_px": base.focal_px,
        "centre_px": base.centre_px,
        "motion": "aligned",
        "synchronisation": how,
        "gate": "off",
        "reset_after": 0,
        "sigma_omega": base.sigma_omega,
        "sigma_speed": base.sigma_speed,
        "tracks": {"sigma_px": base.pixel_sigma},
        "max_landmarks": 1,
        "zero_velocity_update": False,
        "gyro_bias": "given",
        "start": "range",
        "start_range_m": base.start_range_m,
        "start_sigma_m": base.start_sigma_xi * base.start_range_m**2,
        "start_pixel_variance": base.start_pixel_variance,
    }
    return RangeSettings(**(made | changes))


@functools.cache
def asynchronous_samples(how: str, run: int) -> tuple[Sample, ...]:
    """The messages of one run by time: IMU 50 Hz, odometry 20 Hz, frames 5 Hz; of equal times the frame last."""
    base, frame_s = ASYNCHRONOUS.base, ASYNCHRONOUS.frame_s()
    rng = rng_of(base.seed, "asynchronous")
    gyro_s, odometer_s = np.arange(601) / 50, np.arange(241) / 20
    gyro = ASYNCHRONOUS.omega_at(gyro_s) + base.sigma_omega * 50**0.5 * rng.standard_normal((RUNS, 601))
    speed = ASYNCHRONOUS.speed_at(odometer_s) + base.sigma_speed * 20**0.5 * rng.standard_normal((RUNS, 241))
    truth = asynchronous_batch(how).truth[0, :, :2]
    pixel = truth + base.pixel_sigma * rng.standard_normal((RUNS, len(frame_s), 2))
    samples: list[Sample] = [imu(t, (0, 0, -w)) for t, w in zip(gyro_s, gyro[run], strict=True)]
    samples += [odometry(t, (v, 0, 0)) for t, v in zip(odometer_s, speed[run], strict=True)]
    samples += [tracks(t, p) for t, p in zip(frame_s, pixel[run], strict=True)]
    return tuple(sorted(samples, key=lambda sample: sample.t_ns))
