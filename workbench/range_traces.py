"""Steps of the range filter as what is drawn of them: plain arrays, without a word about the recording's format.

n steps, N slots of landmarks. Points on images are those of the viewer, which puts the corner of the first pixel at
(0, 0): half a pixel more than the Step says. The map is the ground from above: x, y in m, headings counter-clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.equations import range_interval
from pipelines.ranging.filter import Outcome, Status
from workbench.traces import Columns, finite, table_form

Floats = NDArray[np.float64]
Colours = NDArray[np.uint32]
Bools = NDArray[np.bool_]

GATE = 13.8
"""χ² of the ellipse around a predicted image point."""
ELLIPSE_POINTS = 17
PLOTTED = 24
"""Slots that have plots of their own."""
LISTED = 50
"""Landmarks in the table of numbers."""
LABELLED = 20
"""Landmarks whose labels are shown all the time."""
NEAR_M, FAR_M = 0.5, 50.0
"""Ends of the colours of range, which are logarithmic between."""
LONGEST_RAY = 3.0
"""A ray of a range that is not known ends at so many times the range."""
FARTHEST_FOCUS_PX = 1000.0
"""A landmark farther from the focus of expansion has no such line in its plot."""
ELLIPSE_SIGMA = 0.3
"""σ_ξ/ξ up to which an ellipse says what is known; beyond, only the ray does."""

STATUS_COLOURS: Mapping[Status, int] = {
    Status.UNKNOWN: 0x9E9E9EFF,
    Status.CONVERGING: 0xFFB300FF,
    Status.CONVERGED: 0x4CAF50FF,
    Status.REJECTED: 0xF44336FF,
    Status.RESET: 0xE040FBFF,
    Status.LOST: 0x5D4037FF,
}
_STATUS_TABLE = np.array([STATUS_COLOURS[status] for status in Status], np.uint32)
_TURBO = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0].astype(np.uint32)


def _same(points_px: Floats) -> Floats:
    return points_px


@dataclass(frozen=True, slots=True)
class RangeScene:
    """What the drawing needs to know beyond the steps.

    Attributes:
        focal_px: of the pinhole that image points are for.
        centre_px: its principal point.
        image_px: width and height of the images, None where unknown.
        on_image: from points of that pinhole [n, 2] to pixels of the images as they are shown.
        surveyed: places of landmarks in the world [3] by their numbers.
        referenced: whether a reference tells where the camera is; else the path is dead reckoned.
    """

    focal_px: float = 1.0
    centre_px: tuple[float, float] = (0.0, 0.0)
    image_px: tuple[float, float] | None = None
    on_image: Callable[[Floats], Floats] = _same
    surveyed: Mapping[int, Floats] = field(default_factory=dict)
    referenced: bool = False


class Beside(NamedTuple):
    """What the reference says at a frame.

    Attributes:
        world_t_camera: pose of the camera [4, 4]; NaN where unknown.
        depth_m: along the optical axis to the landmark in each slot [N]; NaN where unknown.
    """

    world_t_camera: Floats
    depth_m: Floats


# ------------------------------------------------------------------------------ on the image


def status_colours(status: Floats) -> Colours:
    """RGBA by status, which may be NaN for none."""
    return _STATUS_TABLE[np.nan_to_num(status).astype(np.int64)]


def range_colours(range_m: Floats) -> Colours:
    """RGBA by range: red at `NEAR_M`, blue at `FAR_M`."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.log(np.nan_to_num(range_m, nan=FAR_M, posinf=FAR_M).clip(NEAR_M, FAR_M) / NEAR_M)
    place = np.round(255 * (1 - share / math.log(FAR_M / NEAR_M))).astype(np.int64)
    blue, green, red = _TURBO[place].reshape(-1, 3).T
    colours: Colours = (red << 24 | green << 16 | blue << 8 | 0xFF).astype(np.uint32)
    return colours.reshape(place.shape)


def shown(points_px: Floats, scene: RangeScene) -> Floats:
    """Points [n, N, 2] of the pinhole where the viewer has them on the image."""
    return scene.on_image(points_px.reshape(-1, 2)).reshape(points_px.shape) + 0.5


def gates(centres_px: Floats, covariance: Floats) -> Floats:
    """Ellipses νᵀ S⁻¹ ν = 13.8 around points [m, 2] with covariances [m, 2, 2], as closed lines [m, points, 2]."""
    angle = np.linspace(0, 2 * np.pi, ELLIPSE_POINTS)
    values, vectors = np.linalg.eigh(covariance)
    half = vectors * np.sqrt(GATE * values.clip(0))[:, None, :]
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centres_px[:, None, :] + np.swapaxes(half @ circle, 1, 2))


def labels(table: Columns, chosen: Bools) -> list[str]:
    """Number and range of some landmarks [n, N], one after another."""
    numbers, ranges = table["landmark_id"][chosen].tolist(), table["range_m"][chosen].tolist()
    told = (table["status"][chosen] >= Status.CONVERGING).tolist()
    return [
        f"{number:.0f}: {depth:.2f} m" if known and math.isfinite(depth) else f"{number:.0f}"
        for number, depth, known in zip(numbers, ranges, told, strict=True)
    ]


# ---------------------------------------------------------------------------------- from above


def dead_reckoned(table: Columns, start: Floats) -> Floats:
    """Camera poses x, y, heading [n, 3] after a pose [3], by the speeds that the filter used."""
    dt = np.nan_to_num(table["dt_s"])
    turn = -np.nan_to_num(table["omega_radps"]) * dt  # the camera's y axis points down
    way = np.nan_to_num(table["speed_mps"]) * dt
    heading = start[2] + np.cumsum(turn)
    middle = heading - turn / 2
    x, y = start[0] + np.cumsum(way * np.cos(middle)), start[1] + np.cumsum(way * np.sin(middle))
    return np.column_stack([x, y, heading])


def level(poses: Floats) -> Floats:
    """`world_t_camera` [n, 4, 4] of level cameras at x, y, heading [n, 3]."""
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    cameras = np.zeros((len(poses), 4, 4))
    cameras[:, :2, 0] = np.column_stack([sine, -cosine])
    cameras[:, 2, 1] = -1
    cameras[:, :2, 2] = np.column_stack([cosine, sine])
    cameras[:, :2, 3] = poses[:, :2]
    cameras[:, 3, 3] = 1
    return cameras


class Above(NamedTuple):
    """Landmarks from above, m of them, step by step.

    Attributes:
        counts: of each step [n].
        points: where they are [m, 2].
        rays: nearest and farthest place [m, 2, 2].
        colours: by status [m].
        sure: whose ellipse says what is known [m].
        half_axes: of the 2σ ellipse [m, 2].
        angle: direction of its first axis [m].
    """

    counts: NDArray[np.int64]
    points: Floats
    rays: Floats
    colours: Colours
    sure: Bools
    half_axes: Floats
    angle: Floats


def from_above(table: Columns, cameras: Floats, scene: RangeScene) -> Above:
    """The landmarks of n steps from cameras with the poses `world_t_camera` [n, 4, 4]."""
    mean, status, depth = table["mean"], table["status"], table["range_m"]
    seen = finite(mean, 2) & np.isfinite(depth) & (depth > 0) & finite(cameras, (1, 2))[:, None]
    seen &= np.asarray(status != Status.LOST)
    which = np.nonzero(seen)[0]
    turn, place = cameras[which, :2, :3], cameras[which, :2, 3]
    aside = (mean[seen][:, :2] - scene.centre_px) / scene.focal_px
    direction = np.einsum("mij,mj->mi", turn, np.column_stack([aside, np.ones(len(aside))]))
    z = depth[seen]
    near, far = table["range_interval_m"][seen].T
    ends = np.stack([near, np.fmin(far, LONGEST_RAY * z)], axis=1)
    half, angle = _ellipses(table["covariance"][seen], mean[seen][:, 2], aside, turn, scene.focal_px)
    return Above(
        counts=seen.sum(axis=1),
        points=place + z[:, None] * direction,
        rays=place[:, None, :] + ends[:, :, None] * direction[:, None, :],
        colours=status_colours(status[seen]),
        sure=np.asarray(table["relative_sigma"][seen] < ELLIPSE_SIGMA, np.bool_),
        half_axes=half,
        angle=angle,
    )


def _ellipses(covariance: Floats, xi: Floats, aside: Floats, turn: Floats, focal_px: float) -> tuple[Floats, Floats]:
    """Half axes [m, 2] and direction [m] of the 2σ ellipses of (a, b, 1)/ξ from above, by its derivative with X.

    Args:
        covariance: P [m, 3, 3].
        xi: ξ [m].
        aside: a, b = (x - c)/f [m, 2].
        turn: first two rows of `world_r_camera` [m, 2, 3].
        focal_px: f.
    """
    jacobian = np.zeros((len(xi), 3, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1 / (focal_px * xi)
    jacobian[:, :2, 2] = -aside / xi[:, None] ** 2
    jacobian[:, 2, 2] = -1 / xi**2
    full = turn @ jacobian
    values, vectors = np.linalg.eigh(np.nan_to_num(full @ covariance @ np.swapaxes(full, 1, 2)))
    return 2 * np.sqrt(values.clip(0)), np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0])


# ------------------------------------------------------------------------------ plots of a slot


class Plot(NamedTuple):
    """One plot of one slot: its name, its series, their colours, and whether each is a thin line."""

    name: str
    series: tuple[str, ...]
    colours: tuple[int, ...]
    thin: tuple[bool, ...]


BLUE, ORANGE, GREEN, GREY = 0x4FC3F7FF, 0xFFB74DFF, 0x2ECC71FF, 0x9E9E9EFF
PURPLE = 0xCE93D8FF
PLOTS = (
    Plot(
        "range",
        ("Z [m]", "nearest [m]", "farthest [m]", "reference [m]"),
        (BLUE, 0x4FC3F7A0, 0x4FC3F7A0, GREEN),
        (False, True, True, False),
    ),
    Plot(
        "xi",
        ("ξ [1/m]", "ξ - 2σ", "ξ + 2σ", "reference [1/m]"),
        (BLUE, 0x4FC3F7A0, 0x4FC3F7A0, GREEN),
        (False, True, True, False),
    ),
    Plot("sigma", ("σ_x [px]", "σ_y [px]"), (BLUE, ORANGE), (False, False)),
    Plot("relative_sigma", ("σ_ξ/ξ",), (BLUE,), (False,)),
    Plot(
        "innovation",
        ("ν_x [px]", "ν_y [px]", "-2 √S_xx", "2 √S_xx", "-2 √S_yy", "2 √S_yy"),
        (BLUE, ORANGE, 0x4FC3F790, 0x4FC3F790, 0xFFB74D90, 0xFFB74D90),
        (False, False, True, True, True, True),
    ),
    Plot("nis", ("NIS",), (BLUE,), (False,)),
    Plot(
        "gain",
        ("K_xx", "K_xy", "K_yx", "K_yy", "K_ξx [1/m/px]", "K_ξy [1/m/px]"),
        (BLUE, 0x4FC3F790, 0xFFB74D90, ORANGE, 0x81C784FF, 0xE57373FF),
        (False, True, True, False, False, False),
    ),
    Plot("parallax", ("parallax [px]", "derotated [px]", "to the focus [px]"), (GREY, BLUE, ORANGE),
         (True, False, False)),
)  # fmt: skip
SMOOTHED = Plot(
    "range",
    ("smoothed Z [m]", "nearest [m]", "farthest [m]"),
    (PURPLE, 0xCE93D8A0, 0xCE93D8A0),
    (False, True, True),
)


def smoothed(mean: Floats, covariance: Floats) -> Floats:
    """Z, nearest and farthest of n smoothed states [n, 3]; NaN where ξ says nothing of the range."""
    xi = np.where(mean[:, 2] > 0.0, mean[:, 2], np.nan)
    near, far = range_interval(xi, np.sqrt(covariance[:, 2, 2]))
    values = np.stack([1.0 / xi, near, far], axis=-1)
    return np.where(np.isfinite(values), values, np.nan)


def plotted(table: Columns, reference_m: Floats, slots: int) -> dict[str, Floats]:
    """The series of the first slots by the plot's name [n, slots, series]; what is not finite is NaN.

    Args:
        table: n steps.
        reference_m: reference depths [n, N].
        slots: how many.
    """
    at = np.s_[:, :slots]
    xi, spread = table["mean"][at][..., 2], table["covariance"][at]
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt(np.diagonal(spread, axis1=2, axis2=3))
        reach = 2 * np.sqrt(np.diagonal(table["innovation_covariance"][at], axis1=2, axis2=3))
        reference = reference_m[at]
        near, far = np.moveaxis(table["range_interval_m"][at], -1, 0)
        innovation = table["innovation_px"][at]
        found = {
            "range": np.stack([table["range_m"][at], near, far, reference], -1),
            "xi": np.stack([xi, xi - 2 * sigma[..., 2], xi + 2 * sigma[..., 2], 1 / reference], -1),
            "sigma": sigma[..., :2],
            "relative_sigma": table["relative_sigma"][at][..., None],
            "innovation": np.concatenate([innovation, np.stack([-reach, reach], -1).reshape(*reach.shape[:2], 4)], -1),
            "nis": table["nis"][at][..., None],
            "gain": table["gain"][at].reshape(*xi.shape, 6),
            "parallax": np.stack(
                [table["parallax_px"][at], table["derotated_parallax_px"][at], _near(table["focus_distance_px"][at])],
                -1,
            ),
        }
    return {name: np.where(np.isfinite(values), values, np.nan) for name, values in found.items()}


def _near(focus_distance_px: Floats) -> Floats:
    """Distances from the focus of expansion as far as they matter; in a turn it lies anywhere, and hides the rest."""
    return np.where(focus_distance_px < FARTHEST_FOCUS_PX, focus_distance_px, np.nan)


# -------------------------------------------------------------------------------------- tables

_NAMES = {status: status.name.lower() for status in Status} | {-1: ""}
_OUTCOMES = {outcome: outcome.name.lower() for outcome in Outcome} | {-1: ""}
_INPUTS = "ω %.5f rad/s, V %.4f m/s over %.4f s; %d carried, %d measured, %d converged\n\n"


def numbers(table: Columns, reference_m: Floats) -> list[str]:
    """Each step's landmarks as Markdown tables: ranges, P, K, S; the first `LISTED` that are carried.

    Args:
        table: n steps.
        reference_m: reference depths [n, N].
    """
    n, total = table["landmark_id"].shape
    id_, cov, gain = table["landmark_id"], table["covariance"].reshape(n, total, 9), table["gain"].reshape(n, total, 6)
    near, far = np.moveaxis(table["range_interval_m"], -1, 0)
    error = 100 * (table["range_m"] / reference_m - 1)
    ranges = np.stack(
        [id_, table["status"], table["outcome"], table["range_m"], near, far, error, table["relative_sigma"],
         table["nis"], *np.moveaxis(table["innovation_px"], -1, 0)], -1,
    )  # fmt: skip
    matrices = np.concatenate(
        [id_[..., None], cov[..., [0, 1, 2, 4, 5, 8]], gain,
         table["innovation_covariance"].reshape(n, total, 4)[..., [0, 1, 3]]], -1,
    )  # fmt: skip
    carried = ~np.isnan(id_)
    heads = [table[k].tolist() for k in ("omega_radps", "speed_mps", "dt_s", "landmarks", "measured", "converged")]
    found = []
    for row, head in enumerate(zip(*heads, strict=True)):
        some = np.flatnonzero(carried[row])
        text = _INPUTS % head
        if len(some):
            text += _lines(ranges[row, some[:LISTED]].tolist(), matrices[row, some[:LISTED]].tolist())
        if len(some) > LISTED:
            text += f"\n{len(some) - LISTED} more landmarks are in the recording's columns.\n"
        found.append(text)
    return found


def _lines(ranges: Sequence[Sequence[float]], matrices: Sequence[Sequence[float]]) -> str:
    head, line = _RANGES
    parts = [head]
    parts += [line % (row[0], _word(_NAMES, row[1]), _word(_OUTCOMES, row[2]), *row[3:]) for row in ranges]
    for (head, line), first, last in ((_COVARIANCES, 1, 7), (_GAINS, 7, 16)):
        parts.append("\n" + head)
        parts += [line % (row[0], *row[first:last]) for row in matrices]
    return "".join(parts)


def _word(words: Mapping[int, str], value: float) -> str:
    return words[int(value)] if math.isfinite(value) else ""


_RANGES = table_form(
    "Landmarks (Z in m, error in %, ν in px)", "# status outcome Z nearest farthest error σ_ξ/ξ NIS ν·x ν·y",
    "%.0f %s %s %.3f %.3f %.3f %.2f %.4f %.2f %.3f %.3f",
)  # fmt: skip
_COVARIANCES = table_form("P (x, y px; ξ 1/m)", "# xx xy xξ yy yξ ξξ", "%.0f" + " %.3e" * 6)
_GAINS = table_form("K, and S in px²", "# K·xx K·xy K·yx K·yy K·ξx K·ξy S·xx S·xy S·yy", "%.0f" + " %.3g" * 9)
