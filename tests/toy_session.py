"""Toy parts for a whole session: a recording that opens by name, and writers that keep lines of text.

Run as ``python -m tests.toy_session ARGUMENTS…`` it is the command line with these parts in place of the real ones.
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import workbench.opening
import workbench.session
import workbench.settings
from pipelines.estimator import Step
from pipelines.geometry import quat_of_heading
from pipelines.verdict import Severity
from readers.streams import (
    UNKNOWN_COV6,
    Camera,
    Damage,
    ImageSample,
    PoseSample,
    RangeSample,
    ReadOptions,
    RecordingError,
    Sample,
    StreamKind,
    array,
)
from tests.toys import SIZE, ToyRecording, WalkingEstimator, WalkSettings, image
from workbench.session import Writers
from workbench.settings import Plugin

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
KINDS = {
    "/camera": StreamKind.IMAGE,
    "/truth": StreamKind.POSE,
    "/range": StreamKind.RANGE,
    "/imu": StreamKind.IMU,
}


class ToyMission(ToyRecording):
    """A walk at 1 m/s along x with turns: n frames at 10 Hz, the true pose, a range of 2 m."""

    def __init__(self, n: int = 40, *, slow_s: float = 0.0, camera: Camera | None = None, **options: Any) -> None:
        samples: list[Sample] = []
        for k in range(n):
            t = START + k * SECOND // 10
            samples += [pose(t, k / 10, 0.1 * math.sin(k / 10)), height(t, 2.0), image(t, k % 256)]
        kinds = options.pop("kinds", KINDS)
        super().__init__([s for s in samples if s.stream in kinds], kinds, **options)
        self.slow_s, self._camera = slow_s, camera
        self.damage_found: tuple[Damage, ...] = ()

    @property
    def cameras(self) -> dict[str, Camera]:
        return {} if self._camera is None else {"/camera": self._camera}

    @property
    def damage(self) -> tuple[Damage, ...]:
        return self.damage_found

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        for sample in super().read(streams, start_ns, stop_ns):
            if self.slow_s and isinstance(sample, ImageSample):
                time.sleep(self.slow_s)
            yield sample


def pose(t_ns: int, x: float, heading: float) -> PoseSample:
    return PoseSample(
        stream="/truth",
        t_ns=t_ns,
        received_ns=t_ns,
        position_m=array(x, 5.0, 0.7),
        quat_xyzw=quat_of_heading(heading),
        covariance=UNKNOWN_COV6,
    )


def height(t_ns: int, value: float) -> RangeSample:
    return RangeSample(
        stream="/range",
        t_ns=t_ns,
        received_ns=t_ns,
        range_m=value,
        min_range_m=0.0,
        max_range_m=9.0,
        field_of_view_rad=0.1,
    )


def calibrated(focal_px: float = 200.0, width_px: int = SIZE[1], height_px: int = SIZE[0]) -> Camera:
    return Camera(
        width_px=width_px,
        height_px=height_px,
        matrix=array([focal_px, 0, 2], [0, focal_px, 1.5], [0, 0, 1]),
        distortion_model="plumb_bob",
        distortion=array(0.1, 0, 0, 0, 0),
        rectification=np.eye(3),
        projection=np.zeros((3, 4)),
    )


# --------------------------------------------------------------------------------- writers


class TextLog:
    """Keeps what it is told as lines of a text file, flushed at once."""

    made: list[TextLog] = []  # noqa: RUF012

    def __init__(self, path: Path, **options: Any) -> None:
        self.path, self.options, self.closed = path, options, False
        self._file = path.open("w", buffering=1)
        TextLog.made.append(self)

    def _say(self, *words: object) -> None:
        assert not self.closed
        print(*words, file=self._file)

    def close(self) -> None:
        self.closed = True
        self._file.close()

    @property
    def lines(self) -> list[str]:
        return self.path.read_text().splitlines()


class ToySensors(TextLog):
    def image(self, frame: int, sample: ImageSample) -> None:
        self._say("image", frame, sample.t_ns, bytes(sample.data).hex())

    def sample(self, original: Sample, decoded: Sample) -> None:
        self._say("sample", original.stream, original.t_ns)

    def undecodable(self, frame: int, t_ns: int, reason: str) -> None:
        self._say("undecodable", frame, t_ns, reason)

    def reference(self, poses: Sequence[PoseSample]) -> None:
        self._say("reference", len(poses))

    def facts(self, lines: Sequence[str]) -> None:
        self._say("facts", *lines)


class ToyRun(TextLog):
    def step(self, step: Step, beside: Any = None) -> None:
        self._say("step", step.frame, step.t_ns, step.verdict.name)

    def event(self, frame: int, t_ns: int, severity: Severity, text: str) -> None:
        self._say("event", frame, severity.name, text)

    def errors(self, frames: Any, t_ns: Any, values: Any) -> None:
        assert len(frames) == len(t_ns) == len(values)
        self._say("errors", len(frames), int(frames[0]), int(frames[-1]))

    def smoothed(self, slot: int, frames: Any, t_ns: Any, mean: Any, covariance: Any) -> None:
        self._say("smoothed", slot, len(frames))

    def finish(self, summary: Mapping[str, Any], aligned_path: Any) -> None:
        self._say("finish", None if aligned_path is None else len(aligned_path), *summary)


def toy_rows(file: Path) -> dict[str, int]:
    """The lines of a toy file by their first word."""
    return dict(Counter(f"/{line.partition(' ')[0]}" for line in file.read_text().splitlines()))


WRITERS = Writers(ToySensors, ToyRun, toy_rows)
WALKER = Plugin("toy", WalkSettings, WalkingEstimator)


def open_toy(path: Path, options: ReadOptions) -> ToyMission:
    """Open a toy mission; words in the file's name say what is special about it."""
    if not path.exists():
        raise RecordingError(path, "there is no such file or folder", "check the path")
    words = path.stem.split("-")
    mission = ToyMission(
        n=400 if "long" in words else 40,
        slow_s=0.05 if "slow" in words else 0.0,
        camera=calibrated() if "camera" in words else None,
        kinds={k: v for k, v in KINDS.items() if not ("bare" in words and k != "/camera")},
        fail_at=61 if "torn" in words else -1,
        error=RecordingError(path, "the file ends in the middle", "record again"),
    )
    if "damaged" in words:
        mission.damage_found = (Damage(what="chunk 3 is broken", where="byte 99", affected=0.1),)
    mission.path = path
    return mission


def install() -> None:
    """Put the toys in place of the real parts, for good."""
    workbench.opening.open_any = open_toy
    workbench.session.rerun_writers = lambda: WRITERS
    workbench.settings.BUILT_IN = {"toy": lambda: WALKER}


if __name__ == "__main__":
    from workbench.cli import main

    install()
    sys.exit(main())
