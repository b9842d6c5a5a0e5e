"""Sample → JSON message with its schema: Foxglove's types, and ROS's where Foxglove has none that holds all of it.

Stamps are {sec, nsec}, bytes are base64. JSON has no NaN and no infinity: these are the strings ``NaN``, ``Infinity``
and ``-Infinity``, as in the JSON form of protobuf; a matrix of a camera that is not known is an empty list.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from readers.images import RAW_FORMATS
from readers.streams import CameraInfo, FloatArray, ImageSample, PoseSample, Sample
from workbench.writers.ros_messages import RosMessages, compressed_topic, transform_topic

Json = dict[str, Any]


class JsonMessage(NamedTuple):
    """A message, the name of its type and the topic that it goes to."""

    topic: str
    type: str
    fields: Json


class JsonMessages:
    """Builds JSON messages; see `RosMessages`."""

    def __init__(self) -> None:
        self._ros = RosMessages(2)
        self._builders: dict[type[Sample], Callable[[Any, str], JsonMessage | None]] = {
            ImageSample: _image,
            CameraInfo: _camera,
            PoseSample: self._pose,
        }
        self._uncertain: set[str] = set()

    def build(self, sample: Sample, frame: str) -> JsonMessage | None:
        """The message of a sample; None for a kind of sample that is not ours.

        Raises:
            StreamError: a number of it does not fit into the message.
        """
        builder = self._builders.get(type(sample))
        if builder is not None and (found := builder(sample, frame)) is not None:
            return found
        envelope = self._ros.build(sample, frame)
        if envelope is None:
            return None
        return JsonMessage(envelope.topic, envelope.message.__msgtype__, self._plain(envelope.message))

    def schema(self, name: str) -> Json:
        """The JSON schema of a type."""
        return FOXGLOVE[name] if name in FOXGLOVE else {"title": name, **self._ros_schema(name)}

    def _pose(self, sample: PoseSample, frame: str) -> JsonMessage | None:
        """FrameTransform or PoseInFrame; None where a covariance is known, for which ROS has a type."""
        where = {"position": _xyz(sample.position_m), "orientation": _xyz(sample.quat_xyzw)}
        if (topic := transform_topic(sample)) is not None:
            frames = {"parent_frame_id": sample.parent_frame, "child_frame_id": sample.child_frame}
            moved = {"translation": where["position"], "rotation": where["orientation"]}
            return JsonMessage(topic, "foxglove.FrameTransform", {"timestamp": _stamp(sample), **frames, **moved})
        if not np.all(np.isnan(sample.covariance)):
            self._uncertain.add(sample.stream)
        if sample.stream in self._uncertain:
            return None
        stated = {"timestamp": _stamp(sample), "frame_id": sample.parent_frame or frame}
        return JsonMessage(sample.stream, "foxglove.PoseInFrame", {**stated, "pose": where})

    def _plain(self, value: Any) -> Any:
        """A ROS message, or a part of one, as JSON."""
        if hasattr(value, "nanosec"):
            return {"sec": value.sec, "nsec": value.nanosec}
        if hasattr(value, "__msgtype__"):
            _, fields = self._ros.store.fielddefs[value.__msgtype__]
            return {name: self._plain(getattr(value, name)) for name, _ in fields}
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if isinstance(value, list):
            return [self._plain(part) for part in value]
        return _number(value) if isinstance(value, float) else value

    def _ros_schema(self, name: str) -> Json:
        _, fields = self._ros.store.fielddefs[name]
        if name == "builtin_interfaces/msg/Time":
            return TIME
        return _object(**{field: self._field_schema(description) for field, description in fields})

    def _field_schema(self, description: Any) -> Json:
        kind, detail = description
        if kind is Nodetype.BASE:
            return _base_schema(detail[0])
        if kind is Nodetype.NAME:
            return self._ros_schema(detail)
        return {"type": "array", "items": self._field_schema(detail[0])}


def as_bytes(fields: Json) -> bytes:
    """A message or schema as it lies in the file."""
    return json.dumps(fields, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


# ------------------------------------------------------------------------------- Foxglove


def _image(sample: ImageSample, frame: str) -> JsonMessage:
    stated: Json = {"timestamp": _stamp(sample), "frame_id": frame}
    if not sample.step_bytes:
        fields = {**stated, "data": _base64(sample.data), "format": sample.encoding}
        return JsonMessage(compressed_topic(sample.stream), "foxglove.CompressedImage", fields)
    fields = {
        **stated,
        "width": sample.width_px,
        "height": sample.height_px,
        "encoding": sample.encoding,
        "step": sample.step_bytes,
        "data": _base64(_little_endian(sample)),
    }
    return JsonMessage(sample.stream, "foxglove.RawImage", fields)


def _little_endian(sample: ImageSample) -> bytes | memoryview:
    """The pixels with their low byte first, since a RawImage does not say which comes first."""
    raw = RAW_FORMATS.get(sample.encoding.lower())
    if not sample.big_endian or raw is None or raw.bits != 16:
        return sample.data
    return np.frombuffer(sample.data, np.uint16).byteswap().tobytes()


def _camera(sample: CameraInfo, frame: str) -> JsonMessage:
    camera = sample.camera
    fields = {
        "timestamp": _stamp(sample),
        "frame_id": camera.frame or frame,
        "width": camera.width_px,
        "height": camera.height_px,
        "distortion_model": camera.distortion_model,
        "D": _list(camera.distortion),
        "K": _list(camera.matrix),
        "R": _list(camera.rectification),
        "P": _list(camera.projection),
    }
    return JsonMessage(sample.stream, "foxglove.CameraCalibration", fields)


def _stamp(sample: Sample) -> Json:
    seconds, nanoseconds = divmod(sample.t_ns, 1_000_000_000)
    return {"sec": seconds, "nsec": nanoseconds}


def _xyz(values: FloatArray) -> Json:
    return {name: _number(value) for name, value in zip("xyzw", values.tolist(), strict=False)}


def _list(values: FloatArray) -> list[Any]:
    if np.all(np.isnan(values)):
        return []
    return [_number(value) for value in values.ravel().tolist()]


def _number(value: float) -> float | str:
    if math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _base64(data: bytes | memoryview) -> str:
    return base64.b64encode(data).decode()


# ---------------------------------------------------------------------------------- schemas


def _object(**fields: Json) -> Json:
    return {"type": "object", "properties": fields}


def _base_schema(name: str) -> Json:
    if name in ("string", "bool"):
        return {"type": {"string": "string", "bool": "boolean"}[name]}
    return {"type": "number" if name.startswith("float") else "integer"}


_TEXT, _COUNT = {"type": "string"}, {"type": "integer", "minimum": 0}
_NUMBERS = {"type": "array", "items": {"type": "number"}}
_BYTES = {"type": "string", "contentEncoding": "base64"}
TIME = {"title": "time", **_object(sec=_COUNT, nsec={**_COUNT, "maximum": 999_999_999})}
_POINT = _object(**{name: {"type": "number"} for name in "xyz"})
_TURN = _object(**{name: {"type": "number"} for name in "xyzw"})


def _foxglove(name: str, **fields: Json) -> Json:
    return {"title": name, **_object(timestamp=TIME, **fields)}


FOXGLOVE: dict[str, Json] = {
    schema["title"]: schema
    for schema in (
        _foxglove("foxglove.CompressedImage", frame_id=_TEXT, data=_BYTES, format=_TEXT),
        _foxglove(
            "foxglove.RawImage", frame_id=_TEXT, width=_COUNT, height=_COUNT, encoding=_TEXT, step=_COUNT, data=_BYTES
        ),
        _foxglove(
            "foxglove.CameraCalibration",
            frame_id=_TEXT,
            width=_COUNT,
            height=_COUNT,
            distortion_model=_TEXT,
            D=_NUMBERS,
            K=_NUMBERS,
            R=_NUMBERS,
            P=_NUMBERS,
        ),
        _foxglove("foxglove.PoseInFrame", frame_id=_TEXT, pose=_object(position=_POINT, orientation=_TURN)),
        _foxglove(
            "foxglove.FrameTransform",
            parent_frame_id=_TEXT,
            child_frame_id=_TEXT,
            translation=_POINT,
            rotation=_TURN,
        ),
    )
}
"""The schemas of Foxglove's own types, by name."""
