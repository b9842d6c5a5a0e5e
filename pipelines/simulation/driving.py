"""Motions in closed form: curves driven at a speed, turns on the spot, sequences, swaying, disturbances.

All of them are `Motion`s: position, velocity, acceleration, attitude, angular velocity and acceleration are
analytic derivatives of one another, and what is found for a time does not depend on the other times asked
for. Axes and signs are those of `motion`. Each stands still before its start and after its end.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.curves import Curve, Frenet
from pipelines.simulation.faults import Fault, HeightChange, ShiftJump, TurnJump, of_kind
from pipelines.simulation.motion import Kinematics, Motion, body_rates, chained, cross, rotated, rotations
from pipelines.simulation.signals import Signal, as_signal, smooth_step
from pipelines.simulation.speeds import Speed

Floats = NDArray[np.float64]
Derivatives = tuple[Floats, Floats, Floats]  # value, first and second derivative by time
Pulse = ShiftJump | TurnJump | HeightChange

JOINT = 1e-6  # position, attitude (m, rad) and rates (m/s, rad/s) that may differ where motions are joined


@dataclass(frozen=True, eq=False)
class Drive:
    """A curve, driven at a speed.

    The body's origin runs along the curve; with the arc length s(t), curvature κ and sideslip β

        velocity = ṡ T,  acceleration = s̈ T + κ ṡ² N,  heading = direction of T - β,
        heading rate = κ ṡ - β̇,  its derivative = κ' ṡ² + κ s̈ - β̈.

    Args:
        curve: where it drives.
        speed: how fast; negative in reverse.
        sideslip_rad: angle β from the body's forward axis to the direction of travel, positive to the left.
        height_m: height of the body's origin above z = 0.
        roll_rad: roll, a number or a signal such as `fluctuation(...)`.
        pitch_rad: pitch, a number or a signal.
        start_m: arc length on the curve at the start.

    Raises:
        ValueError: the speed leads beyond an end of the curve.
    """

    curve: Curve
    speed: Speed
    sideslip_rad: Signal | float = 0.0
    height_m: Signal | float = 0.0
    roll_rad: Signal | float = 0.0
    pitch_rad: Signal | float = 0.0
    start_m: float = 0.0
    _way: Callable[[Floats], Frenet] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        least, most = (self.start_m + arc for arc in self.speed.extent())
        if not self.curve.reaches(least, most):
            raise ValueError(
                f"the drive leads from {least:.6g} m to {most:.6g} m of a curve of {self.curve.length_m:.6g} m: "
                "drive less long or make the curve longer"
            )
        object.__setattr__(self, "_way", self.curve.measured(least, most))

    @property
    def duration_s(self) -> float:
        """Length of the speed profile."""
        return self.speed.duration_s

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]."""
        t_s, inside, clipped = _times(t_s, self.duration_s)
        arc, v, a = self.speed.at(clipped)
        way = self._way(self.start_m + arc)
        slip, slip_rate, slip_change = as_signal(self.sideslip_rad).at(clipped)
        v, a, slip_rate, slip_change = (x * inside for x in (v, a, slip_rate, slip_change))
        cos, sin = np.cos(way.heading_rad), np.sin(way.heading_rad)
        pull = way.curvature * v**2
        plane = _on_the_plane(
            t_s,
            ((way.point_m[0], v * cos, a * cos - pull * sin), (way.point_m[1], v * sin, a * sin + pull * cos)),
            (
                way.heading_rad - slip,
                way.curvature * v - slip_rate,
                way.curvature_rate * v**2 + way.curvature * a - slip_change,
            ),
        )
        if all(isinstance(x, int | float) and x == 0 for x in (self.height_m, self.roll_rad, self.pitch_rad)):
            return plane
        return swayed(plane, *_signals((self.height_m, self.roll_rad, self.pitch_rad), clipped, inside))


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn on the spot, at the origin from heading 0, as a quintic smooth step of `duration_s`.

    The rate is 1.875 turn_rad/duration_s at its greatest; a turn of 0 is a stop.

    Raises:
        ValueError: the duration is not positive.
    """

    turn_rad: float
    duration_s: float

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ValueError(f"a turn or stop of {self.duration_s} s: it must take some time")

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]."""
        t_s = np.asarray(t_s, dtype=np.float64)
        step, slope, bend = smooth_step(t_s / self.duration_s)
        zeros = np.zeros(len(t_s))
        still = (zeros, zeros, zeros)
        turn = (
            self.turn_rad * step,
            self.turn_rad / self.duration_s * slope,
            self.turn_rad / self.duration_s**2 * bend,
        )
        return _on_the_plane(t_s, (still, still), turn)


def stop(duration_s: float) -> Turn:
    """A stop of that length at the origin, heading 0."""
    return Turn(0.0, duration_s)


@dataclass(frozen=True, slots=True)
class Placed:
    """A motion in a world that is turned by `heading_rad` about z and then moved by `x_m`, `y_m`."""

    motion: Motion
    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0

    @property
    def duration_s(self) -> float:
        """Length of the motion."""
        return self.motion.duration_s

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]."""
        base = self.motion.at(t_s)
        turn = rotations(np.full(len(base.t_s), self.heading_rad), np.zeros(1), np.zeros(1))
        return dataclasses.replace(
            base,
            position_m=rotated(turn, base.position_m) + np.array([self.x_m, self.y_m, 0.0]),
            world_r_body=chained(turn, base.world_r_body),
            velocity_mps=rotated(turn, base.velocity_mps),
            acceleration_mps2=rotated(turn, base.acceleration_mps2),
            heading_rad=base.heading_rad + self.heading_rad,
        )


@dataclass(frozen=True, eq=False)
class Chain:
    """Motions one after the other, each placed where the one before ended (position in the plane and heading).

    A part begins at its own time 0, so let random signals sway the whole: ``Swaying(Chain(...), ...)``.

    Args:
        parts: the motions, at least one.

    Raises:
        ValueError: there is none, or a part begins with another height, attitude, velocity or rate than the
            one before it ended with (a jump that no vehicle and no IMU could follow).
    """

    parts: Sequence[Motion]
    _placed: tuple[Motion, ...] = field(init=False, repr=False)
    _begin_s: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("a chain of no motions")
        placed: list[Motion] = [self.parts[0]]
        for k, part in enumerate(self.parts[1:], start=1):
            before = placed[-1].at(np.array([placed[-1].duration_s]))
            placed.append(_moved_to(part, before))
            _demand_smooth(before, placed[-1].at(np.zeros(1)), k)
        object.__setattr__(self, "_placed", tuple(placed))
        begin_s = np.concatenate([[0.0], np.cumsum([part.duration_s for part in placed])])
        object.__setattr__(self, "_begin_s", begin_s)

    @property
    def duration_s(self) -> float:
        """Sum of the parts' lengths."""
        return float(self._begin_s[-1])

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]; at a joint that of the part that begins."""
        t_s = np.asarray(t_s, dtype=np.float64)
        number = np.clip(np.searchsorted(self._begin_s, t_s, side="right") - 1, 0, len(self._placed) - 1)
        whole: dict[str, Floats] = {}
        for k in np.unique(number):
            mine = number == k
            part, local = self._placed[k], t_s[mine] - self._begin_s[k]
            # rounding must not carry a time of the last part beyond its end
            local = np.where(t_s[mine] <= self._begin_s[k + 1], np.minimum(local, part.duration_s), local)
            found = part.at(local)
            for name in _COLUMNS:
                column = getattr(found, name)
                whole.setdefault(name, np.empty((len(t_s), *column.shape[1:])))[mine] = column
        if not whole:
            return self._placed[0].at(t_s)
        return Kinematics(t_s=t_s, **whole)


_COLUMNS = tuple(item.name for item in dataclasses.fields(Kinematics) if item.name != "t_s")


@dataclass(frozen=True, slots=True)
class Swaying:
    """A motion whose body heaves, rolls and pitches besides: the attitude becomes base · Ry(pitch) Rx(roll).

    Args:
        motion: the motion it adds to; an upright one for roll and pitch to be those of `Kinematics`.
        height_m: what is added to the height, a number or a signal.
        roll_rad: roll, a number or a signal.
        pitch_rad: pitch, a number or a signal.
    """

    motion: Motion
    height_m: Signal | float = 0.0
    roll_rad: Signal | float = 0.0
    pitch_rad: Signal | float = 0.0

    @property
    def duration_s(self) -> float:
        """Length of the motion."""
        return self.motion.duration_s

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]."""
        t_s, inside, clipped = _times(t_s, self.duration_s)
        return swayed(self.motion.at(t_s), *_signals((self.height_m, self.roll_rad, self.pitch_rad), clipped, inside))


@dataclass(frozen=True, eq=False)
class Disturbed:
    """A motion with the pushes, turns and lifts of a list of faults; faults of other kinds are passed over.

    Each is a pulse that rises and falls back by a quintic `smooth_step` within its `ramp_s`. A `TurnJump`
    turns the body about its origin, a `HeightChange` lifts it, a `ShiftJump` moves it by a fixed vector in
    the world: (forward, left) of the heading that it has when the push begins.

    Raises:
        ValueError: a pulse is shorter than its two ramps, or a ramp takes no time.
    """

    motion: Motion
    faults: Iterable[Fault]
    _turns: tuple[TurnJump, ...] = field(init=False, repr=False)
    _lifts: tuple[HeightChange, ...] = field(init=False, repr=False)
    _pushes: tuple[tuple[ShiftJump, float, float], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        faults = tuple(self.faults)
        turns, lifts, pushes = (of_kind(faults, TurnJump), of_kind(faults, HeightChange), of_kind(faults, ShiftJump))
        pulses: tuple[Pulse, ...] = (*turns, *lifts, *pushes)
        for fault in pulses:
            if not 0 < 2 * fault.ramp_s <= fault.stop_s - fault.start_s:
                raise ValueError(
                    f"{fault.name} from {fault.start_s:g} s to {fault.stop_s:g} s with ramps of {fault.ramp_s:g} s: "
                    "ramps must take some time, and there must be time for both"
                )
        object.__setattr__(self, "faults", faults)
        object.__setattr__(self, "_turns", turns)
        object.__setattr__(self, "_lifts", lifts)
        object.__setattr__(self, "_pushes", tuple(self._push(fault) for fault in pushes))

    @property
    def duration_s(self) -> float:
        """Length of the motion."""
        return self.motion.duration_s

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]."""
        t_s, inside, clipped = _times(t_s, self.duration_s)
        base = self.motion.at(t_s)
        if self._turns:
            base = _turned(base, _pulses([(f, f.turn_rad) for f in self._turns], clipped, inside))
        pushes = self._pushes
        shift = [
            _pulses([(f, x) for f, x, _ in pushes], clipped, inside),
            _pulses([(f, y) for f, _, y in pushes], clipped, inside),
            _pulses([(f, f.lift_m) for f in self._lifts], clipped, inside),
        ]
        place, velocity, acceleration = (np.stack(columns, axis=-1) for columns in zip(*shift, strict=True))
        return _shifted(base, (place, velocity, acceleration))

    def _push(self, fault: ShiftJump) -> tuple[ShiftJump, float, float]:
        """The push in world axes."""
        start = np.clip([fault.start_s], 0.0, self.duration_s)
        turn, _, _ = _pulses([(f, f.turn_rad) for f in self._turns], start, np.ones(1, dtype=bool))
        heading = float(self.motion.at(start).heading_rad[0] + turn[0])
        cos, sin = math.cos(heading), math.sin(heading)
        return fault, cos * fault.forward_m - sin * fault.left_m, sin * fault.forward_m + cos * fault.left_m


def swayed(base: Kinematics, height_m: Derivatives, roll_rad: Derivatives, pitch_rad: Derivatives) -> Kinematics:
    """A motion lifted by a height, and turned by Ry(pitch) Rx(roll) in its body axes.

    With L = Ry Rx and its own rate λ in the new axes, ω' = Lᵀω + λ and ω̇' = Lᵀω̇ + λ̇ - λ × Lᵀω.
    """
    (roll, roll_rate, roll_change), (pitch, pitch_rate, pitch_change) = roll_rad, pitch_rad
    tilt = rotations(np.zeros(1), pitch, roll)
    back = tilt.swapaxes(1, 2)
    cos, sin = np.cos(roll), np.sin(roll)
    own = body_rates(pitch, roll, np.zeros_like(pitch), pitch_rate, roll_rate)
    own_change = np.stack(
        [
            roll_change,
            cos * pitch_change - sin * roll_rate * pitch_rate,
            -sin * pitch_change - cos * roll_rate * pitch_rate,
        ],
        axis=-1,
    )
    carried = rotated(back, base.angular_velocity_radps)
    change = rotated(back, base.angular_acceleration_radps2) + own_change - cross(own, carried)
    zeros = np.zeros_like(roll)
    lift = tuple(np.stack([zeros, zeros, part], axis=-1) for part in height_m)
    return dataclasses.replace(
        _shifted(base, (lift[0], lift[1], lift[2])),
        world_r_body=chained(base.world_r_body, tilt),
        angular_velocity_radps=carried + own,
        angular_acceleration_radps2=change,
    )


def _turned(base: Kinematics, turn_rad: Derivatives) -> Kinematics:
    """A motion whose body is turned about the world's z axis through its origin by δ.

    ω' = ω + δ̇ e and ω̇' = ω̇ + δ̈ e - δ̇ ω × e with e the world's z axis in body axes (the same before and after).
    """
    angle, rate, change = turn_rad
    up = base.world_r_body[:, 2]
    swing = cross(base.angular_velocity_radps, up)
    return dataclasses.replace(
        base,
        world_r_body=chained(rotations(angle, np.zeros(1), np.zeros(1)), base.world_r_body),
        angular_velocity_radps=base.angular_velocity_radps + rate[:, None] * up,
        angular_acceleration_radps2=base.angular_acceleration_radps2 + change[:, None] * up - rate[:, None] * swing,
        heading_rad=base.heading_rad + angle,
    )


def _shifted(base: Kinematics, shift_m: Derivatives) -> Kinematics:
    """A motion moved by a vector [n, 3] in world axes."""
    return dataclasses.replace(
        base,
        position_m=base.position_m + shift_m[0],
        velocity_mps=base.velocity_mps + shift_m[1],
        acceleration_mps2=base.acceleration_mps2 + shift_m[2],
    )


def _pulses(pulses: Sequence[tuple[Pulse, float]], t_s: Floats, inside: NDArray[np.bool_]) -> Derivatives:
    """Sum of pulses of given heights with their faults' times and ramps, at times [n]."""
    total = np.zeros((3, len(t_s)))
    for fault, height in pulses:
        rise = smooth_step((t_s - fault.start_s) / fault.ramp_s)
        fall = smooth_step((t_s - (fault.stop_s - fault.ramp_s)) / fault.ramp_s)
        for order in range(3):
            total[order] += height / fault.ramp_s**order * (rise[order] - fall[order])
    return total[0], total[1] * inside, total[2] * inside


def _times(t_s: Floats, duration_s: float) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Times [n] as an array, which of them lie within the motion, and the nearest that do."""
    t_s = np.asarray(t_s, dtype=np.float64)
    return t_s, (t_s >= 0) & (t_s <= duration_s), np.clip(t_s, 0.0, duration_s)


def _signals(signals: Iterable[Signal | float], t_s: Floats, inside: NDArray[np.bool_]) -> list[Derivatives]:
    found = (as_signal(signal).at(t_s) for signal in signals)
    return [(value, rate * inside, change * inside) for value, rate, change in found]


def _on_the_plane(t_s: Floats, place: tuple[Derivatives, Derivatives], heading: Derivatives) -> Kinematics:
    """The motion of x, y and heading, upright at height 0."""
    zeros = np.zeros(len(t_s))
    position, velocity, acceleration = (np.stack([x, y, zeros], axis=-1) for x, y in zip(*place, strict=True))
    angle, rate, change = heading
    return Kinematics(
        t_s=t_s,
        position_m=position,
        world_r_body=rotations(angle, np.zeros(1), np.zeros(1)),
        velocity_mps=velocity,
        acceleration_mps2=acceleration,
        angular_velocity_radps=np.stack([zeros, zeros, rate], axis=-1),
        angular_acceleration_radps2=np.stack([zeros, zeros, change], axis=-1),
        heading_rad=angle,
    )


def _moved_to(part: Motion, before: Kinematics) -> Placed:
    """The part, placed so that it begins at the last pose of the motion before it."""
    (x, y, heading), (own_x, own_y, own_heading) = before.poses[-1], part.at(np.zeros(1)).poses[0]
    turn = float(heading - own_heading)
    cos, sin = math.cos(turn), math.sin(turn)
    return Placed(part, float(x - cos * own_x + sin * own_y), float(y - sin * own_x - cos * own_y), turn)


def _demand_smooth(before: Kinematics, after: Kinematics, part: int) -> None:
    for name, what in (
        ("position_m", "height"),
        ("world_r_body", "roll and pitch"),
        ("velocity_mps", "velocity"),
        ("angular_velocity_radps", "angular velocity"),
    ):
        old, new = getattr(before, name)[0], getattr(after, name)[0]
        if np.max(np.abs(old - new)) > JOINT:
            raise ValueError(
                f"part {part} of the chain begins with another {what} than the one before ends with "
                f"({_text(new)} against {_text(old)}): join motions at a standstill, and let signals sway the whole chain"
            )


def _text(array: Floats) -> str:
    return np.array2string(array, precision=4, suppress_small=True).replace("\n", "")
