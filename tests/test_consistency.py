"""A run held against itself, from the command line to what explain and report make of it."""

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Shell

from pipelines.verdict import Verdict
from readers.streams import RecordingError, ScalarSample
from workbench import consistency as module
from workbench import report
from workbench.consistency import Consistency, Logged, Stretch, consistency, read, values_of, write
from workbench.judgement import BACKWARD, drift_of, judged
from workbench.rrd_sensors import sensors_of
from workbench.runs import Run, open_run
from workbench.session import Request, run

FRAMES, TURNING = 140, 69
BLURRED = (24, 40)
TIMES_S, SPEEDS_MPS = [0, 0.4, 0.65, 1, 1.3, 3], [1.8, 1.8, 0.9, 1.8, -1.8, -1.8]
HEIGHT = "/camera/height"
SCENARIO = f"""
frames = {FRAMES}
[ground]
size_px = 1024
[trajectory]  # an arc, and back on it in reverse
curve = "circle"
profile = "knots"
profile_parameters = {{ t_s = {TIMES_S}, speed_mps = {SPEEDS_MPS} }}
[camera]
width_px = 160
height_px = 120
focal_px = 100
[reference.timing]
rate_hz = 60
[height.timing]
rate_hz = 60
"""
BLUR = f"""
[[faults]]
kind = "motion-blur"
start_s = {(BLURRED[0] - 0.5) / 60}
stop_s = {(BLURRED[1] - 0.5) / 60}
exposure = 0.9
"""
LIFT = """
[[faults]]
kind = "height-change"
start_s = 0.1
stop_s = 0.9
lift_m = 0.02
ramp_s = 0.3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a reference, blurred for a while; one with it, whose height comes from a stream; one of ranges."""
    folder = tmp_path_factory.mktemp("consistency")
    for name, fault in (("blurred", BLUR), ("lifted", LIFT)):
        (folder / f"{name}.toml").write_text(SCENARIO + fault, encoding="utf-8")
    run(Request(path=folder / "blurred.toml", out=folder / "runs", reference="none"))
    run(Request(path=folder / "lifted.toml", out=folder / "heights", name="known", height=HEIGHT, stop="0.8"))
    run(Request(path=Path("sim:fault-track-slip"), estimator="range", stop="0.3", out=folder / "ranges"))
    return folder


@pytest.fixture
def blurred(folder: Path, tmp_path: Path) -> Run:
    """A copy of the run without a reference that a test may write beside."""
    shutil.copytree(folder / "runs", tmp_path / "runs")
    return open_run(tmp_path / "runs")


@pytest.fixture(scope="module")
def found(folder: Path) -> Consistency:
    return consistency(open_run(folder / "runs"))


# ---------------------------------------------------------------------------------- the answer


def test_the_frames_of_a_fault_move_the_end_most(found: Consistency, folder: Path) -> None:
    worst = found.frame[found.ranked()[:3]]
    assert all(BLURRED[0] <= frame <= BLURRED[1] for frame in worst)
    assert found.size_m[found.ranked()[0]] > 15 * found.usual_m
    assert found.harm_m.sum() == pytest.approx(found.end_m, rel=1e-9)
    assert 0 < found.end_m < 0.01 * found.path_m
    assert len(found.frame) == FRAMES - 1
    truth = np.abs(np.interp(np.arange(FRAMES) / 60, TIMES_S, SPEEDS_MPS)).sum() / 60
    assert found.path_m == pytest.approx(truth, rel=0.05)


def test_loops_over_the_fault_drift_and_accuse_the_stretch_that_holds_it(found: Consistency) -> None:
    assert found.loops_why == ""
    assert 2 < len(found.loops) <= found.revisits
    assert [one.drift_m for one in found.loops] == sorted((one.drift_m for one in found.loops), reverse=True)
    assert all(one.first_frame < TURNING < one.second_frame for one in found.loops)
    over = [one.drift_m for one in found.loops if one.first_frame < BLURRED[0]]
    beside = [one.drift_m for one in found.loops if one.first_frame >= BLURRED[1]]
    assert min(over) > 2 * max(beside)
    spans, explained = found.suspicion()
    assert any(first < BLURRED[1] and BLURRED[0] < last for first, last in spans)
    assert sum(last - first for first, last in spans) < FRAMES / 2
    assert explained > 0.8


def test_heights_of_a_stream_hold_for_the_same_frames_backward(folder: Path) -> None:
    opened = open_run(folder / "heights")
    assert opened.settings["height_stream"] == HEIGHT
    found = consistency(opened)
    assert np.isfinite(opened.column("height_m")).all()
    assert found.end_m < 2e-4 * found.path_m
    assert np.ptp(opened.column("height_m")) > 1e-3 * opened.column("height_m").mean()  # so that a wrong one would show


def test_logged_samples_are_read_by_their_times(folder: Path) -> None:
    with sensors_of(open_run(folder / "heights")) as sensors:
        names = ["/camera/image_raw", HEIGHT]
        log = Logged(sensors, names)
        whole = list(log.read())
        assert [s.t_ns for s in whole] == sorted(s.t_ns for s in whole)
        assert {s.stream for s in whole} == set(names)
        heights = [s.t_ns for s in log.read([HEIGHT])]
        assert [s.t_ns for s in log.read([HEIGHT], heights[3], heights[7])] == heights[3:7]
        first = next(log.read(["/camera/image_raw"]))
        assert sensors.decoded(first).grey().shape == (120, 160)  # type: ignore[attr-defined]
        number = ScalarSample(stream="/a", t_ns=1, received_ns=1, value=2.0)
        assert sensors.decoded(number) is number


def test_stretches_that_explain_alike_are_one_span(found: Consistency) -> None:
    def stretch(after: int, last: int, explained: float) -> Stretch:
        return Stretch(after_frame=after, last_frame=last, loops=1, mean_m=0.1, explained=explained)

    likely = [stretch(20, 30, 0.9), stretch(10, 20, 0.88), stretch(50, 60, 0.86), stretch(30, 50, 0.2)]
    spans, explained = dataclasses.replace(found, suspects=tuple(likely)).suspicion()
    assert spans == [(11, 30), (51, 60)]
    assert explained == 0.9


def test_undecodable_frames_have_no_image_to_look_at(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = open_run(folder / "runs")
    alarms = opened.column("alarms").copy()
    ends = {one.second_frame for one in consistency(opened).loops}
    alarms[sorted(ends)] = int(Verdict.UNDECODABLE)
    monkeypatch.setitem(opened._columns, "alarms", alarms)
    again = consistency(opened)
    assert not ends & {frame for one in again.loops for frame in (one.first_frame, one.second_frame)}
    assert len(again.loops) < again.revisits


# ------------------------------------------------------------------------------------ the file


def test_what_is_written_is_read_back(blurred: Run, found: Consistency) -> None:
    assert read(blurred) is None
    file = write(blurred, dataclasses.replace(found, end_rad=math.nan))
    values = json.loads(file.read_text())
    assert values["end_rad"] is None
    write(blurred, found)
    back = read(blurred)
    assert back is not None
    assert repr(back) == repr(found)
    for name in ("frame", "size_m", "shift_m", "heading_m"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))
    assert values_of(back) == values_of(found)


def test_a_file_of_another_replay_is_told_and_not_used(blurred: Run, found: Consistency, shell: Shell) -> None:
    write(blurred, found)
    toml = blurred.path("toml")
    toml.write_text(toml.read_text() + "# replayed again\n")
    again = open_run(blurred.folder)
    with pytest.raises(RecordingError, match=r"of another replay than best\.rrd; run workbench consistency again"):
        read(again)
    judgement = judged(again)
    assert judgement.harm_m is None
    assert judgement.findings
    assert "of another replay" in judgement.note
    assert judged(again).note == judgement.note  # also where it was kept
    status, out, _ = shell("explain", blurred.folder)
    assert status == 0
    assert "harm: not told" in out
    assert any("of another replay" in line for line in report.facts_of(again).missing)
    module.file_of(again).write_text("[]")
    with pytest.raises(RecordingError, match="cannot be read"):
        read(again)


# -------------------------------------------------------------------------------- the commands


def test_from_the_command_to_the_findings_harm(blurred: Run, shell: Shell) -> None:
    before = judged(blurred)
    assert before.harm_m is None
    assert all(math.isnan(finding.harm_m) for finding in before.findings)
    status, out, err = shell("consistency", blurred.folder, "--worst", 4)
    assert status == 0, err
    assert f"{FRAMES} of {FRAMES}" in err
    rows = [line.split() for line in out.splitlines()]
    top = [row for row in rows if row and row[-1] == "motion-blur"]
    assert {int(row[0]) for row in top} & set(range(*BLURRED))
    assert "one error in frames" in out
    after = judged(blurred)
    blur = next(finding for finding in after.findings if finding.rule == "motion-blur")
    assert after.harm_from == BACKWARD
    assert blur is after.findings[0]
    drift = drift_of(blurred)
    assert drift is not None
    assert np.nansum(drift.harm_m) == pytest.approx(drift.end_error_m, rel=1e-9)
    assert blur.harm_m > 0.5 * drift.end_error_m
    status, out, _ = shell("explain", blurred.folder, "--worst", 1)
    assert BLURRED[0] <= int(out.split()[1]) <= BLURRED[1]
    assert "to what forward and backward replay end apart" in out
    facts = report.facts_of(blurred)
    for text in (report.page_of(facts), report.text_of(facts)):
        assert "Forward and backward replay end" in text
        assert "of what forward and backward replay end apart" in text
        assert "The end is" not in text
    assert report.values(facts)["drift"]["source"] == BACKWARD


def test_json_holds_what_the_file_holds(blurred: Run, shell: Shell) -> None:
    status, out, _ = shell("consistency", blurred.folder, "--json")
    assert status == 0
    printed = json.loads(out)
    kept = json.loads(Path(printed.pop("file")).read_text())
    del kept["key"]
    assert printed == kept
    assert len(printed["frame"]) == len(printed["size_m"]) == FRAMES - 1
    status, out, _ = shell("explain", blurred.folder, "--json")
    assert json.loads(out)["harm_from"] == BACKWARD


def test_a_reference_comes_before_the_backward_replay(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "heights", tmp_path / "heights")
    opened = open_run(tmp_path / "heights")
    before = drift_of(opened)
    write(opened, consistency(opened))
    after = drift_of(opened)
    assert before is not None
    assert after is not None
    assert after.source == before.source == judged(opened).harm_from == "reference"
    np.testing.assert_array_equal(after.harm_m, before.harm_m)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda folder: (folder / "sensors.rrd").unlink(), "sensors.rrd: is missing or was not finished"),
        (
            lambda folder: _replaced(folder / "sensors.toml", 'digest = "', 'digest = "0'),
            "sensors.rrd: is of another recording than best",
        ),
        (
            lambda folder: _replaced(folder / "sensors.toml", "stride = 1", "stride = 2"),
            "was written again for another",
        ),
    ],
)
def test_runs_without_their_samples_are_refused(
    blurred: Run, shell: Shell, damage: Callable[[Path], None], said: str
) -> None:
    damage(blurred.folder)
    status, _, err = shell("consistency", blurred.folder)
    assert status == 2
    assert said in err
    assert "replay the recording again" in err
    assert not module.file_of(blurred).exists()


def _replaced(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_ranges_have_no_path_to_hold_against_itself(folder: Path, shell: Shell) -> None:
    status, _, err = shell("consistency", folder / "ranges")
    assert status == 2
    assert "is a run of range, which has no path" in err
    assert "give a run of an estimator of the vehicle's path" in err


def test_a_path_without_a_scale_tells_no_harm_in_metres(blurred: Run, found: Consistency) -> None:
    write(blurred, dataclasses.replace(found, unit="px"))
    assert "has no scale" in judged(blurred).note
    assert judged(blurred).harm_m is None


def test_an_interrupt_leaves_nothing_behind(blurred: Run, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.replay.stepped", interrupted)
    before = sorted(file.name for file in blurred.folder.iterdir())
    status, _, _ = shell("consistency", blurred.folder)
    assert status == 130
    assert sorted(file.name for file in blurred.folder.iterdir()) == before
