"""Paper B's experiments: the command on few runs, statements that follow numbers, a replica that is what it says."""

import csv
import dataclasses
import json
import math
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from pipelines.ranging import montecarlo as mc
from pipelines.ranging.step import RangeStep
from workbench import cli, inputs, rrd, scenarios
from workbench.reproduce import drawing, paper_b
from workbench.reproduce.judged import Upshot
from workbench.reproduce.plans import Reproduced
from workbench.reproduce.ranging import replica, report, robot
from workbench.reproduce.ranging import simulation as sim
from workbench.reproduce.ranging import statements as said
from workbench.reproduce.ranging.results import Results
from workbench.reproduce.ranging.robot import Robot
from workbench.reproduce.ranging.simulation import Accuracy
from workbench.settings import SettingsError

RUNS, SEEDS = 40, 2


@pytest.fixture(scope="module", autouse=True)
def quick() -> None:
    """Ways to feed the filter are compared by one run; pictures are drawn once, as small PNGs."""
    patch = pytest.MonkeyPatch()
    patch.setattr(robot, "WAYS_RUNS", 1)
    patch.setattr(drawing, "save", saved_small)
    yield
    patch.undo()


def saved_small(file: Path, draw: Callable[[], Figure]) -> Path:
    png = file.with_suffix(".png")
    draw().savefig(png, dpi=50)
    return png


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper-b")


@pytest.fixture(scope="module")
def done(folder: Path) -> Reproduced[Results]:
    return paper_b.reproduce(paper_b.Plan(out=folder, runs=RUNS, seeds=SEEDS), lambda *_: None)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without drawing their pictures."""
    monkeypatch.setattr(drawing, "save", lambda file, draw: file.with_suffix(".png"))


# ------------------------------------------------------------------------------- the command


def test_the_command_writes_report_tables_and_pictures(done: Reproduced[Results], folder: Path) -> None:
    assert not done.interrupted
    text = done.file.read_text()
    for part in (
        "| paper, Table 2 |  | 3.2 | 2.1 | 1.7 | 1.5 | 1.35 |",
        "| 0.042 | 9.05 |",
        "Not finished",
        "**missed**",
    ):
        assert (part in text) == (part != "Not finished")
    for name in ("fig6", "fig7", "fig8", "fig10", "fig11", "fig12", "start", "consistency", "table3"):
        assert f"pictures/{name}.png" in text
        assert (folder / "pictures" / f"{name}.png").stat().st_size > 10_000
    values = json.loads((folder / "values.json").read_text())
    assert set(values) >= {
        "accuracy",
        "convergence",
        "scaling",
        "better",
        "misprints",
        "robot",
        "versions",
        "statements",
    }
    assert (values["runs"], values["seeds"]) == (RUNS, SEEDS)
    with (folder / "table-3.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["paper (one run)"] for row in rows] == ["9.05", "2.14", "0.92", "0.26", "0.17"]
    assert float(rows[-1]["median"]) == pytest.approx(100 * values["robot"]["table"][-1]["median"], abs=0.005)


def test_the_values_are_those_of_the_monte_carlo(done: Reproduced[Results]) -> None:
    accuracy, better = done.results.accuracy, done.results.better
    assert accuracy is not None
    assert better is not None
    row = next(r for r in accuracy.rows if (r.reading, r.pixel_sigma) == ("as-printed", 0.02))
    direct = mc.table_2("as-printed", runs=RUNS).rms_relative
    np.testing.assert_allclose(said.table_2_columns(accuracy, row), direct[[10, 20, 30, 40, 50]])
    assert 0.3 < better.joint[0].correlation < 0.95  # the study: 0.75; equal image noise would make it 0.99
    assert better.joint[0].correlation > better.joint[1].correlation


@pytest.mark.usefixtures("undrawn")
def test_finished_parts_are_found_again(done: Reproduced[Results], folder: Path) -> None:
    told: list[tuple[str, int, int]] = []
    plan = paper_b.Plan(out=folder, runs=RUNS, seeds=SEEDS)
    again = paper_b.reproduce(plan, lambda *args: told.append(args))
    assert told == []
    texts = [json.dumps(report.values(run.results)) for run in (again, done)]
    assert texts[0] == texts[1]
    (folder / "parts" / "scaling.json").write_text("{torn")
    paper_b.reproduce(plan, lambda *args: told.append(args))
    assert {name for name, *_ in told} == {"scaling"}
    assert told[-1][1] == told[-1][2]


@pytest.mark.usefixtures("undrawn")
def test_parts_of_another_plan_are_not_taken(folder: Path, done: Reproduced[Results], tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    for file in (folder / "parts").iterdir():
        (tmp_path / "parts" / file.name).write_bytes(file.read_bytes())

    told: list[str] = []

    def until_robot(name: str, *_: int) -> None:
        told.append(name)
        if name == "convergence":
            raise KeyboardInterrupt

    stopped = paper_b.reproduce(paper_b.Plan(out=tmp_path, runs=RUNS + 1, seeds=SEEDS), until_robot)
    assert set(told) == {"accuracy", "convergence"}
    assert stopped.interrupted
    assert set(stopped.results.parts) == {"accuracy"}
    assert "convergence" in stopped.results.unfinished
    text = stopped.file.read_text()
    assert "**Not finished**: convergence, scaling" in text
    assert "## Table 2" in text
    assert "## Table 3" not in text


@pytest.mark.usefixtures("undrawn")
def test_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    first = paper_b.works

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    def two(plan: paper_b.Plan) -> list[paper_b.Work]:
        work = first(plan)[:2]
        return [work[0], paper_b.Work(work[1].name, work[1].kind, interrupted, 1, {})]

    monkeypatch.setattr(paper_b, "works", two)
    assert cli.main(["reproduce", "paper-b", "--runs", "20", "-o", str(tmp_path), "--json"]) == 130
    values = json.loads(capsys.readouterr().out)
    assert values["interrupted"] is True
    assert values["unfinished"] == ["convergence"]
    assert values["command"].endswith("--runs 20 --seeds 40")
    assert cli.main(["reproduce", "paper-b", "--runs", "20", "-o", str(tmp_path)]) == 130
    shown = capsys.readouterr().out
    assert "Table 2" in shown
    assert "not finished: convergence" in shown
    assert cli.main(["reproduce", "paper-b", "--runs", "3", "-o", str(tmp_path)]) == 2
    assert "--runs 3: must be 10 or more" in capsys.readouterr().err
    with pytest.raises(SettingsError, match="--seeds 0"):
        paper_b.reproduce(paper_b.Plan(out=tmp_path, seeds=0), lambda *_: None)


# ----------------------------------------------------------------------------- the replica


def test_the_replica_is_what_the_paper_describes(done: Reproduced[Results]) -> None:
    found = done.results.robot
    assert found is not None
    facts, run = found.facts, found.run
    assert facts.camera_hz == 5
    assert 50 <= facts.gyro_hz <= 200
    assert 20 <= facts.odometer_hz <= 50
    assert facts.sigma_speed <= 0.002
    time, scale, speed = np.array(run.frame_s), np.array(run.scale), np.array(run.speed)
    assert np.ptp(np.array(run.depth_m)[time <= 1.5]) < 1e-9  # it stands for 1.5 s
    reached = {L: time[np.argmax(scale >= L)] - facts.start_s for L in robot.TABLE_3}
    assert 1.5 <= reached[0.042] <= 2.2  # where the paper's filter has just converged
    assert reached[0.23] + facts.start_s < 20
    assert np.nanmin(speed) < -0.1 < 0.1 < np.nanmax(speed)  # forth, and back in reverse
    assert len(found.converged_s) == SEEDS


def test_the_filter_ranges_the_upper_left_corner() -> None:
    found = replica.drive(3, 12.0)
    matrix, corner = found.mission.camera.matrix, found.corner
    seen = np.array([sample.points_px[sample.ids == corner][0] for sample in found.tracks])
    expected = matrix[0, 0] * found.point_m[:, :2] / found.point_m[:, 2:] + matrix[:2, 2]
    assert np.std(seen - expected) == pytest.approx(0.1, rel=0.2)
    others = np.array([sample.points_px[sample.ids > corner].min(axis=0) for sample in found.tracks])
    assert (others >= seen - 0.8).all()  # no other corner is farther up or left
    estimate = replica.ranged(found, robot.WAYS[robot.HERE])
    assert len(estimate.mean) == len(found.frame_s)
    assert estimate.depth_m[0] == pytest.approx(1.5 * found.point_m[0, 2])
    off = estimate.depth_m / found.point_m[:, 2] - 1
    assert abs(off[-1]) < 0.02
    assert (np.abs(1 / found.point_m[:, 2] - estimate.mean[:, 2]) < 4 * estimate.sigma_xi).all()
    np.testing.assert_allclose(1 / estimate.interval_m[:, 0], estimate.mean[:, 2] + 2 * estimate.sigma_xi)
    still = np.flatnonzero(found.way_m == 0)
    assert estimate.sigma_xi[still[-1]] > 0.99 * estimate.sigma_xi[0]  # nothing is learnt at a stop
    np.testing.assert_allclose(estimate.speed[1:], np.diff(found.way_m) / np.diff(found.frame_s), atol=0.03)
    printed = replica.ranged(found, robot.WAYS[robot.PRINTED])
    assert abs(printed.depth_m[-1] / found.point_m[-1, 2] - 1) > 0.5


def test_the_board_tells_the_range() -> None:
    found = replica.drive(3, 12.0)
    depths = replica.board_depths(found)
    np.testing.assert_allclose(depths, found.point_m[:, 2], rtol=4e-3)
    # where the board's other corners are not seen, or the corner itself is not, the range is unknown
    few, without = found.tracks[0], found.tracks[1]
    few = dataclasses.replace(few, ids=few.ids[: found.corner + 3], points_px=few.points_px[: found.corner + 3])
    kept = without.ids != found.corner
    without = dataclasses.replace(without, ids=without.ids[kept], points_px=without.points_px[kept])
    less = replica.board_depths(dataclasses.replace(found, tracks=(few, without, found.tracks[2])))
    np.testing.assert_array_equal(less, [np.nan, np.nan, depths[2]])


def test_a_landmark_without_a_slot_is_unknown() -> None:
    found = replica.drive(3, 1.0)
    steps = [item.step for item in replica.steps_of(found, robot.WAYS[robot.HERE])]
    nobody = replica.Ranged.of(steps, 99)
    assert np.isnan(nobody.mean).all()
    assert nobody.covariance.shape == (len(steps), 3, 3)


def test_the_log_is_that_of_a_replay(done: Reproduced[Results], folder: Path) -> None:
    found = done.results.robot
    assert found is not None
    drive = replica.drive(replica.LOGGED_SEED)
    np.testing.assert_array_equal(found.run.estimate_m, replica.ranged(drive, robot.WAYS[robot.HERE]).depth_m)
    log = robot.log_folder(folder)
    read = replica.Ranged.of(rrd.read_steps(log / "best.rrd", "best", RangeStep), drive.corner)
    np.testing.assert_array_equal(read.depth_m, found.run.estimate_m)
    scenario = Path("sim:paper-b")
    digest = inputs.digest_of(scenarios.open_scenario(scenario), scenario)
    for preset in ("best", "paper-b"):
        written = tomllib.loads((log / f"{preset}.toml").read_text())
        assert written["complete"]
        assert (log / f"{preset}.rrd").is_file()
        assert written["run"]["digest"] == digest
        assert written["settings"]["start_range_m"] == pytest.approx(1.5 * drive.point_m[0, 2])
    assert "`workbench view`" in done.file.read_text()


@pytest.mark.usefixtures("undrawn")
def test_a_lost_log_is_made_again(
    done: Reproduced[Results], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    lost = robot.log_folder(tmp_path) / "paper-b.rrd"
    plan = paper_b.Plan(out=tmp_path, runs=RUNS, seeds=SEEDS)
    (work,) = [work for work in paper_b.works(plan) if work.name == "robot"]
    assert lost in work.files

    def made_again(_: object) -> Robot:
        lost.touch()
        assert done.results.robot is not None
        return done.results.robot

    monkeypatch.setattr(paper_b, "works", lambda _: [dataclasses.replace(work, make=made_again)])
    paper_b.reproduce(plan, lambda *_: None)
    assert lost.stat().st_size  # it was there
    lost.unlink()
    paper_b.reproduce(plan, lambda *_: None)
    assert not lost.stat().st_size


def test_convergence_is_for_good() -> None:
    time = np.arange(5.0)
    assert robot._converged_s(time, np.array([0.5, 0.05, 0.2, 0.05, 0.01])) == 3.0
    assert robot._converged_s(time, np.full(5, 0.01)) == 0.0
    assert math.isinf(robot._converged_s(time, np.array([0.0, 0.0, 0.0, 0.0, np.nan])))


# ------------------------------------------------------------------------------ statements


def made_accuracy(printed: float, coarse: float) -> Accuracy:
    """Table 2 times a factor as printed, and times another one with coarse pixels."""
    time = tuple(mc.TABLE_2)
    rms = np.array(list(mc.TABLE_2.values())) / 100

    def row(reading: str, r: float, factor: float, nees: float) -> dict:
        curves = {"rms": tuple(factor * rms), "bound": tuple(0.9 * factor * rms)}
        return {"reading": reading, "pixel_sigma": r, "nees": nees, "converged_s": 0.3, **curves}

    rows = [row("as-printed", 0.02, printed, 4.3), row("exact", 0.02, 0.7, 3.0), row("exact", 0.5, coarse, 3.0)]
    return Accuracy.model_validate({"time_s": time, "scale": time, "rows": rows})


def test_statements_on_table_2_follow_the_numbers() -> None:
    printed, measured, consistent, real = said.of_table_2(made_accuracy(1.05, 2.0))
    assert [s.upshot for s in (printed, measured, consistent, real)] == ["reached", "reached", "missed", "missed"]
    assert "5.0 %" in printed.numbers
    assert "no filter can" in real.numbers
    printed, *_, real = said.of_table_2(made_accuracy(1.08, 0.9))
    assert (printed.upshot, real.upshot) == ("missed", "reached")
    assert "no filter can" not in real.numbers


def column(median: float, low: float, paper: float = 0.01) -> Robot.Column:
    rest = dict.fromkeys(("high", "rms", "sigma", "reference", "as_good"), 0.1)
    return Robot.Column(scale=0.1, paper=paper, median=median, low=low, **rest)


def test_statements_on_table_3_follow_the_numbers() -> None:
    good, lucky, bad = column(0.009, 0.001), column(0.02, 0.005), column(0.05, 0.02)
    assert said.worst_column([good]).upshot is Upshot.REACHED
    assert said.worst_column([good, lucky]).upshot is Upshot.IN_SCATTER
    assert said.worst_column([good, bad, lucky]).upshot is Upshot.MISSED


def test_statements_on_the_robot_follow_the_numbers(done: Reproduced[Results]) -> None:
    found = done.results.robot
    assert found is not None

    def upshots(**changes: object) -> list[Upshot]:
        return [s.upshot for s in said.of_robot(found.model_copy(update=changes))]

    implied = [row.model_copy(update={"as_good": 0.3}) for row in found.implied]
    assert upshots(implied=implied)[1] is Upshot.REACHED
    assert upshots(implied=[row.model_copy(update={"as_good": 0.01}) for row in implied])[1] is Upshot.MISSED
    assert upshots(converged_s=(1.0, 1.8, 2.5))[2] is Upshot.REACHED
    assert upshots(converged_s=(1.0, 2.4, math.inf))[2] is Upshot.MISSED
    assert upshots(within_one=0.68, within_two=0.95)[3] is Upshot.REACHED
    assert upshots(within_one=0.30, within_two=0.60)[3] is Upshot.MISSED
    assert upshots()[-1] is Upshot.MISSED


def test_statements_on_figures_and_bars_follow_the_numbers(done: Reproduced[Results]) -> None:
    results = done.results
    assert results.convergence is not None
    assert results.consistency is not None
    assert results.scaling is not None
    slower = [row.model_copy(update={"converged_s": row.converged_s + 0.5}) for row in results.convergence.rows]
    slow = list(said.of_figures(results.convergence.model_copy(update={"rows": slower})))
    assert [s.upshot for s in slow[:2]] == ["missed", "missed"]
    rows = [
        row.model_copy(update={"nees": (3.5,) * 51, "ratio": (1.2,) * 51, "diverged": 0.0})
        for row in results.consistency.rows
    ]
    bad = list(said.of_consistency(results.consistency.model_copy(update={"rows": rows})))
    assert [s.upshot for s in bad[1:3]] == ["missed", "missed"]
    assert "1.20 … 1.20" in bad[1].numbers
    exact, *claims = said.of_scaling(results.scaling)
    assert exact.upshot is Upshot.REACHED
    assert [s.upshot for s in claims] == ["missed", "missed"]
    same = [row.model_copy(update={"rms": 0.02}) for row in results.scaling.rows]
    off = results.scaling.model_copy(update={"rows": same, "time": 1e-3})
    assert [s.upshot for s in said.of_scaling(off)] == ["missed", "reached", "reached"]


def test_every_misprint_has_its_row(done: Reproduced[Results]) -> None:
    found = done.results.misprints
    assert found is not None
    assert found.row("right").rms == 1.0
    assert found.row(sim.NO_DT).sigma > 2
    assert found.row(sim.NO_DT).nis < 0.9
    assert found.row("RK4, ω = 0.1 (no misprint)").rms == pytest.approx(1.0, abs=1e-3)
    heads, rows = report.misprints_table(found)
    assert all(len(row) == len(heads) for row in rows)
