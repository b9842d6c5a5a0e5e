"""A small recording in memory and an estimator that only counts, for tests of the replay and the session."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from pipelines.estimator import Step, quantity
from pipelines.verdict import Verdict
from readers.streams import (
    ImageError,
    ImageSample,
    Problem,
    RangeSample,
    Recording,
    Sample,
    StreamError,
    StreamInfo,
    StreamKind,
)

SIZE = (3, 4)


class ToyImage(ImageSample):
    """An image of constant grey; it is damaged where its bytes are empty."""

    __slots__ = ()

    def grey(self) -> NDArray[np.uint8]:
        if not self.data:
            raise ImageError(f"{self.source}: no bytes")
        return np.frombuffer(self.data, np.uint8).reshape(self.height_px, self.width_px)


def image(t_ns: int, value: int = 0, *, damaged: bool = False, stream: str = "/camera") -> ToyImage:
    return ToyImage(
        stream=stream,
        t_ns=t_ns,
        received_ns=t_ns + 5,
        encoding="mono8",
        payload=b"" if damaged else bytes([value]) * (SIZE[0] * SIZE[1]),
        width_px=SIZE[1],
        height_px=SIZE[0],
        source=f"image at {t_ns}",
    )


class ToyRecording(Recording):
    """Samples from a list; `fail_at` raises in place of that sample."""

    format = "toy"

    def __init__(
        self,
        samples: Sequence[Sample],
        kinds: dict[str, StreamKind] | None = None,
        fail_at: int = -1,
        error: Exception | None = None,
    ) -> None:
        self.path = Path("toy")
        self._samples = samples
        self._kinds = kinds or {"/camera": StreamKind.IMAGE}
        self._fail_at, self._error = fail_at, error
        self.read_samples = 0

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        return tuple(self._info(name, kind) for name, kind in sorted(self._kinds.items()))

    def _info(self, name: str, kind: StreamKind) -> StreamInfo:
        times = [s.received_ns for s in self._samples if s.stream == name]
        first, last = (min(times), max(times)) if times else (-1, -1)
        return StreamInfo(name=name, kind=kind, type="toy", count=len(times), first_ns=first, last_ns=last)

    def read(
        self, streams: Sequence[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Sample]:
        for name in streams or ():
            if name not in self._kinds:
                raise StreamError(name)
        for number, sample in enumerate(self._samples):
            if number == self._fail_at and self._error is not None:
                raise self._error
            inside = (start_ns is None or sample.t_ns >= start_ns) and (stop_ns is None or sample.t_ns < stop_ns)
            if inside and (streams is None or sample.stream in streams):
                self.read_samples += 1
                yield sample


class ToySettings(BaseModel):
    """Settings of the toy estimator."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    bias: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ToyStep(Step):
    mean: float = quantity("grey", "mean grey level")
    steps_before: int = quantity("1", "steps so far")


class ToyEstimator:
    """Takes the mean of every frame; `explode_at` raises at that frame."""

    name: ClassVar[str] = "toy"
    step_type: ClassVar[type[Step]] = ToyStep
    kinds: ClassVar[tuple[StreamKind, ...]] = (StreamKind.IMAGE,)

    def __init__(self, explode_at: int = -1, seen: Callable[[Sample], None] | None = None) -> None:
        self.settings = ToySettings()
        self.explode_at = explode_at
        self.seen = seen or (lambda sample: None)
        self.threads: set[int] = set()

    def start(self) -> int:
        return 0

    def step(self, state: int, sample: Sample, /) -> tuple[int, ToyStep | None]:
        self.seen(sample)
        self.threads.add(threading.get_ident())
        if not isinstance(sample, ImageSample | Problem):
            return state, None
        if sample.frame == self.explode_at:
            raise ZeroDivisionError("toy")
        damaged = isinstance(sample, Problem)
        verdict = Verdict.UNDECODABLE if damaged else Verdict.OK
        mean = float("nan") if damaged else float(np.frombuffer(sample.data, np.uint8).mean())
        return state + 1, ToyStep(
            frame=sample.frame,
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            verdict=verdict,
            alarms=verdict,
            mean=mean,
            steps_before=state,
        )


class WalkSettings(BaseModel):
    """The settings of the walking estimator that concern the session."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    metres_per_px: float | None = None
    focal_px: float | None = None
    height_m: float | None = None
    height_stream: str = ""
    height_offset_m: float = 0.0
    start_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed_px: float = 10.0

    @classmethod
    def presets(cls) -> tuple[str, ...]:
        return ("best", "slow")

    @classmethod
    def preset(cls, name: str) -> WalkSettings:
        return cls(speed_px={"best": 10.0, "slow": 5.0}[name])


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkStep(Step):
    accepted: bool = quantity("1", "whether the motion was measured")
    pose: NDArray[np.float64] = quantity("m, m, rad", "x, y, heading", 3)


class WalkingEstimator:
    """Walks `speed_px` pixels a frame along its start heading, times the price of a pixel."""

    name: ClassVar[str] = "toy"
    step_type: ClassVar[type[Step]] = WalkStep
    kinds: ClassVar[tuple[StreamKind, ...]] = (StreamKind.IMAGE, StreamKind.RANGE)

    def __init__(self, settings: WalkSettings) -> None:
        self.settings = settings

    def start(self) -> tuple[int, float]:
        return 0, self.settings.height_m or float("nan")

    def step(self, state: tuple[int, float], sample: Sample, /) -> tuple[tuple[int, float], WalkStep | None]:
        steps, height_m = state
        if isinstance(sample, RangeSample):
            return (steps, sample.range_m), None
        if not isinstance(sample, ImageSample | Problem):
            return state, None
        s = self.settings
        w = s.metres_per_px if s.metres_per_px is not None else height_m / (s.focal_px or float("nan"))
        x, y, heading = s.start_pose
        way = steps * s.speed_px * w
        damaged = isinstance(sample, Problem)
        verdict = Verdict.UNDECODABLE if damaged else Verdict.FIRST_FRAME if steps == 0 else Verdict.OK
        step = WalkStep(
            frame=sample.frame,
            t_ns=sample.t_ns,
            received_ns=sample.received_ns,
            verdict=verdict,
            alarms=verdict,
            accepted=verdict is Verdict.OK,
            pose=np.array([x + way * np.cos(heading), y + way * np.sin(heading), heading]),
        )
        return (steps + 1, height_m), step
