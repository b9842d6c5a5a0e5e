"""Scenarios by name or from a TOML file, with overrides; and the missions that they make.

The named scenarios are the files in ``scenarios/`` beside this module. A scenario stands wherever a recording
does as ``sim:NAME``, or as the path of its TOML file.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from readers.streams import RecordingError
from workbench.settings import Layer, SettingsError, parse_override, to_toml, validated

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipelines.simulation.mission import SimulatedMission
    from pipelines.simulation.scenario import Scenario

FOLDER = Path(__file__).with_name("scenarios")
PREFIX = "sim:"


@dataclass(frozen=True, slots=True)
class Loaded:
    """A scenario, and the folder that its picture is looked for in."""

    scenario: Scenario
    folder: Path


# ----------------------------------------------------------------------------------- names


def names() -> tuple[str, ...]:
    """The names of all scenarios that come with the workbench."""
    return tuple(sorted(file.stem for file in FOLDER.glob("*.toml")))


def about(name: str) -> str:
    """What a named scenario shows, one line."""
    return str(_read(FOLDER / f"{name}.toml").get("about", ""))


def is_scenario(path: Path) -> bool:
    """Whether a path stands for a scenario: ``sim:NAME``, or an existing TOML file."""
    return str(path).startswith(PREFIX) or (path.suffix == ".toml" and path.is_file())


def _file_of(wanted: str) -> Path:
    """The TOML file of a scenario by name, with or without ``sim:``, or by path."""
    name = wanted.removeprefix(PREFIX)
    if name in names():
        return FOLDER / f"{name}.toml"
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        return path
    near = difflib.get_close_matches(name, names(), n=3, cutoff=0.5)
    tip = f"did you mean {' or '.join(near)}?" if near else "workbench simulate --list names all"
    raise SettingsError(f"there is no scenario {name!r}; {tip} (or give a TOML file)")


def _read(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"{file}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise SettingsError(f"{file}: not valid TOML: {error}") from error


# ---------------------------------------------------------------------------------- loading


def load(wanted: str, *, overrides: Sequence[str] = (), seed: int | None = None, picture: Path | None = None) -> Loaded:
    """A scenario with overrides.

    Args:
        wanted: its name, with or without ``sim:``, or the path of a TOML file.
        overrides: ``key=value`` each, dots for nested keys and places in lists: ``faults.0.gain=1.4``.
        seed: another seed.
        picture: picture file of the ground, in place of what the scenario says.

    Raises:
        SettingsError: no such scenario, an unknown key, or a value that does not fit.
    """
    from pipelines.simulation.scenario import Scenario

    file = _file_of(wanted)
    layers = [Layer(f"scenario {file.stem if file.parent == FOLDER else file}", _read(file))]
    layers += [Layer(f"--set {text}", parse_override(text)) for text in overrides]
    if seed is not None:
        layers.append(Layer("--seed", {"seed": seed}))
    if picture is not None:
        layers.append(Layer("--picture", {"ground": {"picture": str(picture.resolve())}}))
    scenario = validated(Scenario(name=file.stem), layers).settings
    assert isinstance(scenario, Scenario)
    return Loaded(scenario, file.parent)


def mission(loaded: Loaded) -> SimulatedMission:
    """The mission that a scenario makes.

    Raises:
        SettingsError: its values do not go together.
        RecordingError: the picture of the ground cannot be read.
    """
    from pipelines.simulation.scenario import build

    given = loaded.scenario.ground.picture
    picture = read_picture(loaded.folder / given) if given else None
    try:
        return build(loaded.scenario, picture=picture)
    except ValueError as error:
        raise SettingsError(f"scenario {loaded.scenario.name}: {error}") from error


def open_scenario(path: Path) -> SimulatedMission:
    """The mission of a path for which `is_scenario` holds.

    Raises:
        SettingsError: no such scenario, or one that cannot be.
        RecordingError: the picture of the ground cannot be read.
    """
    return mission(load(str(path)))


def read_picture(file: Path) -> NDArray[np.float64]:
    """Grey levels [height, width], 0.299 R + 0.587 G + 0.114 B, of a picture file.

    Raises:
        RecordingError: there is no such file, or it is no picture.
    """
    import cv2
    import numpy as np

    try:
        stored = np.frombuffer(file.read_bytes(), dtype=np.uint8)
    except OSError as error:
        problem = f"the picture of the ground cannot be read ({error.strerror or error})"
        raise RecordingError(file, problem, "check ground.picture or --picture") from error
    picture = cv2.imdecode(stored, cv2.IMREAD_COLOR) if len(stored) else None
    if picture is None:
        raise RecordingError(file, "it is no picture that can be decoded", "give a PNG, JPEG or TIFF file")
    grey: NDArray[np.float64] = picture.astype(np.float64) @ np.array([0.114, 0.587, 0.299])
    return grey


# ---------------------------------------------------------------------------------- as text


def to_text(scenario: Scenario) -> str:
    """A scenario as TOML, every key with what it is."""
    return "\n".join(_table(type(scenario), scenario, "")) + "\n"


def _table(kind: type, section: Any, path: str) -> Iterator[str]:
    """The lines of one section: its values, then the sections within it."""
    from pipelines.simulation.sections import entry_values, is_section, meanings

    inner: list[tuple[str, Any]] = []
    for key, meaning in meanings(kind).items():
        value = getattr(section, key)
        if is_section(value) or isinstance(value, Mapping):
            inner.append((key, value))
        elif entries := entry_values(value):
            inner.append((key, entries))
        elif value is None:
            yield f"# {key}: {meaning}; not set"
        else:
            yield f"# {meaning.partition('. ')[0]}"
            yield to_toml({key: _plain(value)}).strip()
    for key, value in inner:
        below = f"{path}.{key}" if path else key
        if isinstance(value, list):
            for entry in value:
                yield from ("", f"[[{below}]]", *_values(entry, below))
        else:
            yield from ("", f"[{below}]")
            yield from _values(value, below) if isinstance(value, Mapping) else _table(type(value), value, below)


def _values(values: Mapping[str, Any], path: str) -> Iterator[str]:
    """The lines of a table without descriptions, the tables within it last."""
    if plain := {key: _plain(value) for key, value in values.items() if not isinstance(value, Mapping)}:
        yield to_toml(plain).strip()
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield f"[{path}.{key}]"
            yield from _values(value, f"{path}.{key}")


def _plain(value: Any) -> Any:
    """Tuples as lists, so that TOML can hold them."""
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value
