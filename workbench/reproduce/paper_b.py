"""`workbench reproduce paper-b`: the paper's simulation and a replica of its robot's run, tables, pictures, report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from workbench import scenarios
from workbench.reproduce.documents import made_folder
from workbench.reproduce.plans import OnProgress, Reproduced, at_least
from workbench.reproduce.ranging import replica, report, robot
from workbench.reproduce.ranging import simulation as sim
from workbench.reproduce.ranging.parts import Part
from workbench.reproduce.ranging.results import Results
from workbench.reproduce.tasks import Task, carried_out
from workbench.session import versions

RUNS, SEEDS = 4000, 40
FEWEST_RUNS, FEWEST_SEEDS = 10, 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is to be done: `runs` of each Monte Carlo, `seeds` runs of the robot."""

    out: Path
    runs: int = RUNS
    seeds: int = SEEDS
    command: str = "workbench reproduce paper-b"


@dataclass(frozen=True, slots=True)
class Work:
    """One part: what it is called, what makes it, how many ticks that takes, what it depends on, its files."""

    name: str
    kind: type[Part]
    make: Task[Part]
    ticks: int
    depends: dict[str, Any]
    files: tuple[Path, ...] = ()


def works(plan: Plan) -> list[Work]:
    """The parts of a plan."""
    made = [
        Work(name, kind, partial(make, plan.runs), ticks, {"runs": plan.runs})
        for name, kind, make, ticks in (
            ("accuracy", sim.Accuracy, sim.accuracy, 2 * len(sim.TABLE_2_PIXELS)),
            ("convergence", sim.Convergence, sim.convergence, 16 * len(sim.CURVE_PIXELS)),
            ("scaling", sim.Scaling, sim.scaling, 2 + 2 * len(sim.SCALE_SPEEDS_MPS)),
            ("consistency", sim.Consistency, sim.consistency, len(sim.CONSISTENCY_PIXELS)),
            ("better", sim.Better, sim.better, 2 * len(sim.CONSISTENCY_PIXELS) + 3),
            ("misprints", sim.Misprints, sim.misprints, 9),
            ("asynchronous", sim.Asynchronous, sim.asynchronous, 3 * len(sim.CONSISTENCY_PIXELS)),
        )
    ]
    scenario = scenarios.load(replica.SCENARIO).scenario.model_dump(mode="json")
    depends = {"runs": plan.runs, "seeds": plan.seeds, "scenario": scenario, "ways": robot.WAYS}
    make = partial(robot.robot, plan.seeds, plan.runs, plan.out)
    made.append(Work("robot", robot.Robot, make, robot.ticks(plan.seeds), depends, robot.log_files(plan.out)))
    return made


def reproduce(plan: Plan, on_progress: OnProgress) -> Reproduced[Results]:
    """Do what is missing of the plan in its folder, and write the report.

    Finished parts are found again, so that the same call goes on after an interrupt.

    Raises:
        WorkbenchError: the plan cannot be carried out; the text says why.
    """
    at_least("runs", plan.runs, FEWEST_RUNS)
    at_least("seeds", plan.seeds, FEWEST_SEEDS)
    made_folder(plan.out)
    wanted, found, interrupted = works(plan), dict[str, Part](), False
    try:
        for work in wanted:
            found[work.name] = _done(work, plan.out, on_progress)
    except KeyboardInterrupt:
        interrupted = True
    results = Results(
        command=plan.command,
        log=robot.log_folder(plan.out),
        runs=plan.runs,
        seeds=plan.seeds,
        unfinished=[work.name for work in wanted if work.name not in found],
        **found,  # type: ignore[arg-type]
    )
    return Reproduced(plan.out, report.write(results, plan.out), results, interrupted)


def _done(work: Work, folder: Path, on_progress: OnProgress) -> Part:
    """The part, from the folder or made now."""
    identity = json.dumps({"versions": versions(), **work.depends}, sort_keys=True, default=str)
    kept = work.kind.kept(folder, identity)
    if kept is not None and all(file.is_file() for file in work.files):
        return kept
    (part,) = carried_out([work.make], jobs=1, on_tick=lambda done: on_progress(work.name, done, work.ticks))
    part.keep(folder, identity)
    return part
