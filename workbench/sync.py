"""How far the clocks of a recording's cameras, IMUs and odometers are apart, from the motion that all of them saw.

The turn of the whole image (and a downward camera's way) is held against the rates of turn of an IMU or odometer
and against an odometer's speed. Of each pair of streams the signals that go together best tell the offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.image_motion import Motions
from pipelines.time_offset import Correlations, TimeOffset, correlations, signal_offset
from readers.streams import (
    ImageError,
    ImageSample,
    ImuSample,
    OdometrySample,
    Recording,
    StreamError,
    StreamKind,
)
from workbench import inputs

Floats = NDArray[np.float64]
TRUTH = "/truth/"
LEAST_KNOWN = 0.7


class Signal(NamedTuple):
    """A quantity summed up over time: its name, times [n] and sums [n]."""

    name: str
    t_ns: NDArray[np.int64]
    summed: Floats


@dataclass(frozen=True, slots=True)
class Pair:
    """What two streams tell of their clocks: `offset` is to be added to the times of `camera`."""

    camera: str
    sensor: str
    signals: str
    offset: TimeOffset
    curve: Correlations | None = None

    @property
    def option(self) -> str:
        """What to give to a replay; empty where the offset is not known."""
        return f"--offset {self.camera}={self.offset.offset_ns / 1e6:.3f}" if self.offset.determined else ""


def sync(
    recording: Recording,
    *,
    images: Sequence[str] = (),
    sensors: Sequence[str] = (),
    start: str | None = None,
    stop: str | None = None,
    max_offset_s: float = 1.0,
    on_frame: Callable[[int, int], None] | None = None,
) -> list[Pair]:
    """Estimate the offset of every camera to every IMU and odometer.

    Args:
        recording: where the streams are.
        images: the cameras; all of them if empty.
        sensors: IMUs and odometers; all of them but those of a simulation's truth if empty.
        start: first time of the window, as `inputs.parse_time` reads it.
        stop: its end.
        max_offset_s: how far the clocks may be apart.
        on_frame: called after each image with their number so far and all of them (-1: unknown).

    Raises:
        StreamError: a stream is missing or of another kind, or there is nothing to compare.
    """
    kinds = (StreamKind.IMU, StreamKind.ODOMETRY)
    cameras = [inputs.of_kind(recording, name, (StreamKind.IMAGE,), "--image") for name in images]
    cameras = cameras or [info.name for info in recording.of_kind(StreamKind.IMAGE)]
    others = [inputs.of_kind(recording, name, kinds, "--with") for name in sensors]
    others = others or [
        info.name for kind in kinds for info in recording.of_kind(kind) if not info.name.startswith(TRUTH)
    ]
    if not cameras or not others:
        what = "images" if not cameras else "IMU and no odometry"
        raise StreamError(f"{recording.path}: no {what} to compare; the streams are: {inputs.kinds(recording)}")
    origin = inputs.first_time(recording, cameras[0], None, None)
    start_ns, stop_ns = (None if text is None else inputs.parse_time(text, origin) for text in (start, stop))
    moving = {name: _of_sensor(recording, name, start_ns, stop_ns) for name in others}
    pairs = []
    for camera in cameras:
        seen = _of_camera(recording, camera, start_ns, stop_ns, on_frame)
        pairs += [_pair(camera, seen, name, moving[name], max_offset_s) for name in others]
    return pairs


def _of_camera(
    recording: Recording,
    stream: str,
    start_ns: int | None,
    stop_ns: int | None,
    on_frame: Callable[[int, int], None] | None,
) -> list[Signal] | str:
    """The signals of a camera; or why there are none."""
    motions, total = Motions(), recording.stream(stream).count
    for done, sample in enumerate(recording.read([stream], start_ns, stop_ns), start=1):
        if isinstance(sample, ImageSample):
            try:
                motions.add(sample.t_ns, sample.grey())
            except ImageError:
                continue
        if on_frame is not None:
            on_frame(done, total)
    times, values = motions.t_ns, motions.values
    if len(times) < 3:
        return f"{stream} has {len(times)} images that can be used in this window"
    if motions.known_share < LEAST_KNOWN:
        return f"the motion of only {motions.known_share:.0%} of the images of {stream} can be told"
    turn, across, down = (_filled(values[:, k], times) for k in range(3))
    signals = {"turn of the image": turn, "shift across": across, "shift down": down}
    return [Signal(name, times, np.cumsum(steps)) for name, steps in signals.items()] + [
        Signal("way of the image", times, np.cumsum(np.hypot(across, down)))
    ]


def _filled(steps: Floats, t_ns: NDArray[np.int64]) -> Floats:
    """Steps [n] with those that are unknown at the rate of their neighbours."""
    seconds = np.diff(t_ns, prepend=t_ns[0] - 1) / 1e9
    rates, known = steps / seconds, np.isfinite(steps)
    known[0] = False  # the first frame has no step
    filled = np.interp(t_ns, t_ns[known], rates[known]) * seconds
    filled[0] = 0.0
    return np.asarray(filled)


def _of_sensor(recording: Recording, stream: str, start_ns: int | None, stop_ns: int | None) -> list[Signal]:
    """The rates of turn of an IMU or odometer, and the speed of an odometer, summed up."""
    rows: list[tuple[Any, ...]] = []
    for sample in recording.read([stream], start_ns, stop_ns):
        if rows and sample.t_ns <= rows[-1][0]:
            continue
        if isinstance(sample, ImuSample):
            rows.append((sample.t_ns, *map(float, sample.angular_velocity_radps), math.nan))
        elif isinstance(sample, OdometrySample):
            speed = float(np.hypot(*sample.linear_velocity_mps[:2]))
            rows.append((sample.t_ns, *map(float, sample.angular_velocity_radps), speed))
    names = ("turn about x", "turn about y", "turn about z", "speed")
    columns = list(zip(*rows, strict=True)) if rows else []
    times = np.array(columns[0] if columns else (), np.int64)
    signals = []
    for name, values in zip(names, columns[1:], strict=False):
        rates = np.array(values)
        if np.isfinite(rates).all() and np.ptp(rates) > 0:
            signals.append(Signal(name, times, _integral(times, rates)))
    return signals


def _integral(t_ns: NDArray[np.int64], rates: Floats) -> Floats:
    """The integral of rates [n] since the first, by trapezes."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(t_ns) / 1e9
    return np.concatenate([[0.0], np.cumsum(steps)])


def _candidates(seen: Sequence[Signal], moving: Sequence[Signal]) -> Iterator[tuple[Signal, Signal]]:
    """The signals that can be of one motion: turns with turns, ways with speeds."""
    for first in seen:
        for second in moving:
            if (first.name == "way of the image") == (second.name == "speed"):
                yield first, second


def _pair(camera: str, seen: list[Signal] | str, sensor: str, moving: list[Signal], max_offset_s: float) -> Pair:
    """The offset by those signals of two streams that tell it best."""
    if isinstance(seen, str):
        return Pair(camera, sensor, "", _unknown(seen))
    found = []
    for first, second in _candidates(seen, moving):
        arguments = (first.t_ns, first.summed, second.t_ns, second.summed)
        offset = signal_offset(*arguments, max_offset_s=max_offset_s)
        found.append((offset, f"{first.name}, {second.name}", arguments))
    if not found:
        return Pair(camera, sensor, "", _unknown(f"{sensor} tells no motion that varies"))
    known = [entry for entry in found if entry[0].determined]
    if not known:
        return Pair(camera, sensor, "", _unknown(found[0][0].reason))
    offset, names, arguments = max(known, key=lambda entry: abs(entry[0].correlation))
    return Pair(camera, sensor, names, offset, correlations(*arguments, max_offset_s=max_offset_s))


def _unknown(reason: str) -> TimeOffset:
    nan = math.nan
    return TimeOffset(offset_ns=0, sigma_s=nan, correlation=nan, scale=nan, determined=False, reason=reason)


def draw(pairs: Sequence[Pair], file: Path) -> None:
    """Draw the correlation of each pair over the offset.

    Raises:
        StreamError: no pair has one.
    """
    from matplotlib.figure import Figure

    drawn = [pair for pair in pairs if pair.curve is not None]
    if not drawn:
        raise StreamError("no pair of streams goes together, so that there is nothing to draw; leave --picture out")
    figure = Figure(figsize=(9, 2.6 * len(drawn)), layout="constrained")
    for axes, pair in zip(np.atleast_1d(figure.subplots(len(drawn), 1)), drawn, strict=True):
        assert pair.curve is not None
        axes.plot(1e3 * pair.curve.lag_s, pair.curve.correlation, lw=1)
        axes.axvline(pair.offset.offset_ns / 1e6, color="tab:red", lw=1)
        axes.axhline(0.0, color="0.8", lw=0.5)
        axes.set_title(f"{pair.camera} and {pair.sensor}: {pair.signals}", fontsize=9)
        axes.set_ylabel("correlation")
        axes.set_ylim(-1.05, 1.05)
    axes.set_xlabel("ms added to the times of the camera")
    figure.savefig(file, dpi=110, metadata={"Software": None})
