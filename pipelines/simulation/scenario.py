"""A scenario: everything that makes a simulated mission, by name; and the mission that it makes.

Equal scenarios make equal missions, to the last byte. Whatever is random follows from the one seed and the
name of what is random, so that a change of one section leaves the noise of the others as it is.
"""

from __future__ import annotations

import contextlib
import inspect
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from pipelines.lens import pinhole, rays
from pipelines.simulation import faults as flaws
from pipelines.simulation.channels import Channel, rng_of
from pipelines.simulation.curves import curve
from pipelines.simulation.driving import Chain, Disturbed, Drive, Swaying, Turn, stop
from pipelines.simulation.families import ground as ground_of_family
from pipelines.simulation.faults import Fault
from pipelines.simulation.imaging import OF_IMAGES, CameraOnBoard
from pipelines.simulation.mission import IMAGE, INFO, LEVEL_FRAME, START_NS, SimulatedMission, digest
from pipelines.simulation.motion import FORWARD, NADIR, Kinematics, Motion, Mount, looking
from pipelines.simulation.patches import OF_GROUND, faults_met, outline, patches_of
from pipelines.simulation.scene import Plane, Relief, Scene, chessboard, chessboard_corners, poster, upright
from pipelines.simulation.sections import (
    AnyFault,
    AnyGnss,
    AnyHeight,
    AnyImu,
    AnyOdometer,
    AnyReference,
    AnyTracks,
    CameraSection,
    Chessboard,
    Clock,
    Count,
    DownCamera,
    Fluctuation,
    FrontCamera,
    Ground,
    Leg,
    Positive,
    Section,
    Surroundings,
    Trajectory,
)
from pipelines.simulation.sensors import (
    BODY_FRAME,
    Reference,
    camera_info_channel,
    faults_channel,
    gnss_channel,
    height_channel,
    imu_channel,
    level_ground,
    odometer_channel,
    reference_channel,
    tracks_channel,
    truth_channel,
)
from pipelines.simulation.signals import fluctuation
from pipelines.simulation.speeds import SPEEDS, Speed, speed, trapezoid
from pipelines.simulation.surfaces import WRAP, Surface, surface_from_image
from pipelines.simulation.timing import schedule
from readers.streams import Camera, Landmark, RangeSample, Sample, TrackSample

Floats = NDArray[np.float64]

FRONT_IMAGE, FRONT_INFO, FRONT_TRACKS = "/front/image_raw", "/front/camera_info", "/front/tracks"
USUAL_DURATION_S = 8.0


class Scenario(Section):
    """What a simulated mission is made of; sections of sensors that are not given are not on board."""

    name: str = Field("scenario", min_length=1, description="name of the mission")
    about: str = Field("", description="what it shows, one line")
    seed: int = Field(0, ge=0, description="seed of everything random")
    duration_s: Positive | None = Field(None, description="length; otherwise that of the speed profile, or 8 s")
    frames: Count | None = Field(None, description="length in frames of the first camera; overrides duration_s")
    start_ns: int = Field(START_NS, ge=0, le=1 << 62, description="time of the start, ns since 1970")
    ground: Ground = Field(Ground(), description="the ground")
    trajectory: Trajectory = Field(Trajectory(), description="the way and the speed")
    body: Fluctuation = Field(Fluctuation(), description="how the body sways")
    camera: DownCamera | None = Field(None, description="the downward camera")
    front: FrontCamera | None = Field(None, description="the camera that looks ahead")
    surroundings: Surroundings = Field(Surroundings(), description="what the front camera can see")
    tracks: AnyTracks | None = Field(None, description="tracks of landmarks in the front camera's images")
    height: AnyHeight | None = Field(None, description="distance sensor beside the downward camera")
    imu: AnyImu | None = Field(None, description="inertial measurement unit")
    odometer: AnyOdometer | None = Field(None, description="wheel odometer")
    reference: AnyReference | None = Field(
        None, description="reference pose: at the downward camera, or at the body where there is none, plus its point_m"
    )
    gnss: AnyGnss | None = Field(None, description="satellite receiver")
    truth: Clock | None = Field(None, description="exact pose and velocity of the turning point")
    faults: tuple[AnyFault, ...] = Field((), description="what goes wrong, and when")

    @model_validator(mode="after")
    def _complete(self) -> Scenario:
        if self.frames is not None and self.first_camera is None:
            raise ValueError("frames: there is no camera to count them; give duration_s, or a section camera or front")
        if self.height is not None and self.camera is None:
            raise ValueError("height: it is the downward camera's; add a section camera")
        if self.tracks is not None and (self.front is None or not len(landmarks_of(self.surroundings))):
            raise ValueError("tracks: they need a section front, and landmarks_m or a chessboard in surroundings")
        for number, fault in enumerate(self.faults):
            if not any(getattr(self, section) is not None for section in _needs(fault)):
                raise ValueError(f"faults.{number}: {fault.name} needs a section {' or '.join(_needs(fault))}")
        return self

    @property
    def first_camera(self) -> CameraSection | None:
        """The downward camera, else the front one, else none."""
        return self.camera or self.front


def _needs(fault: Fault) -> tuple[str, ...]:
    """The sections of which a fault needs one."""
    if isinstance(fault, OF_GROUND):
        return ("camera",)
    if isinstance(fault, OF_IMAGES):
        return ("camera", "front")
    if isinstance(fault, flaws.TrackSlip | flaws.TrackOutliers):
        return ("tracks",)
    if isinstance(fault, flaws.OdometerScale):
        return ("odometer",)
    return ("imu",) if isinstance(fault, flaws.GyroBias) else ("trajectory",)


# ----------------------------------------------------------------------------------- build


def build(scenario: Scenario, *, picture: ArrayLike | None = None) -> SimulatedMission:
    """The mission that a scenario describes.

    Args:
        scenario: the scenario.
        picture: grey levels [height, width] of the picture that ``ground.picture`` names.

    Raises:
        ValueError: the scenario cannot be; the text names the section.
    """
    motion = _motion(scenario)
    faults = _met(scenario, motion)
    cameras = _cameras(scenario, motion, faults, picture)
    values = described(scenario, picture)
    truth = faults_channel(faults, start_ns=scenario.start_ns, scenario=values)
    tracked = landmarks_of(scenario.surroundings)
    return SimulatedMission(
        [truth, *_channels(scenario, motion, faults), *(camera.channel() for camera in cameras)],
        name=scenario.name,
        start_ns=scenario.start_ns,
        motion=motion,
        cameras=cameras,
        faults=faults,
        landmarks={number: Landmark(position_m=place, sigma_m=np.zeros(3)) for number, place in enumerate(tracked)},
        description=values,
    )


def described(scenario: Scenario, picture: ArrayLike | None = None) -> dict[str, Any]:
    """The scenario in values that JSON has: equal for equal missions, wherever their picture lies."""
    values: dict[str, Any] = _as_json(scenario.model_dump(mode="json"))
    if picture is not None:
        values["ground"] |= {"picture": PurePath(scenario.ground.picture).name, "picture_digest": digest(picture)}
    return values


def _as_json(value: Any) -> Any:
    """The value with infinities as texts, for which JSON has no numbers."""
    if isinstance(value, dict):
        return {key: _as_json(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(inner) for inner in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def _named(section: str) -> Iterator[None]:
    """Puts the name of a section before what is wrong with it."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{section}: {error}") from error


# ---- motion


@dataclass(frozen=True, slots=True)
class Lasting:
    """A motion that is known up to another time; after its own end it stands still."""

    motion: Motion
    duration_s: float

    def at(self, t_s: Floats) -> Kinematics:
        """The body's motion at times [n]."""
        return self.motion.at(t_s)


def _motion(scenario: Scenario) -> Motion:
    way, body, seed = scenario.trajectory, scenario.body, scenario.seed
    with _named("trajectory"):
        driven = Chain([_leg(leg, way) for leg in way.legs] * way.rounds) if way.legs else _drive(scenario)
    swaying = Swaying(
        driven,
        height_m=fluctuation(body.height_rms_m, body.height_tau_s, seed=seed, name="height"),
        roll_rad=fluctuation(body.roll_rms_rad, body.roll_tau_s, seed=seed, name="roll", mean=body.roll_rad),
        pitch_rad=fluctuation(body.pitch_rms_rad, body.pitch_tau_s, seed=seed, name="pitch", mean=body.pitch_rad),
    )
    with _named("faults"):
        return Lasting(Disturbed(swaying, scenario.faults), _duration_s(scenario) or driven.duration_s)


def _drive(scenario: Scenario) -> Motion:
    """One curve, driven with the speed profile."""
    way = scenario.trajectory
    slip = fluctuation(
        way.sideslip_rms_rad, way.sideslip_tau_s, seed=scenario.seed, name="sideslip", mean=way.sideslip_rad
    )
    pace = _speed(scenario).with_stops(way.stops, ramp_s=way.stop_ramp_s)
    return Drive(curve(way.curve, **way.parameters), pace, sideslip_rad=slip)


def _leg(leg: Leg, way: Trajectory) -> Motion:
    if leg.drive_m is not None:
        pace = trapezoid(leg.drive_m, way.speed_kmh / 3.6, leg.acceleration_mps2)
        return Drive(curve(leg.curve, **leg.parameters), pace, sideslip_rad=way.sideslip_rad)
    return stop(leg.stop_s) if leg.stop_s is not None else Turn(leg.turn_rad or 0.0, leg.turn_s)


def _speed(scenario: Scenario) -> Speed:
    """The speed profile; it is told the speed, the length of the mission and the seed if it asks for them."""
    way = scenario.trajectory
    offered = {
        "speed_mps": way.speed_kmh / 3.6,
        "duration_s": _duration_s(scenario) or USUAL_DURATION_S,
        "seed": scenario.seed,
    }
    asked = inspect.signature(SPEEDS[way.profile]).parameters if way.profile in SPEEDS else {}
    return speed(way.profile, **{key: offered[key] for key in offered if key in asked} | way.profile_parameters)


def _duration_s(scenario: Scenario) -> float | None:
    """The length of the mission as the scenario gives it; 0 is none."""
    if scenario.frames is None or scenario.first_camera is None:
        return scenario.duration_s
    timing = scenario.first_camera.timing
    return timing.start_s + max(scenario.frames - 1, 1e-3) / timing.rate_hz


# ---- cameras and what they see


class Post(NamedTuple):
    """A place for a camera: its section, its streams and frame, and where it looks if it is not turned."""

    section: str
    images: str
    info: str
    frame: str
    body_r_camera: Floats


DOWN = Post("camera", IMAGE, INFO, "camera", NADIR)
FRONT = Post("front", FRONT_IMAGE, FRONT_INFO, "front", FORWARD)


def _posts(scenario: Scenario) -> Iterator[tuple[Post, CameraSection]]:
    """The cameras on board, the first one first."""
    if scenario.camera is not None:
        yield DOWN, scenario.camera
    if scenario.front is not None:
        yield FRONT, scenario.front


def _truly(section: CameraSection, post: Post) -> tuple[Camera, Mount]:
    """What a camera truly is, and how it is mounted."""
    turned = looking(
        post.body_r_camera, yaw_rad=section.yaw_rad, pitch_rad=section.pitch_rad, roll_rad=section.roll_rad
    )
    mount = Mount(np.array([section.ahead_m, section.left_m, section.height_m]), turned, section.hold)
    camera = pinhole(
        section.width_px,
        section.height_px,
        section.focal_px,
        model=section.distortion_model,
        distortion=section.distortion,
    )
    return replace(camera, frame=post.frame, body_t_camera=mount.body_t_camera), mount


def _met(scenario: Scenario, motion: Motion) -> tuple[Fault, ...]:
    """The faults as they really happen."""
    late = [fault for fault in scenario.faults if fault.start_s >= motion.duration_s]
    if late:
        raise ValueError(
            f"faults: {late[0].name} begins at {late[0].start_s} s, but the mission ends at {motion.duration_s:.6g} s; "
            "make it longer or leave the fault out"
        )
    if scenario.camera is None:
        return scenario.faults
    section = scenario.camera
    with _named("camera"):
        camera, mount = _truly(section, DOWN)
        t_s = section.timing.times_s(motion.duration_s)
    with _named("faults"):
        return faults_met(scenario.faults, camera, mount, motion, t_s)


def _surface(scenario: Scenario, picture: ArrayLike | None) -> Surface:
    given = scenario.ground
    if bool(given.picture) != (picture is not None):
        raise ValueError("ground.picture: name the picture there and give it to build as well")
    with _named("ground"):
        if picture is not None:
            return surface_from_image(
                picture,
                metres_per_px=given.metres_per_px,
                psf_sigma_px=given.psf_sigma_px,
                arrange=given.arrange,
                seed=scenario.seed,
            )
        return ground_of_family(
            given.family,
            seed=scenario.seed,
            size_px=given.size_px,
            contrast=given.contrast,
            repetition=given.repetition,
            spectrum=given.spectrum,
            metres_per_px=given.metres_per_px,
            scatter=given.arrange == "scatter",
        )


def _relief(scenario: Scenario) -> Relief | None:
    given = scenario.ground
    if not given.relief_height_m:
        return None
    seed = int(rng_of(scenario.seed, "relief").integers(1 << 62))
    return Relief(given.relief_height_m, given.relief_correlation_m, seed)


def height_of(relief: Relief, x_m: Floats, y_m: Floats) -> Floats:
    """Height of a relief in m [n] at world x and y, each [n]: its cubic B-spline, rows running along minus y."""
    places = np.stack([-np.asarray(y_m), np.asarray(x_m)]) / relief.metres_per_sample
    period = relief.coefficients[1 : 1 - WRAP, 1 : 1 - WRAP].astype(np.float64)
    return np.asarray(scipy.ndimage.map_coordinates(period, places, order=3, mode="grid-wrap", prefilter=False))


def _scene(scenario: Scenario, faults: Sequence[Fault], picture: ArrayLike | None) -> Scene:
    surface, around = _surface(scenario, picture), scenario.surroundings
    with _named("faults"):
        patches = patches_of(faults, surface, scenario.seed)
    with _named("surroundings"):
        return Scene(
            surface,
            patches=patches,
            relief=_relief(scenario),
            planes=tuple(_planes(around, scenario.seed)),
            background_grey=around.background_grey,
        )


def _planes(around: Surroundings, seed: int) -> Iterator[Plane]:
    if around.poster_m:
        for number, place in enumerate(around.landmarks_m):
            yield poster(np.array(place), size_m=around.poster_m, rng=rng_of(seed, "poster", str(number)))
    if around.chessboard is not None:
        board = around.chessboard
        yield chessboard(board.columns, board.rows, board.square_m, _pose_of(board))


def _pose_of(board: Chessboard) -> Floats:
    return upright(np.array(board.position_m), board.facing_rad)


def landmarks_of(around: Surroundings) -> Floats:
    """The points that are tracked [n, 3]: the landmarks, then the chessboard's inner corners row by row."""
    points = np.array(around.landmarks_m, dtype=np.float64).reshape(-1, 3)
    if around.chessboard is None:
        return points
    board = around.chessboard
    return np.concatenate([points, chessboard_corners(board.columns, board.rows, board.square_m, _pose_of(board))])


def _cameras(
    scenario: Scenario, motion: Motion, faults: tuple[Fault, ...], picture: ArrayLike | None
) -> list[CameraOnBoard]:
    if scenario.first_camera is None:
        return []
    scene = _scene(scenario, faults, picture)
    return [_camera(scenario, section, post, motion, scene, faults) for post, section in _posts(scenario)]


def _camera(
    scenario: Scenario, section: CameraSection, post: Post, motion: Motion, scene: Scene, faults: tuple[Fault, ...]
) -> CameraOnBoard:
    own_seed = int(rng_of(scenario.seed, post.images).integers(1 << 62))
    with _named(post.section):
        camera, mount = _truly(section, post)
        rays(camera, outline(camera))
        on_board = CameraOnBoard(
            stream=post.images,
            start_ns=scenario.start_ns,
            camera=camera,
            mount=mount,
            motion=motion,
            scene=scene,
            plan=schedule(
                section.timing,
                duration_s=motion.duration_s,
                start_ns=scenario.start_ns,
                seed=scenario.seed,
                stream=post.images,
                faults=faults,
            ),
            rate_hz=section.timing.rate_hz,
            exposure_s=section.exposure_s,
            readout_s=section.readout_s,
            noise_grey=section.noise_grey,
            vignetting=section.vignetting,
            seed=scenario.seed if post is DOWN else own_seed,
            faults=faults,
            name=scenario.name,
        )
        lowest = float(on_board.heights_m.min())
        if lowest <= 0:
            raise ValueError(f"it is at a height of {lowest:g} m at times: mount it higher, or let the body sway less")
        return on_board


# ---- everything else on board


def _channels(scenario: Scenario, motion: Motion, faults: tuple[Fault, ...]) -> Iterator[Channel]:
    """The channels of all that is on board, but for images and faults."""
    start: dict[str, Any] = {"start_ns": scenario.start_ns, "seed": scenario.seed}
    for post, section in _posts(scenario):
        yield camera_info_channel(
            _truly(section, post)[0],
            section.timing,
            duration_s=motion.duration_s,
            faults=faults,
            stream=post.info,
            **start,
        )
    if scenario.truth is not None:
        yield truth_channel(motion, scenario.truth, **start)
    if scenario.reference is not None:
        yield reference_channel(motion, _at_camera(scenario.reference, scenario), **start)
    if scenario.height is not None and scenario.camera is not None:
        (_, mount), relief = _truly(scenario.camera, DOWN), _relief(scenario)
        ground = level_ground if relief is None else partial(height_of, relief)
        with _named("height"):
            yield _single_precision(height_channel(motion, scenario.height, mount, ground=ground, **start))
    if scenario.imu is not None:
        yield imu_channel(motion, scenario.imu, faults=faults, **start)
    if scenario.odometer is not None:
        yield odometer_channel(motion, scenario.odometer, faults=faults, **start)
    if scenario.gnss is not None:
        yield gnss_channel(motion, scenario.gnss, **start)
    if scenario.tracks is not None and scenario.front is not None:
        camera, mount = _truly(scenario.front, FRONT)
        points = landmarks_of(scenario.surroundings)
        with _named("tracks"):
            tracked = tracks_channel(
                motion, scenario.tracks, camera, mount, points, faults=faults, stream=FRONT_TRACKS, **start
            )
        yield _single_precision(tracked)


def _single_precision(channel: Channel) -> Channel:
    """The channel with ranges and pixels as their ROS messages hold them, so that a file holds the same numbers."""

    def sample(number: int, t_ns: int, received_ns: int) -> Sample:
        made = channel.sample(number, t_ns, received_ns)
        if isinstance(made, RangeSample):
            return replace(made, range_m=float(np.float32(made.range_m)))
        if isinstance(made, TrackSample):
            return replace(made, points_px=made.points_px.astype(np.float32).astype(np.float64))
        return made

    return replace(channel, sample=sample)


def _at_camera(reference: Reference, scenario: Scenario) -> Reference:
    """The reference, its point counted from the downward camera where there is one, whose frame is not the body's."""
    section = scenario.camera
    if section is None:
        return reference
    x, y, z = reference.point_m
    frame = LEVEL_FRAME if reference.child_frame == BODY_FRAME else reference.child_frame
    place = (x + section.ahead_m, y + section.left_m, z + section.height_m)
    return replace(reference, point_m=place, child_frame=frame)
