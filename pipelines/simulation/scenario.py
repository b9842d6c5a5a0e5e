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
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from pipelines.lens import pinhole
from pipelines.simulation import faults as flaws
from pipelines.simulation.channels import Channel, rng_of
from pipelines.simulation.curves import curve
from pipelines.simulation.driving import Disturbed, Drive
from pipelines.simulation.families import ground as ground_of_family
from pipelines.simulation.faults import Fault
from pipelines.simulation.imaging import OF_IMAGES, CameraOnBoard
from pipelines.simulation.mission import IMAGE, INFO, START_NS, SimulatedMission, digest
from pipelines.simulation.motion import FORWARD, NADIR, Kinematics, Motion, Mount, looking
from pipelines.simulation.patches import OF_GROUND, faults_met, patches_of
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
    Positive,
    Section,
    Surroundings,
    Trajectory,
)
from pipelines.simulation.sensors import (
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
from pipelines.simulation.speeds import SPEEDS, Speed, speed
from pipelines.simulation.surfaces import WRAP, Surface, surface_from_image
from pipelines.simulation.timing import schedule
from readers.streams import Camera, RangeSample, Sample, TrackSample

Floats = NDArray[np.float64]

FRONT_IMAGE, FRONT_INFO, FRONT_TRACKS = "/front/image_raw", "/front/camera_info", "/front/tracks"
USUAL_DURATION_S = 8.0


class Scenario(Section):
    """What a simulated mission is made of; sections of sensors that are not given are not on board."""

    name: str = Field("scenario", min_length=1, description="name of the mission")
    about: str = Field("", description="what it shows, one line")
    seed: int = Field(0, ge=0, description="seed of everything random")
    duration_s: Positive | None = Field(None, description="length; None: that of the speed profile, or 8 s")
    frames: Count | None = Field(None, description="length in frames of the first camera; overrides duration_s")
    start_ns: int = Field(START_NS, ge=0, description="time of the start, ns since 1970")
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
    reference: AnyReference | None = Field(None, description="reference pose, at the first camera plus its point_m")
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
    return SimulatedMission(
        [truth, *_channels(scenario, motion, faults), *(camera.channel() for camera in cameras)],
        name=scenario.name,
        start_ns=scenario.start_ns,
        motion=motion,
        cameras=cameras,
        faults=faults,
        landmarks_m=() if scenario.tracks is None else landmarks_of(scenario.surroundings),
        pose_point_m=(0.0, 0.0, 0.0)
        if scenario.reference is None
        else _at_camera(scenario.reference, scenario).point_m,
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
        pace = _speed(scenario)
        drive = Drive(
            curve(way.curve, **way.parameters),
            pace.with_stops(way.stops, ramp_s=way.stop_ramp_s),
            sideslip_rad=way.sideslip_rad,
            height_m=fluctuation(body.height_rms_m, body.height_tau_s, seed=seed, name="height"),
            roll_rad=fluctuation(body.roll_rms_rad, body.roll_tau_s, seed=seed, name="roll", mean=body.roll_rad),
            pitch_rad=fluctuation(body.pitch_rms_rad, body.pitch_tau_s, seed=seed, name="pitch", mean=body.pitch_rad),
        )
    with _named("faults"):
        return Lasting(Disturbed(drive, scenario.faults), _duration_s(scenario) or pace.duration_s)


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


def _mount(section: CameraSection, base: Floats) -> Mount:
    turned = looking(base, yaw_rad=section.yaw_rad, pitch_rad=section.pitch_rad, roll_rad=section.roll_rad)
    return Mount(np.array([section.ahead_m, section.left_m, section.height_m]), turned, section.hold)


def _intrinsics(section: CameraSection, frame: str) -> Camera:
    camera = pinhole(
        section.width_px,
        section.height_px,
        section.focal_px,
        model=section.distortion_model,
        distortion=section.distortion,
    )
    return replace(camera, frame=frame)


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
        camera, mount, t_s = (
            _intrinsics(section, "camera"),
            _mount(section, NADIR),
            section.timing.times_s(motion.duration_s),
        )
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
    with _named("surroundings"):
        return Scene(
            surface,
            patches=patches_of(faults, surface, scenario.seed),
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
    cameras = []
    if scenario.camera is not None:
        cameras.append(_camera(scenario, scenario.camera, IMAGE, "camera", NADIR, motion, scene, faults))
    if scenario.front is not None:
        cameras.append(_camera(scenario, scenario.front, FRONT_IMAGE, "front", FORWARD, motion, scene, faults))
    return cameras


def _camera(
    scenario: Scenario,
    section: CameraSection,
    stream: str,
    frame: str,
    base: Floats,
    motion: Motion,
    scene: Scene,
    faults: tuple[Fault, ...],
) -> CameraOnBoard:
    with _named("front" if base is FORWARD else "camera"):
        return CameraOnBoard(
            stream=stream,
            start_ns=scenario.start_ns,
            camera=_intrinsics(section, frame),
            mount=_mount(section, base),
            motion=motion,
            scene=scene,
            plan=schedule(
                section.timing,
                duration_s=motion.duration_s,
                start_ns=scenario.start_ns,
                seed=scenario.seed,
                stream=stream,
                faults=faults,
            ),
            rate_hz=section.timing.rate_hz,
            exposure_s=section.exposure_s,
            readout_s=section.readout_s,
            noise_grey=section.noise_grey,
            vignetting=section.vignetting,
            seed=scenario.seed if base is NADIR else int(rng_of(scenario.seed, stream).integers(1 << 62)),
            faults=faults,
            name=scenario.name,
        )


# ---- everything else on board


def _channels(scenario: Scenario, motion: Motion, faults: tuple[Fault, ...]) -> Iterator[Channel]:
    """The channels of all that is on board, but for images and faults."""
    start: dict[str, Any] = {"start_ns": scenario.start_ns, "seed": scenario.seed}
    if scenario.camera is not None:
        yield _info(scenario, scenario.camera, INFO, "camera", motion, faults)
    if scenario.front is not None:
        yield _info(scenario, scenario.front, FRONT_INFO, "front", motion, faults)
    if scenario.truth is not None:
        yield truth_channel(motion, scenario.truth, **start)
    if scenario.reference is not None:
        yield reference_channel(motion, _at_camera(scenario.reference, scenario), **start)
    if scenario.height is not None and scenario.camera is not None:
        mount, relief = _mount(scenario.camera, NADIR), _relief(scenario)
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
        camera, mount = _intrinsics(scenario.front, "front"), _mount(scenario.front, FORWARD)
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


def _info(
    scenario: Scenario, section: CameraSection, stream: str, frame: str, motion: Motion, faults: tuple[Fault, ...]
) -> Channel:
    return camera_info_channel(
        _intrinsics(section, frame),
        section.timing,
        duration_s=motion.duration_s,
        start_ns=scenario.start_ns,
        seed=scenario.seed,
        faults=faults,
        stream=stream,
    )


def _at_camera(reference: Reference, scenario: Scenario) -> Reference:
    """The reference, its point counted from the first camera where there is one."""
    section = scenario.first_camera
    if section is None:
        return reference
    x, y, z = reference.point_m
    return replace(reference, point_m=(x + section.ahead_m, y + section.left_m, z + section.height_m))
