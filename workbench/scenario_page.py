"""The page `docs/scenarios.md`: every named scenario, section, key, curve, profile and fault, from the code itself.

`python -m workbench.scenario_page` writes it.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel

from pipelines.lens import COEFFICIENTS
from pipelines.simulation.curves import CURVES
from pipelines.simulation.families import FAMILIES
from pipelines.simulation.faults import FAULTS
from pipelines.simulation.scenario import Scenario
from pipelines.simulation.sections import DownCamera, FrontCamera, meanings
from pipelines.simulation.speeds import SPEEDS
from pipelines.simulation.timing import Timing
from workbench import scenarios

PAGE = Path(__file__).parents[1] / "docs" / "scenarios.md"

_PREFACE = """# Scenarios: every name and key

What a simulated mission is made of. [simulation.md](simulation.md) says how to use it; this page lists what there
is. It is made by `python -m workbench.scenario_page` from the code itself; a test demands that it is current.

Keys end in their unit: `_m`, `_px`, `_s`, `_rad`, `_radps` (rad/s), `_mps`, `_mps2`, `_hz`, `_ppm`, `_grey` (grey
levels, 0…255), `_kmh`. World and body: z up, x forward, y left, headings counter-clockwise.
"""


def document() -> str:
    """The text of `docs/scenarios.md`."""
    return "\n".join(line for block in _blocks() for line in block) + "\n"


def _blocks() -> Iterator[Iterable[str]]:
    yield [_PREFACE]
    yield ["## Scenarios by name", "`workbench simulate NAME`, or `sim:NAME` wherever a recording can stand.", ""]
    yield _table(("Scenario", "About"), ((f"`{name}`", scenarios.about(name)) for name in scenarios.names()))
    yield ["", "## At the top of the file", "What is not a section; before the first `[section]` of a TOML file.", ""]
    inner = {*(name for name, _, _ in _sections(Scenario)), "truth", "faults"}
    yield _keys(Scenario, [key for key in Scenario.model_fields if key not in inner])
    yield ["", "## Sections", _about_sections(), ""]
    for name, kind, listed in _sections(Scenario):
        yield [f"### `[[{name}]]`" if listed else f"### `[{name}]`", _first_paragraph(kind), ""]
        yield _section(kind)
    yield ["### `[truth]`, and `timing` of every camera and sensor", _first_paragraph(Timing), ""]
    yield _keys(Timing)
    yield ["", "## Curves", "`trajectory.curve`, and `trajectory.parameters` with their defaults. Lengths in m.", ""]
    yield _table(("Curve", "Parameters", "What"), _functions(CURVES))
    yield ["", "## Speed profiles", _about_profiles(), ""]
    yield _table(("Profile", "Parameters", "What"), _functions(SPEEDS))
    yield ["", "## Grounds and lenses"]
    yield [f"`ground.family`: {_listed(FAMILIES)}; [simulation-surfaces.md](simulation-surfaces.md) shows them."]
    lenses = (f"`{name}` ({count} coefficients)" for name, count in COEFFICIENTS.items())
    yield ["", f"`distortion_model`, with ROS's order of the coefficients: {', '.join(lenses)}."]
    yield ["", "## Faults", _about_faults(), ""]
    yield _table(("Fault", "Parameters", "What"), (_fault(name) for name in FAULTS))


def _sections(kind: type, above: str = "") -> Iterator[tuple[str, type, bool]]:
    """The sections within a section by their full names, and whether there is a list of them; and those within them."""
    for key, annotation in get_type_hints(kind, include_extras=True).items():
        parts = list(_parts(annotation))
        inner = next((part for part in parts if _has_keys(part)), None)
        if inner is not None and inner is not Timing:
            yield above + key, inner, any(get_origin(part) is tuple for part in parts)
            yield from _sections(inner, f"{above}{key}.")


def _parts(annotation: Any) -> Iterator[Any]:
    """A type, and the types that it is made of."""
    yield annotation
    for argument in get_args(annotation):
        yield from _parts(argument)


def _has_keys(part: Any) -> bool:
    return isinstance(part, type) and (issubclass(part, BaseModel) or dataclasses.is_dataclass(part))


def _about_sections() -> str:
    optional = [
        name for name, _, _ in _sections(Scenario) if "." not in name and Scenario.model_fields[name].default is None
    ]
    return (
        f"{_listed(optional)} and `truth`\n"
        "are on board only if the scenario has the section; an empty one takes the defaults."
    )


def _about_profiles() -> str:
    return (
        "`trajectory.profile`, and `trajectory.profile_parameters`. `speed_mps`, `duration_s` and `seed` come from\n"
        "the scenario (`trajectory.speed_kmh`, `duration_s` or `frames`, `seed`) unless they are given here."
    )


def _about_faults() -> str:
    return (
        "`[[faults]]` with `kind`, `start_s`, `stop_s` (s since the start of the mission, half-open) and the\n"
        "parameters; those without a default must be given."
    )


def _section(kind: type) -> Iterator[str]:
    if kind is not FrontCamera:
        yield from _keys(kind)
    else:
        yield "All keys of `[camera]`; these have another default:"
        yield ""
        yield from _keys(kind, [key for key in kind.model_fields if _default(kind, key) != _default(DownCamera, key)])
    yield ""


# ------------------------------------------------------------------------------------ keys


def _keys(kind: type, keys: Sequence[str] | None = None) -> Iterator[str]:
    texts = meanings(kind)
    rows = ((f"`{key}`", _default(kind, key), _values(kind, key), texts[key]) for key in keys or texts)
    return _table(("Key", "Default", "Value", "Meaning"), rows)


def _default(kind: type, key: str) -> str:
    if issubclass(kind, BaseModel):
        return _shown(kind.model_fields[key].default)
    fields: Mapping[str, dataclasses.Field[Any]] = vars(kind)["__dataclass_fields__"]
    default = fields[key].default
    return "must be given" if default is dataclasses.MISSING else _shown(default)


def _shown(value: Any) -> str:
    """A default as TOML has it; of a clock its rate, for all else is exact."""
    if value is None:
        return "none"
    if isinstance(value, Timing):
        return f"`rate_hz = {value.rate_hz:g}`"
    return f"`{_plain(value)}`"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Enum):
        return f'"{value.value}"'
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_plain, value))}]"
    return str(value)


def _values(kind: type, key: str) -> str:
    """What a key may be, in words."""
    if issubclass(kind, BaseModel):
        field = kind.model_fields[key]
        return " ".join(filter(None, (_type(field.annotation), _bounds(field.metadata))))
    return _type(get_type_hints(kind, include_extras=True)[key])


_WORDS: Mapping[Any, str] = {float: "number", int: "whole number", str: "text", bool: "true or false", dict: "table"}


def _type(annotation: Any) -> str:
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        return " ".join(filter(None, (_type(inner), _bounds(metadata))))
    arguments = get_args(annotation)
    if get_origin(annotation) in (Union, types.UnionType):
        return " or ".join(_type(a) for a in arguments if a is not types.NoneType)
    if get_origin(annotation) is Literal:
        return " or ".join(f"`{word}`" for word in arguments)
    if get_origin(annotation) is tuple:
        return f"list of {_many(arguments)}"
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return " or ".join(f"`{member.value}`" for member in annotation)
    if annotation is Timing:
        return "clock"
    return _WORDS.get(get_origin(annotation) or annotation, "section")


def _many(arguments: tuple[Any, ...]) -> str:
    inner = _type(arguments[0])
    if arguments[-1] is not Ellipsis:
        return f"{len(arguments)} {inner}s"
    return f"{inner.replace('list', 'lists', 1)}" if inner.startswith("list") else f"{inner}s"


def _bounds(metadata: Iterable[Any]) -> str:
    bounds = [inner for entry in metadata for inner in getattr(entry, "metadata", [entry])]
    signs = (("gt", ">"), ("ge", "≥"), ("le", "≤"))
    return ", ".join(f"{sign} {getattr(b, key):g}" for key, sign in signs for b in bounds if hasattr(b, key))


# --------------------------------------------------------------------------- names with parameters


def _functions(table: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    for name, function in table.items():
        parameters = inspect.signature(function).parameters.values()
        given = _parameters((p.name, p.default, p.default is p.empty) for p in parameters)
        yield f"`{name}`", given, _first_paragraph(function)


def _fault(name: str) -> tuple[str, str, str]:
    kind = FAULTS[name]
    fields = [f for f in dataclasses.fields(kind) if f.name not in ("start_s", "stop_s", "in_view_s")]
    given = _parameters((f.name, f.default, f.default is dataclasses.MISSING) for f in fields)
    return f"`{name}`", given, _first_paragraph(kind)


def _parameters(parameters: Iterable[tuple[str, Any, bool]]) -> str:
    return ", ".join(
        f"`{name}`" if needed or default is None else f"`{name} = {_plain(default)}`"
        for name, default, needed in parameters
    )


def _first_paragraph(thing: Any) -> str:
    return " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split())


# ------------------------------------------------------------------------------------ as text


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(heads)} |"
    yield "|" + "---|" * len(heads)
    for row in rows:
        yield "| " + " | ".join(cell.replace("``", "`") for cell in row) + " |"


if __name__ == "__main__":
    PAGE.write_text(document(), encoding="utf-8")
