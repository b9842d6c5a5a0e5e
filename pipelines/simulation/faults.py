"""What can go wrong in a simulated mission, by name; the list of it is part of the mission's truth.

Times are seconds since the start of the mission, ranges are half-open. A fault is data: the part of the
simulator that it concerns looks for its own kinds in the list and acts on them.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

from pipelines.simulation.checks import check

FAULTS_STREAM = "/truth/faults"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """Something that is wrong from `start_s` to before `stop_s`.

    Raises:
        ValueError: a number is not finite, or breaks its rule (see `checks`).
    """

    rules: ClassVar[Mapping[str, str]] = {}

    start_s: float
    stop_s: float

    def __post_init__(self) -> None:
        numbers = [f.name for f in dataclasses.fields(self) if isinstance(getattr(self, f.name), float | int | tuple)]
        check(self, "a finite number", *(name for name in numbers if name != "in_view_s"))
        for name, rule in self.rules.items():
            check(self, rule, name)

    @property
    def name(self) -> str:
        """Name of the kind of fault, such as ``motion-blur``."""
        return name_of(type(self))

    def holds(self, t_s: float) -> bool:
        """Whether the fault is there at that time."""
        return self.start_s <= t_s < self.stop_s


# ---- the ground


@dataclass(frozen=True, slots=True, kw_only=True)
class RepetitiveTexture(Fault):
    """The image centre is over a pattern that repeats itself: `tiles` both ways, `stripes` one way.

    It reaches `margin_m` to both sides of the way. In a mission's truth there is one fault for every time that
    the way leads over it, with the rectangle `area_m` (x_min, x_max, y_min, y_max) that it covers, and `in_view_s`,
    the intervals in which any of it is in view.
    """

    rules: ClassVar = {"period_px": "an even number above 0", "margin_m": "0 or more"}

    pattern: Literal["tiles", "stripes"] = "tiles"
    period_px: int = 8
    margin_m: float = 0.3
    area_m: tuple[float, float, float, float] | None = None
    in_view_s: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class LowTexture(Fault):
    """The image centre is over ground of a gradient of `gradient_rms` grey levels per px along an axis.

    Place and times are those of `RepetitiveTexture`.
    """

    rules: ClassVar = {"gradient_rms": "0 or more", "margin_m": "0 or more"}

    gradient_rms: float = 0.4
    margin_m: float = 0.3
    area_m: tuple[float, float, float, float] | None = None
    in_view_s: tuple[tuple[float, float], ...] = ()


# ---- the motion


@dataclass(frozen=True, slots=True, kw_only=True)
class ShiftJump(Fault):
    """The vehicle is pushed aside by (forward, left) within `ramp_s`, and back before the end."""

    forward_m: float = 0.0
    left_m: float = 0.0
    ramp_s: float = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class TurnJump(Fault):
    """The vehicle is turned about its origin by `turn_rad` within `ramp_s`, and back before the end."""

    turn_rad: float
    ramp_s: float = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class HeightChange(Fault):
    """The vehicle's origin is lifted by `lift_m` within `ramp_s`, and let down before the end."""

    lift_m: float
    ramp_s: float = 0.5


# ---- the images


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionBlur(Fault):
    """The shutter stays open for `exposure` of the frame interval, about the frame's time."""

    rules: ClassVar = {"exposure": "a share within 0 and 1", "samples": "a whole number above 0"}

    exposure: float
    samples: int = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureJump(Fault):
    """The images are `gain` times as bright, plus `offset_grey`."""

    rules: ClassVar = {"gain": "0 or more"}

    gain: float
    offset_grey: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNoise(Fault):
    """The standard deviation of the image noise is `noise_grey`."""

    rules: ClassVar = {"noise_grey": "0 or more"}

    noise_grey: float = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LensDirt(Fault):
    """A fixed pattern lies over the images with the weight `share`, 0…1."""

    rules: ClassVar = {"share": "a share within 0 and 1"}

    share: float = 0.35


@dataclass(frozen=True, slots=True, kw_only=True)
class DroppedFrames(Fault):
    """The images never arrive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DuplicateFrames(Fault):
    """The last image before is sent again and again, with stamps of its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LateImages(Fault):
    """The images are stamped `latency_s` after they were taken."""

    rules: ClassVar = {"latency_s": "0 or more"}

    latency_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SwappedStamps(Fault):
    """Neighbouring images carry each other's stamps."""


# ---- pixel tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSlip(Fault):
    """The track of one landmark moves to another point of the scene, `offset_px` (u, v) away."""

    track: int
    offset_px: tuple[float, float] = (5.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackOutliers(Fault):
    """A `share` of the tracked points is off by up to `size_px` in u and v."""

    rules: ClassVar = {"share": "a share within 0 and 1", "size_px": "0 or more"}

    share: float = 0.05
    size_px: float = 50.0


# ---- calibration and sensors


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongCalibration(Fault):
    """The calibration that is sent differs from the camera: focal length times `focal_factor`, centre moved."""

    rules: ClassVar = {"focal_factor": "above 0"}

    focal_factor: float = 1.0
    centre_px: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometerScale(Fault):
    """The wheel odometer's speed is `factor` times the true one (a wrong wheel radius, slip)."""

    factor: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GyroBias(Fault):
    """The IMU's angular velocity is off by `bias_radps` about x, y, z of the body."""

    bias_radps: tuple[float, float, float]


# ---------------------------------------------------------------------------- by name, as text


def name_of(kind: type[Fault]) -> str:
    """Name of a kind of fault: the class's name in lower case with dashes."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", kind.__name__).lower()


FAULTS: Mapping[str, type[Fault]] = {
    name_of(kind): kind
    for kind in (
        RepetitiveTexture,
        LowTexture,
        ShiftJump,
        TurnJump,
        HeightChange,
        MotionBlur,
        ExposureJump,
        ImageNoise,
        LensDirt,
        DroppedFrames,
        DuplicateFrames,
        LateImages,
        SwappedStamps,
        TrackSlip,
        TrackOutliers,
        WrongCalibration,
        OdometerScale,
        GyroBias,
    )
}

F = TypeVar("F", bound=Fault)


def of_kind(faults: Iterable[Fault], kind: type[F]) -> tuple[F, ...]:
    """The faults of one kind."""
    return tuple(fault for fault in faults if isinstance(fault, kind))


@dataclass(frozen=True, slots=True)
class FaultRecord:
    """One fault as a recording carries it: from `start_ns` to before `stop_ns` of true time."""

    name: str
    start_ns: int
    stop_ns: int
    parameters: Mapping[str, Any]


def to_text(faults: Sequence[Fault], start_ns: int, scenario: Mapping[str, Any]) -> str:
    """The list of faults of a mission that starts at `start_ns`, with its scenario, as JSON."""
    records = [
        {
            "name": fault.name,
            "start_ns": start_ns + round(fault.start_s * 1e9),
            "stop_ns": start_ns + round(fault.stop_s * 1e9),
            "parameters": {k: v for k, v in dataclasses.asdict(fault).items() if k not in ("start_s", "stop_s")},
        }
        for fault in faults
    ]
    return json.dumps({"faults": records, "scenario": dict(scenario)}, sort_keys=True)


def from_text(text: str) -> tuple[FaultRecord, ...]:
    """The list of faults that `to_text` wrote.

    Raises:
        ValueError: the text is not such a list.
    """
    try:
        return tuple(FaultRecord(**record) for record in json.loads(text)["faults"])
    except (TypeError, KeyError) as error:
        raise ValueError(f"this is no list of faults ({error})") from error
