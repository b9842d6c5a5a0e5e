"""Simulated missions of the range filter with one planted failure each, as pixel tracks: no image is rendered.

A mission follows from the failure's name and a seed: landmarks, way, sensors' noise, when the failure begins and how
strong it is. `MISSIONS` is the table of them; the ranges of strengths are those in which a failure matters.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.lens import pinhole
from pipelines.ranging.landmarks.settings import TrackSettings
from pipelines.ranging.range_filter import RangeFilter
from pipelines.ranging.range_settings import RangeSettings, StartKind
from pipelines.ranging.step import RangeStep
from pipelines.simulation import faults as flaws
from pipelines.simulation.channels import Channel, rng_of
from pipelines.simulation.curves import curve
from pipelines.simulation.driving import Chain, Drive, Turn, stop
from pipelines.simulation.faults import Fault
from pipelines.simulation.mission import START_NS, SimulatedMission
from pipelines.simulation.motion import FORWARD, Motion, Mount
from pipelines.simulation.sensors import (
    IMU,
    ODOMETRY,
    TRACKS,
    Imu,
    Odometer,
    Tracks,
    imu_channel,
    odometer_channel,
    tracks_channel,
)
from pipelines.simulation.speeds import constant, trapezoid
from pipelines.simulation.timing import Timing, schedule
from workbench.diagnosis.finding import Case

Floats = NDArray[np.float64]
Dice = np.random.Generator

FOCAL_PX, CENTRE_PX, SIZE_PX = 500.0, (319.5, 239.5), (640, 480)
HEIGHT_M = 0.6
RATE_HZ = 10.0
DURATION_S = 15.0
CAMERA = pinhole(*SIZE_PX, FOCAL_PX, centre_px=CENTRE_PX)
MOUNT = Mount(np.array([0.0, 0.0, HEIGHT_M]), FORWARD)
STREAMS = (IMU, ODOMETRY, TRACKS)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a mission is made of, and how it is estimated.

    Attributes:
        motion: the way.
        landmarks_m: places in the world [n, 3].
        noise_px: of the tracks.
        gyro: spectral density of the gyro's noise.
        speed: spectral density of the odometer's noise.
        faults: what goes wrong in the sensors.
        without: streams whose messages get lost in the interval of a fault: stream → interval, s.
        settings: changes of the settings.
        wrong_s: interval in which the failure is there; None: the whole mission.
        referenced: whether the reference depths are known.
    """

    motion: Motion
    landmarks_m: Floats
    noise_px: float
    gyro: float
    speed: float
    faults: tuple[Fault, ...] = ()
    without: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    wrong_s: tuple[float, float] | None = None
    referenced: bool = True


# ----------------------------------------------------------------------- ways and places


def landmarks(rng: Dice, count: int = 14, *, nearest_m: float = 12.0, farthest_m: float = 24.0) -> Floats:
    """Places ahead of the start [count, 3] that stay in view of a drive of some 7 m, none near its direction."""
    places: list[list[float]] = []
    while len(places) < count:
        ahead, side, up = rng.uniform(nearest_m, farthest_m), rng.uniform(-1, 1), rng.uniform(-1, 1)
        y, z = 0.42 * (ahead - 7.0) * side, 0.32 * (ahead - 7.0) * up
        if FOCAL_PX * math.hypot(y, z) / ahead > 30.0 and abs(z) > 0.15:
            places.append([ahead, y, HEIGHT_M + z])
    return np.array(places)


def straight(rng: Dice) -> Motion:
    """A straight drive."""
    return Drive(curve("line"), constant(rng.uniform(0.4, 0.6), DURATION_S))


def weave(
    rng: Dice, *, turn_rad: tuple[float, float] = (0.04, 0.12), period_s: tuple[float, float] = (4.0, 8.0)
) -> Motion:
    """A drive along +x that swings to both sides."""
    speed = rng.uniform(0.4, 0.6)
    wave_m = speed * rng.uniform(*period_s)
    x = np.arange(-1.0, speed * DURATION_S + 2.0, 0.25)
    phase = rng.uniform(0.0, 2.0 * math.pi)
    side = rng.uniform(*turn_rad) * wave_m / (2.0 * math.pi) * np.sin(2.0 * math.pi * x / wave_m + phase)
    way = curve("spline", points=np.column_stack([x, side]).tolist())
    return Drive(way, constant(speed, DURATION_S), start_m=1.0)


def either(rng: Dice) -> Motion:
    """A straight drive or one that swings."""
    return straight(rng) if rng.random() < 0.5 else weave(rng)


def with_stop(rng: Dice, begin_s: float, length_s: float) -> Motion:
    """A straight drive that stops for a while."""
    speed, rise = rng.uniform(0.4, 0.6), 0.5
    first = speed * (begin_s - rise)
    rest_s = DURATION_S - begin_s - length_s
    return Chain(
        [
            Drive(curve("line"), trapezoid(first, speed, speed / rise)),
            stop(length_s),
            Drive(curve("line"), trapezoid(speed * (rest_s - rise), speed, speed / rise)),
        ]
    )


def plan_of(rng: Dice, motion: Motion | None = None, **more: Any) -> Plan:
    """A mission without failures; what `more` names replaces its parts."""
    usual: dict[str, Any] = {
        "motion": motion or either(rng),
        "landmarks_m": landmarks(rng),
        "noise_px": float(rng.choice([0.2, 0.3, 0.5])),
        "gyro": float(rng.choice([1e-3, 2e-3])),
        "speed": float(rng.choice([0.005, 0.01])),
    }
    return Plan(**(usual | more))


def _times(rng: Dice, length_s: tuple[float, float], first_s: float = 4.0, last_s: float = 13.0) -> tuple[float, float]:
    length = rng.uniform(*length_s)
    begin = rng.uniform(first_s, last_s - length)
    return begin, begin + length


# ----------------------------------------------------------------------------- failures


def _near_focus(rng: Dice) -> Plan:
    plan = plan_of(rng, straight(rng))
    places = plan.landmarks_m.copy()
    off, way = rng.uniform(0.0, 2.0) * rng.uniform(14.0, 22.0) / FOCAL_PX, rng.uniform(0.0, 2.0 * math.pi)
    places[0] = [rng.uniform(14.0, 22.0), off * math.cos(way), HEIGHT_M + off * math.sin(way)]
    return dataclasses.replace(plan, landmarks_m=places)


def _pure_rotation(rng: Dice) -> Plan:
    first = rng.random() < 0.5
    length, angle = rng.uniform(3.0, 5.0), float(rng.choice([-1.0, 1.0])) * rng.uniform(0.6, 1.0)
    speed = rng.uniform(0.4, 0.6)
    drive_s = DURATION_S - length if first else (DURATION_S - length) / 2
    drive = Drive(curve("line"), trapezoid(speed * (drive_s - 0.5), speed, 2.0 * speed))
    parts: list[Motion] = [Turn(angle, length), drive] if first else [drive, Turn(angle, length), drive]
    begin = 0.0 if first else drive_s
    around, distance = rng.uniform(-1.2, 1.2, 60), rng.uniform(12.0, 24.0, 60)
    up = rng.choice([-1.0, 1.0], 60) * rng.uniform(0.4, 2.0, 60)
    places = np.column_stack([distance * np.cos(around), distance * np.sin(around), HEIGHT_M + up])
    return plan_of(rng, Chain(parts), landmarks_m=places, wrong_s=(begin, begin + length))


def _standstill(rng: Dice) -> Plan:
    begin, length = rng.uniform(4.0, 6.0), rng.uniform(2.5, 5.0)
    return plan_of(rng, with_stop(rng, begin, length), wrong_s=(begin, begin + length))


def _overconfident_start(rng: Dice) -> Plan:
    plan = plan_of(rng)
    depth = float(np.median(plan.landmarks_m[:, 0]))
    wrong = depth * (rng.uniform(0.3, 0.45) if rng.random() < 0.5 else rng.uniform(2.5, 4.0))
    start = {"start": StartKind.RANGE, "start_range_m": wrong, "start_sigma_m": wrong * rng.uniform(0.02, 0.06)}
    return dataclasses.replace(plan, settings=start, wrong_s=(0.0, 2.0))


def _noise_too_small(rng: Dice) -> Plan:
    plan = plan_of(rng)
    return dataclasses.replace(plan, settings={"tracks": TrackSettings(sigma_px=plan.noise_px / rng.uniform(2.2, 5.0))})


def _noise_too_large(rng: Dice) -> Plan:
    plan = plan_of(rng)
    return dataclasses.replace(plan, settings={"tracks": TrackSettings(sigma_px=plan.noise_px * rng.uniform(2.2, 5.0))})


def _input_noise_too_small(rng: Dice) -> Plan:
    gyro = rng.uniform(6e-3, 1.2e-2)
    told = gyro / rng.uniform(5.0, 20.0) if rng.random() < 0.7 else 0.0
    return plan_of(rng, gyro=gyro, noise_px=float(rng.choice([0.2, 0.3])), settings={"sigma_omega": told})


def _dropped_frames(rng: Dice) -> Plan:
    times = _times(rng, (0.4, 1.5))
    return plan_of(rng, faults=(flaws.DroppedFrames(start_s=times[0], stop_s=times[1]),), wrong_s=times)


def _dropped_motion(rng: Dice) -> Plan:
    times = _times(rng, (0.4, 1.5))
    return plan_of(
        rng,
        faults=(flaws.DroppedFrames(start_s=times[0], stop_s=times[1]),),
        without={IMU: times, ODOMETRY: times},
        wrong_s=times,
    )


def _late_images(rng: Dice) -> Plan:
    times = _times(rng, (5.0, 8.0), 2.0)
    late = flaws.LateImages(start_s=times[0], stop_s=times[1], latency_s=rng.uniform(0.04, 0.2))
    motion = weave(rng, turn_rad=(0.1, 0.18), period_s=(3.0, 5.0))
    return plan_of(rng, motion, faults=(late,), wrong_s=times)


def _swapped_stamps(rng: Dice) -> Plan:
    times = _times(rng, (1.0, 3.0))
    swapped = flaws.SwappedStamps(start_s=times[0], stop_s=times[1])
    return plan_of(rng, weave(rng), faults=(swapped,), wrong_s=times)


def _wrong_mounting(rng: Dice) -> Plan:
    off = rng.uniform(6.0, 15.0)
    kind = rng.integers(3)
    if kind == 0:
        way = rng.choice([0.0, math.pi]) + rng.uniform(0.25, 0.75) * math.pi  # above or below rather than beside
        centre = (CENTRE_PX[0] + off * math.cos(way), CENTRE_PX[1] + off * math.sin(way))
        return plan_of(rng, settings={"centre_px": centre})
    if kind == 2:  # a yaw looks much like a turn: it takes more to be told
        off = rng.uniform(12.0, 20.0)
    angle = float(rng.choice([-1.0, 1.0])) * off / FOCAL_PX
    return plan_of(rng, settings={"camera_pitch_rad" if kind == 1 else "camera_yaw_rad": angle})


def _gyro_bias(rng: Dice) -> Plan:
    bias = float(rng.choice([-1.0, 1.0])) * rng.uniform(0.006, 0.02)
    times = (0.0, DURATION_S + 1.0) if rng.random() < 0.5 else _times(rng, (6.0, 9.0), 2.0)
    fault = flaws.GyroBias(start_s=times[0], stop_s=times[1], bias_radps=(0.0, 0.0, bias))
    return plan_of(rng, faults=(fault,), wrong_s=times)


def _track_outliers(rng: Dice) -> Plan:
    times = _times(rng, (1.0, 4.0))
    fault = flaws.TrackOutliers(
        start_s=times[0], stop_s=times[1], share=rng.uniform(0.05, 0.3), size_px=rng.uniform(25.0, 60.0)
    )
    return plan_of(rng, faults=(fault,), wrong_s=times)


def _track_slip(rng: Dice) -> Plan:
    times = _times(rng, (3.0, 6.0))
    way, size = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(8.0, 30.0)
    plan = plan_of(rng)
    seen = int(np.argmin(np.abs(plan.landmarks_m[:, 1]) + np.abs(plan.landmarks_m[:, 2] - HEIGHT_M)))
    fault = flaws.TrackSlip(
        start_s=times[0], stop_s=times[1], track=seen, offset_px=(size * math.cos(way), size * math.sin(way))
    )
    return dataclasses.replace(plan, faults=(fault,), wrong_s=times)


def _missing_inputs(rng: Dice) -> Plan:
    times = _times(rng, (0.6, 2.0))
    which = ((IMU,), (ODOMETRY,), (IMU, ODOMETRY))[int(rng.integers(3))]
    return plan_of(rng, without=dict.fromkeys(which, times), wrong_s=times)


def _odometer_scale(rng: Dice) -> Plan:
    factor = 1.0 + float(rng.choice([-1.0, 1.0])) * rng.uniform(0.05, 0.12)
    fault = flaws.OdometerScale(start_s=0.0, stop_s=DURATION_S + 1.0, factor=factor)
    return plan_of(rng, faults=(fault,))


def _odometer_scale_unseen(rng: Dice) -> Plan:
    return dataclasses.replace(_odometer_scale(rng), referenced=False)


def _clean(rng: Dice) -> Plan:
    """Straight, swinging, with a stop, from a rest, with landmarks that come and go."""
    kind = int(rng.integers(4))
    if kind == 0:
        return plan_of(rng, with_stop(rng, rng.uniform(4.0, 6.0), rng.uniform(1.0, 4.0)))
    if kind == 1:
        return plan_of(rng, landmarks_m=landmarks(rng, 24, nearest_m=8.0, farthest_m=40.0))
    if kind == 2:
        speed = rng.uniform(0.4, 0.6)
        drive = Drive(curve("line"), trapezoid(speed * 11.5, speed, speed))
        return plan_of(rng, Chain([stop(2.5), drive]))
    return plan_of(rng)


MISSIONS: Mapping[str, Callable[[Dice], Plan]] = {
    "near-focus": _near_focus,
    "pure-rotation": _pure_rotation,
    "standstill": _standstill,
    "overconfident-start": _overconfident_start,
    "measurement-noise-too-small": _noise_too_small,
    "measurement-noise-too-large": _noise_too_large,
    "input-noise-too-small": _input_noise_too_small,
    "dropped-frames": _dropped_frames,
    "dropped-motion": _dropped_motion,
    "late-images": _late_images,
    "swapped-stamps": _swapped_stamps,
    "wrong-mounting": _wrong_mounting,
    "gyro-bias": _gyro_bias,
    "track-outliers": _track_outliers,
    "track-slip": _track_slip,
    "missing-inputs": _missing_inputs,
    "odometer-scale": _odometer_scale,
}
"""The failures by name, each the name of the rule that is the right answer."""
CLEAN = "clean"
UNSEEN = "odometer-scale, no reference"
OTHERS: Mapping[str, Callable[[Dice], Plan]] = {CLEAN: _clean, UNSEEN: _odometer_scale_unseen}
"""Missions whose right answer is that there is nothing to find."""


# -------------------------------------------------------------------------------- replay


def mission_of(plan: Plan, seed: int) -> SimulatedMission:
    """The recording of a plan."""
    common: dict[str, Any] = {"start_ns": START_NS, "seed": seed}
    imu = Imu(timing=Timing(rate_hz=50.0), gyro_density=plan.gyro)
    odometer = Odometer(timing=Timing(rate_hz=20.0), speed_density=plan.speed)
    tracks = Tracks(timing=Timing(rate_hz=RATE_HZ), noise_px=plan.noise_px)
    made = [
        (imu_channel(plan.motion, imu, faults=plan.faults, **common), imu.timing, _lost(plan, IMU)),
        (odometer_channel(plan.motion, odometer, faults=plan.faults, **common), odometer.timing, _lost(plan, ODOMETRY)),
        (
            tracks_channel(plan.motion, tracks, CAMERA, MOUNT, plan.landmarks_m, faults=plan.faults, **common),
            tracks.timing,
            plan.faults,
        ),
    ]
    return SimulatedMission(
        [_sent(channel, timing, plan.motion.duration_s, faults, seed) for channel, timing, faults in made],
        name="failure",
        start_ns=START_NS,
        motion=plan.motion,
        faults=plan.faults,
        description={"seed": seed},
    )


def _lost(plan: Plan, stream: str) -> tuple[Fault, ...]:
    times = plan.without.get(stream)
    return () if times is None else (flaws.DroppedFrames(start_s=times[0], stop_s=times[1]),)


def _sent(channel: Channel, timing: Timing, duration_s: float, faults: Sequence[Fault], seed: int) -> Channel:
    """The channel with the faults of messages: lost, late, swapped."""
    plan = schedule(
        timing, duration_s=duration_s, start_ns=START_NS, seed=seed, stream=channel.stream, faults=tuple(faults)
    )
    return dataclasses.replace(channel, number=plan.number, stamp_ns=plan.stamp_ns, received_ns=plan.received_ns)


def settings_of(plan: Plan) -> RangeSettings:
    """The preset ``best`` with the noise of the sensors, and the plan's changes."""
    usual: dict[str, Any] = {
        "focal_px": FOCAL_PX,
        "centre_px": CENTRE_PX,
        "image_size_px": SIZE_PX,
        "sigma_omega": plan.gyro,
        "sigma_speed": plan.speed,
        "tracks": TrackSettings(sigma_px=plan.noise_px),
    }
    return RangeSettings(**(usual | dict(plan.settings)))


@dataclass(frozen=True)
class Replayed:
    """A mission's case, and the numbers of the frames [k] at which its failure is there."""

    case: Case
    wrong: NDArray[np.int64]


def replayed(name: str, seed: int, **settings: Any) -> Replayed:
    """Make and replay the mission of a failure and a seed; `settings` are changed besides."""
    plan = {**MISSIONS, **OTHERS}[name](rng_of(seed, name))
    plan = dataclasses.replace(plan, settings={**plan.settings, **settings})
    chosen = settings_of(plan)
    estimator = RangeFilter(chosen)
    state, steps = estimator.start(), list[RangeStep]()
    for sample in mission_of(plan, int(rng_of(seed, name, "noise").integers(1 << 62))).read(STREAMS):
        state, step = estimator.step(state, sample)
        if step is not None:
            steps.append(step)
    t_s = np.array([(step.t_ns - START_NS) * 1e-9 for step in steps])
    case = Case.of_steps(
        steps,
        "range",
        chosen.model_dump(mode="json", exclude_none=True),
        reference_depth_m=_depths(plan, steps, t_s) if plan.referenced else None,
    )
    wrong = np.ones(len(steps), bool)
    if plan.wrong_s is not None:
        wrong = (t_s >= plan.wrong_s[0]) & (t_s < plan.wrong_s[1])
        if not wrong.any():  # the frames never came: the one after them
            wrong[np.searchsorted(t_s, plan.wrong_s[1])] = True
    return Replayed(case, case.frame[wrong])


def _depths(plan: Plan, steps: Sequence[RangeStep], t_s: Floats) -> Floats:
    """True depths of the landmarks in the slots of each frame [n, N]."""
    turn, place = MOUNT.world_t_camera(plan.motion.at(t_s))
    every = np.einsum("kni,ki->kn", plan.landmarks_m - place[:, None], turn[:, :, 2])
    ids = np.array([step.landmark_id for step in steps])
    known = np.isfinite(ids)
    slots = np.where(known, ids, 0.0).astype(np.int64)
    return np.where(known, np.take_along_axis(every, slots, axis=1), np.nan)
