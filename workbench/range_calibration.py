"""What a run of ranges tells of its sensors, from its Steps alone: gyro bias, focus of expansion, time offset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.ranging import calibration
from pipelines.ranging.filter import Outcome
from pipelines.ranging.range_settings import MotionModel
from pipelines.ranging.step import RangeStep
from pipelines.simulation.channels import rng_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

STRAIGHT_RADPS = 0.02
"""Frames with a slower turn count as straight driving."""
MOVING_SIGMAS = 5.0
"""… if the speed is so many of its own σ."""
SIGNIFICANT_SIGMAS = 3.0
"""A difference from the settings below that is none."""
MAX_OFFSET_S = 0.5
SIGMA_OFFSET_S = 0.005
"""What the time offset is uncertain by: speeds are held over the intervals, and depths differ."""
LEAST_CORRELATION = 0.9
"""Below it the image's turn and the gyro's do not resemble each other: no time offset is told."""
DRAWS = 40
"""Drawn errors of the turn for the focus's uncertainty."""
MOST_TRACKS = 200
"""The longest tracks, which tell the focus."""
FEWEST_POINTS = 5
"""Image points that a rate of turn needs."""


class Track(NamedTuple):
    """A landmark's image points [m, 2] in one stretch of straight driving, and the steps they are of [m]."""

    frames: NDArray[np.int64]
    pixel: Floats


class SensorCalibration:
    """Collects what the calibrations need: about 40 bytes for every image point.

    Args:
        settings: the estimator's.
        imu: whether the rate of turn is an IMU's.
    """

    def __init__(self, settings: Any, imu: bool) -> None:
        self._settings, self._imu = settings, imu
        self._inputs: list[tuple[float, ...]] = []
        self._focus: list[Floats] = []
        self._points: list[dict[int, Floats]] = []
        self._variances: list[float] = []

    def take(self, step: RangeStep) -> None:
        """Take note of one step; points that the gate rejected are left out."""
        # ω̃ about the camera's y axis, Ṽ, dt, still, bias that was taken out, time
        self._inputs.append(
            (step.omega_radps, step.speed_mps, step.dt_s, step.still, step.gyro_bias_radps, step.t_ns * 1e-9)
        )
        self._focus.append(step.focus_px)
        good = np.isfinite(step.measured_px).all(axis=1) & (step.outcome != Outcome.REJECTED)
        self._points.append({int(step.landmark_id[k]): step.measured_px[k] for k in np.flatnonzero(good)})
        noise = (step.innovation_covariance - step.prior_covariance[:, :2, :2])[:, 0, 0]
        if np.isfinite(noise).any():
            self._variances.append(float(np.nanmedian(noise)))

    def told(self) -> dict[str, Any]:
        """All three, each with its sentence; the ``key`` names those that could be told, empty for none."""
        found: dict[str, Any] = {}
        sentences = []
        for name, title, tell in (
            ("gyro_bias", "gyro bias", self._gyro_bias),
            ("focus", "focus of expansion", self._focus_of_expansion),
            ("time_offset", "time offset", self._time_offset),
        ):
            try:
                values, sentence = tell()
                found[name] = values
            except ValueError as error:
                sentence = f"cannot be told: {error}"
            sentences.append(f"{title}: {sentence}")
        return {"key": ", ".join(found), "sentence": "; ".join(sentences), "sentences": sentences, **found}

    # ---- one by one

    def _column(self, k: int) -> Floats:
        return np.array([row[k] for row in self._inputs], dtype=np.float64)

    def _gyro_bias(self) -> tuple[dict[str, float], str]:
        if not self._imu:
            raise ValueError("the rate of turn is the odometry's; name an IMU with --imu")
        omega, dt, rest = self._column(0), self._column(2), self._rest()
        if not rest.any():
            raise ValueError("the robot never stood still; let it stand for some seconds")
        bias, sigma = calibration.gyro_bias((omega + self._column(4))[rest], dt[rest], self._settings.sigma_omega)
        robot = bias * self._settings.body_r_camera[:, 1] + 0.0
        sentence = (
            f"{bias:.3g} ± {sigma:.2g} rad/s about the camera's y axis, from {dt[rest].sum():.3g} s of standstill; "
        )
        if abs(bias) < SIGNIFICANT_SIGMAS * sigma:
            sentence += "none that could be told from 0"
        else:
            sentence += f"use --set gyro_bias=given --set gyro_bias_radps={_list(robot, 6)}"
        return {"radps": bias, "sigma_radps": sigma, "rest_s": float(dt[rest].sum())}, sentence

    def _focus_of_expansion(self) -> tuple[dict[str, Any], str]:
        s = self._settings
        if not self._variances:
            raise ValueError("no landmark was ever updated")
        straight, stretch = self._straight()
        tracks = self._tracks(straight, stretch)
        turns = self._turns(tracks, straight, self._column(0))
        if not tracks:
            raise ValueError(f"no straight driving (turns below {STRAIGHT_RADPS} rad/s) with landmarks in view")
        sigma_px = math.sqrt(float(np.median(self._variances)))
        found = self._focus_from(tracks, turns, sigma_px)
        sigma = np.sqrt(np.diag(found.covariance + self._from_turns(tracks, straight, sigma_px)))
        aligned = s.motion is MotionModel.ALIGNED
        used = np.array(s.pinhole_centre_px) if aligned else np.nanmedian(np.array(self._focus)[straight], axis=0)
        u, v = found.pixel
        sentence = (
            f"({u:.2f} ± {sigma[0]:.2g}, {v:.2f} ± {sigma[1]:.2g}) px from {found.lines} straight tracks; "
            f"the filter takes ({used[0]:.2f}, {used[1]:.2f}): "
        )
        if (np.abs(found.pixel - used) < SIGNIFICANT_SIGMAS * sigma).all():
            sentence += "they agree"
        elif aligned:
            sentence += f"use --set centre_px={_list(found.pixel, 2)}"
        else:
            sentence += f"use --set camera_quat_xyzw={_list(self._mounting(found.pixel, used), 6)}"
        values = {"focus_px": found.pixel.tolist(), "sigma_px": sigma.tolist(), "tracks": found.lines}
        return values | {"used_px": used.tolist()}, sentence

    def _focus_from(self, tracks: list[Track], turns: list[Floats], sigma_px: float) -> calibration.Focus:
        s = self._settings
        pixels = [track.pixel for track in tracks]
        return calibration.focus_from_tracks(pixels, turns, sigma_px, s.pinhole_focal_px, s.pinhole_centre_px)

    def _from_turns(self, tracks: list[Track], straight: Bools, sigma_px: float) -> Floats:
        """The gyro's share of the focus's covariance [2, 2]: all tracks have the error of the turn in common.

        The focus is computed again with drawn errors of the turn: the gyro's noise, and a bias as uncertain as one
        from the run's standstill.
        """
        rng = rng_of(0, "focus of expansion")
        omega, dt = self._column(0), self._column(2)
        rest_s = float(dt[self._rest()].sum())
        bias = self._settings.sigma_omega / math.sqrt(rest_s) if self._imu and rest_s > 0 else 0.0
        found = []
        for _ in range(DRAWS):
            noise = self._settings.sigma_omega / np.sqrt(dt) * rng.standard_normal(len(dt))
            turns = self._turns(tracks, straight, omega + noise + bias * rng.standard_normal())
            found.append(self._focus_from(tracks, turns, sigma_px).pixel)
        return np.asarray(np.cov(np.array(found).T))

    def _rest(self) -> Bools:
        omega = self._column(0)
        still = (self._column(3) > 0) & np.isfinite(omega)
        return np.asarray(still & (np.abs(omega) < self._settings.gyro_bias_limit_radps))

    def _straight(self) -> tuple[Bools, NDArray[np.int64]]:
        """Which frames belong to straight driving, and the number of the stretch of each."""
        omega, speed, dt = (self._column(k) for k in range(3))
        with np.errstate(invalid="ignore"):
            moving = np.abs(speed) > MOVING_SIGMAS * self._settings.sigma_speed / np.sqrt(dt)
            straight = moving & (np.abs(omega) < STRAIGHT_RADPS) & (self._column(3) == 0)
        return straight, np.cumsum(~straight)

    def _tracks(self, straight: Bools, stretch: NDArray[np.int64]) -> list[Track]:
        """The longest tracks of landmarks within one stretch each."""
        rows: dict[tuple[int, int], list[int]] = {}
        for k in np.flatnonzero(straight).tolist():
            for number in self._points[k]:
                rows.setdefault((int(stretch[k]), number), []).append(k)
        longest = sorted(rows.items(), key=lambda row: -len(row[1]))[:MOST_TRACKS]
        return [
            Track(np.array(frames), np.array([self._points[k][number] for k in frames]))
            for (_, number), frames in longest
            if len(frames) > 2
        ]

    def _turns(self, tracks: list[Track], straight: Bools, omega: Floats) -> list[Floats]:
        """The turn at each point of each track about their mean, rad."""
        turn = np.cumsum(np.where(straight, omega * self._column(2), 0.0))
        return [turn[track.frames] - turn[track.frames].mean() for track in tracks]

    def _mounting(self, focus_px: Floats, used_px: Floats) -> Floats:
        """The camera's attitude [4], turned the least so that the focus found is where the filter's was."""
        s = self._settings
        seen, meant = (s.body_r_camera @ self._ray(pixel) for pixel in (focus_px, used_px))
        axis = np.cross(seen, meant)
        angle = math.atan2(float(np.linalg.norm(axis)), float(seen @ meant))
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        return np.asarray((turn * Rotation.from_matrix(s.body_r_camera)).as_quat(canonical=True))

    def _ray(self, pixel: Floats) -> Floats:
        s = self._settings
        ray = np.append((pixel - np.array(s.pinhole_centre_px)) / s.pinhole_focal_px, 1.0)
        return np.asarray(ray / np.linalg.norm(ray))

    def _time_offset(self) -> tuple[dict[str, float], str]:
        s = self._settings
        omega, dt, t_s = self._column(0), self._column(2), self._column(5)
        image = np.full(len(omega), np.nan)
        for k in range(1, len(omega)):
            both = self._points[k].keys() & self._points[k - 1].keys()
            if len(both) >= FEWEST_POINTS and dt[k] > 0:
                before, after = (np.array([self._points[j][i] for i in both]) for j in (k - 1, k))
                focal, centre = s.pinhole_focal_px, s.pinhole_centre_px
                image[k] = calibration.image_turn_rate(before, after, dt[k], focal, centre)
        middle = t_s - t_s[:1] - 0.5 * dt
        known, seen = np.isfinite(omega) & (dt > 0), np.isfinite(image)
        if seen.sum() < 3 or known.sum() < 3:
            raise ValueError(f"too few frames share {FEWEST_POINTS} landmarks")
        found = calibration.time_offset(middle[seen], image[seen], middle[known], omega[known], MAX_OFFSET_S)
        if found.correlation < LEAST_CORRELATION:
            raise ValueError(
                f"the image's turn and the gyro's correlate by {found.correlation:.2f} only; drive more turns with "
                f"{FEWEST_POINTS} landmarks or more in view"
            )
        if MAX_OFFSET_S - abs(found.seconds) < 1e-3:
            raise ValueError(f"it lies at the end of the search, ± {MAX_OFFSET_S} s")
        delay_s = s.camera_delay_s - found.seconds
        values = {"seconds": found.seconds, "correlation": found.correlation, "camera_delay_s": delay_s}
        sign = "late" if found.seconds > 0 else "early"
        sentence = (
            f"the gyro's stamps are {abs(found.seconds):.3f} ± {SIGMA_OFFSET_S:g} s {sign} beside the frames' "
            f"(correlation {found.correlation:.3f}): "
        )
        if abs(found.seconds) < SIGNIFICANT_SIGMAS * SIGMA_OFFSET_S:
            return values, sentence + "none that could be told from 0"
        return values, sentence + f"use --set camera_delay_s={delay_s:.3f}"


def _list(values: Sequence[float] | Floats, digits: int) -> str:
    return "[" + ",".join(f"{float(v):.{digits}f}" for v in values) + "]"
