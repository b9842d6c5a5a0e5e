"""What an estimator's steps look like in the recording, beyond the numbers of their schema."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from workbench import traces
from workbench.blueprints import Extent
from workbench.rrd_file import IMAGE, Floats, Ints, RrdFile
from workbench.schema import Schema


class Drawing:
    """What is drawn of a run; this one draws nothing.

    Args:
        file: the run's file.
        schema: the rows of its steps.
        run: name of the run.
        estimator: name of the estimator.
        scene: what the drawing needs to know beyond the steps; each estimator's has its own type.
    """

    def __init__(self, file: RrdFile, schema: Schema, run: str, estimator: str, scene: Any = None) -> None:
        self.file, self.schema = file, schema
        self.root = f"/runs/{run}/{estimator}"
        self.world = f"/world/runs/{run}"
        self.image = f"{IMAGE}/{run}"
        self.scene = scene
        self.silent: frozenset[str] = frozenset()
        """Entities, relative to the root, of plots that had no number but 0 so far."""

    def constants(self) -> None:
        """Log what holds for the whole run."""

    def legends(self, table: traces.Columns) -> Mapping[str, Any]:
        """Log what depends on the shapes of a step, given as a table of one row; what is known now for `Bounds`."""
        return {}

    def bytes_a_step(self, table: traces.Columns) -> int:
        """About how much a step takes, given as a table of one row; it decides on the size of the buffer."""
        return 4096

    def write(self, table: traces.Columns, beside: Sequence[Any]) -> None:
        """Draw some steps; `beside` is what is known of each one's frame from elsewhere."""

    def smoothed(self, slot: int, frames: Ints, t_ns: Ints, mean: Floats, covariance: Floats) -> None:
        """Draw what smoothing says of the landmarks in a slot, see `RunWriter.smoothed`."""

    def finish(self, aligned_path: Floats | None, given: Extent | None) -> Mapping[str, Any]:
        """Draw what is known at the end; what is known by now for `Bounds`.

        Args:
            aligned_path: the path [n, 2] aligned with the reference, None where there is none.
            given: what the map shows already.
        """
        return {}

    def send(self, entity: str, table: traces.Columns, *columns: Iterable[Any]) -> None:
        """Log one row a step, at an entity below the run's root or at an absolute one."""
        path = entity if entity.startswith("/") else f"{self.root}/{entity}"
        self.file.send(path, table["frame"], table["t_ns"], *columns)
