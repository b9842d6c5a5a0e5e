"""Cameras from calibration files: ROS camera_info, Kalibr camchain and OpenCV FileStorage, all of them YAML.

A file may hold several cameras. Kalibr's are named ``cam0``, ``cam1``, … and know their topics; a stereo pair of OpenCV
(``M1``, ``D1``, ``M2``, ``D2``) is ``1`` and ``2``; a single camera has the name that the file gives it.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from readers.streams import Camera, FloatArray, RecordingError, array

CURE = "give the YAML of ROS's camera_info, of Kalibr's camchain, or of OpenCV's FileStorage"
LARGEST_BYTES = 1 << 20
LARGEST_PX = 1 << 16
ASPECT_AGREES = 0.01
MODELS = {
    "radtan": ("plumb_bob", (4, 5)),
    "plumb_bob": ("plumb_bob", (4, 5)),
    "rational_polynomial": ("rational_polynomial", (8,)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "none": ("none", (0,)),
}
"""Distortion models by the names that files give them: ours, and how many coefficients they have."""
_MATRIX_NAMES = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "CameraMatrix", "K", "M", "intrinsic_matrix")
_LENS_NAMES = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")


class _FileError(Exception):
    """A file that holds no camera; the text is a clause that says why."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """One camera of a file: its name there, the topic that it names (or ""), and what is to be said of it."""

    name: str
    topic: str
    camera: Camera
    notes: tuple[str, ...] = ()


def read_camera(file: Path, *, name: str = "", topic: str = "") -> Calibration:
    """One camera of a file.

    Args:
        file: the YAML file.
        name: which camera, by its name or topic in the file; empty for the only one or that of `topic`.
        topic: the stream of images that it is for.

    Raises:
        RecordingError: the file cannot be read, is none of the three kinds, or it is not clear which camera is meant.
    """
    found = read_cameras(file)
    names = ", ".join(c.name + (f" ({c.topic})" if c.topic else "") for c in found)
    if name:
        wanted = [c for c in found if name in (c.name, c.topic, c.camera.frame)]
        if len(wanted) == 1:
            return wanted[0]
        raise RecordingError(file, f"it has no camera {name!r}", f"its cameras are: {names}")
    if len(found) == 1:
        return found[0]
    wanted = [c for c in found if c.topic and plain_topic(c.topic) == plain_topic(topic)]
    if len(wanted) == 1:
        return wanted[0]
    raise RecordingError(file, f"it has several cameras: {names}", f"name one, such as {file.name}#{found[0].name}")


def read_cameras(file: Path) -> list[Calibration]:
    """All cameras of a file.

    Raises:
        RecordingError: it cannot be read, or is none of the three kinds.
    """
    try:
        values = _parsed(file)
        chain = {
            key: part for key, part in values.items() if re.fullmatch(r"cam\d+", key) and isinstance(part, Mapping)
        }
        if chain:
            return [_of_kalibr(file, key, part) for key, part in chain.items()]
        if "M1" in values or "K1" in values:
            return [_of_stereo(file, values, k) for k in ("1", "2") if f"M{k}" in values or f"K{k}" in values]
        return [_of_ros(file, values)]
    except _FileError as error:
        raise RecordingError(file, str(error), CURE) from error


def scaled(camera: Camera, width_px: int, height_px: int) -> Camera:
    """The same lens with images of another size, as if they had been resized: K and P by the ratio of the sizes.

    The centre of the first pixel is (0, 0): u + 1/2 grows by the ratio.

    Raises:
        ValueError: the size of the calibration is not known, or has another ratio of its sides.
    """
    if not (camera.width_px and camera.height_px):
        raise ValueError("the calibration does not say for which size it is")
    across, down = width_px / camera.width_px, height_px / camera.height_px
    if abs(across / down - 1) > ASPECT_AGREES:
        raise ValueError(
            f"the calibration is for {camera.width_px} x {camera.height_px} px and the images of {width_px} x "
            f"{height_px} px have another ratio of sides: they were cropped, not scaled"
        )
    change = array([across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1])
    return dataclasses.replace(
        camera,
        width_px=width_px,
        height_px=height_px,
        matrix=_frozen(change @ camera.matrix),
        projection=_frozen(change @ camera.projection),
        source=f"{camera.source or 'the log'}, scaled to the images",
    )


# ---------------------------------------------------------------------------------- parsing


def _parsed(file: Path) -> dict[str, Any]:
    """The top of a YAML file as a mapping of texts."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        if file.stat().st_size > LARGEST_BYTES:
            raise _FileError(f"it has {file.stat().st_size} bytes, too many for a calibration")
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise _FileError("it is no text") from error
    except OSError as error:
        raise RecordingError(
            file, f"the calibration cannot be read ({error.strerror or error})", "check the path"
        ) from error
    plain = re.sub(r"\A\ufeff?%YAML[: ][^\n]*\n", "", text)  # OpenCV writes a directive that is no YAML
    plain = re.sub(r"!!opencv-matrix\b", "", plain)
    try:
        values = YAML(typ="safe", pure=True).load(plain)
    except (YAMLError, ValueError, RecursionError) as error:
        line = (str(error).splitlines() or ["no reason given"])[0]
        raise _FileError(f"it is no YAML ({line})") from error
    if not isinstance(values, Mapping):
        raise _FileError("it holds no table of values")
    return {str(key): value for key, value in values.items()}


def _of_kalibr(file: Path, name: str, values: Mapping[str, Any]) -> Calibration:
    model = values.get("camera_model", "pinhole")
    if model != "pinhole":
        raise _FileError(f"{name} has the camera model {model!r}; only pinhole is known")
    fx, fy, cx, cy = _numbers(values, ("intrinsics",), 4)
    width, height = (_size(value) for value in _numbers(values, ("resolution",), 2))
    topic = str(values.get("rostopic") or "")
    notes, body_t_camera = [], None
    if "T_cam_imu" in values:
        body_t_camera = _inverse(_numbers(values, ("T_cam_imu",), 16).reshape(4, 4))
        notes.append(f"{file.name}#{name}: the camera's place is that of T_cam_imu, in the axes of the IMU.")
    if "timeshift_cam_imu" in values:
        shift_ms = 1e3 * float(_numbers(values, ("timeshift_cam_imu",), 1)[0])
        told = f"{file.name}#{name}: timeshift_cam_imu is {shift_ms:g} ms and is not applied by itself"
        notes.append(f"{told}; give --offset {topic or 'TOPIC'}={shift_ms:.6g}.")
    camera = _camera(
        matrix=array([fx, 0, cx], [0, fy, cy], [0, 0, 1]),
        size=(width, height),
        model=str(values.get("distortion_model", "none")),
        lens=_numbers(values, ("distortion_coeffs",), None),
        source=f"{file.name}#{name}",
    )
    if body_t_camera is not None:
        camera = dataclasses.replace(camera, body_t_camera=body_t_camera)
    return Calibration(name, topic, camera, tuple(notes))


def _of_stereo(file: Path, values: Mapping[str, Any], side: str) -> Calibration:
    camera = _camera(
        matrix=_numbers(values, (f"M{side}", f"K{side}"), 9).reshape(3, 3),
        size=_stated_size(values),
        model="",
        lens=_numbers(values, (f"D{side}",), None),
        source=f"{file.name}#{side}",
    )
    return Calibration(side, "", camera)


def _of_ros(file: Path, values: Mapping[str, Any]) -> Calibration:
    """ROS's camera_info and what OpenCV's programs write have the same form, with names of their own."""
    name = str(values.get("camera_name") or "camera")
    camera = _camera(
        matrix=_numbers(values, _MATRIX_NAMES, 9).reshape(3, 3),
        size=_stated_size(values),
        model=str(values.get("distortion_model") or values.get("camera_model") or ""),
        lens=_numbers(values, _LENS_NAMES, None),
        source=file.name,
    )
    camera = dataclasses.replace(camera, frame=str(values.get("frame_id") or ""))
    if "rectification_matrix" in values:
        turn = _numbers(values, ("rectification_matrix",), 9).reshape(3, 3)
        camera = dataclasses.replace(camera, rectification=_frozen(turn))
    if "projection_matrix" in values:
        onto = _numbers(values, ("projection_matrix",), 12).reshape(3, 4)
        camera = dataclasses.replace(camera, projection=_frozen(onto))
    return Calibration(name, "", camera)


def _camera(*, matrix: FloatArray, size: tuple[int, int], model: str, lens: FloatArray, source: str) -> Camera:
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise _FileError(f"its focal lengths are {matrix[0, 0]:g} and {matrix[1, 1]:g} px; they must be positive")
    if not np.array_equal(matrix[2], [0, 0, 1]) or matrix[1, 0] != 0:
        raise _FileError(f"its camera matrix is {matrix.tolist()}; the last row must be 0, 0, 1")
    if not model or model == "pinhole":
        model = "rational_polynomial" if lens.size == 8 else "plumb_bob" if lens.size else "none"
    if model not in MODELS:
        raise _FileError(f"the distortion model {model!r} is not known; known are {', '.join(MODELS)}")
    ours, sizes = MODELS[model]
    if lens.size not in sizes and np.any(lens):
        wanted = " or ".join(map(str, sizes))
        raise _FileError(f"the distortion model {model} takes {wanted} coefficients, not {lens.size}")
    return Camera(
        width_px=size[0],
        height_px=size[1],
        matrix=_frozen(matrix),
        distortion_model=ours if lens.size else "none",
        distortion=_frozen(lens),
        rectification=_frozen(np.eye(3)),
        projection=_frozen(np.column_stack([matrix, np.zeros(3)])),
        source=source,
    )


def _stated_size(values: Mapping[str, Any]) -> tuple[int, int]:
    """Width and height, 0 x 0 where the file does not say."""
    pairs = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))
    for width, height in pairs:
        if width in values and height in values:
            return _size(values[width]), _size(values[height])
    for name in ("image_size", "imageSize", "size"):
        if name in values:
            width, height = _numbers(values, (name,), 2)
            return _size(width), _size(height)
    return 0, 0


def _size(value: Any) -> int:
    """A number of pixels."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (0 < number <= LARGEST_PX and number == int(number)):
        raise _FileError(f"{value!r} is no size of an image in px")
    return int(number)


def _numbers(values: Mapping[str, Any], names: Sequence[str], count: int | None) -> FloatArray:
    """The numbers of the first of these names, a list or the `data` of a matrix; none may be missing or infinite.

    Where any count will do (None), a name that is missing has none.
    """
    name = next((name for name in names if name in values), "")
    if not name:
        if count is None:
            return np.zeros(0)
        raise _FileError(f"it has no {names[0]}")
    value = values[name]
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        numbers = np.array(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError) as error:
        raise _FileError(f"{name} is no list of numbers") from error
    if not np.isfinite(numbers).all():
        raise _FileError(f"{name} has numbers that are not finite")
    if count is not None and numbers.size != count:
        raise _FileError(f"{name} has {numbers.size} numbers, not {count}")
    return numbers


def _inverse(transform: FloatArray) -> FloatArray:
    """The inverse of a rigid transform [4, 4]."""
    turn = transform[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or not np.array_equal(transform[3], [0, 0, 0, 1]):
        raise _FileError("T_cam_imu is no rigid transform")
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = turn.T, -turn.T @ transform[:3, 3]
    return _frozen(inverse)


def _frozen(values: FloatArray) -> FloatArray:
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def plain_topic(topic: str) -> str:
    """A topic without a leading slash or the ending of its compressed form."""
    return topic.strip("/").removesuffix("/compressed")
