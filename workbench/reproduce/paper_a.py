"""`workbench reproduce paper-a`: the experiment under all conditions, its tables, pictures, logs and report."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pipelines.simulation.families import FAMILIES, PAPER_GROUNDS
from workbench.reproduce import correction, experiment, limits, matrix, report
from workbench.reproduce.conditions import CONDITIONS, FRAMES, surface_of
from workbench.reproduce.documents import made_folder
from workbench.reproduce.ledger import Ledger, Part
from workbench.reproduce.plans import OnProgress, Reproduced, at_least
from workbench.reproduce.tasks import carried_out

LOGGED = ("C0", "C4")
FEWEST_FRAMES = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is to be done.

    `surface` is one of ours or a picture, None for gravel (and for all of ours in matrix and limits);
    `overrides` are ``key=value`` over the preset paper-a; `samples` are the fragments of a cell of the limits.
    """

    out: Path
    surface: str | None = None
    frames: int = FRAMES
    seeds: int = 1
    with_matrix: bool = False
    with_limits: bool = False
    jobs: int | None = None
    overrides: tuple[str, ...] = ()
    samples: int = limits.SAMPLES
    command: str = "workbench reproduce paper-a"

    @property
    def ground(self) -> str:
        """The surface of the experiment."""
        return self.surface or "gravel"

    @property
    def surfaces(self) -> tuple[str, ...]:
        """The surfaces of matrix and limits."""
        return (self.surface,) if self.surface else PAPER_GROUNDS

    @property
    def cells(self) -> list[experiment.Cell]:
        """The drives of the experiment, those that are logged first."""
        cells = [
            experiment.Cell(
                surface=self.ground, condition=condition, seed=seed, frames=self.frames, overrides=self.overrides
            )
            for seed in range(self.seeds)
            for condition in CONDITIONS
        ]
        return sorted(cells, key=lambda cell: not is_logged(cell))


def is_logged(cell: experiment.Cell) -> bool:
    """Whether the runs of a drive are logged as .rrd."""
    return cell.seed == 0 and cell.condition.name in LOGGED


def _kept(cell: experiment.Cell, folder: Path) -> experiment.Run | None:
    """The run of a cell, if it is there with its log."""
    if is_logged(cell) and not experiment.has_log(cell, folder):
        return None
    return experiment.kept(cell, folder)


def reproduce(plan: Plan, on_progress: OnProgress) -> Reproduced[report.Results]:
    """Do what is missing of the plan in its folder, and write the report.

    Finished parts are found again, so that the same call goes on after an interrupt.

    Raises:
        WorkbenchError: the plan cannot be carried out; the text says why.
    """
    _check(plan)
    work = _Work(plan, plan.jobs or os.cpu_count() or 1, on_progress)
    interrupted = False
    try:
        work.do()
    except KeyboardInterrupt:
        interrupted = True
    results = work.results()
    return Reproduced(plan.out, report.write(results, plan.out), results, interrupted)


def _check(plan: Plan) -> None:
    at_least("frames", plan.frames, FEWEST_FRAMES)
    at_least("seeds", plan.seeds, 1)
    if plan.jobs is not None:
        at_least("jobs", plan.jobs, 1)
    if plan.surface is not None and plan.surface not in FAMILIES:
        surface_of(plan.surface, 0)
    plan.cells[0].identity  # noqa: B018 (the settings are checked before anything is computed)
    made_folder(plan.out)


class _Work:
    """The parts of a plan, done one after the other."""

    def __init__(self, plan: Plan, jobs: int, on_progress: OnProgress) -> None:
        self._plan, self._jobs, self._on_progress = plan, jobs, on_progress
        self._runs = {cell: run for cell in plan.cells if (run := _kept(cell, plan.out)) is not None}
        self._effects: list[correction.Effect] = []
        self._matrix, self._limits = matrix.ledger(plan.out), limits.ledger(plan.out)
        self._places = matrix.places(
            plan.surfaces if plan.with_matrix else (), frames=min(plan.frames, matrix.FRAMES), overrides=plan.overrides
        )
        self._cases = limits.cases(plan.surfaces if plan.with_limits else (), samples=plan.samples)

    def do(self) -> None:
        """Do what is missing."""
        missing = [cell for cell in self._plan.cells if cell not in self._runs]
        tasks = [partial(experiment.computed, cell=c, folder=self._plan.out, log=is_logged(c)) for c in missing]
        steps = sum(experiment.ticks(cell, is_logged(cell)) for cell in missing)
        for run in carried_out(tasks, jobs=self._jobs, on_tick=self._told("experiment", steps)):
            self._runs[run.cell] = run
        self._effects = correction.effects(frames=self._plan.frames)
        self._fill("matrix", self._matrix, self._places)
        self._fill("limits", self._limits, self._cases)

    def _fill(self, what: str, results: Ledger, parts: Sequence[Part]) -> None:
        steps = sum(part.steps for part in results.missing_of(parts))
        results.fill(parts, jobs=self._jobs, on_tick=self._told(what, steps))

    def results(self) -> report.Results:
        """What is done by now."""
        plan = self._plan
        false = {case: limits.false_rates(case, self._limits) for case in self._cases}
        return report.Results(
            command=plan.command,
            surface=plan.ground,
            frames=plan.frames,
            seeds=tuple(range(plan.seeds)),
            runs=[self._runs[cell] for cell in self._in_order() if cell in self._runs],
            effects=self._effects,
            matrix=matrix.rows_of(self._places, self._matrix),
            limits={case: rates for case, rates in false.items() if rates},
            logs=[experiment.log_folder(c, plan.out) for c in plan.cells if is_logged(c) and c in self._runs],
            unfinished=list(self._unfinished()),
        )

    def _in_order(self) -> list[experiment.Cell]:
        return sorted(self._plan.cells, key=lambda cell: (cell.condition.name, cell.seed))

    def _unfinished(self) -> Iterator[str]:
        for name, left, wanted in (
            ("experiment", [c for c in self._plan.cells if c not in self._runs], self._plan.cells),
            ("matrix", self._matrix.missing_of(self._places), self._places),
            ("limits", self._limits.missing_of(self._cases), self._cases),
        ):
            if left:
                yield f"{name} ({len(left)} of {len(wanted)} parts are missing)"
        if not self._effects:
            yield "correction without images"

    def _told(self, what: str, steps: int) -> Callable[[int], None]:
        return lambda done: self._on_progress(what, done, steps)
