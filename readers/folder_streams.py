"""A recording made of files in a folder: tables of times in memory, images read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from readers import clock
from readers.folder_tables import Table
from readers.images import image_header
from readers.streams import (
    UNKNOWN_COV3,
    UNKNOWN_COV6,
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    Camera,
    Damage,
    FloatArray,
    GnssSample,
    ImageError,
    ImageSample,
    ImuSample,
    Landmark,
    LandmarkSample,
    OdometrySample,
    PoseSample,
    Problem,
    RangeSample,
    Recording,
    Sample,
    ScalarSample,
    StreamError,
    StreamInfo,
    StreamKind,
    TextSample,
    TrackSample,
)

Times = NDArray[np.int64]
Longs = NDArray[np.int64]
HEAD_BYTES = 4096
LONG_HEAD_BYTES = 1 << 20
NORM_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class FolderStream:
    """One stream: its facts, its times in ascending order, and how to make its samples by index."""

    info: StreamInfo
    times_ns: Times
    make: Callable[[int], Sample]

    def read(self, start_ns: int | None, stop_ns: int | None) -> Iterator[Sample]:
        """The samples of the half-open range."""
        first = 0 if start_ns is None else int(np.searchsorted(self.times_ns, start_ns))
        stop = len(self.times_ns) if stop_ns is None else int(np.searchsorted(self.times_ns, stop_ns))
        return (self.make(index) for index in range(first, stop))


class FolderRecording(Recording):
    """Streams whose times are known; images stay in their files until they are decoded."""

    def __init__(
        self,
        path: Path,
        form: str,
        streams: Sequence[FolderStream],
        *,
        cameras: Mapping[str, Camera],
        landmarks: Mapping[int, Landmark],
        damage: Sequence[Damage],
        notes: Sequence[str],
    ) -> None:
        self.path, self.format, self.notes = path, form, tuple(notes)
        self._streams = {s.info.name: s for s in sorted(streams, key=lambda s: s.info.name)}
        self._cameras, self._landmarks, self._damage = dict(cameras), dict(landmarks), tuple(damage)

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """See `Recording.streams`."""
        return tuple(stream.info for stream in self._streams.values())

    @property
    def cameras(self) -> dict[str, Camera]:
        """See `Recording.cameras`."""
        return dict(self._cameras)

    @property
    def landmarks(self) -> dict[int, Landmark]:
        """See `Recording.landmarks`."""
        return dict(self._landmarks)

    @property
    def damage(self) -> tuple[Damage, ...]:
        """Rows and files that could not be used when the folder was opened."""
        return self._damage

    def read(
        self,
        streams: Sequence[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Sample]:
        """See `Recording.read`."""
        wanted = [self.stream(name).name for name in (self._streams if streams is None else dict.fromkeys(streams))]
        return clock.merge(*(self._streams[name].read(start_ns, stop_ns) for name in wanted))

    def count_before(self, stream: str, t_ns: int) -> int:
        """See `Recording.count_before`; by the times, without opening a file."""
        return int(np.searchsorted(self._streams[self.stream(stream).name].times_ns, t_ns))


@dataclass(slots=True)
class Draft:
    """A recording while its layout is being read; every method adds one thing."""

    path: Path
    form: str
    streams: list[FolderStream] = field(default_factory=list)
    cameras: dict[str, Camera] = field(default_factory=dict)
    landmarks: dict[int, Landmark] = field(default_factory=dict)
    damage: list[Damage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    used_rate: bool = False
    used_times_file: bool = False

    def recording(self) -> FolderRecording:
        """The recording as it was drafted."""
        return FolderRecording(
            self.path,
            self.form,
            self.streams,
            cameras=self.cameras,
            landmarks=self.landmarks,
            damage=self.damage,
            notes=self.notes,
        )

    def note(self, sentence: str) -> None:
        """Add a choice or an oddity that the user should know."""
        self.notes.append(sentence)

    def bad_rows(self, table: Table) -> None:
        """Take over what a table could not read."""
        self.damage += [damage for damage in table.damage(self.path) if damage not in self.damage]

    def images(self, name: str, files: Sequence[Path], times_ns: Sequence[int] | Times, kind: str) -> None:
        """Add an image stream: one file per time."""
        order, times = self._ordered(name, times_ns)
        frames = [files[i] for i in order]

        def make(index: int) -> Sample:
            return image_sample(name, int(times[index]), frames[index], self.path)

        self._add(name, StreamKind.IMAGE, kind, times, make)

    def poses(
        self,
        name: str,
        times_ns: Sequence[int] | Times,
        position_m: FloatArray,
        quat_xyzw: FloatArray,
        kind: str,
        *,
        parent: str = "world",
        child: str = "body",
    ) -> None:
        """Add a pose stream from positions [n, 3] and quaternions [n, 4], which are brought to unit norm."""
        order, times = self._ordered(name, times_ns)
        norm = np.linalg.norm(quat_xyzw, axis=1, keepdims=True)
        odd = int(np.sum((np.abs(norm - 1) > NORM_TOLERANCE) & (norm > 0)))
        if odd:
            self.note(f"{name}: {odd} quaternions are off unit norm by more than 1 % and were normalised")
        unit = np.divide(quat_xyzw, norm, out=np.array(quat_xyzw), where=norm > 0)
        positions, quats = _frozen(position_m[order]), _frozen(unit[order])

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            return PoseSample(
                stream=name,
                t_ns=t_ns,
                received_ns=t_ns,
                position_m=positions[index],
                quat_xyzw=quats[index],
                covariance=UNKNOWN_COV6,
                parent_frame=parent,
                child_frame=child,
            )

        self._add(name, StreamKind.POSE, kind, times, make, frame=child)

    def imu(self, name: str, times_ns: Times, values: FloatArray, kind: str) -> None:
        """Add inertial measurements: angular velocity and specific force, values [n, 6] in rad/s and m/s²."""
        order, times = self._ordered(name, times_ns)
        rows = _frozen(values[order])

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            return ImuSample(
                stream=name,
                t_ns=t_ns,
                received_ns=t_ns,
                angular_velocity_radps=rows[index, :3],
                linear_acceleration_mps2=rows[index, 3:],
                quat_xyzw=UNKNOWN_QUAT,
            )

        self._add(name, StreamKind.IMU, kind, times, make)

    def odometry(self, name: str, times_ns: Times, values: FloatArray, kind: str) -> None:
        """Add body velocities: linear in m/s and angular in rad/s, values [n, 6], in the body's axes."""
        order, times = self._ordered(name, times_ns)
        rows = _frozen(values[order])

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            return OdometrySample(
                stream=name,
                t_ns=t_ns,
                received_ns=t_ns,
                linear_velocity_mps=rows[index, :3],
                angular_velocity_radps=rows[index, 3:],
                position_m=UNKNOWN_VEC3,
                quat_xyzw=UNKNOWN_QUAT,
            )

        self._add(name, StreamKind.ODOMETRY, kind, times, make)

    def tracks(self, name: str, times_ns: Times, points: Sequence[tuple[Longs, FloatArray]], kind: str) -> None:
        """Add pixel tracks: of every time the ids [N] and the points (u, v) [N, 2] in px."""
        order, times = self._ordered(name, times_ns)

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            ids, pixels = points[order[index]]
            return TrackSample(stream=name, t_ns=t_ns, received_ns=t_ns, ids=ids, points_px=pixels)

        self._add(name, StreamKind.TRACK, kind, times, make)

    def sightings(self, name: str, times_ns: Times, ids: Longs, values: FloatArray, kind: str) -> None:
        """Add measured landmarks: ids [n], range (m) and bearing (rad) [n, 2]; equal times are one sample."""
        order, times = self._ordered(name, times_ns)
        moments, starts = np.unique(times, return_index=True)
        rows = np.split(order, starts[1:])

        def make(index: int) -> Sample:
            t_ns, chosen = int(moments[index]), rows[index]
            return LandmarkSample(
                stream=name,
                t_ns=t_ns,
                received_ns=t_ns,
                ids=ids[chosen],
                range_m=values[chosen, 0],
                bearing_rad=values[chosen, 1],
            )

        self._add(name, StreamKind.LANDMARKS, kind, moments, make)

    def gnss(self, name: str, times_ns: Sequence[int] | Times, values: FloatArray, kind: str) -> None:
        """Add fixes: latitude and longitude in rad, altitude in m, values [n, 3]."""
        order, times = self._ordered(name, times_ns)
        rows = values[order]

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            latitude, longitude, altitude = (float(value) for value in rows[index])
            return GnssSample(
                stream=name,
                t_ns=t_ns,
                received_ns=t_ns,
                latitude_rad=latitude,
                longitude_rad=longitude,
                altitude_m=altitude,
                covariance_m2=UNKNOWN_COV3,
            )

        self._add(name, StreamKind.GNSS, kind, times, make)

    def ranges(self, name: str, times_ns: Times, range_m: FloatArray, kind: str) -> None:
        """Add distances in m, [n]."""
        order, times = self._ordered(name, times_ns)
        rows = range_m[order]
        nan = float("nan")

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            return RangeSample(
                stream=name,
                t_ns=t_ns,
                received_ns=t_ns,
                range_m=float(rows[index]),
                min_range_m=nan,
                max_range_m=nan,
                field_of_view_rad=nan,
            )

        self._add(name, StreamKind.RANGE, kind, times, make)

    def scalars(self, name: str, times_ns: Times, values: FloatArray, kind: str) -> None:
        """Add plain numbers, [n]."""
        order, times = self._ordered(name, times_ns)
        rows = values[order]

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            return ScalarSample(stream=name, t_ns=t_ns, received_ns=t_ns, value=float(rows[index]))

        self._add(name, StreamKind.SCALAR, kind, times, make)

    def texts(self, name: str, times_ns: Sequence[int] | Times, texts: Sequence[str], kind: str) -> None:
        """Add pieces of text, [n]."""
        order, times = self._ordered(name, times_ns)
        rows = [texts[i] for i in order]

        def make(index: int) -> Sample:
            t_ns = int(times[index])
            return TextSample(stream=name, t_ns=t_ns, received_ns=t_ns, text=rows[index])

        self._add(name, StreamKind.TEXT, kind, times, make)

    def free_name(self, name: str) -> str:
        """That name, with underscores behind it if a stream has it already."""
        while any(stream.info.name == name for stream in self.streams):
            name += "_"
        return name

    def _ordered(self, name: str, times_ns: Sequence[int] | Times) -> tuple[NDArray[np.intp], Times]:
        """The order by time (stable) and the times in it; disorder is noted."""
        times = np.asarray(times_ns, np.int64)
        backwards = int(np.sum(np.diff(times) < 0))
        if backwards:
            self.note(f"{name}: {backwards} times lie before the one in the row above; the stream is sorted by time")
        order = np.argsort(times, kind="stable")
        return order, times[order]

    def _add(
        self, name: str, kind: StreamKind, type_name: str, times: Times, make: Callable[[int], Sample], frame: str = ""
    ) -> None:
        if any(s.info.name == name for s in self.streams):
            raise StreamError(f"{self.path}: two streams are named {name!r}")
        first, last = (int(times[0]), int(times[-1])) if len(times) else (-1, -1)
        info = StreamInfo(
            name=name, kind=kind, type=type_name, count=len(times), first_ns=first, last_ns=last, frame=frame
        )
        self.streams.append(FolderStream(info, times, make))


def image_sample(stream: str, t_ns: int, file: Path, root: Path) -> Sample:
    """The image in that file, or a `Problem` if the file is missing, empty or no image."""
    source = str(file.relative_to(root)) if file.is_relative_to(root) else str(file)
    try:
        encoding, width, height = file_header(file)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return Problem(
            stream=stream, t_ns=t_ns, received_ns=t_ns, kind=StreamKind.IMAGE, reason=f"{source!r}: {reason}"
        )
    return ImageSample(
        stream=stream,
        t_ns=t_ns,
        received_ns=t_ns,
        encoding=encoding,
        payload=partial(_load, file, stream),
        width_px=width,
        height_px=height,
        source=source,
    )


def file_header(file: Path) -> tuple[str, int, int]:
    """Format, width and height of an image file by its first bytes (0, 0 where they do not tell).

    Raises:
        OSError: the file is missing or cannot be read.
        ValueError: it is not a regular file, is empty, or does not begin like an image.
    """
    if file.exists() and not file.is_file():
        raise ValueError("not a regular file")
    with file.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
        header = image_header(head)
        if header[0] == "jpeg" and header[1] == 0:
            header = image_header(head + stream.read(LONG_HEAD_BYTES))
    if not head:
        raise ValueError("the file is empty")
    if not header[0]:
        raise ValueError("the file does not begin like an image")
    return header


def _frozen(values: FloatArray) -> FloatArray:
    values.setflags(write=False)
    return values


def _load(file: Path, stream: str) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ImageError(f"{stream} ({file}): the image file cannot be read ({error.strerror})") from None
