"""A run in other tools' formats: tables (Parquet, CSV), trajectories (TUM, KITTI), one portable recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pipelines.spatial import SpatialPath
from readers.streams import RecordingError, WorkbenchError
from workbench.runs import Run

FORMATS = ("parquet", "csv", "tum", "kitti", "rrd")
USUAL = ("parquet", "tum", "rrd")


class ExportError(WorkbenchError):
    """Something that a run cannot be exported as."""


def export(run: Run, folder: Path, formats: Sequence[str] | None = None) -> list[Path]:
    """Write a run in other formats; the files written.

    The table of the numbers has one row a frame, a column a number; `pandas.read_parquet` and `read_csv` give it
    back with the frame's number as its index (CSV: ``index_col="frame"``), bit for bit.

    Args:
        run: the run.
        folder: where to; it is made.
        formats: of `FORMATS`; None for those of `USUAL` that the run can give.

    Raises:
        ExportError: an unknown format, or a trajectory of an estimator that has none.
        RecordingError: a file cannot be read or written.
    """
    chosen = list(formats) if formats is not None else [f for f in USUAL if f != "tum" or run.trajectory is not None]
    unknown = [name for name in chosen if name not in FORMATS]
    if unknown:
        raise ExportError(f"there is no format {unknown[0]!r}; there are: {', '.join(FORMATS)}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return [_WRITERS[name](run, folder) for name in chosen]
    except OSError as error:
        raise RecordingError(
            folder, f"cannot be written ({error.strerror})", "choose another folder with -o"
        ) from error


def _parquet(run: Run, folder: Path) -> Path:
    file = folder / f"{run.name}.{run.estimator}.parquet"
    run.trace().to_parquet(file)
    return file


def _csv(run: Run, folder: Path) -> Path:
    file = folder / f"{run.name}.{run.estimator}.csv"
    run.trace().to_csv(file)
    return file


def _trajectory(run: Run, folder: Path, ending: str) -> Path:
    from workbench.trajectory_files import write_kitti, write_tum

    path = run.trajectory
    if path is None:
        raise ExportError(f"{run.file}: {run.estimator} has no trajectory, so there is no {ending} file of it")
    file = folder / f"{run.name}.{ending}"
    in_space = run.path_in_space
    {"tum": write_tum, "kitti": write_kitti}[ending](file, SpatialPath.of_plane(path) if in_space is None else in_space)
    return file


def _rrd(run: Run, folder: Path) -> Path:
    from workbench.rrd import merge

    file = folder / f"{run.name}.portable.rrd"
    merge([*([run.sensors_file] if run.sensors_file.is_file() else []), run.file], file)
    return file


_WRITERS: Mapping[str, Callable[[Run, Path], Path]] = {
    "parquet": _parquet,
    "csv": _csv,
    "tum": lambda run, folder: _trajectory(run, folder, "tum"),
    "kitti": lambda run, folder: _trajectory(run, folder, "kitti"),
    "rrd": _rrd,
}
