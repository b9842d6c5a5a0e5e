"""The sensors of a simulated mission except its cameras' images: each as a `Channel` of samples.

A sensor is a frozen dataclass of plain numbers (what it is, its defaults named) and a function that makes its
channel from a `Motion`. All its errors are drawn when the channel is made, from the mission's seed, the
stream's name and the error's name, so that any sample can be made by itself, and one error does not change
another. Noise densities are as in `noise`: a sample has σ·√rate. The intervals of faults are in true time.

World and body: z up, x forward, y left. Angles of a mounting are yaw, pitch, roll of ``body_r_sensor`` =
Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.geometry import from_local_enu
from pipelines.lens import project, rays
from pipelines.simulation.channels import Channel, rng_of
from pipelines.simulation.checks import check, check_word
from pipelines.simulation.faults import (
    FAULTS_STREAM,
    Fault,
    GyroBias,
    OdometerScale,
    TrackOutliers,
    TrackSlip,
    WrongCalibration,
    of_kind,
    to_text,
)
from pipelines.simulation.motion import Kinematics, Motion, Mount, rotations
from pipelines.simulation.noise import in_ticks, measured
from pipelines.simulation.timing import Schedule, Timing, during, frozen, schedule
from readers.streams import (
    UNKNOWN_COV3,
    UNKNOWN_COV6,
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    Camera,
    CameraInfo,
    GnssSample,
    ImuSample,
    OdometrySample,
    PoseSample,
    RangeSample,
    Sample,
    StreamKind,
    TextSample,
    TrackSample,
)

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]
Sampling = Literal["mean", "instant"]
"""A sample is the mean over the interval between two of them, its time in the middle, as sensors that count
or integrate give it: the trapezoids over the samples are then the truth's own, whatever happens in between.
Or it is the value of the instant, which a motion with jumps in its acceleration can hide much between."""
Ground = Callable[[Floats, Floats], Floats]
"""Height of the ground in m [n] at world x and y in m, each [n]."""

IMU, ODOMETRY, REFERENCE, TRUTH = "/imu", "/wheel/odometry", "/reference/pose", "/truth/odometry"
HEIGHT, CALIBRATION, TRACKS, GNSS = "/camera/height", "/camera/camera_info", "/camera/tracks", "/gnss/fix"
WORLD_FRAME, ODOMETRY_FRAME, BODY_FRAME = "world", "odom", "base_link"
IMU_FRAME, CAMERA_FRAME, GNSS_FRAME = "imu", "camera", "gnss"

SAMPLINGS = ("mean", "instant")
GRAVITY_MPS2 = np.array([0.0, 0.0, 9.80665])  # what an accelerometer at rest feels, upwards


# ------------------------------------------------------------------------------------- IMU


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu:
    """An inertial measurement unit: three gyros and three accelerometers.

    Attributes:
        timing: when it measures.
        sampling: what a sample is, see `Sampling`.
        position_m: where it sits in the body.
        yaw_pitch_roll_rad: its axes in the body.
        gyro_density: white noise of the angular velocity, rad/s/√Hz; the default is paper B's Table 1.
        gyro_bias_radps: constant error about its axes.
        gyro_walk: random walk of that bias, rad/s²/√Hz.
        gyro_scale: scale error, 0.01 for a hundredth too much.
        force_density: white noise of the specific force, m/s²/√Hz; the default is a common MEMS sensor's.
        force_bias_mps2: constant error along its axes.
        force_walk: random walk of that bias, m/s³/√Hz.
        force_scale: scale error.
        orientation: whether it tells its orientation in the world too.
        orientation_noise_rad: standard deviation of that about each of its axes.
    """

    timing: Timing = Timing(rate_hz=100.0)
    sampling: Sampling = "mean"
    position_m: Triple = (0.0, 0.0, 0.0)
    yaw_pitch_roll_rad: Triple = (0.0, 0.0, 0.0)
    gyro_density: float = 1e-3
    gyro_bias_radps: Triple = (0.0, 0.0, 0.0)
    gyro_walk: float = 0.0
    gyro_scale: float = 0.0
    force_density: float = 2e-3
    force_bias_mps2: Triple = (0.0, 0.0, 0.0)
    force_walk: float = 0.0
    force_scale: float = 0.0
    orientation: bool = False
    orientation_noise_rad: float = 0.0

    def __post_init__(self) -> None:
        check(self, "0 or more", "gyro_density", "gyro_walk", "force_density", "force_walk", "orientation_noise_rad")
        check(self, "a finite number", "position_m", "yaw_pitch_roll_rad", "gyro_bias_radps", "gyro_scale")
        check(self, "a finite number", "force_bias_mps2", "force_scale")
        check_word(self, "sampling", SAMPLINGS)


def imu_channel(
    motion: Motion, imu: Imu, *, start_ns: int, seed: int, faults: Sequence[Fault] = (), stream: str = IMU
) -> Channel:
    """Angular velocity and specific force at the IMU's place, in its axes.

    ω_imu = imu_r_body ω and f = imu_r_world (a + g), with a the acceleration of the IMU's place and g =
    9.80665 m/s² upwards: at rest and level it feels +g on z. As means, a and ω are the change of velocity and
    the turn within the interval, divided by its length, in the axes of the sample's time. Each has its errors
    (`noise.measured`), and `GyroBias` faults add to the angular velocity.
    """
    plan, dice, state = _observed(motion, imu.timing, start_ns, seed, stream, imu.position_m)
    rate_hz = imu.timing.rate_hz
    body_r_imu = _mounting(imu.yaw_pitch_roll_rad)
    world_r_imu = state.world_r_body @ body_r_imu
    felt = _felt(imu.sampling, motion, state, rate_hz, imu.position_m)
    rate = measured(
        felt.rate_radps @ body_r_imu,
        partial(dice, "gyro"),
        rate_hz,
        density=imu.gyro_density,
        bias=imu.gyro_bias_radps,
        walk=imu.gyro_walk,
        scale=imu.gyro_scale,
    )
    for fault in of_kind(faults, GyroBias):
        rate[during([fault], plan.t_s)] += np.array(fault.bias_radps) @ body_r_imu
    force = measured(
        _in_axes(world_r_imu, felt.acceleration_mps2 + GRAVITY_MPS2),
        partial(dice, "force"),
        rate_hz,
        density=imu.force_density,
        bias=imu.force_bias_mps2,
        walk=imu.force_walk,
        scale=imu.force_scale,
    )
    quats = np.broadcast_to(UNKNOWN_QUAT, (len(rate), 4))
    if imu.orientation:
        errors = imu.orientation_noise_rad * dice("orientation").standard_normal((len(rate), 3))
        quats = (Rotation.from_matrix(world_r_imu) * Rotation.from_rotvec(errors)).as_quat()
    for array in (rate, force, quats):
        frozen(array)

    def sample(number: int, t_ns: int, received_ns: int) -> ImuSample:
        return ImuSample(
            stream=stream,
            t_ns=t_ns,
            received_ns=received_ns,
            angular_velocity_radps=rate[number],
            linear_acceleration_mps2=force[number],
            quat_xyzw=quats[number],
        )

    return _channel(stream, StreamKind.IMU, "sensor_msgs/msg/Imu", IMU_FRAME, plan, sample)


# -------------------------------------------------------------------------- wheel odometer


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometer:
    """A wheel odometer at the body's origin, the vehicle's turning point.

    Attributes:
        timing: when it measures.
        sampling: what a sample is, see `Sampling`.
        message: ``odometry`` (nav_msgs/Odometry, with a pose) or ``twist`` (geometry_msgs/TwistStamped).
        speed_density: white noise of the forward speed, m/s/√Hz; the default is paper B's Table 1.
        speed_bias_mps: constant error of the speed.
        speed_walk: random walk of that bias, m/s²/√Hz.
        speed_scale: scale error of the speed (a wrong wheel radius), 0.01 for a hundredth too much.
        turn_density: white noise of the yaw rate, rad/s/√Hz.
        turn_bias_radps: constant error of the yaw rate.
        turn_walk: random walk of that bias, rad/s²/√Hz.
        turn_scale: scale error of the yaw rate (a wrong track).
        tick_m: way of a wheel from one tick of its encoder to the next; 0 for no ticks.
        track_m: distance of the left and the right wheel, which the ticks become a yaw rate by.
    """

    timing: Timing = Timing(rate_hz=50.0)
    sampling: Sampling = "mean"
    message: Literal["odometry", "twist"] = "odometry"
    speed_density: float = 0.01
    speed_bias_mps: float = 0.0
    speed_walk: float = 0.0
    speed_scale: float = 0.0
    turn_density: float = 0.01
    turn_bias_radps: float = 0.0
    turn_walk: float = 0.0
    turn_scale: float = 0.0
    tick_m: float = 0.0
    track_m: float = 0.5

    def __post_init__(self) -> None:
        check(self, "0 or more", "speed_density", "speed_walk", "turn_density", "turn_walk", "tick_m")
        check(self, "a finite number", "speed_bias_mps", "speed_scale", "turn_bias_radps", "turn_scale")
        check(self, "above 0", "track_m")
        check_word(self, "sampling", SAMPLINGS)
        check_word(self, "message", ("odometry", "twist"))


def odometer_channel(
    motion: Motion,
    odometer: Odometer,
    *,
    start_ns: int,
    seed: int,
    faults: Sequence[Fault] = (),
    stream: str = ODOMETRY,
) -> Channel:
    """Forward speed and yaw rate of the body, as wheels tell them.

    Speed along body x and rate about body z have their errors (`noise.measured`), `OdometerScale` faults
    multiply the speed, then the encoders count whole ticks. Wheels know no sideways motion: y and z are 0.
    The pose of ``odometry`` is the dead reckoning of these values from the origin (`dead_reckoning`).
    """
    plan, dice, state = _observed(motion, odometer.timing, start_ns, seed, stream)
    felt = _felt(odometer.sampling, motion, state, odometer.timing.rate_hz)
    factor = np.ones(len(plan.t_s))
    for fault in of_kind(faults, OdometerScale):
        factor[during([fault], plan.t_s)] *= fault.factor
    speed, turn = _told_by_wheels(odometer, felt, factor, dice)
    zeros = np.zeros_like(speed)
    velocity, rate = frozen(np.column_stack([speed, zeros, zeros])), frozen(np.column_stack([zeros, zeros, turn]))
    posed = odometer.message == "odometry"
    position, quats = dead_reckoning(plan.t_s, speed, turn)

    def sample(number: int, t_ns: int, received_ns: int) -> OdometrySample:
        return OdometrySample(
            stream=stream,
            t_ns=t_ns,
            received_ns=received_ns,
            linear_velocity_mps=velocity[number],
            angular_velocity_radps=rate[number],
            position_m=position[number] if posed else UNKNOWN_VEC3,
            quat_xyzw=quats[number] if posed else UNKNOWN_QUAT,
        )

    message = "nav_msgs/msg/Odometry" if posed else "geometry_msgs/msg/TwistStamped"
    frame = ODOMETRY_FRAME if posed else BODY_FRAME
    return _channel(stream, StreamKind.ODOMETRY, message, frame, plan, sample)


def _told_by_wheels(odometer: Odometer, felt: _Felt, factor: Floats, dice: Dice) -> tuple[Floats, Floats]:
    """Speed in m/s and yaw rate in rad/s [n] with all errors; the speed is off by a `factor` [n] besides."""
    rate_hz = odometer.timing.rate_hz
    speed = factor * measured(
        felt.body_velocity_mps[:, 0],
        partial(dice, "speed"),
        rate_hz,
        density=odometer.speed_density,
        bias=odometer.speed_bias_mps,
        walk=odometer.speed_walk,
        scale=odometer.speed_scale,
    )
    turn = measured(
        felt.rate_radps[:, 2],
        partial(dice, "turn"),
        rate_hz,
        density=odometer.turn_density,
        bias=odometer.turn_bias_radps,
        walk=odometer.turn_walk,
        scale=odometer.turn_scale,
    )
    if odometer.tick_m:
        half = odometer.track_m / 2
        wheels = np.column_stack([speed - half * turn, speed + half * turn])
        left, right = in_ticks(dice("ticks"), wheels, odometer.tick_m, rate_hz).T
        speed, turn = (left + right) / 2, (right - left) / odometer.track_m
    return speed, turn


def dead_reckoning(t_s: Floats, speed_mps: Floats, turn_radps: Floats) -> tuple[Floats, Floats]:
    """Positions [n, 3] and quaternions x, y, z, w [n, 4] of a plane drive, from the origin along +x.

    Between two samples [n] the mean of their speeds and of their yaw rates is held, so that the way is an
    arc: a chord of length s·sin(φ/2)/(φ/2) in the direction of the mean heading.
    """
    dt = np.diff(t_s)
    arc, turn = (dt * (x[1:] + x[:-1]) / 2 for x in (speed_mps, turn_radps))
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    chord, course = arc * np.sinc(turn / (2 * np.pi)), heading[:-1] + turn / 2
    steps = np.column_stack([chord * np.cos(course), chord * np.sin(course), np.zeros_like(arc)])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return frozen(position), frozen(_about_z(heading).as_quat())


# ------------------------------------------------------------------- reference and truth


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """A reference pose, as a tracking system or an RTK receiver gives it; without noise it is the truth.

    Attributes:
        timing: when it measures.
        point_m: the point of the body whose position it tells.
        child_frame: name of the frame there, with the body's axes.
        position_noise_m: standard deviation of each coordinate of a sample.
        heading_noise_rad: standard deviation of a sample's heading.
        with_covariance: whether the samples tell their noise (geometry_msgs/PoseWithCovarianceStamped).
    """

    timing: Timing = Timing(rate_hz=60.0)
    point_m: Triple = (0.0, 0.0, 0.0)
    child_frame: str = BODY_FRAME
    position_noise_m: float = 0.0
    heading_noise_rad: float = 0.0
    with_covariance: bool = False

    def __post_init__(self) -> None:
        check(self, "0 or more", "position_noise_m", "heading_noise_rad")
        check(self, "a finite number", "point_m")
        if self.with_covariance and not (self.position_noise_m or self.heading_noise_rad):
            raise ValueError(
                "Reference: with_covariance is True without noise, and a covariance of zeros means an unknown one: "
                "set position_noise_m or heading_noise_rad"
            )


def reference_channel(
    motion: Motion, reference: Reference, *, start_ns: int, seed: int, stream: str = REFERENCE
) -> Channel:
    """The pose of a point of the body in the world, with the body's axes: position and full attitude.

    The noise of the heading turns the body about the world's z.
    """
    plan, dice, state = _observed(motion, reference.timing, start_ns, seed, stream, reference.point_m)
    n = len(plan.t_s)
    spin = reference.heading_noise_rad * dice("heading").standard_normal(n)
    position = frozen(state.position_m + reference.position_noise_m * dice("position").standard_normal((n, 3)))
    quats = frozen((_about_z(spin) * Rotation.from_matrix(state.world_r_body)).as_quat())
    variances = [reference.position_noise_m**2] * 3 + [0.0, 0.0, reference.heading_noise_rad**2]
    covariance = frozen(np.diag(variances)) if reference.with_covariance else UNKNOWN_COV6

    def sample(number: int, t_ns: int, received_ns: int) -> PoseSample:
        return PoseSample(
            stream=stream,
            t_ns=t_ns,
            received_ns=received_ns,
            position_m=position[number],
            quat_xyzw=quats[number],
            covariance=covariance,
            parent_frame=WORLD_FRAME,
            child_frame=reference.child_frame,
        )

    message = "PoseWithCovarianceStamped" if reference.with_covariance else "PoseStamped"
    return _channel(stream, StreamKind.POSE, f"geometry_msgs/msg/{message}", WORLD_FRAME, plan, sample)


def truth_channel(
    motion: Motion, timing: Timing, *, start_ns: int, seed: int, point_m: Triple = (0.0, 0.0, 0.0), stream: str = TRUTH
) -> Channel:
    """The exact pose of a point of the body, and its velocity and angular velocity in body axes."""
    plan, _, state = _observed(motion, timing, start_ns, seed, stream, point_m)
    quats = frozen(Rotation.from_matrix(state.world_r_body).as_quat())
    position, velocity, rate = (
        frozen(np.array(a)) for a in (state.position_m, state.body_velocity_mps, state.angular_velocity_radps)
    )

    def sample(number: int, t_ns: int, received_ns: int) -> OdometrySample:
        return OdometrySample(
            stream=stream,
            t_ns=t_ns,
            received_ns=received_ns,
            linear_velocity_mps=velocity[number],
            angular_velocity_radps=rate[number],
            position_m=position[number],
            quat_xyzw=quats[number],
        )

    return _channel(stream, StreamKind.ODOMETRY, "nav_msgs/msg/Odometry", WORLD_FRAME, plan, sample)


# -------------------------------------------------------------------------- camera's height


@dataclass(frozen=True, slots=True, kw_only=True)
class Height:
    """A distance sensor beside the camera.

    Attributes:
        timing: when it measures.
        direction: ``vertical`` (the camera's height above the ground below it) or ``axis`` (the distance to
            the ground along the camera's optical axis).
        noise_m: standard deviation of a sample.
        bias_m: constant error.
        min_range_m: nearer ground reads minus infinity (REP 117).
        max_range_m: ground farther away, or none at all, reads plus infinity.
    """

    timing: Timing = Timing(rate_hz=60.0)
    direction: Literal["vertical", "axis"] = "vertical"
    noise_m: float = 0.0
    bias_m: float = 0.0
    min_range_m: float = 0.0
    max_range_m: float = math.inf

    def __post_init__(self) -> None:
        check(self, "0 or more", "noise_m", "min_range_m")
        check(self, "a finite number", "bias_m")
        if not self.max_range_m > self.min_range_m:
            raise ValueError(f"Height: max_range_m is {self.max_range_m!r}, it must be above min_range_m")
        check_word(self, "direction", ("vertical", "axis"))


def level_ground(x_m: Floats, y_m: Floats) -> Floats:
    """The plane z = 0."""
    return np.zeros(np.broadcast(x_m, y_m).shape)


def height_channel(
    motion: Motion,
    height: Height,
    mount: Mount,
    *,
    start_ns: int,
    seed: int,
    ground: Ground = level_ground,
    stream: str = HEIGHT,
) -> Channel:
    """Distance from the camera to the ground, vertically or along its axis.

    Raises:
        ValueError: the camera is not above the ground, or the ground is too rugged for its slanting axis.
    """
    plan, dice, state = _observed(motion, height.timing, start_ns, seed, stream)
    world_r_camera, place = mount.world_t_camera(state)
    down = np.array([0.0, 0.0, -1.0])
    ways = world_r_camera[:, :, 2] if height.direction == "axis" else np.broadcast_to(down, place.shape)
    noise = height.noise_m * dice("noise").standard_normal(len(place))
    ranges = distance_to_ground(place, ways, ground) + height.bias_m + noise
    ranges[ranges < height.min_range_m] = -math.inf
    ranges[ranges > height.max_range_m] = math.inf
    frozen(ranges)

    def sample(number: int, t_ns: int, received_ns: int) -> RangeSample:
        return RangeSample(
            stream=stream,
            t_ns=t_ns,
            received_ns=received_ns,
            range_m=float(ranges[number]),
            min_range_m=height.min_range_m,
            max_range_m=height.max_range_m,
            field_of_view_rad=0.0,
        )

    return _channel(stream, StreamKind.RANGE, "sensor_msgs/msg/Range", CAMERA_FRAME, plan, sample)


def distance_to_ground(points_m: Floats, ways: Floats, ground: Ground = level_ground) -> Floats:
    """Distances [n] from points [n, 3] along unit vectors [n, 3] to the ground; infinite where it is not met.

    Solves z_p + d z_w = ground(x_p + d x_w, y_p + d y_w) by fixed-point iteration, which converges where the
    ray falls more steeply than the ground does. That the ground found is the nearest is checked at 64 places.

    Raises:
        ValueError: a point is not above the ground, or the ground is steeper than its ray.
    """
    rugged = ValueError("the ground is steeper than the camera's axis: tilt it less or take a smoother relief")
    clearance = points_m[:, 2] - ground(points_m[:, 0], points_m[:, 1])
    if not np.all(clearance > 0):
        raise ValueError(f"a camera is {-np.min(clearance):g} m below the ground: lift its mount or the vehicle")
    falls = ways[:, 2] < 0
    start, way = points_m[falls], ways[falls]
    distance = clearance[falls] / -way[:, 2]
    for _ in range(200):
        hit = start + distance[:, None] * way
        step = (hit[:, 2] - ground(hit[:, 0], hit[:, 1])) / -way[:, 2]
        distance = distance + step
        if np.all(np.abs(step) <= 1e-12 * (1 + np.abs(distance))):
            break
    else:
        raise rugged
    for share in (np.arange(64) + 0.5) / 64:
        passed = start + share * distance[:, None] * way
        if np.any(passed[:, 2] < ground(passed[:, 0], passed[:, 1])):
            raise rugged
    found = np.full(len(points_m), np.inf)
    found[falls] = distance
    return found


# ------------------------------------------------------------------------------ calibration


def camera_info_channel(
    camera: Camera,
    timing: Timing,
    *,
    duration_s: float,
    start_ns: int,
    seed: int,
    faults: Sequence[Fault] = (),
    stream: str = CALIBRATION,
) -> Channel:
    """The camera's intrinsics as they are sent; `WrongCalibration` changes them, the camera stays as it is."""
    plan = schedule(timing, duration_s=duration_s, start_ns=start_ns, seed=seed, stream=stream)
    wrong = of_kind(faults, WrongCalibration)

    def sample(number: int, t_ns: int, received_ns: int) -> CameraInfo:
        sent = camera
        for fault in wrong:
            if fault.holds(float(plan.t_s[number])):
                sent = miscalibrated(sent, fault)
        return CameraInfo(stream=stream, t_ns=t_ns, received_ns=received_ns, camera=sent)

    return _channel(stream, StreamKind.CAMERA, "sensor_msgs/msg/CameraInfo", camera.frame, plan, sample)


def miscalibrated(camera: Camera, fault: WrongCalibration) -> Camera:
    """The camera with a focal length and a principal point that are wrong by the fault, in K and in P."""
    matrix, projection = np.array(camera.matrix), np.array(camera.projection)
    for k in (matrix, projection):
        k[[0, 1], [0, 1]] *= fault.focal_factor
        k[:2, 2] += fault.centre_px
    return dataclasses.replace(camera, matrix=frozen(matrix), projection=frozen(projection))


# ------------------------------------------------------------------------------------- GNSS


@dataclass(frozen=True, slots=True, kw_only=True)
class Gnss:
    """A satellite receiver; the world's x, y, z are east, north and up at its origin on WGS 84.

    Attributes:
        timing: when it measures.
        latitude_rad: latitude of the world's origin.
        longitude_rad: its longitude.
        altitude_m: its height above the ellipsoid.
        point_m: where the antenna is in the body.
        horizontal_noise_m: standard deviation of a sample to the east and to the north.
        vertical_noise_m: standard deviation of a sample's altitude.
    """

    timing: Timing = Timing(rate_hz=5.0)
    latitude_rad: float = math.radians(61.45)
    longitude_rad: float = math.radians(23.86)
    altitude_m: float = 100.0
    point_m: Triple = (0.0, 0.0, 0.0)
    horizontal_noise_m: float = 1.0
    vertical_noise_m: float = 2.0

    def __post_init__(self) -> None:
        check(self, "0 or more", "horizontal_noise_m", "vertical_noise_m")
        check(self, "a finite number", "latitude_rad", "longitude_rad", "altitude_m", "point_m")
        if abs(self.latitude_rad) > math.pi / 2:
            raise ValueError(f"Gnss: latitude_rad is {self.latitude_rad!r}, it must be within -π/2 and π/2")


def gnss_channel(motion: Motion, gnss: Gnss, *, start_ns: int, seed: int, stream: str = GNSS) -> Channel:
    """Fixes of the antenna's place; their covariance is that of the noise, unknown without noise."""
    plan, dice, state = _observed(motion, gnss.timing, start_ns, seed, stream, gnss.point_m)
    spread = np.array([gnss.horizontal_noise_m, gnss.horizontal_noise_m, gnss.vertical_noise_m])
    enu = state.position_m + spread * dice("position").standard_normal((len(plan.t_s), 3))
    latitude, longitude, altitude = from_local_enu(enu, gnss.latitude_rad, gnss.longitude_rad, gnss.altitude_m)
    covariance = frozen(np.diag(spread**2)) if np.any(spread) else UNKNOWN_COV3

    def sample(number: int, t_ns: int, received_ns: int) -> GnssSample:
        return GnssSample(
            stream=stream,
            t_ns=t_ns,
            received_ns=received_ns,
            latitude_rad=float(latitude[number]),
            longitude_rad=float(longitude[number]),
            altitude_m=float(altitude[number]),
            covariance_m2=covariance,
        )

    return _channel(stream, StreamKind.GNSS, "sensor_msgs/msg/NavSatFix", GNSS_FRAME, plan, sample)


# ----------------------------------------------------------------------------------- tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracks:
    """A tracker of known landmarks in a camera's images.

    Attributes:
        timing: when the images are taken.
        noise_px: standard deviation of u and v.
    """

    timing: Timing = Timing(rate_hz=5.0)
    noise_px: float = 0.5

    def __post_init__(self) -> None:
        check(self, "0 or more", "noise_px")


def tracks_channel(
    motion: Motion,
    tracks: Tracks,
    camera: Camera,
    mount: Mount,
    landmarks_m: Floats,
    *,
    start_ns: int,
    seed: int,
    faults: Sequence[Fault] = (),
    stream: str = TRACKS,
) -> Channel:
    """Pixels of landmarks [n, 3] in the world; the id of a track is the landmark's row.

    A point is tracked while it is in front of the camera and its pixel, noise included, lies in the image;
    nothing hides one landmark from another. A landmark of a `TrackSlip` is replaced, from its first image in
    the fault's interval, by the point of the scene that is then `offset_px` away at the same depth. With
    `TrackOutliers`, each point is by its share off by uniform errors up to `size_px` in u and v.

    The ROS message is sensor_msgs/PointCloud: a point (x, y, z) = (u, v, 1) in px for each track, and one
    channel ``id`` with the tracks' ids in the same order.

    Raises:
        ValueError: a slip of a landmark that there is not or that is not seen then; landmarks of another shape.
    """
    landmarks = np.array(landmarks_m, dtype=np.float64)
    if landmarks.ndim != 2 or landmarks.shape[1] != 3:
        raise ValueError(f"landmarks_m has the shape {landmarks.shape}, it must be [n, 3]")
    plan, _, state = _observed(motion, tracks.timing, start_ns, seed, stream)
    views = _Views(camera, *mount.world_t_camera(state))
    slips = [_slipped(slip, views, landmarks, plan.t_s) for slip in of_kind(faults, TrackSlip)]
    outliers = of_kind(faults, TrackOutliers)

    def pixels(number: int) -> Floats:
        dice = partial(rng_of, seed, stream, str(number))
        t_s = float(plan.t_s[number])
        points = landmarks.copy()
        for slip, place in slips:
            if slip.holds(t_s):
                points[slip.track] = place
        seen = views.pixels(number, points) + tracks.noise_px * dice("noise").standard_normal((len(points), 2))
        for which, fault in enumerate(outliers):
            if fault.holds(t_s):
                rng = dice("outliers", str(which))
                hit = rng.random(len(points)) < fault.share
                seen[hit] += rng.uniform(-fault.size_px, fault.size_px, (len(points), 2))[hit]
        return seen

    def sample(number: int, t_ns: int, received_ns: int) -> TrackSample:
        seen = pixels(number)
        ids = np.flatnonzero(_within(camera, seen)).astype(np.int64)
        return TrackSample(stream=stream, t_ns=t_ns, received_ns=received_ns, ids=ids, points_px=seen[ids])

    return _channel(stream, StreamKind.TRACK, "sensor_msgs/msg/PointCloud", camera.frame, plan, sample)


@dataclass(frozen=True, slots=True)
class _Views:
    """A camera with its rotations `world_r_camera` [n, 3, 3] and positions [n, 3] at n times."""

    camera: Camera
    world_r_camera: Floats
    position_m: Floats

    def pixels(self, number: int, points_m: Floats) -> Floats:
        """Pixels [m, 2] of points in the world [m, 3]; NaN for what is not before the camera."""
        return project(self.camera, (points_m - self.position_m[number]) @ self.world_r_camera[number])

    def beside(self, number: int, point_m: Floats, offset_px: Floats) -> Floats:
        """The point [3] that is seen `offset_px` beside another one, at the same depth along the axis."""
        turn, place = self.world_r_camera[number], self.position_m[number]
        depth = float((point_m - place) @ turn[:, 2])
        ray = rays(self.camera, self.pixels(number, point_m[None]) + offset_px)[0]
        return np.asarray(place + turn @ (depth * ray))


def _slipped(slip: TrackSlip, views: _Views, landmarks: Floats, t_s: Floats) -> tuple[TrackSlip, Floats]:
    """A slip and the point [3] that takes the landmark's place."""
    if not 0 <= slip.track < len(landmarks):
        raise ValueError(f"{slip.name}: track is {slip.track}, there are {len(landmarks)} landmarks, counted from 0")
    landmark = landmarks[slip.track]
    for number in np.flatnonzero(during([slip], t_s)).tolist():
        if _within(views.camera, views.pixels(number, landmark[None]))[0]:
            return slip, views.beside(number, landmark, np.array(slip.offset_px))
    raise ValueError(
        f"{slip.name}: landmark {slip.track} is not seen from {slip.start_s} s to {slip.stop_s} s, so that it cannot "
        "slip: choose another track or time"
    )


def _within(camera: Camera, pixels: Floats) -> NDArray[np.bool_]:
    """Whether pixels [n, 2] lie in the image, from the edge of its first to that of its last pixels."""
    u, v = pixels.T
    with np.errstate(invalid="ignore"):
        return np.asarray((u >= -0.5) & (u < camera.width_px - 0.5) & (v >= -0.5) & (v < camera.height_px - 0.5))


# ----------------------------------------------------------------------------------- faults


def faults_channel(faults: Sequence[Fault], *, start_ns: int, scenario: Mapping[str, Any]) -> Channel:
    """The list of faults with the scenario, as one text at the mission's start (`faults.to_text`)."""
    text = to_text(faults, start_ns, scenario)
    now = frozen(np.array([start_ns], dtype=np.int64))

    def sample(number: int, t_ns: int, received_ns: int) -> TextSample:
        return TextSample(stream=FAULTS_STREAM, t_ns=t_ns, received_ns=received_ns, text=text)

    return Channel(
        stream=FAULTS_STREAM,
        kind=StreamKind.TEXT,
        type="std_msgs/msg/String",
        frame="",
        number=frozen(np.zeros(1, dtype=np.int64)),
        stamp_ns=now,
        received_ns=now,
        sample=sample,
    )


# ------------------------------------------------------------------------------ small parts

Dice = Callable[..., np.random.Generator]


def _observed(
    motion: Motion, timing: Timing, start_ns: int, seed: int, stream: str, point_m: Triple = (0.0, 0.0, 0.0)
) -> tuple[Schedule, Dice, Kinematics]:
    """When a sensor measures, its random numbers by name, and how its point of the body moves then."""
    plan = schedule(timing, duration_s=motion.duration_s, start_ns=start_ns, seed=seed, stream=stream)
    return plan, partial(rng_of, seed, stream), motion.at(plan.t_s).at_point(np.array(point_m))


class _Felt(NamedTuple):
    """What is measured of a point's motion: rates and velocity in body axes, acceleration in the world's [n, 3]."""

    rate_radps: Floats
    acceleration_mps2: Floats
    body_velocity_mps: Floats


def _felt(
    sampling: Sampling, motion: Motion, state: Kinematics, rate_hz: float, point_m: Triple = (0.0, 0.0, 0.0)
) -> _Felt:
    """A point's motion at the times of its `state`, or the means of it over the intervals about them.

    The intervals end where the motion ends. The mean velocity is along the arc: the way from end to end is
    the chord of a steady turn φ, shorter by sin(φ/2)/(φ/2), in the axes of its middle.
    """
    if sampling == "instant" or motion.duration_s == 0:
        return _Felt(state.angular_velocity_radps, state.acceleration_mps2, state.body_velocity_mps)
    before, after = (
        motion.at(np.clip(state.t_s + lag_s, 0.0, motion.duration_s)).at_point(np.array(point_m))
        for lag_s in (-0.5 / rate_hz, 0.5 / rate_hz)
    )
    length_s = (after.t_s - before.t_s)[:, None]
    start = Rotation.from_matrix(before.world_r_body)
    turn = (start.inv() * Rotation.from_matrix(after.world_r_body)).as_rotvec()
    middle = (start * Rotation.from_rotvec(turn / 2)).as_matrix()
    chord = _in_axes(middle, after.position_m - before.position_m)
    arc = chord / np.sinc(np.linalg.norm(turn, axis=1, keepdims=True) / (2 * np.pi))
    return _Felt(turn / length_s, (after.velocity_mps - before.velocity_mps) / length_s, arc / length_s)


def _channel(
    stream: str, kind: StreamKind, message: str, frame: str, plan: Schedule, sample: Callable[[int, int, int], Sample]
) -> Channel:
    return Channel(
        stream=stream,
        kind=kind,
        type=message,
        frame=frame,
        number=plan.number,
        stamp_ns=plan.stamp_ns,
        received_ns=plan.received_ns,
        sample=sample,
    )


def _mounting(yaw_pitch_roll_rad: Triple) -> Floats:
    """`body_r_sensor` [3, 3]."""
    yaw, pitch, roll = (np.array([angle]) for angle in yaw_pitch_roll_rad)
    return np.asarray(rotations(yaw, pitch, roll)[0])


def _about_z(angles_rad: Floats) -> Rotation:
    """Rotations [n] about z."""
    return Rotation.from_rotvec(np.outer(angles_rad, [0.0, 0.0, 1.0]))


def _in_axes(world_r_sensor: Floats, vectors: Floats) -> Floats:
    """Vectors [n, 3] of the world in a sensor's axes `world_r_sensor` [n, 3, 3]."""
    return np.asarray(np.einsum("nji,nj->ni", world_r_sensor, vectors))
