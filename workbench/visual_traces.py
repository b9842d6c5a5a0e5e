"""Steps of a visual odometry as what is drawn of them: plain arrays, without a word about the recording's format.

n steps; lists of points, filters, keyframes come one after another (`traces.Joined`). Points on images are those of
the viewer, which puts the corner of the first pixel at (0, 0): half a pixel more than the Step says.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.semidirect.step import Feature, Stage
from workbench.traces import Columns, Joined, table_form

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Colours = NDArray[np.uint32]

FEATURE_COLOURS: Mapping[Feature, int] = {
    Feature.MATCHED: 0x4CAF50FF,
    Feature.OUT_OF_VIEW: 0x607D8BFF,
    Feature.OBLIQUE: 0x7E57C2FF,
    Feature.REFERENCE_OUT_OF_VIEW: 0x26A69AFF,
    Feature.FLAT: 0x8D6E63FF,
    Feature.LEFT_IMAGE: 0xF06292FF,
    Feature.NOT_CONVERGED: 0xFFB300FF,
    Feature.NOT_TRIED: 0x9E9E9EFF,
    Feature.OUTLIER: 0xF44336FF,
}
STATE_COLOURS = (0x1B7A2EFF, 0x4CAF50FF, 0xB9F6CAFF)
"""Of a matched point: candidate, known, good (`local_map.PointState`)."""
FILTER_NAMES = ("updated", "no match", "converged", "diverged", "unseen")
"""As `depth_filter.Outcome`, which comes with compiled code."""
FILTER_COLOURS = (0x29B6F6FF, 0xFFB300FF, 0x4CAF50FF, 0xF44336FF, 0x9E9E9EFF)
DIVERGED = 3
UNSEEN = 4
STAGE_NAMES = tuple(stage.name for stage in Stage)
STOP_NAMES = ("not run", "converged", "rose", "iterations", "singular", "too few patches")
"""As `alignment.Stop`, which comes with compiled code."""
BAD_RESIDUAL = 20.0
"""Residual of a patch of the alignment that is drawn red, grey levels."""
FRUSTUM_DEPTH = 0.12
"""Depth of a keyframe's frustum, in scene depths."""
FOLLOWED = 8
"""Depth filters that are followed at once, each from its start to its end."""
KEPT_DIVERGED = 16
"""Diverged filters whose history is shown, the first ones of a run."""
HISTORY_FRAMES = 300
"""Frames of that history."""
SURE, UNSURE = 0.001, 0.1
"""Ends of the colours of a map point's σ over the scene's depth, logarithmic between."""


def feature_colours(outcome: Ints, state: Ints | None) -> Colours:
    """RGBA of points [N] by what became of them; matched ones by their state, where that is known [N]."""
    table = np.array([FEATURE_COLOURS[feature] for feature in Feature], np.uint32)
    colours = table[outcome]
    if state is None:
        return colours
    shade = np.array(STATE_COLOURS, np.uint32)[np.clip(state, 0, len(STATE_COLOURS) - 1)]
    return np.where(outcome == Feature.MATCHED, shade, colours).astype(np.uint32)


def found(outcome: Ints) -> NDArray[np.bool_]:
    """Which points [N] were found in the image, also those that do not agree with the pose."""
    return np.isin(outcome, (Feature.MATCHED, Feature.OUTLIER))


def heat(share: Floats) -> Colours:
    """RGBA from green for 0 over yellow to red for 1; grey where a number is not known."""
    known = np.clip(np.nan_to_num(share), 0, 1)
    red = np.round(np.minimum(1, 2 * known) * 235).astype(np.uint32)
    green = np.round(np.minimum(1, 2 - 2 * known) * 200).astype(np.uint32)
    colours = (red << 24) | (green << 16) | np.uint32(0x30 << 8 | 0xFF)
    return np.where(np.isfinite(share), colours, np.uint32(0x9E9E9EFF)).astype(np.uint32)


def sureness(sigma_m: Floats, depth_m: Floats) -> Floats:
    """A map point's σ on the scale of `heat`: 0 for 0.1 % of the scene's depth, 1 for 10 %."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(sigma_m / depth_m / SURE) / math.log(UNSURE / SURE)
    return np.asarray(np.where(np.isfinite(sigma_m / depth_m), np.clip(share, 0, 1), np.nan))


def frusta(
    position_m: Floats, quat_xyzw: Floats, focal_px: tuple[float, float], size_px: Floats, depth: Floats
) -> Floats:
    """The edges of cameras [K] as one strip each, [K, 11, 3].

    Args:
        position_m: centres [K, 3].
        quat_xyzw: rotations from camera axes to the world [K, 4].
        focal_px: along u and v.
        size_px: width and height of the image [2].
        depth: of each frustum [K].
    """
    x, y = size_px / 2 / np.array(focal_px)
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]])
    tip = np.zeros(3)
    a, b, c, d = corners
    path = np.array([tip, a, b, tip, c, b, c, d, tip, a, d])
    turned = np.stack([Rotation.from_quat(quat).apply(path) for quat in quat_xyzw])
    return np.asarray(position_m[:, None] + depth[:, None, None] * turned)


def quantiles(joined: Joined, share: float) -> Floats:
    """A quantile of each step's numbers [n], NaN where it has none."""
    out = np.full(len(joined.counts), np.nan)
    ends = np.cumsum(joined.counts)
    for k, (end, count) in enumerate(zip(ends.tolist(), joined.counts.tolist(), strict=True)):
        part = joined.values[end - count : end]
        part = part[np.isfinite(part)]
        if len(part):
            out[k] = np.quantile(part, share)
    return out


def level_costs(table: Columns) -> Floats:
    """Cost of each level of the alignment before and after it [n, 2 L]; NaN of a level that did not run."""
    rows = []
    for costs in table["align_cost"]:
        known = np.isfinite(costs)
        first = np.where(known.any(axis=1), costs[:, 0], np.nan)
        last = costs.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
        after = np.where(known.any(axis=1), costs[np.arange(len(costs)), last], np.nan)
        rows.append(np.column_stack([first, after]).ravel())
    return np.array(rows)


def level_colours(levels: int) -> Colours:
    """RGBA of each level of the alignment, from the coarsest, red, to the finest, blue."""
    hues = np.linspace(0.02, 0.58, levels)
    rgb = np.array([colorsys.hsv_to_rgb(hue, 0.65, 1.0) for hue in hues])
    red, green, blue = np.round(rgb * 255).astype(np.uint32).T
    return np.asarray(red << 24 | green << 16 | blue << 8 | np.uint32(0xFF), np.uint32)


def top_of_times(stage_ms: Floats) -> float:
    """Upper end of a plot of the stages' times [n, k] in ms, a little above all but the slowest hundredth; 0 without.

    The first frames of a first start compile for seconds: on the axis of all frames nothing else would be seen.
    """
    slowest = np.nan_to_num(stage_ms).max(axis=1)
    return 1.3 * float(np.quantile(slowest, 0.99, method="lower")) if len(slowest) else 0.0


# ------------------------------------------------------------------------------- filters


class Traced(NamedTuple):
    """A filter at some frames: places in the buffer or frames [m], its number, and values [m, 5].

    The values are μ, μ - σ, μ + σ (1/m), a/(a+b), and C1.
    """

    frame: Ints
    t_ns: Ints
    number: int
    values: Floats


@dataclass(slots=True)
class _Slot:
    number: int = -1


@dataclass(slots=True)
class FilterLog:
    """Chooses the depth filters whose course is shown, from step to step.

    Each of `FOLLOWED` slots follows one filter from its start to its end, then the next one that starts, the lowest
    number first; so every slot shows one after another. The first `KEPT_DIVERGED` filters that diverge are shown
    besides, with the last `HISTORY_FRAMES` frames before. What is chosen does not depend on how the steps are cut.
    """

    _slots: list[_Slot] = field(default_factory=lambda: [_Slot() for _ in range(FOLLOWED)])
    _recent: list[tuple[int, int, Ints, Floats]] = field(default_factory=list)
    _diverged: int = 0

    def take(self, table: Columns) -> tuple[list[list[tuple[int, int, Floats]]], list[Traced]]:
        """What each slot shows of some steps: (row, number, values [5]); and the courses of those that diverged."""
        shown: list[list[tuple[int, int, Floats]]] = [[] for _ in self._slots]
        courses: list[Traced] = []
        for row in range(len(table["frame"])):
            numbers, values = table["filter_id"][row], filter_values(table, row)
            self._follow(row, numbers, table["filter_age"][row], values, shown)
            self._recent.append((int(table["frame"][row]), int(table["t_ns"][row]), numbers, values))
            self._recent = self._recent[-HISTORY_FRAMES:]
            for number in numbers[table["filter_outcome"][row] == DIVERGED].tolist():
                if self._diverged < KEPT_DIVERGED:
                    self._diverged += 1
                    courses.append(self._course(number))
        return shown, courses

    def _follow(self, row: int, numbers: Ints, age: Ints, values: Floats, shown: list[Any]) -> None:
        """Go on with the filters of the slots; give free slots those that have just started."""
        place = {int(number): k for k, number in enumerate(numbers.tolist())}
        for slot in self._slots:
            if slot.number not in place:
                slot.number = -1
        free = [slot for slot in self._slots if slot.number < 0]
        if free and len(numbers):
            followed = {slot.number for slot in self._slots}
            young = sorted(n for n in numbers[age <= age.min()].tolist() if n not in followed) if age.min() <= 1 else []
            for slot, number in zip(free, young, strict=False):
                slot.number = number
        for k, slot in enumerate(self._slots):
            if slot.number >= 0:
                shown[k].append((row, slot.number, values[place[slot.number]]))

    def _course(self, number: int) -> Traced:
        rows = [
            (frame, t_ns, values[numbers == number][0])
            for frame, t_ns, numbers, values in self._recent
            if (numbers == number).any()
        ]
        frames, times, values = zip(*rows, strict=True)
        return Traced(np.array(frames, np.int64), np.array(times, np.int64), number, np.array(values))


def filter_values(table: Columns, row: int) -> Floats:
    """Of each filter of a step [S, 5]: μ, μ - σ, μ + σ (1/m), a/(a+b), C1."""
    mu, sigma = table["filter_mu"][row], table["filter_sigma"][row]
    return np.column_stack([mu, mu - sigma, mu + sigma, table["filter_ratio"][row], table["filter_inlier"][row]])


# -------------------------------------------------------------------------------- tables


def numbers(table: Columns, *, semidirect: bool) -> list[str]:
    """Each step's counts, levels and costs as Markdown."""
    return [_numbers(table, row, semidirect) for row in range(len(table["frame"]))]


def _numbers(table: Columns, row: int, semidirect: bool) -> str:
    stage = Stage(int(table["stage"][row])).name
    scale = f"{table['metres_per_unit'][row]:.5g} m a unit" if table["scale_known"][row] else "unknown"
    counts = np.bincount(table["outcome"][row], minlength=len(Feature))
    head, line = _COUNTS
    told = [
        f"**{stage}**, map {int(table['map_number'][row])}: {int(table['keyframes'][row])} keyframes, "
        f"{int(table['map_points'][row])} points; {int(table['tracked'][row])} tracked; scale {scale}",
        head + line % tuple(counts.tolist()),
    ]
    if semidirect:
        told += _semidirect_numbers(table, row)
    return "\n\n".join(told)


def _semidirect_numbers(table: Columns, row: int) -> list[str]:
    levels = len(table["align_iterations"][row])
    courses = [" → ".join(f"{cost:.4g}" for cost in costs[np.isfinite(costs)]) for costs in table["align_cost"][row]]
    head, line = _LEVELS
    stops = [STOP_NAMES[int(stop)] for stop in table["align_stop"][row]]
    aligned = zip(range(1, levels + 1), table["align_iterations"][row].tolist(), courses, stops, strict=True)
    heights = f"{table['height_m'][row]:.4g} m by the sensor, {table['map_height_m'][row]:.4g} m over the map"
    return [
        head + "".join(line % level for level in aligned),
        f"Pose: {_course(table['pose_cost'][row])} px² in {int(table['pose_iterations'][row])} iterations; error "
        f"{table['error_before_px'][row]:.3g} → {table['error_after_px'][row]:.3g} px; median correlation of points "
        f"and patches {_median(table['correlation'][row])}",
        f"Bundle: {_course(table['bundle_cost'][row])} px², {int(table['bundle_keyframes'][row])} keyframes, "
        f"{int(table['bundle_points'][row])} points, {int(table['bundle_outliers'][row])} outliers",
        f"Filters: {int(table['filters'][row])}; height {heights}",
    ]


def _median(values: Floats) -> str:
    known = values[np.isfinite(values)]
    return f"{np.median(known):.3g}" if len(known) else "–"


def _course(costs: Floats) -> str:
    known = costs[np.isfinite(costs)]
    return f"{known[0]:.4g} → {known[-1]:.4g}" if len(known) else "–"


_COUNTS = table_form(
    "Points looked for", " ".join(f.name.lower().replace("_", "·") for f in Feature), "%d " * len(Feature)
)
_LEVELS = table_form("Alignment, coarse to fine, grey²", "# iterations cost·by·iteration ended", "%d %d %s %s")


def stage_changes(before: int, stages: Sequence[int]) -> list[tuple[int, str]]:
    """Row and name wherever the stage differs from the one before; `before` is that before the first row."""
    changes = []
    for row, stage in enumerate(int(s) for s in stages):
        if stage != before:
            changes.append((row, STAGE_NAMES[stage]))
        before = stage
    return changes
