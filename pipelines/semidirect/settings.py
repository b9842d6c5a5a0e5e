"""Settings of the semi-direct odometry, and its two presets (paper C, Table 1)."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipelines.semidirect.pyramid import LEVELS
from readers.streams import Camera

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]


class CameraSettings(BaseModel):
    """The camera, its scale source and where the path begins: what every visual odometry has to be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    focal_px: Positive | None = Field(None, description="focal length along u, px; otherwise the recording's camera")
    focal_y_px: Positive | None = Field(None, description="focal length along v, px; otherwise focal_px")
    centre_px: tuple[float, float] | None = Field(None, description="principal point (u, v), px; else the centre")
    distortion_model: str = Field("", description="lens: none, plumb_bob, rational_polynomial, equidistant")
    distortion: tuple[float, ...] = Field((), description="its coefficients in ROS's order")
    image_size_px: tuple[int, int] | None = Field(None, description="width and height that these are for")
    mounting_yaw_rad: float = Field(0.0, description="heading of the image's +u axis in the body, CCW from above")
    start_pose: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="x (m), y (m), heading (rad) of the first frame of the first map"
    )

    height_m: Positive | None = Field(None, description="camera height over the ground at the start, m: the scale")
    height_stream: str = Field("", description="stream with the camera height: range, number, or z of a pose")
    height_offset_m: float = Field(0.0, description="added to every value of the height stream, m")
    height_direction: Literal["vertical", "axis"] = Field(
        "vertical", description="heights are over the ground, or distances along the camera's axis"
    )
    height_sigma_m: Positive = Field(0.02, description="standard deviation of a height, m")
    speed_stream: str = Field("", description="stream of odometry whose speed gives the scale, where no height does")
    speed_sigma_mps: Positive = Field(0.05, description="standard deviation of such a speed, m/s")
    position_stream: str = Field("", description="stream of poses whose positions give the scale, where no other does")
    position_sigma_m: Positive = Field(0.01, description="standard deviation of a coordinate of these, m")
    scale_way: Positive = Field(1.0, description="way, in units of the map, over which speed or positions are taken")

    @property
    def camera_key(self) -> tuple[Any, ...]:
        """What tells one camera from another."""
        return (
            self.focal_px, self.focal_y_px, self.centre_px, self.distortion_model, self.distortion, self.image_size_px
        )  # fmt: skip

    def camera(self, width_px: int, height_px: int) -> Camera:
        """The camera of images of that size.

        Raises:
            ValueError: the settings do not tell the focal length, or are for images of another size.
        """
        if self.focal_px is None:
            raise ValueError("the camera is unknown: set focal_px (and centre_px), or give a calibration with --camera")
        size = self.image_size_px or (width_px, height_px)
        if size != (width_px, height_px):
            raise ValueError(
                f"the calibration is for {size[0]} x {size[1]} px, the images are {width_px} x {height_px} px: give "
                "--camera for these images, or --scale-camera if they were resized"
            )
        centre = self.centre_px or ((width_px - 1) / 2, (height_px - 1) / 2)
        matrix = np.array([[self.focal_px, 0, centre[0]], [0, self.focal_y_px or self.focal_px, centre[1]], [0, 0, 1]])
        return Camera(
            rectification=np.full((3, 3), np.nan),
            projection=np.full((3, 4), np.nan),
            width_px=width_px,
            height_px=height_px,
            matrix=matrix,
            distortion_model=self.distortion_model or ("plumb_bob" if self.distortion else "none"),
            distortion=np.array(self.distortion),
        )


class SemidirectSettings(CameraSettings):
    """Every default of the semi-direct odometry by name; unknown keys are an error.

    Lengths in px are those of the image as it is read. The defaults are those of the preset ``fast``.
    """

    # start
    start_corners: Count = Field(200, description="most corners that are followed for the start")
    start_min_matches: Count = Field(50, description="fewer start again with a new first view")
    start_motion_px: Positive = Field(50.0, description="median way of the corners that allows a start")
    start_parallax_px: Positive = Field(10.0, description="median way beyond all rotation that allows a start")
    start_min_inliers: Count = Field(40, description="fewer points are no first map")
    start_model: Literal["plane", "space", "auto"] = Field(
        "plane", description="homography (ground), essential matrix (a camera that looks ahead), or what fits better"
    )

    # sparse image alignment
    prior: Literal["constant-velocity", "still"] = Field("constant-velocity", description="motion that it starts from")
    align_coarsest: Annotated[int, Field(ge=0, lt=LEVELS)] = Field(4, description="first level of the pyramid")
    align_finest: Annotated[int, Field(ge=0, lt=LEVELS)] = Field(2, description="last level of the pyramid")
    align_iterations: Count = Field(30, description="most iterations a level")
    align_tolerance: Positive = Field(1e-6, description="a level ends where the step's largest part is below, m, rad")
    illumination: bool = Field(False, description="estimate gain and offset between the frames")

    # features
    max_features: Count = Field(120, description="map points that are tracked in a frame")
    cell_px: Annotated[int, Field(ge=8)] = Field(30, description="side of a cell of the image")
    feature_iterations: Count = Field(10, description="most iterations of a point's alignment")
    feature_tolerance_px: Positive = Field(0.03, description="it ends where a step is shorter")
    min_view_cosine: Fraction = Field(0.5, description="least cosine between a point's view now and in its keyframe")

    # refinement
    pose_iterations: Count = Field(10, description="most iterations of the pose refinement")
    inlier_px: Positive = Field(2.0, description="a point with a larger reprojection error is dropped from the frame")
    refine_iterations: Count = Field(5, description="iterations of each point that a keyframe sees, on its own")

    # keyframes
    keyframe_distance: Positive = Field(0.12, description="a keyframe is farther from all others, in scene depths")
    keyframe_points: Literal["all", "tracked"] = Field(
        "all", description="points that a keyframe sees: all of the map in its view, or those that tracking found"
    )
    max_keyframes: Annotated[int, Field(ge=3)] = Field(10, description="keyframes in the map")

    # local bundle adjustment
    bundle_keyframes: Annotated[int, Field(ge=0)] = Field(0, description="keyframes of the local bundle, 0: none")
    bundle_iterations: Count = Field(10, description="its most iterations")
    bundle_huber_px: Positive = Field(1.0, description="width of its Huber cost")

    # corners and depth filters
    corner_threshold: Annotated[int, Field(ge=1)] = Field(7, description="FAST's threshold, grey levels")
    corner_min_score: NotNegative = Field(4.0, description="least smaller eigenvalue of a corner, grey levels²")
    filter_keyframes: Count = Field(3, description="filters of the last so many keyframes are kept")
    filter_converged: Fraction = Field(0.005, description="converged where σ is below this share of z_range")
    filter_min_depth: Fraction = Field(0.5, description="least depth of a filter, in scene depths: z_range = 1/that")
    epipolar_score: Positive = Field(2000.0, description="worst mean squared difference of a match, grey levels²")
    point_failures: Count = Field(15, description="a point that was not found so often goes")
    candidate_failures: Count = Field(30, description="… one that no keyframe has confirmed")

    # lost and found
    min_tracked: Count = Field(50, description="fewer points are LOST")
    max_drop: Fraction = Field(
        0.5, description="losing a larger share of the points from one frame to the next is LOST"
    )
    unlike_px: Positive = Field(
        1.0, description="a larger median error of points that do not look like their patches is LOST"
    )
    unlike_correlation: Fraction = Field(0.6, description="… which is a smaller median correlation with them")
    relocalise_correlation: Fraction = Field(0.7, description="least correlation of the small images")
    restart_s: NotNegative = Field(2.0, description="a new map is begun when lost for so long, 0: never")

    # verdicts
    max_level_change: Positive = Field(8.0, description="EXPOSURE_JUMP above, change of the mean grey level")
    gap_factor: Positive = Field(1.6, description="FRAME_GAP above this multiple of the running median of dt")
    min_sharpness_ratio: Fraction = Field(0.5, description="BLURRED below this share of the last frames' median")
    max_height_ratio: Positive = Field(0.1, description="SCALE_DRIFT above, map's height against the sensor's")

    # how it runs
    mapping: Literal["synchronous", "beside"] = Field(
        "synchronous", description="the map grows with each frame, or in a thread beside, some frames later"
    )
    stage_times: bool = Field(False, description="log the time of each stage (not reproducible)")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.align_finest > self.align_coarsest:
            raise ValueError("align_finest exceeds align_coarsest: alignment goes from coarse to fine")
        if self.bundle_keyframes == 1 or self.bundle_keyframes == 2:
            raise ValueError("bundle_keyframes: 0 for none, or 3 and more, since the two oldest are held")
        if self.min_tracked > self.max_features:
            raise ValueError("min_tracked exceeds max_features: every frame would be lost")
        return self

    @classmethod
    def presets(cls) -> tuple[str, ...]:
        """The names of the presets."""
        return ("fast", "accurate")

    @classmethod
    def preset(cls, name: str) -> SemidirectSettings:
        """The settings of that name, as in paper C's Table 1.

        Raises:
            KeyError: there is no preset of that name.
        """
        if name not in cls.presets():
            raise KeyError(name)
        accurate: dict[str, Any] = {
            "max_features": 200,
            "max_keyframes": 50,
            "bundle_keyframes": 12,
            "min_tracked": 30,
        }
        return cls(**(accurate if name == "accurate" else {}))
