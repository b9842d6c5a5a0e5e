"""What the presets make of a drive: one pass over its frames for all of them; frames that are rendered once."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pipelines.correlation.equations import Motion
from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import Correction, CorrelationSettings
from pipelines.correlation.step import CorrelationStep
from pipelines.correlation.trajectory import Pose, Segment, corrected, integrated
from pipelines.estimator import Step
from pipelines.geometry import Floats
from pipelines.replay import grey_sample
from readers.streams import Camera, ImageSample, Recording, Sample, StreamInfo, StreamKind
from workbench.reproduce.conditions import METRES_PER_PX, SPEED_MPS
from workbench.reproduce.tasks import Tick
from workbench.settings import plugin, resolve


def settings_of(preset: str, start: Floats, overrides: Sequence[str] = ()) -> CorrelationSettings:
    """A preset with the experiment's W and the true start pose; `overrides` are ``key=value``, as of ``--set``.

    Raises:
        SettingsError: an override has an unknown key or a wrong value.
    """
    values = resolve(plugin("correlation"), preset=preset, overrides=overrides).settings.model_dump()
    fixed = {"metres_per_px": METRES_PER_PX, "start_pose": tuple(float(x) for x in start)}
    return CorrelationSettings.model_validate(
        {**values, **{k: v for k, v in fixed.items() if not _given(k, overrides)}}
    )


def _given(key: str, overrides: Sequence[str]) -> bool:
    return any(text.partition("=")[0].strip() == key for text in overrides)


class Estimate(NamedTuple):
    """What an estimator says: shifts [n - 1, 2] in px and turns [n - 1] in rad between frames, poses [n, 3]."""

    shift_px: Floats
    turn_rad: Floats
    pose: Floats


class Notes:
    """Collects what an `Estimate` is made of, step by step."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def add(self, step: Step) -> None:
        """Take note of the step of one frame."""
        assert isinstance(step, CorrelationStep)
        self._rows.append((*step.frame_shift_px, step.delta_heading_rad, *step.pose))

    def estimate(self) -> Estimate:
        """All steps together; headings go on over full turns."""
        rows = np.array(self._rows)
        rows[:, 5] = np.unwrap(rows[:, 5])
        return Estimate(rows[1:, :2], rows[1:, 2], rows[:, 3:])


def estimates(
    recording: Recording, settings: Mapping[str, CorrelationSettings], tick: Tick = lambda: None
) -> dict[str, Estimate]:
    """Give every frame, which is made once, to an estimator of each of the settings."""
    odometries = {name: CorrelationOdometry(s) for name, s in settings.items()}
    states = {name: odometry.start() for name, odometry in odometries.items()}
    notes = {name: Notes() for name in settings}
    (images,) = (info.name for info in recording.of_kind(StreamKind.IMAGE))
    for sample in recording.read([images]):
        assert isinstance(sample, ImageSample)
        decoded = grey_sample(sample)
        for name, odometry in odometries.items():
            states[name], step = odometry.step(states[name], decoded)
            assert step is not None
            notes[name].add(step)
        tick()
    return {name: note.estimate() for name, note in notes.items()}


# ------------------------------------------------------------------------------ correction


def variants(settings: CorrelationSettings) -> dict[str, CorrelationSettings]:
    """Paper A's settings without correction and with its two readings, by what they are called here."""
    on = {"correction_speed_mps": SPEED_MPS}
    return {
        "none": settings.model_copy(update={"correction": Correction.OFF}),
        "speed prior": settings.model_copy(update={"correction": Correction.SPEED_PRIOR, **on}),
        "as printed": settings.model_copy(update={"correction": Correction.AS_PRINTED, **on}),
    }


def dead_reckoned(settings: CorrelationSettings, shift_px: Floats, turn_rad: Floats, dt_s: Floats) -> Floats:
    """Poses [n, 3] that measured shifts [n - 1, 2] and turns [n - 1], `dt_s` [n - 1] apart, come to.

    The estimator's own integration and correction, without images; the first pose is that of the settings.
    """
    assert settings.metres_per_px is not None
    pose: Pose = settings.start_pose
    segment, total = Segment(), np.zeros(2)
    path = [pose]
    for (u, v), turn, dt in zip(shift_px.tolist(), turn_rad.tolist(), dt_s.tolist(), strict=True):
        before = pose
        pose, _, path_m = integrated(settings, before, Motion(u, v, turn), settings.metres_per_px)
        segment = corrected(settings, segment, before, pose, path_m, dt)
        total += segment.applied_m
        path.append((pose[0] + total[0], pose[1] + total[1], pose[2]))
    poses = np.array(path)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses


# -------------------------------------------------------------------- frames, rendered once


class RenderedOnce(Recording):
    """A recording whose images of one stream are made once and kept in a file, for several replays.

    The file takes one byte a pixel; it is removed when the recording is closed.

    Args:
        inner: the recording; its images are ``mono8`` without padding, all of one size.
        file: where the images are kept.
        identity: what makes the recording the one that it is.
    """

    def __init__(self, inner: Recording, file: Path, identity: str) -> None:
        self.path, self.format, self.notes = inner.path, inner.format, inner.notes
        (info,) = inner.of_kind(StreamKind.IMAGE)
        camera = inner.cameras[info.name]
        self._inner, self._images, self._file, self._identity = inner, info.name, file, identity
        self._slots: dict[int, int] = {}
        self._there = np.zeros(info.count, dtype=bool)
        self._pixels = np.memmap(file, np.uint8, "w+", shape=(info.count, camera.height_px * camera.width_px))

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        """Those of the recording."""
        return self._inner.streams

    @property
    def cameras(self) -> dict[str, Camera]:
        """Those of the recording."""
        return self._inner.cameras

    @property
    def identity(self) -> str:
        """As it was given."""
        return self._identity

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        """Those of the recording; an image's bytes come from the file from the second time on."""
        for sample in self._inner.read(streams, start_ns, stop_ns):
            if isinstance(sample, ImageSample) and sample.stream == self._images:
                yield dataclasses.replace(sample, payload=partial(self._kept, self._slot(sample.t_ns), sample))
            else:
                yield sample

    def lent(self) -> Recording:
        """The same frames for a reader who closes what it has read."""
        other = copy.copy(self)
        other.close = lambda: None  # type: ignore[method-assign]
        return other

    def close(self) -> None:
        """Remove the file."""
        self._inner.close()
        self._file.unlink(missing_ok=True)

    def _slot(self, t_ns: int) -> int:
        return self._slots.setdefault(t_ns, len(self._slots))

    def _kept(self, slot: int, sample: ImageSample) -> memoryview:
        if not self._there[slot]:
            self._pixels[slot] = np.frombuffer(sample.data, np.uint8)
            self._there[slot] = True
        return np.asarray(self._pixels[slot]).data.cast("B")
