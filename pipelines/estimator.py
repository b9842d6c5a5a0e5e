"""What every estimator is: a pure step function from samples to records of all that it computed.

A `Step` class is a frozen slotted dataclass whose fields are declared with `quantity`, so that each
carries its unit, its shape and its meaning. That declaration is the list of intermediates: a new one
is one field there and one row in `workbench/schema.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from pipelines.verdict import Verdict
from readers.streams import Sample, StreamKind, WorkbenchError

StateT = TypeVar("StateT")


class EstimatorError(WorkbenchError):
    """An estimator cannot work with these settings on this input; the text says which and what to change."""


def quantity(unit: str, meaning: str, *shape: int | str) -> Any:
    """Declare a field of a Step: its unit (SI or px, ``1`` for none), what it is, and its shape.

    A letter in the shape stands for a length that the settings decide.
    """
    return dataclasses.field(metadata={"unit": unit, "meaning": meaning, "shape": shape})


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What every estimator says about a frame; estimators add their own fields.

    `frame` is the number of the frame within the recording's image stream (0, 1, …), whatever the
    window or stride of the replay.
    """

    frame: int = quantity("1", "number of the frame in its stream")
    t_ns: int = quantity("ns", "sensor time of the frame")
    received_ns: int = quantity("ns", "log time of the frame")
    verdict: Verdict = quantity("1", "gravest of the alarms")
    alarms: Verdict = quantity("1", "every check that did not pass, as flags")


class Estimator(Protocol[StateT]):
    """An estimator as the replay sees it.

    `name` is the name of the command line, `settings` the frozen model that is saved beside the result,
    `step_type` the class of its steps, `kinds` the kinds of samples that it can use.
    """

    name: ClassVar[str]
    kinds: ClassVar[tuple[StreamKind, ...]]

    @property
    def step_type(self) -> type[Step]:
        """The class of this estimator's steps."""
        ...

    @property
    def settings(self) -> BaseModel:
        """The frozen settings of this estimator."""
        ...

    def start(self) -> StateT:
        """The state before the first sample."""
        ...

    def step(self, state: StateT, sample: Sample, /) -> tuple[StateT, Step | None]:
        """Take one sample; return the new state, and a Step where the sample was a frame."""
        ...


class FrameImage(NamedTuple):
    """Stands in a packed state for the decoded grey image of a frame, which the recording holds anyway."""

    frame: int


Images = Callable[[int], NDArray[np.uint8] | NDArray[np.uint16]]
"""Grey levels [height, width] of the image of a frame, by its number."""


@runtime_checkable
class Resumable(Protocol[StateT]):
    """What an estimator may offer beside `Estimator`, so that a replay can go on from the middle.

    A packed state is a value of frozen dataclasses, named tuples, arrays, enums, containers and numbers. An
    estimator without these methods has its states kept as they are, and cannot go on under other settings.
    """

    def packed(self, state: StateT, /) -> Any:
        """The state in a form that is small to keep: images of frames as `FrameImage`, no settings."""
        ...

    def unpacked(self, packed: Any, images: Images, /) -> StateT:
        """The state that was packed: every step from it is, bit for bit, the step from the state itself.

        Raises:
            EstimatorError: it is no state of this estimator under its settings.
        """
        ...

    def adopted(self, state: StateT, /) -> StateT:
        """The state of the same estimator under other settings, in the shape that these settings need.

        What was computed stays as far as it fits; what does not fit begins afresh.

        Raises:
            EstimatorError: the states do not match; the text names the setting and the cure.
        """
        ...


def quantities(step_type: type[Step]) -> Mapping[str, Mapping[str, Any]]:
    """The declared fields of a Step class: name → unit, meaning, shape."""
    return {f.name: dict(f.metadata) for f in dataclasses.fields(step_type)}
