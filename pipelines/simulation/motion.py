"""How the vehicle moves: its exact position, velocity, acceleration and rates at any time.

World: z up. Body: x forward, y left, z up, its origin at the turning point. Attitude is
`world_r_body` = Rz(heading) Ry(pitch) Rx(roll), right-hand rule: a positive roll lifts the left side, a
positive pitch lowers the nose. A camera's axes are optical: x right, y down in the image, z out of the lens.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipelines.simulation.signals import smooth_step as smooth_step
from readers.streams import unknown_transform

Floats = NDArray[np.float64]

NADIR = np.diag([1.0, -1.0, -1.0])  # body_r_camera: straight down, image u forward, v to the right
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # straight ahead, image u to the right, v down


@dataclass(frozen=True, slots=True)
class Kinematics:
    """A rigid body's motion at n times.

    Attributes:
        t_s: times since the start of the mission [n].
        position_m: its origin in the world [n, 3].
        world_r_body: rotation [n, 3, 3].
        velocity_mps: derivative of the position, world axes [n, 3].
        acceleration_mps2: second derivative, world axes [n, 3].
        angular_velocity_radps: of the body against the world, body axes [n, 3].
        angular_acceleration_radps2: its derivative, body axes [n, 3].
        heading_rad: rotation about z, continuous over full turns [n].
    """

    t_s: Floats
    position_m: Floats
    world_r_body: Floats
    velocity_mps: Floats
    acceleration_mps2: Floats
    angular_velocity_radps: Floats
    angular_acceleration_radps2: Floats
    heading_rad: Floats

    @property
    def body_velocity_mps(self) -> Floats:
        """Velocity in body axes [n, 3]."""
        return rotated(self.world_r_body.swapaxes(1, 2), self.velocity_mps)

    @property
    def poses(self) -> Floats:
        """The plane pose: x (m), y (m), heading (rad) [n, 3]."""
        return np.column_stack([self.position_m[:, :2], self.heading_rad])

    def at_point(self, point_m: Floats) -> Kinematics:
        """The motion of another point of the same body, `point_m` [3] in body axes, with the same axes."""
        rate, change = self.angular_velocity_radps, self.angular_acceleration_radps2
        offset = np.broadcast_to(point_m, rate.shape)
        swing = cross(rate, offset)
        pull = cross(change, offset) + cross(rate, swing)
        return Kinematics(
            t_s=self.t_s,
            position_m=self.position_m + rotated(self.world_r_body, offset),
            world_r_body=self.world_r_body,
            velocity_mps=self.velocity_mps + rotated(self.world_r_body, swing),
            acceleration_mps2=self.acceleration_mps2 + rotated(self.world_r_body, pull),
            angular_velocity_radps=rate,
            angular_acceleration_radps2=change,
            heading_rad=self.heading_rad,
        )


class Motion(Protocol):
    """A vehicle's motion over time, differentiable and exact."""

    @property
    def duration_s(self) -> float:
        """Length of the motion; it is known from 0 to here, both included, and stands still outside."""
        ...

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n] in seconds since the start, in any order."""
        ...


class Hold(StrEnum):
    """How a camera hangs on the vehicle."""

    RIGID = "rigid"
    """Fixed to the body: it turns with it (paper A)."""
    LEVELLED = "levelled"
    """In a gimbal of two axes: it follows the heading, roll and pitch are taken out."""
    GIMBALLED = "gimballed"
    """In a gimbal of three axes: it keeps its orientation in the world (paper A0), that of heading 0."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Where a camera sits: `position_m` [3] and `body_r_camera` [3, 3] in body axes, and how it is held."""

    position_m: Floats = field(default_factory=lambda: np.zeros(3))
    body_r_camera: Floats = field(default_factory=lambda: NADIR)
    hold: Hold = Hold.RIGID

    @property
    def body_t_camera(self) -> Floats:
        """The transform [4, 4] from camera to body; NaN where a gimbal moves it."""
        transform = unknown_transform()
        if self.hold is Hold.RIGID:
            transform[:3] = np.column_stack([self.body_r_camera, self.position_m])
            transform[3] = [0, 0, 0, 1]
        return transform

    def world_t_camera(self, motion: Kinematics) -> tuple[Floats, Floats]:
        """Rotations `world_r_camera` [n, 3, 3] and positions in the world [n, 3] of the camera."""
        position = motion.at_point(self.position_m).position_m
        if self.hold is Hold.RIGID:
            turn = motion.world_r_body
        elif self.hold is Hold.LEVELLED:
            turn = rotations(motion.heading_rad, np.zeros(1), np.zeros(1))
        else:
            turn = np.broadcast_to(np.eye(3), motion.world_r_body.shape)
        return np.asarray(turn @ self.body_r_camera), position


def rotations(heading_rad: Floats, pitch_rad: Floats, roll_rad: Floats) -> Floats:
    """`world_r_body` [n, 3, 3] = Rz(heading) Ry(pitch) Rx(roll) of angles [n] (or [1] for all)."""
    h, p, r = heading_rad, pitch_rad, roll_rad
    ch, sh, cp, sp, cr, sr = np.cos(h), np.sin(h), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    out = np.empty((*np.broadcast_shapes(h.shape, p.shape, r.shape), 3, 3))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = -sp, cp * sr, cp * cr
    return out


# Written out term by term, so that the last digit does not depend on how many times are asked for at once.


def rotated(matrices: Floats, vectors: Floats) -> Floats:
    """Matrices [n, 3, 3] times vectors [n, 3]."""
    total: Floats = matrices[:, :, 0] * vectors[:, None, 0]
    for k in (1, 2):
        total = total + matrices[:, :, k] * vectors[:, None, k]
    return total


def chained(first: Floats, second: Floats) -> Floats:
    """Products [n, 3, 3] of matrices [n, 3, 3]."""
    total: Floats = first[:, :, 0, None] * second[:, None, 0]
    for k in (1, 2):
        total = total + first[:, :, k, None] * second[:, None, k]
    return total


def cross(a: Floats, b: Floats) -> Floats:
    """Vector products [n, 3] of vectors [n, 3]."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def looking(base: Floats, *, yaw_rad: float = 0.0, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> Floats:
    """`body_r_camera` [3, 3] of a camera that is turned out of `base` (`NADIR`, `FORWARD`) about body axes."""
    one = np.ones(1)
    turned: Floats = rotations(yaw_rad * one, pitch_rad * one, roll_rad * one)[0] @ base
    return turned


@dataclass(frozen=True)
class Waypoints:
    """Poses at given times, straight lines between them.

    Args:
        t_s: times [n], rising, the first 0.
        poses: x (m), y (m), heading (rad, continuous) [n, 3].
        height_m: height of the body's origin above z = 0, one number or [n].
        roll_rad: roll, one number or [n].
        pitch_rad: pitch, one number or [n].

    Velocities and rates are those of the piece that begins at the time; accelerations are zero.

    Raises:
        ValueError: an array has another length than the times.
    """

    t_s: Floats
    poses: Floats
    height_m: float | Floats = 0.0
    roll_rad: float | Floats = 0.0
    pitch_rad: float | Floats = 0.0

    def __post_init__(self) -> None:
        n = len(self.t_s)
        for name in ("height_m", "roll_rad", "pitch_rad"):
            array = np.asarray(getattr(self, name), dtype=np.float64)
            if array.ndim and array.shape != (n,):
                raise ValueError(f"{name}: an array of shape {array.shape} for {n} poses: give one number or [{n}]")
            object.__setattr__(self, name, np.broadcast_to(array, (n,)))
        if self.poses.shape != (n, 3):
            raise ValueError(f"poses of shape {self.poses.shape} for {n} times: [{n}, 3] is needed")

    @property
    def duration_s(self) -> float:
        """Time of the last pose."""
        return float(self.t_s[-1])

    def at(self, t_s: Floats) -> Kinematics:
        """Interpolate linearly; before the first and after the last pose the body stands still."""
        columns = np.column_stack([self.poses, self.height_m, self.pitch_rad, self.roll_rad])
        value = np.column_stack([np.interp(t_s, self.t_s, column) for column in columns.T])
        rate = np.zeros_like(value)
        if len(self.t_s) > 1:
            piece = np.searchsorted(self.t_s, t_s, side="right") - 1
            moving = (piece >= 0) & (piece < len(self.t_s) - 1)
            slopes = np.diff(columns, axis=0) / np.diff(self.t_s)[:, None]
            rate[moving] = slopes[piece[moving]]
        x, y, heading, z, pitch, roll = value.T
        zeros = np.zeros((len(value), 3))
        return Kinematics(
            t_s=np.asarray(t_s, dtype=np.float64),
            position_m=np.column_stack([x, y, z]),
            world_r_body=rotations(heading, pitch, roll),
            velocity_mps=rate[:, [0, 1, 3]],
            acceleration_mps2=zeros,
            angular_velocity_radps=body_rates(pitch, roll, rate[:, 2], rate[:, 4], rate[:, 5]),
            angular_acceleration_radps2=zeros,
            heading_rad=heading,
        )


def body_rates(
    pitch_rad: Floats, roll_rad: Floats, heading_rate: Floats, pitch_rate: Floats, roll_rate: Floats
) -> Floats:
    """Angular velocity in body axes [n, 3] of rates of heading, pitch and roll, each [n], in rad/s."""
    cp, sp, cr, sr = np.cos(pitch_rad), np.sin(pitch_rad), np.cos(roll_rad), np.sin(roll_rad)
    return np.column_stack(
        [
            roll_rate - sp * heading_rate,
            cr * pitch_rate + cp * sr * heading_rate,
            -sr * pitch_rate + cp * cr * heading_rate,
        ]
    )
