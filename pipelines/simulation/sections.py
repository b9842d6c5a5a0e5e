"""The sections of a scenario: everything that can be set, each with its default and what it is.

SI units and radians, but for the speed, which is in km/h as the papers have it. Sensors and clocks are the
dataclasses of `sensors` and `timing` themselves; their attributes are the keys.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    field_validator,
    model_validator,
)

from pipelines.simulation.faults import FAULTS, Fault
from pipelines.simulation.motion import Hold
from pipelines.simulation.sensors import Gnss, Height, Imu, Odometer, Reference, Tracks
from pipelines.simulation.surfaces import PAPER_METRES_PER_PX, PSF_SIGMA_PX
from pipelines.simulation.timing import Timing

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(gt=0)]
Triple = tuple[Finite, Finite, Finite]
Parameters = dict[str, Any]

PAPER_HEIGHT_M, PAPER_FOCAL_PX, PAPER_SIDE_PX = 0.2002, 256.0, 512


class Section(BaseModel):
    """Settings that belong together; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


# ------------------------------------------------------------------- dataclasses as sections


def hint(wrong: str, known: list[str]) -> str:
    """What a wrong name may have meant, or what there is."""
    near = difflib.get_close_matches(wrong, known, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(near)}?" if near else f"known are: {', '.join(known)}"


def _completed(kind: type, values: Any, usual: Mapping[str, Any]) -> Any:
    """The values of a dataclass, those left out as `usual`; in a dataclass within it they are its default's.

    Raises:
        ValueError: a key that the dataclass does not have.
    """
    if not isinstance(values, Mapping):
        return values
    types, defaults = get_type_hints(kind), {field.name: field.default for field in dataclasses.fields(kind)}
    complete = {**usual, **values}
    for key, value in values.items():
        if key not in types:
            raise ValueError(f"unknown key {key!r}; {hint(str(key), list(types))}")
        default = defaults[key]
        if dataclasses.is_dataclass(default) and not isinstance(default, type):
            complete[key] = _completed(types[key], value, dataclasses.asdict(default))
    return complete


def _known(kind: type, **usual: Any) -> BeforeValidator:
    return BeforeValidator(lambda values: _completed(kind, values, usual))


Clock = Annotated[Timing, _known(Timing)]


# ---------------------------------------------------------------------------------- faults


def fault_of(values: Any) -> Fault:
    """The fault that a table ``{kind, start_s, stop_s, …}`` names.

    Raises:
        ValueError: no such kind or parameter, or a value that does not fit.
    """
    if isinstance(values, Fault):
        return values
    if not isinstance(values, Mapping) or "kind" not in values:
        raise ValueError('a fault is a table such as { kind = "exposure-jump", start_s = 1, stop_s = 2, gain = 1.4 }')
    name, parameters = values["kind"], {key: value for key, value in values.items() if key != "kind"}
    if name not in FAULTS:
        raise ValueError(f"no fault is named {name!r}; {hint(str(name), list(FAULTS))}")
    kind = FAULTS[name]
    try:
        fault = TypeAdapter(kind).validate_python(_completed(kind, parameters, {}))
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "value_error":
            raise ValueError(f"{name}: {str(first['ctx']['error']).partition(': ')[2]}") from None
        raise ValueError(f"{name}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if not 0 <= fault.start_s < fault.stop_s:
        raise ValueError(f"{name}: from {fault.start_s} to {fault.stop_s} s: 0 <= start_s < stop_s is needed")
    return fault


def fault_values(fault: Fault) -> dict[str, Any]:
    """The table that makes the fault; parameters without a value are left out."""
    values = {key: value for key, value in dataclasses.asdict(fault).items() if value is not None}
    return {"kind": fault.name, **values}


AnyFault = Annotated[Any, PlainValidator(fault_of), PlainSerializer(fault_values)]


# -------------------------------------------------------------------------------- sections


class Ground(Section):
    """The ground at z = 0."""

    family: str = Field("gravel", description="family of the texture: gravel, wood, … (docs/simulation-surfaces.md)")
    contrast: Positive | None = Field(None, description="gradient rms, grey levels per px; otherwise the family's own")
    repetition: Share | None = Field(None, description="share of it that repeats; otherwise the family's own")
    spectrum: NotNegative | None = Field(None, description="β of its spectrum ~ f^-β; otherwise the family's own")
    size_px: Count = Field(1024, description="side of the picture that the ground is laid of, a multiple of 256")
    picture: str = Field("", description="picture file that the ground is made of, in place of a family")
    arrange: Literal["mirror", "scatter"] = Field("scatter", description="how the picture becomes endless ground")
    psf_sigma_px: NotNegative = Field(PSF_SIGMA_PX, description="softness of a picture, px")
    metres_per_px: Positive = Field(PAPER_METRES_PER_PX, description="what a pixel of the texture measures, m")
    relief_height_m: NotNegative = Field(0.0, description="standard deviation of bumps of the ground")
    relief_correlation_m: Positive = Field(0.05, description="their correlation length")


class Leg(Section):
    """A piece of a way from standstill to standstill: a drive, a turn on the spot, or a stop."""

    drive_m: Finite | None = Field(None, description="a drive of that length; negative goes back in reverse")
    turn_rad: Finite | None = Field(None, description="a turn on the spot; positive to the left")
    stop_s: Positive | None = Field(None, description="a stop of that time")
    curve: str = Field("line", description="what is driven along, see curves.py")
    parameters: Parameters = Field({}, description="parameters of the curve")
    acceleration_mps2: Positive = Field(0.5, description="of a drive, up to speed_kmh and down again")
    turn_s: Positive = Field(2.0, description="time of a turn")

    @model_validator(mode="after")
    def _one_thing(self) -> Leg:
        given = [key for key in ("drive_m", "turn_rad", "stop_s") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"a leg has one of drive_m, turn_rad and stop_s, here: {', '.join(given) or 'none'}")
        return self


class Trajectory(Section):
    """The way of the vehicle's turning point, and how fast it goes along it."""

    curve: str = Field("figure-eight", description="name of the curve: line, circle, lanes, … (docs/scenarios.md)")
    parameters: Parameters = Field({}, description="parameters of the curve")
    speed_kmh: Finite = Field(2.0, description="speed, km/h; negative drives in reverse")
    profile: str = Field("jitter", description="how the speed varies: constant, jitter, … (docs/scenarios.md)")
    profile_parameters: Parameters = Field({}, description="parameters of the profile")
    stops: tuple[tuple[Finite, Finite], ...] = Field((), description="stops: time at which each begins, and length, s")
    stop_ramp_s: Positive = Field(0.5, description="time of slowing down before and of speeding up after a stop")
    sideslip_rad: Finite = Field(0.0, description="angle from the heading to the direction of travel, to the left")
    sideslip_rms_rad: NotNegative = Field(0.0, description="standard deviation of the sideslip about that")
    sideslip_tau_s: Positive = Field(0.5, description="its correlation time")
    legs: tuple[Leg, ...] = Field(
        (), description="pieces in place of curve and profile: a drive_m, turn_rad or stop_s each"
    )
    rounds: Count = Field(1, description="how often the legs are driven")

    @model_validator(mode="after")
    def _either_legs_or_a_profile(self) -> Trajectory:
        if self.legs and (self.stops or self.sideslip_rms_rad):
            raise ValueError("legs stop by themselves, with a steady sideslip: leave stops and sideslip_rms_rad out")
        if self.legs and self.speed_kmh <= 0:
            raise ValueError("legs are driven at a positive speed_kmh; a negative drive_m goes back in reverse")
        return self


class Fluctuation(Section):
    """Random roll, pitch and height of the body: standard deviations, correlation times and offsets."""

    height_rms_m: NotNegative = Field(0.0, description="standard deviation of the height")
    height_tau_s: Positive = Field(0.5, description="its correlation time")
    roll_rms_rad: NotNegative = Field(0.0, description="standard deviation of the roll")
    roll_tau_s: Positive = Field(0.3, description="its correlation time")
    roll_rad: Finite = Field(0.0, description="constant roll; positive lifts the left side")
    pitch_rms_rad: NotNegative = Field(0.0, description="standard deviation of the pitch")
    pitch_tau_s: Positive = Field(0.3, description="its correlation time")
    pitch_rad: Finite = Field(0.0, description="constant pitch; positive lowers the nose")


class CameraSection(Section):
    """What the cameras have in common."""

    width_px: Count = Field(PAPER_SIDE_PX, description="columns of the image")
    height_px: Count = Field(PAPER_SIDE_PX, description="rows of the image")
    focal_px: Positive = Field(PAPER_FOCAL_PX, description="focal length")
    distortion_model: str = Field("plumb_bob", description="lens: none, plumb_bob, rational_polynomial, equidistant")
    distortion: tuple[Finite, ...] = Field((), description="its coefficients; those left out are 0")
    timing: Annotated[Timing, _known(Timing, rate_hz=60.0)] = Field(
        Timing(rate_hz=60.0), description="when it takes pictures, and what becomes of them"
    )
    height_m: Positive = Field(PAPER_HEIGHT_M, description="height above the ground, the body being level")
    ahead_m: Finite = Field(0.0, description="how far it sits ahead of the turning point")
    left_m: Finite = Field(0.0, description="how far it sits to the left of the turning point")
    yaw_rad: Finite = Field(0.0, description="mounting about body z, counter-clockwise from above")
    pitch_rad: Finite = Field(0.0, description="mounting about body y; positive lowers what is ahead")
    roll_rad: Finite = Field(0.0, description="mounting about body x")
    hold: Hold = Field(Hold.RIGID, description="rigid, levelled (2-axis gimbal) or gimballed (keeps its heading)")
    noise_grey: NotNegative = Field(2.0, description="standard deviation of the noise, grey levels")
    vignetting: Share = Field(0.0, description="fall of brightness in the image corners")
    exposure_s: NotNegative = Field(0.0, description="how long the shutter is open")
    readout_s: NotNegative = Field(0.0, description="rolling shutter: from the first row to the last")

    @field_validator("timing", mode="before")
    @classmethod
    def _over_the_usual_timing(cls, values: Any) -> Any:
        usual = dataclasses.asdict(cls.model_fields["timing"].default)
        return usual | dict(values) if isinstance(values, Mapping) else values


class DownCamera(CameraSection):
    """A camera that looks at the ground; the defaults are paper A's."""


class FrontCamera(CameraSection):
    """A camera that looks ahead; the defaults are like paper B's."""

    width_px: Count = Field(640, description="columns of the image")
    height_px: Count = Field(480, description="rows of the image")
    focal_px: Positive = Field(500.0, description="focal length")
    timing: Annotated[Timing, _known(Timing, rate_hz=5.0)] = Field(
        Timing(rate_hz=5.0), description="when it takes pictures, and what becomes of them"
    )
    height_m: Positive = Field(0.6, description="height above the ground, the body being level")


class Chessboard(Section):
    """A chessboard that stands upright."""

    columns: Count = Field(8, description="inner corners in a row")
    rows: Count = Field(6, description="rows of inner corners")
    square_m: Positive = Field(0.1, description="side of a square")
    position_m: Triple = Field((8.0, 0.0, 0.8), description="its centre in the world")
    facing_rad: Finite = Field(3.141592653589793, description="heading that it faces; π towards -x")


class Surroundings(Section):
    """What stands around for the front camera."""

    landmarks_m: tuple[Triple, ...] = Field((), description="points in the world that are tracked")
    poster_m: NotNegative = Field(0.3, description="side of the poster at each landmark; 0 for none")
    chessboard: Chessboard | None = Field(None, description="a chessboard; its corners are tracked too, after those")
    background_grey: Finite = Field(170.0, description="grey level where there is nothing")


AnyImu = Annotated[Imu, _known(Imu)]
AnyOdometer = Annotated[Odometer, _known(Odometer)]
AnyReference = Annotated[Reference, _known(Reference)]
AnyHeight = Annotated[Height, _known(Height)]
AnyGnss = Annotated[Gnss, _known(Gnss)]
AnyTracks = Annotated[Tracks, _known(Tracks)]


# ---------------------------------------------------------------------------- descriptions


def is_section(value: Any) -> bool:
    """Whether a value of a scenario has keys of its own with meanings."""
    return isinstance(value, BaseModel) or (dataclasses.is_dataclass(value) and not isinstance(value, Fault | type))


def entry_values(value: Any) -> list[dict[str, Any]]:
    """What is set in each of the faults or legs of a scenario; empty for a value that is no list of them."""
    if not isinstance(value, tuple):
        return []
    faults = [fault_values(entry) for entry in value if isinstance(entry, Fault)]
    return faults + [entry.model_dump(exclude_defaults=True) for entry in value if isinstance(entry, Section)]


def meanings(kind: type) -> dict[str, str]:
    """What the keys of a section or of a sensor's dataclass are, by key."""
    if issubclass(kind, BaseModel):
        return {name: info.description or "" for name, info in kind.model_fields.items()}
    text = (kind.__doc__ or "").partition("Attributes:")[2].partition("Raises:")[0]
    entries = re.findall(r"^ {8}(\w+): (.*(?:\n {12}.*)*)", text, re.MULTILINE)
    return {name: " ".join(words.split()).rstrip(".") for name, words in entries}
