"""Paper C's flights: the command on a short flight, statements that follow the numbers, interrupts, resumption."""

import csv
import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from pipelines.semidirect.scoring import Accuracy, MapErrors, Work
from workbench import cli, scenarios
from workbench.reproduce import drawing, paper_c
from workbench.reproduce.flights import flying, pictures, report
from workbench.reproduce.flights import statements as said
from workbench.reproduce.flights.flying import FLIGHTS, Flight, Flown, Result
from workbench.reproduce.flights.methods import ACCURATE, BASELINE, FAST, KLT, METHODS, built, chosen
from workbench.reproduce.flights.results import BARS, Results
from workbench.reproduce.judged import Upshot
from workbench.reproduce.plans import Reproduced
from workbench.settings import SettingsError
from workbench.summary import without_nan

FRAMES = 75
CURVES = ("path_m", "position_m", "attitude_rad", "scale_path_m", "scale")


def saved_small(file: Path, draw: Callable[[], Figure]) -> Path:
    png = file.with_suffix(".png")
    draw().savefig(png, dpi=50)
    return png


@pytest.fixture(scope="module", autouse=True)
def quick() -> Any:
    """Pictures are drawn once, as small PNGs."""
    patch = pytest.MonkeyPatch()
    patch.setattr(drawing, "save", saved_small)
    yield
    patch.undo()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper-c")


def plan(folder: Path, **more: Any) -> paper_c.Plan:
    return paper_c.Plan(out=folder, **({"flights": ("gravel",), "methods": (FAST, KLT), "frames": FRAMES} | more))


@pytest.fixture(scope="module")
def done(folder: Path) -> Reproduced[Results]:
    told: list[tuple[str, int, int]] = []
    found = paper_c.reproduce(plan(folder), lambda *progress: told.append(progress))
    assert told == [("flight-gravel", k + 1, FRAMES) for k in range(FRAMES)]
    return found


# ------------------------------------------------------------------------------ the flights


def test_every_flight_is_a_scenario_like_the_papers() -> None:
    for name in FLIGHTS:
        scenario = scenarios.load(name).scenario
        camera = scenario.camera
        assert camera is not None
        assert (camera.width_px, camera.height_px, camera.focal_px, camera.height_m) == (752, 480, 420, 1.5)
        assert camera.timing.rate_hz == 60
        assert camera.height_m / camera.focal_px >= scenario.ground.metres_per_px  # as fine as the image, or finer
        assert min(scenario.body.roll_rms_rad, scenario.body.pitch_rms_rad, scenario.body.height_rms_m) > 0
        assert scenario.reference is not None
        assert scenario.height is not None
    assert set(FLIGHTS) == {name for name in scenarios.names() if name.startswith("flight-")}


def test_the_flights_are_as_long_and_as_fast_as_they_say() -> None:
    lengths = {"flight-gravel": 24, "flight-slow": 24, "flight-relief": 40, "flight-100m": 101}
    for name, length in lengths.items():
        mission = scenarios.mission(scenarios.load(name, overrides=["ground.size_px=256"]))
        seconds = np.arange(0, mission.motion.duration_s, 1 / 60)
        path = np.linalg.norm(np.diff(mission.motion.at(seconds).position_m[:, :2], axis=0), axis=1)
        assert path.sum() == pytest.approx(length, rel=0.01)
        assert np.median(path) * 60 == pytest.approx(0.4 if name == "flight-slow" else 1.6, rel=0.05)


def test_the_ground_of_a_flight_is_the_one_that_its_height_sensor_feels() -> None:
    mission = scenarios.mission(scenarios.load("flight-relief", overrides=["ground.size_px=256", "frames=60"]))
    truth, ground = flying.truth_of(mission), flying.ground_of(mission)
    x, y, z = truth.position_m.T
    felt = [s.range_m for s in mission.read(["/camera/height"])]  # type: ignore[attr-defined]
    np.testing.assert_allclose(z - ground(x, y), felt, atol=1e-6)
    assert np.ptp(ground(np.linspace(0, 40, 200), np.zeros(200))) > 0.3


# ------------------------------------------------------------------------------ the methods


def test_methods_are_built_with_the_camera_and_their_presets() -> None:
    camera = {"focal_px": 420.0, "height_m": 1.5}
    settings: dict[str, Any] = {method: built(method, camera).settings for method in METHODS}
    assert all(s.focal_px == 420 and s.height_m == 1.5 for s in settings.values())
    assert (settings[FAST].max_features, settings[ACCURATE].max_features) == (120, 200)
    assert (settings[FAST].max_keyframes, settings[ACCURATE].max_keyframes) == (10, 50)


@pytest.mark.parametrize("method", METHODS)
def test_a_setting_that_a_method_does_not_have_is_refused(method: str) -> None:
    with pytest.raises(SettingsError, match="wings"):
        built(method, {"focal_px": 420.0, "height_m": 1.5}, wings=2)


def test_methods_by_name() -> None:
    assert chosen(()) == METHODS
    assert chosen((KLT, FAST, KLT)) == (FAST, KLT)
    for refused in (lambda: chosen(("ptam",)), lambda: built("ptam", {})):
        with pytest.raises(SettingsError, match="no method 'ptam'; there are: fast, accurate, baseline, klt"):
            refused()


# ------------------------------------------------------------------------------ the command


def test_a_short_flight_is_flown_well(done: Reproduced[Results]) -> None:
    (flight,) = done.results.flights
    fast, klt = flight.of(FAST), flight.of(KLT)
    assert fast is not None
    assert klt is not None
    assert fast.accuracy.losses == klt.accuracy.losses == 0
    assert fast.accuracy.accepted > FRAMES / 2
    assert fast.accuracy.ate_share < 0.0005
    assert klt.accuracy.ate_share < 0.01
    assert fast.map_errors.points > 200
    assert fast.map_errors.share < 0.01
    assert klt.map_errors.points == 0
    assert fast.work.median_ms <= fast.work.whole_mean_ms * 2
    assert len(fast.path_m) == fast.accuracy.accepted
    assert fast.path_m[-1] == pytest.approx(flight.path_m)


def test_the_report_tables_and_pictures_are_written(done: Reproduced[Results], folder: Path) -> None:
    text = done.file.read_text()
    for part in ("| flight-gravel | fast |", "| published, 84 m | baseline |", "frames/s", "Sim(3)", "## Versions"):
        assert part in text
    assert "Not finished" not in text
    for name in ("flights", "flight-gravel"):
        assert f"pictures/{name}.png" in text
        assert (folder / "pictures" / f"{name}.png").stat().st_size > 5_000
    rows = list(csv.DictReader((folder / "flights.csv").open()))
    assert [(row["flight"], row["method"]) for row in rows] == [("flight-gravel", FAST), ("flight-gravel", KLT)]
    stored = json.loads((folder / "report.json").read_text())
    assert stored["flights"][0]["ate_share"] == pytest.approx(float(rows[0]["ate_share"]))
    assert stored["flights"][1]["map_outlier_share"] is None


def test_a_finished_flight_is_found_again(
    done: Reproduced[Results], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper_c, "flown", lambda *_, **__: pytest.fail("it was flown again"))
    again = paper_c.reproduce(plan(folder), lambda *_: None)
    assert without_nan(report.values(again.results)) == without_nan(report.values(done.results))


@pytest.mark.parametrize("change", [{"methods": (KLT,)}, {"frames": FRAMES - 1}])
def test_another_plan_is_another_flight(folder: Path, done: Reproduced[Results], change: dict[str, Any]) -> None:
    (before,), (after,) = paper_c.works(plan(folder)), paper_c.works(plan(folder, **change))
    assert Flown.kept(folder, before.identity, before.name) is not None
    assert Flown.kept(folder, after.identity, after.name) is None


def test_an_interrupt_keeps_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(tick: Callable[[], None], *, flight: Flight) -> Flown:
        if flight.name == "flight-grass":
            raise KeyboardInterrupt
        return made_flight(flight.name, fast=1e-4)

    monkeypatch.setattr(paper_c, "flown", stopped)
    broken = paper_c.reproduce(plan(tmp_path, flights=("gravel", "grass", "slow")), lambda *_: None)
    assert broken.interrupted
    assert broken.results.unfinished == ["flight-grass", "flight-slow"]
    assert "**Not finished**: flight-grass, flight-slow" in broken.file.read_text()
    monkeypatch.setattr(paper_c, "flown", lambda tick, *, flight: made_flight(flight.name, fast=2e-4))
    whole = paper_c.reproduce(plan(tmp_path, flights=("gravel", "grass", "slow")), lambda *_: None)
    shares = [flight.results[0].accuracy.ate_share for flight in whole.results.flights]
    assert (whole.interrupted, shares) == (False, [1e-4, 2e-4, 2e-4])


def test_the_command_prints_tables_or_json(
    done: Reproduced[Results], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reproduce", "paper-c", "-o", str(folder), "--flight", "gravel", "--frames", str(FRAMES)]
    words += ["--method", FAST, "--method", KLT]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    assert "flight-gravel" in printed
    assert str(done.file) in printed
    assert cli.main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["flights"][0]["method"] == FAST


@pytest.mark.parametrize(
    ("words", "cure"),
    [
        (["--flight", "moon"], "no flight 'flight-moon'; there are: flight-gravel"),
        (["--method", "ptam"], "no method 'ptam'; there are: fast"),
        (["--frames", "10"], "--frames 10: must be 60 or more"),
    ],
)
def test_what_cannot_be_is_refused(
    words: list[str], cure: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["reproduce", "paper-c", "-o", str(tmp_path / "out"), *words]) == 2
    assert cure in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------- statements


def made_result(method: str, ate_share: float, **more: Any) -> Result:
    accuracy = Accuracy(
        frames=900, accepted=900, first=0, losses=0, lost_frames=0, relocalisations=0, maps=1, path_m=24.0, covered=1.0,
        ate_share=ate_share, scale_drift=0.001,
    )  # fmt: skip
    points = MapErrors(points=1000, outliers=2, judged=900, misplaced=1)
    work = Work(median_ms=2.0, most_ms=3.0, mean_ms=2.1, whole_mean_ms=4.0)
    curves: dict[str, Any] = dict.fromkeys(
        ("path_m", "position_m", "attitude_rad", "scale_path_m", "scale"), (1.0, 2.0)
    )
    changed = {name: value for name, value in more.items() if name in Accuracy.__dataclass_fields__}
    others = {name: value for name, value in more.items() if name not in changed}
    parts = {"map_errors": points, "work": work, **curves, **others}
    return Result(method=method, accuracy=dataclasses.replace(accuracy, **changed), **parts)


def made_flight(name: str, *results: Result, **shares: float) -> Flown:
    made = [*results, *(made_result(method, share) for method, share in shares.items())]
    return Flown(
        flight=name, about="made", frames=900, seconds=15.0, path_m=24.0, height_m=1.5, results=tuple(made)
    )  # fmt: skip


def upshots(*flights: Flown) -> dict[str, Upshot]:
    results = Results(command="", methods=METHODS, flights=flights)
    return {statement.claim: statement.upshot for statement in said.statements(results)}


MORE = "fast is more accurate than the baseline on every flight"


def test_the_more_accurate_one_wins() -> None:
    assert upshots(made_flight("flight-gravel", fast=3e-4, baseline=4e-4))[MORE] == Upshot.REACHED
    assert upshots(made_flight("flight-gravel", fast=5e-4, baseline=4e-4))[MORE] == Upshot.MISSED


def test_one_that_flew_little_of_the_way_is_not_the_more_accurate() -> None:
    short = {"covered": 0.2, "losses": 1, "lost_frames": 700}
    lost_baseline = made_flight("flight-grass", made_result(BASELINE, 1e-5, **short), fast=3e-4)
    assert upshots(lost_baseline)[MORE] == Upshot.REACHED
    assert upshots(made_flight("flight-grass", made_result(FAST, 1e-5, **short), baseline=3e-4))[MORE] == Upshot.MISSED
    never = made_flight("flight-grass", made_result(BASELINE, math.nan, accepted=0, covered=0.0), fast=3e-4)
    assert upshots(never)[MORE] == Upshot.REACHED
    (told,) = [s for s in said.statements(Results(command="", methods=METHODS, flights=[never])) if s.claim == MORE]
    assert "(never started)" in told.numbers


@pytest.mark.parametrize(("theirs", "upshot"), [(19, Upshot.MISSED), (20, Upshot.REACHED)])
def test_ten_times_fewer_outliers(theirs: int, upshot: Upshot) -> None:
    points = MapErrors(points=5000, outliers=theirs, judged=0, misplaced=0)
    flight = made_flight("flight-slow", made_result(BASELINE, 1e-3, map_errors=points), fast=1e-4)
    claim = "fast: ten times fewer outliers in the map than the baseline on every flight"
    assert upshots(flight)[claim] == upshot


def test_bars_hold_for_error_scale_and_losses() -> None:
    def of(share: float, **more: Any) -> Upshot:
        found = upshots(made_flight("flight-100m", made_result(ACCURATE, share, **more)))
        return next(upshot for claim, upshot in found.items() if claim.startswith("flight-100m, accurate"))

    bar = BARS["flight-100m", ACCURATE]
    assert of(0.99 * bar.ate_share) == Upshot.REACHED
    assert of(1.01 * bar.ate_share) == Upshot.MISSED
    assert of(0.5 * bar.ate_share, scale_drift=-0.003) == Upshot.MISSED
    assert of(0.5 * bar.ate_share, losses=1, lost_frames=5) == Upshot.MISSED
    assert of(math.nan) == Upshot.MISSED


def test_losses_and_wrong_motions_are_told() -> None:
    claims = "Neither mode is lost on any flight", "No mode stands by a wrong motion for more than 30 frames"
    good = upshots(made_flight("flight-fractal", fast=1e-4, accurate=1e-4, baseline=1e-4))
    assert [good[claim] for claim in claims] == [Upshot.REACHED] * 2
    bad = made_result(ACCURATE, 1e-4, losses=2, lost_frames=9, longest_unnoticed=31)
    found = upshots(made_flight("flight-fractal", bad))
    assert [found[claim] for claim in claims] == [Upshot.MISSED] * 2
    only_theirs = made_flight("flight-fractal", made_result(BASELINE, 1, losses=3, longest_unnoticed=99), fast=1e-4)
    assert [upshots(only_theirs)[claim] for claim in claims] == [Upshot.REACHED] * 2


@pytest.mark.parametrize(("ms", "upshot"), [(6.5, Upshot.MISSED), (6.7, Upshot.REACHED)])
def test_the_ratio_of_frame_rates_is_the_papers(ms: float, upshot: Upshot) -> None:
    work = Work(median_ms=ms, most_ms=9.0, mean_ms=ms, whole_mean_ms=ms)
    flight = made_flight("flight-slow", made_result(BASELINE, 1e-3, work=work), fast=1e-4)
    assert upshots(flight)["The fast mode's tracking makes 3.3 times the baseline's frames/s"] == upshot


def test_pictures_of_methods_that_are_missing_or_never_started() -> None:
    never = made_result(BASELINE, math.nan, accepted=0)
    empty = never.model_copy(update=dict.fromkeys(CURVES, ()))
    flights = [made_flight("flight-slow", empty, fast=1e-4), made_flight("flight-grass", fast=1e-4, klt=1e-3)]
    figure = pictures.bars(flights)
    assert len(figure.axes[0].containers) == 3
    assert len(figure.axes[1].containers) == 2  # the peer has no map
    assert len(pictures.along(flights[0]).axes[0].lines) == 2
