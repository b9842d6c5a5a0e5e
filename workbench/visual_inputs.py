"""What of a recording a replay of visual odometry uses beside its images: the camera, and what tells the scale.

What is not asked for is chosen only where there is one possibility; every choice is a sentence of the summary. The
reference is never taken for the scale unless the setting `position_stream` names it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from readers.streams import Camera, OdometrySample, PoseSample, Recording, StreamError, StreamKind
from workbench.inputs import (
    NONE,
    Reference,
    camera_sentence,
    choose_height,
    filled,
    height_of,
    intrinsics,
    of_kind,
    other_size,
)
from workbench.settings import Resolved

LEVEL = 0.5
"""The image's u axis tells a heading where its part in the vehicle's plane is longer than this."""


@dataclass(frozen=True, slots=True)
class ScaleSource:
    """What the scale comes from: the streams to read, and a sentence; no sentence where nothing tells it."""

    streams: tuple[str, ...]
    sentence: str


def with_camera(
    resolved: Resolved, recording: Recording, image: str, size_px: tuple[int, int]
) -> tuple[Resolved, list[str]]:
    """Fill in what the settings leave open of the camera; also say what was filled in.

    Where `focal_px` was given, none of the intrinsics is filled in.

    Raises:
        StreamError: the camera is unknown, or was calibrated for images of another size.
    """
    settings: Any = resolved.settings
    camera = recording.cameras.get(image)
    if settings.focal_px is not None:
        told = [f"camera: focal length {settings.focal_px:g} px, as given"]
        return _with_mounting(resolved, camera, told)
    if camera is None or not camera.calibrated:
        found = "the calibration is empty (K has no focal length)" if camera is not None else "no calibration"
        raise StreamError(
            f"{recording.path}: {found} of the camera of {image}, and visual odometry needs one: give --camera FILE, "
            "or --set focal_px=… (and centre_px)"
        )
    if other := other_size(camera, size_px):
        raise StreamError(
            f"{recording.path}: {image}: {other}: give --camera for these, or --scale-camera if they were resized"
        )
    return _with_mounting(filled(resolved, intrinsics(camera)), camera, [camera_sentence(camera)])


def _with_mounting(resolved: Resolved, camera: Camera | None, notes: list[str]) -> tuple[Resolved, list[str]]:
    """Fill in the heading of the image's +u axis in the vehicle, where the recording tells it."""
    if camera is None or "mounting_yaw_rad" in resolved.given or not np.isfinite(camera.body_t_camera).all():
        return resolved, notes
    x, y = camera.body_t_camera[:2, 0].tolist()
    if math.hypot(x, y) < LEVEL:
        return resolved, notes
    yaw = math.atan2(y, x)
    notes = [*notes, f"the image's +u axis has heading {math.degrees(yaw):.4g}° in the vehicle, as recorded"]
    return filled(resolved, {"mounting_yaw_rad": yaw}), notes


def with_scale(
    resolved: Resolved,
    recording: Recording,
    *,
    kinds: Sequence[StreamKind],
    height: str | None = None,
    odometry: str | None = None,
    start_ns: int | None = None,
) -> tuple[Resolved, ScaleSource]:
    """Complete the settings with the streams that tell the scale.

    In this order: the height over the ground (a stream, else constant), the speed, positions.

    Args:
        resolved: the settings.
        recording: what there is.
        kinds: what the estimator takes. One that takes images alone gets the first height of the window.
        height: stream of heights that the user named, or none; else the settings' own, else the only range stream.
        odometry: odometry whose speed the user wants to be the scale.
        start_ns: when the window begins.

    Raises:
        StreamError: a stream is missing, or holds something else or nothing that tells a length.
    """
    settings: Any = resolved.settings
    wanted = height if height is not None else settings.height_stream or None
    values: dict[str, Any] = {}
    if wanted is not None or settings.height_m is None:
        values["height_stream"] = choose_height(recording, wanted)
    if odometry is not None:
        chosen = "" if odometry == NONE else of_kind(recording, odometry, (StreamKind.ODOMETRY,), "--odometry")
        values["speed_stream"] = chosen
    resolved = filled(resolved, values)
    if StreamKind.RANGE not in kinds:
        return _with_first_height(resolved, recording, start_ns)
    settings = resolved.settings
    told: list[str] = []
    if settings.height_stream:
        _demand(recording, settings.height_stream, "height", lambda sample: height_of(sample) is not None)
        told.append(f"height of {settings.height_stream}")
    elif settings.height_m is not None:
        told.append(f"height {settings.height_m:g} m at the start, as given")
    if settings.speed_stream:
        _demand(recording, settings.speed_stream, "speed", lambda sample: isinstance(sample, OdometrySample))
        told.append(f"speed of {settings.speed_stream}")
    if settings.position_stream:
        _demand(recording, settings.position_stream, "position", lambda sample: isinstance(sample, PoseSample))
        told.append(f"positions of {settings.position_stream}")
    streams = dict.fromkeys(s for s in (settings.height_stream, settings.speed_stream, settings.position_stream) if s)
    return resolved, ScaleSource(tuple(streams), ", else ".join(told))


def _with_first_height(resolved: Resolved, recording: Recording, start_ns: int | None) -> tuple[Resolved, ScaleSource]:
    """The scale of an estimator that takes images alone: a constant height, else the first one of the stream."""
    settings: Any = resolved.settings
    stream = settings.height_stream
    unusable = settings.speed_stream or settings.position_stream
    if unusable:
        raise StreamError(f"{unusable} cannot be the scale: this estimator takes images and a height alone")
    if not stream:
        known = settings.height_m is not None
        return resolved, ScaleSource((), f"height {settings.height_m:g} m at the start, as given" if known else "")
    first = next((h for s in recording.read([stream], start_ns) if (h := height_of(s)) is not None), None)
    if first is None:
        raise StreamError(f"{recording.path}: {stream} holds no positive height: choose another with --height")
    values = {"height_m": first + settings.height_offset_m, "height_stream": ""}
    return filled(resolved, values), ScaleSource((), f"height of {stream} at the start")


def _demand(recording: Recording, stream: str, what: str, tells: Any) -> None:
    """Raise an error where a stream is missing or none of its samples tells what it is for."""
    recording.stream(stream)
    if not any(tells(sample) for sample in recording.read([stream])):
        raise StreamError(
            f"{recording.path}: {stream} holds no {what} that could tell the scale: choose another stream"
        )


def scale_notes(source: ScaleSource, reference: Reference) -> list[str]:
    """What is to be said of the scale before the replay."""
    if not source.sentence:
        return [
            "nothing tells the scale, so that lengths are in units of the first map: give --height STREAM, "
            "--set height_m=…, --odometry STREAM for its speed, or --set position_stream=…"
        ]
    if reference.stream and reference.stream in source.streams:
        return [f"the scale comes of {reference.stream}, which is the reference, too: it says nothing of the scale"]
    return []
