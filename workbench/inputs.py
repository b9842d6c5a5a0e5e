"""What of a recording a replay uses: image stream, time window, reference, camera height, scale.

What is not asked for is chosen only where there is one possibility; every choice is a sentence of the summary.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluation import Trajectory, associate
from pipelines.geometry import local_enu
from readers.clock import StreamAudit
from readers.streams import (
    UNKNOWN_COV6,
    UNKNOWN_QUAT,
    Camera,
    GnssSample,
    ImageError,
    ImageSample,
    OdometrySample,
    PoseSample,
    Problem,
    RangeSample,
    Recording,
    RecordingError,
    Sample,
    ScalarSample,
    StreamError,
    StreamKind,
)
from workbench.settings import Layer, Resolved, validated

NONE = "none"
DEPTH = "/compressedDepth"
"""How topics of compressed depth images end: they are images that no picture is in."""
SECOND_NS = 1_000_000_000
MARGIN_NS = 2 * SECOND_NS
EDGE_BYTES = 1 << 20
SAMPLED_FILES = 64
SAMPLED_BYTES = 1 << 16
MAX_TRIES = 100


# --------------------------------------------------------------------------------- window


def parse_time(text: str, origin_ns: int) -> int:
    """A moment in nanoseconds: seconds after the first frame, absolute nanoseconds, or ISO 8601 (UTC if unsaid).

    A whole number of 15 digits or more is taken for nanoseconds.

    Raises:
        StreamError: the text is none of these.
    """
    if re.fullmatch(r"\d{15,}", text):
        return int(text)
    try:
        seconds = float(text)
    except ValueError:
        pass
    else:
        if math.isfinite(seconds):
            return origin_ns + round(seconds * SECOND_NS)
    try:
        moment = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise StreamError(
            f"{text!r} is not a time: give seconds after the first frame (12.5), nanoseconds (1700000000000000000) "
            "or ISO 8601 (2023-11-14T22:13:20)"
        ) from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    since = moment - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return (since.days * 86_400 + since.seconds) * SECOND_NS + since.microseconds * 1000


@dataclass(frozen=True, slots=True)
class FirstFrame:
    """Time of the first frame of a window, and width and height in px of the first one that can be decoded."""

    t_ns: int
    size_px: tuple[int, int]


def first_frame(recording: Recording, stream: str, start_ns: int | None, stop_ns: int | None) -> FirstFrame:
    """The first frame of a window.

    Raises:
        StreamError: the window holds no frame or only one, or none of the first hundred can be decoded.
    """
    if len(list(itertools.islice(recording.read([stream], start_ns, stop_ns), 2))) == 1:
        raise StreamError(f"{recording.path}: {stream} has one frame in this window; a motion takes two or more")
    first_ns, tries, reason = -1, 0, ""
    for sample in recording.read([stream], start_ns, stop_ns):
        first_ns = sample.t_ns if tries == 0 else first_ns
        tries += 1
        if isinstance(sample, ImageSample):
            try:
                height, width = sample.grey().shape
            except ImageError as error:
                reason = str(error)
            else:
                return FirstFrame(first_ns, (width, height))
        elif isinstance(sample, Problem):
            reason = sample.reason
        if tries >= MAX_TRIES:
            break
    if tries:
        raise StreamError(f"{recording.path}: none of the first {tries} images of {stream} can be decoded: {reason}")
    raise _no_frame(recording, stream)


def first_time(recording: Recording, stream: str, start_ns: int | None, stop_ns: int | None) -> int:
    """Time of the first frame of a window, decodable or not.

    Raises:
        StreamError: the window has none.
    """
    for sample in recording.read([stream], start_ns, stop_ns):
        return sample.t_ns
    raise _no_frame(recording, stream)


def _no_frame(recording: Recording, stream: str) -> StreamError:
    info = recording.stream(stream)
    span = f"from {info.first_ns} to {info.last_ns} ns" if info.first_ns >= 0 else "at no time"
    return StreamError(f"{recording.path}: {stream} has no frame in this window; its messages lie {span}")


LOOK_NS = 10 * SECOND_NS
CLOCK_FACTS = frozenset(
    ("clock_jump", "duplicate_stamp", "foreign_publish_time", "foreign_stamp", "frozen_stamp", "gap", "out_of_order")
) | {"stamp_rollover", "zero_stamp"}


def clock_warnings(recording: Recording, streams: Sequence[str], first_ns: int, stop_ns: int | None) -> list[str]:
    """What is odd about the clocks of some streams in the first seconds of a window, one sentence each.

    A simulated mission is not looked at: its oddities are its own, and looking renders it.
    """
    if recording.identity:
        return []
    last_ns = first_ns + LOOK_NS if stop_ns is None else min(stop_ns, first_ns + LOOK_NS)
    audits = {name: StreamAudit(name) for name in streams}
    for sample in while_readable(recording.read(list(streams), first_ns, last_ns)):
        audits[sample.stream].add(sample)
    facts = [fact for audit in audits.values() for fact in audit.facts() if fact.code in CLOCK_FACTS]
    return [f"{fact.stream}, first {LOOK_NS // SECOND_NS} s: {fact.sentence}" for fact in facts]


# -------------------------------------------------------------------------------- streams


def names(infos: Iterable[Any]) -> str:
    """The names of some streams, for a message."""
    return ", ".join(info.name for info in infos) or "none"


def choose_images(recording: Recording, wanted: str | None) -> str:
    """The stream of frames: the one asked for, else the only one.

    Raises:
        StreamError: it is missing or holds no images, or there are several or none to choose from.
    """
    if wanted is not None:
        return of_kind(recording, wanted, (StreamKind.IMAGE,), "--image")
    found = recording.of_kind(StreamKind.IMAGE)
    pictures = [info for info in found if not info.name.endswith(DEPTH)]
    if len(pictures) == 1:
        return pictures[0].name
    if found:
        raise StreamError(f"{recording.path}: several image streams: {names(found)}; choose one with --image")
    raise StreamError(f"{recording.path}: no stream of images that can be read; the streams are: {kinds(recording)}")


def choose_height(recording: Recording, wanted: str | None) -> str:
    """The stream of camera heights: the one asked for, else the only range stream, else none (an empty name).

    Raises:
        StreamError: the stream asked for is missing, or holds something else.
    """
    kinds = (StreamKind.RANGE, StreamKind.SCALAR, StreamKind.POSE)
    if wanted is not None:
        return "" if wanted == NONE else of_kind(recording, wanted, kinds, "--height")
    found = recording.of_kind(StreamKind.RANGE)
    return found[0].name if len(found) == 1 else ""


def of_kind(recording: Recording, wanted: str, kinds: Sequence[StreamKind], option: str) -> str:
    """The name of a stream that was asked for.

    Raises:
        StreamError: it is missing, cannot be read, or holds something else.
    """
    info = recording.stream(wanted)
    if not info.readable:
        raise StreamError(f"{recording.path}: {wanted} cannot be read: {info.reason}")
    if info.kind not in kinds:
        usable = [s for kind in kinds for s in recording.of_kind(kind)]
        raise StreamError(f"{recording.path}: {wanted} holds {info.kind}; {option} can be: {names(usable)}")
    return info.name


def kinds(recording: Recording) -> str:
    """The names and kinds of all streams, for a message."""
    return ", ".join(f"{s.name} ({s.kind})" for s in recording.streams) or "none"


# ------------------------------------------------------------------------------ reference


@dataclass(frozen=True, slots=True)
class Reference:
    """The path that the estimate is held against; `sentence` says where it comes from, or why there is none."""

    stream: str
    sentence: str
    poses: tuple[PoseSample, ...] = ()

    @property
    def path(self) -> Trajectory:
        """The poses seen from above."""
        return Trajectory.of_poses(self.poses)


def choose_reference(recording: Recording, wanted: str | None) -> tuple[str, str]:
    """The stream of the reference (an empty name for none), and a sentence on that choice.

    Without a wish: the only pose stream; else the only GNSS stream; else the only odometry.

    Raises:
        StreamError: the stream asked for is missing, or holds something else.
    """
    kinds = (StreamKind.POSE, StreamKind.GNSS, StreamKind.ODOMETRY)
    if wanted == NONE:
        return "", "none, as asked"
    if wanted is not None:
        return of_kind(recording, wanted, kinds, "--reference"), f"{wanted}, as asked"
    for kind in kinds:
        found = recording.of_kind(kind)
        if len(found) > 1:
            return "", f"none: several {kind} streams ({names(found)}); choose one with --reference"
        if found:
            return found[0].name, f"{found[0].name}, {_WHAT[kind]}"
    return "", "none in the recording"


_WHAT = {
    StreamKind.POSE: "the only pose stream",
    StreamKind.GNSS: "satellite positions in metres east and north of the first one",
    StreamKind.ODOMETRY: "the vehicle's own odometry, itself an estimate: for want of a better one",
}


def load_reference(
    recording: Recording, wanted: str | None, start_ns: int | None, stop_ns: int | None, offset_ns: int = 0
) -> Reference:
    """Read the reference of a window, with a margin on both sides so that its ends can be interpolated.

    Raises:
        StreamError: the stream asked for is missing, or holds something else.
    """
    stream, sentence = choose_reference(recording, wanted)
    if not stream:
        return Reference(stream, sentence)
    lower = None if start_ns is None else start_ns + offset_ns - MARGIN_NS
    upper = None if stop_ns is None else stop_ns + offset_ns + MARGIN_NS
    poses = reference_poses(while_readable(recording.read([stream], lower, upper)))
    if poses:
        return Reference(stream, sentence, poses)
    return _no_reference(recording, f"{stream} holds no position in this window", wanted)


def overlapping(
    recording: Recording, reference: Reference, wanted: str | None, image: str, first_ns: int, offset_ns: int
) -> Reference:
    """The same reference, or none if all of it lies before the first image or after the last one.

    Raises:
        StreamError: it was asked for by name.
    """
    if not reference.poses:
        return reference
    images = recording.stream(image)
    last_ns = images.last_ns + max(0, first_ns - images.first_ns)
    begin, end = reference.poses[0].t_ns - offset_ns, reference.poses[-1].t_ns - offset_ns
    if end >= first_ns and (images.last_ns < 0 or begin <= last_ns + MARGIN_NS):
        return reference
    problem = (
        f"{reference.stream} lies from {begin / 1e9:.3f} to {end / 1e9:.3f} s, at another time than the images, which "
        f"begin at {first_ns / 1e9:.3f} s; look at --reference-offset"
    )
    return _no_reference(recording, problem, wanted)


def _no_reference(recording: Recording, problem: str, wanted: str | None) -> Reference:
    """No reference where it was only supposed, an error where it was asked for."""
    if wanted is not None:
        raise StreamError(f"{recording.path}: {problem}; choose another with --reference, or none")
    return Reference("", f"none: {problem}")


def while_readable(samples: Iterator[Sample]) -> Iterator[Sample]:
    """Samples up to where the file can be read; that it ends there is for the replay to say, which reads it too."""
    with contextlib.suppress(RecordingError):
        yield from samples


def reference_poses(samples: Iterator[Sample]) -> tuple[PoseSample, ...]:
    """Samples of a pose, GNSS or odometry stream as poses; those without a position are left out.

    GNSS fixes become metres east, north and up of the first fix; they have no heading.
    """
    poses: list[PoseSample] = []
    fixes: list[GnssSample] = []
    for sample in samples:
        if isinstance(sample, GnssSample):
            if sample.status >= 0 and math.isfinite(sample.latitude_rad) and math.isfinite(sample.longitude_rad):
                fixes.append(sample)
        elif isinstance(sample, OdometrySample):
            poses.append(_pose(sample, sample.position_m, sample.quat_xyzw))
        elif isinstance(sample, PoseSample):
            poses.append(sample)
    if fixes:
        coordinates = np.array([(f.latitude_rad, f.longitude_rad, f.altitude_m) for f in fixes])
        enu = local_enu(*coordinates.T)
        poses += [_pose(fix, position, UNKNOWN_QUAT) for fix, position in zip(fixes, enu, strict=True)]
    return tuple(pose for pose in poses if np.isfinite(pose.position_m[:2]).all())


def _pose(sample: Sample, position_m: Any, quat_xyzw: Any) -> PoseSample:
    return PoseSample(
        stream=sample.stream,
        t_ns=sample.t_ns,
        received_ns=sample.received_ns,
        position_m=position_m,
        quat_xyzw=quat_xyzw,
        covariance=UNKNOWN_COV6,
    )


# ---------------------------------------------------------------------------------- scale


@dataclass(frozen=True, slots=True)
class Scale:
    """What the path is measured in: `unit` is ``m`` where the scale is known."""

    unit: str
    sentence: str

    @property
    def known(self) -> bool:
        """Whether the path is in metres."""
        return self.unit == "m"


def with_scale(
    resolved: Resolved, recording: Recording, image: str, size_px: tuple[int, int], height_stream: str
) -> tuple[Resolved, Scale, list[str]]:
    """Complete the settings with the price of a pixel; also say what it comes from, and what to look out for.

    In this order: `metres_per_px`; the height (constant, or a stream) over the focal length (setting, or the
    camera's intrinsics); the height alone, the path then being in pixels times metres; nothing, the path then
    being in pixels. Estimators without these settings are left as they are.
    """
    settings: Any = resolved.settings
    if "metres_per_px" not in type(settings).model_fields:
        return resolved, Scale("m", "the estimator's own"), []
    if settings.metres_per_px is not None:
        return resolved, Scale("m", f"{settings.metres_per_px:.6g} m/px, as given"), []
    focal_px, focal, notes = _focal(settings, recording.cameras.get(image), size_px)
    values, height = _height(settings, recording, height_stream)
    if not height:
        cure = "give metres_per_px, or height_m" + ("" if focal_px else " and focal_px")
        values, scale = {"metres_per_px": 1.0}, Scale("px", f"unknown, so that the path is in pixels: {cure}")
    elif focal_px is None:
        values["focal_px"] = 1.0
        scale = Scale("px·m", f"{height}, but no focal length: the path is in pixels times metres; give focal_px")
    else:
        values["focal_px"] = focal_px
        scale = Scale("m", f"{height} over {focal}")
    return filled(resolved, values), scale, notes


def _focal(settings: Any, camera: Camera | None, size_px: tuple[int, int]) -> tuple[float | None, str, list[str]]:
    """The focal length, what it comes from, and what to look out for."""
    if settings.focal_px is not None:
        return settings.focal_px, f"focal length {settings.focal_px:g} px, as given", []
    if camera is None:
        return None, "", []
    if not camera.calibrated:
        return (
            None,
            "",
            ["the calibration is empty (K has no focal length): give --camera FILE or focal_px"],
        )
    if other := other_size(camera, size_px):
        return None, "", [f"{other}: it is not used; give focal_px, or --scale-camera if the images were resized"]
    notes = [camera_sentence(camera)]
    notes += ["lens distortion is not removed from the images"] if np.any(camera.distortion) else []
    focal = float(camera.matrix[0, 0])
    return focal, f"focal length {focal:.6g} px of {source_of(camera)}", notes


def other_size(camera: Camera, size_px: tuple[int, int]) -> str:
    """That a calibration is for images of another width and height, in words; "" if it is not, or does not say."""
    made_for = (camera.width_px, camera.height_px)
    if made_for in (size_px, (0, 0)):
        return ""
    (width, height), (actual_width, actual_height) = made_for, size_px
    return f"the calibration is for {width} x {height} px, but the images are {actual_width} x {actual_height} px"


def source_of(camera: Camera) -> str:
    """Where a camera comes from."""
    return camera.source or "the log's calibration"


def camera_sentence(camera: Camera) -> str:
    """The model of a camera and where it comes from."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    size = f"{camera.width_px} x {camera.height_px} px, " if camera.width_px else ""
    lens = ", ".join(f"{k:.6g}" for k in camera.distortion)
    bent = f"distortion {camera.distortion_model} ({lens})" if np.any(camera.distortion) else "no distortion"
    return f"camera: {size}f {fx:.6g} {fy:.6g}, centre {cx:.6g} {cy:.6g}, {bent}, of {source_of(camera)}"


def intrinsics(camera: Camera) -> dict[str, Any]:
    """The settings of a camera's intrinsics."""
    values: dict[str, Any] = {
        "focal_px": float(camera.matrix[0, 0]),
        "focal_y_px": float(camera.matrix[1, 1]),
        "centre_px": (float(camera.matrix[0, 2]), float(camera.matrix[1, 2])),
        "distortion_model": camera.distortion_model,
        "distortion": tuple(float(v) for v in camera.distortion),
    }
    if camera.width_px and camera.height_px:
        values["image_size_px"] = (camera.width_px, camera.height_px)
    return values


def _height(settings: Any, recording: Recording, stream: str) -> tuple[dict[str, Any], str]:
    """The settings for the height, and what it comes from (empty for unknown)."""
    stream = stream or settings.height_stream
    if not stream:
        known = settings.height_m is not None
        return {}, f"height {settings.height_m:g} m, as given" if known else ""
    first = next((h for s in recording.read([stream]) if (h := height_of(s)) is not None), None)
    if first is None:
        raise StreamError(f"{recording.path}: {stream} holds no positive height")
    values: dict[str, Any] = {"height_stream": stream}
    if settings.height_m is None:
        values["height_m"] = first + settings.height_offset_m
    return values, f"height of {stream}"


def height_of(sample: Sample) -> float | None:
    """The height that a sample tells, None where it tells none that is positive and finite."""
    value = math.nan
    if isinstance(sample, RangeSample):
        value = sample.range_m
    elif isinstance(sample, ScalarSample):
        value = sample.value
    elif isinstance(sample, PoseSample):
        value = float(sample.position_m[2])
    return value if math.isfinite(value) and value > 0 else None


def with_start(resolved: Resolved, reference: Reference, first_ns: int) -> Resolved:
    """Let the path begin at the reference's pose at the first frame, so that both draw over one another.

    A start pose that the user gave stays. Where the reference has no heading, it is the settings' own.
    """
    settings: Any = resolved.settings
    fields = type(settings).model_fields
    if not reference.poses or "start_pose" not in fields or "start_pose" in resolved.given:
        return resolved
    path = reference.path
    at = associate(np.array([first_ns]), path)[0]
    pose = at if np.isfinite(at[0]) else path.pose[0]
    heading = float(pose[2]) if math.isfinite(pose[2]) else settings.start_pose[2]
    return filled(resolved, {"start_pose": (float(pose[0]), float(pose[1]), heading)})


def filled(resolved: Resolved, values: dict[str, Any]) -> Resolved:
    """The same settings with some values of the recording; what the user gave stays noted as given."""
    settings = validated(resolved.settings, [Layer("the recording", values)]).settings
    return Resolved(settings, resolved.given)


# --------------------------------------------------------------------------------- digest


def digest_of(recording: Recording, path: Path) -> str:
    """SHA-256 of what identifies a recording: what it says of itself where it has no file, else its file."""
    return hashlib.sha256(recording.identity.encode()).hexdigest() if recording.identity else digest(path)


def digest(path: Path) -> str:
    """SHA-256 of what identifies a recording, as hexadecimal digits.

    Of a file: its size and its first and last MiB. Of a folder: the names and sizes of all its files, and
    the first and last 64 KiB of up to 64 of them.
    """
    total = hashlib.sha256()
    if not path.is_dir():
        _add_edges(total, path, EDGE_BYTES)
        return total.hexdigest()
    files = sorted((p for p in path.rglob("*") if p.is_file()), key=lambda p: p.relative_to(path).as_posix())
    for file in files:
        total.update(f"{file.relative_to(path).as_posix()}\0{file.stat().st_size}\n".encode(errors="surrogateescape"))
    for number in np.unique(np.linspace(0, len(files) - 1, SAMPLED_FILES).astype(int)) if files else ():
        _add_edges(total, files[number], SAMPLED_BYTES)
    return total.hexdigest()


def _add_edges(total: Any, file: Path, edge: int) -> None:
    size = file.stat().st_size
    total.update(f"{size}\n".encode())
    with file.open("rb") as stream:
        total.update(stream.read(edge))
        if size > edge:
            stream.seek(max(edge, size - edge))
            total.update(stream.read(edge))
