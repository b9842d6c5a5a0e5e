"""The contract of the readers: samples, cameras, stream facts, recordings and errors.

Everything behind this contract is in SI units and radians; foreign units, axes and quaternion
orders end at the reader. Time is `t_ns: int`, nanoseconds since the recording's epoch, and
every range of time is half-open, `start_ns <= t < stop_ns`.
"""

from __future__ import annotations

import abc
import enum
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from readers.extras import Extras
    from readers.salvage import Loss

FloatArray = NDArray[np.float64]


# ---------------------------------------------------------------------------------- errors


class WorkbenchError(Exception):
    """Root of the errors that a user can cure; its text names the thing and the cure."""


class RecordingError(WorkbenchError):
    """A file or folder that cannot be used as a recording.

    Args:
        path: the file or folder.
        problem: what is wrong, one clause without a full stop.
        cure: what the user can do, one clause without a full stop.
    """

    def __init__(self, path: Path | str, problem: str, cure: str) -> None:
        self.path, self.problem, self.cure = Path(path), problem, cure
        super().__init__(f"{path}: {problem}; {cure}")


class StreamError(WorkbenchError):
    """A stream that is missing, or that holds something else than what was asked for."""


class ImageError(WorkbenchError):
    """One image that cannot be decoded; the other images are not affected."""


# --------------------------------------------------------------------------------- samples


class StreamKind(enum.StrEnum):
    """What the samples of a stream are."""

    IMAGE = "image"
    CAMERA = "camera"
    IMU = "imu"
    ODOMETRY = "odometry"
    POSE = "pose"
    RANGE = "range"
    GNSS = "gnss"
    TRACK = "track"
    LANDMARKS = "landmarks"
    SCALAR = "scalar"
    TEXT = "text"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One timestamped datum of a stream.

    `t_ns` is the sensor's time (the header stamp where it is sane, else the log time, unless the user chose another
    clock, plus the user's offset); `received_ns` is the log time. Both are integer nanoseconds of the same epoch.
    `header_ns` is the message's own stamp as it stands there, sane or not, and `published_ns` when it was sent; -1
    where there is none. `oddities` are the
    codes of what the reader met in this one message and how it took it, such as ``foreign_stamp``;
    `readers.clock.StreamAudit` counts them and has a sentence for each.
    """

    stream: str
    t_ns: int
    received_ns: int
    oddities: tuple[str, ...] = ()
    header_ns: int = field(default=-1, compare=False)
    published_ns: int = field(default=-1, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSample(Sample):
    """One image, kept as it was stored until `grey()` or `colour()` is called.

    `encoding` is the ROS name of a raw encoding (``mono8``, ``bgr8``, ``bayer_rggb8``, …) or the
    name of a compressed format (``jpeg``, ``png``, ``tiff``, …). `width_px` and `height_px` are 0
    for compressed images whose header was not read. `step_bytes` and `big_endian` matter for raw
    encodings only. `payload` is the stored bytes, or a function that loads them; `source` names
    where they come from (a file name, or topic and index) for messages. `frame` is the number of the
    image in its stream, which the replay sets; -1 before.
    """

    encoding: str
    payload: bytes | memoryview | Callable[[], bytes | memoryview] = field(repr=False)
    width_px: int = 0
    height_px: int = 0
    step_bytes: int = 0
    big_endian: bool = False
    source: str = ""
    frame: int = -1

    @property
    def data(self) -> bytes | memoryview:
        """The stored bytes.

        Raises:
            ImageError: the bytes cannot be loaded.
        """
        return self.payload() if callable(self.payload) else self.payload

    @property
    def media_type(self) -> str | None:
        """``image/jpeg`` or ``image/png`` where the stored bytes can be shown as they are, else None."""
        return {"jpeg": "image/jpeg", "png": "image/png"}.get(self.encoding)

    def check(self) -> None:
        """Refuse an image that cannot be decoded by what is stated of it, without a look at its data.

        Raises:
            ImageError: its encoding is not known, or its size and step are impossible.
        """
        from readers.images import check_stated

        check_stated(self)

    def grey(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Decode to grey levels, shape [height, width], uint8 (uint16 for 16-bit encodings).

        Raises:
            ImageError: the image is damaged or its encoding is not supported.
        """
        from readers.images import decode_grey

        return decode_grey(self)

    def colour(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Decode to RGB, shape [height, width, 3], uint8 (uint16 for 16-bit encodings).

        Raises:
            ImageError: the image is damaged or its encoding is not supported.
        """
        from readers.images import decode_colour

        return decode_colour(self)

    def depth(self) -> NDArray[np.float32]:
        """Decode a depth image to metres, shape [height, width], NaN where nothing was measured.

        Raises:
            ImageError: the image is damaged or holds no distances.
        """
        from readers.images import decode_depth

        return decode_depth(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSample(Sample):
    """Inertial measurement in the sensor's axes.

    `angular_velocity_radps` [3], `linear_acceleration_mps2` [3] (specific force),
    `quat_xyzw` [4] orientation, NaN where it was not measured.
    """

    angular_velocity_radps: FloatArray
    linear_acceleration_mps2: FloatArray
    quat_xyzw: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometrySample(Sample):
    """Body velocities, with a pose where the log has one.

    `linear_velocity_mps` [3] and `angular_velocity_radps` [3] in the body's axes,
    `position_m` [3] and `quat_xyzw` [4] of `world_T_body`, NaN where there is no pose.
    """

    linear_velocity_mps: FloatArray
    angular_velocity_radps: FloatArray
    position_m: FloatArray
    quat_xyzw: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseSample(Sample):
    """A pose `parent_T_child`: `position_m` [3], `quat_xyzw` [4] of unit norm, NaN where unknown.

    `covariance` is [6, 6] in the order x, y, z (m), rotation about x, y, z (rad), NaN where unknown.
    """

    position_m: FloatArray
    quat_xyzw: FloatArray
    covariance: FloatArray
    parent_frame: str = ""
    child_frame: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeSample(Sample):
    """One distance measurement in metres (`range_m`), with the sensor's limits; infinite or NaN is kept."""

    range_m: float
    min_range_m: float
    max_range_m: float
    field_of_view_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssSample(Sample):
    """A fix on WGS 84: latitude and longitude in radians, altitude in metres.

    `covariance_m2` is [3, 3] east, north, up, NaN where unknown; `status` is negative without a fix.
    """

    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    covariance_m2: FloatArray
    status: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSample(Sample):
    """Pixel tracks of one frame: `ids` int64 [N], `points_px` float64 [N, 2] (u, v).

    `frame` is the number of the sample in its stream, which the replay sets; -1 before.
    """

    ids: NDArray[np.int64]
    points_px: FloatArray
    frame: int = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkSample(Sample):
    """Landmarks that a vehicle measured at one moment, N of them.

    `ids` int64 [N]; `range_m` [N] distance in the plane; `bearing_rad` [N] direction from the body's x axis,
    counter-clockwise; NaN where not measured. `Recording.landmarks` has the places of those that stand still.
    `frame` is the number of the sample in its stream, which the replay sets; -1 before.
    """

    ids: NDArray[np.int64]
    range_m: FloatArray
    bearing_rad: FloatArray
    frame: int = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmark:
    """A surveyed point: `position_m` [3] in the world and the standard deviation `sigma_m` [3], NaN if unknown."""

    position_m: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarSample(Sample):
    """One number of a stream of plain numbers, in the unit that its topic has."""

    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TextSample(Sample):
    """A piece of text, such as a log line or the list of a simulated mission's faults."""

    text: str


def unknown_transform() -> FloatArray:
    """A transform [4, 4] that nothing is known of: NaN."""
    return np.full((4, 4), np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics of one camera.

    `matrix` K [3, 3] in px, `distortion_model` (``plumb_bob``, ``rational_polynomial``,
    ``equidistant``, … or ``none``), `distortion` [n], `rectification` R [3, 3], `projection`
    P [3, 4] in px; a matrix that the log does not have is NaN. `body_t_camera` [4, 4] is the transform that
    maps points of the camera (x right, y down, z ahead) into the body, whose axes are those of the recording's own
    odometry, IMU and poses; NaN where unknown.
    A size of 0 x 0 px is unknown. `source` says where it comes from, empty for the recording itself.
    """

    width_px: int
    height_px: int
    matrix: FloatArray
    distortion_model: str
    distortion: FloatArray
    rectification: FloatArray
    projection: FloatArray
    frame: str = ""
    body_t_camera: FloatArray = field(default_factory=unknown_transform, repr=False)
    source: str = field(default="", compare=False)

    @property
    def calibrated(self) -> bool:
        """Whether K has a positive, finite focal length."""
        return bool(np.all(np.isfinite(self.matrix)) and self.matrix[0, 0] > 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraInfo(Sample):
    """A camera's intrinsics as they were sent at one moment."""

    camera: Camera


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(Sample):
    """A message that stood in the file and could not be made a sample; `reason` says why.

    `Recording.read` yields it in place of the sample, so that a replay can give it a verdict.
    """

    kind: StreamKind
    reason: str
    frame: int = -1


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A file with the calibration of a camera.

    `topic` is the stream of images that it is for, empty for the only one or those that the file names; `name` the
    camera in the file, empty for the only one or that of the topic.
    """

    path: Path
    topic: str = ""
    name: str = ""


class Clock(enum.StrEnum):
    """Whose time a sample carries: the sensor's (header stamp), the recorder's (log), or the sender's (publish)."""

    HEADER = "header"
    LOG = "log"
    PUBLISH = "publish"

    @property
    def sentence(self) -> str:
        """The clock in words."""
        words = {"header": "header stamps", "log": "log times", "publish": "publish times"}
        return words[self.value]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """What a user tells a reader that the recording does not say itself.

    `rate_hz` is the frame rate of plain frames or a video without times; `times_file` a file with the
    frames' times, in `times_unit` (``s``, ``ms``, ``us``, ``ns`` or ``auto``); `pose_frames` pairs
    ``parent, child`` whose transforms in ``/tf`` become pose streams (all pairs found if empty). `clocks` are pairs of
    a topic and the `Clock` that its samples' times come from, ``header`` where none is named; `offsets_ns` pairs of a
    topic and what is added to the times of its samples. `cameras` are the files of calibrations that take the place of
    the recording's own; `scale_cameras` has calibrations of another image size scaled to the images. Definitions that a
    log does not have come from the ROS 2 `distribution` (``humble``; the latest if empty), then from the ``.msg`` files
    of `msg_folder`. `cache` allows a log without a usable index to be opened by what an earlier opening found, see
    `readers.index_cache`.
    """

    rate_hz: float | None = None
    times_file: Path | None = None
    times_unit: str = "auto"
    pose_frames: tuple[tuple[str, str], ...] = ()
    clocks: tuple[tuple[str, Clock], ...] = ()
    offsets_ns: tuple[tuple[str, int], ...] = ()
    cameras: tuple[CameraFile, ...] = ()
    scale_cameras: bool = False
    distribution: str = ""
    msg_folder: Path | None = None
    cache: bool = True

    def clock_of(self, topic: str) -> Clock:
        """The clock of a topic."""
        return dict(self.clocks).get(topic, Clock.HEADER)

    def offset_ns_of(self, topic: str) -> int:
        """What is added to the times of a topic."""
        return dict(self.offsets_ns).get(topic, 0)

    def clock_notes(self) -> tuple[str, ...]:
        """What was asked for of the clocks, one sentence each."""
        chosen = [f"{topic}: times are {clock.sentence}, as asked." for topic, clock in self.clocks]
        moved = [f"{topic}: {ns / 1e6:+g} ms are added to its times, as asked." for topic, ns in self.offsets_ns]
        return (*chosen, *moved)


# -------------------------------------------------------------------------- stream facts


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamInfo:
    """What is known of one stream without decoding its samples.

    `count` is -1 where the file does not say it and it was not counted; `first_ns` and `last_ns`
    are log times (-1 for an empty stream); `rate_hz` is NaN below two messages. `definition` is the
    message definition or schema from the log. `readable` is False, with the `reason`, for streams
    that are listed and skipped.
    """

    name: str
    kind: StreamKind
    type: str
    encoding: str = ""
    count: int = -1
    first_ns: int = -1
    last_ns: int = -1
    frame: str = ""
    definition: str = field(default="", repr=False)
    readable: bool = True
    reason: str = ""

    @property
    def rate_hz(self) -> float:
        """Mean rate in Hz between the first and the last message, NaN below two messages."""
        if self.count < 2 or self.last_ns <= self.first_ns:
            return float("nan")
        return (self.count - 1) * 1e9 / (self.last_ns - self.first_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class Damage:
    """One piece of damage: what is broken, where, and how much of the file it affects.

    `affected` is a share of the file's bytes, 0…1, NaN where it cannot be told.
    """

    what: str
    where: str
    affected: float = float("nan")

    def __str__(self) -> str:
        share = "" if self.affected != self.affected else f" ({self.affected:.1%} of the file affected)"
        return f"{self.what} at {self.where}{share}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fact:
    """One counted oddity of a stream, such as 3 duplicate stamps; `code` is a stable short name."""

    stream: str
    code: str
    count: int
    sentence: str


# ------------------------------------------------------------------------------ recording


class Recording(abc.ABC):
    """A mission's log: streams of samples, merged by time.

    Attributes:
        path: the file or folder that was opened.
        format: what it was taken for, such as ``ROS 1 bag 2.0`` or ``EuRoC ASL folder``.
        notes: choices that the reader made and that a user should know (one sentence each).
    """

    path: Path
    format: str
    notes: tuple[str, ...] = ()

    @property
    @abc.abstractmethod
    def streams(self) -> tuple[StreamInfo, ...]:
        """All streams, readable or not, in the order of their names."""

    @property
    def cameras(self) -> dict[str, Camera]:
        """Intrinsics by the name of the image stream that they belong to."""
        return {}

    @property
    def landmarks(self) -> dict[int, Landmark]:
        """Surveyed landmarks by the number that `LandmarkSample` and `TrackSample` know them by."""
        return {}

    @property
    def damage(self) -> tuple[Damage, ...]:
        """What of the file is damaged, as far as it was read by now."""
        return ()

    @property
    def losses(self) -> tuple[Loss, ...]:
        """The damage in the form that can be counted by topic, of logs of messages."""
        return ()

    @property
    def cache_troubles(self) -> tuple[str, ...]:
        """What was wrong with the cache of indexes, one sentence each; the recording is the same without it."""
        return ()

    def extras(self) -> Extras:
        """Attachments and metadata of the log; reading them may find damage."""
        from readers.extras import Extras

        return Extras()

    @abc.abstractmethod
    def read(
        self,
        streams: Sequence[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Sample]:
        """Yield the samples of `streams` (all readable ones if None), merged by `t_ns`.

        The range ``start_ns <= t_ns < stop_ns`` is half-open and in sensor time. Memory is bounded,
        topics that were not asked for are never decoded, images are not decoded at all. A message
        that cannot be made a sample comes out as a `Problem`.

        Raises:
            StreamError: a stream is not in the recording, or is listed as not readable.
            RecordingError: nothing more of the file can be read.
        """

    def arrivals(self, streams: Sequence[str] | None = None) -> Iterator[Sample]:
        """Yield the samples in the order in which they were received, as far as the recording knows it.

        That of `read` here; a recording whose messages come late or out of order can do better.

        Raises:
            StreamError: as for `read`.
        """
        return self.read(streams)

    def array(self, stream: str, start_ns: int | None = None, stop_ns: int | None = None) -> NDArray[np.void]:
        """The samples of a stream as one structured array, a row for each, in the order of `read`.

        Its columns are those of `readers.sample_arrays`: times in ns, and the fields of the samples with their units in
        their names. A message that cannot be made a sample has a row with ``readable`` False and NaN. The array is as
        large as what was asked for; `arrays` gives the same rows piece by piece.

        Args:
            stream: one of numbers: IMU, odometry, poses, ranges, GNSS, scalars.
            start_ns: first `t_ns`, None from the begin.
            stop_ns: end of the half-open range, None to the end.

        Raises:
            StreamError: as for `read`; or the samples are no rows of numbers, or a time does not fit into 64 bits.
        """
        from readers.sample_arrays import joined, row_type

        columns = row_type(self.stream(stream))
        return joined(self.arrays(stream, start_ns, stop_ns), columns)

    def arrays(
        self, stream: str, start_ns: int | None = None, stop_ns: int | None = None, *, rows: int = 1 << 12
    ) -> Iterator[NDArray[np.void]]:
        """The same rows as `array`, in pieces of about `rows` of them, so that memory is bounded.

        Raises:
            StreamError: as for `array`.
        """
        from readers.sample_arrays import arrays_of, row_type

        columns = row_type(self.stream(stream))
        return arrays_of(self.read([stream], start_ns, stop_ns), columns, rows)

    @property
    def identity(self) -> str:
        """What makes a recording without a file the one that it is; empty where the file itself does."""
        return ""

    def count_before(self, stream: str, t_ns: int) -> int:
        """How many samples of `stream` lie before `t_ns`: the number of the first frame of a window.

        Reads that part of the stream without decoding it; a reader that has an index can do better.
        """
        return sum(1 for _ in self.read([stream], None, t_ns))

    def close(self) -> None:  # noqa: B027 (most recordings hold nothing open)
        """Release the file; reading after this is an error."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def stream(self, name: str) -> StreamInfo:
        """The stream of that name.

        Raises:
            StreamError: there is none; the text lists the names that there are.
        """
        for info in self.streams:
            if info.name == name:
                return info
        known = ", ".join(s.name for s in self.streams) or "none"
        raise StreamError(f"{self.path}: no stream named {name!r}; the streams are: {known}")

    def of_kind(self, kind: StreamKind) -> tuple[StreamInfo, ...]:
        """The readable streams of that kind that hold at least one message."""
        return tuple(s for s in self.streams if s.kind is kind and s.readable and s.count != 0)


def array(*values: Any) -> FloatArray:
    """A read-only float64 array of the given numbers."""
    a = np.array(values, dtype=np.float64)
    a.setflags(write=False)
    return a


UNKNOWN_QUAT = array(*[np.nan] * 4)
LATEST_NS = 2**63 - 1
"""The last moment that a sample can have; MCAP knows later ones, which are taken for it."""
UNKNOWN_VEC3 = array(*[np.nan] * 3)
UNKNOWN_COV6 = array(*[[np.nan] * 6] * 6)
UNKNOWN_COV3 = array(*[[np.nan] * 3] * 3)
