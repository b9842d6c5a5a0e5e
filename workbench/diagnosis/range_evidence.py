"""What the image points of a run say of its own sensors, told from the filter's records and never from the truth.

Three looks at the same tracks: a track's third differences (the noise of its points), the step from a frame to the
next (turn and way as the image has them against those of gyro and odometer), and pairs of frames seconds apart
(epipolar geometry: what the gyro and the mounting leave over, whatever the depths are). All fits are robust, so that
single blunders do not count. Axes and signs are those of `pipelines.ranging.equations`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.ranging.filter import Outcome
from pipelines.ranging.range_settings import MotionModel, RangeSettings
from workbench.diagnosis.finding import Case

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

HUBER = 2.0
"""Residuals beyond so many σ count less in the fits (Huber 1964)."""
MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
THIRD_DIFFERENCE = math.sqrt(20.0)
"""σ of x₃ - 3x₂ + 3x₁ - x₀ of white noise of σ 1."""
QUIET_NIS = 6.0
"""Median NIS of a frame below which its landmarks are in place."""
AGE_INTERVALS = 1.5
"""Intervals between frames beyond which the age of an input, above its usual one, means that messages are missing."""
FEWEST_INPUTS = 0.5
"""Share of the usual messages of the inputs below which some are missing."""
WAY_SIGMAS = 5.0
"""Shorter ways, in σ of the odometer's noise, have no direction for the geometry of pairs."""
SLIPPED = 3
"""Blunders between two frames from which on a track may have slipped to another point."""
REGULAR = 0.25
"""Intervals that differ more from the usual one are left out of third differences."""
BLUNDER = 6.0
"""Residuals beyond so many σ do not count at all in the last rounds of a fit of many parameters."""
ROUNDS = 6
FEWEST = 4
"""Landmarks that a fit of a frame takes at least."""


def spread(values: NDArray[np.floating]) -> float:
    """Robust standard deviation about the median: 1.4826 MAD; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(MAD * np.median(np.abs(known - np.median(known)))) if len(known) else math.nan


def _huber(residual: Floats) -> Floats:
    """Weights of residuals in σ."""
    size = np.abs(residual)
    return np.asarray(np.where(size <= HUBER, 1.0, HUBER / np.maximum(size, HUBER)))


class Camera(NamedTuple):
    """Focal length, principal point [2] and the body's z axis in camera axes [3], over its y, as the settings say."""

    focal_px: float
    centre_px: Floats
    axis: Floats

    @classmethod
    def of(cls, settings: RangeSettings) -> Camera:
        """The camera of some settings."""
        up = settings.body_r_camera.T @ [0.0, 0.0, 1.0]
        aligned = settings.motion is MotionModel.ALIGNED or abs(up[1]) < 0.1
        axis = np.array([0.0, 1.0, 0.0]) if aligned else up / up[1]
        return cls(float(settings.pinhole_focal_px or math.nan), np.array(settings.pinhole_centre_px), axis)

    def rays(self, pixels: Floats) -> Floats:
        """Rays [..., 3] of pixels [..., 2]."""
        plane = (pixels - self.centre_px) / self.focal_px
        return np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)

    def pixels(self, points: Floats) -> Floats:
        """Pixels [..., 2] of points [..., 3]; NaN of those behind it."""
        depth = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return np.asarray(self.focal_px * points[..., :2] / depth + self.centre_px)


@dataclass(frozen=True)
class Drive:
    """The run as its records have it.

    Attributes:
        settings: the settings.
        camera: the camera.
        ids: landmark in each slot [n, N], -1 for none.
        pixel: its measured image point [n, N, 2], NaN for none.
        blunder: it is far off while most of its frame's are not [n, N].
        blind: no new speed or rate of turn came for the frame [n].
        dt: time since the frame before [n], 0 of the first and of frames that were passed over.
        turn: turn of the camera since then, camera axes, as `Rotation.as_matrix` [n, 3, 3]: P' = turn P - shift.
        shift: way since then in the new axes [n, 3].
    """

    settings: RangeSettings
    camera: Camera
    ids: Ints
    pixel: Floats
    blunder: Bools
    blind: Bools
    dt: Floats
    turn: Floats
    shift: Floats

    @property
    def in_plane(self) -> bool:
        """Whether the records hold the whole motion: of `spatial` they have the turn and the speed ahead only."""
        return self.settings.motion is not MotionModel.SPATIAL

    @property
    def usual_dt(self) -> float:
        """The median interval between frames, s."""
        known = self.dt[self.dt > 0.0]
        return float(np.median(known)) if len(known) else math.nan

    def between(self, first: int, last: int) -> tuple[Floats, Floats]:
        """Turn [3, 3] and way [3] from one frame to a later one: P' = turn P - shift."""
        turn, shift = np.eye(3), np.zeros(3)
        for k in range(first + 1, last + 1):
            turn, shift = self.turn[k] @ turn, self.turn[k] @ shift + self.shift[k]
        return turn, shift

    def shared(self, first: int, last: int) -> Ints:
        """The slots whose landmark is seen in both frames."""
        same = (self.ids[first] == self.ids[last]) & (self.ids[first] >= 0)
        seen = np.isfinite(self.pixel[first, :, 0]) & np.isfinite(self.pixel[last, :, 0])
        return np.flatnonzero(same & seen)


def drive(case: Case) -> Drive:
    """The run of a case, made once."""
    return case.once(_drive)


def _drive(case: Case) -> Drive:
    settings = RangeSettings.model_validate(dict(case.settings))
    camera = Camera.of(settings)
    dt = np.nan_to_num(case["dt_s"])
    skipped = ~np.isfinite(case["landmark_id"]).any(axis=1) & (dt <= 0.0)
    dt = np.where(skipped, 0.0, dt)
    omega = np.nan_to_num(case["omega_radps"])
    angle = -(omega * dt)[:, None] * camera.axis
    focus = np.where(np.isfinite(case["focus_px"]), case["focus_px"], camera.centre_px)
    way = (np.nan_to_num(case["speed_mps"]) * dt)[:, None] * camera.rays(focus)
    turn = Rotation.from_rotvec(angle).as_matrix()
    half = Rotation.from_rotvec(angle / 2).as_matrix()
    known = dt[dt > 0.0]
    usual = float(np.median(known)) if len(known) else math.nan
    blind = np.zeros(len(dt), bool)
    for age in (case["gyro_age_s"], case["odometer_age_s"]):
        blind |= age > AGE_INTERVALS * usual + np.nanmedian(age)
    a_second = case["intervals"] / np.where(dt > 0.0, dt, np.nan)
    with np.errstate(invalid="ignore"):
        blind |= a_second < FEWEST_INPUTS * np.nanmedian(a_second)
    return Drive(
        settings,
        camera,
        np.nan_to_num(case["landmark_id"], nan=-1.0).astype(np.int64),
        case["measured_px"],
        blunders(case, BLUNDER**2),
        blind,
        dt,
        turn,
        np.einsum("nij,nj->ni", half, way),
    )


# ----------------------------------------------------------------------- noise of the points


class TrackNoise(NamedTuple):
    """Noise of the image points per axis, px: as the tracks show it, as the filter takes it; of so many points."""

    shown_px: float
    taken_px: float
    points: int


def track_noise(case: Case) -> TrackNoise:
    """The noise of the image points, from third differences less what all landmarks of a frame have in common."""
    return case.once(_track_noise)


def _track_noise(case: Case) -> TrackNoise:
    run = drive(case)
    regular = np.abs(run.dt - run.usual_dt) <= REGULAR * run.usual_dt
    found: list[Floats] = []
    for k in range(3, len(run.dt)):
        if not regular[k - 2 : k + 1].all():
            continue
        ids = run.ids[k - 3 : k + 1]
        same = (ids == ids[0]).all(axis=0) & (ids[0] >= 0)
        third = np.diff(run.pixel[k - 3 : k + 1], n=3, axis=0)[0][same]
        third = third[np.isfinite(third[:, 0])]
        if len(third) >= FEWEST:
            # the median takes away a share of the scatter, as a mean does: 1/n of the variance
            found.append((third - np.median(third, axis=0)) * math.sqrt(len(third) / (len(third) - 1)))
    taken = case["innovation_covariance"] - case["prior_covariance"][:, :, :2, :2]
    variance = np.nanmedian(taken[..., 0, 0]) if np.isfinite(taken).any() else math.nan
    points = np.concatenate(found) if found else np.zeros((0, 2))
    shown = spread(points.ravel()) / THIRD_DIFFERENCE
    return TrackNoise(shown, math.sqrt(max(float(variance), 0.0)), len(points))


# ------------------------------------------------------------------------- frame to frame


class Steps(NamedTuple):
    """The step from the frame before to each frame [n], NaN where too few landmarks tell.

    Attributes:
        turn_rad: turn of the image less that of the gyro, to the right.
        turn_sigma_rad: σ of that by the image points alone.
        ratio: step on the image over the one that the filter's motion and ranges predict; 1.
        ratio_sigma: its σ.
    """

    turn_rad: Floats
    turn_sigma_rad: Floats
    ratio: Floats
    ratio_sigma: Floats


def steps(case: Case) -> Steps:
    """What the image says of each step, with the filter's ranges for the share of the way."""
    return case.once(_steps)


def _steps(case: Case) -> Steps:
    run, noise = drive(case), track_noise(case)
    sigma = math.sqrt(2.0) * (noise.shown_px if noise.points else noise.taken_px)
    out = np.full((4, len(run.dt)), np.nan)
    xi = case["mean"][..., 2]
    for k in range(1, len(run.dt)):
        slots = run.shared(k - 1, k)
        slots = slots[np.isfinite(xi[k - 1, slots])]
        if len(slots) < FEWEST or run.dt[k] <= 0.0 or not run.in_plane:
            continue
        before, now = run.pixel[k - 1, slots], run.pixel[k, slots]
        ahead = (run.turn[k] @ run.camera.rays(before).T).T
        predicted = run.camera.pixels(ahead - xi[k - 1, slots, None] * run.shift[k])
        lever = _turned(run.camera, predicted)
        out[:2, k] = _fitted((now - predicted).ravel(), lever.ravel(), sigma)
        out[2:, k] = _fitted((now - before).ravel(), (predicted - before).ravel(), sigma)
    return Steps(*out)


def _turned(camera: Camera, pixel: Floats) -> Floats:
    """∂(x, y)/∂θ [m, 2] of a turn θ about the vehicle's axis, to the right."""
    ray = camera.rays(pixel)
    moved = -np.cross(camera.axis, ray)
    return np.asarray(camera.focal_px * (moved[:, :2] - ray[:, :2] * moved[:, 2:]))


def _fitted(values: Floats, lever: Floats, sigma: float) -> tuple[float, float]:
    """The q of values ≈ lever · q and its σ, by Huber's weights that begin at the weighted median of the quotients."""
    known = np.isfinite(values) & np.isfinite(lever)
    values, lever = values[known], lever[known]
    total = float(lever @ lever)
    if not total > 0.0:
        return math.nan, math.nan
    used = np.abs(lever) > 1e-9 * np.abs(lever).max()
    quotient, weight = values[used] / lever[used], np.abs(lever[used])
    order = np.argsort(quotient)
    q = float(quotient[order][np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())])
    for _ in range(ROUNDS):
        w = _huber((values - q * lever) / sigma)
        q = float((w * lever) @ values / ((w * lever) @ lever))
    return q, sigma / math.sqrt(total)


# ------------------------------------------------------------------- pairs of frames


@dataclass(frozen=True)
class Pair:
    """Two frames, and how far m image points are off the lines that the motion between them draws.

    Attributes:
        first: row of the earlier frame.
        last: row of the later one.
        seconds: between them.
        off: distance from the epipolar line in σ [m].
        by_turn: its change by a turn of 1 rad more than the gyro's [m].
        by_focus: its change by a focus of expansion that lies 1 px to the right, 1 px below [m, 2].
    """

    first: int
    last: int
    seconds: float
    off: Floats
    by_turn: Floats
    by_focus: Floats


def pairs(case: Case, length_s: float, every_s: float) -> list[Pair]:
    """The pairs of frames `length_s` apart between which the vehicle moved, one every `every_s`."""
    return case.once(lambda c: _pairs(c, length_s, every_s), ("pairs", length_s, every_s))


def _pairs(case: Case, length_s: float, every_s: float) -> list[Pair]:
    run, noise = drive(case), track_noise(case)
    sigma = noise.shown_px if noise.points else noise.taken_px
    time = np.cumsum(run.dt)
    found: list[Pair] = []
    if not run.in_plane:
        return found
    begins = np.unique(np.searchsorted(time, np.arange(0.0, time[-1] - length_s + 1e-6, every_s)))
    for first in begins.tolist():
        last = int(np.searchsorted(time, time[first] + length_s - 1e-6))
        if last < len(time):
            pair = _pair(run, first, last, sigma)
            if pair is not None:
                found.append(pair)
    return found


def _pair(run: Drive, first: int, last: int, sigma_px: float) -> Pair | None:
    """r₂ᵀ [t]ₓ R r₁ = 0 for each landmark, linearised in a turn and in the direction of the way."""
    slots = run.shared(first, last)
    slots = slots[~(run.blunder[first, slots] | run.blunder[last, slots])]
    slots = slots[run.blunder[first : last + 1, slots].sum(axis=0) < SLIPPED]  # the others may show two points
    if run.blind[first + 1 : last + 1].any():
        return None
    turn, shift = run.between(first, last)
    seconds = float(run.dt[first + 1 : last + 1].sum())
    if len(slots) < FEWEST or np.linalg.norm(shift) <= WAY_SIGMAS * run.settings.sigma_speed * math.sqrt(seconds):
        return None
    camera = run.camera
    before = (turn @ camera.rays(run.pixel[first, slots]).T).T
    now = camera.rays(run.pixel[last, slots])
    normal = np.cross(shift, before)
    off = (now * normal).sum(axis=1)
    other = np.cross(now, shift) @ turn
    size = np.hypot(np.linalg.norm(normal[:, :2], axis=1), np.linalg.norm(other[:, :2], axis=1))
    scale = camera.focal_px / (sigma_px * np.where(size > 0.0, size, np.nan))
    by_turn = (now * (np.cross(shift, -np.cross(camera.axis, before)))).sum(axis=1)
    by_turn += 0.5 * (now * np.cross(-np.cross(camera.axis, shift), before)).sum(axis=1)
    way = shift[2] / camera.focal_px
    aside = [(now * np.cross(way * axis, before)).sum(axis=1) for axis in np.eye(3)[:2]]
    return Pair(first, last, seconds, scale * off, scale * by_turn, scale[:, None] * np.stack(aside, axis=1))


def turn_of(pair: Pair, sigma_omega: float) -> tuple[float, float]:
    """Rate of turn that the image shows beyond the gyro's, rad/s, and its σ with the gyro's noise in it."""
    turn, sigma = _fitted(-pair.off, pair.by_turn, 1.0)
    return turn / pair.seconds, math.hypot(sigma / pair.seconds, sigma_omega / math.sqrt(pair.seconds))


class Focus(NamedTuple):
    """By how much the image's focus of expansion is off the filter's, px [2], its covariance [2, 2], pairs used."""

    off_px: Floats
    covariance: Floats
    pairs: int

    @property
    def significance(self) -> float:
        """Distance from 0 in σ (Mahalanobis)."""
        return math.sqrt(max(float(self.off_px @ np.linalg.solve(self.covariance, self.off_px)), 0.0))


def focus_of(found: list[Pair], sigma_omega: float) -> Focus | None:
    """The one focus of expansion that all pairs have in common; the turn of each is free within the gyro's noise.

    Least squares with Huber's weights, at last without blunders. Pairs overlap by half, so that the covariance
    is doubled.
    """
    if not found:
        return None
    m = len(found)
    rows = []
    values = []
    for j, pair in enumerate(found):
        block = np.zeros((len(pair.off), m + 2))
        block[:, j] = pair.by_turn
        block[:, m:] = pair.by_focus
        rows.append(block)
        values.append(-pair.off)
    a, b = np.concatenate(rows), np.concatenate(values)
    known = np.isfinite(b)
    a, b = a[known], b[known]
    prior = np.zeros((m, m + 2))
    prior[:, :m] = np.diag([1.0 / max(sigma_omega * math.sqrt(pair.seconds), 1e-6) for pair in found])
    q: Floats = np.zeros(m + 2)
    information: Floats = np.eye(m + 2)
    for number in range(2 * ROUNDS):
        residual = b - a @ q
        w = _huber(residual)
        if number >= ROUNDS:
            w[np.abs(residual) > BLUNDER] = 0.0
        information = (a * w[:, None]).T @ a + prior.T @ prior
        if np.linalg.cond(information[m:, m:]) > 1e8:
            return None
        q = np.asarray(np.linalg.solve(information, (a * w[:, None]).T @ b), dtype=np.float64)
    return Focus(q[m:], np.asarray(2.0 * np.linalg.inv(information)[m:, m:], dtype=np.float64), m)


def depth_at(run: Drive, slot: int, first: int, last: int, sigma_px: float) -> tuple[float, float]:
    """Inverse depth of a landmark at its earlier frame, 1/m, by two views, and its σ; NaN where they tell none."""
    turn, shift = run.between(first, last)
    before = turn @ run.camera.rays(run.pixel[first, slot])
    now = run.camera.rays(run.pixel[last, slot])
    # now ∝ before - ξ shift: the part across `now`
    across = np.cross(now, before), np.cross(now, shift)
    lever = float(across[1] @ across[1])
    if not lever > 0.0:
        return math.nan, math.nan
    seconds = float(run.dt[first + 1 : last + 1].sum())
    turned = run.settings.sigma_omega * math.sqrt(seconds)
    sigma = math.hypot(math.sqrt(2.0) * sigma_px / run.camera.focal_px, turned)
    return float(across[0] @ across[1]) / lever, sigma * float(np.linalg.norm(now)) / math.sqrt(lever)


def median_nis(case: Case) -> Floats:
    """Median NIS of the landmarks in each frame [n], NaN where none was measured."""
    return case.once(_median_nis)


def _median_nis(case: Case) -> Floats:
    nis = np.where(updated(case), case["nis"], np.nan)
    out = np.full(len(nis), np.nan)
    some = np.isfinite(nis).any(axis=1)
    out[some] = np.nanmedian(nis[some], axis=1)
    return out


def blunders(case: Case, nis: float, quiet: float = QUIET_NIS) -> Bools:
    """Image points [n, N] of a larger NIS than that in frames whose median NIS is below the quiet one."""
    return np.asarray(updated(case) & (case["nis"] > nis) & (median_nis(case) < quiet)[:, None])


def updated(case: Case) -> Bools:
    """Which landmarks [n, N] had an innovation, whether it was used or not."""
    innovated = np.isin(case["outcome"], [Outcome.UPDATED, Outcome.REJECTED, Outcome.RESET])
    return np.asarray(innovated & np.isfinite(case["nis"]))
