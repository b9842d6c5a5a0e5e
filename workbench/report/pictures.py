"""The picture of a frame: its image with what the estimator drew on it, and its correlation surfaces.

Drawings carry their own colours, so that each also stands as a file of its own.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.ranging.filter import Outcome, Status
from readers.streams import RecordingError, StreamError
from workbench import traces
from workbench.report import visual_pictures
from workbench.report.markup import Element, el
from workbench.runs import Run
from workbench.schema import Archetype

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]

WIDEST_PX = 640
JPEG_QUALITY = 80
CANVAS_PX = (640.0, 480.0)
CLOSE_PX = 32.0
"""Half the width of a view from close by."""
MOST_LANDMARKS = 24
"""Landmarks in the table of a frame."""
BLUE, YELLOW, RED, WHITE, GREEN = "#4fc3f7", "#ffd54f", "#ff5252", "#ffffff", "#00e676"

_OVERLAY_FIELDS = (
    "fragment_px", "fragment_side_px", "search_centre_px", "search_radius_px", "shift_px", "weight", "accepted",
    "tile_px", "tile_shift_px", "tile_weight",
)  # fmt: skip
_PEAK_FIELDS = ("peak_px", "second_peak_px", "peak_correlation", "second_peak_correlation", "peak_ratio")
_FRAGMENT_FIELDS = (
    "peak_correlation", "peak_ratio", "residual_rms", "condition", "weight", "shift_px", "fit_residual_px",
)  # fmt: skip
_LANDMARK_FIELDS = ("landmark_id", "status", "outcome", "range_m", "range_interval_m", "relative_sigma", "nis",
                    "innovation_px", "measured_px")  # fmt: skip
_DRAWN = {"measured": "Points2D:positions", "predicted": "Points2D:positions", "gate": "LineStrips2D:strips",
          "focus": "LineStrips2D:strips"}  # fmt: skip
_ARROWS = ("Arrows2D:origins", "Arrows2D:vectors")


@dataclass(frozen=True)
class Picture:
    """What there is to see of one frame.

    Attributes:
        frame: its number.
        image: the drawing with the image, or on a blank canvas; None where nothing was drawn.
        caption: what is on it.
        closer: the correlation surfaces, or the landmark that fits worst from close by; None where there is none.
        closer_caption: what is on it.
        heads: names of the columns of the frame's numbers.
        rows: the numbers, one row a fragment or landmark.
    """

    frame: int
    image: Element | None
    caption: str
    closer: Element | None = None
    closer_caption: str = ""
    heads: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()


def pictures(run: Run, frames: Iterable[int]) -> dict[int, Picture]:
    """The pictures of some frames, each part of the files read once.

    Raises:
        RecordingError: a file of the run cannot be read.
    """
    wanted = sorted(set(frames) & set(run.frames.tolist()))
    if not wanted:
        return {}
    images = _greys(run, wanted)
    if run.estimator == "correlation":
        stored = _stored_surfaces(run, wanted)
        return {frame: _correlation(run, frame, images[frame], stored.get(frame)) for frame in wanted}
    if run.visual:
        lists = visual_pictures.lists_of(run, wanted)
        return {frame: _visual(run, frame, images[frame], lists[frame]) for frame in wanted}
    drawn = _drawn(run, wanted)
    return {frame: _drawn_picture(run, frame, images[frame], drawn) for frame in wanted}


# -------------------------------------------------------------------------------- the image


def _greys(run: Run, frames: Sequence[int]) -> dict[int, Grey | str]:
    """The grey images of some frames, or a sentence on why there is none."""
    try:
        samples = run.images(frames)
    except RecordingError as error:
        return dict.fromkeys(frames, f" There is no image: {error}.")
    found: dict[int, Grey | str] = dict.fromkeys(frames, " The run holds no image of this frame.")
    for frame, sample in samples.items():
        try:
            found[frame] = _eight_bits(sample.grey())
        except StreamError as error:
            found[frame] = f" There is no image: {error}."
    return found


def _eight_bits(grey: NDArray[Any]) -> Grey:
    """An image with 8 bits a pixel; deeper ones are stretched over them."""
    if grey.dtype == np.uint8:
        return np.asarray(grey, np.uint8)
    return np.asarray(cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U), np.uint8)


def _shown(grey: Grey | str, view: tuple[float, float, float, float] | None = None) -> list[Element]:
    """An image, or the part x, y, width, height of it; nothing where there is none."""
    if isinstance(grey, str):
        return []
    left = top = 0
    if view is not None:
        left, top = (max(0, math.floor(v)) for v in view[:2])
        right, bottom = (max(0, math.ceil(view[k] + view[k + 2])) for k in (0, 1))
        grey = grey[top:bottom, left:right]
    if not grey.size:
        return []
    tall, wide = grey.shape
    place = {"x": left, "y": top, "width": wide, "height": tall}
    if wide > WIDEST_PX:
        small = cv2.resize(grey, (WIDEST_PX, max(1, round(tall * WIDEST_PX / wide))), interpolation=cv2.INTER_AREA)
        grey = np.asarray(small, np.uint8)
    return [_embedded(_encoded(grey, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]), "jpeg", place)]


def _encoded(image: NDArray[np.uint8], ending: str, options: Sequence[int] = ()) -> bytes:
    _, encoded = cv2.imencode(ending, image, list(options))
    return bytes(encoded.tobytes())


def _embedded(blob: bytes, form: str, place: Mapping[str, float], **more: str) -> Element:
    uri = f"data:image/{form};base64,{base64.b64encode(blob).decode()}"
    return el("image", href=uri, **place, **more)


def _svg(view: tuple[float, float, float, float], label: str, *content: Any) -> Element:
    return el("svg", *content, viewBox=" ".join(f"{v:g}" for v in view), role="img", aria_label=label, class_="picture")


def _blank(x: float, y: float, width: float, height: float) -> Element:
    return el("rect", x=x, y=y, width=width, height=height, fill="#222222")


def _excuse(grey: Grey | str) -> str:
    return grey if isinstance(grey, str) else ""


def _hex(colour: int) -> str:
    return f"#{int(colour) >> 8:06x}"


def _box(centre: Floats, half: Floats, colour: str, **more: str) -> Element:
    (u, v), (w, h) = centre.tolist(), half.tolist()
    return el("rect", x=f"{u - w:.1f}", y=f"{v - h:.1f}", width=f"{2 * w:.1f}", height=f"{2 * h:.1f}",
              fill="none", stroke=colour, **more)  # fmt: skip


def _arrow(start: Floats, vector: Floats, colour: str) -> Element:
    (u, v), (a, b) = start.tolist(), vector.tolist()
    return el(
        "g",
        el("path", d=f"M{u:.1f} {v:.1f}l{a:.1f} {b:.1f}", stroke=colour, stroke_width="1.6", fill="none"),
        el("circle", cx=f"{u + a:.1f}", cy=f"{v + b:.1f}", r="2.2", fill=colour),
    )


# -------------------------------------------------------------------------------- correlation


def _correlation(run: Run, frame: int, grey: Grey | str, surface: NDArray[Any] | None) -> Picture:
    row = run.row_of(frame)
    table = {name: column[row : row + 1] for name, column in run.columns(_OVERLAY_FIELDS).items()}
    shapes = traces.overlays(table)
    width, height = _around(shapes) if isinstance(grey, str) else grey.shape[::-1]
    marks: list[Element] = [
        _box(c, h, BLUE, stroke_width="1", stroke_dasharray="4 3")
        for c, h in zip(shapes["search"].points, shapes["search"].extents, strict=True)
    ]
    marks += [_box(c, h, WHITE, stroke_width="1") for c, h in zip(*shapes["fragments"][1:3], strict=True)]
    for name, draw in (("matches", _box), ("shifts", _arrow)):
        colours = shapes[name].colours
        assert colours is not None
        marks += [
            draw(point, extent, _hex(colour))
            for point, extent, colour in zip(shapes[name].points, shapes[name].extents, colours, strict=True)
        ]
    caption = (
        f"Frame {frame}: fragments of the template (white), search areas (blue, dashed), matches and shifts (green: "
        "trusted, red: not, grey: the frame was not accepted)."
    )
    label = f"image of frame {frame} with fragments and matches"
    image = _svg((0, 0, width, height), label, _blank(0, 0, width, height), _shown(grey), marks)
    surfaces, told = _surfaces(run, row, frame, surface)
    return Picture(frame, image, caption + _excuse(grey), surfaces, told, *_fragments(run, row))


def _fragments(run: Run, row: int) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """The numbers of a frame's fragments."""
    here = {name: column[row] for name, column in run.columns(_FRAGMENT_FIELDS).items()}
    shift, residual = here.pop("shift_px"), here.pop("fit_residual_px")
    parts = [*here.values(), *shift.T, np.hypot(*residual.T)]
    heads = ("fragment", "peak", "ratio", "residual", "condition", "weight", "shift u px", "shift v px", "misfit px")
    return heads, _numbered(np.arange(1, len(shift) + 1), parts)


def _numbered(first: Iterable[object], parts: Sequence[Floats]) -> tuple[tuple[str, ...], ...]:
    """Rows of a table: a name and numbers."""
    return tuple(
        (str(name), *("" if math.isnan(v) else f"{v:.4g}" for v in values))
        for name, *values in zip(first, *parts, strict=True)
    )


def _around(shapes: Mapping[str, traces.Shapes]) -> tuple[float, float]:
    """The size of a canvas that holds some shapes."""
    ends = [s.points + s.extents for s in shapes.values() if len(s.points)]
    if not ends:
        return CANVAS_PX
    width, height = np.concatenate(ends).max(axis=0) + 10
    return float(width), float(height)


def _stored_surfaces(run: Run, frames: Sequence[int]) -> dict[int, NDArray[Any]]:
    """The surfaces of some frames as the images that hold them all, float16."""
    from workbench.rrd_reading import chunks

    found: dict[int, NDArray[Any]] = {}
    component = Archetype.SURFACES.value
    entity = f"{run.root}/{run.schema.entity('surface')}"
    for chunk in chunks(run.file, entity, components=[component]):
        batch = chunk.to_record_batch()
        names = batch.schema.names
        if "frame" not in names:
            continue
        numbers = batch.column("frame").to_numpy()
        for row in np.flatnonzero(np.isin(numbers, frames)).tolist():
            if component in names and batch.column(component)[row].as_py():
                blob = bytes(batch.column(component)[row].as_py()[0])
                found[int(numbers[row])] = np.frombuffer(blob, np.float16)
    return found


def _surfaces(run: Run, row: int, frame: int, stored: NDArray[Any] | None) -> tuple[Element | None, str]:
    """The surfaces of a frame as a heat map with both peaks of each, and the numbers of the worst one."""
    peaks = {name: column[row] for name, column in run.columns(_PEAK_FIELDS).items()}
    here = {name: run.column(name)[row] for name in ("fragment_px", "search_centre_px", "search_radius_px",
                                                     "fragment_side_px")}  # fmt: skip
    if stored is None:
        return None, "The correlation surfaces of this frame were not kept."
    at = traces.cells(here["fragment_px"], float(here["fragment_side_px"]))
    columns = int(at[:, 1].max()) + 1
    rows = int(at[:, 0].max()) + 1
    side = _side(stored.size, rows, columns)
    if side is None or not np.isfinite(stored).any():
        return None, "The correlation surfaces of this frame hold no number."
    height, width = rows * (side + 1) - 1, columns * (side + 1) - 1
    heat = _encoded(_heat(stored.reshape(height, width).astype(np.float64)), ".png")
    corners = at[:, ::-1] * (side + 1)
    centre = here["search_centre_px"] - here["fragment_px"]
    marks = []
    for name, colour in (("second_peak_px", RED), ("peak_px", WHITE)):
        points = corners + np.round(peaks[name] - centre) + (side - 1) / 2 + 0.5
        marks += [
            el("circle", cx=f"{u:.1f}", cy=f"{v:.1f}", r="1.4", fill="none", stroke=colour, stroke_width="0.5")
            for u, v in points[np.isfinite(points).all(axis=1)].tolist()
        ]
    image = _embedded(heat, "png", {"width": width, "height": height}, image_rendering="pixelated")
    told = f"Correlation surfaces of frame {frame}, fragments as on the image (white: peak, red: second peak)."
    ratio = peaks["peak_ratio"]
    if np.isfinite(ratio).any():
        k = int(np.nanargmax(ratio))
        told += (
            f" Fragment {k + 1} is the most ambiguous: peak {peaks['peak_correlation'][k]:.3f}, second peak "
            f"{peaks['second_peak_correlation'][k]:.3f}, ratio {ratio[k]:.3f}."
        )
    label = f"correlation surfaces of frame {frame}"
    return _svg((0, 0, width, height), label, image, marks), told


def _side(size: int, rows: int, columns: int) -> int | None:
    """Positions a side of the surfaces in a mosaic of that many numbers."""
    for side in range(1, 400):
        if (rows * (side + 1) - 1) * (columns * (side + 1) - 1) == size:
            return side
    return None


def _heat(values: Floats) -> NDArray[np.uint8]:
    """Correlations as colours, from 0 (dark) to 1 (bright); what is no number is mid grey."""
    grey = np.round(255 * np.nan_to_num(values).clip(0, 1)).astype(np.uint8)
    heat = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), np.uint8)
    heat[~np.isfinite(values)] = 96
    return heat


# -------------------------------------------------------------------------------- visual odometry


def _visual(run: Run, frame: int, grey: Grey | str, here: Mapping[str, NDArray[Any]]) -> Picture:
    row = run.row_of(frame)
    told = visual_pictures.caption(frame, int(run.column("stage")[row]), here) + _excuse(grey)
    width, height = run.column("image_size_px")[row].tolist()
    label = f"image of frame {frame} with the points of the map"
    content = (_blank(0, 0, width, height), _shown(grey), visual_pictures.marks(here))
    image = _svg((0, 0, width, height), label, *content) if width > 0 and height > 0 else None
    heads, rows = visual_pictures.table(here)
    return Picture(frame, image, told, None, "", heads, rows)


# -------------------------------------------------------------------------------- what a replay drew


def _drawn(run: Run, frames: Sequence[int]) -> dict[int, dict[str, list[Any]]]:
    """What the replay drew on the images of some frames: name → what the viewer gets, by frame."""
    from workbench.rrd_reading import chunks

    found: dict[int, dict[str, list[Any]]] = {frame: {} for frame in frames}
    root = f"/camera/image/{run.name}"
    components = sorted({*_DRAWN.values(), *_ARROWS})
    for chunk in chunks(run.file, f"{root}/**", components=components):
        name = chunk.entity_path.removeprefix(f"{root}/")
        batch = chunk.to_record_batch()
        parts = {"innovation": _ARROWS}.get(name, (_DRAWN.get(name, ""),))
        if "frame" not in batch.schema.names or not set(parts) <= set(batch.schema.names):
            continue
        numbers = batch.column("frame").to_numpy()
        for row in np.flatnonzero(np.isin(numbers, frames)).tolist():
            values = [batch.column(part)[row].as_py() or [] for part in parts]
            found[int(numbers[row])][name] = values if len(parts) > 1 else values[0]
    return found


def _drawn_picture(run: Run, frame: int, grey: Grey | str, drawn: Mapping[int, Mapping[str, list[Any]]]) -> Picture:
    here = drawn.get(frame, {})
    measured, predicted = (np.asarray(here.get(k, []), np.float64).reshape(-1, 2) for k in ("measured", "predicted"))
    table, worst = _landmarks(run, run.row_of(frame))
    known = np.concatenate([measured, predicted])
    if isinstance(grey, str) and not len(known):
        told = f"Frame {frame}: no landmark was measured or predicted.{grey}"
        return Picture(frame, None, told, None, "", *table)
    width, height = _canvas(run, known) if isinstance(grey, str) else grey.shape[::-1]
    marks = _marks(here, measured, predicted)
    caption = (
        f"Frame {frame}: measured points (red), predicted ones (blue crosses), gates (yellow), innovations (white), "
        "focus of expansion (green)."
    )
    label = f"image of frame {frame} with landmarks"
    image = _svg((0, 0, width, height), label, _blank(0, 0, width, height), _shown(grey), marks)
    closer, told = None, ""
    if worst is not None and len(measured):
        u, v = measured[np.argmin(np.hypot(*(measured - worst[1]).T))]
        view = (u - CLOSE_PX, v - 0.75 * CLOSE_PX, 2 * CLOSE_PX, 1.5 * CLOSE_PX)
        told = f"The landmark whose innovation is the largest for its gate (number {worst[0]}), from close by."
        marks = _marks(here, measured, predicted, fine=True)
        closer = _svg(view, f"frame {frame} around landmark {worst[0]}", _blank(*view), _shown(grey, view), marks)
    return Picture(frame, image, caption + _excuse(grey), closer, told, *table)


def _marks(here: Mapping[str, list[Any]], measured: Floats, predicted: Floats, *, fine: bool = False) -> list[Element]:
    """Points, gates and innovations of a frame; `fine` for a view from close by."""
    size, line = (0.8, "0.4") if fine else (4.0, "1.4")
    marks = [_line(strip, YELLOW, line) for strip in here.get("gate", [])]
    marks += [_line(strip, GREEN, line) for strip in here.get("focus", [])]
    marks += [
        el("path", d=f"M{u - size:.2f} {v:.2f}h{2 * size}M{u:.2f} {v - size:.2f}v{2 * size}", stroke=BLUE,
           stroke_width=line, fill="none")
        for u, v in predicted.tolist()
    ]  # fmt: skip
    marks += [el("circle", cx=f"{u:.2f}", cy=f"{v:.2f}", r=size, fill="none", stroke=RED, stroke_width=line)
              for u, v in measured.tolist()]  # fmt: skip
    arrows = here.get("innovation", [[], []])
    origins, vectors = (np.asarray(arrows[k], np.float64).reshape(-1, 2) for k in (0, 1))
    marks += [
        el("path", d=f"M{u:.2f} {v:.2f}l{a:.2f} {b:.2f}", stroke=WHITE, stroke_width=line, fill="none")
        for (u, v), (a, b) in zip(origins.tolist(), vectors.tolist(), strict=True)
    ]
    return marks


def _landmarks(run: Run, row: int) -> tuple[tuple[tuple[str, ...], tuple[tuple[str, ...], ...]],
                                            tuple[int, Floats] | None]:  # fmt: skip
    """The numbers of a frame's landmarks; number and image point of the one with the largest NIS, where one is."""
    if "landmark_id" not in run.fields:
        return ((), ()), None
    here = {name: column[row] for name, column in run.columns(_LANDMARK_FIELDS).items()}
    carried = np.flatnonzero(np.isfinite(here["landmark_id"]))[:MOST_LANDMARKS]
    here = {name: values[carried] for name, values in here.items()}
    names = [
        f"{int(k)} ({_word(Status, s)}, {_word(Outcome, o)})"
        for k, s, o in zip(here["landmark_id"], here["status"], here["outcome"], strict=True)
    ]
    parts = [
        here["range_m"],
        *here["range_interval_m"].T,
        here["relative_sigma"],
        here["nis"],
        *here["innovation_px"].T,
    ]
    heads = ("landmark", "Z m", "nearest m", "farthest m", "σ_ξ/ξ", "NIS", "ν x px", "ν y px")
    table = (heads, _numbered(names, parts))
    if not np.isfinite(here["nis"]).any():
        return table, None
    k = int(np.nanargmax(here["nis"]))
    return table, (int(here["landmark_id"][k]), here["measured_px"][k])


def _word(kind: type[Status] | type[Outcome], value: float) -> str:
    return kind(int(value)).name.lower() if math.isfinite(value) else "none"


def _canvas(run: Run, points: Floats) -> tuple[float, float]:
    """The size of a blank canvas: that of the settings' images, or one that holds the points."""
    size = run.settings.get("image_size_px")
    if size and len(size) == 2 and min(size) > 0:
        return float(size[0]), float(size[1])
    width, height = np.maximum(points.max(axis=0) + 20, CANVAS_PX)
    return float(width), float(height)


def _line(points: Iterable[Iterable[float]], colour: str, width: str) -> Element:
    text = "L".join(f"{u:.2f} {v:.2f}" for u, v in points)
    return el("path", d=f"M{text}", stroke=colour, stroke_width=width, fill="none")
