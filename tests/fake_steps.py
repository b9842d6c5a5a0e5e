"""Plausible correlation steps and images for tests of the log, from a seed, without the estimator."""

import math
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.correlation.step import CorrelationStep
from pipelines.verdict import Verdict, gravest
from readers.streams import ImageSample, PoseSample, array

SIZE = 512
PERIOD_NS = 16_666_667
START_NS = 1_712_345_678_123_456_789
SIDE, RADIUS = 21, 8
W = 0.0005


def t_of(frame: int) -> int:
    return START_NS + frame * PERIOD_NS


def fragments(count: int) -> NDArray[np.float64]:
    """Centres of a grid of fragments: 2 along u, or 3 x 3."""
    if count == 2:
        return np.array([[156.0, 256.0], [356.0, 256.0]])
    u, v = np.meshgrid([126.0, 256.0, 386.0], [126.0, 256.0, 386.0])
    return np.column_stack([u.ravel(), v.ravel()])


def tiles(fragment_count: int) -> NDArray[np.float64]:
    """Centres of the photometric tiles: none with two fragments, else 9 x 8."""
    if fragment_count == 2:
        return np.empty((0, 2))
    u, v = np.meshgrid(np.linspace(13.0, 498.0, 9), np.linspace(13.0, 498.0, 8))
    return np.column_stack([u.ravel(), v.ravel()])


def path(frame: float) -> NDArray[np.float64]:
    """True x, y, heading: a loop that starts eastward."""
    a = 2 * math.pi * frame / 1500
    return np.array([0.8 * math.sin(a), 0.5 * (1 - math.cos(a)), math.atan2(0.5 * math.sin(a), 0.8 * math.cos(a))])


def alarms_of(frame: int) -> Verdict:
    if frame == 0:
        return Verdict.FIRST_FRAME
    phase = frame % 400
    alarms = Verdict.OK
    if 120 <= phase < 135:
        alarms |= Verdict.PEAK_AMBIGUOUS
    if 128 <= phase < 140:
        alarms |= Verdict.NOT_RIGID
    if 300 <= phase < 306:
        alarms |= Verdict.LOW_TEXTURE | Verdict.APERTURE
    if phase == 399:
        alarms |= Verdict.CORRECTION_APPLIED
    return alarms


def steps(count: int, *, fragment_count: int = 9, seed: int = 1, start: int = 0) -> Iterator[CorrelationStep]:
    rng = np.random.default_rng(seed)
    f = fragment_count
    centres, tile_centres = fragments(f), tiles(f)
    side = 2 * RADIUS + 1
    grid = np.arange(side) - RADIUS
    raw = path(start)
    spread = np.zeros((3, 3))
    total = np.zeros(2)
    sum_m = reference_m = 0.0
    nan_surface = np.full((f, side, side), np.nan, np.float32)
    for frame in range(start, start + count):
        before, now = path(frame - 1), path(frame)
        alarms = alarms_of(frame)
        first = frame == 0
        moved = now - before + rng.normal(0, [2e-5, 2e-5, 2e-5])
        c, s = math.cos(before[2]), math.sin(before[2])
        body = np.array([c * moved[0] + s * moved[1], -s * moved[0] + c * moved[1]])
        shift = np.array([-body[0], body[1]]) / W + rng.normal(0, 0.02, (f, 2))
        if Verdict.NOT_RIGID in alarms:
            shift[-1] += 3.0
        predicted = np.round(shift + rng.normal(0, 2, (f, 2)))
        integer = np.round(shift)
        at = integer - predicted
        second = np.clip(at + rng.integers(3, 6, (f, 2)) * rng.choice([-1, 1], (f, 2)), -RADIUS, RADIUS)
        height = np.where(Verdict.PEAK_AMBIGUOUS in alarms, 0.93, 0.5) * rng.uniform(0.9, 1.0, f)
        peak = rng.uniform(0.9, 0.99, f)
        hills = [
            h[:, None, None]
            * np.exp(-((grid - p[:, :1, None][:, 0]) ** 2)[:, None, :] / 9)
            * np.exp(-((grid - p[:, 1:, None][:, 0]) ** 2)[:, :, None] / 9)
            for h, p in ((peak, at), (height, second))
        ]
        surface = (np.maximum(*hills) * 1.2 - 0.2 + rng.normal(0, 0.02, (f, side, side))).astype(np.float32)
        if frame % 7 == 3:
            surface[0, :, :3] = np.nan
        hessian = np.array([[800.0, 40.0], [40.0, 650.0]]) * rng.uniform(0.8, 1.2, (f, 1, 1))
        eigen = np.linalg.eigvalsh(hessian)
        spread = spread + np.diag([4e-10, 9e-10, 1e-9]) + 1e-11
        raw = raw + moved
        correction = np.array([1e-3, -5e-4]) if Verdict.CORRECTION_APPLIED in alarms else np.zeros(2)
        total = total + correction
        step_m = float(np.hypot(*moved[:2]))
        sum_m, reference_m = sum_m + step_m, reference_m + float(np.hypot(*(now - before)[:2]))

        tile_shift = -body[:2] / W * [1, -1] + rng.normal(0, 0.05, tile_centres.shape)

        def unless_first(values: NDArray[np.float64], first: bool = first) -> NDArray[np.float64]:
            return np.full(np.shape(values), np.nan) if first else np.asarray(values, float)

        yield CorrelationStep(
            frame=frame,
            t_ns=t_of(frame),
            received_ns=t_of(frame) + int(rng.integers(1, 2_000_000)),
            verdict=gravest(alarms),
            alarms=alarms,
            accepted=not first and Verdict.NOT_RIGID not in alarms,
            template_frame=frame - 1,
            dt_s=math.nan if first else PERIOD_NS * 1e-9,
            image_size_px=array(SIZE, SIZE),
            mean_grey=float(rng.normal(120, 2)),
            gradient_energy=float(rng.normal(300, 10)),
            fragment_side_px=SIDE,
            search_radius_px=RADIUS,
            fragment_px=centres,
            predicted_shift_px=unless_first(predicted),
            search_centre_px=unless_first(centres + predicted),
            surface=nan_surface if first else surface,
            peak_px=unless_first(integer),
            peak_correlation=unless_first(peak),
            second_peak_px=unless_first(predicted + second),
            second_peak_correlation=unless_first(height),
            peak_ratio=unless_first(height / peak),
            peak_curvature=unless_first(rng.uniform(0.05, 0.1, f)),
            peak_anisotropy=unless_first(rng.uniform(1, 2, f)),
            delta_px=unless_first(shift - integer),
            hessian=hessian,
            condition=eigen[:, 1] / eigen[:, 0],
            smallest_eigenvalue=eigen[:, 0] / SIDE**2,
            iterations=unless_first(rng.integers(2, 6, f).astype(float)),
            gain=unless_first(rng.normal(1, 0.01, f)),
            offset=unless_first(rng.normal(0, 1, f)),
            match_grey=unless_first(rng.normal(120, 5, f)),
            gradient=rng.normal(300, 10, f),
            residual_rms=unless_first(rng.normal(3, 0.2, f)),
            sigma_px=unless_first(rng.uniform(0.01, 0.03, (f, 2))),
            shift_px=unless_first(shift),
            weight=unless_first(np.where(np.abs(shift - np.median(shift, 0)).max(1) > 1, 0.0, rng.uniform(0.7, 1, f))),
            fit_residual_px=unless_first(shift - np.median(shift, 0)),
            inliers=0 if first else f - (Verdict.NOT_RIGID in alarms),
            rigidity_px=math.nan if first else float(rng.normal(0, 0.02)),
            scale=math.nan if first else float(rng.normal(1, 1e-4)),
            centre_shift_px=unless_first(shift.mean(0)),
            template_rotation_rad=math.nan if first else float(moved[2]),
            tile_px=tile_centres,
            tile_shift_px=unless_first(tile_shift),
            tile_weight=np.zeros(len(tile_centres)) if first else rng.uniform(0, 1, len(tile_centres)),
            motion_covariance=unless_first(np.diag([4e-4, 4e-4, 1e-8]) + 1e-9),
            rotation_limit_rad=1 / SIDE,
            frame_shift_px=unless_first(shift.mean(0)),
            delta_heading_rad=math.nan if first else float(moved[2]),
            heading_rad=float(raw[2]),
            metres_per_px=W,
            height_m=math.nan,
            path_step_m=math.nan if first else step_m,
            increment_m=unless_first(moved[:2]),
            segment_frames=frame % 400,
            segment_sum_m=sum_m,
            segment_reference_m=reference_m,
            relative_deviation=(sum_m - reference_m) / sum_m if frame % 400 == 399 else math.nan,
            deviation_m=sum_m - reference_m if frame % 400 == 399 else math.nan,
            correction_m=correction,
            correction_total_m=total,
            pose_raw=raw,
            pose=raw + np.append(total, 0.0),
            pose_covariance=spread,
        )


def texture(seed: int = 1) -> NDArray[np.uint8]:
    """A gravel-like grey texture, 1024 x 1024."""
    noise = np.random.default_rng(seed).normal(0, 1, (1024, 1024)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 3) + 0.4 * cv2.GaussianBlur(noise, (0, 0), 9)
    return np.asarray(np.clip(120 + 45 * blurred / blurred.std(), 0, 255), np.uint8)


def image(frame: int, surface: NDArray[np.uint8], encoding: str = "jpeg") -> ImageSample:
    """What the camera saw at that frame, by rolling the texture."""
    u, v = (int(p / W) for p in path(frame)[:2])
    pixels = np.ascontiguousarray(np.roll(surface, (v, -u), (0, 1))[:SIZE, :SIZE])
    payload = pixels.tobytes() if encoding == "mono8" else cv2.imencode("." + encoding, pixels)[1].tobytes()
    return ImageSample(
        stream="/camera", t_ns=t_of(frame), received_ns=t_of(frame), encoding=encoding, payload=payload,
        width_px=SIZE, height_px=SIZE, step_bytes=SIZE,
    )  # fmt: skip


def reference(count: int) -> list[PoseSample]:
    """Reference poses at half the frame rate."""
    poses = []
    for frame in range(0, count, 2):
        x, y, heading = path(frame)
        poses.append(
            PoseSample(
                stream="/reference",
                t_ns=t_of(frame),
                received_ns=t_of(frame),
                position_m=array(x, y, 0.3),
                quat_xyzw=array(0, 0, math.sin(heading / 2), math.cos(heading / 2)),
                covariance=np.full((6, 6), np.nan),
            )
        )
    return poses
