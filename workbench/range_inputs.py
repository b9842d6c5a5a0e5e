"""What of a recording a replay of ranges uses: frames, odometry, IMU, camera, surveyed landmarks, reference.

What is not asked for is chosen only where there is one possibility; every choice is a sentence of the summary.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.latency import LatencyBuffer
from pipelines.ranging.inputs import Synchronisation
from pipelines.simulation.faults import FAULTS_STREAM
from readers.adjusted import image_size
from readers.streams import (
    Camera,
    Landmark,
    Recording,
    StreamError,
    StreamInfo,
    StreamKind,
    TextSample,
)
from workbench.inputs import (
    NONE,
    Reference,
    camera_sentence,
    choose_images,
    intrinsics,
    kinds,
    names,
    of_kind,
    other_size,
)
from workbench.inputs import load_reference as load_any_reference
from workbench.settings import Layer, Resolved, validated

TRUTH = "/truth/"
"""Streams of a simulated mission that no vehicle has: they are never chosen for an input, only when asked for."""
SOURCES: Mapping[str, StreamKind] = {
    "tracks": StreamKind.TRACK,
    "bearings": StreamKind.LANDMARKS,
    "corners": StreamKind.IMAGE,
    "chessboard": StreamKind.IMAGE,
    "aruco": StreamKind.IMAGE,
}
"""What the frames are for each value of the setting ``landmarks`` but ``auto``."""


@dataclass(frozen=True, slots=True)
class Streams:
    """The streams of a replay, by name; an empty name for none.

    Attributes:
        frames: where the landmarks are found.
        kind: what it holds.
        shown: images that are only shown.
        odometry: speeds.
        imu: rates of turn, where they are not the odometry's.
        notes: sentences on the choice.
    """

    frames: str
    kind: StreamKind
    shown: str
    odometry: str
    imu: str
    notes: tuple[str, ...]

    @property
    def others(self) -> tuple[str, ...]:
        """The streams that the estimator gets beside the frames."""
        return tuple(name for name in (self.odometry, self.imu) if name)


def choose_streams(
    recording: Recording,
    settings: Any,
    *,
    tracks: str | None = None,
    image: str | None = None,
    odometry: str | None = None,
    imu: str | None = None,
) -> Streams:
    """Choose the streams of a replay.

    Args:
        recording: what there is.
        settings: with `landmarks` (``auto`` or what finds them) and `gyro`.
        tracks: pixel tracks or measured landmarks that the user named.
        image: images that the user named; of frames that are no images the ones to show.
        odometry: odometry that the user named.
        imu: IMU that the user named, or none.

    Raises:
        StreamError: what is needed is missing, or there are several to choose from.
    """
    frames, kind = _frames(recording, str(getattr(settings, "landmarks", "auto")), tracks, image)
    speeds = _odometry(recording, odometry)
    shown = "" if kind is StreamKind.IMAGE else _shown(recording, frames, image)
    turns = _imu(recording, imu, str(getattr(settings, "gyro", "auto")))
    notes = [f"frames: {frames}; speed: {speeds}; rate of turn: {turns or speeds}"]
    if shown:
        notes.append(f"the images of {shown} are shown, not used")
    return Streams(frames, kind, shown, speeds, turns, tuple(notes))


def _frames(recording: Recording, source: str, tracks: str | None, image: str | None) -> tuple[str, StreamKind]:
    asked = SOURCES.get(source)
    recorded = (StreamKind.TRACK, StreamKind.LANDMARKS) if asked is None else (asked,)
    if tracks is not None:
        name = of_kind(recording, tracks, recorded, "--tracks")
        return name, recording.stream(name).kind
    if asked is StreamKind.IMAGE:
        return choose_images(recording, image), StreamKind.IMAGE
    for kind in recorded:
        found = recording.of_kind(kind)
        if len(found) > 1:
            raise StreamError(f"{recording.path}: several {kind} streams: {names(found)}; choose one with --tracks")
        if found:
            return found[0].name, kind
    if asked is not None:
        there = f"the streams are: {kinds(recording)}"
        raise StreamError(f"{recording.path}: no stream of {asked} for landmarks = {source!r}; {there}")
    return choose_images(recording, image), StreamKind.IMAGE


def _of_vehicle(recording: Recording, kind: StreamKind) -> list[StreamInfo]:
    return [info for info in recording.of_kind(kind) if not info.name.startswith(TRUTH)]


def _odometry(recording: Recording, wanted: str | None) -> str:
    if wanted is not None:
        return of_kind(recording, wanted, (StreamKind.ODOMETRY,), "--odometry")
    found = _of_vehicle(recording, StreamKind.ODOMETRY)
    if len(found) == 1:
        return found[0].name
    if found:
        raise StreamError(f"{recording.path}: several odometry streams: {names(found)}; choose one with --odometry")
    raise StreamError(
        f"{recording.path}: no odometry, and ranges come from known speeds alone: give a recording that has it; the "
        f"streams are: {kinds(recording)}"
    )


def _imu(recording: Recording, wanted: str | None, gyro: str) -> str:
    if wanted == NONE or (wanted is None and gyro == "odometry"):
        return ""
    if wanted is not None:
        return of_kind(recording, wanted, (StreamKind.IMU,), "--imu")
    found = _of_vehicle(recording, StreamKind.IMU)
    if len(found) > 1:
        raise StreamError(f"{recording.path}: several IMU streams: {names(found)}; choose one with --imu, or none")
    if not found and gyro == "imu":
        raise StreamError(f"{recording.path}: no IMU for gyro = 'imu'; the streams are: {kinds(recording)}")
    return found[0].name if found else ""


def _shown(recording: Recording, frames: str, wanted: str | None) -> str:
    """The images of the same camera: asked for, else the only ones in the same folder of topics."""
    if wanted is not None:
        return "" if wanted == NONE else choose_images(recording, wanted)
    folder = frames.rpartition("/")[0]
    found = [info.name for info in recording.of_kind(StreamKind.IMAGE) if info.name.rpartition("/")[0] == folder]
    return found[0] if len(found) == 1 else ""


def latency_of(settings: Any, streams: Streams) -> LatencyBuffer | None:
    """The buffer that sorts the samples as the settings say; None where the reader's order will do."""
    buffer_ns = round(1e9 * getattr(settings, "latency_buffer_s", 0.0))
    delay_ns = round(1e9 * getattr(settings, "camera_delay_s", 0.0))
    if not buffer_ns and not delay_ns:
        return None
    frames = tuple(name for name in (streams.frames, streams.shown) if name)
    return LatencyBuffer(
        wait_ns=buffer_ns + abs(delay_ns),
        frames=frames,
        delay_ns=dict.fromkeys(frames, delay_ns),
        by_arrival=buffer_ns > 0,
        look_ahead=getattr(settings, "synchronisation", None) is Synchronisation.MIDPOINT,
    )


# ---------------------------------------------------------------------------------------- camera


def camera_of(recording: Recording, streams: Streams) -> Camera | None:
    """The calibrated camera of the frames, of the images beside them, or of the only images in the same folder."""
    cameras = recording.cameras
    folder = streams.frames.rpartition("/")[0]
    beside = [name for name in cameras if name.rpartition("/")[0] == folder]
    for name in (streams.frames, streams.shown, *(beside if len(beside) == 1 else ())):
        if name in cameras and cameras[name].calibrated:
            return cameras[name]
    return None


def with_camera(
    resolved: Resolved, recording: Recording, camera: Camera | None, streams: Streams
) -> tuple[Resolved, list[str]]:
    """Fill in what the settings leave open of the camera; also say what was filled in.

    Only settings that are None are filled in; where `focal_px` was given, none of the intrinsics is.

    Raises:
        StreamError: neither recording nor settings have intrinsics, or those of the recording are for frames of
            another size. Images that are only shown may have been resized: of those it is said.
    """
    settings: Any = resolved.settings
    if streams.kind is StreamKind.LANDMARKS:
        return _only_surveyed(resolved, recording), ["bearings need no camera: they are put into one that looks ahead"]
    if camera is None:
        if settings.focal_px is not None:
            return resolved, []
        raise StreamError(
            f"the recording has no calibration of the camera of {streams.frames}: give --set focal_px=… and "
            "--set centre_px=[…, …]"
        )
    values: dict[str, Any] = {}
    notes = []
    if settings.focal_px is None:
        values = intrinsics(camera)
        notes += [camera_sentence(camera), *_size_notes(recording, camera, streams)]
    if np.isfinite(camera.body_t_camera).all():
        turn, place = camera.body_t_camera[:3, :3], camera.body_t_camera[:3, 3]
        values["camera_quat_xyzw"] = tuple(Rotation.from_matrix(turn).as_quat().tolist())
        values["camera_position_m"] = tuple(place.tolist())
        if settings.camera_quat_xyzw is None and not resolved.given & _ANGLES:
            notes.append("the camera's place in the vehicle is the recording's")
    elif settings.camera_quat_xyzw is None and not resolved.given & _ANGLES:
        notes.append(
            "where the camera looks is not recorded: taken for straight ahead; see camera_yaw_rad, …pitch, …roll"
        )
    if resolved.given & _ANGLES:
        values.pop("camera_quat_xyzw", None)
    fill = {
        key: value
        for key, value in values.items()
        if key in type(settings).model_fields and getattr(settings, key) is None and key not in resolved.given
    }
    filled = validated(settings, [Layer("the recording", fill)]).settings
    return Resolved(filled, resolved.given), notes


def _size_notes(recording: Recording, camera: Camera, streams: Streams) -> list[str]:
    """What is to be said of a camera that was calibrated for another size than the images have, which it may raise."""
    images = streams.frames if streams.kind is StreamKind.IMAGE else streams.shown
    size_px = image_size(recording, images) if images else None
    if size_px is None or not (other := other_size(camera, size_px)):
        return []
    if images != streams.frames:
        return [f"{other} of {images}, which are only shown"]
    raise StreamError(
        f"{recording.path}: {images}: {other}: give --set focal_px=… and --set centre_px=[…, …], or --scale-camera if "
        "the images were resized"
    )


def _only_surveyed(resolved: Resolved, recording: Recording) -> Resolved:
    """Of measured landmarks those that are surveyed: of others it is not known that they stand still."""
    settings: Any = resolved.settings
    if "only_landmarks" not in type(settings).model_fields or "only_landmarks" in resolved.given:
        return resolved
    surveyed = {"only_landmarks": tuple(sorted(recording.landmarks))}
    return Resolved(validated(settings, [Layer("the recording", surveyed)]).settings, resolved.given)


_ANGLES = frozenset({"camera_yaw_rad", "camera_pitch_rad", "camera_roll_rad"})


# -------------------------------------------------------------------------- landmarks, reference


def landmarks_of(recording: Recording) -> dict[int, Landmark]:
    """The surveyed landmarks; of a written simulated mission those of the scenario that it carries with it."""
    known = recording.landmarks
    if known or not any(info.name == FAULTS_STREAM for info in recording.of_kind(StreamKind.TEXT)):
        return known
    sample = next(iter(recording.read([FAULTS_STREAM])), None)
    return _of_scenario(sample.text) if isinstance(sample, TextSample) else {}


def _of_scenario(text: str) -> dict[int, Landmark]:
    """The tracked points of the scenario in the text of a mission's faults; none where it has no such part."""
    from pydantic import ValidationError

    from pipelines.simulation.scenario import landmarks_of as tracked
    from pipelines.simulation.sections import Surroundings

    with contextlib.suppress(ValueError, ValidationError, KeyError, TypeError):
        scenario = json.loads(text)["scenario"]
        if scenario.get("tracks") is not None:
            points = tracked(Surroundings.model_validate(scenario["surroundings"]))
            return {k: Landmark(position_m=place, sigma_m=np.zeros(3)) for k, place in enumerate(points)}
    return {}


def load_reference(
    recording: Recording, wanted: str | None, start_ns: int | None, stop_ns: int | None, offset_ns: int
) -> Reference:
    """The reference poses of a window: of the stream asked for, else of the only pose stream, else none.

    Raises:
        StreamError: the stream asked for is missing, or holds something else.
    """
    poses: Sequence[StreamInfo] = recording.of_kind(StreamKind.POSE)
    if wanted is None and not poses:
        return Reference("", "no reference pose in the recording")
    return load_any_reference(recording, wanted, start_ns, stop_ns, offset_ns)
