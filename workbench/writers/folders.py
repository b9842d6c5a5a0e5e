"""Folders of images with tables beside them: EuRoC's layout, and that of paper A's data set.

A folder knows sensor time only: rows and frames come in its order, and when they were received is not kept. The list
of a simulated mission's faults lies at the folder's top.
"""

from __future__ import annotations

import abc
import json
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from readers.folder_layouts import FAULTS_FILE, FAULTS_STREAM, UE4_FROM_ENU
from readers.streams import (
    Camera,
    FloatArray,
    ImageError,
    ImageSample,
    ImuSample,
    OdometrySample,
    PoseSample,
    RangeSample,
    Sample,
    ScalarSample,
    StreamError,
    StreamInfo,
    StreamKind,
    TextSample,
)
from workbench.writers.target import Order, Target, first_missing

Longs = NDArray[np.int64]
SUFFIXES = {
    "jpeg": ".jpg",
    "png": ".png",
    "tiff": ".tiff",
    "bmp": ".bmp",
    "webp": ".webp",
    "pnm": ".pnm",
    "jp2": ".jp2",
}
CM_PER_M, KMH_PER_MPS = 100.0, 3.6
_TRUTH_NAMES = ("truth", "reference")


class FolderTarget(Target):
    """A folder, made with those above it."""

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._root = first_missing(self.path)
        self._made = False
        self._put: dict[str, Callable[[Any], None]] = {}

    def open(self) -> None:
        """Make the folder, and choose what of the recording it can hold."""
        self.path.mkdir(parents=True)
        self._made = True
        self.choose([info for info in self.order.infos if info.count != 0])

    @abc.abstractmethod
    def choose(self, infos: Sequence[StreamInfo]) -> None:
        """Fill in what is done with the samples of each stream, and name those that are left out."""

    def samples(self) -> Iterator[Sample]:
        """The samples of the chosen streams in the order of their stamps."""
        return self.order.recording.read(list(self._put)) if self._put else iter(())

    def put(self, sample: Sample) -> None:
        """Write one sample, or keep it for the table."""
        self._put[sample.stream](sample)

    def discard(self) -> None:
        """Remove the folder, and those above it that were made for it."""
        if self._made:
            shutil.rmtree(self._root, ignore_errors=True)

    def _put_faults(self, sample: TextSample) -> None:
        if self.messages[FAULTS_FILE]:
            self.skip(sample.stream, f"{FAULTS_FILE} holds one text")
            return
        (self.path / FAULTS_FILE).write_text(sample.text, encoding="utf-8", newline="")
        self.messages[FAULTS_FILE] += 1

    def _save(self, sample: ImageSample, path: Path) -> Path:
        """Write an image; returns the path with the suffix of its format."""
        coding = self.order.coding
        if sample.step_bytes and coding.format == "stored":
            coding = type(coding)("png")
        image = coding.encoded(sample)
        suffix = SUFFIXES.get(image.encoding)
        if suffix is None:
            raise ImageError(
                f"{sample.source or sample.stream}: no image file is {image.encoding}; write it into a log"
            )
        path = path.with_name(path.name + suffix)
        path.write_bytes(image.data)
        return path


def truest(infos: Sequence[StreamInfo]) -> list[StreamInfo]:
    """Of several streams those whose names say that they are the truth, or else a reference; else all."""
    found = list(infos)
    for word in _TRUTH_NAMES:
        if len(found) > 1 and (named := [info for info in found if word in info.name.lower()]):
            found = named
    return found


# ------------------------------------------------------------------------------------ EuRoC

_EUROC_CAMERAS = {"plumb_bob": "radial-tangential"}
_EUROC_HEADERS = {
    StreamKind.IMAGE: "#timestamp [ns],filename",
    StreamKind.IMU: "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]",
    StreamKind.POSE: "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
}
_EUROC_FOLDERS = {StreamKind.IMAGE: "cam", StreamKind.IMU: "imu", StreamKind.POSE: "pose"}
_EUROC_TRUTH = "state_groundtruth_estimate"


class EurocFolder(FolderTarget):
    """EuRoC's ASL layout: mav0/cam0 …, imu0 …, state_groundtruth_estimate0, and pose0 … for other poses."""

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._tables: dict[str, TextIO] = {}
        self._folders: dict[str, Path] = {}
        self._stamps: Counter[tuple[str, int]] = Counter()

    def choose(self, infos: Sequence[StreamInfo]) -> None:
        """Images, IMUs and poses each get a folder; other kinds are left out."""
        actions: dict[StreamKind, Callable[[Any], None]] = {
            StreamKind.IMAGE: self._put_image,
            StreamKind.IMU: self._put_imu,
            StreamKind.POSE: self._put_pose,
        }
        numbers: Counter[str] = Counter()
        truth = truest([info for info in infos if info.kind is StreamKind.POSE])
        for info in infos:
            if info.name == FAULTS_STREAM and info.kind is StreamKind.TEXT:
                self._put[info.name] = self._put_faults
            elif info.kind in actions:
                self._put[info.name] = actions[info.kind]
                begin = _EUROC_TRUTH if [info] == truth else _EUROC_FOLDERS[info.kind]
                self._make(info, f"{begin}{numbers[begin]}")
                numbers[begin] += 1
            elif info.kind is StreamKind.CAMERA:
                self.leave_out(info.name, "an EuRoC folder has one calibration a camera, in its sensor.yaml")
            else:
                self.leave_out(info.name, f"an EuRoC folder has no place for {info.kind} streams")

    def _make(self, info: StreamInfo, name: str) -> None:
        folder = self.path / "mav0" / name
        (folder / "data" if info.kind is StreamKind.IMAGE else folder).mkdir(parents=True)
        self._folders[info.name] = folder
        self._tables[info.name] = (folder / "data.csv").open("w", encoding="utf-8", newline="\n")
        self._tables[info.name].write(_EUROC_HEADERS[info.kind] + "\n")
        if info.kind is StreamKind.POSE:
            return
        lines = [f"sensor_type: {'camera' if info.kind is StreamKind.IMAGE else 'imu'}"]
        lines.append(f"comment: {json.dumps(info.name)}")
        if math.isfinite(info.rate_hz):
            lines.append(f"rate_hz: {info.rate_hz!r}")
        if info.kind is StreamKind.IMAGE:
            lines += self._mounting(info.name) + self._calibration(info.name)
        (folder / "sensor.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")

    def _mounting(self, stream: str) -> list[str]:
        """The lines of sensor.yaml on the transform from camera to body; none where it is not known."""
        camera = self.order.recording.cameras.get(stream)
        if camera is None or not np.all(np.isfinite(camera.body_t_camera)):
            return []
        return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: {_numbers(*camera.body_t_camera.ravel())}"]

    def _calibration(self, stream: str) -> list[str]:
        """The lines of sensor.yaml on the intrinsics; none where they are not known or no plain pinhole's."""
        camera = self.order.recording.cameras.get(stream)
        if camera is None or not camera.calibrated:
            self.leave_out(stream, "its sensor.yaml has no intrinsics, since the recording has none")
            return []
        if camera.matrix[0, 1]:
            self.leave_out(stream, "its sensor.yaml has no intrinsics, since it has no place for a skew")
            return []
        k = camera.matrix
        return [
            f"resolution: [{camera.width_px}, {camera.height_px}]",
            "camera_model: pinhole",
            f"intrinsics: {_numbers(k[0, 0], k[1, 1], k[0, 2], k[1, 2])}",
            f"distortion_model: {_EUROC_CAMERAS.get(camera.distortion_model, camera.distortion_model)}",
            f"distortion_coefficients: {_numbers(*_coefficients(camera))}",
        ]

    def _row(self, sample: Sample, *cells: Any) -> None:
        self._tables[sample.stream].write(",".join([str(sample.t_ns), *map(str, cells)]) + "\n")
        self.messages[self._folders[sample.stream].name] += 1

    def _put_image(self, sample: ImageSample) -> None:
        again = self._stamps[sample.stream, sample.t_ns]
        self._stamps[sample.stream, sample.t_ns] += 1
        name = f"{sample.t_ns}_{again}" if again else str(sample.t_ns)
        self._row(sample, self._save(sample, self._folders[sample.stream] / "data" / name).name)

    def _put_imu(self, sample: ImuSample) -> None:
        if not np.all(np.isnan(sample.quat_xyzw)):
            self.leave_out(sample.stream, "its orientation, for which an EuRoC folder has no columns")
        values = [*sample.angular_velocity_radps.tolist(), *sample.linear_acceleration_mps2.tolist()]
        self._finite_row(sample, values)

    def _put_pose(self, sample: PoseSample) -> None:
        if not np.all(np.isnan(sample.covariance)):
            self.leave_out(sample.stream, "its covariance, for which an EuRoC folder has no columns")
        x, y, z, w = sample.quat_xyzw.tolist()
        self._finite_row(sample, [*sample.position_m.tolist(), w, x, y, z])

    def _finite_row(self, sample: Sample, values: Sequence[float]) -> None:
        if all(map(math.isfinite, values)):
            self._row(sample, *map(repr, values))
        else:
            self.skip(sample.stream, "a number of it is not known or not finite, and a table has to have all")

    def close(self) -> None:
        """Finish the tables."""
        for table in self._tables.values():
            table.close()

    def discard(self) -> None:
        """Remove the folder."""
        self.close()
        super().discard()


def _coefficients(camera: Camera) -> list[float]:
    """The distortion; of radial-tangential k1, k2, p1, p2, and k3 only where it is not zero."""
    values: list[float] = camera.distortion.tolist()
    return values[:4] if camera.distortion_model == "plumb_bob" and not any(values[4:]) else values


def _numbers(*values: float) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


# ---------------------------------------------------------------------------------- paper A

TABLE = "file.csv"
_PAPER_HEADER = ("time [s]", "x [cm]", "y [cm]", "z [cm]", "roll [deg]", "pitch [deg]", "yaw [deg]")
_DISTANCE, _SPEED = "distance to the surface [cm]", "speed [km/h]"
_SPEED_KINDS = (StreamKind.ODOMETRY, StreamKind.SCALAR)


class PaperFolder(FolderTarget):
    """The leaf folder of paper A's data set, ``SURFACE/TRAJECTORY/MATERIAL/speed_N``: img_001.png …, file.csv.

    A row is a frame. Where pose, distance or speed were measured at other times, they are interpolated to the
    frame's (rotations along the shortest way), never beyond their ends: a frame outside of them is left out.
    Axes are UE4's, as `readers.folder_layouts.surface_set` reads them.
    """

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._images = ""
        self._frames: list[tuple[int, Path]] = []
        self._series: dict[str, _Series] = {}
        self._columns: dict[str, str] = {}

    def choose(self, infos: Sequence[StreamInfo]) -> None:
        """One stream of images and one of poses, at most one of distances and one of speeds."""
        images = self._choose(infos, "images", (StreamKind.IMAGE,))
        pose = self._choose(infos, "pose", (StreamKind.POSE,))
        if images is None or pose is None:
            lacking = "images" if images is None else "reference poses"
            raise StreamError(
                f"{self.order.recording.path}: no {lacking} to write; paper A's folder is made of frames with their "
                "poses; choose another container"
            )
        self._images = images.name
        self._put[images.name] = self._put_image
        speeds = [i for i in infos if i.kind is StreamKind.ODOMETRY or "speed" in i.name.lower()]
        chosen = {
            "pose": pose,
            "distance": self._choose(infos, "distance", (StreamKind.RANGE,)),
            "speed": self._choose(speeds, "speed", _SPEED_KINDS),
        }
        for column, info in chosen.items():
            if info is not None:
                self._columns[column] = info.name
                self._series[info.name] = _Series()
                self._put[info.name] = self._put_number
        for info in infos:
            if info.name == FAULTS_STREAM and info.kind is StreamKind.TEXT:
                self._put[info.name] = self._put_faults
            elif info.name not in self._put:
                self.leave_out(info.name, _no_place(info.kind))

    def _choose(self, infos: Sequence[StreamInfo], what: str, kinds: Sequence[StreamKind]) -> StreamInfo | None:
        """The only stream of these kinds, or the only one whose name says that it is the truth."""
        found = truest([info for info in infos if info.kind in kinds])
        if len(found) > 1:
            raise StreamError(
                f"{self.order.recording.path}: paper A's folder holds one stream of {what} and these could be it: "
                f"{', '.join(info.name for info in found)}; name the streams to write"
            )
        return found[0] if found else None

    def _put_image(self, sample: ImageSample) -> None:
        file = self._save(sample, self.path / _frame_name(len(self._frames)))
        self._frames.append((sample.t_ns, file))

    def _put_number(self, sample: Sample) -> None:
        values, lost = _values(sample)
        if lost:
            self.leave_out(sample.stream, lost)
        if not self._series[sample.stream].add(sample.t_ns, values):
            self.skip(sample.stream, "a number of it is not known or not finite, and the table has to have all")

    def close(self) -> None:
        """Write the table; frames without a row are removed and the others numbered anew.

        Raises:
            StreamError: no frame has a pose.
        """
        times = np.array([t_ns for t_ns, _ in self._frames], np.int64)
        used = np.ones(len(times), bool)
        for series in self._series.values():
            used &= series.covers(times)
        if not used.any():
            raise StreamError(f"{self.order.recording.path}: no frame has a pose at its time; choose another container")
        self._keep_frames(used)
        self._write_table(times[used])

    def _keep_frames(self, used: NDArray[np.bool_]) -> None:
        kept = 0
        for (_, file), wanted in zip(self._frames, used.tolist(), strict=True):
            if not wanted:
                file.unlink()
                self.skip(self._images, "outside of the times of pose, distance or speed")
                continue
            file.rename(file.with_name(_frame_name(kept) + file.suffix))
            kept += 1
        self.messages["images"] = kept

    def _write_table(self, times: Longs) -> None:
        pose = self._series[self._columns["pose"]]
        header, columns = list(_PAPER_HEADER), [pose.positions(times) @ UE4_FROM_ENU * CM_PER_M]
        columns.append(ue4_angles_deg(pose.rotations(times)))
        for column, title, factor in (("distance", _DISTANCE, CM_PER_M), ("speed", _SPEED, KMH_PER_MPS)):
            if column in self._columns:
                header.append(title)
                columns.append(self._series[self._columns[column]].positions(times) * factor)
            else:
                self.leave_out(f"column {column}", "no stream of the recording gives it")
        lines = [",".join(header)]
        for t_ns, row in zip(times.tolist(), np.column_stack(columns).tolist(), strict=True):
            lines.append(",".join([_seconds(t_ns), *map(repr, row)]))
        (self.path / TABLE).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
        self.messages[TABLE] = len(times)
        for name, series in self._series.items():
            for sentence in series.remarks(times):
                self.leave_out(name, sentence)


class _Series:
    """Numbers of one stream by time: a pose (position, quaternion) or one number, [n, 7] or [n, 1]."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._values: list[list[float]] = []

    def add(self, t_ns: int, values: list[float]) -> bool:
        """Take one measurement; False if a number of it is not finite."""
        if not all(map(math.isfinite, values)):
            return False
        self._times.append(t_ns)
        self._values.append(values)
        return True

    def covers(self, times: Longs) -> NDArray[np.bool_]:
        """Which of the times lie between the first and the last measurement."""
        if not self._times:
            return np.zeros(len(times), bool)
        return (times >= min(self._times)) & (times <= max(self._times))

    def positions(self, times: Longs) -> FloatArray:
        """Linear interpolation of the position or the number, [m, 3] or [m, 1]."""
        values, before, after, weight = self._around(times)
        width = 3 if values.shape[1] == 7 else 1
        left, right = values[before, :width], values[after, :width]
        return left + weight[:, None] * (right - left)

    def rotations(self, times: Longs) -> Rotation:
        """Interpolation along the shortest rotation, R0 exp(w log(R0ᵀ R1))."""
        values, before, after, weight = self._around(times)
        left, right = Rotation.from_quat(values[before, 3:]), Rotation.from_quat(values[after, 3:])
        return left * Rotation.from_rotvec((left.inv() * right).as_rotvec() * weight[:, None])

    def remarks(self, times: Longs) -> Iterator[str]:
        """What of the measurements is not in the table as it was."""
        own, frames = set(self._times), set(times.tolist())
        if between := len(own - frames):
            yield f"{between} of its messages are at no frame's time"
        if interpolated := len(frames - own):
            yield f"it is interpolated at {interpolated} frames"

    def _around(self, times: Longs) -> tuple[FloatArray, Longs, Longs, FloatArray]:
        """Values in the order of time, and for each time the indices of its neighbours and the weight of the later."""
        order = np.argsort(self._times, kind="stable")
        own, values = np.array(self._times, np.int64)[order], np.array(self._values)[order]
        before = np.searchsorted(own, times, side="right") - 1
        after = np.minimum(before + 1, len(own) - 1)
        span = np.maximum(own[after] - own[before], 1)
        return values, before, after, (times - own[before]) / span


def ue4_angles_deg(rotations: Rotation) -> FloatArray:
    """UE4's roll, pitch, yaw in degrees [n, 3] of `world_T_body`; the inverse of `readers`' `ue4_rotations`."""
    angles: FloatArray = rotations.as_euler("ZYX", degrees=True)[:, ::-1] * [1.0, -1.0, -1.0]
    return angles


def _values(sample: Sample) -> tuple[list[float], str]:
    """The numbers of a sample that the table is made of, and what is lost of it, if anything."""
    match sample:
        case PoseSample():
            lost = "" if np.all(np.isnan(sample.covariance)) else "its covariance"
            return [*sample.position_m.tolist(), *sample.quat_xyzw.tolist()], lost
        case RangeSample():
            return [sample.range_m], "its limits and field of view"
        case OdometrySample():
            return [float(np.linalg.norm(sample.linear_velocity_mps))], "everything but its speed"
        case ScalarSample():
            return [sample.value], ""
    raise StreamError(f"{sample.stream}: a {type(sample).__name__} is no column of paper A's table")


def _no_place(kind: StreamKind) -> str:
    if kind is StreamKind.CAMERA:
        return "paper A's folder has no place for a calibration"
    one = {StreamKind.IMAGE, StreamKind.POSE, StreamKind.RANGE, StreamKind.ODOMETRY}
    return f"paper A's folder has no place for {'a second' if kind in one else 'a'} {kind} stream"


def _frame_name(index: int) -> str:
    return f"img_{index + 1:03d}"


def _seconds(t_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    sign, (seconds, nanoseconds) = "-" * (t_ns < 0), divmod(abs(t_ns), 1_000_000_000)
    return f"{sign}{seconds}.{nanoseconds:09d}"
