"""Whether a run is as good as expected: bounds on its metrics, the answer as a JUnit file for CI.

A file of expectations is TOML with tables of bounds by the names of `workbench.metrics`:

    [max]
    drift_percent = 1.0
    "verdict.PEAK_AMBIGUOUS" = 5
    [min]
    "share.OK" = 95
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args
from xml.etree import ElementTree

from readers.streams import RecordingError, WorkbenchError
from workbench.metrics import metric

Side = Literal["max", "min"]
CURE = "write NAME=NUMBER, such as drift_percent=1, or a table [max] with drift_percent = 1.0"


class CheckError(WorkbenchError):
    """An expectation that cannot be understood."""


@dataclass(frozen=True, slots=True)
class Expectation:
    """A bound on a metric: at most (``max``) or at least (``min``) `bound`."""

    metric: str
    side: Side
    bound: float

    def met(self, value: float) -> bool:
        """Whether a value keeps the bound; NaN never does."""
        return value <= self.bound if self.side == "max" else value >= self.bound

    def __str__(self) -> str:
        return f"{self.metric} {'<=' if self.side == 'max' else '>='} {self.bound:g}"


@dataclass(frozen=True, slots=True)
class Checked:
    """An expectation and what a run has to say to it; `missing` says why there is no value."""

    expectation: Expectation
    value: float
    missing: str = ""

    @property
    def passed(self) -> bool:
        """Whether the run keeps it."""
        return self.expectation.met(self.value)

    def __str__(self) -> str:
        told = "no value" if math.isnan(self.value) else f"{self.value:.6g}"
        return f"{self.expectation}: {told}" + (f" ({self.missing})" if self.missing else "")


def parsed(text: str, side: Side) -> Expectation:
    """An expectation as the command line writes it, ``NAME=NUMBER``.

    Raises:
        CheckError: it is none.
    """
    name, sign, bound = text.rpartition("=")
    try:
        value = float(bound)
    except ValueError:
        value = math.nan
    if not name or not sign or math.isnan(value):
        raise CheckError(f"--{side} {text}: is no bound; {CURE}")
    return Expectation(name.strip(), side, value)


def read_expectations(file: Path) -> list[Expectation]:
    """The expectations of a TOML file.

    Raises:
        RecordingError: the file cannot be read.
        CheckError: it holds something else than bounds, or no bound.
    """
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RecordingError(file, f"cannot be read as TOML ({error})", CURE) from error
    found: list[Expectation] = []
    for table, bounds in values.items():
        if table not in get_args(Side) or not isinstance(bounds, Mapping):
            raise CheckError(f"{file}: {table!r} is no table of bounds; the tables are [max] and [min]")
        for name, bound in _dotted(bounds):
            if isinstance(bound, bool) or not isinstance(bound, int | float):
                raise CheckError(f"{file}: [{table}] {name}: {bound!r} is no number")
            found.append(Expectation(name, "max" if table == "max" else "min", float(bound)))
    if not found:
        raise CheckError(f"{file}: holds no expectation; {CURE}")
    return found


def _dotted(values: Mapping[str, object], before: str = "") -> Iterable[tuple[str, object]]:
    """Nested tables as dotted names: an unquoted ``verdict.LOST = 0`` is a table in TOML."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{before}{key}.")
        else:
            yield before + key, value


def check(found: Mapping[str, float], expectations: Iterable[Expectation]) -> list[Checked]:
    """Hold a run's metrics against expectations; what is not known does not pass.

    Raises:
        MetricError: an expectation names no metric.
    """
    results = []
    for expectation in expectations:
        value = metric(found, expectation.metric)
        missing = "the run does not tell it" if math.isnan(value) else ""
        results.append(Checked(expectation, value, missing))
    return results


def write_junit(file: Path, suites: Mapping[str, Sequence[Checked]]) -> None:
    """Write the results of some runs as a JUnit file, one suite a run.

    Raises:
        RecordingError: the file cannot be written.
    """
    root = ElementTree.Element("testsuites", name="workbench check")
    for name, results in suites.items():
        failed = sum(not result.passed for result in results)
        suite = ElementTree.SubElement(root, "testsuite", name=name, tests=str(len(results)), failures=str(failed))
        for result in results:
            case = ElementTree.SubElement(suite, "testcase", classname=name, name=str(result.expectation))
            if not result.passed:
                ElementTree.SubElement(case, "failure", message=str(result))
    ElementTree.indent(root)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise RecordingError(file, f"cannot be written ({error.strerror})", "choose another file") from error
