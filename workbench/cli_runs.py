"""The commands about finished runs: explain, consistency, compare, report, check, sweep, export.

`workbench.cli` takes them up; what is said there of output and exit statuses holds here, and one more: 4, an
expectation of ``check`` is not met.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from workbench.options import EstimatorName, PresetName, SettingsFile, StartTime, StopTime, Stride
from workbench.terminal import (
    IN_PART,
    INTERRUPTED,
    NOT_MET,
    Bars,
    examples,
    has_display,
    moment,
    print_error,
    print_json,
    print_list,
    shown,
    table,
)

if TYPE_CHECKING:
    from workbench.check import Checked
    from workbench.compare import Comparison, Parting
    from workbench.consistency import Consistency
    from workbench.diagnosis.finding import Finding
    from workbench.explain import Explanation, Quantity
    from workbench.judgement import Judgement
    from workbench.runs import Run

LINE = 110
EXPLAINED = 0.5
"""One error counts as the source of the loops' drift where it explains that share of it."""
MOST_ODD = 14
ERRORS = ("x_m", "y_m", "distance_m", "heading_rad")
COMPARED = (
    "frames", "share.*", "drift_percent", "end_error_m", "yaw_drift_deg", "path_length", "ape_m.rmse", "ape_m.max",
    "ape_heading_deg.rmse", "rpe.*.rmse", "ranging.error.*", "ranging.nis.mean", "ranging.conv*", "verdict.*",
    "alarm.*",
)  # fmt: skip
"""The metrics that are printed for people, in this order."""

RunPath = Annotated[
    Path, typer.Argument(metavar="RUN", help="RUN.rrd or RUN.toml, or a folder with one run", show_default=False)
]
RunPaths = Annotated[
    list[Path], typer.Argument(metavar="RUN...", help="RUN.rrd files, or folders of runs", show_default=False)
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    for command, short, lines in (
        (explain, "Why a frame is as it is: a screenful about it.", EXPLAIN),
        (consistency, "What a run says of its own drift, without a reference.", CONSISTENCY),
        (compare, "Runs side by side, and where they part.", COMPARE),
        (report, "Make a page that tells what a run concluded, what failed, and why.", REPORT),
        (check, "Hold runs against expectations, for CI.", CHECK),
        (sweep, "Replay over a grid of settings and recordings.", SWEEP),
        (export, "A run as Parquet, CSV, TUM, KITTI or one .rrd.", EXPORT),
    ):
        app.command(short_help=short, epilog=examples(*lines))(command)


# -------------------------------------------------------------------------------- explain


EXPLAIN = (
    "workbench explain results/mission --frame 812",
    "workbench explain results/mission --time 13.5",
    "workbench explain results/mission/best.rrd --worst 3",
    "workbench explain results/mission --frame 812 --open",
)


def explain(
    run: RunPath,
    frame: Annotated[int | None, typer.Option("--frame", metavar="N", help="Number of the frame.")] = None,
    at: Annotated[
        str | None, typer.Option("--time", metavar="T", help="Time: seconds after the first frame, ns, or ISO 8601.")
    ] = None,
    worst: Annotated[
        int | None, typer.Option("--worst", metavar="K", min=1, help="The K worst frames, the worst first.")
    ] = None,
    open_viewer: Annotated[bool, typer.Option("--open", help="Open the viewer at that frame.")] = False,
    as_json: AsJson = False,
) -> None:
    """Explain frames: verdict, every intermediate with its unit, what is unusual in this run, neighbours, findings.

    Without a choice it is the worst frame: the one that did the most harm where a reference or the command consistency
    tells it, else the one of the gravest verdict. How unusual a number is, is told in robust standard deviations (σ)
    from the run's median.
    """
    from workbench.explain import explain as explained
    from workbench.judgement import judged
    from workbench.runs import open_run

    opened = open_run(run)
    judgement = judged(opened)
    frames = _chosen_frames(opened, frame, at, worst, judgement.harm_m)
    told = [explained(opened, number, findings=judgement.findings, harm_m=judgement.harm_m) for number in frames]
    if as_json:
        about = {"run": str(opened.file), "harm_from": judgement.harm_from, "note": judgement.note}
        print_json({**about, "frames": [_explanation_values(one) for one in told]})
    elif not told:
        print(f"{shown(str(opened.file))}: no frame of this run is out of the ordinary")
    for number, one in enumerate(told if not as_json else ()):
        print("\n" + "=" * LINE if number else "", end="\n" if number else "")
        _print_explanation(opened, one, judgement)
    if open_viewer and told:
        _open_at(opened, told[0])


def _chosen_frames(run: Run, frame: int | None, at: str | None, worst: int | None, harm_m: Any) -> list[int]:
    """The frames that are asked for."""
    from readers.streams import WorkbenchError
    from workbench.explain import worst_frames

    if sum(choice is not None for choice in (frame, at, worst)) > 1:
        raise WorkbenchError("give one of --frame, --time and --worst")
    if frame is not None:
        run.row_of(frame)
        return [frame]
    if at is not None:
        from workbench.inputs import parse_time

        t_ns, first, last = parse_time(at, int(run.t_ns[0])), int(run.t_ns[0]), int(run.t_ns[-1])
        if not first <= t_ns <= last:
            raise WorkbenchError(f"--time {at}: the run lasts from 0 to {(last - first) / 1e9:.3f} s ({moment(first)})")
        return [run.frame_at(t_ns)]
    return worst_frames(run, worst or 1, harm_m)


def _print_explanation(run: Run, one: Explanation, judgement: Judgement) -> None:
    """A screenful."""
    from workbench.explain import NOT_JUDGED, brief, number, unit_of
    from workbench.judgement import WHOLES

    print(
        f"frame {one.frame} of {shown(str(run.file))} ({shown(one.estimator)}), {one.since_start_s:.3f} s after its "
        f"first frame, {moment(one.t_ns)}"
    )
    name, sentence = one.verdict
    print(f"{name}: {sentence}")
    for alarm, text in one.alarms[1:] if one.alarms else ():
        print(f"  also {alarm}: {text}")
    if one.error is not None:
        x, y, distance, heading = one.error
        print(f"error against the reference: {distance:.4g} m (x {x:+.4g}, y {y:+.4g}), {math.degrees(heading):+.4g}°")
    if math.isfinite(one.harm_m):
        print(f"harm: this frame adds {one.harm_m:+.4g} m to {WHOLES[judgement.harm_from]}")
    if judgement.note:
        print(f"harm: not told: {shown(judgement.note)}")
    for finding in one.findings:
        print(f"finding {finding.rule} ({_spans(finding.spans)}): {shown(finding.sentence)}")
        print(f"  cause: {shown(finding.cause)}\n  try: {shown(finding.remedy)}")
    odd = one.odd
    print(f"\nout of the usual range in this run ({len(odd)} of {len(one.quantities)} quantities):")
    rows = [_odd_row(q) for q in odd[:MOST_ODD]]
    print(
        "\n".join(
            f"  {line}" for line in table(("quantity", "here", "usual", "off", "so far off", "unit", "meaning"), rows)
        )
    )
    if len(odd) > MOST_ODD:
        print(f"  and {len(odd) - MOST_ODD} more: {', '.join(q.name for q in odd[MOST_ODD:])}")
    print("\nframes around:")
    heads = ("frame", "s", "verdict", *one.followed)
    around = [
        (f"{'>' if n.frame == one.frame else ' '}{n.frame}", f"{n.after_s:+.3f}", n.verdict, *map(number, n.values))
        for n in one.neighbours
    ]
    print("\n".join(f"  {line}" for line in table(heads, around, right=(0, 1, *range(3, len(heads))))))
    print("\nall quantities (of many: median, least…greatest):")
    told = (
        f"{q.field} {brief(q)} {unit_of(q.unit)}".rstrip()
        for q in sorted(one.quantities, key=_by_place(run))
        if q.field not in NOT_JUDGED
    )
    print("\n".join(f"  {line}" for line in wrapped(told, LINE - 2)))


def _by_place(run: Run) -> Any:
    order = {name: place for place, name in enumerate((*run.fields, *run.lists))}
    return lambda quantity: order[quantity.field]


def _odd_row(quantity: Quantity) -> tuple[str, ...]:
    from workbench.explain import number, score, unit_of

    value = quantity.change if quantity.drifts else quantity.value
    change = "changed by " if quantity.drifts else ""
    return (
        quantity.name,
        f"{change}{number(value)}",
        number(quantity.usual),
        score(quantity.z),
        "here only" if quantity.rarity == 0 else f"{100 * quantity.rarity:.2g} % of frames",
        unit_of(quantity.unit),
        quantity.meaning,
    )


def _spans(spans: Sequence[tuple[int, int]], most: int = 4) -> str:
    """Spans of frames in words."""
    told = [f"{first}" if first == last else f"{first}–{last}" for first, last in spans[:most]]
    more = f" and {len(spans) - most} more" if len(spans) > most else ""
    return f"frames {', '.join(told)}{more}"


def wrapped(items: Iterable[str], width: int) -> list[str]:
    """Items one after another, divided by semicolons, in lines of at most `width` where an item fits."""
    lines, line = [], ""
    for item in items:
        longer = f"{line}; {item}" if line else item
        if len(longer) > width and line:
            lines.append(line + ";")
            line = item
        else:
            line = longer
    return [*lines, line] if line else lines


def _explanation_values(one: Explanation) -> dict[str, Any]:
    """An explanation as plain values."""
    return {
        "frame": one.frame,
        "t_ns": one.t_ns,
        "since_start_s": one.since_start_s,
        "verdict": one.verdict[0],
        "alarms": [name for name, _ in one.alarms],
        "error": None if one.error is None else dict(zip(ERRORS, one.error, strict=True)),
        "harm_m": one.harm_m,
        "quantities": [
            {
                "field": q.field,
                "unit": q.unit,
                "meaning": q.meaning,
                "values": q.values.tolist(),
                "unusual": {"index": list(q.at), "value": q.change if q.drifts else q.value, "usual": q.usual,
                            "z": q.z, "rarity": q.rarity, "change": q.drifts},
            }
            for q in one.quantities
        ],
        "neighbours": [
            {"frame": n.frame, "after_s": n.after_s, "verdict": n.verdict,
             **dict(zip(one.followed, n.values, strict=True))}
            for n in one.neighbours
        ],
        "findings": [finding_values(finding) for finding in one.findings],
    }  # fmt: skip


def finding_line(finding: Finding) -> str:
    """A finding in a line."""
    harm = "" if math.isnan(finding.harm_m) else f" (harm {finding.harm_m:+.3g} m)"
    where = _spans(finding.spans)
    return f"{finding.severity.name.lower()}: {finding.rule}, {where}{harm}: {finding.sentence}"


def finding_values(finding: Finding) -> dict[str, Any]:
    """A finding as plain values."""
    return {**dataclasses.asdict(finding), "severity": finding.severity.name.lower()}


def _open_at(run: Run, one: Explanation) -> None:
    """Open the viewer with the run, its cursor at the frame."""
    from workbench.cli import files_of
    from workbench.rrd_viewer import show_at

    if not has_display():
        print("There is no display here: open the run on a machine with one, with workbench view.", file=sys.stderr)
        return
    raise typer.Exit(show_at(files_of([run.file]), one.frame))


# ---------------------------------------------------------------------------- consistency


CONSISTENCY = (
    "workbench consistency results/mission",
    "workbench consistency results/mission/best.rrd --worst 20",
    "workbench consistency results/mission --json | jq .loops[0]",
)


def consistency(
    run: RunPath,
    worst: Annotated[int, typer.Option("--worst", metavar="K", min=1, help="How many frames and loops to print.")] = 8,
    as_json: AsJson = False,
) -> None:
    """Hold a run against itself: replay it backward, and look again at the places that its path came back to.

    Needs no reference and no original log. Frames whose motion the backward replay does not undo are named, the one
    that moves the end the furthest first. What both replays have alike, such as a wrong scale, stays unseen. The answer
    is kept in RUN.consistency.json; explain and report take the harm of frames from it where there is no reference.
    """
    from workbench.consistency import consistency as held
    from workbench.consistency import values_of, write
    from workbench.judgement import judged
    from workbench.runs import open_run

    opened = open_run(run)
    with Bars() as bars:
        found = held(opened, bars)
    file = write(opened, found)
    if as_json:
        print_json({**values_of(found), "file": str(file)})
    else:
        _print_consistency(opened, found, judged(opened).findings, worst)
        print(f"\nwritten      {shown(str(file))}")


def _print_consistency(run: Run, found: Consistency, findings: Sequence[Finding], worst: int) -> None:
    from workbench.explain import number

    unit, share = found.unit, 100 * found.end_m / found.path_m if found.path_m > 0 else math.nan
    print(
        f"backward     the two replays end {number(found.end_m)} {unit} apart, {number(share)} % of the path, "
        f"turned by {number(math.degrees(found.end_rad))}°"
    )
    print(f"             the median frame moves the end by {number(found.usual_m)} {unit}; those that move it most:\n")
    heads = ("frame", f"by, {unit}", "of the median", "verdict", "finding")
    print("\n".join(table(heads, _frame_rows(run, found, findings, worst), right=(0, 1, 2))))
    print(f"\nloops        {_loops_line(found)}")
    if found.loops:
        rows = [
            (f"{one.first_frame} – {one.second_frame}", number(one.loop_m), number(one.drift_m),
             number(100 * one.drift_m / one.loop_m), number(math.degrees(one.drift_rad)))
            for one in found.loops[:worst]
        ]  # fmt: skip
        heads = ("frames", f"path, {unit}", f"drift, {unit}", "% of it", "turned, °")
        print("\n" + "\n".join(table(heads, rows, right=range(1, 5))))
    if found.suspects:
        print(f"\n             {_suspicion(found)}")


def _suspicion(found: Consistency) -> str:
    """Where the drift of the loops may come from."""
    spans, explained = found.suspicion()
    share = f"{max(0, round(100 * explained))} % of the loops' drift"
    if explained < EXPLAINED:
        return f"no single error explains it, the likeliest one {share}: it is spread along the path"
    return f"one error in {_spans(spans)} would explain {share}; nothing tells more closely where"


def _frame_rows(run: Run, found: Consistency, findings: Sequence[Finding], worst: int) -> Iterable[tuple[str, ...]]:
    from workbench.explain import number

    for row in found.ranked()[:worst].tolist():
        frame, size = int(found.frame[row]), float(found.size_m[row])
        times = f"{number(size / found.usual_m)} x" if found.usual_m > 0 else ""
        named = ", ".join(finding.rule for finding in findings if finding.covers(frame))
        yield str(frame), number(size), times, str(run.verdicts[run.row_of(frame)].name), named


def _loops_line(found: Consistency) -> str:
    if found.loops_why:
        return f"not looked for: {found.loops_why}"
    if not found.revisits:
        return "the path does not come back to any place"
    places = f"{found.revisits} place" + "s" * (found.revisits != 1)
    return f"{places} come back to; at {len(found.loops)} the images tell the motion between the visits"


# -------------------------------------------------------------------------------- compare


COMPARE = (
    "workbench compare results/mission",
    "workbench compare results/mission/best.rrd results/mission/wide.rrd",
    "workbench compare results/mission --rrd both.rrd --csv differences.csv",
)


def compare(
    runs: RunPaths,
    rrd: Annotated[
        Path | None, typer.Option("--rrd", metavar="FILE", help="Write one recording with all runs over one another.")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write the differences of every frame as a table.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare runs with the first one: metrics and settings side by side, and the frames where they part.

    Frame by frame they are compared where they are of one recording and one estimator.
    """
    from workbench.compare import compare as compared
    from workbench.compare import overlay, write_differences
    from workbench.runs import runs_in

    opened = runs_in(runs)
    found = compared(opened)
    if rrd is not None:
        overlay(opened, found.partings, rrd)
    if csv is not None:
        write_differences(found, csv)
    if as_json:
        print_json(_comparison_values(found))
    else:
        _print_comparison(found)
        for file in (rrd, csv):
            if file is not None:
                print(f"written      {shown(str(file))}")


def _print_comparison(found: Comparison) -> None:
    from workbench.explain import number

    if not found.one_mission:
        print("the runs are of different recordings: only their metrics are compared\n")
    told = {name: values for name, values in found.metrics.items() if any(map(math.isfinite, values))}
    shown_first = [name for pattern in COMPARED for name in told if fnmatch(name, pattern)]
    rows = [(name, *map(number, told[name])) for name in dict.fromkeys(shown_first)]
    print("\n".join(table(("metric", *found.runs), rows, right=range(1, len(found.runs) + 1))))
    if len(told) > len(rows):
        print(f"… and {len(told) - len(rows)} more; --json prints all")
    if found.settings:
        print()
        rows = [(name, *(_setting(value) for value in values)) for name, values in found.settings.items()]
        print("\n".join(table(("setting", *found.runs), rows)))
    for parting in found.partings:
        print_list(f"{parting.run} against {parting.other}", list(_parting_lines(parting)))


def _setting(value: Any) -> str:
    return "not set" if value is None else str(value)


def _parting_lines(parting: Parting) -> Iterable[str]:
    if parting.identical:
        yield f"identical in all {parting.frames} frames, bit for bit"
        return
    yield f"first number that differs: {parting.field} at frame {parting.first_different} ({parting.frames} in common)"
    if parting.first_verdict >= 0:
        yield f"first verdict that differs: frame {parting.first_verdict}; {parting.verdicts_differ} frames in all"
    else:
        yield "no verdict differs"
    for bound, frame in parting.apart.items():
        if frame >= 0:
            yield f"more than {bound:g} {parting.unit} apart from frame {frame} on"
    for name, value in parting.largest().items():
        yield f"{name}: {value:.4g}"


def _comparison_values(found: Comparison) -> dict[str, Any]:
    return {
        "runs": list(found.runs),
        "one_mission": found.one_mission,
        "metrics": {name: dict(zip(found.runs, values, strict=True)) for name, values in found.metrics.items()},
        "settings": {name: dict(zip(found.runs, values, strict=True)) for name, values in found.settings.items()},
        "partings": [
            {
                "run": p.run,
                "other": p.other,
                "frames": p.frames,
                "identical": p.identical,
                "first_different": p.first_different,
                "field": p.field,
                "first_verdict": p.first_verdict,
                "verdicts_differ": p.verdicts_differ,
                "apart": [{"bound": bound, "unit": p.unit, "frame": frame} for bound, frame in p.apart.items()],
                "largest": p.largest(),
            }
            for p in found.partings
        ],
    }


# --------------------------------------------------------------------------------- report


REPORT = (
    "workbench report results/mission -o report.html",
    "workbench report results/mission/best.rrd --md > report.md",
    "workbench report results/mission --md -o report.md --pictures pictures/",
    "workbench report results/mission --json | jq .findings[0]",
)


def report(
    run: RunPath,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="File to write [RUN.html beside the run].")
    ] = None,
    as_markdown: Annotated[bool, typer.Option("--md", help="Short Markdown instead, on stdout without -o.")] = False,
    picture_folder: Annotated[
        Path | None, typer.Option("--pictures", metavar="DIR", help="Of --md: the findings' pictures as SVG files.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make one page of a run: verdict, ranked findings with pictures, errors, metrics, settings, versions.

    The page holds everything that it shows, opens without a network, and prints. --md is for a pull request.
    """
    from workbench import report as reports
    from workbench.runs import open_run
    from workbench.settings import SettingsError

    if as_json and (as_markdown or out is not None):
        raise SettingsError("--json prints on stdout; leave --md and -o out")
    if picture_folder is not None and not as_markdown:
        raise SettingsError("--pictures goes with --md; the HTML page holds its pictures")
    opened = open_run(run)
    facts = reports.facts_of(opened, str(run))
    if as_json:
        print_json(reports.values(facts))
    elif as_markdown:
        text = reports.text_of(facts, picture_folder, None if out is None else out.parent)
        if out is None:
            print(text, end="")
        else:
            _tell_written(reports.write(text, out))
    else:
        _tell_written(reports.write(reports.page_of(facts), out or opened.path("html")))


def _tell_written(file: Path) -> None:
    print(f"written      {shown(str(file))} ({file.stat().st_size / 1e6:.2f} MB)")


# ---------------------------------------------------------------------------------- check


CHECK = (
    "workbench check results/mission --max drift_percent=1 --max verdict.PEAK_AMBIGUOUS=5",
    "workbench check results/mission --expect expectations.toml --junit check.xml",
    "workbench check results/mission --list",
)


def check(
    runs: RunPaths,
    most: Annotated[
        list[str] | None, typer.Option("--max", metavar="NAME=NUMBER", help="A metric's upper bound; repeatable.")
    ] = None,
    least: Annotated[
        list[str] | None, typer.Option("--min", metavar="NAME=NUMBER", help="A metric's lower bound; repeatable.")
    ] = None,
    expect: Annotated[
        Path | None, typer.Option("--expect", metavar="FILE", help="TOML with tables [max] and [min].")
    ] = None,
    junit: Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Write the results as JUnit.")] = None,
    list_metrics: Annotated[bool, typer.Option("--list", help="Print the names and values of all metrics.")] = False,
    as_json: AsJson = False,
) -> None:
    """Hold runs against bounds on their metrics. Exit status 0: all are kept; 4: one is not.

    A metric that a run cannot tell, such as its drift without a reference, does not keep any bound.
    """
    from workbench.check import CheckError, parsed, read_expectations, write_junit
    from workbench.check import check as checked
    from workbench.compare import labels
    from workbench.judgement import judged
    from workbench.metrics import metrics
    from workbench.runs import runs_in

    opened = runs_in(runs)
    expectations = read_expectations(expect) if expect is not None else []
    expectations += [parsed(text, "max") for text in most or ()] + [parsed(text, "min") for text in least or ()]
    if not expectations and not list_metrics:
        raise CheckError("nothing is expected: give --max, --min or --expect; --list prints the names of all metrics")
    asks_findings = list_metrics or any(e.metric.startswith("finding") for e in expectations)
    tables = [metrics(run.summary, judged(run).findings if asks_findings else None) for run in opened]
    names = labels(opened)
    if list_metrics:
        _print_metrics(names, tables, as_json=as_json)
        return
    results = {name: checked(found, expectations) for name, found in zip(names, tables, strict=True)}
    if junit is not None:
        write_junit(junit, results)
    if as_json:
        print_json({name: [_checked_values(one) for one in found] for name, found in results.items()})
    else:
        for name, found in results.items():
            print("\n".join(f"{'pass' if one.passed else 'FAIL'}  {shown(name)}  {one}" for one in found))
    if not all(one.passed for found in results.values() for one in found):
        raise typer.Exit(NOT_MET)


def _print_metrics(names: Sequence[str], tables: Sequence[Mapping[str, float]], *, as_json: bool) -> None:
    from workbench.explain import number

    if as_json:
        print_json(dict(zip(names, tables, strict=True)))
        return
    rows = [
        (metric, *(number(found.get(metric, math.nan)) for found in tables))
        for metric in dict.fromkeys(metric for found in tables for metric in found)
    ]
    print("\n".join(table(("metric", *names), rows, right=range(1, len(names) + 1))))


def _checked_values(one: Checked) -> dict[str, Any]:
    return {
        "metric": one.expectation.metric,
        one.expectation.side: one.expectation.bound,
        "value": one.value,
        "passed": one.passed,
    }


# ---------------------------------------------------------------------------------- sweep


SWEEP = (
    "workbench sweep mission.bag --grid search_radius_px=8,16,32 --grid preset=best,paper-a -o sweep",
    "workbench sweep a.mcap b.mcap -e range --grid sigma_speed=0.01,0.02 --grid mode=joint,independent",
    "workbench sweep sim:demo --grid 'recovery_rotations_rad=[0.0],[0.0,0.1,-0.1]' --keep",
)


def sweep(
    paths: Annotated[
        list[Path], typer.Argument(metavar="PATH...", help="recordings, as replay takes them", show_default=False)
    ],
    grid: Annotated[
        list[str] | None,
        typer.Option("--grid", metavar="KEY=A,B,C", help="A setting (or preset) and its values; repeatable."),
    ] = None,
    estimator: EstimatorName = "correlation",
    preset: PresetName = None,
    settings: SettingsFile = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting of all replays; repeatable.")
    ] = None,
    start: StartTime = None,
    stop: StopTime = None,
    stride: Stride = 1,
    image: Annotated[str | None, typer.Option(metavar="TOPIC", help="Image stream.")] = None,
    reference: Annotated[str | None, typer.Option(metavar="TOPIC", help="Stream to compare with, or none.")] = None,
    height: Annotated[str | None, typer.Option(metavar="TOPIC", help="Stream of the camera's height.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results.")] = Path("sweep"),
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Replays at a time [the number of cores].")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep every run's recording, not only its row.")] = False,
    as_json: AsJson = False,
) -> None:
    """Replay recordings over a grid of settings; write a table, and a picture of accuracy against cost.

    The folder then holds sweep.csv, sweep.parquet, sweep.png and sweep.svg. What was done before is not done again: the
    same command goes on with an interrupted sweep, a larger grid adds to it.
    """
    from workbench.session import Request
    from workbench.sweep import SweepError, parse_axis, plan
    from workbench.sweep import sweep as swept

    axes = [parse_axis(text) for text in grid or ()]
    if not axes:
        raise SweepError("there is no grid: give --grid KEY=A,B,C, for example --grid search_radius_px=8,16")
    requests = [
        Request(
            path=path, estimator=estimator, preset=preset, settings_file=settings, overrides=tuple(overrides or ()),
            start=start, stop=stop, stride=stride, image=image, reference=reference, height=height,
        )
        for path in paths
    ]  # fmt: skip
    planned = plan(requests, axes, out, keep=keep)
    with Bars() as bars:
        done = swept(planned, out, workers=jobs, on_done=lambda _, k, n: bars("sweep", k, n))
    _print_sweep(done, as_json=as_json)
    if done.interrupted:
        raise typer.Exit(INTERRUPTED)
    if done.failed:
        raise typer.Exit(IN_PART)


def _print_sweep(done: Any, *, as_json: bool) -> None:
    from workbench.explain import number
    from workbench.sweep import COST, accuracy_of, table_of

    if as_json:
        print_json({"rows": list(done.rows), "planned": done.planned, "files": [str(file) for file in done.files]})
        return
    if done.rows:
        found = table_of(done.rows)
        accuracy = accuracy_of(found)
        shown_columns = [name for name in (accuracy, "ape_m.rmse", "share.OK", COST) if name and name in found]
        ranked = found.sort_values(accuracy, na_position="last") if accuracy else found
        rows = [
            (str(row["recording"]), str(row["name"]), *(number(float(row[name])) for name in shown_columns))
            for _, row in ranked[ranked["error"] == ""].iterrows()
        ]
        heads = ("recording", "settings", *shown_columns)
        print("\n".join(table(heads, rows, right=range(2, len(heads)))))
    for row in done.failed:
        print_error(f"{row['recording']}, {row['name']}: {row['error']}")
    print(f"\n{len(done.rows)} of {done.planned} replays are done, {done.before} of them before")
    for file in done.files:
        print(f"written      {shown(str(file))}")


# --------------------------------------------------------------------------------- export


EXPORT = (
    "workbench export results/mission -o exported",
    "workbench export results/mission/best.rrd --format csv --format kitti -o exported",
)


def export(
    run: RunPath,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder of the files [export beside the run].")
    ] = None,
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", "-f", metavar="NAME", help="parquet, csv, tum, kitti or rrd; repeatable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a run in other tools' formats: a table of every number, the trajectory, one portable recording."""
    from workbench.export import export as exported
    from workbench.runs import open_run

    opened = open_run(run)
    files = exported(opened, out or opened.folder / "export", formats)
    if as_json:
        print_json({"files": [str(file) for file in files]})
    for file in files if not as_json else ():
        print(f"written      {shown(str(file))}")
