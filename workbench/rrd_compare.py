"""Several runs in one recording: their paths in colours of their own, and how far they are apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from workbench.blueprints import Extent, compare_blueprint
from workbench.rrd_columns import columns
from workbench.rrd_file import RrdFile, flat

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PALETTE = (0x4FC3F7FF, 0xFFB74DFF, 0xBA68C8FF, 0xAED581FF, 0xF06292FF, 0xFFF176FF, 0x4DB6ACFF, 0xA1887FFF)
LAYER = "corrected"


class DifferenceWriter:
    """Writes what is told of several runs together, with the view that shows them over one another.

    Args:
        path: the file to write.
        recording_id: the mission's id, that of the runs.
        estimator: name of the estimator, for the view.
        runs: names of the runs, for the view.
        extent: what the map shows, None for the viewer's choice.
        frames: first and last frame, for the axes of the plots.
        path_runs: whether the differences are those of paths (m, rad), not of ranges (shares).

    Raises:
        RecordingError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        recording_id: str,
        estimator: str,
        runs: Sequence[str],
        extent: Extent | None,
        frames: tuple[int, int],
        path_runs: bool,
    ) -> None:
        self._file = RrdFile(path, recording_id)
        self._runs, self._path_runs = list(runs), path_runs
        self._file.blueprint(compare_blueprint(self._runs, estimator, extent, frames, path_runs=path_runs))
        if extent is not None:
            self._file.scale_bar(extent)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _colour(self, run: str) -> int:
        return PALETTE[self._runs.index(run) % len(PALETTE)]

    def path(self, run: str, positions: Floats) -> None:
        """Draw a run's path [n, 2] in m in its colour."""
        points = flat(positions, LAYER)
        line = rr.LineStrips3D(
            [points], colors=self._colour(run), radii=rr.Radius.ui_points(2), labels=[run], show_labels=True
        )
        self._file.static(f"/world/compare/{run}", line)

    def differences(self, other: str, run: str, frame: Ints, t_ns: Ints, difference: Floats) -> None:
        """Log how far a run is from another one: distance (m) and heading (rad), or shares of ranges, [m, 2]."""
        names = ("distance", "heading") if self._path_runs else ("largest", "median")
        for k, name in enumerate(names):
            entity = f"/compare/{name}/{run}"
            lines = rr.SeriesLines(names=[f"{run} from {other}"], colors=np.array([self._colour(run)], np.uint32))
            self._file.static(entity, lines)
            self._file.send(entity, frame, t_ns, columns(rr.Scalars, scalars=difference[:, k]))
