"""A simulated mission: a `Recording` of channels, whose truth comes with it.

Nothing is kept but what the mission is; every sample is made when it is asked for, and images are rendered
when their bytes are. The truth and the list of faults are attributes, and streams where a scenario says so.
"""

from __future__ import annotations

import dataclasses
import hashlib
import heapq
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import quat_of_heading
from pipelines.simulation.channels import Channel, Longs
from pipelines.simulation.faults import Fault
from pipelines.simulation.imaging import OF_IMAGES, CameraOnBoard, ground_view, pinhole
from pipelines.simulation.motion import Motion, Mount, Waypoints
from pipelines.simulation.patches import OF_GROUND, faults_met, patches_of
from pipelines.simulation.surfaces import Surface
from readers.streams import (
    UNKNOWN_COV6,
    Camera,
    PoseSample,
    RangeSample,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
    StreamKind,
)

Floats = NDArray[np.float64]

IMAGE, INFO, POSE, HEIGHT = "/camera/image_raw", "/camera/camera_info", "/reference/pose", "/camera/height"
WORLD_FRAME, CAMERA_FRAME = "world", "camera_ground"
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
        description: Mapping[str, Any],
    ) -> None:
        self.path, self.start_ns, self.motion = Path(name), start_ns, motion
        self.on_board, self.faults, self.description = tuple(cameras), tuple(faults), dict(description)
        self._channels = {channel.stream: channel for channel in channels}
        if len(self._channels) != len(channels):
            raise ValueError(f"{name}: two channels have the same name: {[channel.stream for channel in channels]}")
        if self.on_board:
            first = self.on_board[0]
            self.truth_t_ns = first.t_ns
            self.truth_poses = camera_poses(first.mount, motion, first.t_s)
            self.metres_per_px = _price_of_pixel(first)

    # ------------------------------------------------------------------------------ frames

    @property
    def camera(self) -> Camera:
        """What the first camera truly is."""
        return self.on_board[0].camera

    def frame(self, k: int) -> NDArray[np.uint8]:
        """The image that the first camera sends for its frame k, uint8 [height, width].

        Raises:
            IndexError: there is no such frame.
        """
        camera = self.on_board[0]
        return camera.picture(camera.shown(k) if 0 <= k < len(camera.t_s) else k)

    def sent(self, k: int) -> bool:
        """Whether the image of the first camera's frame k arrives."""
        return self.on_board[0].sent(k)

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
        """The calibration that each camera sends first."""
        return {camera.stream: camera.sent_camera(float(camera.t_s[0])) for camera in self.on_board}

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


def camera_poses(mount: Mount, motion: Motion, t_s: Floats) -> Floats:
    """Where a camera is at times [n], seen from above: x (m), y (m), heading of its u axis (rad, continuous) [n, 3]."""
    world_r_camera, position = mount.world_t_camera(motion.at(t_s))
    heading = np.unwrap(np.arctan2(world_r_camera[:, 1, 0], world_r_camera[:, 0, 0]))
    return np.column_stack([position[:, :2], heading])


def _price_of_pixel(camera: CameraOnBoard) -> float:
    _, position = camera.mount.world_t_camera(camera.motion.at(camera.t_s))
    return float(np.mean(position[:, 2]) / camera.camera.matrix[0, 0])


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
    t_s = np.arange(len(poses)) / rate_hz
    motion, mount, camera = Waypoints(t_s, poses, height_m, roll_rad, pitch_rad), Mount(), camera or nadir_camera()
    unfit = [fault.name for fault in faults if not isinstance(fault, OF_IMAGES + OF_GROUND)]
    if unfit:
        raise ValueError(f"{name}: {unfit[0]} is no fault of the images or the ground; make a scenario for it")
    met = faults_met(faults, camera, mount, motion, t_s)
    patches = patches_of(met, surface, seed)
    on_board = CameraOnBoard(
        stream=IMAGE,
        info_stream=INFO,
        camera=camera,
        mount=mount,
        motion=motion,
        rate_hz=rate_hz,
        t_s=t_s,
        start_ns=start_ns,
        view=ground_view(surface, patches, camera, mount, motion),
        noise_grey=noise_grey,
        vignetting=vignetting,
        seed=seed,
        faults=met,
        name=name,
    )
    return SimulatedMission(
        [on_board.info_channel(), *_truth_channels(on_board), on_board.image_channel()],
        name=name,
        start_ns=start_ns,
        motion=motion,
        cameras=[on_board],
        faults=met,
        description={
            "name": name,
            "surface": _digest(surface.coefficients) + f" {surface.texels_per_px} {surface.metres_per_px!r}",
            "motion": _digest(t_s, motion.poses, motion.height_m, motion.roll_rad, motion.pitch_rad),
            "camera": [camera.width_px, camera.height_px, camera.matrix.tolist()],
            "images": [start_ns, noise_grey, vignetting, seed],
            "faults": [[fault.name, dataclasses.asdict(fault)] for fault in met],
        },
    )


def _truth_channels(camera: CameraOnBoard) -> list[Channel]:
    """Pose and height of a camera without fail, at the times of its pictures."""
    poses = camera_poses(camera.mount, camera.motion, camera.t_s)
    height_m = camera.mount.world_t_camera(camera.motion.at(camera.t_s))[1][:, 2]

    def pose(number: int, t_ns: int, received_ns: int) -> PoseSample:
        x, y, heading = poses[number]
        return PoseSample(
            stream=POSE,
            t_ns=t_ns,
            received_ns=received_ns,
            position_m=np.array([x, y, height_m[number]]),
            quat_xyzw=quat_of_heading(float(heading)),
            covariance=UNKNOWN_COV6,
            parent_frame=WORLD_FRAME,
            child_frame=CAMERA_FRAME,
        )

    def height(number: int, t_ns: int, received_ns: int) -> RangeSample:
        return RangeSample(
            stream=HEIGHT,
            t_ns=t_ns,
            received_ns=received_ns,
            range_m=float(height_m[number]),
            min_range_m=0.0,
            max_range_m=float("inf"),
            field_of_view_rad=0.0,
        )

    def channel(stream: str, kind: StreamKind, ros_type: str, frame: str, sample: Callable[..., Sample]) -> Channel:
        times = camera.t_ns
        return Channel(
            stream=stream,
            kind=kind,
            type=ros_type,
            frame=frame,
            number=np.arange(len(times)),
            stamp_ns=times,
            received_ns=times,
            sample=sample,
        )

    return [
        channel(POSE, StreamKind.POSE, "geometry_msgs/msg/PoseStamped", WORLD_FRAME, pose),
        channel(HEIGHT, StreamKind.RANGE, "sensor_msgs/msg/Range", camera.camera.frame, height),
    ]


def _digest(*arrays: Any) -> str:
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
