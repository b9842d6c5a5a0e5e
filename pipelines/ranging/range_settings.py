"""Settings of the range estimator: the filter's own, and what its landmarks, inputs, start and verdicts need."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from pipelines.lens import pinhole
from pipelines.ranging.inputs import Synchronisation
from pipelines.ranging.landmarks.settings import LandmarkKind, LandmarkSettings
from pipelines.ranging.settings import (
    FilterSettings,
    Flow,
    GainForm,
    Model,
    NotNegative,
    Positive,
    TransitionForm,
)
from pipelines.simulation.motion import FORWARD, looking
from readers.streams import Camera

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]
Probability = Annotated[float, Field(gt=0, lt=0.5)]

JOINT_LIMIT = 50


class MotionModel(StrEnum):
    """Which of the robot's motion the filter uses."""

    ALIGNED = "aligned"
    """Paper B's (13): V along the camera's z axis and ω about its y axis, whatever else there is."""
    PLANAR = "planar"
    """A vehicle's V_x and ω_z with the camera anywhere on it, looking anywhere; the same as `aligned` for a camera
    that looks straight ahead from the turning point."""
    SPATIAL = "spatial"
    """All six velocities, as of a camera that is carried by hand."""


class StartKind(StrEnum):
    """What is known of a new landmark's range."""

    BROAD = "broad"
    """That it is farther than `start_nearest_m`: ξ₀ = 1/(2 Z_min), σ = ξ₀/2."""
    RANGE = "range"
    """About how far: `start_range_m` ± `start_sigma_m`."""
    PLANE = "plane"
    """That it lies on a plane (a wall) whose distance from the first frame's camera is known."""
    TWO_VIEWS = "two-views"
    """Nothing; it waits for a parallax of `start_parallax_px` and is triangulated."""
    SECOND_LANDMARK = "second-landmark"
    """Its offset from another landmark; those that have none start as `broad`."""


class RangeSettings(FilterSettings, LandmarkSettings):
    """Every default of the range estimator by name; unknown keys are an error.

    The defaults are those of the preset ``best``. Robot axes: x forward, y left, z up; camera axes: x right, y down,
    z out of the lens.
    """

    # camera; the replay fills in what is None from the recording
    focal_px: Positive | None = Field(None, description="focal length f, px; of the pinhole that image points are for")
    focal_y_px: Positive | None = Field(None, description="focal length down the image, px; None: focal_px")
    centre_px: tuple[float, float] | None = Field(None, description="principal point (u, v); None: (0, 0)")
    distortion_model: str | None = Field(None, description="lens model by its ROS name; None: as recorded, or none")
    distortion: tuple[float, ...] | None = Field(None, description="coefficients of the lens model")
    image_size_px: tuple[int, int] | None = Field(None, description="width and height of the images")

    # where the camera sits in the robot: R_r^c
    camera_quat_xyzw: tuple[float, float, float, float] | None = Field(
        None, description="turns camera axes into robot axes; None: ahead, turned by the three angles below"
    )
    camera_yaw_rad: float = Field(0.0, description="camera turned to the left")
    camera_pitch_rad: float = Field(0.0, description="camera turned downwards")
    camera_roll_rad: float = Field(0.0, description="camera turned about its own axis, as the robot's roll")
    camera_position_m: Triple | None = Field(None, description="camera in the robot; None: at the turning point")
    imu_yaw_pitch_roll_rad: Triple = Field((0.0, 0.0, 0.0), description="axes of the IMU in the robot")

    # landmarks; where they come from is in `landmarks` and the sections of the sources
    max_landmarks: Annotated[int, Field(ge=1, le=4096)] = Field(32, description="slots N: landmarks at a time")
    keep_unseen_s: NotNegative = Field(1.0, description="a landmark without an image point is predicted so long")
    only_landmarks: tuple[int, ...] = Field(
        (), description="bearings: numbers that count, such as the surveyed ones; none: all"
    )

    # inputs
    motion: MotionModel = Field(MotionModel.PLANAR, description="which of the robot's motion is used")
    synchronisation: Synchronisation = Field(
        Synchronisation.HOLD_BOTH, description="what the speeds are between two messages"
    )
    latency_buffer_s: NotNegative = Field(
        0.0,
        description="the replay takes messages as they arrived, and sorts what comes late by up to this; 0: all are "
        "sorted beforehand",
    )
    camera_delay_s: float = Field(
        0.0, allow_inf_nan=False, description="the frames' stamps are late by this: a frame is of its stamp less it"
    )
    gyro: Literal["auto", "imu", "odometry"] = Field("auto", description="whose ω; auto: the IMU's if there is one")
    sigma_omega_across: NotNegative | None = Field(
        None, description="spatial: noise of ω about the robot's x and y, rad/s/√Hz; None: sigma_omega"
    )
    sigma_speed_across: NotNegative | None = Field(
        None, description="spatial: noise of V along the robot's y and z, m/s/√Hz; None: sigma_speed"
    )
    gyro_bias: Literal["standstill", "given"] = Field(
        "standstill", description="bias of the IMU's ω: measured while the robot rests at the start, or given"
    )
    gyro_bias_radps: Triple = Field((0.0, 0.0, 0.0), description="given bias in robot axes, also until one is measured")
    gyro_bias_min_s: Positive = Field(1.5, description="a bias counts after so much rest")
    gyro_bias_limit_radps: Positive = Field(0.02, description="a robot that turns faster does not rest")
    zero_velocity_update: bool = Field(True, description="V = 0 without error while the robot stands")
    standstill_s: Positive = Field(1.0, description="the robot stands if its speed was noise alone for so long")
    standstill_sigmas: Positive = Field(3.0, description="… on every shorter end of that time too, in σ_V/√T")
    standstill_limit_mps: Positive = Field(0.03, description="… and a robot whose mean speed is above does not stand")

    # start
    start: StartKind = Field(StartKind.BROAD, description="what is known of a new landmark's range")
    start_nearest_m: Positive = Field(2.0, description="broad: Z_min, no landmark is nearer")
    start_range_m: Positive = Field(11.0, description="range: depth of a new landmark")
    start_sigma_m: Positive = Field(5.67, description="range: σ of that depth (paper: σ_ξ = 3/64 1/m)")
    start_pixel_variance: Positive | None = Field(
        None, description="P₀ of x and y, px² (paper: 10); None: that of the image point"
    )
    start_plane_normal: Triple = Field((1.0, 0.0, 0.0), description="plane: away from the robot, robot axes")
    start_plane_m: Positive = Field(8.0, description="plane: its distance from the camera of the first frame")
    start_plane_sigma_m: Positive = Field(0.5, description="plane: σ of its distance")
    start_parallax_px: Positive = Field(5.0, description="two-views: derotated parallax that is waited for")
    start_pair: tuple[int, int] = Field((0, 1), description="second-landmark: numbers of the two landmarks")
    start_offset_m: Triple = Field(
        (0.0, 0.0, 0.0), description="second-landmark: from the first to the second, robot axes"
    )
    start_offset_sigma_m: Positive = Field(0.01, description="second-landmark: σ of each coordinate of that")

    # many landmarks
    mode: Literal["independent", "joint"] = Field(
        "independent", description="each landmark by itself, or all with one noise of the speeds (up to 50)"
    )

    # what a range is worth, and the thresholds of the verdicts
    max_relative_sigma: Positive = Field(0.1, description="a range counts below this σ_ξ/ξ …")
    min_parallax_px: NotNegative = Field(5.0, description="… and above this derotated parallax")
    focus_limit_px: NotNegative = Field(10.0, description="NEAR_FOCUS within this distance of the focus of expansion")
    rotation_parallax_px: Positive = Field(10.0, description="PURE_ROTATION above this raw parallax without the other")
    input_stale_s: Positive = Field(0.5, description="INPUT_STALE above this age of a speed at the frame")
    gap_factor: Positive = Field(1.6, description="FRAME_GAP above this multiple of the running median of dt")
    statistics_frames: Annotated[int, Field(ge=5, le=1000)] = Field(30, description="frames of the running means")
    band_probability: Probability = Field(1e-4, description="NIS_HIGH, NIS_LOW: chance of either for a right filter")
    trend_sigmas: Positive = Field(4.5, description="INNOVATIONS_…: significance of a trend, in σ")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        forms = (self.flow, self.transition, self.noise_gain)
        plain = forms == (Flow.EXACT, TransitionForm.EXACT, GainForm.EXACT) and not self.relinearisations
        if self.motion is not MotionModel.ALIGNED and not plain:
            raise ValueError(
                "flow, transition, noise_gain and relinearisations other than the defaults are of the paper's "
                "equations: set motion = 'aligned'"
            )
        if self.mode == "joint" and self.max_landmarks > JOINT_LIMIT:
            raise ValueError(f"mode = 'joint' is for max_landmarks up to {JOINT_LIMIT}, not {self.max_landmarks}")
        if self.mode == "joint" and self.relinearisations:
            raise ValueError("relinearisations are for mode = 'independent'")
        if self.motion is not MotionModel.ALIGNED and self.start is StartKind.TWO_VIEWS:
            raise ValueError("start = 'two-views' is for motion = 'aligned'; use start = 'broad'")
        if self.start is StartKind.PLANE and not np.linalg.norm(self.start_plane_normal) > 0.0:
            raise ValueError("start_plane_normal must not be zero")
        if self.pixel_sigma != FilterSettings().pixel_sigma:
            raise ValueError(
                "the noise of an image point is that of its source: set tracks.sigma_px, corners.sigma_px, "
                "board.sigma_px, markers.sigma_px or bearings.sigma_rad instead of pixel_sigma"
            )
        if self.camera_quat_xyzw is not None and not np.linalg.norm(self.camera_quat_xyzw) > 0.0:
            raise ValueError("camera_quat_xyzw must not be zero")
        return self

    @property
    def body_r_camera(self) -> Floats:
        """Turns camera axes into robot axes [3, 3]: the transpose of the paper's R_r^c."""
        if self.camera_quat_xyzw is not None:
            return np.asarray(Rotation.from_quat(self.camera_quat_xyzw).as_matrix())
        return np.asarray(
            looking(
                FORWARD, yaw_rad=self.camera_yaw_rad, pitch_rad=self.camera_pitch_rad, roll_rad=self.camera_roll_rad
            )
        )

    @property
    def body_r_imu(self) -> Floats:
        """Turns the IMU's axes into robot axes [3, 3]."""
        return np.asarray(Rotation.from_euler("ZYX", self.imu_yaw_pitch_roll_rad).as_matrix())

    @property
    def camera(self) -> Camera | None:
        """The camera as its images are; None where the focal length is unknown."""
        if self.focal_px is None:
            return None
        width, height = self.image_size_px or (1, 1)
        model, centre = self.distortion_model or "none", self.centre_px or (0.0, 0.0)
        made = pinhole(width, height, self.focal_px, model=model, distortion=self.distortion or (), centre_px=centre)
        matrix = made.matrix.copy()
        matrix[1, 1] = self.focal_y_px or self.focal_px
        size = (0, 0) if self.image_size_px is None else self.image_size_px
        return replace(made, width_px=size[0], height_px=size[1], matrix=matrix)

    @property
    def pinhole_focal_px(self) -> float | None:
        """Focal length of the pinhole that image points are for; that of bearings where there is no camera."""
        if self.landmarks is LandmarkKind.BEARINGS:
            return self.bearings.focal_px
        if self.focal_px is None and self.landmarks is LandmarkKind.AUTO:
            return self.bearings.focal_px
        return self.focal_px

    @property
    def pinhole_centre_px(self) -> tuple[float, float]:
        """Principal point of that pinhole; (0, 0) for bearings."""
        bearings = self.landmarks is LandmarkKind.BEARINGS or self.focal_px is None
        return (0.0, 0.0) if bearings or self.centre_px is None else self.centre_px

    @property
    def kernel_model(self) -> Model:
        """The settings and the camera as the kernels take them.

        Raises:
            ValueError: the focal length is unknown.
        """
        if self.pinhole_focal_px is None:
            raise ValueError("focal_px is unknown")
        return self.model(self.pinhole_focal_px, self.pinhole_centre_px)

    @classmethod
    def presets(cls) -> tuple[str, ...]:
        """The names of the presets."""
        return ("paper-b", "best")

    @classmethod
    def preset(cls, name: str) -> RangeSettings:
        """The settings of that name: ``paper-b`` as the paper has it, misprints put right, ``best`` as we recommend it.

        Raises:
            KeyError: there is no preset of that name.
        """
        if name == "best":
            return cls()
        if name == "paper-b":
            return cls(
                motion=MotionModel.ALIGNED,
                flow=Flow.RK4,
                transition=TransitionForm.FIRST_ORDER,
                noise_gain=GainForm.FIRST_ORDER,
                gate="off",
                reset_after=0,
                zero_velocity_update=False,
                gyro_bias="given",
                start=StartKind.RANGE,
                start_pixel_variance=10.0,
            )
        raise KeyError(name)
