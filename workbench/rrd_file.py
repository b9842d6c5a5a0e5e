"""One ``.rrd`` that is being written: columns on both timelines, and the small parts of what is drawn."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from pipelines.verdict import Severity
from readers.streams import RecordingError, WorkbenchError
from workbench import traces
from workbench.blueprints import Extent
from workbench.rrd_columns import columns
from workbench.safe_text import printable

APPLICATION = "estimator_workbench"
IMAGE = "/camera/image"
REFERENCE = "/world/reference"

ARROW_SHARE = 0.1
"""Length of the arrows of heading, in sides of the map."""

LAYER_M = 0.001
"""Height of each layer of the map over the one below, so that what lies over one another does not flicker."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEVELS = {Severity.FINE: "INFO", Severity.NOTICE: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}
COLOURS = {"reference": 0x2ECC71FF, "raw": 0x9E9E9EFF, "corrected": 0x4FC3F7FF, "aligned": 0xCE93D8FF,
           "arrow": 0xFFFFFFFF}  # fmt: skip
LAYERS = ("aligned", "reference", "raw", "corrected", "markers", "arrows")


class RrdFile:
    """One ``.rrd`` that is being written: an explicit stream of columns on both timelines."""

    def __init__(self, path: Path, recording_id: str) -> None:
        self._rec = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
        if not rr.is_enabled(self._rec):
            raise WorkbenchError(f"{path}: Rerun is switched off by the environment; unset RERUN or set RERUN=on")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._rec.save(path)
        except (OSError, RuntimeError) as error:
            raise RecordingError(path, f"cannot be written ({error})", "choose another folder with -o") from error
        self._rec.set_log_time_enabled(False)
        self._rec.set_log_tick_enabled(False)
        self._frames: Ints | None = None
        self._t_ns: Ints | None = None
        self._times: list[rr.TimeColumn] = []
        self.static("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)

    def static(self, entity: str, *what: rr.AsComponents) -> None:
        """Log what holds for the whole recording."""
        self._rec.log(entity, *what, static=True, strict=True)

    def send(self, entity: str, frames: Ints | None, t_ns: Ints, *columns: Iterable[Any]) -> None:
        """Log rows of one entity at sensor times [n] and at frames [n], where they belong to frames."""
        if len(t_ns):
            self._rec.send_columns(entity, self._at(frames, t_ns), itertools.chain(*columns), strict=True)

    def _at(self, frames: Ints | None, t_ns: Ints) -> list[rr.TimeColumn]:
        """The columns of times; most entities share those of the one before."""
        if frames is not self._frames or t_ns is not self._t_ns:
            self._frames, self._t_ns = frames, t_ns
            self._times = [rr.TimeColumn("sensor_time", timestamp=np.asarray(t_ns, np.int64).view("datetime64[ns]"))]
            if frames is not None:
                self._times.append(rr.TimeColumn("frame", sequence=frames))
        return self._times

    def scale_bar(self, extent: Extent) -> None:
        """Draw a round length below the map."""
        length, (x, y) = extent.bar()
        line = rr.LineStrips3D(
            [[(x, y, 0.0), (x + length, y, 0.0)]],
            labels=[f"{length:g} m"], show_labels=True, colors=0xFFFFFFFF, radii=rr.Radius.ui_points(1.5),
        )  # fmt: skip
        self.static("/world/scale", line)

    def flush(self) -> None:
        """Hand everything to the operating system: a process killed after this loses nothing of it."""
        self._rec.flush()

    def blueprint(self, blueprint: rr.blueprint.Blueprint) -> None:
        """Make this the view of the file."""
        self._rec.send_blueprint(blueprint, make_active=True, make_default=True)

    def close(self) -> None:
        """Write the footer."""
        self._rec.flush()
        self._rec.disconnect()


def numbers(column: pa.Array) -> NDArray[Any]:
    """An Arrow array of numbers or times as it lies in memory, times as int64; read-only.

    Arrow's own way would load pandas for it, which takes longer than most commands.
    """
    kind = column.type
    if column.null_count or kind.bit_width < 8:
        return np.asarray(column.to_numpy(zero_copy_only=False))
    letter = "f" if pa.types.is_floating(kind) else "u" if pa.types.is_unsigned_integer(kind) else "i"
    dtype = np.dtype(f"{letter}{kind.bit_width // 8}")
    data = column.buffers()[1]
    if not len(column) or data is None:
        return np.empty(0, dtype)
    return np.frombuffer(data, dtype, len(column), column.offset * dtype.itemsize)


def texts(events: Sequence[traces.Event]) -> list[rr.ComponentColumn]:
    """Lines of a log."""
    return columns(rr.TextLog, text=[printable(e.text) for e in events], level=[LEVELS[e.severity] for e in events])


def flat(points: Floats, layer: str = "") -> NDArray[np.float32]:
    """Points [n, 2] on the ground as [n, 3] in the viewer's precision, a hair above the layers below."""
    z = LAYER_M * (LAYERS.index(layer) if layer else 0)
    with np.errstate(over="ignore"):
        return np.column_stack([points, np.full(len(points), z)]).astype(np.float32)


def document(text: str) -> rr.TextDocument:
    """A text in Markdown; what looks like HTML in it is text."""
    return rr.TextDocument(printable(text).replace("<", "&lt;"), media_type="text/markdown")


def marker(name: str, radius: float) -> rr.Points3D:
    """The looks of a point on the map; `radius` in points of the screen."""
    return rr.Points3D.from_fields(colors=COLOURS[name], radii=rr.Radius.ui_points(radius))


def arrow(name: str, radius: float) -> rr.Arrows3D:
    """The looks of an arrow on the map; `radius` in points of the screen."""
    return rr.Arrows3D.from_fields(colors=COLOURS[name], radii=rr.Radius.ui_points(radius))
