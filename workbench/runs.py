"""A finished run as it lies in its folder: what was set, what came out, every number, image and reference pose.

    run = open_run("results/mission")          # or results/mission/best.rrd, .toml
    run.frames, run.column("residual_rms")     # arrays, one row a frame
    run.trace("correlation")                   # everything as a pandas table

Nothing here writes. Columns are read when they are asked for and are kept.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from pipelines.estimator import Step
from pipelines.evaluation import Trajectory
from pipelines.semidirect.step import VisualStep
from pipelines.verdict import Verdict
from readers.streams import ImageSample, RecordingError
from workbench.schema import Archetype, Schema, schema_of
from workbench.settings import Layer, Plugin, plugin, settings_values, validated

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.spatial import SpatialPath

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
IMAGE = "/camera/image"
ANSWER = ".whatif-"
"""What the names of the answers of ``whatif`` hold."""
CURE = "give the RUN.rrd, the RUN.toml or the folder of a replay"


@dataclass(frozen=True)
class Errors:
    """Errors against the reference after alignment at `frame` [m], `t_ns` [m].

    `values` [m, 4] are x, y, distance (m), heading (rad).
    """

    frame: Ints
    t_ns: Ints
    values: Floats


@dataclass(frozen=True)
class Run:
    """One run of a mission.

    Attributes:
        folder: where its files are.
        name: name of the run.
        toml: what RUN.toml holds.
    """

    folder: Path
    name: str
    toml: Mapping[str, Any]
    _columns: dict[str, NDArray[Any]] = field(default_factory=dict, repr=False)

    # ---- files

    def path(self, ending: str) -> Path:
        """One of the run's own files, such as ``RUN.tum``."""
        return self.folder / f"{self.name}.{ending}"

    @property
    def file(self) -> Path:
        """RUN.rrd."""
        return self.path("rrd")

    @property
    def sensors_file(self) -> Path:
        """The measurements of the mission."""
        return self.folder / "sensors.rrd"

    # ---- what was asked for

    @property
    def about(self) -> Mapping[str, Any]:
        """The table ``run`` of RUN.toml."""
        values: Mapping[str, Any] = self.toml["run"]
        return values

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return str(self.about["estimator"])

    @property
    def preset(self) -> str:
        """Name of the preset that the settings started from."""
        return str(self.about["preset"])

    @property
    def digest(self) -> str:
        """SHA-256 of the recording; equal for runs of one mission."""
        return str(self.about["digest"])

    @property
    def settings(self) -> Mapping[str, Any]:
        """Every setting as a plain value; None is left out."""
        values: Mapping[str, Any] = self.toml.get("settings", {})
        return values

    @property
    def summary(self) -> Mapping[str, Any]:
        """What the replay concluded; empty where it was killed."""
        values: Mapping[str, Any] = self.toml.get("summary", {})
        return values

    @property
    def complete(self) -> bool:
        """Whether the replay came to its end; an interrupted one did, a killed one did not."""
        return bool(self.toml.get("complete", False))

    @functools.cached_property
    def plugin(self) -> Plugin:
        """The estimator.

        Raises:
            SettingsError: it is not installed here.
        """
        return plugin(self.estimator)

    @functools.cached_property
    def model(self) -> BaseModel:
        """The settings as they were; a key that is missing was None, as TOML has no word for it.

        Raises:
            SettingsError: the estimator of this version does not have them.
        """
        settings = self.plugin.settings
        base = settings.model_construct(**dict.fromkeys(settings.model_fields))
        return validated(base, [Layer(str(self.path("toml")), _with_none(settings, self.settings))]).settings

    def changed_settings(self) -> dict[str, tuple[Any, Any]]:
        """The settings that differ from their preset's: name → value here, value there (None: not set)."""
        usual = _without_none(settings_values(self.plugin.preset(self.preset)))
        here = dict(self.settings)
        names = dict.fromkeys([*usual, *here])
        return {k: (here.get(k), usual.get(k)) for k in names if here.get(k) != usual.get(k)}

    # ---- numbers

    @functools.cached_property
    def schema(self) -> Schema:
        """Where each field of its steps lies."""
        return schema_of(self.plugin.step_type(self.model))

    @property
    def step_type(self) -> type[Step]:
        """The class of its steps."""
        return self.schema.step_type

    @property
    def root(self) -> str:
        """The entity path above all its numbers."""
        return f"/runs/{self.name}/{self.estimator}"

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of all fields but surfaces and lists."""
        apart = (Archetype.SURFACES, Archetype.LISTS)
        return tuple(row.field for row in self.schema.rows if row.archetype not in apart)

    @property
    def lists(self) -> tuple[str, ...]:
        """The names of the fields whose length changes from frame to frame."""
        return self.schema.lists

    def columns(self, names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Some fields of all frames, [n, *shape] each; lists are not for it, see `column`.

        Raises:
            RecordingError: the file cannot be read, or holds no such run.
            KeyError: there is no such field.
        """
        from workbench import rrd_reading

        wanted = list(names)
        unknown = [name for name in wanted if name not in (*self.fields, "frame", "t_ns")]
        if unknown:
            raise KeyError(f"{self.estimator} has no field {unknown[0]!r}; there are: {', '.join(self.fields)}")
        missing = [name for name in wanted if name not in self._columns]
        if missing or not self._columns:
            found = rrd_reading.columns(self.file, self.root, self.schema, [*missing, "verdict", "alarms"])
            self._columns.update(found)
        return {name: self._columns[name] for name in wanted}

    def sample(self, frame: int, *, margin: int, blocks: int) -> dict[str, NDArray[Any]]:
        """All fields of the frames around one, and of a sample of the run, [m, *shape] each, ascending by ``frame``.

        A short run is its own sample. Consecutive frames come in blocks.
        """
        from workbench import rrd_reading

        if len(self.frames) <= blocks * margin:
            return self.columns(self.fields)
        choose = rrd_reading.spread(frame, margin, blocks)
        return rrd_reading.columns(self.file, self.root, self.schema, self.fields, choose)

    def column(self, name: str) -> NDArray[Any]:
        """One field of all frames, [n, *shape], see `columns`; of a list an array [n] of arrays, which is not kept.

        Raises:
            RecordingError: the file cannot be read.
            KeyError: there is no such field.
        """
        return self.list_columns([name])[name] if name in self.lists else self.columns([name])[name]

    def list_columns(self, names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Some lists of all frames, an array [n] of arrays each; they are large and not kept.

        Raises:
            RecordingError: the file cannot be read.
        """
        from workbench import rrd_reading

        return rrd_reading.columns(self.file, self.root, self.schema, names)

    @property
    def frames(self) -> Ints:
        """Numbers of the frames [n], ascending."""
        return self.column("frame")

    @property
    def t_ns(self) -> Ints:
        """Sensor times of the frames [n]."""
        return self.column("t_ns")

    @functools.cached_property
    def verdicts(self) -> list[Verdict]:
        """The verdict of each frame."""
        return [Verdict(int(value)) for value in self.column("verdict")]

    @functools.cached_property
    def alarms(self) -> list[Verdict]:
        """The alarms of each frame, as a set of flags."""
        return [Verdict(int(value)) for value in self.column("alarms")]

    def row_of(self, frame: int) -> int:
        """The row of a frame in every column.

        Raises:
            RecordingError: the run has no such frame.
        """
        row = int(np.searchsorted(self.frames, frame))
        if row < len(self.frames) and self.frames[row] == frame:
            return row
        first, last = int(self.frames[0]), int(self.frames[-1])
        raise RecordingError(self.file, f"has no frame {frame}", f"give one of {first} to {last}")

    def frame_at(self, t_ns: int) -> int:
        """The number of the frame whose sensor time is nearest."""
        return int(self.frames[np.argmin(np.abs(self.t_ns - t_ns))])

    def trace(self, estimator: str | None = None, fields: Iterable[str] | None = None) -> pd.DataFrame:
        """The numbers of every frame as a table, the frame's number as its index.

        A field of one number is a column of its name; an element of an array one named like ``pose[0]`` or
        ``shift_px[3,1]``. Surfaces are left out.

        Args:
            estimator: name of the estimator; the run's own, which is the only one.
            fields: names of fields; all of them by default.

        Raises:
            RecordingError: the run is of another estimator, or its file cannot be read.
        """
        import pandas as pd

        if estimator not in (None, self.estimator):
            raise RecordingError(self.file, f"is not a run of {estimator!r}", f"ask for {self.estimator!r}")
        names = ["t_ns", *(name for name in fields or self.fields if name not in ("frame", "t_ns"))]
        found = self.columns(names)
        columns: dict[str, Any] = {}
        for name, array in found.items():
            for index in np.ndindex(array.shape[1:]):
                columns[f"{name}[{','.join(map(str, index))}]" if index else name] = array[(slice(None), *index)]
        return pd.DataFrame(columns, index=pd.Index(self.frames, name="frame"))

    def lists_at(self, frame: int) -> dict[str, NDArray[Any]]:
        """The lists of one frame.

        Raises:
            RecordingError: the run has no such frame, or its file cannot be read.
        """
        if not self.lists:
            return {}
        from workbench.rrd import read_fields

        found = read_fields(self.file, self.name, self.step_type, self.lists, range(frame, frame + 1))
        return {name: values[0] for name, values in found.items()}

    def steps(self, first: int, stop: int) -> list[Step]:
        """The Steps of the frames `first` to before `stop`, surfaces included.

        Raises:
            RecordingError: the file cannot be read.
        """
        from workbench.rrd import read_steps

        return read_steps(self.file, self.name, self.step_type, frames=range(first, stop))

    # ---- beside the estimator

    @functools.cached_property
    def errors(self) -> Errors | None:
        """Errors of the path against the reference; None where there was none."""
        found = self._series(self.file, f"{self.root}/error")
        return None if found is None else Errors(found.frame, found.t_ns, found.values)

    @functools.cached_property
    def reference(self) -> Trajectory | None:
        """The reference path, seen from above; None where there is none."""
        found = self._series(self.sensors_file, "/sensors/reference")
        return None if found is None else Trajectory.of(found.t_ns, found.values[:, [0, 1, 3]])

    @functools.cached_property
    def trajectory(self) -> Trajectory | None:
        """The estimated path, seen from above; None of an estimator that has none.

        Of a visual odometry only frames whose pose was found; the others hold the last one.
        """
        if "pose" not in self.fields:
            return None
        pose = self.column("pose")
        if self.visual:
            pose = np.where(self.column("accepted").astype(bool)[:, None], pose, np.nan)
        return Trajectory.of(self.t_ns, pose)

    @property
    def visual(self) -> bool:
        """Whether it is of a visual odometry with a map."""
        return issubclass(self.step_type, VisualStep)

    @functools.cached_property
    def path_in_space(self) -> SpatialPath | None:
        """The estimated path in space, of frames whose pose was found; None of an estimator that has only the plane."""
        from pipelines.spatial import SpatialPath

        if not self.visual:
            return None
        found = self.column("accepted").astype(bool)
        return SpatialPath.of(self.t_ns[found], self.column("position_m")[found], self.column("quat_xyzw")[found])

    @functools.cached_property
    def reference_depths(self) -> Floats | None:
        """Reference depth of the landmark in each slot of every frame [n, N], m; None where nothing tells any."""
        found = self._series(self.file, f"{self.root}/reference")
        if found is None:
            return None
        depths = np.full((len(self.frames), found.values.shape[1]), np.nan)
        _, here, there = np.intersect1d(self.frames, found.frame, assume_unique=True, return_indices=True)
        depths[here] = found.values[there]
        return depths

    def _series(self, file: Path, entity: str) -> Any:
        from workbench.rrd_reading import series

        if not file.is_file():
            return None
        found = series(file, entity, Archetype.SCALARS.value)
        return found if len(found.t_ns) else None

    def image(self, frame: int) -> ImageSample | None:
        """A frame's image as it was logged; None where there is none.

        Raises:
            RecordingError: the file of the sensors cannot be read.
        """
        from workbench.rrd_reading import stored_image

        row = stored_image(self.sensors_file, IMAGE, frame) if self.sensors_file.is_file() else None
        return None if row is None else self._image(frame, row)

    def images(self, frames: Iterable[int]) -> dict[int, ImageSample]:
        """The images of some frames, those that there are, in one pass over the file.

        Raises:
            RecordingError: as `image`.
        """
        from workbench.rrd_reading import stored_images

        if not self.sensors_file.is_file():
            return {}
        rows = stored_images(self.sensors_file, IMAGE, list(frames))
        found = ((frame, self._image(frame, row)) for frame, row in rows)
        return {frame: sample for frame, sample in found if sample is not None}

    def _image(self, frame: int, row: Mapping[str, Any]) -> ImageSample | None:
        t_ns = int(self.t_ns[self.row_of(frame)])
        return _sample(row, frame, t_ns, self.about["image_stream"], str(self.sensors_file))


def open_run(path: Path | str) -> Run:
    """Open a run by its .rrd, .toml or .tum file, by that name without an ending, or by its folder.

    Raises:
        RecordingError: there is no run, the folder holds several, or RUN.toml is damaged.
    """
    path = Path(path)
    if path.is_dir():
        found = _replays_in(path)
        if len(found) > 1:
            names = ", ".join(file.stem for file in found)
            raise RecordingError(
                path, f"holds several runs: {names}", f"give one, such as {found[0].with_suffix('.rrd')}"
            )
        if not found:
            raise RecordingError(path, "holds no run", CURE)
        return _opened(found[0])
    known = path.suffix in (".rrd", ".toml", ".tum")
    return _opened(path.with_suffix(".toml") if known else path.with_name(path.name + ".toml"))


def runs_in(paths: Iterable[Path | str]) -> list[Run]:
    """All runs of some paths; a folder gives every run in it.

    Raises:
        RecordingError: as `open_run`.
    """
    found: list[Run] = []
    for path in map(Path, paths):
        files = _replays_in(path) if path.is_dir() else []
        found += [_opened(file) for file in files] or [open_run(path)]
    return found


def _replays_in(folder: Path) -> list[Path]:
    """The RUN.toml of every replay in a folder; answers of ``whatif`` are asked for by their names."""
    names = sorted(file for file in folder.glob("*.toml") if file.name != "sensors.toml")
    return [file for file in names if ANSWER not in file.stem]


def _opened(file: Path) -> Run:
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordingError(file.with_suffix(""), "there is no such run", CURE) from None
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(file, f"cannot be read ({error})", "replay the recording again") from error
    if not {"name", "estimator", "preset", "digest", "image_stream"} <= set(values.get("run", {})):
        raise RecordingError(file, "is not the RUN.toml of a replay", CURE)
    run = Run(file.parent, str(values["run"]["name"]), values)
    if not run.file.is_file():
        raise RecordingError(run.file, "is missing beside its RUN.toml", "replay the recording again")
    return run


def _with_none(model: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Values from TOML with None for every key that is missing."""
    found: dict[str, Any] = {}
    for name, info in model.model_fields.items():
        value, inner = values.get(name), info.annotation
        nested = isinstance(inner, type) and issubclass(inner, BaseModel) and isinstance(value, dict)
        found[name] = _with_none(inner, value) if nested else value  # type: ignore[arg-type]
    return found


def _without_none(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_none(value) if isinstance(value, Mapping) else value
        for key, value in values.items()
        if value is not None
    }


def _sample(row: Mapping[str, Any], frame: int, t_ns: int, stream: str, source: str) -> ImageSample | None:
    """A logged image as a sample."""
    blob = row.get("EncodedImage:blob")
    if blob:
        media = row["EncodedImage:media_type"][0]
        return ImageSample(
            stream=stream,
            t_ns=t_ns,
            received_ns=t_ns,
            encoding=media.partition("/")[2],
            payload=bytes(blob[0]),
            frame=frame,
            source=source,
        )
    buffer = row.get("Image:buffer")
    if not buffer:
        return None
    form = row["Image:format"][0]
    deep, colour = form["channel_datatype"] != 6, form["color_model"] not in (None, 1)
    bytes_a_px = (2 if deep else 1) * (3 if colour else 1)
    return ImageSample(
        stream=stream,
        t_ns=t_ns,
        received_ns=t_ns,
        encoding=("rgb" if colour else "mono") + ("16" if deep else "8"),
        payload=bytes(buffer[0]),
        width_px=form["width"],
        height_px=form["height"],
        step_bytes=form["width"] * bytes_a_px,
        frame=frame,
        source=source,
    )
