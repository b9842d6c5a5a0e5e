"""Runs of visual odometry from the command line to the files: a short flight with a gap, explained and compared."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import fake_semidirect as fake
import numpy as np
import pandas as pd
import pytest
from command_line import Shell
from scipy.spatial.transform import Rotation

from pipelines.semidirect.step import SemidirectStep, Stage
from pipelines.spatial import SpatialPath
from pipelines.verdict import Verdict
from readers.streams import RecordingError, StreamError
from workbench import rrd
from workbench.compare import compare
from workbench.consistency import consistency
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Case
from workbench.explain import explain
from workbench.metrics import metrics
from workbench.runs import open_run
from workbench.session import Request, run
from workbench.settings import SettingsError
from workbench.trajectory_files import read_tum
from workbench.visual_account import in_space

FLIGHT = """
duration_s = 4.2
ground = { family = "gravel", metres_per_px = 0.002 }
[trajectory]
curve = "wander"
parameters = { amplitude_m = 0.1, wavelength_m = 2.0 }
speed_kmh = 1.8
[camera]
width_px = 320
height_px = 240
focal_px = 180.0
height_m = 0.5
timing.rate_hz = 30
[reference.timing]
rate_hz = 30
[height.timing]
rate_hz = 30
"""
GAP = """
[[faults]]
kind = "dropped-frames"
start_s = 1.6
stop_s = 3.0
"""
SMALL = ("cell_px=16", "min_tracked=25")


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two equal runs of a flight in which frames are missing for so long that the camera is lost."""
    folder = tmp_path_factory.mktemp("flights")
    for name, text in (("gap", FLIGHT + GAP), ("whole", FLIGHT)):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    for name in ("one", "two"):
        flown(folder / "gap.toml", folder / "runs", name, "restart_s=0.2")
    return folder


def flown(file: Path, out: Path, name: str, *overrides: str, **more: Any) -> Any:
    options = {"estimator": "semidirect"} | more
    return run(Request(path=file, out=out, name=name, overrides=(*SMALL, *overrides), **options))


# ------------------------------------------------------------------------------------ the account


def test_a_gap_is_a_loss_with_its_cause_and_a_new_map(flights: Path) -> None:
    done = open_run(flights / "runs" / "one.rrd")
    found = done.summary["odometry"]
    lost = done.frames[done.column("stage") == Stage.LOST].tolist()
    assert found["losses"] == [[lost[0], lost[-1]]]
    assert found["lost_frames"] == len(lost) > 1
    assert found["maps"] == 2
    assert found["frames_with_pose"] == int(done.column("accepted").sum())
    assert done.summary["unit"] == "m"
    assert done.summary["scale"].startswith("height of /camera/height")
    rules = {finding.rule: finding for finding in diagnose(Case.of_run(done))}
    assert {"lost-frame-gap", "new-map"} <= set(rules)
    assert "start-failed" not in rules
    assert rules["lost-frame-gap"].spans == ((lost[0], lost[-1]),)
    dt = rules["lost-frame-gap"].evidence[0]
    assert dt.value == pytest.approx(1.43, abs=0.1)
    assert dt.usual == pytest.approx(1 / 30, rel=0.01)
    assert metrics(done.summary)["odometry.losses"] == 1
    space = found["space"]
    assert space["of_map"] == 0
    assert space["ape_percent"] < 0.2
    assert space["attitude_deg"]["rmse"] < 0.2


def test_the_trajectory_has_six_coordinates_of_frames_with_a_pose(flights: Path) -> None:
    done = open_run(flights / "runs" / "one.rrd")
    path = read_tum(done.path("tum"))
    good = done.column("accepted").astype(bool)
    np.testing.assert_array_equal(path.t_ns, done.t_ns[good])
    np.testing.assert_array_equal(path.position_m, done.column("position_m")[good])
    assert path.position_m[0, 2] == pytest.approx(0.5, abs=0.02)
    looks = path.rotation.apply([0, 0, 1])
    assert (looks[:, 2] < -0.99).all()
    assert done.trajectory is not None
    assert len(done.trajectory) == good.sum()


def test_two_replays_are_the_same_number_by_number(flights: Path) -> None:
    runs = [open_run(flights / "runs" / f"{name}.rrd") for name in ("one", "two")]
    (parting,) = compare(runs).partings
    assert parting.identical
    assert len(runs[0].lists) > 20


def test_a_list_that_differs_parts_two_runs(flights: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    shutil.copytree(flights / "runs", folder)
    done = open_run(folder / "two.rrd")
    steps = rrd.read_steps(done.file, "two", SemidirectStep)
    row = next(k for k in range(30, len(steps)) if len(steps[k].filter_mu))
    steps[row] = changed(steps[row], filter_mu=steps[row].filter_mu * (1 + 1e-15))
    with rrd.RunWriter(
        done.file, recording_id="m", run="two", estimator="semidirect", step_type=SemidirectStep, settings_text=""
    ) as writer:
        for step in steps:
            writer.step(step)
        writer.finish({}, None)
    (parting,) = compare([open_run(folder / "one.rrd"), open_run(folder / "two.rrd")]).partings
    assert (parting.first_different, parting.field) == (steps[row].frame, "filter_mu")


def test_without_height_the_scale_is_unknown_and_said_so(flights: Path, tmp_path: Path) -> None:
    flown(flights / "whole.toml", tmp_path, "free", height="none", stop="1.6")
    done = open_run(tmp_path / "free.rrd")
    assert done.summary["unit"] == "units"
    assert done.summary["scale"].startswith("scale unknown")
    assert any("--height STREAM" in note for note in done.summary["notes"])
    assert done.summary["evaluation"]["alignment"]["scale"] == pytest.approx(0.5, rel=0.05)
    assert done.summary["odometry"]["space"]["scale"] == pytest.approx(0.5, rel=0.05)
    assert not any(done.column("scale_known"))
    assert "scale-unknown" in {finding.rule for finding in diagnose(Case.of_run(done))}
    with pytest.raises(RecordingError, match="of unknown scale"):
        consistency(done)


def test_positions_give_the_scale_only_when_asked_and_that_is_noted(flights: Path, tmp_path: Path) -> None:
    flown(
        flights / "whole.toml",
        tmp_path,
        "near",
        "position_stream=/reference/pose",
        "scale_way=0.5",
        height="none",
        stop="1.6",
    )
    done = open_run(tmp_path / "near.rrd")
    assert done.summary["scale"].startswith("positions of /reference/pose")
    assert any("which is the reference, too" in note for note in done.summary["notes"])
    assert done.summary["odometry"]["space"]["scale"] == pytest.approx(1.0, rel=0.02)


def test_the_baseline_replays_with_the_first_height(flights: Path, tmp_path: Path) -> None:
    overrides = ("min_tracked=20",)
    run(Request(path=flights / "whole.toml", out=tmp_path, name="b", estimator="ptam", overrides=overrides, stop="2"))
    done = open_run(tmp_path / "b.rrd")
    assert done.summary["scale"].startswith("height of /camera/height at the start")
    assert done.summary["odometry"]["starts"]
    assert done.summary["odometry"]["space"]["scale"] == pytest.approx(1.0, rel=0.05)


# ------------------------------------------------------------------------------------- refusals


def test_what_cannot_be_is_refused_with_its_cure(flights: Path, tmp_path: Path) -> None:
    request = Request(path=flights / "whole.toml", out=tmp_path)
    with pytest.raises(SettingsError, match="--calibrate is for correlation"):
        flown(flights / "whole.toml", tmp_path, "x", calibrate=True)
    with pytest.raises(StreamError, match="/reference/pose holds pose; --odometry can be"):
        flown(flights / "whole.toml", tmp_path, "x", odometry="/reference/pose")
    with pytest.raises(StreamError, match="cannot be the scale: this estimator takes images"):
        run(replace(request, estimator="ptam", overrides=("position_stream=/reference/pose",)))
    assert not list(tmp_path.glob("*.rrd"))


# ------------------------------------------------------------------------------------- commands


def test_explain_tells_the_lists_of_the_frame(flights: Path, shell: Shell) -> None:
    done = open_run(flights / "runs" / "one.rrd")
    status, out, err = shell("explain", done.file, "--frame", 40, "--json")
    assert status == 0, err
    told = {q["field"]: q for q in json.loads(out)["frames"][0]["quantities"]}
    (step,) = done.steps(40, 41)
    assert told["filter_mu"]["values"] == step.filter_mu.tolist()  # type: ignore[attr-defined]
    assert not any(q.odd for q in explain(done, 40).quantities if q.field in done.lists)
    frame = done.summary["odometry"]["losses"][0][0]
    status, out, _ = shell("explain", done.file, "--frame", frame)
    assert status == 0
    assert "LOST" in out
    assert "lost-frame-gap" in out


def test_what_if_goes_on_from_the_middle(flights: Path, shell: Shell, tmp_path: Path) -> None:
    shutil.copytree(flights / "runs", tmp_path / "runs")
    file = tmp_path / "runs" / "one.rrd"
    status, out, err = shell("whatif", file, "--from", 30, "--to", 36, "--json")
    assert status == 0, err
    assert json.loads(out)["summary"]["frames_changed"] == 0
    status, out, err = shell("whatif", file, "--from", 30, "--to", 36, "--set", "max_features=60")
    assert status == 0, err
    assert "max_features: 120 → 60" in out
    assert "changed in 0 frames; numbers in 6" in out


def test_report_check_and_export(flights: Path, shell: Shell, tmp_path: Path) -> None:
    file = flights / "runs" / "one.rrd"
    page = tmp_path / "page.html"
    status, _, err = shell("report", file, "-o", page)
    assert status == 0, err
    text = page.read_text(encoding="utf-8")
    assert "Points that agree with the pose" in text
    assert "lost-frame-gap" in text
    assert "points found (large circles" in text
    status, out, _ = shell("check", file, "--max", "odometry.losses=0", "--min", "odometry.tracked_median=50")
    assert status == 4
    assert "odometry.losses <= 0: 1" in out
    status, _, err = shell("export", file, "-o", tmp_path, "--format", "parquet", "--format", "tum")
    assert status == 0, err
    table = pd.read_parquet(tmp_path / "one.semidirect.parquet")
    assert "position_m[2]" in table
    assert "filter_mu" not in table
    np.testing.assert_array_equal(
        read_tum(tmp_path / "one.tum").position_m, read_tum(file.with_suffix(".tum")).position_m
    )


def test_a_run_is_held_against_itself_where_it_has_a_pose(flights: Path, tmp_path: Path) -> None:
    shutil.copytree(flights / "runs", tmp_path / "runs")
    done = open_run(tmp_path / "runs" / "one.rrd")
    found = consistency(done)
    assert found.unit == "m"
    assert set(found.frame.tolist()) <= set(done.frames[done.column("accepted").astype(bool)].tolist())
    assert "does not measure the motion between any two" in found.loops_why


# -------------------------------------------------------------------------------------- findings


def case(steps: list[SemidirectStep], **settings: Any) -> Case:
    return Case.of_steps(steps, "semidirect", {"min_tracked": 10, **settings})


def test_a_loss_without_another_cause_is_the_maps_and_what_follows_is_doubtful() -> None:
    steps = list(fake.steps(120))
    found = {finding.rule: finding for finding in diagnose(case(steps))}
    assert found["lost-points"].spans == ((fake.LOST.start, fake.LOST.stop - 1),)
    again = found["after-relocalisation"]
    assert again.spans == ((fake.LOST.stop, 119),)
    assert "new-map" not in found
    assert "lost-frame-gap" not in found


@pytest.mark.parametrize(
    ("alarm", "rule"),
    [
        (Verdict.FRAME_GAP, "lost-frame-gap"),
        (Verdict.EXPOSURE_JUMP, "lost-exposure"),
        (Verdict.BLURRED, "lost-blur"),
        (Verdict.LOW_TEXTURE, "lost-flat"),
        (Verdict.ALIGNMENT_FAILED, "lost-alignment"),
        (Verdict.POINTS_DROPPED, "lost-drop"),
    ],
)
def test_a_loss_has_the_cause_that_rings_where_it_begins(alarm: Verdict, rule: str) -> None:
    steps = list(fake.steps(90))
    row = fake.LOST.start
    steps[row] = changed(steps[row], alarms=steps[row].alarms | alarm)
    assert rule in {finding.rule for finding in diagnose(case(steps))}


def changed(step: SemidirectStep, **values: Any) -> SemidirectStep:
    names = step.__dataclass_fields__
    return SemidirectStep(**({name: getattr(step, name) for name in names} | values))


def test_height_over_the_map_against_the_sensor() -> None:
    steps = list(fake.steps(50))
    told = {"height_stream": "/height"}
    assert "scale-drift" not in {finding.rule for finding in diagnose(case(steps, **told))}  # off by 1 %
    steps = [changed(s, map_height_m=1.06 * s.map_height_m) if s.frame > 25 else s for s in steps]
    (drift,) = (finding for finding in diagnose(case(steps, **told)) if finding.rule == "scale-drift")
    assert drift.spans == ((26, 49),)
    assert drift.evidence[0].value == pytest.approx(1.06 * 1.01 - 1, rel=1e-6)


def test_a_start_that_never_came() -> None:
    steps = list(fake.steps(4))
    (finding,) = (f for f in diagnose(case(steps, start_motion_px=50.0)) if f.rule == "start-failed")
    assert finding.worst_frame == 3
    assert finding.evidence[0].value == 36.0
    assert finding.evidence[0].bound == 50.0


# ------------------------------------------------------------------------------- path in space


def test_a_path_in_space_is_told_exactly() -> None:
    """A helix that is turned, shifted, shrunk and mounted askew: no error remains, and the scale is that."""
    s = np.linspace(0, 6, 200)
    places = np.column_stack([np.cos(s), np.sin(s), 0.2 * s])
    turns = Rotation.from_rotvec(np.column_stack([0.1 * s, 0 * s, s]))
    t_ns = np.arange(200) * 10**7
    truth = SpatialPath.of(t_ns, places, turns.as_quat())
    turn, mounting = Rotation.from_rotvec([0.3, -0.2, 0.9]), Rotation.from_rotvec([math.pi, 0, 0.1])
    mine = SpatialPath.of(t_ns, turn.apply(places) / 2.5 + [1, 2, 3], (turn * turns * mounting).as_quat())
    values, laid = in_space(mine, truth)
    assert values["scale"] == pytest.approx(2.5)
    assert values["ape_m"]["max"] < 1e-9
    assert values["attitude_deg"]["max"] < 1e-6
    assert abs(values["scale_drift_percent"]) < 1e-9
    np.testing.assert_allclose(laid, mine.position_m, atol=1e-9)


def test_a_path_that_shrinks_has_that_scale_drift() -> None:
    s = np.linspace(0, 9, 300)
    places = np.column_stack([s, np.sin(2 * s), 0.3 * np.cos(3 * s)])
    quats = np.tile([0.0, 0, 0, 1], (300, 1))
    t_ns = np.arange(300) * 10**7
    step = np.diff(places, axis=0, prepend=places[:1]) * np.where(np.arange(300) < 200, 1.0, 0.9)[:, None]
    values, _ = in_space(SpatialPath.of(t_ns, np.cumsum(step, axis=0), quats), SpatialPath.of(t_ns, places, quats))
    assert values["scale_drift_percent"] == pytest.approx(-10, abs=1.0)
