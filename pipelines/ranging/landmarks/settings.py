"""Settings of the landmark sources; every default by name, unknown keys are an error."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal, Self

import cv2
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class LandmarkKind(StrEnum):
    """What the landmarks are found by."""

    AUTO = "auto"
    """By the first frame: recorded tracks, measured bearings, or the corners of an image."""
    TRACKS = "tracks"
    BEARINGS = "bearings"
    CORNERS = "corners"
    CHESSBOARD = "chessboard"
    ARUCO = "aruco"


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TrackSettings(_Frozen):
    """Recorded pixel tracks."""

    sigma_px: Positive = Field(0.5, description="noise of a track per axis, px")


class BearingSettings(_Frozen):
    """Measured bearings, as image points of a camera that looks along the body's x axis."""

    focal_px: Positive = Field(500.0, description="focal length of that camera, px")
    sigma_rad: Positive = Field(0.02, description="noise of a bearing, rad")
    limit_rad: Annotated[float, Field(gt=0, lt=1.57)] = Field(
        1.396, description="bearings farther aside are left out (80°): the image runs to infinity at 90°"
    )


class CornerSettings(_Frozen):
    """Shi-Tomasi corners, tracked by pyramidal Lucas-Kanade from frame to frame; lengths in px of the image."""

    # detection
    max_corners: Annotated[int, Field(ge=1)] = Field(200, description="tracks at a time")
    quality: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.01, description="a corner's smaller eigenvalue of the gradients, of the frame's best"
    )
    min_texture: NotNegative = Field(
        2.0, description="grey levels per px: rms gradient along a corner's weaker direction, below it is no corner"
    )
    min_distance_px: Positive = Field(12.0, description="between a new corner and any other")
    border_px: NotNegative = Field(12.0, description="from the image's edge; a track that comes closer ends")
    grid_columns: Annotated[int, Field(ge=1)] = Field(8, description="cells that the image is divided into")
    grid_rows: Annotated[int, Field(ge=1)] = Field(6, description="… down")
    replenish_below: Fraction = Field(
        0.8, description="share of max_corners under which new ones are looked for; 0: when none is left"
    )

    # tracking
    window_px: Annotated[int, Field(ge=5, le=63)] = Field(
        15, description="side of the window that is tracked, and that a corner is chosen for; odd"
    )
    levels: Annotated[int, Field(ge=0, le=8)] = Field(3, description="halvings of the image; each doubles the reach")
    max_iterations: Annotated[int, Field(ge=1, le=100)] = Field(30, description="of Lucas-Kanade at each level")
    tolerance_px: Positive = Field(0.01, description="the iteration ends below this step")
    min_eigenvalue: NotNegative = Field(1e-4, description="OpenCV's minEigThreshold: a flatter window is lost")
    forward_backward_px: Positive = Field(
        0.3, description="a track that does not come back this close to where it started ends"
    )
    max_residual_grey: Positive = Field(
        20.0, description="mean difference of the window before and after, grey levels, that ends a track"
    )
    exposure_jump: NotNegative = Field(
        0.03, description="relative change of the frame's mean or contrast from which it is evened out; inf: never"
    )

    # noise
    sigma_px: Positive = Field(0.5, description="noise of a point per axis, px")
    sigma_from: Literal["fixed", "residual"] = Field(
        "fixed", description="residual: sigma_px and the forward-backward distance, as a sum of variances"
    )

    @field_validator("window_px")
    @classmethod
    def _odd(cls, side: int) -> int:
        if side % 2 == 0:
            raise ValueError(f"a window's side must be odd, not {side}")
        return side


class BoardSettings(_Frozen):
    """A chessboard; corners are those inside, where four squares meet, numbered row by row from 0."""

    columns: Annotated[int, Field(ge=3)] = Field(9, description="inner corners along a row")
    rows: Annotated[int, Field(ge=3)] = Field(6, description="inner corners along a column")
    square_m: Positive | None = Field(None, description="side of a square, m; None: unknown, no reference range")
    landmarks: Literal["all", "outer"] | tuple[int, ...] = Field(
        "outer", description="corners that are landmarks: all, the four outermost, or their numbers (paper: 0)"
    )
    first: Literal["upper-left", "light", "dark"] = Field(
        "upper-left",
        description="corner 0: at the upper left of the image when the board is first seen, or at the board's light "
        "or dark corner square",
    )
    detector: Literal["lines", "sectors", "either"] = Field(
        "either", description="findChessboardCorners, findChessboardCornersSB, or that where the first finds nothing"
    )
    sigma_px: Positive = Field(0.1, description="noise of a corner per axis, px")

    @model_validator(mode="after")
    def _corners_exist(self) -> Self:
        count = self.columns * self.rows
        for number in self.landmarks if isinstance(self.landmarks, tuple) else ():
            if not 0 <= number < count:
                raise ValueError(f"landmarks: no corner {number}; a board of {count} has 0 to {count - 1}")
        if isinstance(self.landmarks, tuple) and len(set(self.landmarks)) != len(self.landmarks):
            raise ValueError(f"landmarks: a corner is named twice in {self.landmarks}")
        if self.first != "upper-left" and (self.columns + self.rows) % 2 == 0:
            raise ValueError(
                f"first: the corner squares of a board of {self.columns} x {self.rows} corners do not tell its ends "
                "apart; take upper-left, or a board with one odd and one even number"
            )
        return self

    @property
    def numbers(self) -> tuple[int, ...]:
        """The corners that are landmarks."""
        last = self.columns * self.rows - 1
        if self.landmarks == "all":
            return tuple(range(last + 1))
        if self.landmarks == "outer":
            return (0, self.columns - 1, last - self.columns + 1, last)
        return self.landmarks


class MarkerSettings(_Frozen):
    """ArUco markers and AprilTags; corner k of tag t, clockwise from its upper left, is landmark 4 t + k."""

    dictionary: str = Field("4x4_50", description="of the markers: 4x4_50, 6x6_250, apriltag_36h11, …")
    marker_m: Positive | None = Field(
        None, description="side of a marker's black square, m; None: unknown, no reference range"
    )
    columns: Annotated[int, Field(ge=1)] = Field(1, description="markers along a row of the board; 1 x 1: each alone")
    rows: Annotated[int, Field(ge=1)] = Field(1, description="… along a column")
    gap_m: NotNegative = Field(0.0, description="between neighbouring markers of the board, m")
    first_tag: Annotated[int, Field(ge=0)] = Field(0, description="the board's upper left; they count row by row")
    tags: Literal["all"] | tuple[int, ...] = Field("all", description="tags that count; others are not looked at")
    sigma_px: Positive = Field(0.1, description="noise of a corner per axis, px")

    @field_validator("dictionary")
    @classmethod
    def _known(cls, name: str) -> str:
        known = sorted({n.removeprefix("DICT_").lower() for n in dir(cv2.aruco) if n.startswith("DICT_")})
        if name not in known:
            raise ValueError(f"there is no dictionary {name!r}; the dictionaries are {', '.join(known)}")
        return name


class LandmarkSettings(_Frozen):
    """Which source of landmarks is used, and a section for each; settings of the range filter can inherit it."""

    landmarks: LandmarkKind = Field(LandmarkKind.AUTO, description="what the landmarks are found by")
    tracks: TrackSettings = TrackSettings()
    bearings: BearingSettings = BearingSettings()
    corners: CornerSettings = CornerSettings()
    board: BoardSettings = BoardSettings()
    markers: MarkerSettings = MarkerSettings()
