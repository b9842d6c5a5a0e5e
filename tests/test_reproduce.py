"""Paper A's experiment: measures against closed forms, the command on a few frames, statements that follow numbers."""

import dataclasses
import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import Correction
from pipelines.replay import grey_sample
from pipelines.simulation import trajectories as way
from pipelines.simulation.families import ground
from pipelines.simulation.mission import nadir_camera, nadir_mission
from readers.streams import ImageSample, RecordingError, StreamKind
from workbench import cli
from workbench.reproduce import conditions, correction, drawing, estimates, experiment, limits, matrix, paper_a, report
from workbench.reproduce import pictures as drawn
from workbench.reproduce import statements as said
from workbench.reproduce.judged import Upshot
from workbench.reproduce.ledger import Ledger
from workbench.reproduce.measures import Accuracy, accuracy, block_ratio, relative_rms
from workbench.reproduce.plans import Reproduced
from workbench.reproduce.report import Results
from workbench.reproduce.tasks import carried_out
from workbench.settings import SettingsError

W = conditions.METRES_PER_PX


@pytest.fixture(scope="module", autouse=True)
def small_ground() -> None:
    """Gravel of a quarter of the side, which is made at once, and a camera of half the side over it."""
    patch = pytest.MonkeyPatch()
    patch.setattr(conditions, "nadir_mission", partial(nadir_mission, camera=nadir_camera(256, 256)))
    surface = ground("gravel", size_px=256)
    for module in (conditions, limits, paper_a):
        patch.setattr(module, "surface_of", lambda name, seed: surface)
    yield
    patch.undo()


# -------------------------------------------------------------------------------- measures


def test_relative_rms_of_a_wrong_scale_is_the_scale() -> None:
    truth = np.column_stack([3 + np.linspace(0, 2, 50) ** 2, np.linspace(1, -1, 50)])
    error = 0.07 * (truth - truth[0])
    assert relative_rms(error, truth) == pytest.approx(0.07)
    assert relative_rms(error[:, 1], truth[:, 1]) == pytest.approx(0.07)
    assert math.isnan(relative_rms(np.ones(3), np.full(3, 5.0)))


def test_block_ratio_of_constant_white_and_alternating_errors() -> None:
    white = np.random.default_rng(0).standard_normal(200_000)
    assert block_ratio(white) == pytest.approx(1.0, abs=0.03)
    sine = np.sin(2 * np.pi * np.arange(400) / 400)  # sums of 50 are those of an integral
    sums = [200 / np.pi * (np.cos(np.pi * k / 4) - np.cos(np.pi * (k + 1) / 4)) for k in range(8)]
    expected = np.sqrt(np.mean(np.square(sums))) / (np.sqrt(0.5) * np.sqrt(50)) / 1.0
    assert block_ratio(sine) == pytest.approx(expected, rel=0.01)
    assert block_ratio(np.tile([1.0, -1.0], 500)) == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(block_ratio(np.ones(49)))


def test_accuracy_of_a_known_error() -> None:
    n = 101
    truth = np.column_stack([np.linspace(0, 4, n), np.linspace(1, 3, n), np.full(n, 0.2)])
    pose = truth + np.array([0.0, 0.0, 0.01])
    pose[:, 0] += 0.03 * (truth[:, 0] - truth[0, 0])
    pose[:, 1] -= 0.05 * (truth[:, 1] - truth[0, 1])
    shift_error = np.tile([0.3, 0.4], (n - 1, 1))
    shift_error[7] = 0.9, 0.9
    shift_error[9] = np.nan
    found = accuracy(pose, truth, shift_error, np.full(n - 1, 2e-3))
    assert (found.relative_x, found.relative_y) == pytest.approx((0.03, 0.05))
    assert found.relative_euclid == pytest.approx(math.sqrt((0.03**2 * 16 + 0.05**2 * 4) / 20))
    assert found.relative_mean == pytest.approx(0.04)
    assert (found.end_x, found.end_y) == pytest.approx((0.03, 0.05))
    assert found.end_m == pytest.approx(math.hypot(0.12, 0.1))
    assert found.end_path == pytest.approx(found.end_m / math.hypot(4, 2))
    assert (found.failures, found.failed) == (2, 0.02)
    assert found.failed_turn_rad == pytest.approx(4e-3)
    assert found.shift_px == pytest.approx(math.sqrt((0.09 + 0.16) / 2))
    assert found.turn_rad == pytest.approx(2e-3)
    assert (found.yaw_rad, found.heading_rad) == pytest.approx((0.01, 0.01))


# ------------------------------------------------------------------------------ conditions


def test_fluctuation_has_its_size_and_correlation() -> None:
    x = conditions.fluctuation(400_000, 0.01, np.random.default_rng(1), tau_frames=20)
    assert x.std() == pytest.approx(0.01, rel=0.03)
    assert np.mean(x[20:] * x[:-20]) / x.var() == pytest.approx(math.exp(-1), abs=0.03)
    starts = [conditions.fluctuation(1, 1.0, np.random.default_rng(k))[0] for k in range(2000)]
    assert np.std(starts) == pytest.approx(1.0, abs=0.06)


def test_conditions_disturb_what_they_say_and_nothing_else() -> None:
    drives = {c.name: conditions.experiment_drive("gravel", c, 0, 60) for c in conditions.CONDITIONS}
    clean = drives["C0"].truth
    np.testing.assert_array_equal(drives["C2"].truth, clean)
    np.testing.assert_allclose(drives["C3"].truth, way.ahead(clean, 0.10), atol=1e-15)
    frames = {name: next(images(drive)).grey() for name, drive in drives.items()}
    assert not np.array_equal(frames["C0"], frames["C1"])
    assert not np.array_equal(frames["C0"], frames["C2"])
    np.testing.assert_array_equal(frames["C0"], next(images(conditions.experiment_drive(
        "gravel", conditions.CONDITIONS[0], 0, 60))).grey())  # fmt: skip


def images(drive: conditions.Drive):
    (info,) = drive.recording.of_kind(StreamKind.IMAGE)
    for sample in drive.recording.read([info.name]):
        assert isinstance(sample, ImageSample)
        yield sample


def test_the_drive_is_that_of_the_paper() -> None:
    poses = way.drive(
        way.figure_eight(start_rad=conditions.START_RAD),
        conditions.FRAMES,
        speed_mps=conditions.SPEED_MPS,
        rng=np.random.default_rng(0),
    )
    assert pytest.approx(35.18, abs=0.02) == (conditions.FRAMES - 1) / conditions.RATE_HZ
    assert pytest.approx(0.0782, abs=5e-5) == 100 * W
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() == pytest.approx(17.9, abs=0.4)


# ------------------------------------------------------------------------------- estimates


@pytest.mark.parametrize("reading", ["none", "speed prior", "as printed"])
def test_dead_reckoning_is_the_estimators_own(reading: str) -> None:
    drive = conditions.experiment_drive("gravel", conditions.CONDITIONS[0], 0, 90)
    base = estimates.settings_of("paper-a", drive.truth[0])
    chosen = estimates.variants(base)[reading].model_copy(update={"correction_max_relative": 5.0})
    odometry = CorrelationOdometry(chosen)
    state, steps = odometry.start(), []
    for sample in images(drive):
        state, step = odometry.step(state, grey_sample(sample))
        steps.append(step)
    shift = np.array([s.frame_shift_px for s in steps[1:]])
    turn = np.array([s.delta_heading_rad for s in steps[1:]])
    dt_s = np.array([s.dt_s for s in steps[1:]])
    poses = np.array([s.pose for s in steps])
    again = estimates.dead_reckoned(chosen, shift, turn, dt_s)
    np.testing.assert_allclose(again[:, :2], poses[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.cos(again[:, 2]), np.cos(poses[:, 2]), atol=1e-12)
    assert (chosen.correction is Correction.OFF) == bool(np.all(steps[-1].correction_total_m == 0))


def test_frames_are_rendered_once(tmp_path: Path) -> None:
    drive = conditions.experiment_drive("gravel", conditions.CONDITIONS[0], 0, 4)
    rendered = []

    class Counted(type(drive.recording)):
        def read(self, *args):
            for sample in super().read(*args):
                if isinstance(sample, ImageSample):
                    data = sample.payload
                    sample = dataclasses.replace(sample, payload=lambda d=data: rendered.append(1) or d())
                yield sample

    expected = [s.grey().copy() for s in images(drive)]
    inner = drive.recording
    inner.__class__ = Counted
    once = estimates.RenderedOnce(inner, tmp_path / "frames", "that one")
    for _ in range(2):
        lent = once.lent()
        with lent:
            got = [s.grey() for s in images(conditions.Drive(lent, drive.truth))]
        np.testing.assert_array_equal(got, expected)
    assert len(rendered) == 4
    assert once.identity == "that one"
    assert (tmp_path / "frames").exists()
    once.close()
    assert not (tmp_path / "frames").exists()


# ------------------------------------------------------------------------------ correction


def test_correction_without_images_helps_and_harms_as_the_study_measured() -> None:
    found = {(e.truth, e.reading): e for e in correction.effects(seeds=1)}
    rms = {key: 100 * e.rms_m for key, e in found.items()}
    assert rms["constant speed, W exact", "none"] < 1.5
    # a scale that is 5 % too large: everything is 5 % further from the start
    lengths = np.full(conditions.FRAMES - 1, conditions.SPEED_MPS / conditions.RATE_HZ)
    way_m = way.follow(way.figure_eight(start_rad=conditions.START_RAD), lengths)[:, :2]
    wrong = 100 * 0.05 * float(np.sqrt(np.mean(np.sum((way_m - way_m[0]) ** 2, axis=1))))
    assert rms["constant speed, W +5 %", "none"] == pytest.approx(wrong, rel=0.05)
    assert wrong == pytest.approx(16.1, rel=0.05)  # the study's, which tells where its eight begins
    assert rms["constant speed, W +5 %", "toward nominal"] < 1.5
    # (21) as printed, par 25 cm: 25 · 0.05/1.05 cm more every 25 frames, which is 2.1 times the error
    doubled = wrong * (1 + 25 * 0.05 / 1.05 / (25 * 100 * conditions.SPEED_MPS / conditions.RATE_HZ * 0.05))
    assert rms["constant speed, W +5 %", "as printed, par +25 cm"] == pytest.approx(doubled, rel=0.1)
    assert rms["speed jitter 10 %, W exact", "none"] < 1.5
    assert rms["speed jitter 10 %, W exact", "toward nominal"] > 4
    assert rms["jitter 10 % and a start within 40 frames", "as printed, par +25 cm"] > 4
    helped, harmed = said.helped_and_harmed(list(found.values()), "constant speed, W +5 %")
    assert "toward nominal" in helped
    assert "as printed, par +25 cm" in harmed
    upshots = [
        s.upshot for s in (said.correction_helps(list(found.values())), said.correction_harms(list(found.values())))
    ]
    assert upshots == [Upshot.REACHED] * 2


# ------------------------------------------------------------------------------ statements


def made_up(**changes: float) -> Accuracy:
    values = {field.name: 0.001 for field in dataclasses.fields(Accuracy)} | {"failures": 0, "frames": 100}
    return Accuracy(**(values | changes))


def runs_of(paper: Accuracy, best: Accuracy, prior: Accuracy | None = None) -> dict[str, Accuracy]:
    others = dict.fromkeys((experiment.PRIOR, experiment.PRINTED), prior or paper)
    return {experiment.PAPER: paper, experiment.EXACT: paper, experiment.BEST: best, **others}


def test_statements_follow_the_numbers() -> None:
    good = runs_of(made_up(relative_euclid=0.05), made_up(relative_euclid=0.001))
    bad = runs_of(made_up(relative_euclid=0.2, relative_y=0.3, failures=3), made_up(relative_euclid=0.1))
    (relative, end, better, *_) = said.statements({"C0": [good]}, [])
    assert [s.upshot for s in (relative, end, better)] == [Upshot.REACHED] * 3
    assert "50 times" in better.numbers
    (relative, end, better, corrected, failures) = said.statements({"C0": [bad]}, [])
    assert relative.upshot is Upshot.MISSED
    assert "Y and Euclid above" in relative.numbers
    assert better.upshot is Upshot.MISSED
    assert corrected.upshot is Upshot.MISSED
    assert failures.upshot is Upshot.MISSED
    assert "paper-a: 3 of 99" in failures.numbers
    both = said.relative_rms_of("C3", [bad, good, bad])
    assert both.upshot is Upshot.IN_SCATTER
    assert said.correction_of("C4", [runs_of(made_up(rms_m=0.1), made_up(), made_up(rms_m=0.05))]).upshot == "reached"
    far = runs_of(made_up(), made_up(), made_up(end_x=0.5))
    assert said.end_point_of("C4", [far]).upshot == "reached"  # without correction it is near enough
    assert said.end_point_of("C4", [runs_of(made_up(end_y=0.05), made_up())]).upshot == "missed"


def test_the_cause_is_told_from_the_measurements() -> None:
    lost = runs_of(made_up(relative_euclid=0.2), made_up())
    lost[experiment.EXACT] = made_up(relative_euclid=0.01)
    assert "lateral" in said.cause([lost])
    biased = made_up(block_ratio=3.0, failures=1, failed_turn_rad=0.01, heading_rad=0.06)
    assert "3.0 times" in said.cause([runs_of(biased, made_up())])
    false = made_up(failures=2, failed_turn_rad=0.07, heading_rad=0.06)
    assert "false peaks (2) turn the heading by 4.0°" in said.cause([runs_of(false, made_up())])


# --------------------------------------------------------------------------- ledger, tasks


def test_ledger_goes_on_after_a_torn_line(tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    rows = [{"name": "a", "size": 2.0, "value": 0.1}, {"name": "b", "size": 2, "value": 0.2}]
    Ledger(file, ("name", "size"), ("value",)).add(rows)
    file.write_text(file.read_text() + "c,2,0.", encoding="utf-8")
    again = Ledger(file, ("name", "size"), ("value",))
    assert {"name": "a", "size": 2} in again
    assert {"name": "c", "size": 2} not in again
    again.add([{"name": "c", "size": 2, "value": 0.3}])
    assert file.read_text() == "name,size,value\na,2,0.1\nb,2,0.2\nc,2,0.3\n"
    with pytest.raises(RecordingError, match="another form"):
        Ledger(file, ("name",), ("value",))


def double(tick, number: int) -> int:
    tick()
    return 2 * number


class Doubling:
    def __init__(self, number: int) -> None:
        self.number = number

    def __call__(self, tick) -> int:
        return double(tick, self.number)


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_are_carried_out_and_counted(jobs: int) -> None:
    ticks: list[int] = []
    found = sorted(carried_out([Doubling(k) for k in range(4)], jobs=jobs, on_tick=ticks.append))
    assert found == [0, 2, 4, 6]
    assert ticks[-1] <= 4
    assert jobs == 2 or ticks == [1, 2, 3, 4]


# ---------------------------------------------------------------------- the command, in small


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, small_ground: None) -> Path:
    return tmp_path_factory.mktemp("paper-a")


@pytest.fixture(scope="module")
def done(folder: Path) -> Reproduced[Results]:
    return paper_a.reproduce(paper_a.Plan(out=folder, frames=60, jobs=1), lambda *_: None)


def test_the_command_writes_report_tables_pictures_and_logs(done: Reproduced[Results], folder: Path) -> None:
    assert not done.interrupted
    text = (folder / "report.md").read_text()
    for part in (
        "paper A | printed | 0.0647 | 0.0491 | 0.0569",
        "fig5-C0-seed0.png",
        "fig6-C4-seed0.png",
        "**reached**",
    ):
        assert part in text
    values = json.loads((folder / "report.json").read_text())
    assert len(values["experiment"]) == 5 * 5
    assert len(values["correction"]) == 6 * 5
    for name in ("fig5-C0-seed0", "fig6-C0-seed0", "fig5-C4-seed0", "fig6-C4-seed0", "correction"):
        assert (folder / "pictures" / f"{name}.png").stat().st_size > 10_000
    for condition in ("C0", "C4"):
        logs = {file.name for file in (folder / f"log-{condition}-seed0").iterdir()}
        assert {"sensors.rrd", "paper-a.rrd", "best.rrd", "paper-a.toml", "best.toml"} <= logs
    assert not list(folder.glob("*.frames"))


def test_what_is_logged_is_what_is_judged(done: Reproduced[Results], folder: Path) -> None:
    run = next(r for r in done.results.runs if r.cell.condition.name == "C4")
    drive = conditions.experiment_drive("gravel", run.cell.condition, 0, 60)
    direct = estimates.estimates(drive.recording, run.cell.settings(drive.truth[0]))
    for preset in ("paper-a", "best"):
        np.testing.assert_allclose(run.seen[preset].pose, direct[preset].pose, atol=1e-9)
        last = (folder / "log-C4-seed0" / f"{preset}.tum").read_text().splitlines()[-1].split()
        assert [float(x) for x in last[1:3]] == pytest.approx(run.poses[preset][-1, :2].tolist(), abs=1e-8)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without drawing their pictures again."""
    monkeypatch.setattr(drawing, "save", lambda file, draw: file.with_suffix(".png"))


@pytest.mark.usefixtures("undrawn")
def test_finished_parts_are_found_again(done: Reproduced[Results], folder: Path) -> None:
    told: list[tuple[str, int, int]] = []
    again = paper_a.reproduce(paper_a.Plan(out=folder, frames=60, jobs=1), lambda *args: told.append(args))
    assert told == []
    assert report.values(again.results) == report.values(done.results)


def test_the_numbers_are_those_of_the_settings(done: Reproduced[Results], folder: Path) -> None:
    run = done.results.runs[0]
    larger = dataclasses.replace(run.cell, overrides=("fragment_side_px=21",))
    assert experiment.kept(larger, folder) is None
    other = experiment.computed(lambda: None, cell=larger, folder=folder / "pictures", log=False)
    assert other.accuracies[experiment.PAPER].shift_px < run.accuracies[experiment.PAPER].shift_px
    for ours, same in zip(other.seen[experiment.BEST], run.seen[experiment.BEST], strict=True):
        np.testing.assert_allclose(ours, same, atol=1e-9)  # a logged run starts at the reference's quaternion
    (folder / "pictures" / f"{larger.name}.npz").write_bytes(b"PK torn")
    assert experiment.kept(larger, folder / "pictures") is None


@pytest.mark.usefixtures("undrawn")
def test_an_interrupt_leaves_the_finished_parts(tmp_path: Path) -> None:
    calls = 0

    def press(*_: object) -> None:
        nonlocal calls
        calls += 1
        if calls == 2 * 60 + 30:  # in the midst of the second drive
            raise KeyboardInterrupt

    plan = paper_a.Plan(out=tmp_path, frames=60, jobs=1)
    stopped = paper_a.reproduce(plan, press)
    assert stopped.interrupted
    assert [run.cell.condition.name for run in stopped.results.runs] == ["C0"]
    assert "experiment (4 of 5 parts are missing)" in stopped.results.unfinished
    assert "Not finished" in stopped.file.read_text()
    assert not list(tmp_path.glob("*.frames"))


def test_matrix_is_filled_once_and_goes_on(tmp_path: Path) -> None:
    wanted = matrix.places(["gravel"], speeds_kmh=(2.0,), trajectories=("line", "circle"), frames=20)
    results = matrix.ledger(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        results.fill(wanted, jobs=1, on_tick=lambda done: stop_at(done, 30))
    assert results.missing_of(wanted) == wanted[1:]
    results = matrix.ledger(tmp_path)
    ticks: list[int] = []
    results.fill(wanted, jobs=1, on_tick=ticks.append)
    assert len(ticks) == 20
    rows = list(matrix.rows_of(wanted, results))
    assert [(r["trajectory"], r["preset"]) for r in rows] == [
        ("line", "paper-a"), ("line", "best"), ("circle", "paper-a"), ("circle", "best"),
    ]  # fmt: skip
    assert all(float(r["end_path"]) < 0.02 and r["failures"] == "0" for r in rows)
    heads, lines = report.matrix_table(rows)
    assert len(lines) == 1
    assert len(lines[0]) == len(heads)
    changed = [dataclasses.replace(place, overrides=("fragment_side_px=21",)) for place in wanted]
    assert results.missing_of(changed) == changed
    assert drawing.save(tmp_path / "matrix", lambda: drawn.matrix(rows, ["gravel"])).stat().st_size > 10_000


def stop_at(done: int, last: int) -> None:
    if done == last:
        raise KeyboardInterrupt


def test_limits_count_false_peaks(tmp_path: Path) -> None:
    easy = limits.Case(surface="gravel", samples=24, noise_grey=0.0, rotation_deg=0.0)
    hard = limits.Case(surface="gravel", samples=24, noise_grey=40.0)
    results = limits.ledger(tmp_path)
    results.fill([easy, hard], jobs=1, on_tick=lambda _: None)
    assert set(limits.false_rates(easy, results)) == set(limits.SIDES_PX)
    assert max(limits.false_rates(easy, results).values()) == 0
    assert limits.smallest_side(limits.false_rates(easy, results)) == 5
    rates = limits.false_rates(hard, results)
    assert rates[5] > 0.7
    assert rates[5] > rates[31]
    assert limits.ledger(tmp_path).missing_of([easy, hard]) == []
    assert limits.smallest_side({5: 0.5, 9: 0.01, 21: 0.0}) == 9
    assert limits.smallest_side({5: 0.5, 9: 0.02}) is None


def test_every_case_of_the_limits_is_in_a_table_once() -> None:
    cases = limits.cases(["gravel", "mud"], samples=12)
    rates = {case: dict.fromkeys(limits.SIDES_PX, 0.0) for case in cases}
    tables = report.limits_tables(rates)
    counts = {name: len(rows) for name, (_, rows) in tables.items()}
    assert list(counts.values()) == [
        2 * len(limits.NOISES_GREY),
        2 * len(limits.RADII_PX),
        2 * len(limits.ROTATIONS_DEG),
    ]
    assert len(set(cases)) == len(cases) == sum(counts.values()) - 2 * 2


def test_pictures_are_the_same_for_the_same_numbers(done: Reproduced[Results], tmp_path: Path) -> None:
    run = done.results.runs[0]
    for name in ("one", "two"):
        drawing.save(tmp_path / name, lambda: drawn.errors(run))
    for suffix in ("png", "svg"):
        assert (tmp_path / f"one.{suffix}").read_bytes() == (tmp_path / f"two.{suffix}").read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_cli_prints_tables_or_json(done: Reproduced[Results], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["reproduce", "paper-a", "-o", str(folder), "--frames", "60", "--jobs", "1"]
    assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert "paper A    printed" in out
    assert "reached: C0: best is at least 10 times better" in out
    assert cli.main([*command, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["folder"] == str(folder)
    assert values["experiment"] == json.loads((folder / "report.json").read_text())["experiment"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "10"], "--frames 10: must be 60 or more"),
        (["--jobs", "0"], "--jobs 0: must be 1 or more"),
        (["--set", "no_such=1"], "unknown setting 'no_such'"),
    ],
)
def test_refusals(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["reproduce", "paper-a", "-o", str(tmp_path / "out"), *arguments]) == cli.REFUSED
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_unknown_surface_is_refused() -> None:
    with pytest.raises(SettingsError, match="neither a picture nor one of the surfaces gravel"):
        ORIGINAL_SURFACE_OF("lawn", 0)


ORIGINAL_SURFACE_OF = conditions.surface_of
