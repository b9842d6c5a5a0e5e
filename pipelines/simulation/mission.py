"""A simulated mission: a `Recording` whose frames are rendered when they are asked for.

A downward camera drives over a surface. Every frame is a function of the mission and its own number, so
random access gives the same bytes as reading in order. The truth and the list of faults come with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import quat_of_heading
from pipelines.simulation.render import Patch, expose, noise_key_of, radiance, world_h_pixel
from pipelines.simulation.surfaces import Surface
from readers.streams import (
    UNKNOWN_COV6,
    Camera,
    CameraInfo,
    ImageSample,
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


# ---------------------------------------------------------------------------------- faults


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that goes wrong from frame `start` to before frame `stop`."""

    start: int
    stop: int

    @property
    def name(self) -> str:
        """Name of the kind of fault."""
        return type(self).__name__

    def holds(self, frame: int) -> bool:
        """Whether the fault is there at that frame."""
        return self.start <= frame < self.stop


@dataclass(frozen=True, slots=True)
class DroppedFrames(Fault):
    """The images never arrive."""


@dataclass(frozen=True, slots=True)
class DuplicateFrames(Fault):
    """The image before `start` is sent again and again, with stamps of its own."""


@dataclass(frozen=True, slots=True)
class ExposureJump(Fault):
    """The images are `gain` times as bright, plus `offset_grey`."""

    gain: float
    offset_grey: float = 0.0


@dataclass(frozen=True, slots=True)
class MotionBlur(Fault):
    """The shutter stays open for `exposure` of the frame interval, about the frame's time."""

    exposure: float
    samples: int = 15


@dataclass(frozen=True, slots=True)
class RepetitivePatch(Fault):
    """The way leads over a rectangle of the ground where the texture repeats itself.

    `over` makes one of the patch; `start` and `stop` are then the frames whose image centre lies in it.
    """

    patch: Patch

    @classmethod
    def over(cls, poses: Floats, patch: Patch) -> RepetitivePatch:
        """The fault that a patch is on a way of poses [n, 3].

        Raises:
            ValueError: the way does not lead over the patch.
        """
        x, y = poses[:, 0], poses[:, 1]
        inside = (patch.x_min_m <= x) & (x < patch.x_max_m) & (patch.y_min_m <= y) & (y < patch.y_max_m)
        frames = np.flatnonzero(inside)
        if not len(frames):
            raise ValueError("the way does not lead over the patch: move the patch or the way")
        return cls(int(frames[0]), int(frames[-1]) + 1, patch)


# --------------------------------------------------------------------------------- mission


def nadir_camera(
    width_px: int = PAPER_SIDE_PX, height_px: int = PAPER_SIDE_PX, focal_px: float = PAPER_FOCAL_PX
) -> Camera:
    """A distortion-free camera with its principal point in the image centre; defaults are paper A's."""
    u0, v0 = (width_px - 1) / 2, (height_px - 1) / 2
    matrix = np.array([[focal_px, 0, u0], [0, focal_px, v0], [0, 0, 1.0]])
    return Camera(
        width_px=width_px,
        height_px=height_px,
        matrix=matrix,
        distortion_model="plumb_bob",
        distortion=np.zeros(5),
        rectification=np.eye(3),
        projection=np.column_stack([matrix, np.zeros(3)]),
        frame="camera",
    )


class SimulatedMission(Recording):
    """A downward camera's drive over a surface.

    Streams: `/camera/image_raw` (mono8), `/camera/camera_info`, `/reference/pose` (x, y, heading and height
    of the camera in the world; the true pose), `/camera/height` (the true height). All have the
    frames' times; dropped frames have the other three.

    Args:
        surface: the ground.
        poses: x (m), y (m), heading (rad) of the camera [n, 3], z up, counter-clockwise.
        camera: intrinsics; paper A's by default.
        height_m: height above the ground, one number or [n].
        roll_rad: roll of the camera, one number or [n] (see `render`).
        pitch_rad: pitch of the camera, one number or [n].
        rate_hz: frames per second.
        start_ns: time of the first frame.
        noise_grey: standard deviation of the sensor's noise.
        vignetting: fall of brightness in the image corners, 0…1.
        seed: seed of the noise.
        faults: what goes wrong.
        name: name of the mission.

    Attributes:
        truth_poses: the poses [n, 3] of all frames, those of dropped images included.
        truth_t_ns: their times [n].
        faults: the faults, as given.
        metres_per_px: price of a pixel W at the mean height.

    Raises:
        ValueError: an array has another length than the poses.
    """

    format = "simulated mission"

    def __init__(
        self,
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
    ) -> None:
        n = len(poses)
        self.path = Path(name)
        self.surface, self.truth_poses, self.faults = surface, poses, tuple(faults)
        self.camera = camera or nadir_camera()
        self.height_m, self.roll_rad, self.pitch_rad = (_per_frame(x, n) for x in (height_m, roll_rad, pitch_rad))
        self.truth_t_ns = start_ns + np.rint(np.arange(n) * (1e9 / rate_hz)).astype(np.int64)
        self.noise_grey, self.vignetting, self.seed = noise_grey, vignetting, seed
        self.metres_per_px = float(np.mean(self.height_m) / self.camera.matrix[0, 0])
        self._patches = tuple(f.patch for f in self.faults if isinstance(f, RepetitivePatch))

    # ------------------------------------------------------------------------------ frames

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Render frame k, uint8 [height, width].

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= k < len(self.truth_poses):
            raise IndexError(f"frame {k} of a mission of {len(self.truth_poses)} frames")
        k = self._shown(k)
        jumps = [f for f in self.faults if isinstance(f, ExposureJump) and f.holds(k)]
        return expose(
            self._radiance(k),
            noise_key=noise_key_of(self.seed, k),
            noise_grey=self.noise_grey,
            gain=float(np.prod([f.gain for f in jumps])),
            offset_grey=float(sum(f.offset_grey for f in jumps)),
            vignetting=self.vignetting,
        )

    def sent(self, k: int) -> bool:
        """Whether the image of frame k arrives."""
        return not any(isinstance(f, DroppedFrames) and f.holds(k) for f in self.faults)

    def _shown(self, k: int) -> int:
        """The frame whose image is sent for frame k."""
        duplicates = [f for f in self.faults if isinstance(f, DuplicateFrames) and f.holds(k)]
        return max(0, min((f.start - 1 for f in duplicates), default=k))

    def _radiance(self, k: int) -> NDArray[np.float32]:
        blurs = [f for f in self.faults if isinstance(f, MotionBlur) and f.holds(k)]
        if not blurs:
            return self._sharp(self.truth_poses[k], k)
        exposure, samples = max((f.exposure, f.samples) for f in blurs)
        times = k + exposure * ((np.arange(samples) + 0.5) / samples - 0.5)
        frames = np.arange(len(self.truth_poses))
        ways = np.column_stack([np.interp(times, frames, column) for column in self.truth_poses.T])
        total = np.zeros((self.camera.height_px, self.camera.width_px), dtype=np.float32)
        for pose in ways:
            total += self._sharp(pose, k)
        return total / np.float32(samples)

    def _sharp(self, pose: Floats, k: int) -> NDArray[np.float32]:
        h = world_h_pixel(
            pose,
            self.camera.matrix,
            float(self.height_m[k]),
            roll_rad=float(self.roll_rad[k]),
            pitch_rad=float(self.pitch_rad[k]),
        )
        return radiance(self.surface, h, (self.camera.height_px, self.camera.width_px), self._patches)

    # --------------------------------------------------------------------------- recording

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """The four streams."""
        return tuple(self._info(name) for name in sorted(_STREAMS))

    @property
    def cameras(self) -> dict[str, Camera]:
        """The one camera."""
        return {IMAGE: self.camera}

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
        wanted = set(_STREAMS) if streams is None else set(streams)
        for name in wanted - set(_STREAMS):
            raise StreamError(f"{self.path}: no stream named {name!r}; the streams are: {', '.join(sorted(_STREAMS))}")
        return self._samples([name for name in _STREAMS if name in wanted], start_ns, stop_ns)

    def _samples(self, names: Sequence[str], start_ns: int | None, stop_ns: int | None) -> Iterator[Sample]:
        first = 0 if start_ns is None else int(np.searchsorted(self.truth_t_ns, start_ns))
        stop = len(self.truth_t_ns) if stop_ns is None else int(np.searchsorted(self.truth_t_ns, stop_ns))
        for k in range(first, stop):
            for name in names:
                if name != IMAGE or self.sent(k):
                    yield _STREAMS[name].sample(self, k)

    def _info(self, name: str) -> StreamInfo:
        frames = [k for k in range(len(self.truth_t_ns)) if name != IMAGE or self.sent(k)]
        return StreamInfo(
            name=name,
            kind=_STREAMS[name].kind,
            type=_STREAMS[name].type,
            encoding="simulated",
            count=len(frames),
            first_ns=int(self.truth_t_ns[frames[0]]) if frames else -1,
            last_ns=int(self.truth_t_ns[frames[-1]]) if frames else -1,
            frame=WORLD_FRAME if name == POSE else self.camera.frame,
        )

    def _image(self, k: int) -> ImageSample:
        t_ns = int(self.truth_t_ns[k])
        return ImageSample(
            stream=IMAGE,
            t_ns=t_ns,
            received_ns=t_ns,
            encoding="mono8",
            payload=partial(_bytes_of_frame, self, k),
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            step_bytes=self.camera.width_px,
            source=f"{self.path} frame {k}",
        )

    def _camera_info(self, k: int) -> CameraInfo:
        t_ns = int(self.truth_t_ns[k])
        return CameraInfo(stream=INFO, t_ns=t_ns, received_ns=t_ns, camera=self.camera)

    def _pose(self, k: int) -> PoseSample:
        t_ns = int(self.truth_t_ns[k])
        x, y, heading = self.truth_poses[k]
        return PoseSample(
            stream=POSE,
            t_ns=t_ns,
            received_ns=t_ns,
            position_m=np.array([x, y, self.height_m[k]]),
            quat_xyzw=quat_of_heading(float(heading)),
            covariance=UNKNOWN_COV6,
            parent_frame=WORLD_FRAME,
            child_frame=CAMERA_FRAME,
        )

    def _height(self, k: int) -> RangeSample:
        t_ns = int(self.truth_t_ns[k])
        return RangeSample(
            stream=HEIGHT,
            t_ns=t_ns,
            received_ns=t_ns,
            range_m=float(self.height_m[k]),
            min_range_m=0.0,
            max_range_m=float("inf"),
            field_of_view_rad=0.0,
        )


@dataclass(frozen=True, slots=True)
class _Stream:
    kind: StreamKind
    type: str
    sample: Callable[[SimulatedMission, int], Sample]


_STREAMS = {
    INFO: _Stream(StreamKind.CAMERA, "sensor_msgs/msg/CameraInfo", SimulatedMission._camera_info),
    POSE: _Stream(StreamKind.POSE, "geometry_msgs/msg/PoseStamped", SimulatedMission._pose),
    HEIGHT: _Stream(StreamKind.RANGE, "sensor_msgs/msg/Range", SimulatedMission._height),
    IMAGE: _Stream(StreamKind.IMAGE, "sensor_msgs/msg/Image", SimulatedMission._image),
}


def _bytes_of_frame(mission: SimulatedMission, k: int) -> memoryview:
    return mission.frame(k).data.cast("B")


def _per_frame(value: float | Floats, n: int) -> Floats:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim and array.shape != (n,):
        raise ValueError(f"an array of shape {array.shape} for {n} frames: give one number or [{n}]")
    return np.broadcast_to(array, (n,))
