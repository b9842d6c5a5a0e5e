"""The command that flies paper C's flights: ``reproduce paper-c``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from workbench.terminal import INTERRUPTED, Bars, examples, print_json, table

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]


def paper_c(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results.")] = Path(
        "results/reproduce-paper-c"
    ),
    flight: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="A flight [all]: gravel, relief, 100m, …; repeatable.")
    ] = None,
    method: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="fast, accurate, baseline, klt [all]; repeatable.")
    ] = None,
    frames: Annotated[int | None, typer.Option(metavar="N", help="Frames of each flight [all of it].")] = None,
    as_json: AsJson = False,
) -> None:
    """Fly both modes of the semi-direct odometry, the PTAM-style baseline and OpenCV's KLT over simulated ground.

    The folder then holds report.md with tables and pictures (errors over the path as in Figs 4 and 5, outliers of the
    map as in Fig. 3, frames/s) and the same values as JSON and CSV. Ctrl-C leaves the finished flights; the same
    command goes on with the others.
    """
    import shlex

    from workbench.reproduce import paper_c as experiment
    from workbench.reproduce.flights import report
    from workbench.reproduce.flights.statements import statements

    words = ["workbench", "reproduce", "paper-c", "-o", str(out)]
    for name in flight or ():
        words += ["--flight", name]
    for name in method or ():
        words += ["--method", name]
    words += [] if frames is None else ["--frames", str(frames)]
    plan = experiment.Plan(
        out=out, flights=tuple(flight or ()), methods=tuple(method or ()), frames=frames, command=shlex.join(words)
    )
    with Bars() as bars:
        done = experiment.reproduce(plan, bars)
    if as_json:
        print_json({**report.values(done.results), "folder": str(done.folder), "interrupted": done.interrupted})
    else:
        for name, (heads, rows) in report.tables(done.results).items():
            print("\n".join((name, *table(heads, rows, right=range(2, len(heads))))), end="\n\n")
        for statement in statements(done.results):
            print(f"{statement.upshot}: {statement.claim}\n    {statement.numbers}")
        for text in done.results.unfinished:
            print(f"not finished: {text}; the same command goes on")
        print(f"\nreport  {done.file}")
    raise typer.Exit(INTERRUPTED if done.interrupted else 0)


def register(reproduce: typer.Typer) -> None:
    """Add the command to the workbench's."""
    reproduce.command(
        "paper-c",
        short_help="Semi-direct visual odometry of a small UAV (paper C, Table 1, Figs 3-5).",
        epilog=examples(
            "workbench reproduce paper-c",
            "workbench reproduce paper-c --flight gravel --flight relief --method fast --method baseline",
            "workbench reproduce paper-c --frames 300 -o results/short",
        ),
    )(paper_c)
