"""The commands about recordings: inspect, replay, simulate, view, demo, reproduce, settings.

Those about finished runs are in `cli_runs.py`, those about patrols in `cli_patrol.py`, paper C's flights in
`cli_flights.py`. Only these modules and `terminal.py` print.

What a command concludes goes to stdout, progress and errors to stderr. Exit status: 0 done; 2 a request that
cannot be met (one line says why); 3 the recording could be read only in part; 130 interrupted; 1 a fault of the
workbench itself. Everything heavy is imported inside the commands, so that help comes at once.
"""

from __future__ import annotations

import subprocess
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from workbench import cli_flights, cli_patrol, cli_runs
from workbench.options import EstimatorName, PresetName, SettingsFile, StartTime, StopTime, Stride
from workbench.terminal import (
    FAULT,
    IN_PART,
    INTERRUPTED,
    REFUSED,
    Bar,
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
    from pipelines.simulation.mission import SimulatedMission
    from readers.extras import Extras, LostExtra
    from readers.streams import Camera, CameraFile, Clock, ReadOptions, Recording, StreamInfo
    from workbench.diagnosis.finding import Finding
    from workbench.reproduce import report as reports_a
    from workbench.reproduce.judged import Statement
    from workbench.reproduce.plans import Reproduced
    from workbench.reproduce.ranging.results import Results as RangeResults
    from workbench.session import Outcome, Request
    from workbench.sync import Pair


MOST_FINDINGS = 5
LONGEST_OFFSET_MS = 4e12  # beyond it times of today do not fit into 64 bits

app = typer.Typer(
    name="workbench",
    help="Replay a mission's log through odometry and see, frame by frame, what the estimator concluded and why.\n\n"
    "\b\nFirst steps:\n"
    "  workbench demo                     replay the built-in recording\n"
    "  workbench inspect mission.bag      what is in a log, and what is odd about it\n"
    "  workbench replay mission.bag       replay it; the result lies in results/mission/\n"
    "  workbench simulate --list          missions with exact truth and known faults\n"
    "  workbench view results/mission     look at the result\n\n"
    "Every command explains itself with --help. A fault is one line on stderr; --debug adds where it arose.",
    no_args_is_help=False,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"max_content_width": 100},
)


RecordingPath = Annotated[
    Path,
    typer.Argument(
        metavar="PATH",
        help="ROS 1 bag, ROS 2 bag, MCAP, image folder or video; sim:NAME or a scenario's TOML file",
        show_default=False,
    ),
]
Rate = Annotated[float | None, typer.Option("--rate", metavar="HZ", help="Frame rate of images without times.")]
TimesFile = Annotated[Path | None, typer.Option("--times", metavar="FILE", help="File with the times of the frames.")]
TimesUnit = Annotated[str, typer.Option("--times-unit", metavar="UNIT", help="Unit in it: s, ms, us, ns or auto.")]
TimeFrames = Annotated[
    list[str] | None,
    typer.Option("--tf", metavar="PARENT,CHILD", help="Pair of frames in /tf to read as a pose stream; repeatable."),
]
Clocks = Annotated[
    list[str] | None,
    typer.Option("--clock", metavar="TOPIC=CLOCK", help="Times of a topic: header, log or publish; repeatable."),
]
Offsets = Annotated[
    list[str] | None,
    typer.Option("--offset", metavar="TOPIC=MS", help="Milliseconds to add to the times of a topic; repeatable."),
]
Cameras = Annotated[
    list[str] | None,
    typer.Option(
        "--camera",
        metavar="[TOPIC=]FILE[#NAME]",
        help="Calibration in place of the recording's: YAML of ROS, Kalibr or OpenCV; repeatable.",
    ),
]
ScaleCamera = Annotated[
    bool, typer.Option("--scale-camera", help="Scale a calibration for another image size to the images.")
]
MsgFolder = Annotated[
    Path | None,
    typer.Option("--msg", metavar="DIR", help="Folder of .msg files for types that the log does not define."),
]
Distribution = Annotated[
    str, typer.Option("--distro", metavar="NAME", help="ROS 2 distribution of types that the log does not define.")
]
NoCache = Annotated[
    bool, typer.Option("--no-cache", help="Walk over a log without an index anew; see docs/readers.md.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]


@app.callback()
def _common(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show where an error arose; works after a command, too.")
    ] = False,
) -> None:
    """Options before the command; `main` has taken ``--debug`` out by now."""


# -------------------------------------------------------------------------------- inspect


@app.command(
    short_help="What is in a recording, and what is odd about it.",
    epilog=examples(
        "workbench inspect mission.bag",
        "workbench inspect frames/ --rate 30",
        "workbench inspect mission.mcap --json | jq '.streams[].name'",
    ),
)
def inspect(
    path: RecordingPath,
    as_json: AsJson = False,
    quick: Annotated[bool, typer.Option("--quick", help="Do not read the messages to count oddities.")] = False,
    rate: Rate = None,
    times: TimesFile = None,
    times_unit: TimesUnit = "auto",
    tf: TimeFrames = None,
    clocks: Clocks = None,
    offsets: Offsets = None,
    cameras: Cameras = None,
    scale_camera: ScaleCamera = False,
    msg: MsgFolder = None,
    distro: Distribution = "",
    no_cache: NoCache = False,
) -> None:
    """Show what is in a recording: streams, cameras, damage, and what is odd about its clocks.

    Exit status: 0 nothing is damaged, 3 something was lost, 2 nothing can be read.
    """
    from workbench.opening import open_any

    options = _options(
        rate,
        times,
        times_unit,
        tf,
        clocks,
        offsets,
        cameras,
        scale_camera,
        msg=msg,
        distribution=distro,
        cache=not no_cache,
    )
    with open_any(path, options) as recording:
        _warn(recording.cache_troubles)
        facts, clocks_found = ([], {}) if quick else _survey(recording)
        beside = {} if quick else _extras_values(recording.extras())
        values = _recording_values(recording, facts) | {"clocks": clocks_found} | beside | _lost(recording, quick)
        if as_json:
            print_json(values)
        else:
            _print_recording(recording, values)
        if values["damage"]:
            raise typer.Exit(IN_PART if quick or _is_usable(values) else REFUSED)


def _is_usable(values: Mapping[str, Any]) -> bool:
    """Whether anything of a damaged recording could be read, or named at least."""
    loss = values["loss"]
    beside = any(values[name] for name in ("attachments", "metadata", "lost_beside_messages"))
    return not loss or beside or any(topic["recovered"] for topic in loss["topics"])


def _lost(recording: Recording, quick: bool) -> dict[str, Any]:
    """The report of loss, where there is one; unless `quick`, all messages are read for what was recovered."""
    from workbench import loss_report

    if not recording.losses:
        return {"loss": None}
    good = {} if quick else loss_report.read_through(recording)
    return {"loss": loss_report.values(good, recording.losses)}


def _extras_values(extras: Extras) -> dict[str, Any]:
    """What lies in a log beside its messages."""
    attachments = [
        {"name": one.name, "media_type": one.media_type, "bytes": len(one.data), "log_ns": one.log_ns}
        for one in extras.attachments
    ]
    metadata = [{"name": one.name, "values": one.values} for one in extras.metadata]
    return {"attachments": attachments, "metadata": metadata, "lost_beside_messages": _lost_extras(extras.lost)}


def _lost_extras(lost: Sequence[LostExtra]) -> list[dict[str, str]]:
    return [{"kind": str(one.kind), "name": one.name, "reason": one.reason} for one in lost]


def _survey(recording: Recording) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The oddities of a recording; and by stream how log time stands to header stamps and publish times, ms."""
    from readers.clock import Lag, examine

    def milliseconds(lag: Lag) -> dict[str, Any] | None:
        if not lag.messages:
            return None
        told = {"least_ms": lag.least_ns, "median_ms": lag.median_ns, "greatest_ms": lag.greatest_ns}
        return {"messages": lag.messages} | {name: ns / 1e6 for name, ns in told.items()}

    found = examine(recording)
    facts = [
        {"stream": fact.stream, "code": fact.code, "count": fact.count, "sentence": fact.sentence}
        for fact in found.facts
    ]
    lags = {
        name: {"log_after_header": milliseconds(audit.lag), "log_after_publish": milliseconds(audit.publish_lag)}
        for name, audit in found.audits.items()
    }
    return facts, {name: values for name, values in lags.items() if any(values.values())}


def _recording_values(recording: Recording, facts: list[dict[str, Any]]) -> dict[str, Any]:
    """A recording as plain values."""
    return {
        "path": str(recording.path),
        "format": recording.format,
        "streams": [_stream_values(info) for info in recording.streams],
        "cameras": {name: _camera_values(camera) for name, camera in recording.cameras.items()},
        "notes": list(recording.notes),
        "damage": [str(damage) for damage in recording.damage],
        "facts": facts,
    }


def _stream_values(info: StreamInfo) -> dict[str, Any]:
    return {
        "name": info.name,
        "kind": str(info.kind),
        "type": info.type,
        "encoding": info.encoding,
        "count": None if info.count < 0 else info.count,
        "first_ns": None if info.first_ns < 0 else info.first_ns,
        "last_ns": None if info.last_ns < 0 else info.last_ns,
        "rate_hz": info.rate_hz,
        "frame": info.frame,
        "readable": info.readable,
        "reason": info.reason,
        "definition": info.definition,
    }


def _camera_values(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "matrix": camera.matrix.tolist(),
        "distortion_model": camera.distortion_model,
        "distortion": camera.distortion.tolist(),
        "frame": camera.frame,
        "source": camera.source,
        "calibrated": camera.calibrated,
    }


def _print_recording(recording: Recording, values: Mapping[str, Any]) -> None:
    """Print a recording for people."""
    print(f"{shown(values['path'])}: {shown(values['format'])}")
    times = [info.first_ns for info in recording.streams if info.first_ns >= 0]
    origin_ns = min(times, default=0)
    if times:
        last_ns = max(info.last_ns for info in recording.streams)
        print(f"from {moment(origin_ns)} for {(last_ns - origin_ns) / 1e9:.3f} s (log time)")
    print()
    heads = ("stream", "kind", "messages", "Hz", "from s", "to s", "frame", "type")
    rows = [_stream_row(info, origin_ns) for info in recording.streams]
    print("\n".join(table(heads, rows, right=(2, 3, 4, 5))) if rows else "no streams")
    for name, camera in recording.cameras.items():
        print(f"\ncamera of {shown(name)}: {_camera_text(camera)}")
    _print_clocks(values["clocks"])
    print_list("notes", values["notes"])
    print_list("not readable", [_unreadable(info) for info in recording.streams if not info.readable])
    beside = [f"{one['name']}, {one['media_type']}, {one['bytes']} bytes" for one in values.get("attachments", ())]
    print_list("attachments", beside)
    print_list("metadata", [f"{one['name']}: {len(one['values'])} values" for one in values.get("metadata", ())])
    print_list("damage", values["damage"])
    if values["loss"]:
        _print_losses(values["loss"])
    print_list("oddities", [f"{fact['stream']}: {fact['sentence']}" for fact in values["facts"]])


def _print_clocks(clocks: Mapping[str, Any]) -> None:
    """Print how late log time is after header stamps and publish times."""
    rows = [
        (name, kind, str(lag["messages"]), *(f"{lag[k]:.3f}" for k in ("least_ms", "median_ms", "greatest_ms")))
        for name, lags in clocks.items()
        for kind, lag in (("header", lags["log_after_header"]), ("publish", lags["log_after_publish"]))
        if lag is not None
    ]
    if rows:
        heads = ("log time after", "clock", "messages", "least ms", "median ms", "greatest ms")
        print("\n" + "\n".join(table(heads, rows, right=(2, 3, 4, 5))))


def _unreadable(info: StreamInfo) -> str:
    """Why a stream cannot be read, and the fields of its messages in a line (`--json` has the whole definition)."""
    lines = [line.partition("#")[0].strip() for line in info.definition.partition("\n====")[0].splitlines()]
    fields = "; ".join(" ".join(line.split()) for line in lines if line)
    return f"{info.name}: {info.reason}" + (f", its definition: {fields}" if fields else "")


def _stream_row(info: StreamInfo, origin_ns: int) -> tuple[str, ...]:
    empty = info.first_ns < 0
    return (
        info.name,
        str(info.kind),
        "?" if info.count < 0 else str(info.count),
        "" if info.rate_hz != info.rate_hz else f"{info.rate_hz:.4g}",
        "" if empty else f"{(info.first_ns - origin_ns) / 1e9:.3f}",
        "" if empty else f"{(info.last_ns - origin_ns) / 1e9:.3f}",
        info.frame,
        info.type + ("" if not info.encoding else f" ({info.encoding})"),
    )


def _camera_text(camera: Camera) -> str:
    size = f"{camera.width_px} x {camera.height_px} px"
    if not camera.calibrated:
        return f"{size}, not calibrated"
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    source = f", of {shown(camera.source)}" if camera.source else ""
    lens = shown(camera.distortion_model)
    return f"{size}, f {fx:.6g} {fy:.6g}, centre {cx:.6g} {cy:.6g}, distortion {lens}{source}"


# -------------------------------------------------------------------------------- recover


@app.command(
    short_help="Write what can be read of a damaged log as a clean MCAP file.",
    epilog=examples(
        "workbench recover mission.bag -o mission.mcap",
        "workbench recover rosbag2_folder/ -o mission.mcap --json",
    ),
)
def recover(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="ROS 1 bag, ROS 2 bag or MCAP, or a folder of its parts.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT.mcap", help="File to write; it must not exist.")],
    msg: MsgFolder = None,
    distro: Distribution = "",
    no_cache: NoCache = False,
    as_json: AsJson = False,
) -> None:
    """Write the readable messages of a log, as they are stored, into an MCAP file with an index; tell what was lost.

    Definitions, encodings and times are kept: messages of ROS 1 stay messages of ROS 1. Ctrl-C ends the file early and
    leaves it readable. Exit status: 0 nothing was damaged, 3 something was lost, 2 nothing can be read.
    """
    from workbench import loss_report
    from workbench.opening import open_any
    from workbench.progress import Progress
    from workbench.recovery import recover as write

    options = _options(None, None, "auto", None, msg=msg, distribution=distro, cache=not no_cache)
    with open_any(path, options) as recording, Bar(out.name, "message") as bar:
        _warn(recording.cache_troubles)
        try:
            done = write(recording, out, on_progress=lambda done, total: bar(Progress(done, total, 0)))
        except KeyboardInterrupt:
            print(f"interrupted: {out} holds what was written so far", file=sys.stderr)
            raise
    report = loss_report.values(done.good, done.losses)
    skipped = [{"topic": topic, "count": n, "reason": why} for (topic, why), n in done.skipped.items()]
    if as_json:
        counts = {"attachments": done.attachments, "metadata": done.metadata}
        beside = counts | {"lost_beside_messages": _lost_extras(done.lost)}
        print_json({"path": str(out), **report, **beside, "damage": list(done.damage), "not_written": skipped})
    else:
        counts = {"attachments": done.attachments, "records of metadata": done.metadata}
        more = "".join(f", {count} {what}" for what, count in counts.items() if count)
        print(f"{out}: {sum(good.count for good in done.good.values())} messages{more} of {shown(str(path))}")
        _print_losses(report)
        not_written = [f"{one['topic']}: {one['count']} messages: {one['reason']}" for one in skipped]
        print_list("not written", [*not_written, *(f"{one.kind} {one.name}: {one.reason}" for one in done.lost)])
        print_list("damage", done.damage)
    if not done.clean:
        raise typer.Exit(IN_PART)


def _print_losses(report: Mapping[str, Any]) -> None:
    """Print by topic what was read and what is known to be lost."""
    from workbench import loss_report

    if found := loss_report.rows(report):
        print("\n" + "\n".join(table(loss_report.HEADS, found, right=range(1, 7))))


# --------------------------------------------------------------------------------- replay


@app.command(
    short_help="Replay a recording; write all that was computed.",
    epilog=examples(
        "workbench replay mission.bag",
        "workbench replay mission.bag --preset paper-a --from 10 --to 20",
        "workbench replay mission.bag --set search_radius_px=16 --name wide",
        "workbench replay mission.bag --set metres_per_px=0.00078",
        "workbench replay mission.bag --height /lidar/range --reference /mocap/pose",
        "workbench replay frames/ --rate 60 --times times.txt --json",
        "workbench replay mission.bag -e range --odometry /wheel/odometry --imu /imu",
        "workbench replay sim:paper-b -e range --set landmarks=corners",
    ),
)
def replay(
    path: RecordingPath,
    estimator: EstimatorName = "correlation",
    preset: PresetName = None,
    settings: SettingsFile = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting over all; repeatable.")
    ] = None,
    start: StartTime = None,
    stop: StopTime = None,
    stride: Stride = 1,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results [results/NAME].")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the run [the preset's].")] = None,
    image: Annotated[str | None, typer.Option(metavar="TOPIC", help="Image stream [the only one].")] = None,
    tracks: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Range: pixel tracks or measured landmarks [the only ones].")
    ] = None,
    odometry: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC", help="Range: odometry with the speed [the only one]; visual odometry: its scale."
        ),
    ] = None,
    imu: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Range: IMU with the rate of turn, or none [the only one].")
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="Pose, GNSS or odometry stream to compare with, or none [the only one]."),
    ] = None,
    reference_offset: Annotated[
        float, typer.Option(metavar="S", help="Seconds to add to the frames' times to find the reference.")
    ] = 0.0,
    height: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Range, number or pose (z) stream of the camera's height.")
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate",
            help="Tell the scale and mounting yaw that fit; with -e range: gyro bias, focus, delay.",
        ),
    ] = False,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="With -e range: the best ranges after the mission, from all of it.")
    ] = False,
    raw_images: Annotated[str, typer.Option(metavar="FORM", help="Keep raw images as png or raw.")] = "png",
    rate: Rate = None,
    times: TimesFile = None,
    times_unit: TimesUnit = "auto",
    tf: TimeFrames = None,
    clocks: Clocks = None,
    offsets: Offsets = None,
    cameras: Cameras = None,
    scale_camera: ScaleCamera = False,
    msg: MsgFolder = None,
    distro: Distribution = "",
    no_cache: NoCache = False,
    as_json: AsJson = False,
) -> None:
    """Replay a recording through an estimator; write all it computed, and a summary.

    The folder of the results then holds sensors.rrd, RUN.rrd, RUN.toml (settings, versions, summary) and, of an
    estimator of the vehicle's path, RUN.tum (trajectory). With -e range the frames are pixel tracks, measured landmarks
    or images, and the summary tells the ranges' errors where there is a reference. Ctrl-C ends the replay early and
    loses nothing.
    """
    from workbench.session import Request

    request = Request(
        path=path,
        estimator=estimator,
        preset=preset,
        settings_file=settings,
        overrides=tuple(overrides or ()),
        start=start,
        stop=stop,
        stride=stride,
        out=out,
        name=name,
        image=image,
        tracks=tracks,
        odometry=odometry,
        imu=imu,
        reference=reference,
        reference_offset_s=reference_offset,
        height=height,
        options=_options(
            rate,
            times,
            times_unit,
            tf,
            clocks,
            offsets,
            cameras,
            scale_camera,
            msg=msg,
            distribution=distro,
            cache=not no_cache,
        ),
        calibrate=calibrate,
        smooth=smooth,
        raw_images=_one_of(raw_images, ("png", "raw"), "--raw-images"),
    )
    _conclude(_replay(request), as_json)


def _conclude(outcome: Outcome, as_json: bool) -> NoReturn:
    """Print what became of a replay and leave with its exit status."""
    findings, refused = _findings_of(outcome)
    if as_json:
        print_json(
            outcome.summary | _told(findings, refused) | {"folder": str(outcome.folder), "files": _files(outcome)}
        )
    else:
        _print_summary(outcome, findings, refused)
    raise typer.Exit(_status(outcome))


def _told(findings: Sequence[Finding], refused: str) -> dict[str, Any]:
    """Findings, or why there are none, for JSON."""
    return {"findings": [cli_runs.finding_values(finding) for finding in findings], "not_judged": refused}


def _findings_of(outcome: Outcome) -> tuple[Sequence[Finding], str]:
    """What the diagnosis of a finished replay found; or why there is none."""
    from readers.streams import WorkbenchError
    from workbench.judgement import judged
    from workbench.runs import open_run

    try:
        return judged(open_run(outcome.run_file)).findings, ""
    except WorkbenchError as error:
        return (), str(error)


def _replay(request: Request, recording: Recording | None = None) -> Outcome:
    from workbench.session import run

    with Bar(request.name or request.preset or request.estimator) as bar:
        return run(request, recording=recording, on_progress=bar, on_warnings=_warn)


def _warn(texts: Sequence[str]) -> None:
    """Tell what is odd about the clocks, or the cache of indexes, before the work begins."""
    for text in texts:
        print(f"warning: {shown(text)}", file=sys.stderr, flush=True)


def _status(outcome: Outcome) -> int:
    """The exit status that an outcome deserves."""
    summary = outcome.summary
    if summary["interrupted"]:
        return INTERRUPTED
    if summary["stopped_early"]:
        print_error(summary["stopped_early"])
        return IN_PART
    calibration = summary["calibration"]
    if calibration is not None and not calibration["key"]:
        print_error(f"--calibrate: {calibration['sentence']}")
        return REFUSED
    return IN_PART if summary["damage"] else 0


def _files(outcome: Outcome) -> list[str]:
    run = outcome.run_file
    trajectory = run.with_suffix(".tum")
    files = [outcome.sensors_file, run, run.with_suffix(".toml"), *([trajectory] if trajectory.exists() else [])]
    return [str(file) for file in files]


def _print_summary(outcome: Outcome, findings: Sequence[Finding] = (), refused: str = "") -> None:
    from workbench.summary import lines

    rows = [*lines(outcome.summary), *(("finding", cli_runs.finding_line(one)) for one in findings[:MOST_FINDINGS])]
    if len(findings) > MOST_FINDINGS:
        rows.append(("finding", f"{len(findings) - MOST_FINDINGS} more; workbench report shows all"))
    if refused:
        rows.append(("finding", f"none, the run cannot be judged: {refused}"))
    width = max(len(name) for name, _ in rows)
    before = ""
    for name, text in rows:
        print(f"{'' if name == before else name:<{width}}  {shown(text, None)}")
        before = name
    print(f"{'result':<{width}}  {outcome.run_file}")
    print(f"{'look at it':<{width}}  workbench view {outcome.run_file}")
    if findings:
        frame = findings[0].worst_frame
        print(f"{'ask why':<{width}}  workbench explain {outcome.run_file} --frame {frame}")


# ------------------------------------------------------------------------------- simulate


@app.command(
    short_help="Make a mission with exact truth and known faults, by scenario.",
    epilog=examples(
        "workbench simulate --list",
        "workbench simulate fault-motion-blur -o blur.mcap",
        "workbench simulate fault-motion-blur --set faults.0.exposure=0.5 --replay",
        "workbench simulate paper-a --set camera.noise_grey=5 --seed 3 -o mission.bag",
        "workbench simulate paper-a --as paper-a -o folder/",
        "workbench simulate sensors --stream /camera/image_raw --stream /reference/pose --as paper-a -o folder/",
        "workbench simulate line --picture floor.png --replay --preset paper-a",
        "workbench simulate sensors --show > mine.toml",
        "workbench simulate mine.toml -o mine.mcap",
    ),
)
def simulate(
    scenario: Annotated[
        str | None, typer.Argument(metavar="SCENARIO", help="Name of a scenario, or a TOML file.", show_default=False)
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One value of the scenario, dots inside; repeatable."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of everything random [the scenario's].")] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Picture that the ground is made of.")] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="PATH", help="File or folder to write; of --replay, of its results."),
    ] = None,
    container: Annotated[
        str | None,
        typer.Option("--as", metavar="CONTAINER", help="mcap, mcap-json, ros1, ros2, paper-a, euroc [by .mcap, .bag]."),
    ] = None,
    images: Annotated[
        str | None, typer.Option(metavar="FORM", help="Images as jpeg, png or stored [jpeg; png in folders].")
    ] = None,
    streams: Annotated[
        list[str] | None, typer.Option("--stream", metavar="TOPIC", help="Write this stream; repeatable [all].")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the scenarios.")] = False,
    show: Annotated[bool, typer.Option("--show", help="Print it with all keys, a TOML file to start from.")] = False,
    replayed: Annotated[bool, typer.Option("--replay", help="Replay it without a file in between.")] = False,
    estimator: Annotated[str, typer.Option("--estimator", "-e", help="Estimator of --replay.")] = "correlation",
    preset: PresetName = None,
    as_json: AsJson = False,
) -> None:
    """Make a simulated mission: write it as a recording, or replay it directly.

    A scenario says what the ground, the way, the sensors and the faults are. The recording carries the list of its
    faults in /truth/faults. Same scenario, same seed: same bytes. Ctrl-C ends the file early and keeps it readable.
    docs/simulation.md explains, docs/scenarios.md has every key.
    """
    from workbench import scenarios
    from workbench.settings import SettingsError

    if listed:
        width = max(map(len, scenarios.names()))
        print("\n".join(f"{name:<{width}}  {scenarios.about(name)}" for name in scenarios.names()))
        return
    if scenario is None:
        raise SettingsError("name a scenario, or a TOML file; workbench simulate --list names all")
    if not (show or replayed or out):
        raise SettingsError("say where to: -o FILE writes it, --replay replays it, --show prints it")
    if replayed and (container or images or streams):
        raise SettingsError("--replay writes no recording; leave --as, --images and --stream out")
    loaded = scenarios.load(scenario, overrides=overrides or (), seed=seed, picture=picture)
    if show:
        print(scenarios.to_text(loaded.scenario), end="")
        return
    mission = scenarios.mission(loaded)
    if replayed:
        _replay_mission(mission, estimator, preset, out, as_json)
    elif out is not None:
        _write_mission(mission, out, container, images, streams, as_json)


def _replay_mission(
    mission: SimulatedMission, estimator: str, preset: str | None, out: Path | None, as_json: bool
) -> None:
    from workbench.session import Request

    folder = out or Path("results") / mission.path.name
    request = Request(path=Path(f"sim:{mission.path.name}"), estimator=estimator, preset=preset, out=folder)
    _conclude(_replay(request, mission), as_json)


def _write_mission(
    mission: SimulatedMission,
    out: Path,
    container: str | None,
    images: str | None,
    streams: Sequence[str] | None,
    as_json: bool,
) -> None:
    from workbench.progress import Progress
    from workbench.writers import write

    form: Any = None if images is None else _one_of(images, ("jpeg", "png", "stored"), "--images")
    with Bar(out.name, "message") as bar:
        try:
            written = write(
                mission,
                out,
                container=container,
                streams=streams,
                image_format=form,
                on_progress=lambda done, total: bar(Progress(done, total, 0)),
            )
        except KeyboardInterrupt:
            kept = f"{out} holds what was written so far" if out.exists() else "nothing was kept"
            print(f"interrupted: {kept}", file=sys.stderr)
            raise
    if as_json:
        faults = [{"name": f.name, "start_s": f.start_s, "stop_s": f.stop_s} for f in mission.faults]
        left_out = dict(written.left_out)
        print_json({"path": str(out), "messages": written.messages, "left_out": left_out, "faults": faults})
        return
    rows = [(topic, str(count)) for topic, count in written.messages.items()]
    print("\n".join([f"{out}: {mission.path.name}", "", *table(("stream", "messages"), rows, right=(1,))]))
    print_list("left out", [f"{stream}: {why}" for stream, why in written.left_out.items()])
    print_list("faults", [f"{f.name} from {f.start_s:.3f} to {f.stop_s:.3f} s" for f in mission.faults])
    print(f"\nreplay it with: workbench replay {out}")


# ----------------------------------------------------------------------------------- view


@app.command(
    short_help="Look at one or several runs in the Rerun viewer.",
    epilog=examples(
        "workbench view results/mission",
        "workbench view results/mission/best.rrd results/mission/paper-a.rrd",
        "workbench view results/mission --web",
    ),
)
def view(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="RUN.rrd files, or folders of results", show_default=False)
    ],
    web: Annotated[bool, typer.Option("--web", help="Show it in the browser, served on this machine only.")] = False,
) -> None:
    """Open the Rerun viewer with one or several runs and the images that belong to them.

    Without a display the command that would open it is printed.
    """
    command = view_command(files_of(runs), web=web)
    if not web and not has_display():
        import shlex

        print("There is no display here. On a machine with one, with these files:", file=sys.stderr)
        print(shlex.join(["rerun", *command[3:]]))
        return
    raise typer.Exit(subprocess.run(command, check=False).returncode)


def files_of(runs: Sequence[Path]) -> list[Path]:
    """The files to open for some runs: the sensors of their missions first, no file twice.

    Raises:
        RecordingError: a run is missing, or a folder holds none.
    """
    from readers.streams import RecordingError

    chosen: list[Path] = []
    for run in runs:
        if not run.exists():
            raise RecordingError(run, "there is no such run", "give the RUN.rrd, or its folder, of a replay")
        folder = run if run.is_dir() else run.parent
        found = sorted(run.glob("*.rrd")) if run.is_dir() else [run.with_suffix(".rrd")]
        if not found or not all(file.is_file() for file in found):
            raise RecordingError(run, "there is no .rrd file", "give the RUN.rrd, or its folder, of a replay")
        sensors = folder / "sensors.rrd"
        chosen += [sensors] if sensors.is_file() else []
        chosen += found
    unique = list(dict.fromkeys(chosen))
    return sorted(unique, key=lambda file: file.name != "sensors.rrd")


def view_command(files: Sequence[Path], *, web: bool) -> list[str]:
    """The command that opens the viewer on these files, reachable from this machine only."""
    command = [sys.executable, "-m", "rerun", *map(str, files), "--bind", "127.0.0.1"]
    return [*command, "--web-viewer"] if web else command


# ----------------------------------------------------------------------------------- sync


@app.command(
    short_help="How far the clocks of cameras, IMUs and odometers are apart.",
    epilog=examples(
        "workbench sync mission.bag",
        "workbench sync mission.bag --image /camera/image_raw --with /imu --picture sync.png",
        "workbench replay mission.bag --offset /camera/image_raw=-31.5",
    ),
)
def sync(
    path: RecordingPath,
    images: Annotated[
        list[str] | None, typer.Option("--image", metavar="TOPIC", help="Images [all]; repeatable.")
    ] = None,
    sensors: Annotated[
        list[str] | None, typer.Option("--with", metavar="TOPIC", help="IMU or odometry [all]; repeatable.")
    ] = None,
    start: StartTime = None,
    stop: StopTime = None,
    max_offset: Annotated[float, typer.Option(metavar="S", help="How far the clocks may be apart.")] = 1.0,
    picture: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Draw the correlations.")] = None,
    clocks: Clocks = None,
    offsets: Offsets = None,
    no_cache: NoCache = False,
    as_json: AsJson = False,
) -> None:
    """Tell by how much the times of each camera are to be moved to fit each IMU and odometer, and how surely.

    The turn of the whole image is held against rates of turn, the way of the image against speeds. It takes motion that
    changes: turns, or starts and stops. Exit status 3 where no offset could be told.
    """
    from readers.streams import StreamError
    from workbench.opening import open_any
    from workbench.progress import Progress
    from workbench.sync import draw
    from workbench.sync import sync as estimated

    if not 0 < max_offset < float("inf"):
        raise StreamError(f"--max-offset {max_offset:g}: give a positive number of seconds")
    options = _options(None, None, "auto", None, clocks, offsets, cache=not no_cache)
    with open_any(path, options) as recording, Bar("sync") as bar:
        _warn(recording.cache_troubles)
        pairs = estimated(
            recording,
            images=images or (),
            sensors=sensors or (),
            start=start,
            stop=stop,
            max_offset_s=max_offset,
            on_frame=lambda done, total: bar(Progress(done, None if total < 0 else total, 0)),
        )
    if picture is not None:
        draw(pairs, picture)
    if as_json:
        print_json({"pairs": [_pair_values(pair) for pair in pairs]})
    else:
        for pair in pairs:
            told = pair.offset
            print(f"{shown(pair.camera)} and {shown(pair.sensor)}: ", end="")
            if told.determined:
                print(
                    f"{told.offset_ns / 1e6:+.2f} ms (1σ {1e3 * told.sigma_s:.2f} ms) are to be added to the camera's "
                    f"times, by {pair.signals} (correlation {told.correlation:.3f}): {shown(pair.option)}"
                )
            else:
                print(told.reason)
    raise typer.Exit(0 if any(pair.offset.determined for pair in pairs) else IN_PART)


def _pair_values(pair: Pair) -> dict[str, Any]:
    told = pair.offset
    return {
        "camera": pair.camera,
        "sensor": pair.sensor,
        "signals": pair.signals,
        "determined": told.determined,
        "reason": told.reason,
        "offset_ms": told.offset_ns / 1e6 if told.determined else None,
        "sigma_ms": 1e3 * told.sigma_s,
        "correlation": told.correlation,
        "scale": told.scale,
        "option": pair.option,
    }


# --------------------------------------------------------------------------------- verify


@app.command(
    short_help="Check that the files of a run are what was written.",
    epilog=examples(
        "workbench verify results/mission",
        "workbench verify results/mission/best.rrd --json",
        "cd results/mission && sha256sum -c best.sha256",
    ),
)
def verify(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="RUN.rrd files, or folders of results", show_default=False)
    ],
    as_json: AsJson = False,
) -> None:
    """Hold the files of runs against their manifests, RUN.sha256: every byte, and the rows of every entity.

    Exit status 0: all is as it was written; 3: something differs, which is named; 2: there is no manifest to go by.
    """
    from workbench import manifest

    found = {
        str(folder / name): manifest.verify(folder, name) for run in runs for folder, name in manifest.runs_of(run)
    }
    good = not any(check.problems for checks in found.values() for check in checks)
    if as_json:
        told = {
            run: {c.name: {"rows": c.rows, "problems": list(c.problems)} for c in checks}
            for run, checks in found.items()
        }
        print_json({"good": good, "runs": told})
    else:
        for run, checks in found.items():
            print(shown(run))
            for check in checks:
                counted = f", {check.rows} rows" if check.rows else ""
                print(f"  {shown(check.name)}: {'; '.join(map(shown, check.problems)) or 'as written' + counted}")
    raise typer.Exit(0 if good else IN_PART)


# ----------------------------------------------------------------------------------- demo


@app.command(
    short_help="Replay the built-in recording.",
    epilog=examples(
        "workbench demo && workbench view results/demo",
    ),
)
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results.")] = Path(
        "results/demo"
    ),
    as_json: AsJson = False,
) -> None:
    """Replay the built-in recording with both presets: what went wrong in it, and how to look at the result."""
    from workbench.session import Request

    path = demo_recording()
    runs = {}
    for preset in ("best", "paper-a"):
        outcome = _replay(Request(path=path, preset=preset, out=out))
        findings, refused = _findings_of(outcome)
        runs[outcome.summary["run"]] = outcome.summary | _told(findings, refused)
        if not as_json:
            _print_summary(outcome, findings, refused)
            print()
        if status := _status(outcome):
            raise typer.Exit(status)
    if as_json:
        print_json({"folder": str(out), "runs": runs})
        return
    print(f"Both runs lie in {out}. Look at them, one over the other, with:\n  workbench view {out}")


def demo_recording() -> Path:
    """The recording that comes with the source.

    Raises:
        RecordingError: it is not there.
    """
    from readers.streams import RecordingError

    path = Path(__file__).resolve().parents[1] / "recordings" / "demo.mcap"
    if not path.is_file():
        raise RecordingError(
            path, "the built-in recording is missing", "install from a checkout of the source with pip install -e ."
        )
    return path


# ------------------------------------------------------------------------------ reproduce

reproduce = typer.Typer(help="Repeat a paper's experiment on simulated missions.", rich_markup_mode=None)
app.add_typer(reproduce, name="reproduce", short_help="Repeat a paper's experiment on simulated missions.")
cli_patrol.register(app, reproduce)
cli_flights.register(reproduce)


@reproduce.command(
    "paper-a",
    short_help="Ground-surface odometry (paper A, experiment 3.2).",
    epilog=examples(
        "workbench reproduce paper-a",
        "workbench reproduce paper-a --seeds 5",
        "workbench reproduce paper-a --matrix --limits",
        "workbench reproduce paper-a --surface floor.png --frames 600 -o results/floor",
        "workbench reproduce paper-a --set fragment_side_px=21 -o results/reproduce-paper-a-21",
    ),
)
def reproduce_paper_a(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results.")] = Path(
        "results/reproduce-paper-a"
    ),
    surface: Annotated[
        str | None, typer.Option(metavar="NAME|PICTURE", help="The ground [gravel; all for matrix and limits].")
    ] = None,
    frames: Annotated[int, typer.Option(metavar="N", help="Frames of a drive.")] = 2111,
    seeds: Annotated[int, typer.Option(metavar="N", help="Drives of every condition.")] = 1,
    matrix: Annotated[bool, typer.Option("--matrix", help="All surfaces, speeds and trajectories as well.")] = False,
    limits: Annotated[bool, typer.Option("--limits", help="Which fragment is needed where, as well.")] = False,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting over paper-a's; repeatable.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", help="Processes [all cores].")] = None,
    as_json: AsJson = False,
) -> None:
    """Repeat paper A's experiment 3.2: paper-a before and after correction, and best, beside the paper's numbers.

    The folder then holds report.md with tables and pictures, the same values as JSON and CSV, and logs of two
    drives for the viewer. Ctrl-C leaves the finished parts; the same command goes on with the others.
    """
    from workbench.reproduce import paper_a, report

    plan = paper_a.Plan(
        out=out,
        surface=surface,
        frames=frames,
        seeds=seeds,
        with_matrix=matrix,
        with_limits=limits,
        jobs=jobs,
        overrides=tuple(overrides or ()),
        command=_as_typed(out, surface, frames, seeds, matrix, limits, overrides),
    )
    with Bars() as bars:
        done = paper_a.reproduce(plan, bars)
    _end_reproduced(done, report.values(done.results) if as_json else None, _print_reproduced)


def _as_typed(
    out: Path,
    surface: str | None,
    frames: int,
    seeds: int,
    matrix: bool,
    limits: bool,
    overrides: Sequence[str] | None,
) -> str:
    """The command that repeats this one."""
    import shlex

    words = ["workbench", "reproduce", "paper-a", "-o", str(out)]
    words += ["--surface", surface] if surface else []
    words += ["--frames", str(frames), "--seeds", str(seeds)]
    words += ["--matrix"] * matrix + ["--limits"] * limits
    for text in overrides or ():
        words += ["--set", text]
    return shlex.join(words)


def _end_reproduced(done: Reproduced[Any], values: Mapping[str, Any] | None, show: Callable[[Any], None]) -> NoReturn:
    """Print the values of an experiment as JSON, or show it where there are none; and exit."""
    if values is not None:
        print_json({**values, "folder": str(done.folder), "interrupted": done.interrupted})
    else:
        show(done)
    raise typer.Exit(INTERRUPTED if done.interrupted else 0)


def _print_reproduced(done: Reproduced[reports_a.Results]) -> None:
    """Print the tables and statements of an experiment for people."""
    from workbench.reproduce import report

    results = done.results
    tables = []
    if results.runs:
        tables.append(report.experiment_table(results))
    if results.effects:
        tables.append(report.correction_table(results.effects))
    if results.matrix:
        tables.append(report.matrix_table(results.matrix))
    tables += report.limits_tables(results.limits).values() if results.limits else []
    for heads, rows in tables:
        print("\n".join(table(heads, rows, right=range(2, len(heads)))), end="\n\n")
    _print_statements(results.statements, results.unfinished, done.file)
    for log in results.logs:
        print(f"log     workbench view {log}")


def _print_statements(statements: Iterable[Statement], unfinished: Iterable[str], report: Path) -> None:
    for statement in statements:
        print(f"{statement.upshot}: {statement.claim}\n    {statement.numbers}")
    for text in unfinished:
        print(f"not finished: {text}; the same command goes on")
    print(f"\nreport  {report}")


@reproduce.command(
    "paper-b",
    short_help="Range to landmarks from ego-motion (paper B, section 4).",
    epilog=examples(
        "workbench reproduce paper-b",
        "workbench reproduce paper-b --runs 1000 --seeds 100",
        "workbench simulate paper-b -o paper-b.mcap",
    ),
)
def reproduce_paper_b(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of the results.")] = Path(
        "results/reproduce-paper-b"
    ),
    runs: Annotated[int, typer.Option(metavar="N", help="Runs of each Monte Carlo; the paper has 1000.")] = 4000,
    seeds: Annotated[int, typer.Option(metavar="N", help="Runs of the robot's replica.")] = 40,
    as_json: AsJson = False,
) -> None:
    """Repeat paper B's Tables 1-3 and Figs 6-8, 10-12 beside the paper's numbers, with bounds and consistency.

    The folder then holds report.md with tables and pictures, the same values as JSON and CSV, and a log of one run
    of the robot for the viewer. Ctrl-C leaves the finished parts; the same command goes on with the others.
    """
    import shlex

    from workbench.reproduce import paper_b
    from workbench.reproduce.ranging import report

    words = ["workbench", "reproduce", "paper-b", "-o", str(out), "--runs", str(runs), "--seeds", str(seeds)]
    plan = paper_b.Plan(out=out, runs=runs, seeds=seeds, command=shlex.join(words))
    with Bars() as bars:
        done = paper_b.reproduce(plan, bars)
    _end_reproduced(done, report.values(done.results) if as_json else None, _print_ranges)


def _print_ranges(done: Reproduced[RangeResults]) -> None:
    """Print the tables and statements of paper B's experiments for people."""
    from workbench.reproduce.ranging import report
    from workbench.reproduce.ranging.statements import statements

    for name, (heads, rows) in report.tables(done.results).items():
        print("\n".join((name, *table(heads, rows))), end="\n\n")
    _print_statements(statements(done.results), done.results.unfinished, done.file)
    if done.results.robot:
        print(f"log     workbench view {done.results.log}")


# ------------------------------------------------------------------------------- settings


@app.command(
    short_help="Print the settings of a preset as a settings file.",
    epilog=examples(
        "workbench settings --preset paper-a > mine.toml",
        "workbench replay mission.bag --settings mine.toml",
    ),
)
def settings(
    estimator: Annotated[str, typer.Option("--estimator", "-e", help="Name of the estimator.")] = "correlation",
    preset: Annotated[str | None, typer.Option(help="Preset of its settings.")] = None,
) -> None:
    """Print the settings of a preset as a settings file, each with what it is."""
    from workbench.settings import described, plugin, settings_values, to_toml

    chosen = plugin(estimator)
    name = preset or chosen.usual_preset
    values = settings_values(chosen.preset(name))
    print(f"# {estimator}, preset {name}; all presets: {', '.join(chosen.presets)}")
    for key, meaning in described(chosen.settings):
        if meaning:
            print(f"# {meaning}")
        print(to_toml({key: values[key]}).strip() if values[key] is not None else f"# {key} is not set")


# -------------------------------------------------------------------------------- whatif


@app.command(
    "whatif",
    short_help="Replay a window of a run with other settings, old against new.",
    epilog=examples(
        "workbench whatif results/mission/best.rrd --from 1200 --to 1300 --set search_radius_px=48",
        "workbench whatif results/mission --from 12.5s --to 20s --set max_peak_ratio=0.8 --fields peak_ratio",
        "workbench whatif results/mission --from 1200 --to 1300 --set prediction=last-shift --open",
    ),
)
def what_if(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="RUN.rrd of a replay, or a folder with one run", show_default=False),
    ],
    start: Annotated[
        str | None,
        typer.Option("--from", metavar="A", help="First frame: its number (120) or a time (12.5s, ns, ISO 8601)."),
    ] = None,
    stop: Annotated[str | None, typer.Option("--to", metavar="B", help="Frame or time to end before.")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting to change; repeatable.")
    ] = None,
    settings_file: Annotated[
        Path | None, typer.Option("--settings", metavar="FILE", help="Settings to change, TOML or JSON.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the answer: RUN.whatif-NAME.rrd; made of the settings else.")
    ] = None,
    fields: Annotated[
        str | None, typer.Option("--fields", metavar="A,B", help="Fields of the steps to show, old and new.")
    ] = None,
    as_json: AsJson = False,
    open_: Annotated[bool, typer.Option("--open", help="Open old and new in the viewer.")] = False,
) -> None:
    """Replay a window of a run from the state that it had then, with other settings; show old against new.

    The recording is not needed: states and samples lie in the run's folder. A plain number is a frame's.
    """
    from workbench.whatif import Question, ask, cells, summary_lines, values_of, write

    chosen = [field.strip() for field in (fields or "").split(",") if field.strip()]
    answer = ask(
        Question(
            run=run,
            start=start,
            stop=stop,
            overrides=tuple(overrides or ()),
            settings_file=settings_file,
            name=name,
            fields=tuple(chosen),
        )
    )
    if as_json:
        print_json(values_of(answer))
    else:
        heads, rows = cells(answer)
        print("\n".join(table(heads, rows, right=range(2))), end="\n\n")
        for line in summary_lines(answer):
            print(shown(line))
    sys.stdout.flush()  # the table is the answer; the recording comes after it
    write(answer)
    if open_:
        command = view_command(answer.files, web=False)
        if not has_display():
            import shlex

            print(shlex.join(["rerun", *command[3:]]), file=sys.stderr)
            return
        raise typer.Exit(subprocess.run(command, check=False).returncode)


# -------------------------------------------------------------------------------- helpers


def _options(
    rate: float | None,
    times: Path | None,
    unit: str,
    frames: Sequence[str] | None,
    clocks: Sequence[str] | None = None,
    offsets: Sequence[str] | None = None,
    cameras: Sequence[str] | None = None,
    scale_camera: bool = False,
    *,
    msg: Path | None = None,
    distribution: str = "",
    cache: bool = True,
) -> ReadOptions:
    from readers.streams import ReadOptions, StreamError

    if rate is not None and not 0 < rate < float("inf"):
        raise StreamError(f"--rate {rate:g}: a frame rate is a positive number of frames per second")
    if msg is not None and not msg.is_dir():
        raise StreamError(f"--msg {msg}: there is no such folder; give one of .msg files")
    if distribution:
        from readers.decoding import distributions

        _one_of(distribution.lower(), tuple(distributions()), "--distro")
    pairs = []
    for text in frames or ():
        parent, comma, child = text.partition(",")
        if not (comma and parent and child):
            raise StreamError(f"--tf {text}: write two frames with a comma, for example --tf map,base_link")
        pairs.append((parent.strip(), child.strip()))
    return ReadOptions(
        rate_hz=rate,
        times_file=times,
        times_unit=_one_of(unit, ("auto", "s", "ms", "us", "ns"), "--times-unit"),
        pose_frames=tuple(pairs),
        clocks=_clocks(clocks or ()),
        offsets_ns=_offsets(offsets or ()),
        cameras=tuple(map(_camera_file, cameras or ())),
        scale_cameras=scale_camera,
        distribution=distribution,
        msg_folder=msg,
        cache=cache,
    )


def _camera_file(text: str) -> CameraFile:
    """A file of a camera, with the stream that it is for before it and the camera's name behind it."""
    from readers.streams import CameraFile

    if Path(text).is_file():
        return CameraFile(Path(text))
    topic, _, rest = text.rpartition("=")
    file, mark, name = rest.rpartition("#")
    return CameraFile(Path(file if mark else rest), topic, name if mark else "")


def _clocks(texts: Sequence[str]) -> tuple[tuple[str, Clock], ...]:
    """Topics and their clocks."""
    from readers.streams import Clock, StreamError

    found = {}
    for text in texts:
        topic, _, clock = text.rpartition("=")
        if not topic or clock not in set(Clock):
            raise StreamError(f"--clock {text}: write a topic and header, log or publish, such as --clock /imu=log")
        found[topic] = Clock(clock)
    return tuple(found.items())


def _offsets(texts: Sequence[str]) -> tuple[tuple[str, int], ...]:
    """Topics and their offsets in ns."""
    from readers.streams import StreamError

    found = {}
    for text in texts:
        topic, _, number = text.rpartition("=")
        try:
            milliseconds = float(number)
        except ValueError:
            milliseconds = float("nan")
        if topic and abs(milliseconds) < LONGEST_OFFSET_MS:
            found[topic] = round(milliseconds * 1e6)
        elif topic and abs(milliseconds) >= LONGEST_OFFSET_MS:
            raise StreamError(f"--offset {text}: no clock is a century off; give milliseconds, as sync does")
        else:
            raise StreamError(f"--offset {text}: write a topic and milliseconds, such as --offset /camera=-12.5")
    return tuple(found.items())


def _one_of(text: str, known: Sequence[str], option: str) -> str:
    from workbench.settings import SettingsError

    if text not in known:
        raise SettingsError(f"{option} {text}: must be one of {', '.join(known)}")
    return text


cli_runs.add_to(app)


# ----------------------------------------------------------------------------------- main


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status, with one line on stderr for every fault."""
    given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    debug = "--debug" in given
    call: Callable[..., Any] = app
    try:
        status = call([a for a in given if a != "--debug"], prog_name="workbench", standalone_mode=False)
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else FAULT
    except Exception as error:
        return _explain(error, debug)
    return status if isinstance(status, int) else 0


def _explain(error: Exception, debug: bool) -> int:
    """Print an error as one line and return the exit status that it deserves."""
    from readers.streams import WorkbenchError

    if debug:
        traceback.print_exception(error)
    if type(error).__name__ == "Abort":
        return INTERRUPTED
    where = "".join(f" ({note})" for note in getattr(error, "__notes__", ()))
    usage = getattr(error, "format_message", None)  # of the command line's own errors
    if usage is not None:
        print_error(usage() or "a command is missing; see workbench --help")
        return REFUSED
    if isinstance(error, WorkbenchError):
        print_error(f"{error}{where}")
        return REFUSED
    if isinstance(error, OSError):
        print_error(f"{error.filename or 'the system'}: {error.strerror or error}{where}")
        return REFUSED
    first_line = (str(error).splitlines() or [""])[0]
    print_error(f"unexpected {type(error).__name__}: {first_line}{where}; --debug shows where")
    return FAULT
