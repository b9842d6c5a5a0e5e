"""Finished runs explained, compared, checked, swept and exported, from the command line to the files."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from command_line import Shell

from pipelines.verdict import Severity
from readers.streams import RecordingError
from workbench import rrd
from workbench.check import CheckError, Expectation, check, parsed, read_expectations
from workbench.compare import compare
from workbench.diagnosis import diagnose
from workbench.diagnosis.finding import Case, Evidence, Finding
from workbench.explain import explain, scores, worst_frames
from workbench.judgement import budget_of, judged
from workbench.metrics import MetricError, metric, metrics
from workbench.runs import Run, open_run, runs_in
from workbench.session import Request, run
from workbench.sweep import SweepError, parse_axis, unbeaten

FRAMES = 60
BLURRED = (20, 30)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of a short mission with a blurred stretch."""
    folder = tmp_path_factory.mktemp("commands")
    file = folder / "blurred.toml"
    file.write_text(SCENARIO, encoding="utf-8")
    for name, overrides in (("best", ()), ("small", ("fragment_side_px=15",))):
        run(Request(path=file, out=folder / "runs", name=name, overrides=overrides))
    return folder / "runs"


SCENARIO = f"""
frames = {FRAMES}
[camera]
width_px = 256
height_px = 256
[reference.timing]
rate_hz = 60
[height.timing]
rate_hz = 60
[[faults]]
kind = "motion-blur"
start_s = {(BLURRED[0] - 0.5) / 60}
stop_s = {(BLURRED[1] - 0.5) / 60}
exposure = 0.9
"""


@pytest.fixture(scope="module")
def best(folder: Path) -> Run:
    return open_run(folder / "best.rrd")


# -------------------------------------------------------------------------------- explain


def test_explain_names_what_the_blur_did_to_a_frame(best: Run) -> None:
    blurred, sharp = explain(best, 25), explain(best, 10)
    odd = {quantity.field for quantity in blurred.odd}
    assert {"gradient_energy", "peak_anisotropy"} <= odd
    assert len(sharp.odd) < len(blurred.odd) / 2
    energy = next(q for q in blurred.quantities if q.field == "gradient_energy")
    column = best.column("gradient_energy")
    assert energy.value == column[25]
    assert energy.usual == pytest.approx(np.median(column[1:]), rel=1e-12)
    mad = 1.4826 * np.median(np.abs(column[1:] - energy.usual))
    assert energy.z == pytest.approx((column[25] - energy.usual) / mad, rel=1e-9)
    assert [n.frame for n in blurred.neighbours] == list(range(22, 29))
    assert {q.field for q in blurred.quantities} == set(best.fields)


def test_a_drifting_number_is_judged_by_its_change_and_a_steady_one_by_itself() -> None:
    rng = np.random.default_rng(0)
    steps = rng.normal(0.1, 0.01, 400)
    steps[200] = 0.2
    steady = rng.normal(5.0, 0.5, 400)
    steady[200] = 9.0
    table, rows = np.column_stack([np.cumsum(steps), steady]), np.arange(1, 400)
    found = scores(table, 200, rows)
    assert found.drifts.tolist() == [True, False]
    assert found.usual == pytest.approx([0.1, 5.0], rel=0.05)
    assert found.change[0] == pytest.approx(0.2)
    assert found.z == pytest.approx([10.0, 8.0], rel=0.15)
    assert found.rarity == pytest.approx(1 / 399)
    assert abs(scores(table, 100, rows).z).max() < 4


def test_one_of_many_numbers_far_off_is_usual_where_it_always_is() -> None:
    table = np.random.default_rng(1).normal(size=(500, 90))
    rows = np.arange(500)
    table[rows, rows % 90] = 9.0
    assert scores(table, 250, rows[1:]).stands_out < 4
    table[250, 3] = 30.0
    assert scores(table, 250, rows[1:]).stands_out > 4


def test_a_frame_is_explained_alike_by_a_sample_and_by_the_whole_run(
    best: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = explain(best, 25)
    monkeypatch.setattr("workbench.explain.MARGIN", 3)
    read = best.sample(25, margin=3, blocks=2)
    assert set(range(22, 29)) <= set(read["frame"].tolist())
    for name in best.fields:
        np.testing.assert_array_equal(read[name], best.column(name)[np.isin(best.frames, read["frame"])], name)
    monkeypatch.setattr("workbench.explain.BLOCKS", 2)
    part = explain(best, 25)
    assert part.neighbours[0].frame == whole.neighbours[0].frame
    told = [{q.field: repr(q.values) for q in one.quantities} for one in (part, whole)]
    assert told[0] == told[1]


def test_explain_loads_no_library_that_it_does_not_need(best: Run) -> None:
    judged(best)  # the diagnosis needs some of them, its conclusion does not
    code = (
        "import sys; from workbench.cli import main; main(sys.argv[1:]);"
        "print({'numba', 'pandas', 'scipy', 'pyarrow.compute'} & set(sys.modules), file=sys.stderr)"
    )
    command = [sys.executable, "-c", code, "explain", str(best.file), "--frame", "25"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "frame 25" in done.stdout
    assert done.stderr.splitlines()[-1] == "set()"


def test_findings_of_the_frame_and_only_those_are_told(best: Run) -> None:
    def finding(rule: str, first: int, last: int) -> Finding:
        return Finding(
            rule=rule, severity=Severity.WARNING, spans=((first, last),), worst_frame=first, sentence="s",
            evidence=(Evidence(name="n", value=1.0),), cause="c", remedy="r",
        )  # fmt: skip

    told = explain(best, 25, findings=[finding("here", 20, 29), finding("elsewhere", 30, 40)])
    assert [one.rule for one in told.findings] == ["here"]


def test_worst_frames_are_ranked_by_harm_and_know_their_own_sum(best: Run) -> None:
    judgement, budget = judged(best), budget_of(best)
    assert budget is not None
    assert judgement.harm_m is not None
    harm = np.nan_to_num(judgement.harm_m)
    assert harm.sum() == pytest.approx(np.hypot(*budget.end_error_m), rel=1e-6)
    order = worst_frames(best, 5, judgement.harm_m)
    assert [abs(harm[best.row_of(frame)]) for frame in order] == sorted(np.abs(harm), reverse=True)[:5]


def test_what_was_concluded_is_kept_as_long_as_it_counts(best: Run, tmp_path: Path) -> None:
    for name in ("best.rrd", "best.toml", "sensors.rrd"):
        shutil.copy(best.folder / name, tmp_path)
    run = open_run(tmp_path)
    made = judged(run)
    assert "motion-blur" in [finding.rule for finding in made.findings]
    kept = judged(run)
    assert repr(kept.findings) == repr(made.findings)
    np.testing.assert_array_equal(kept.harm_m, made.harm_m)
    file = tmp_path / "best.judgement.json"
    values = json.loads(file.read_text())
    file.write_text(json.dumps(values | {"findings": []}))
    assert judged(run).findings == ()
    (tmp_path / "best.toml").touch()
    assert repr(judged(run).findings) == repr(made.findings)
    file.write_text("no JSON")
    assert repr(judged(run).findings) == repr(made.findings)


def test_a_finding_that_does_grave_harm_is_an_error(best: Run) -> None:
    harm = np.zeros(FRAMES)
    harm[25] = 1.0
    grave, slight = (diagnose(Case.of_run(best, share * harm)) for share in (1.0, 1e-6))
    rules = [{f.rule: f.severity for f in found} for found in (grave, slight)]
    assert rules[0]["motion-blur"] is Severity.ERROR
    assert rules[1]["motion-blur"] is Severity.WARNING


def test_explain_prints_a_screenful(shell: Shell, folder: Path) -> None:
    status, out, err = shell("explain", folder / "best.rrd", "--frame", 25)
    assert (status, err) == (0, "")
    assert out.startswith("frame 25 of ")
    for text in ("out of the usual range", "gradient_energy", "grey²/px²", ">25", "harm: ", "error against"):
        assert text in out
    assert len(out.splitlines()) < 75
    status, out, _ = shell("explain", folder / "best.rrd", "--time", 25 / 60 + 0.001, "--json")
    told = json.loads(out)["frames"][0]
    assert told["frame"] == 25
    assert {q["field"] for q in told["quantities"]} >= {"surface", "pose"} - {"surface"}
    status, out, _ = shell("explain", folder / "best.rrd", "--worst", 3, "--json")
    assert len(json.loads(out)["frames"]) == 3


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--frame", 900), "has no frame 900; give one of 0 to 59"),
        (("--time", 900), "the run lasts from 0 to"),
        (("--time", "noon"), "is not a time"),
        (("--frame", 3, "--worst", 2), "give one of --frame, --time and --worst"),
    ],
)
def test_explain_refuses_in_a_line(shell: Shell, folder: Path, arguments: tuple[object, ...], text: str) -> None:
    status, out, err = shell("explain", folder / "best.rrd", *arguments)
    assert (status, out) == (2, "")
    assert text in err
    assert err.count("\n") == 1


# -------------------------------------------------------------------------------- compare


def test_compare_finds_where_runs_part(folder: Path, best: Run) -> None:
    small = open_run(folder / "small.rrd")
    found = compare([best, small])
    assert found.settings == {"fragment_side_px": (21, 15)}
    assert found.metrics["frames"] == (FRAMES, FRAMES)
    (parting,) = found.partings
    a, b = best.column("pose"), small.column("pose")
    assert parting.first_different == 0  # the fragments' side stands in the first Step
    assert parting.field in ("fragment_side_px", "fragment_px", "rotation_limit_rad", "surface")
    np.testing.assert_allclose(parting.difference[:, 0], np.hypot(*(a - b)[:, :2].T), atol=1e-12)
    above = np.flatnonzero(parting.difference[:, 0] > 0.001)
    assert parting.apart[0.001] == (above[0] if len(above) else -1)


def test_a_run_does_not_part_from_itself(best: Run) -> None:
    (parting,) = compare([best, open_run(best.file)]).partings
    assert parting.identical
    assert parting.first_different == -1
    assert not parting.difference.any()


def test_compare_writes_one_recording_with_both_runs(shell: Shell, folder: Path, tmp_path: Path, best: Run) -> None:
    both, table = tmp_path / "both.rrd", tmp_path / "differences.csv"
    status, out, err = shell("compare", folder / "best.rrd", folder / "small.rrd", "--rrd", both, "--csv", table)
    assert (status, err) == (0, "")
    assert "first number that differs" in out
    for name in ("best", "small"):
        steps = rrd.read_steps(both, name, best.step_type)
        assert [step.frame for step in steps] == list(range(FRAMES))
    from workbench.rrd_reading import series

    logged = series(both, "/compare/distance/small", "Scalars:scalars")
    written = pd.read_csv(table, index_col="frame")
    np.testing.assert_array_equal(logged.values[:, 0], written["distance_m"].to_numpy())


def test_compare_refuses_one_run_and_twins(shell: Shell, folder: Path, tmp_path: Path) -> None:
    status, _, err = shell("compare", folder / "best.rrd")
    assert status == 2
    assert "only one run" in err
    status, _, err = shell("compare", folder / "best.rrd", folder / "best.rrd", "--rrd", tmp_path / "x.rrd")
    assert status == 2
    assert "two runs are called 'best'" in err


# ---------------------------------------------------------------------------------- check


def test_metrics_are_the_numbers_of_the_summary(best: Run) -> None:
    found = metrics(best.summary)
    evaluation = best.summary["evaluation"]
    assert found["drift_percent"] == evaluation["drift_percent"]
    assert found["ape_m.rmse"] == evaluation["ape_m"]["rmse"]
    assert found["verdict.OK"] == best.summary["verdicts"]["OK"]
    assert metric(found, "verdict.LOST") == 0
    with pytest.raises(MetricError, match="did you mean drift_percent"):
        metric(found, "drift_precent")


@pytest.mark.parametrize(("value", "most", "least"), [(1.0, True, True), (1.1, False, True), (0.9, True, False)])
def test_bounds_take_their_own_value_in(value: float, most: bool, least: bool) -> None:
    assert Expectation("m", "max", 1.0).met(value) is most
    assert Expectation("m", "min", 1.0).met(value) is least
    assert not Expectation("m", "max", 1.0).met(math.nan)


def test_expectations_are_read_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "e.toml"
    file.write_text('[max]\nverdict.LOST = 0\n"drift_percent" = 1.5\n[min]\nframes = 2\n', encoding="utf-8")
    assert {str(e) for e in read_expectations(file)} == {"verdict.LOST <= 0", "drift_percent <= 1.5", "frames >= 2"}
    for text, match in (
        ("[most]\na = 1", r"the tables are \[max\]"),
        ("[max]\na = 'x'", "no number"),
        ("", "holds no"),
    ):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(CheckError, match=match):
            read_expectations(file)
    with pytest.raises(RecordingError, match="cannot be read"):
        read_expectations(tmp_path / "none.toml")
    with pytest.raises(CheckError, match="is no bound"):
        parsed("drift_percent", "max")


def test_check_ends_with_4_and_a_junit_file(shell: Shell, folder: Path, tmp_path: Path) -> None:
    junit = tmp_path / "check.xml"
    arguments = ("check", folder / "best.rrd", "--min", f"frames={FRAMES}")
    assert shell(*arguments)[0] == 0
    status, out, _ = shell(*arguments, "--max", "verdict.OK=3", "--max", "findings.error=99", "--junit", junit)
    assert status == 4
    assert [line.split()[0] for line in out.splitlines()] == ["FAIL", "pass", "pass"] or "FAIL" in out
    suite = ElementTree.parse(junit).getroot()[0]
    assert (suite.get("tests"), suite.get("failures")) == ("3", "1")
    assert shell("check", folder / "best.rrd")[0] == 2
    status, out, _ = shell("check", folder / "best.rrd", "--list", "--json")
    assert json.loads(out)["best"]["frames"] == FRAMES


def test_a_metric_that_is_not_known_does_not_pass() -> None:
    (result,) = check({"drift_percent": math.nan}, [Expectation("drift_percent", "max", 1.0)])
    assert not result.passed
    assert "no value" in str(result)


# ---------------------------------------------------------------------------------- sweep


def test_axes_divide_at_outer_commas_only() -> None:
    axis = parse_axis("a=[0.0, 0.1],[1.0],'x,y'")
    assert axis.values == ("[0.0, 0.1]", "[1.0]", "'x,y'")
    for text in ("a", "a=", "=1,2", "a=1,1"):
        with pytest.raises(SweepError):
            parse_axis(text)


def test_unbeaten_points_are_those_of_the_front() -> None:
    assert unbeaten([1, 2, 3, 2], [3, 1, 2, 1], higher=False) == [True, True, False, True]
    assert unbeaten([1, 2], [1, 2], higher=True) == [True, True]
    assert unbeaten([1, 2], [2, 1], higher=True) == [True, False]


def test_sweep_goes_on_where_it_stopped(shell: Shell, folder: Path, tmp_path: Path) -> None:
    scenario, out = folder.parent / "blurred.toml", tmp_path / "sweep"
    arguments = ("sweep", scenario, "--to", "0.3", "-o", out, "-j", 2)
    status, said, err = shell(*arguments, "--grid", "fragment_side_px=15,21")
    assert (status, "2 of 2 replays are done, 0 of them before" in said) == (0, True), err
    rows = {file.stem: file.stat().st_mtime_ns for file in (out / "rows").rglob("*.json")}
    assert set(rows) == {"fragment_side_px-15", "fragment_side_px-21"}
    status, said, _ = shell(*arguments, "--grid", "fragment_side_px=15,21", "--grid", "span_u_px=100,2000")
    assert status == 3  # 2000 does not fit into the image: its rows say so, the others stand
    assert "4 of 4 replays are done, 0 of them before" in said
    status, said, _ = shell(*arguments, "--grid", "fragment_side_px=15,21,19", "--grid", "span_u_px=100,2000")
    assert "6 of 6 replays are done, 4 of them before" in said
    assert {file.stem: file.stat().st_mtime_ns for file in (out / "rows").rglob("*.json")}.items() >= rows.items()
    table = pd.read_csv(out / "sweep.csv")
    assert list(table["fragment_side_px"]) == [15, 15, 21, 21, 19, 19]
    assert list(table["cpu_ms_per_frame"].notna()) == [True, False] * 3
    pd.testing.assert_frame_equal(
        pd.read_parquet(out / "sweep.parquet")[["name", "drift_percent"]], table[["name", "drift_percent"]]
    )
    assert (out / "sweep.png").stat().st_size > 5000
    status, _, err = shell(*arguments, "--grid", "fragment_side_px=15,22")
    assert status == 2  # no side of a fragment: nothing is replayed
    assert "fragment_side_px" in err


# --------------------------------------------------------------------------------- export


def test_export_is_read_back_by_others(shell: Shell, best: Run, tmp_path: Path) -> None:
    formats = [text for name in ("parquet", "csv", "tum", "kitti", "rrd") for text in ("-f", name)]
    status, _, err = shell("export", best.file, "-o", tmp_path, *formats)
    assert (status, err) == (0, "")
    expected = best.trace()
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "best.correlation.parquet"), expected)
    pd.testing.assert_frame_equal(
        pd.read_csv(tmp_path / "best.correlation.csv", index_col="frame"),
        expected, check_dtype=False, check_exact=True,
    )  # fmt: skip
    from evo.tools import file_interface

    tum = file_interface.read_tum_trajectory_file(tmp_path / "best.tum")
    np.testing.assert_array_equal(tum.positions_xyz[:, :2], best.column("pose")[:, :2])
    kitti = file_interface.read_kitti_poses_file(tmp_path / "best.kitti")
    np.testing.assert_array_equal(kitti.positions_xyz, tum.positions_xyz)
    steps = rrd.read_steps(tmp_path / "best.portable.rrd", "best", best.step_type)
    assert len(steps) == FRAMES
    status, _, err = shell("export", best.file, "-o", tmp_path, "-f", "bag")
    assert status == 2
    assert "there are: parquet, csv" in err


def test_runs_of_a_folder_are_all_its_runs(folder: Path) -> None:
    assert [one.name for one in runs_in([folder])] == ["best", "small"]
