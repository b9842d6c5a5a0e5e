"""Settings of the correlation odometry, and its two presets."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class Correction(StrEnum):
    """What is done at the end of a correction segment (18)-(21)."""

    OFF = "off"
    SPEED_PRIOR = "speed-prior"
    """A pull towards the reference path: -gain · ΔS_Σ along the heading. It helps only where the true speed
    is the nominal one and the scale is wrong; else it harms."""
    AS_PRINTED = "as-printed"
    """par · ΔS_relate · sign(ΔS_Σ) as (21) prints it: never negative for par > 0, so it corrects one way only."""


class CorrelationSettings(BaseModel):
    """Every default of the correlation odometry by name; unknown keys are an error.

    Lengths in px are those of the image as it is read. The defaults are those of the preset ``best``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    # scale: W from a given price of a pixel, or from a height and a focal length
    metres_per_px: Positive | None = Field(None, description="price of a pixel W; overrides height / focal length")
    focal_px: Positive | None = Field(None, description="focal length, px; W = height / focal length")
    height_m: Positive | None = Field(None, description="constant camera height over the ground, m")
    height_stream: str = Field("", description="stream with the camera height: range, number, or z of a pose")
    height_offset_m: float = Field(0.0, description="added to every value of the height stream, m")

    # mount and start
    mount: Literal["rigid", "gimballed"] = Field("rigid", description="rigid: paper A; gimballed: paper A0, shift only")
    mounting_yaw_rad: float = Field(0.0, description="heading of the image's +u axis in the body, CCW from above")
    start_pose: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="x (m), y (m), heading (rad) at frame 0"
    )

    # fragments and search
    columns: Annotated[int, Field(ge=1, le=9)] = Field(3, description="fragments along u")
    rows: Annotated[int, Field(ge=1, le=9)] = Field(3, description="fragments along v")
    fragment_side_px: Annotated[int, Field(ge=5, le=63)] = Field(21, description="side N of a fragment, odd")
    span_u_px: Positive | None = Field(
        None, description="distance of the outer columns (paper: L); None: 0.43 of width"
    )
    span_v_px: Positive | None = Field(None, description="distance of the outer rows; None: 0.586 of the image height")
    search_radius_px: Annotated[int, Field(ge=2, le=256)] = Field(
        8, description="reach of the search around its centre"
    )
    ambiguity: Fraction = Field(
        0.03, description="of peaks that differ by less, the one nearest to the prediction; 0: the highest"
    )
    prediction: Literal["none", "last-shift", "constant-velocity"] = Field(
        "constant-velocity", description="centre of the search: zero, each fragment's last shift, rigid motion x dt"
    )

    # subpixel refinement
    refiner: Literal["one-step", "inverse-compositional"] = Field(
        "inverse-compositional", description="one least-squares step (8), (9), or iterated on a cubic spline"
    )
    rotate_template: bool = Field(True, description="turn the template by the predicted rotation")
    rotate_above_rad: Annotated[float, Field(ge=0)] = Field(2e-3, description="… where that exceeds this angle")
    gain_and_offset: bool = Field(True, description="estimate gain and offset of the match with the shift")
    max_iterations: Annotated[int, Field(ge=1, le=50)] = Field(10, description="of the iterated refinement")
    tolerance_px: Positive = Field(1e-3, description="the iteration ends below this step")
    step_limit_px: Positive = Field(1.5, description="a longer Δ is SUBPIXEL_DIVERGED (paper: 1)")

    # rigid motion
    motion: Literal["paper", "robust"] = Field("robust", description="(12), (13), (15), or a robust rigid fit")
    robust_scale_px: Positive = Field(0.3, description="residual at which a fragment loses half its weight")
    inlier_px: Positive = Field(1.0, description="largest residual of a fragment that agrees")
    min_inliers: Annotated[int, Field(ge=2)] = Field(3, description="fewer reject the frame")
    tile_columns: Annotated[int, Field(ge=0, le=32)] = Field(10, description="photometric tiles along u, 0: none")
    tile_rows: Annotated[int, Field(ge=0, le=32)] = Field(9, description="photometric tiles along v, 0: none")
    tile_side_px: Annotated[int, Field(ge=5, le=63)] = Field(21, description="side of a tile, odd")
    tile_rounds: Annotated[int, Field(ge=1, le=10)] = Field(3, description="most rounds of the photometric step")
    tile_tolerance_px: Positive = Field(0.03, description="a round that moves the frame less is the last one")

    # key frames and recovery
    key_frames: bool = Field(True, description="search the fragments of the oldest frame that still overlaps")
    key_max_shift_px: Positive = Field(110.0, description="a template frame serves up to this shift")
    key_max_rotation_rad: Positive = Field(0.122, description="… and up to this rotation (7 degrees)")
    key_min_inliers: Annotated[int, Field(ge=0)] = Field(5, description="… and while so many fragments agree")
    recovery: bool = Field(True, description="reject bad motions, hold the velocity, search globally")
    recovery_rotations_rad: tuple[float, ...] = Field(
        (0.0, 0.14, -0.14), description="rotations that the global search tries, in this order"
    )
    bridge_frames: Annotated[int, Field(ge=0)] = Field(5, description="a lost template is tried this many frames more")
    accepted_gain: tuple[Positive, Positive] = Field((0.5, 2.0), description="a gain outside rejects the frame")
    global_min_correlation: Fraction = Field(0.35, description="the global search needs this peak")

    # integration (14)-(17)
    integration: Literal["paper", "mid-heading", "exact"] = Field(
        "exact", description="S along the new heading, S along the mid heading, or the full vector on SE(2)"
    )

    # correction (18)-(21)
    correction: Correction = Field(Correction.OFF, description="a prior on the speed; off unless the speed is known")
    correction_frames: Annotated[int, Field(ge=1)] = Field(25, description="frames K of a segment")
    correction_speed_mps: Positive | None = Field(
        None, description="nominal speed; S_etal = speed x time of the segment"
    )
    correction_max_relative: Positive = Field(0.1, description="thr_relate: fires where |ΔS_relate| is below")
    correction_min_m: Annotated[float, Field(ge=0)] = Field(
        0.002, description="thr_sum: fires where |ΔS_Σ| is above, m"
    )
    correction_gain: Fraction = Field(1.0, description="speed-prior: share of ΔS_Σ that is taken back")
    correction_par_m: float = Field(0.25, description="as-printed: par of (21), m")

    # thresholds of the verdicts
    min_correlation: Fraction = Field(0.5, description="LOW_CORRELATION below")
    max_peak_ratio: Positive = Field(0.95, description="PEAK_AMBIGUOUS above (second peak over first)")
    min_eigenvalue: Annotated[float, Field(ge=0)] = Field(0.25, description="LOW_TEXTURE below, grey²/px² per pixel")
    min_texture_ratio: Annotated[float, Field(ge=0)] = Field(
        1.0, description="LOW_TEXTURE where the eigenvalue is below this multiple of the noise's own"
    )
    max_condition: Positive = Field(9.0, description="APERTURE above (condition number of I_xyᵀ I_xy)")
    max_rigidity_px: Positive = Field(1.0, description="NOT_RIGID above, for two fragments")
    max_scale_change: Positive = Field(0.01, description="HEIGHT_CHANGE above, of |scale - 1|")
    max_residual_ratio: Positive = Field(3.0, description="RESIDUAL_HIGH above this multiple of the running median")
    max_level_change: Positive = Field(8.0, description="EXPOSURE_JUMP above, change of the mean grey level")
    min_sharpness_ratio: Fraction = Field(0.5, description="BLURRED below this share of the running median")
    blurred_gain: Positive = Field(0.9, description="… where the gain of the match is below this as well")
    gap_factor: Positive = Field(1.6, description="FRAME_GAP above this multiple of the running median of dt")
    median_frames: Annotated[int, Field(ge=3, le=255)] = Field(31, description="frames of the running medians")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for name in ("fragment_side_px", "tile_side_px"):
            if getattr(self, name) % 2 == 0:
                raise ValueError(f"{name} must be odd, so that a fragment has a centre pixel")
        if self.mount == "rigid" and self.columns * self.rows < 2:
            raise ValueError("a rigid mount needs two fragments at least: raise columns or rows")
        if self.motion == "paper" and (self.columns, self.rows) != (2, 1):
            raise ValueError("motion = 'paper' is for columns = 2 and rows = 1; use motion = 'robust' for more")
        if self.motion == "robust" and self.min_inliers > self.columns * self.rows:
            raise ValueError("min_inliers exceeds the number of fragments")
        if self.refiner == "one-step" and self.rotate_template:
            raise ValueError("rotate_template needs refiner = 'inverse-compositional'")
        if self.motion == "paper" and self.key_frames:
            raise ValueError("key_frames needs motion = 'robust'")
        if self.correction is not Correction.OFF and self.correction_speed_mps is None:
            raise ValueError("a correction needs correction_speed_mps, the nominal speed")
        return self

    @classmethod
    def presets(cls) -> tuple[str, ...]:
        """The names of the presets."""
        return ("paper-a", "best")

    @classmethod
    def preset(cls, name: str) -> CorrelationSettings:
        """The settings of that name: ``paper-a`` as the paper has it, ``best`` as we recommend it.

        Raises:
            KeyError: there is no preset of that name.
        """
        if name == "best":
            return cls()
        if name == "paper-a":
            return cls(
                columns=2,
                rows=1,
                fragment_side_px=9,
                span_u_px=200.0,
                search_radius_px=16,
                ambiguity=0.0,
                prediction="last-shift",
                refiner="one-step",
                rotate_template=False,
                gain_and_offset=False,
                max_iterations=1,
                step_limit_px=1.0,
                min_texture_ratio=3.0,
                motion="paper",
                min_inliers=2,
                tile_columns=0,
                tile_rows=0,
                key_frames=False,
                recovery=False,
                integration="paper",
            )
        raise KeyError(name)
