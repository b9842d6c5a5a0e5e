"""How far an odometry is off, in paper A's own terms (its section 3.2), and the block ratio that shows its bias.

Paper A gives relative errors without saying to what. Here an error e of a coordinate g is related to the
coordinate's distance from the start, sqrt(Σ e² / Σ (g - g₀)²), and the last error to the range of the
coordinate. Its third figure, 0.0569, is the mean of its first two, so that mean is given as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipelines.geometry import Floats, wrap_angles

FAILED_PX = 1.0
"""A motion between frames whose shift is further off than this is a failure."""
BLOCK_FRAMES = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """An estimated path against its truth: errors of the positions, and of the motions between frames.

    `relative_*`, `end_x`, `end_y` (of the coordinate's range) and `end_path` (of the path) are shares; `yaw_rad` is the
    error of the heading at the end, `heading_rad` its rms; `shift_px` and
    `turn_rad` are rms errors per frame and `block_ratio` is that of the turns, over all frames that did not fail;
    `failed_turn_rad` is how far those that did have turned the heading in all, magnitudes added.
    """

    relative_x: float
    relative_y: float
    relative_euclid: float
    relative_mean: float
    rms_m: float
    end_x: float
    end_y: float
    end_m: float
    end_path: float
    yaw_rad: float
    heading_rad: float
    shift_px: float
    turn_rad: float
    block_ratio: float
    failures: int
    failed_turn_rad: float
    frames: int

    @property
    def failed(self) -> float:
        """Share of the motions between frames that failed."""
        return self.failures / max(self.frames - 1, 1)


def accuracy(pose: Floats, truth: Floats, shift_error_px: Floats, turn_error_rad: Floats) -> Accuracy:
    """Judge poses [n, 3] (x, y, heading) against true ones [n, 3], and the motions between them.

    Args:
        pose: estimated poses, which start at the true one.
        truth: true poses.
        shift_error_px: errors [n - 1, 2] of the shifts of the image centre.
        turn_error_rad: errors [n - 1] of the turns.
    """
    error = pose - truth
    x, y = (relative_rms(error[:, k], truth[:, k]) for k in (0, 1))
    spread = np.ptp(truth[:, :2], axis=0)
    end_m = float(np.hypot(*error[-1, :2]))
    path_m = float(np.hypot(*np.diff(truth[:, :2], axis=0).T).sum())
    failed = ~(np.hypot(*shift_error_px.T) <= FAILED_PX)
    return Accuracy(
        relative_x=x,
        relative_y=y,
        relative_euclid=relative_rms(error[:, :2], truth[:, :2]),
        relative_mean=(x + y) / 2,
        rms_m=float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        end_x=share(abs(error[-1, 0]), spread[0]),
        end_y=share(abs(error[-1, 1]), spread[1]),
        end_m=end_m,
        end_path=share(end_m, path_m),
        yaw_rad=float(wrap_angles(error[-1:, 2])[0]),
        heading_rad=rms(wrap_angles(error[:, 2])),
        shift_px=rms(shift_error_px[~failed]),
        turn_rad=rms(turn_error_rad[~failed]),
        block_ratio=block_ratio(turn_error_rad[~failed]),
        failures=int(failed.sum()),
        failed_turn_rad=float(np.nansum(np.abs(turn_error_rad[failed]))),
        frames=len(truth),
    )


def relative_rms(error: Floats, truth: Floats) -> float:
    """sqrt(Σ e² / Σ (g - g₀)²) of errors and true values [n] or [n, 2], g₀ the first one; NaN where g rests."""
    return math.sqrt(share(float(np.sum(error**2)), float(np.sum((truth - truth[0]) ** 2))))


def block_ratio(errors: Floats, frames: int = BLOCK_FRAMES) -> float:
    """RMS of the sums of `frames` consecutive errors over that of white noise of the same standard deviation.

    1 where errors are independent; more where they add up, however small each is; NaN below one block.
    """
    blocks = len(errors) // frames
    if blocks == 0:
        return math.nan
    sums = errors[: blocks * frames].reshape(blocks, frames).sum(axis=1)
    return share(rms(sums), float(errors.std()) * math.sqrt(frames))


def rms(values: Floats) -> float:
    """Root of the mean square of all values, NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def share(part: float, whole: float) -> float:
    """`part` over `whole`, NaN where the whole is nothing."""
    return float(part / whole) if whole > 0 else math.nan
