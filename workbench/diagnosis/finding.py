"""What a diagnosis says: findings with their frames, evidence, cause and remedy; and what a rule looks at."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import Step
from pipelines.evaluation import Trajectory, associate
from pipelines.verdict import Severity, Verdict
from workbench.traces import objects

if TYPE_CHECKING:
    from workbench.runs import Run

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """One number that shows it: its `value` at the finding's worst frame, what is `usual` in this run, the `bound`.

    `name` is a field of the Step or words; `unit` as `pipelines.estimator.quantity` writes it. NaN: there is none.
    """

    name: str
    value: float
    unit: str = "1"
    usual: float = math.nan
    bound: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that went wrong.

    Attributes:
        rule: name of the rule that found it.
        severity: how grave it is.
        spans: its frames as pairs of numbers, first and last, both included, ascending.
        worst_frame: the frame to look at.
        sentence: what happened, for this run.
        evidence: the numbers that show it.
        cause: what is likely behind it.
        remedy: what to try, with the names of settings.
        harm_m: what its frames add to the end-point error in m (drift budget), NaN where that is not known.
    """

    rule: str
    severity: Severity
    spans: tuple[tuple[int, int], ...]
    worst_frame: int
    sentence: str
    evidence: tuple[Evidence, ...]
    cause: str
    remedy: str
    harm_m: float = math.nan

    @property
    def frames(self) -> int:
        """How many frame numbers its spans take in."""
        return sum(last - first + 1 for first, last in self.spans)

    def covers(self, frame: int, margin: int = 0) -> bool:
        """Whether a frame lies in one of its spans, or at most `margin` frames beside."""
        return any(first - margin <= frame <= last + margin for first, last in self.spans)


@dataclass(frozen=True)
class Case:
    """What the rules look at: the numbers of all frames of one run.

    Attributes:
        estimator: name of the estimator.
        settings: its settings as plain values.
        frame: numbers of the frames [n].
        t_ns: their sensor times [n].
        reference: reference pose x, y, heading at each frame [n, 3], NaN where it is not known.
        harm_m: what each frame adds to the end-point error [n], NaN where it is not known.
        facts: oddities of the recording's streams, a sentence each.
        get: the column [n, *shape] of a field by its name, of a list an array [n] of arrays.
        reference_depth_m: of the range estimator: reference depth of the landmark in each slot [n, N], NaN where it is
            not known; None where no reference tells any.
        kept: what rules share, see `once`.
    """

    estimator: str
    settings: Mapping[str, Any]
    frame: Ints
    t_ns: Ints
    reference: Floats
    harm_m: Floats
    facts: Sequence[str]
    get: Callable[[str], NDArray[Any]] = field(repr=False)
    reference_depth_m: Floats | None = None
    kept: dict[Any, Any] = field(default_factory=dict, repr=False, compare=False)

    def once(self, make: Callable[[Case], T], key: Any = None) -> T:
        """What a function makes of this case, made only once however many rules ask for it.

        `key` stands for the function where it is made anew for every call.
        """
        name = make if key is None else key
        if name not in self.kept:
            self.kept[name] = make(self)
        kept: T = self.kept[name]
        return kept

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A field of all frames [n, *shape]."""
        return self.get(name)

    def rings(self, flag: Verdict) -> Bools:
        """The frames [n] at which an alarm rings."""
        rings: Bools = (self.get("alarms").astype(np.int64) & int(flag)) != 0
        return rings

    @classmethod
    def of_run(cls, run: Run, harm_m: Floats | None = None) -> Self:
        """The case of a run on disk."""
        offset_ns = round(float(run.toml["run"].get("reference_offset_s", 0.0)) * 1e9)
        return cls(
            estimator=run.estimator,
            settings=run.settings,
            frame=run.frames,
            t_ns=run.t_ns,
            reference=_reference_at(run.reference, run.t_ns, offset_ns),
            harm_m=np.full(len(run.frames), np.nan) if harm_m is None else harm_m,
            facts=tuple(run.summary.get("facts", ())),
            get=run.column,
            reference_depth_m=run.reference_depths,
        )

    @classmethod
    def of_steps(
        cls,
        steps: Sequence[Step],
        estimator: str,
        settings: Mapping[str, Any],
        reference: Trajectory | None = None,
        facts: Sequence[str] = (),
        reference_depth_m: Floats | None = None,
    ) -> Self:
        """The case of steps in memory."""
        t_ns = np.array([step.t_ns for step in steps], np.int64)
        columns: dict[str, NDArray[Any]] = {}

        def get(name: str) -> NDArray[Any]:
            if name not in columns:
                values = [getattr(step, name) for step in steps]
                alike = len({np.shape(value) for value in values}) <= 1
                columns[name] = np.array(values) if alike else objects(values)
            return columns[name]

        return cls(
            estimator=estimator,
            settings=settings,
            frame=np.array([step.frame for step in steps], np.int64),
            t_ns=t_ns,
            reference=_reference_at(reference, t_ns, 0),
            harm_m=np.full(len(steps), np.nan),
            facts=facts,
            get=get,
            reference_depth_m=reference_depth_m,
        )


def _reference_at(reference: Trajectory | None, t_ns: Ints, offset_ns: int) -> Floats:
    if reference is None:
        return np.full((len(t_ns), 3), np.nan)
    return associate(t_ns, reference, offset_ns=offset_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """How one kind of failure is recognised: data and a small function.

    Attributes:
        name: of the failure, such as ``motion-blur``.
        estimator: name of the estimator whose runs it judges.
        severity: of its findings.
        cause: what is likely behind it.
        remedy: what to try.
        thresholds: the bounds that `find` uses, by name.
        find: the findings in a case.
    """

    name: str
    estimator: str
    severity: Severity
    cause: str
    remedy: str
    thresholds: Mapping[str, float]
    find: Callable[[Case, Rule], Iterable[Finding]]


def spans_of(frames: Ints, chosen: Bools, bridge: int = 2) -> tuple[tuple[int, int], ...]:
    """The chosen ones of some ascending frames [n] as spans; gaps of up to `bridge` frames are closed."""
    numbers = frames[chosen]
    if not len(numbers):
        return ()
    breaks = np.flatnonzero(np.diff(numbers) > bridge + 1)
    firsts = numbers[np.concatenate([[0], breaks + 1])]
    lasts = numbers[np.concatenate([breaks, [len(numbers) - 1]])]
    return tuple(zip(firsts.tolist(), lasts.tolist(), strict=True))
