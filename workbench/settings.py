"""Settings: a preset, over it a settings file, over it single overrides; and the estimators by name.

An unknown key or a value of the wrong type is an error of one line that names the key, where it stands and
what is known instead; nothing is ignored.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from readers.streams import WorkbenchError

if TYPE_CHECKING:
    from pydantic import BaseModel
    from pydantic_core import ErrorDetails

    from pipelines.estimator import Estimator, Step

ENTRY_POINTS = "estimator_workbench.estimators"
PREFERRED_PRESET = "best"
LISTED = 8


class SettingsError(WorkbenchError):
    """A setting, a settings file or the name of an estimator or preset that cannot be used."""


# ----------------------------------------------------------------------------- estimators


@dataclass(frozen=True, slots=True)
class Plugin:
    """An estimator that can be asked for by name.

    `answers` says what its steps are about: the vehicle's ``path``, or ``ranges`` to landmarks. `settings` is its
    frozen pydantic model with ``extra="forbid"``; where that has presets, it has the class
    methods ``presets() -> tuple[str, ...]`` and ``preset(name)``. `build` makes the estimator of such settings; `step`
    is the class of its steps where that is one for all settings, so that a run can be read without the estimator.
    Another package offers one under the entry point group `estimator_workbench.estimators`, as a `Plugin` or
    as a function without arguments that returns one.
    """

    name: str
    settings: type[BaseModel]
    build: Callable[[Any], Estimator[Any]]
    answers: Literal["path", "ranges"] = "path"
    step: type[Step] | None = None

    def step_type(self, settings: BaseModel) -> type[Step]:
        """The class of the steps under these settings."""
        return self.build(settings).step_type if self.step is None else self.step

    @property
    def presets(self) -> tuple[str, ...]:
        """The names of the presets; ``default`` where the settings have none."""
        named = getattr(self.settings, "presets", None)
        return tuple(named()) if named else ("default",)

    @property
    def usual_preset(self) -> str:
        """The preset that is used when none is asked for."""
        return PREFERRED_PRESET if PREFERRED_PRESET in self.presets else self.presets[0]

    def preset(self, name: str) -> BaseModel:
        """The settings of one preset.

        Raises:
            SettingsError: there is no preset of that name.
        """
        if name not in self.presets:
            raise SettingsError(f"{self.name} has no preset {name!r}; there are: {', '.join(self.presets)}")
        maker = getattr(self.settings, "preset", None)
        made: BaseModel = maker(name) if maker else self.settings()
        return made


def _correlation() -> Plugin:
    from pipelines.correlation.settings import CorrelationSettings
    from pipelines.correlation.step import CorrelationStep

    def build(settings: CorrelationSettings) -> Estimator[Any]:
        from pipelines.correlation.odometry import CorrelationOdometry

        return CorrelationOdometry(settings)

    return Plugin("correlation", CorrelationSettings, build, step=CorrelationStep)


def _range() -> Plugin:
    from pipelines.ranging.range_settings import RangeSettings
    from pipelines.ranging.step import RangeStep

    def build(settings: RangeSettings) -> Estimator[Any]:
        from pipelines.ranging.range_filter import RangeFilter

        return RangeFilter(settings)

    return Plugin("range", RangeSettings, build, "ranges", RangeStep)


def _semidirect() -> Plugin:
    from pipelines.semidirect.settings import SemidirectSettings
    from pipelines.semidirect.step import SemidirectStep

    def build(settings: SemidirectSettings) -> Estimator[Any]:
        from pipelines.semidirect.odometry import SemidirectOdometry

        return SemidirectOdometry(settings)

    return Plugin("semidirect", SemidirectSettings, build, step=SemidirectStep)


def _ptam() -> Plugin:
    from pipelines.semidirect.baseline_settings import BaselineSettings
    from pipelines.semidirect.baseline_step import BaselineStep

    def build(settings: BaselineSettings) -> Estimator[Any]:
        from pipelines.semidirect.baseline import BaselineOdometry

        return BaselineOdometry(settings)

    return Plugin("ptam", BaselineSettings, build, step=BaselineStep)


BUILT_IN: Mapping[str, Callable[[], Plugin]] = {
    "correlation": _correlation,
    "range": _range,
    "semidirect": _semidirect,
    "ptam": _ptam,
}


def estimator_names() -> tuple[str, ...]:
    """The names of all estimators, our own first."""
    return (*BUILT_IN, *sorted(p.name for p in entry_points(group=ENTRY_POINTS) if p.name not in BUILT_IN))


def plugin(name: str) -> Plugin:
    """The estimator of that name.

    Raises:
        SettingsError: there is none, or another package's entry point cannot be loaded.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]()
    for point in entry_points(group=ENTRY_POINTS, name=name):
        try:
            loaded = point.load()
            found = loaded if isinstance(loaded, Plugin) else loaded()
        except Exception as error:
            raise SettingsError(f"the estimator {name!r} ({point.value}) cannot be loaded: {error}") from error
        if not isinstance(found, Plugin):
            raise SettingsError(f"the entry point {point.value} of {name!r} is not a Plugin")
        return found
    raise SettingsError(f"there is no estimator {name!r}; there are: {', '.join(estimator_names())}")


# ------------------------------------------------------------------------------- settings


@dataclass(frozen=True, slots=True)
class Layer:
    """Some settings and where they come from: a file, or ``--set``."""

    origin: str
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Resolved:
    """Validated settings, and the names of the top-level keys that the user gave."""

    settings: BaseModel
    given: frozenset[str]


def resolve(
    estimator: Plugin, *, preset: str | None = None, file: Path | None = None, overrides: Sequence[str] = ()
) -> Resolved:
    """Lay a settings file and overrides over a preset and validate the whole.

    Args:
        estimator: whose settings they are.
        preset: name of the preset, None for the usual one.
        file: a TOML or JSON file with some keys, or the RUN.toml of an earlier run.
        overrides: ``key=value`` each, the value written as in TOML, dots for nested keys.

    Raises:
        SettingsError: a file that cannot be read, an unknown key or preset, a wrong value.
    """
    base = estimator.preset(preset or estimator.usual_preset)
    layers = [] if file is None else [Layer(str(file), read_settings(file, estimator.settings))]
    layers += [Layer(f"--set {text}", parse_override(text)) for text in overrides]
    return validated(base, layers)


def validated(base: BaseModel, layers: Sequence[Layer]) -> Resolved:
    """Lay some layers over settings and validate the whole; later layers win.

    Raises:
        SettingsError: an unknown key, or a value of the wrong type or outside its range.
    """
    from pydantic import ValidationError

    merged = base.model_dump()
    for layer in layers:
        merged = _merge(merged, layer.values)
    try:
        settings = type(base).model_validate(merged)
    except ValidationError as error:
        raise SettingsError(_explain(error.errors(), type(base), layers)) from None
    return Resolved(settings, frozenset(key for layer in layers for key in layer.values))


def read_settings(file: Path, model: type[BaseModel]) -> dict[str, Any]:
    """The keys and values of a settings file (TOML or JSON); of a RUN.toml its table ``settings``.

    Raises:
        SettingsError: the file is missing, or is neither TOML nor JSON.
    """
    try:
        text = file.read_text(encoding="utf-8")
        values = json.loads(text) if file.suffix.lower() == ".json" else tomllib.loads(text)
    except OSError as error:
        raise SettingsError(f"{file}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        kind = "JSON" if file.suffix.lower() == ".json" else "TOML"
        raise SettingsError(f"{file}: not valid {kind}: {error}") from error
    if not isinstance(values, dict):
        raise SettingsError(f"{file}: a settings file holds keys and values, not a {type(values).__name__}")
    inner = values.get("settings")
    return inner if isinstance(inner, dict) and "settings" not in model.model_fields else values


def parse_override(text: str) -> dict[str, Any]:
    """``a.b=1`` as ``{"a": {"b": 1}}``; a value that is not TOML is taken as a text, ``none`` as None.

    Raises:
        SettingsError: there is no key or no equals sign.
    """
    key, equals, written = (part.strip() for part in text.partition("="))
    parts = key.split(".")
    if not equals or not all(parts):
        raise SettingsError(f"--set {text}: write key=value, for example --set search_radius_px=16")
    value = _parse_value(written)
    for part in reversed(parts):
        value = {part: value}
    nested: dict[str, Any] = value
    return nested


def to_toml(values: Mapping[str, Any]) -> str:
    """Values as TOML; keys whose value is None are left out, as TOML has no word for it."""
    import tomli_w

    return tomli_w.dumps(_without_none(values))


def settings_values(settings: BaseModel) -> dict[str, Any]:
    """Settings as plain values (texts, numbers, lists) that TOML and JSON can hold."""
    return settings.model_dump(mode="json")


def described(model: type[BaseModel]) -> Iterator[tuple[str, str]]:
    """The name and the description of every setting."""
    for name, info in model.model_fields.items():
        yield name, info.description or ""


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value if v is not None]
    return value


def _parse_value(written: str) -> Any:
    if written.lower() in ("none", "null"):
        return None
    try:
        parsed = tomllib.loads(f"value = {written}")
    except tomllib.TOMLDecodeError:
        return written
    return parsed["value"] if len(parsed) == 1 else written


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(below, list | tuple) and isinstance(value, dict):
            merged[key] = _merge_places(key, below, value)
        else:
            merged[key] = _merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _merge_places(key: str, base: Sequence[Any], over: Mapping[str, Any]) -> list[Any]:
    """A list with some of its entries changed; `over` names them by their places, counted from 0."""
    merged = list(base)
    for place, value in over.items():
        if not (place.isdecimal() and int(place) < len(merged)):
            raise SettingsError(f"{key}.{place}: {key} has {len(merged)} entries, and the first one is {key}.0")
        below = merged[int(place)]
        merged[int(place)] = _merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _explain(errors: Sequence[ErrorDetails], model: type[BaseModel], layers: Sequence[Layer]) -> str:
    """One line about the first thing that is wrong."""
    first = errors[0]
    path = [str(part) for part in first["loc"]]
    key = ".".join(path)
    origin = _origin(path, layers)
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    if first["type"] == "extra_forbidden":
        return f"{origin}: unknown setting {key!r}; {_hint(path[-1], _known(model, path[:-1]))}{more}"
    if first["type"] == "missing":
        return f"{origin}: {key} must be given{more}"
    message = first["msg"].removeprefix("Value error, ")
    if not path:
        return f"{origin}: {message}{more}"
    return f"{origin}: {key} = {first['input']!r}: {message[:1].lower()}{message[1:]}{more}"


def _hint(wrong: str, known: Sequence[str]) -> str:
    """What a wrong name may have meant."""
    near = difflib.get_close_matches(wrong, known, n=3, cutoff=0.5)
    if near:
        return f"did you mean {' or '.join(near)}?"
    listed = ", ".join(known[:LISTED])
    return f"known are: {listed}" if len(known) <= LISTED else f"known are: {listed}, … ({len(known)} in all)"


def _origin(path: Sequence[str], layers: Sequence[Layer]) -> str:
    """The last layer that holds the key; all layers where the fault is not in one key."""
    for layer in reversed(layers):
        values: Any = layer.values
        if path and isinstance(values, dict) and path[0] in values:
            return layer.origin
    return ", ".join(layer.origin for layer in layers) or "settings"


def _known(model: type[BaseModel], path: Sequence[str]) -> list[str]:
    """The keys that a model, or the model nested in it under `path`, has."""
    for part in path:
        annotation: Any = model.model_fields[part].annotation if part in model.model_fields else None
        choices = [choice for choice in (annotation, *get_args(annotation)) if hasattr(choice, "model_fields")]
        if not choices:
            return []
        model = choices[0]
    return list(model.model_fields)
