"""The robot's velocities, message by message, as the range filter takes them: held, freed of bias, at the camera.

Robot axes: x forward, y left, z up; camera axes: x right, y down, z out of the lens. A signal's values are in robot
axes. Of what lies before the last frame only the last value is kept.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.inputs import Synchronisation, intervals
from pipelines.ranging.range_settings import MotionModel, RangeSettings
from readers.streams import ImuSample, OdometrySample

Floats = NDArray[np.float64]

Value = tuple[float, ...]

NS = 1e-9


class Signal(NamedTuple):
    """Values by time, the times rising."""

    t_ns: tuple[int, ...] = ()
    values: tuple[Value, ...] = ()

    def having(self, t_ns: int, value: Value) -> Signal:
        """With one more value; of two with the same time the first counts."""
        if not self.t_ns or t_ns > self.t_ns[-1]:
            return Signal((*self.t_ns, t_ns), (*self.values, value))
        at = bisect.bisect_left(self.t_ns, t_ns)
        if self.t_ns[at] == t_ns:
            return self
        return Signal((*self.t_ns[:at], t_ns, *self.t_ns[at:]), (*self.values[:at], value, *self.values[at:]))

    def since(self, t_ns: int) -> Signal:
        """The last value up to a time, and all after it."""
        at = max(bisect.bisect_right(self.t_ns, t_ns) - 1, 0)
        return Signal(self.t_ns[at:], self.values[at:])

    def age_s(self, t_ns: int) -> float:
        """Age of the last value up to a time, NaN if there is none."""
        at = bisect.bisect_right(self.t_ns, t_ns) - 1
        return (t_ns - self.t_ns[at]) * NS if at >= 0 else math.nan


class Rest(NamedTuple):
    """What the robot's rest at the start told of the gyro: Σ ω̃ dt [3] (rad), its time (s); `over`: it has moved."""

    sum_rad: Floats
    time_s: float = 0.0
    over: bool = False


@dataclass(frozen=True, slots=True)
class Velocities:
    """The messages since the last frame, and the last ones before it.

    Attributes:
        speed: velocity [3], m/s, and 1 where the robot stands by then, else 0 [4].
        wheels: angular velocity by the odometry [3], rad/s.
        gyro: angular velocity by the IMU [3], rad/s, its bias in it.
        window: velocities of the last `standstill_s`.
        rest: the rest at the start.
        disorder: since the last frame a message came late: after a later one of its kind, or after its frame.
        unusable: a message could not be used since the last frame.
    """

    rest: Rest
    speed: Signal = Signal()
    wheels: Signal = Signal()
    gyro: Signal = Signal()
    window: Signal = Signal()
    disorder: bool = False
    unusable: bool = False

    @classmethod
    def none(cls) -> Velocities:
        """No message yet."""
        return cls(Rest(np.zeros(3)))


class Ride(NamedTuple):
    """The camera's motion between two frames in m intervals.

    Attributes:
        dt: lengths [m], s.
        omega: angular velocity, camera axes [m, 3], rad/s.
        velocity: of the camera's centre, camera axes [m, 3], m/s.
        still: the robot stood [m].
        bias_radps: bias that was taken out, robot axes [3].
    """

    dt: Floats
    omega: Floats
    velocity: Floats
    still: NDArray[np.bool_]
    bias_radps: Floats


class Noise(NamedTuple):
    """How the inputs err: columns of (Δω, Δv) in camera axes [6, c], and their spectral densities squared [c].

    The first column is the turn to the right, the second the speed ahead. `speeds` tells the columns of velocities,
    whose errors are 0 while the robot stands [c].
    """

    columns: Floats
    density: Floats
    speeds: NDArray[np.bool_]


def noise_of(s: RangeSettings) -> Noise:
    """The inputs' errors in the motion that the settings name."""
    if s.motion is MotionModel.ALIGNED:
        columns = np.zeros((6, 2))
        columns[1, 0] = columns[5, 1] = 1.0
        return Noise(columns, np.array([s.sigma_omega, s.sigma_speed]) ** 2, np.array([False, True]))
    x, y, z = np.eye(3)
    turns = [_turning(s, -z)]
    speeds = [_driving(s, x)]
    if s.motion is MotionModel.PLANAR:
        return Noise(
            np.stack(turns + speeds, axis=1),
            np.array([s.sigma_omega, s.sigma_speed]) ** 2,
            np.array([False, True]),
        )
    across = [s.sigma_omega if s.sigma_omega_across is None else s.sigma_omega_across] * 2
    aside = [s.sigma_speed if s.sigma_speed_across is None else s.sigma_speed_across] * 2
    others = [_turning(s, x), _turning(s, y), _driving(s, y), _driving(s, z)]
    return Noise(
        np.stack(turns + speeds + others, axis=1),
        np.array([s.sigma_omega, s.sigma_speed, *across, *aside]) ** 2,
        np.array([False, True, False, False, True, True]),
    )


def _turning(s: RangeSettings, axis: Floats) -> Floats:
    """(ω, v) of the camera [6] while the robot turns about an axis by 1 rad/s."""
    position = np.zeros(3) if s.camera_position_m is None else np.array(s.camera_position_m)
    turn = s.body_r_camera.T
    return np.concatenate([turn @ axis, turn @ np.cross(axis, position)])


def _driving(s: RangeSettings, axis: Floats) -> Floats:
    """(ω, v) of the camera [6] while the robot moves along an axis by 1 m/s."""
    return np.concatenate([np.zeros(3), s.body_r_camera.T @ axis])


# --------------------------------------------------------------------------- messages


def with_odometry(s: RangeSettings, known: Velocities, sample: OdometrySample, last_frame_ns: int) -> Velocities:
    """Take one message of the odometry; one without velocities is noted as unusable."""
    velocity = tuple(sample.linear_velocity_mps.tolist())
    used = velocity if s.motion is not MotionModel.PLANAR else (velocity[0], 0.0, 0.0)
    if not all(map(math.isfinite, used)):
        return replace(known, unusable=True)
    late = bool(known.speed.t_ns) and sample.t_ns < known.speed.t_ns[-1]
    if late and sample.t_ns <= last_frame_ns:
        return replace(known, disorder=True)
    disorder = late or sample.t_ns < last_frame_ns
    window = known.window if late else _windowed(s, known.window.having(sample.t_ns, used))
    still = float(s.zero_velocity_update and stands(s, window))
    wheels = known.wheels
    turn = tuple(sample.angular_velocity_radps.tolist())
    if math.isfinite(turn[2]):
        turn = tuple(value if math.isfinite(value) else 0.0 for value in turn)
        wheels = _kept(wheels.having(sample.t_ns, turn), last_frame_ns)
    speed = _kept(known.speed.having(sample.t_ns, (*used, still)), last_frame_ns)
    moved = not still and _lasts(s, window)
    rest = known.rest._replace(over=True) if moved else known.rest
    return replace(
        known,
        speed=speed,
        wheels=wheels,
        window=window,
        rest=rest,
        disorder=known.disorder or disorder,
    )


def with_imu(s: RangeSettings, known: Velocities, sample: ImuSample, last_frame_ns: int) -> Velocities:
    """Take one message of the IMU; one without angular velocity is noted as unusable."""
    omega = s.body_r_imu @ sample.angular_velocity_radps
    if not np.isfinite(omega).all():
        return replace(known, unusable=True)
    late = bool(known.gyro.t_ns) and sample.t_ns < known.gyro.t_ns[-1]
    if late and sample.t_ns <= last_frame_ns:
        return replace(known, disorder=True)
    gyro = _kept(known.gyro.having(sample.t_ns, tuple(omega.tolist())), last_frame_ns)
    return replace(known, gyro=gyro, disorder=known.disorder or late or sample.t_ns < last_frame_ns)


def _kept(signal: Signal, last_frame_ns: int) -> Signal:
    """What the next frame may need; before the first frame that is the last second."""
    return signal if last_frame_ns >= 0 else signal.since(signal.t_ns[-1] - round(1.0 / NS))


def _lasts(s: RangeSettings, window: Signal) -> bool:
    """Whether the window is as long as the standstill asks for; half an interval is no matter."""
    t = window.t_ns
    return len(t) > 1 and (t[-1] - t[0]) * NS >= s.standstill_s - 0.5 * (t[-1] - t[-2]) * NS


def _windowed(s: RangeSettings, window: Signal) -> Signal:
    """The part that the standstill needs."""
    return window.since(window.t_ns[-1] - round(s.standstill_s / NS))


def stands(s: RangeSettings, window: Signal) -> bool:
    """Whether the robot stands: over every end of the window the way is what noise alone makes, |Σ Ṽ dt| ≤ n σ_V √T.

    The ends catch a start at once that the whole window would average away. Over the whole window the mean speed must
    be below `standstill_limit_mps` too: with a bad odometer a crawl is within the noise, and is no stop.
    """
    if not _lasts(s, window):
        return False
    t_ns = np.array(window.t_ns)
    back = np.diff(t_ns)[::-1, None] * NS * np.array(window.values[:0:-1])
    way_m = np.linalg.norm(np.cumsum(back, axis=0), axis=1)
    noise_m = s.standstill_sigmas * s.sigma_speed * np.sqrt((t_ns[-1] - t_ns[-2::-1]) * NS)
    if (way_m > noise_m).any():
        return False
    return bool(way_m[-1] <= s.standstill_limit_mps * (t_ns[-1] - t_ns[0]) * NS)


# ----------------------------------------------------------------------------- a frame


def turn_signal(s: RangeSettings, known: Velocities) -> Signal:
    """Whose angular velocity counts."""
    if s.gyro == "imu" or (s.gyro == "auto" and known.gyro.t_ns):
        return known.gyro
    return known.wheels


def complete(s: RangeSettings, known: Velocities) -> bool:
    """Whether there is a speed and a rate of turn."""
    return bool(known.speed.t_ns and turn_signal(s, known).t_ns)


def bias_of(s: RangeSettings, known: Velocities) -> Floats:
    """Bias of the angular velocity in robot axes [3], rad/s; the odometry's has none."""
    if turn_signal(s, known) is not known.gyro:
        return np.zeros(3)
    if s.gyro_bias == "standstill" and known.rest.time_s >= s.gyro_bias_min_s:
        return np.asarray(known.rest.sum_rad / known.rest.time_s)
    return np.array(s.gyro_bias_radps)


def ridden(s: RangeSettings, known: Velocities, last_ns: int, t_ns: int) -> tuple[Velocities, Ride]:
    """The camera's motion from the last frame to this one; what is kept for the next.

    Args:
        s: the settings.
        known: the messages; there is a speed and a rate of turn.
        last_ns: time of the last frame.
        t_ns: time of this one, later.
    """
    turn = turn_signal(s, known)
    # what comes after the frame (messages of the same time, or a disordered log) is for the next one
    found = intervals(
        *_arrays(turn, last_ns),
        *_arrays(known.speed, last_ns),
        np.array([0.0, (t_ns - last_ns) * NS]),
        s.synchronisation,
    )
    raw, velocity, still = found.omega.T, found.speed[:3].T, found.speed[3] == 1.0
    rest = _rested(s, known.rest, raw, still, found.dt) if turn is known.gyro else known.rest
    kept = replace(
        known,
        speed=known.speed.since(t_ns),
        wheels=known.wheels.since(t_ns),
        gyro=known.gyro.since(t_ns),
        rest=rest,
        disorder=False,
        unusable=False,
    )
    bias = bias_of(s, kept)
    # as printed, there is no rate of turn at all in an interval without a message of the gyro
    turned = np.asarray(raw.any(axis=1) | (s.synchronisation is not Synchronisation.AS_PRINTED))
    omega = np.where(turned[:, None], raw - bias, 0.0)
    velocity = np.where(still[:, None], 0.0, velocity)
    return kept, Ride(found.dt, *_at_camera(s, omega, velocity), still, bias)


def _arrays(signal: Signal, origin_ns: int) -> tuple[Floats, Floats]:
    return (np.array(signal.t_ns) - origin_ns) * NS, np.array(signal.values).T


def _rested(s: RangeSettings, rest: Rest, omega: Floats, still: NDArray[np.bool_], dt: Floats) -> Rest:
    """With the intervals of this frame, if the robot has not moved yet and does not turn either."""
    if rest.over or not still.all() or not len(dt):
        return rest
    if np.linalg.norm(dt @ omega) / dt.sum() > s.gyro_bias_limit_radps:
        return rest._replace(over=True)
    return rest._replace(sum_rad=rest.sum_rad + dt @ omega, time_s=rest.time_s + float(dt.sum()))


def _at_camera(s: RangeSettings, omega: Floats, velocity: Floats) -> tuple[Floats, Floats]:
    """Angular velocity and velocity [m, 3] of the camera in its axes, as far as the motion model takes them."""
    if s.motion is MotionModel.PLANAR:
        omega = omega * [0.0, 0.0, 1.0]
    if s.camera_position_m is not None:
        velocity = velocity + np.cross(omega, s.camera_position_m)
    omega, velocity = omega @ s.body_r_camera, velocity @ s.body_r_camera
    if s.motion is MotionModel.ALIGNED:
        return omega * [0.0, 1.0, 0.0], velocity * [0.0, 0.0, 1.0]
    return omega, velocity
