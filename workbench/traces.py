"""Steps into columns and back: plain arrays, without a word about the recording's format.

n steps, F fragments, M positions a side of a correlation surface. Points on images are those of the
viewer, which puts the corner of the first pixel at (0, 0): half a pixel more than the Step says.
"""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import Step
from pipelines.verdict import Severity, Verdict, flags
from workbench.schema import Archetype, Schema

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Colours = NDArray[np.uint32]
Columns = Mapping[str, NDArray[Any]]

GUTTER_PX = 1
"""Width of the line of NaN between the surfaces of a mosaic."""

SEVERITY_COLOURS: Mapping[Severity, int] = {
    Severity.FINE: 0x4CAF50FF,
    Severity.NOTICE: 0x42A5F5FF,
    Severity.WARNING: 0xFFB300FF,
    Severity.ERROR: 0xF44336FF,
}


# ------------------------------------------------------------------------- steps ⇄ columns


def columns(schema: Schema, steps: Sequence[Step]) -> dict[str, NDArray[Any]]:
    """One array [n, *shape] per field, an array [n] of arrays per list; the steps must agree in their other shapes.

    Integers are int64, everything else float64, surfaces float32.
    """
    names = [row.field for row in schema.rows]
    values = zip(*map(operator.attrgetter(*names), steps), strict=True)
    kinds, lists = schema.kinds, frozenset(schema.lists)
    return {
        name: objects(column) if name in lists else _column(column, kinds[name])
        for name, column in zip(names, values, strict=True)
    }


def objects(items: Sequence[Any]) -> NDArray[Any]:
    """An array [n] of arrays."""
    array = np.empty(len(items), object)
    array[:] = items
    return array


class Joined(NamedTuple):
    """Lists of n steps one after another: how many belong to each step [n], and all of them [N, *shape]."""

    counts: Ints
    values: NDArray[Any]

    @classmethod
    def of(cls, lists: Iterable[NDArray[Any]]) -> Joined:
        """Join the arrays of a list's column, one after another."""
        arrays = list(lists)
        return cls(np.array([len(one) for one in arrays], np.int64), np.concatenate(arrays))

    @property
    def rows(self) -> Ints:
        """Place of the step of each of them [N]."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def chosen(self, mask: NDArray[np.bool_]) -> Joined:
        """Some of them."""
        return Joined(np.bincount(self.rows[mask], minlength=len(self.counts)), self.values[mask])


def _column(values: tuple[Any, ...], kind: Any) -> NDArray[Any]:
    if isinstance(values[0], np.ndarray):
        return np.concatenate(values).reshape(len(values), *values[0].shape)
    return np.array(values, dtype=np.float64 if kind is float else np.int64)


def shape_of(schema: Schema) -> Any:
    """A function from a Step to the lengths that its settings decide, to tell when they change."""
    free = [
        row.field
        for row in schema.rows
        if row.archetype is not Archetype.LISTS and any(isinstance(n, str) for n in schema.shape(row.field))
    ]
    return operator.attrgetter(*(f"{name}.shape" for name in free)) if free else lambda step: ()


def scalar_groups(schema: Schema, table: Columns) -> Iterator[tuple[str, Floats]]:
    """Entity and values [n, k] of each group of scalars."""
    for entity, rows in schema.of(Archetype.SCALARS).items():
        parts = [np.asarray(table[row.field], np.float64).reshape(len(table[row.field]), -1) for row in rows]
        yield entity, parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _exact(kind: Any) -> Any:
    """A function from the logged number to a value of the declared type; flags want a true integer."""
    return float if kind is float else lambda value: kind(int(value))


def _array(whole: bool) -> Any:
    """A function from the logged numbers to an array of the declared type."""
    return (lambda values: np.asarray(values, np.int64)) if whole else np.asarray


def rebuild(schema: Schema, table: Mapping[str, Sequence[Any]]) -> Iterator[Step]:
    """The Steps of one sequence of values per field: the inverse of `columns`."""
    names = [row.field for row in schema.rows]
    casts = [_array(schema.whole(name)) if schema.shape(name) else _exact(schema.kinds[name]) for name in names]
    for values in zip(*(table[name] for name in names), strict=True):
        cast: dict[str, Any] = {name: cast(value) for name, cast, value in zip(names, casts, values, strict=True)}
        yield schema.step_type(**cast)


# ---------------------------------------------------------------------------- surfaces


@functools.lru_cache(maxsize=256)
def _cells(centres: bytes, side_px: float) -> tuple[tuple[int, int], ...]:
    points = np.frombuffer(centres).reshape(-1, 2)
    if not np.isfinite(points).all():
        return tuple((0, column) for column in range(len(points)))
    order = np.argsort(points[:, 1], kind="stable")
    row_of = np.empty(len(points), int)
    row_of[order] = np.cumsum(np.diff(points[order, 1], prepend=points[order[0], 1]) > side_px / 2)
    cells = [(0, 0)] * len(points)
    for row in range(row_of.max() + 1):
        members = np.flatnonzero(row_of == row)
        for column, k in enumerate(members[np.argsort(points[members, 0], kind="stable")]):
            cells[k] = (row, column)
    return tuple(cells)


def cells(fragment_px: Floats, side_px: float) -> Ints:
    """Row and column [F, 2] of each fragment's surface in the mosaic: as the fragments [F, 2] lie on the image.

    Fragments whose v differ by less than half a side share a row, sorted by u. One row where positions are NaN.
    """
    return np.array(_cells(np.ascontiguousarray(fragment_px, np.float64).tobytes(), side_px), np.int64)


def mosaic(surfaces: NDArray[Any], at: Ints) -> NDArray[np.float16]:
    """Surfaces [n, F, M, M] side by side as images [n, height, width], float16, with lines of NaN between."""
    pitch = surfaces.shape[-1] + GUTTER_PX
    rows, cols = at.max(axis=0) + 1
    images = np.full((len(surfaces), rows * pitch - GUTTER_PX, cols * pitch - GUTTER_PX), np.nan, np.float16)
    for k, (row, col) in enumerate(at * pitch):
        images[:, row : row + pitch - GUTTER_PX, col : col + pitch - GUTTER_PX] = surfaces[:, k]
    return images


def unmosaic(image: NDArray[np.float16], at: Ints) -> NDArray[np.float32]:
    """The surfaces [F, M, M] of one image of `mosaic`."""
    rows = int(at[:, 0].max()) + 1
    side = (image.shape[0] + GUTTER_PX) // rows - GUTTER_PX
    corners = at * (side + GUTTER_PX)
    return np.stack([image[r : r + side, c : c + side] for r, c in corners]).astype(np.float32)


class Mosaics(NamedTuple):
    """Consecutive steps whose surfaces are arranged alike.

    `rows` is their slice of the buffer, `images` [n, height, width], `first` and `second` [n, F, 2] the
    peaks on them, `corners` [F, 2] the upper left corners of the surfaces.
    """

    rows: slice
    images: NDArray[np.float16]
    first: Floats
    second: Floats
    corners: Floats


def mosaics(table: Columns) -> Iterator[Mosaics]:
    """The surfaces of correlation steps as images, with their peaks, one group per arrangement."""
    keys = [
        _cells(np.ascontiguousarray(px).tobytes(), float(side))
        for px, side in zip(table["fragment_px"], table["fragment_side_px"], strict=True)
    ]
    bounds = [0, *(i for i in range(1, len(keys)) if keys[i] != keys[i - 1]), len(keys)]
    for start, stop in itertools.pairwise(bounds):
        rows = slice(start, stop)
        at = np.array(keys[start], np.int64)
        surfaces = table["surface"][rows]
        radius = (surfaces.shape[-1] - 1) / 2
        corners = (at[:, ::-1] * (surfaces.shape[-1] + GUTTER_PX)).astype(np.float64)
        centre = table["search_centre_px"][rows] - table["fragment_px"][rows]
        first, second = (
            corners + np.round(table[name][rows] - centre) + radius + 0.5 for name in ("peak_px", "second_peak_px")
        )
        yield Mosaics(rows, mosaic(surfaces, at), first, second, corners)


# ---------------------------------------------------------------- what is drawn on the image


class Shapes(NamedTuple):
    """Shapes of n steps one after another: `counts` [n] of them belong to each step.

    `points` [N, 2], `extents` [N, 2] (half sizes of boxes, vectors of arrows, unused for points), `colours` [N].
    """

    counts: Ints
    points: Floats
    extents: Floats
    colours: Colours | None = None


def finite(values: Floats, axes: int | tuple[int, ...]) -> NDArray[np.bool_]:
    """Where everything along some axes is finite."""
    return np.asarray(np.isfinite(values).all(axis=axes), np.bool_)


def shapes(points: Floats, extents: Floats, colours: Colours | None = None) -> Shapes:
    """Flatten shapes [n, F, 2] and leave out those with NaN."""
    seen = finite(points + extents, 2)
    chosen = None if colours is None else colours[seen]
    return Shapes(seen.sum(axis=1), points[seen], extents[seen], chosen)


def weight_colours(weight: Floats, accepted: NDArray[Any]) -> Colours:
    """RGBA of fragments: from red for weight 0 to green for 1, grey in steps that were not accepted."""
    share = np.clip(np.nan_to_num(weight), 0, 1)
    red: Colours = np.round(np.minimum(1, 2 - 2 * share) * 220).astype(np.uint32)
    green: Colours = np.round(np.minimum(1, 2 * share) * 220).astype(np.uint32)
    colours = (red << 24) | (green << 16) | np.uint32(0x30 << 8 | 0xFF)
    return np.where(np.asarray(accepted, bool)[:, None], colours, np.uint32(0xB0B0B0FF)).astype(np.uint32)


def overlays(table: Columns) -> dict[str, Shapes]:
    """Boxes, arrows and points on the image: `fragments`, `search`, `matches`, `shifts`, `tiles`."""
    at = table["fragment_px"] + 0.5
    n = len(at)
    half = np.broadcast_to(table["fragment_side_px"].reshape(n, 1, 1) / 2.0, at.shape)
    reach = half + table["search_radius_px"].reshape(n, 1, 1)
    colours = weight_colours(table["weight"], table["accepted"])
    tiles = table["tile_px"] + table["tile_shift_px"] + 0.5
    return {
        "fragments": shapes(at, half),
        "search": shapes(table["search_centre_px"] + 0.5, reach),
        "matches": shapes(at + table["shift_px"], half, colours),
        "shifts": shapes(at, table["shift_px"], colours),
        "tiles": shapes(tiles, tiles, weight_colours(table["tile_weight"], table["accepted"])),
    }


# --------------------------------------------------------------------------------- map


def verdict_colours(verdicts: Ints, usual: int) -> Colours:
    """RGBA [n] by the severity of each step's verdict, `usual` where it is fine."""
    colours = {**SEVERITY_COLOURS, Severity.FINE: usual}
    return np.array([colours[Verdict(v).severity] for v in verdicts.tolist()], np.uint32)


def ellipses(covariance: Floats, *, sigmas: float = 3.0) -> tuple[Floats, Floats]:
    """Half axes [n, 2] in m and direction [n] in rad of the first, of the position part of covariances [n, 3, 3].

    NaN where the covariance is not finite.
    """
    good = finite(covariance[:, :2, :2], (1, 2))
    values, vectors = np.linalg.eigh(np.where(good[:, None, None], covariance[:, :2, :2], 0.0))
    half = np.where(good[:, None], sigmas * np.sqrt(np.maximum(values, 0)), np.nan)
    return half, np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0])


# ------------------------------------------------------------------------------ tables


def numbers(table: Columns) -> list[str]:
    """Each correlation step's matrices and fragments as Markdown tables."""
    n, f = table["peak_correlation"].shape
    number = np.broadcast_to(np.arange(1, f + 1.0), (n, f))[..., None]
    quality = [table[name][..., None] for name in ("peak_correlation", "peak_ratio", "residual_rms", "condition")]
    h = table["hessian"].reshape(n, f, 4)[..., [0, 1, 3]]
    parts = (
        (np.concatenate([table["pose_covariance"], table["motion_covariance"]], axis=2), _MATRICES),
        (np.concatenate([number, *quality, table["weight"][..., None]], axis=2), _QUALITY),
        (np.concatenate([number, table["shift_px"], table["delta_px"], table["fit_residual_px"]], axis=2), _SHIFTS),
        (np.concatenate([number, h], axis=2), _HESSIANS),
    )
    form = "\n".join(head + line * rows.shape[1] for rows, (head, line) in parts)
    values = np.concatenate([rows.reshape(n, -1) for rows, _ in parts], axis=1)
    return [form % tuple(row) for row in values.tolist()]


def table_form(title: str, names: str, formats: str) -> tuple[str, str]:
    """Head and line of a Markdown table."""
    heads, cells = names.split(), formats.split()
    head = f"**{title}**\n\n| {' | '.join(heads)} |\n|{'---:|' * len(heads)}\n"
    return head, f"| {' | '.join(cells)} |\n"


_MATRICES = table_form(
    "Covariance of the pose (x, y m; α rad) and of the motion (u, v px; α rad)", "P·x P·y P·α M·u M·v M·α", "%.2e " * 6
)
_QUALITY = table_form("Fragments", "# peak ratio rms condition weight", "%.0f %.4f %.3f %.2f %.2f %.2f")
_SHIFTS = table_form("Shifts, px", "# u v Δu Δv fit·u fit·v", "%.0f" + " %.3f" * 6)
_HESSIANS = table_form("Hessians, grey²/px²", "# uu uv vv", "%.0f" + " %.4g" * 3)


# ---------------------------------------------------------------------------- verdicts


@dataclass(frozen=True, slots=True)
class Event:
    """A line of a log; `row` is its step's place in the buffer."""

    row: int
    severity: Severity
    text: str


class Changes:
    """Follows the verdicts of a run from step to step and says where something changes."""

    def __init__(self) -> None:
        self._verdict: Verdict | None = None
        self._alarms = Verdict.OK
        self._since = 0

    def take(self, table: Columns) -> tuple[list[Event], list[tuple[int, Verdict, Verdict]]]:
        """Events worth stepping to, and (row, verdict, alarms) wherever verdict or alarms changed."""
        events: list[Event] = []
        changes: list[tuple[int, Verdict, Verdict]] = []
        rows = zip(table["frame"].tolist(), table["verdict"].tolist(), table["alarms"].tolist(), strict=True)
        for row, (frame, verdict_bits, alarm_bits) in enumerate(rows):
            verdict, alarms = Verdict(verdict_bits), Verdict(alarm_bits)
            if verdict == self._verdict and alarms == self._alarms:
                continue
            changes.append((row, verdict, alarms))
            if verdict != self._verdict:
                events += self._event(row, frame, verdict)
                self._verdict, self._since = verdict, frame
            self._alarms = alarms
        return events, changes

    def _event(self, row: int, frame: int, verdict: Verdict) -> Iterable[Event]:
        if verdict != Verdict.OK:
            yield Event(row, verdict.severity, f"{verdict.name}: {verdict.sentence}")
        elif self._verdict is not None and self._verdict.severity > Severity.NOTICE:
            count = frame - self._since
            frames = f"{count} frame" + "s" * (count != 1)
            yield Event(row, Severity.FINE, f"OK again after {frames} of {self._verdict.name}")


def verdict_lines(table: Columns) -> list[Event]:
    """One line for every step with an alarm: all its alarms, gravest first, with the gravest one's sentence."""
    lines = []
    for row, bits in enumerate(table["alarms"].tolist()):
        if bits:
            single = flags(Verdict(bits))
            names = ", ".join(str(flag.name) for flag in single)
            lines.append(Event(row, single[0].severity, f"{names}: {single[0].sentence}"))
    return lines
