"""A simulated mission: a `Recording` of channels, whose truth comes with it.

Nothing is kept but what the mission is; every sample is made when it is asked for, and images are rendered
when their bytes are. The truth and the list of faults are attributes, and streams where a scenario says so.
"""

from __future__ import annotations

import dataclasses
import hashlib
import heapq
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.lens import pinhole
from pipelines.simulation.channels import Channel, Longs
from pipelines.simulation.faults import Fault
from pipelines.simulation.imaging import OF_IMAGES, CameraOnBoard
from pipelines.simulation.motion import Hold, Motion, Mount, Waypoints
from pipelines.simulation.patches import OF_GROUND, faults_met, patches_of
from pipelines.simulation.scene import Scene
from pipelines.simulation.sensors import (
    CALIBRATION,
    REFERENCE,
    Height,
    Reference,
    camera_info_channel,
    height_channel,
    reference_channel,
)
from pipelines.simulation.sensors import HEIGHT as RANGE
from pipelines.simulation.surfaces import Surface
from pipelines.simulation.timing import Timing, schedule
from readers.streams import (
    Camera,
    CameraInfo,
    Landmark,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
    unknown_transform,
)

Floats = NDArray[np.float64]

IMAGE, INFO, POSE, HEIGHT = "/camera/image_raw", CALIBRATION, REFERENCE, RANGE
CAMERA_FRAME = "camera_ground"
START_NS = 1_700_000_000_000_000_000
PAPER_HEIGHT_M, PAPER_FOCAL_PX, PAPER_SIDE_PX = 0.2002, 256.0, 512


class SimulatedMission(Recording):
    """A mission that is made of channels.

    Args:
        channels: its streams; of samples with equal stamps those of an earlier channel come first.
        name: name of the mission.
        start_ns: time at which it starts.
        motion: how the vehicle moves.
        cameras: the cameras on board; frames and poses of the truth are those of the first one.
        faults: what goes wrong, as it really happens.
        landmarks_m: places of the points that are tracked [n, 3]; their numbers are those of the tracks.
        pose_point_m: the point of the body whose poses the mission tells, in body axes [3].
        description: what the mission is made of, in values that JSON has; equal missions have equal ones.

    Attributes:
        truth_t_ns: times of the first camera's pictures [n], those of dropped images included.
        truth_poses: its poses then [n, 3]: x (m), y (m), heading of the image's u axis (rad).
        metres_per_px: price of a pixel W of the first camera at its mean height.

    Raises:
        ValueError: two channels have the same name.
    """

    format = "simulated mission"

    def __init__(
        self,
        channels: Sequence[Channel],
        *,
        name: str,
        start_ns: int,
        motion: Motion,
        cameras: Sequence[CameraOnBoard] = (),
        faults: Sequence[Fault] = (),
        landmarks_m: ArrayLike = (),
        pose_point_m: ArrayLike = (0.0, 0.0, 0.0),
        description: Mapping[str, Any],
    ) -> None:
        self.path, self.start_ns, self.motion = Path(name), start_ns, motion
        self.on_board, self.faults, self.description = tuple(cameras), tuple(faults), dict(description)
        self._landmarks_m = np.array(landmarks_m, dtype=np.float64).reshape(-1, 3)
        self._pose_point_m = np.array(pose_point_m, dtype=np.float64)
        self._channels = {channel.stream: channel for channel in channels}
        if len(self._channels) != len(channels):
            raise ValueError(f"{name}: two channels have the same name: {[channel.stream for channel in channels]}")
        if self.on_board:
            first = self.on_board[0]
            self.truth_t_ns, self.truth_poses = first.t_ns, first.poses
            self.metres_per_px = float(np.mean(first.heights_m) / first.camera.matrix[0, 0])
            self._sent = set(first.plan.number.tolist())

    # ------------------------------------------------------------------------------ frames

    @property
    def camera(self) -> Camera:
        """What the first camera truly is."""
        return self.on_board[0].camera

    def frame(self, k: int) -> NDArray[np.uint8]:
        """The image that the first camera takes for its frame k, uint8 [height, width], whether it arrives or not.

        Raises:
            IndexError: there is no such frame.
        """
        return self.on_board[0].picture(k)

    def sent(self, k: int) -> bool:
        """Whether the image of the first camera's frame k arrives."""
        return k in self._sent

    # --------------------------------------------------------------------------- recording

    @property
    def identity(self) -> str:
        """The description as canonical JSON."""
        return json.dumps(self.description, sort_keys=True, separators=(",", ":"), allow_nan=False)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """The streams in the order of their names."""
        return tuple(_info(self._channels[name]) for name in sorted(self._channels))

    @property
    def cameras(self) -> dict[str, Camera]:
        """The calibration that each camera sends first, with the place of a rigidly fixed one in the body.

        The body's origin is the point whose poses the mission tells.
        """
        sent: dict[str, Camera] = {}
        for camera in self.on_board:
            info = self._channels.get(info_stream_of(camera.stream))
            if info is not None and len(info.number):
                first = info.sample(int(info.number[0]), int(info.stamp_ns[0]), int(info.received_ns[0]))
                known = first.camera if isinstance(first, CameraInfo) else camera.camera
                sent[camera.stream] = dataclasses.replace(known, body_t_camera=self._body_t_camera(camera.mount))
        return sent

    def _body_t_camera(self, mount: Mount) -> Floats:
        """Where a camera sits [4, 4]; NaN where it turns in the body."""
        if mount.hold is not Hold.RIGID:
            return unknown_transform()
        body_t_camera = np.eye(4)
        body_t_camera[:3, :3], body_t_camera[:3, 3] = mount.body_r_camera, mount.position_m - self._pose_point_m
        return body_t_camera

    @property
    def landmarks(self) -> dict[int, Landmark]:
        """The points that are tracked, by the numbers of their tracks; their places are exact."""
        return {k: Landmark(position_m=place, sigma_m=np.zeros(3)) for k, place in enumerate(self._landmarks_m)}

    def read(
        self,
        streams: Sequence[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Sample]:
        """Yield the samples, merged by time; images are rendered when their `data` is asked for.

        Raises:
            StreamError: there is no such stream.
        """
        plans = [(channel, _by_stamp(channel, start_ns, stop_ns)) for channel in self._wanted(streams)]
        keyed = [zip(channel.stamp_ns[order].tolist(), order.tolist(), strict=True) for channel, order in plans]
        return _merged([channel for channel, _ in plans], keyed)

    def arrivals(self, streams: Sequence[str] | None = None) -> Iterator[Sample]:
        """Yield the samples in the order in which they were received.

        Raises:
            StreamError: there is no such stream.
        """
        channels = self._wanted(streams)
        return _merged(channels, [zip(c.received_ns.tolist(), range(len(c.number)), strict=True) for c in channels])

    def count_before(self, stream: str, t_ns: int) -> int:
        """How many samples of `stream` lie before `t_ns`.

        Raises:
            StreamError: there is no such stream.
        """
        (channel,) = self._wanted([stream])
        return int(np.count_nonzero(channel.stamp_ns < t_ns))

    def _wanted(self, streams: Sequence[str] | None) -> list[Channel]:
        names = set(self._channels if streams is None else streams)
        for name in sorted(names - set(self._channels)):
            known = ", ".join(sorted(self._channels))
            raise StreamError(f"{self.path}: no stream named {name!r}; the streams are: {known}")
        return [channel for name, channel in self._channels.items() if name in names]


def _by_stamp(channel: Channel, start_ns: int | None, stop_ns: int | None) -> Longs:
    """The messages of a channel within a range of stamps, in the order of their stamps."""
    order = np.argsort(channel.stamp_ns, kind="stable")
    stamps = channel.stamp_ns[order]
    first = 0 if start_ns is None else int(np.searchsorted(stamps, start_ns))
    stop = len(order) if stop_ns is None else int(np.searchsorted(stamps, stop_ns))
    return order[first:stop]


def _merged(channels: Sequence[Channel], keyed: Sequence[Iterable[tuple[int, int]]]) -> Iterator[Sample]:
    """Samples of channels by time, of equal times in the order of the channels."""

    def tagged(rank: int, entries: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int, int]]:
        return ((time, rank, message) for time, message in entries)

    ranked = [tagged(rank, entries) for rank, entries in enumerate(keyed)]
    for _, rank, k in heapq.merge(*ranked, key=itemgetter(0, 1)):
        channel = channels[rank]
        yield channel.sample(int(channel.number[k]), int(channel.stamp_ns[k]), int(channel.received_ns[k]))


def _info(channel: Channel) -> StreamInfo:
    count = len(channel.number)
    return StreamInfo(
        name=channel.stream,
        kind=channel.kind,
        type=channel.type,
        encoding="simulated",
        count=count,
        first_ns=int(channel.received_ns.min()) if count else -1,
        last_ns=int(channel.received_ns.max()) if count else -1,
        frame=channel.frame,
    )


# ---------------------------------------------------------------------- a camera over a surface


def nadir_camera(
    width_px: int = PAPER_SIDE_PX, height_px: int = PAPER_SIDE_PX, focal_px: float = PAPER_FOCAL_PX
) -> Camera:
    """A distortion-free camera with its principal point in the image centre; defaults are paper A's."""
    return pinhole(width_px, height_px, focal_px)


def nadir_mission(
    surface: Surface,
    poses: Floats,
    *,
    camera: Camera | None = None,
    height_m: float | Floats = PAPER_HEIGHT_M,
    roll_rad: float | Floats = 0.0,
    pitch_rad: float | Floats = 0.0,
    rate_hz: float = 60.0,
    start_ns: int = START_NS,
    noise_grey: float = 2.0,
    vignetting: float = 0.0,
    seed: int = 0,
    faults: Sequence[Fault] = (),
    name: str = "simulated",
) -> SimulatedMission:
    """A downward camera's drive over a surface, given pose by pose.

    Streams: `/camera/image_raw` (mono8), `/camera/camera_info`, `/reference/pose` (x, y, heading and height
    of the camera in the world; the true pose), `/camera/height` (the true height). All have the frames'
    times; dropped frames have the other three.

    Args:
        surface: the ground.
        poses: x (m), y (m), heading (rad) of the camera [n, 3], z up, counter-clockwise.
        camera: intrinsics, without distortion; paper A's by default.
        height_m: height above the ground, one number or [n].
        roll_rad: roll of the camera, one number or [n] (see `motion`).
        pitch_rad: pitch of the camera, one number or [n].
        rate_hz: frames per second.
        start_ns: time of the first frame.
        noise_grey: standard deviation of the sensor's noise.
        vignetting: fall of brightness in the image corners, 0…1.
        seed: seed of the noise.
        faults: what goes wrong with the images or lies on the ground.
        name: name of the mission.

    Raises:
        ValueError: an array has another length than the poses, or a fault is of another kind.
    """
    motion = Waypoints(np.arange(len(poses)) / rate_hz, poses, height_m, roll_rad, pitch_rad)
    mount, camera, timing = Mount(), camera or nadir_camera(), Timing(rate_hz=rate_hz)
    unfit = [fault.name for fault in faults if not isinstance(fault, OF_IMAGES + OF_GROUND)]
    if unfit:
        raise ValueError(f"{name}: {unfit[0]} is no fault of the images or the ground; make a scenario for it")
    met = faults_met(faults, camera, mount, motion, timing.times_s(motion.duration_s))
    start: dict[str, Any] = {"start_ns": start_ns, "seed": seed}
    plan = schedule(timing, duration_s=motion.duration_s, stream=IMAGE, faults=met, **start)
    on_board = CameraOnBoard(
        stream=IMAGE,
        camera=camera,
        mount=mount,
        motion=motion,
        scene=Scene(surface, patches_of(met, surface, seed)),
        plan=plan,
        rate_hz=rate_hz,
        noise_grey=noise_grey,
        vignetting=vignetting,
        faults=met,
        name=name,
        **start,
    )
    channels = [
        camera_info_channel(camera, timing, duration_s=motion.duration_s, faults=met, **start),
        reference_channel(motion, Reference(timing=timing, child_frame=CAMERA_FRAME), **start),
        height_channel(motion, Height(timing=timing), mount, **start),
        on_board.channel(),
    ]
    return SimulatedMission(
        channels,
        name=name,
        start_ns=start_ns,
        motion=motion,
        cameras=[on_board],
        faults=met,
        description={
            "name": name,
            "surface": digest(surface.coefficients)
            + repr((surface.texels_per_px, surface.metres_per_px, surface.scatter)),
            "motion": digest(motion.t_s, poses, motion.height_m, motion.roll_rad, motion.pitch_rad),
            "camera": [camera.width_px, camera.height_px, camera.matrix.tolist()],
            "images": [start_ns, noise_grey, vignetting, seed],
            "faults": [[fault.name, dataclasses.asdict(fault)] for fault in met],
        },
    )


def digest(*arrays: ArrayLike) -> str:
    """SHA-256 of the values of some arrays, as hexadecimal digits."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def info_stream_of(image_stream: str) -> str:
    """Where the calibration of a camera is sent: ``…/camera_info`` beside its images."""
    return image_stream.rpartition("/")[0] + "/camera_info"
