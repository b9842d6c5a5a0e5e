"""All that was computed of paper B's experiments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.reproduce.ranging.parts import Part
from workbench.reproduce.ranging.robot import Robot
from workbench.reproduce.ranging.simulation import (
    Accuracy,
    Asynchronous,
    Better,
    Consistency,
    Convergence,
    Misprints,
    Scaling,
)


@dataclass(frozen=True, kw_only=True)
class Results:
    """The parts; None for one that was not done.

    `runs` of each Monte Carlo, `seeds` runs of the replica; `log` is the folder of the one that is logged.
    """

    command: str
    log: Path
    runs: int
    seeds: int
    accuracy: Accuracy | None = None
    convergence: Convergence | None = None
    scaling: Scaling | None = None
    consistency: Consistency | None = None
    better: Better | None = None
    misprints: Misprints | None = None
    asynchronous: Asynchronous | None = None
    robot: Robot | None = None
    unfinished: Sequence[str] = ()

    @property
    def parts(self) -> dict[str, Part]:
        """What was done, by name."""
        named: dict[str, Part | None] = {
            "accuracy": self.accuracy,
            "convergence": self.convergence,
            "scaling": self.scaling,
            "consistency": self.consistency,
            "better": self.better,
            "misprints": self.misprints,
            "asynchronous": self.asynchronous,
            "robot": self.robot,
        }
        return {name: part for name, part in named.items() if part is not None}
