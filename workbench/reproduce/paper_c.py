"""`workbench reproduce paper-c`: both modes, the baseline and a peer on simulated flights; tables, pictures, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from workbench.reproduce.documents import made_folder
from workbench.reproduce.flights import report
from workbench.reproduce.flights.flying import FLIGHTS, Flight, Flown, flown
from workbench.reproduce.flights.methods import chosen
from workbench.reproduce.flights.results import Results
from workbench.reproduce.plans import OnProgress, Reproduced, at_least
from workbench.reproduce.tasks import carried_out
from workbench.settings import SettingsError

FEWEST_FRAMES = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is to be done: `flights` and `methods` by name, all where none is given; `frames` of each, None for all."""

    out: Path
    flights: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    frames: int | None = None
    command: str = "workbench reproduce paper-c"


def works(plan: Plan) -> list[Flight]:
    """The flights of a plan.

    Raises:
        SettingsError: there is no flight or method of a name, or too few frames.
    """
    if plan.frames is not None:
        at_least("frames", plan.frames, FEWEST_FRAMES)
    methods = chosen(plan.methods)
    names = _names(plan.flights)
    return [Flight(name, plan.frames, methods) for name in names]


def _names(wanted: Sequence[str]) -> tuple[str, ...]:
    full = [name if name.startswith("flight-") else f"flight-{name}" for name in wanted]
    for name in full:
        if name not in FLIGHTS:
            raise SettingsError(f"there is no flight {name!r}; there are: {', '.join(FLIGHTS)}")
    return tuple(name for name in FLIGHTS if not full or name in full)


def reproduce(plan: Plan, on_progress: OnProgress) -> Reproduced[Results]:
    """Fly what is missing of the plan in its folder, and write the report.

    Finished flights are found again, so that the same call goes on after an interrupt.

    Raises:
        WorkbenchError: the plan cannot be carried out; the text says why.
    """
    wanted = works(plan)
    made_folder(plan.out)
    found, interrupted = list[Flown](), False
    try:
        for flight in wanted:
            found.append(_done(flight, plan.out, on_progress))
    except KeyboardInterrupt:
        interrupted = True
    results = Results(
        command=plan.command,
        methods=wanted[0].methods,
        flights=found,
        unfinished=[flight.name for flight in wanted[len(found) :]],
    )
    return Reproduced(plan.out, report.write(results, plan.out), results, interrupted)


def _done(flight: Flight, folder: Path, on_progress: OnProgress) -> Flown:
    """The flight, from the folder or flown now."""
    identity = flight.identity
    kept = Flown.kept(folder, identity, flight.name)
    if kept is not None:
        return kept
    ticks = flight.ticks
    task = partial(flown, flight=flight)
    (made,) = carried_out([task], jobs=1, on_tick=lambda done: on_progress(flight.name, done, ticks))
    made.keep(folder, identity, flight.name)
    return made
