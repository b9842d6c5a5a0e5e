"""The commands from end to end, with toy parts: output, files, errors of one line, exit status, interrupts."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import readers.clock
import workbench.cli
import workbench.opening
import workbench.session
import workbench.settings
from readers.streams import Fact, StreamKind, WorkbenchError
from tests import toy_session
from tests.toy_session import START, TextLog, ToyMission, ToyRun, toy_rows
from tests.toys import image
from workbench import manifest
from workbench.cli import files_of, main, moment, shown, table, view_command
from workbench.inputs import digest, parse_time

ROOT = Path(__file__).parents[1]
SECOND = 1_000_000_000


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The toys in place of readers, writers and estimators; a folder to work in."""
    monkeypatch.setattr(workbench.opening, "open_any", toy_session.open_toy)
    monkeypatch.setattr(workbench.session, "rerun_writers", lambda: toy_session.WRITERS)
    monkeypatch.setattr(workbench.settings, "BUILT_IN", {"toy": lambda: toy_session.WALKER})
    monkeypatch.setattr(TextLog, "made", [])
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert all(log.closed for log in TextLog.made)


@dataclass
class Said:
    status: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        values: dict[str, Any] = json.loads(self.out)
        return values

    @property
    def error(self) -> str:
        """The one line of an error."""
        assert self.status == 2
        assert self.out == ""
        assert self.err.startswith("error: ")
        assert self.err.count("\n") == 1
        return self.err


@dataclass
class Shell:
    capture: pytest.CaptureFixture[str]

    def __call__(self, *words: object) -> Said:
        status = main([str(word) for word in words])
        captured = self.capture.readouterr()
        return Said(status, captured.out, captured.err)

    def replay(self, name: str = "walk-camera.log", *words: object) -> Said:
        Path(name).touch()
        return self("replay", name, "-e", "toy", *words)


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(capsys)


def toml(path: str) -> dict[str, Any]:
    return tomllib.loads(Path(path).read_text())


def lines(path: str, word: str) -> list[list[str]]:
    return [line.split() for line in Path(path).read_text().splitlines() if line.split()[0] == word]


# --------------------------------------------------------------------------- the run folder


def test_a_replay_leaves_a_run_folder_and_a_summary(toys: Path, shell: Shell) -> None:
    said = shell.replay()
    assert said.status == 0
    folder = toys / "results" / "walk-camera"
    assert sorted(p.name for p in folder.iterdir()) == [
        "best.checkpoints",
        "best.rrd",
        "best.sha256",
        "best.toml",
        "best.tum",
        "sensors.rrd",
        "sensors.toml",
    ]
    assert len(lines("results/walk-camera/best.rrd", "step")) == 40
    assert len(lines("results/walk-camera/sensors.rrd", "image")) == 40
    for part in (
        "40 in 3.900 s of /camera",
        "OK 39",
        "path length  3.9 m",
        "drift        0",
        "APE",
        "RPE",
        "workbench view",
    ):
        assert part in said.out, part
    run = toml("results/walk-camera/best.toml")
    assert run["complete"] is True
    assert run["interrupted"] is False
    assert run["settings"]["focal_px"] == 200.0
    assert run["summary"]["frames"] == 40
    assert run["run"]["digest"] == digest(Path("walk-camera.log"))
    assert {"python", "numpy", "rerun-sdk"} <= set(run["versions"])


def test_json_is_one_object_on_stdout(toys: Path, shell: Shell) -> None:
    said = shell.replay("walk-camera.log", "--json", "--reference", "none")
    values = said.json
    assert said.status == 0
    assert (values["frames"], values["unit"], values["evaluation"]) == (40, "m", None)
    assert values["path_length"] == pytest.approx(3.9)
    assert values["verdicts"] == {"OK": 39, "FIRST_FRAME": 1}
    assert all(Path(file).is_file() for file in values["files"])


def test_numbers_that_are_unknown_are_null_in_json(toys: Path, shell: Shell) -> None:
    said = shell.replay("walk-camera.log", "--json", "--stride", "100")
    assert said.json["median_dt_s"] is None
    assert "not compared: 1 of 1 poses" in said.json["reference"]


def test_the_trajectory_is_a_tum_file_with_exact_times(toys: Path, shell: Shell) -> None:
    shell.replay()
    rows = Path("results/walk-camera/best.tum").read_text().split("\n")
    assert rows[3].split()[0] == "1700000000.300000000"
    table_ = np.loadtxt("results/walk-camera/best.tum")
    assert table_.shape == (40, 8)
    np.testing.assert_allclose(table_[:, 1], np.arange(40) / 10, atol=1e-8)
    np.testing.assert_allclose(np.hypot(table_[:, 6], table_[:, 7]), 1)


def test_the_same_replay_gives_the_same_files(toys: Path, shell: Shell) -> None:
    shell.replay("walk-camera.log", "-o", "a")
    shell.replay("walk-camera.log", "-o", "b")
    for name in ("best.rrd", "best.tum", "best.toml", "sensors.rrd", "sensors.toml"):
        assert Path("a", name).read_bytes() == Path("b", name).read_bytes()


def test_all_files_of_a_mission_share_one_id_that_its_content_decides(toys: Path, shell: Shell) -> None:
    shell.replay()
    shell.replay("walk-camera.log", "--preset", "slow", "-o", "other")
    ids = {log.options["recording_id"] for log in TextLog.made}
    assert len(TextLog.made) == 4
    assert ids == {digest(Path("walk-camera.log"))[:32]}
    Path("walk-camera.log").write_text("more")
    shell.replay("walk-camera.log", "-o", "third")
    assert TextLog.made[-1].options["recording_id"] not in ids


def test_the_sensors_are_written_once_per_mission_and_window(toys: Path, shell: Shell) -> None:
    def sensor_files(*words: str) -> int:
        before = len(TextLog.made)
        assert shell.replay("walk-camera.log", *words).status == 0
        return sum(type(log).__name__ == "ToySensors" for log in TextLog.made[before:])

    assert sensor_files() == 1
    assert sensor_files("--preset", "slow") == 0
    assert sensor_files("--stride", "2") == 1
    assert sensor_files("--stride", "2") == 0
    assert sensor_files() == 1
    Path("results/walk-camera/sensors.rrd").unlink()
    assert sensor_files() == 1
    Path("walk-camera.log").write_text("other content")
    assert sensor_files() == 1


def test_a_run_keeps_the_name_it_is_given(toys: Path, shell: Shell) -> None:
    shell.replay("walk-camera.log", "--name", "trial_2")
    assert TextLog.made[-1].options["run"] == "trial_2"
    assert Path("results/walk-camera/trial_2.toml").is_file()
    for bad in ("../x", "sensors", "a b", ""):
        if bad:
            assert "name of a run" in shell.replay("walk-camera.log", "--name", bad).error


def test_a_run_can_be_repeated_from_its_toml(toys: Path, shell: Shell) -> None:
    shell.replay("walk-camera.log", "--set", "speed_px=7", "-o", "a")
    shell.replay("walk-camera.log", "--settings", "a/best.toml", "-o", "b")
    assert toml("a/best.toml")["settings"] == toml("b/best.toml")["settings"]
    assert Path("a/best.tum").read_bytes() == Path("b/best.tum").read_bytes()


# --------------------------------------------------------------------- windows and streams


@pytest.mark.parametrize(
    ("words", "frames"),
    [
        (["--from", "1", "--to", "2"], range(10, 20)),
        (["--from", "1.05"], range(11, 40)),
        (["--to", str(START + SECOND)], range(10)),
        (["--from", "2023-11-14T22:13:23"], range(30, 40)),
        (["--from", "2023-11-14T22:13:23.5+00:00", "--stride", "2"], range(35, 40, 2)),
    ],
)
def test_windows_in_seconds_nanoseconds_and_dates(toys: Path, shell: Shell, words: list[str], frames: range) -> None:
    assert shell.replay("walk-camera.log", *words).status == 0
    assert [int(w[1]) for w in lines("results/walk-camera/best.rrd", "step")] == list(frames)
    assert [int(w[1]) for w in lines("results/walk-camera/sensors.rrd", "image")] == list(frames)


def test_times_of_every_form() -> None:
    assert parse_time("1.5", 10) == 1_500_000_010
    assert parse_time("1700000000000000001", 10) == 1_700_000_000_000_000_001
    assert parse_time("1970-01-01T00:00:01.000001", 10) == 1_000_001_000
    assert parse_time("1970-01-01T01:00:00+01:00", 10) == 0
    for bad in ("soon", "nan", "inf", ""):
        with pytest.raises(WorkbenchError, match="is not a time"):
            parse_time(bad, 0)


def test_the_path_begins_at_the_references_pose(toys: Path, shell: Shell) -> None:
    shell.replay("walk-camera.log", "--from", "2")
    got = toml("results/walk-camera/best.toml")["settings"]["start_pose"]
    assert got == pytest.approx([2.0, 5.0, 0.1 * np.sin(2.0)])
    shell.replay("walk-camera.log", "--set", "start_pose=[1,2,3]")
    assert toml("results/walk-camera/best.toml")["settings"]["start_pose"] == [1, 2, 3]


def test_the_offset_of_the_reference_is_used(toys: Path, shell: Shell) -> None:
    said = shell.replay("walk-camera.log", "--json", "--reference-offset", "-0.5")
    assert said.json["evaluation"]["matched"] == 35
    assert said.json["evaluation"]["offset_s"] == -0.5


def test_a_wrong_stream_is_refused_with_the_ones_there_are(toys: Path, shell: Shell) -> None:
    assert (
        "no stream named '/front'; the streams are: /camera, /imu, /range, /truth"
        in shell.replay("walk.log", "--image", "/front").error
    )
    assert "/imu holds imu; --reference can be: /truth" in shell.replay("walk.log", "--reference", "/imu").error
    assert (
        "/camera holds image; --height can be: /range, /truth" in shell.replay("walk.log", "--height", "/camera").error
    )
    assert not Path("results").exists()


def test_several_image_streams_ask_for_a_choice(toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = [image(START + k, stream=s) for k in range(3) for s in ("/left", "/right")]
    two = ToyMission(kinds={"/left": StreamKind.IMAGE, "/right": StreamKind.IMAGE})
    two._samples = samples
    monkeypatch.setattr(workbench.opening, "open_any", lambda path, options: two)
    assert "several image streams: /left, /right; choose one with --image" in shell.replay("two.log").error
    assert shell.replay("two.log", "--image", "/right").status == 0


# ---------------------------------------------------------------------------------- scale


def test_the_scale_comes_from_height_and_calibration(toys: Path, shell: Shell) -> None:
    values = shell.replay("walk-camera.log", "--json").json
    assert values["unit"] == "m"
    assert values["scale"] == "height of /range over focal length 200 px of the log's calibration"
    model = "4 x 3 px, f 200 200, centre 2 1.5, distortion plumb_bob (0.1, 0, 0, 0, 0)"
    distorted = "lens distortion is not removed from the images"
    assert values["notes"] == [f"camera: {model}, of the log's calibration", distorted]
    assert values["path_length"] == pytest.approx(3.9)


def test_a_given_scale_comes_first(toys: Path, shell: Shell) -> None:
    values = shell.replay("walk-camera.log", "--json", "--set", "metres_per_px=0.02").json
    assert values["scale"] == "0.02 m/px, as given"
    assert values["path_length"] == pytest.approx(7.8)
    assert values["evaluation"]["drift_percent"] == pytest.approx(100)


def test_without_a_scale_the_path_is_in_pixels_and_compared_after_scaling(toys: Path, shell: Shell) -> None:
    values = shell.replay("walk.log", "--json", "--height", "none").json
    assert values["unit"] == "px"
    assert "unknown" in values["scale"]
    assert values["path_length"] == pytest.approx(390)
    assert values["evaluation"]["alignment"]["scale"] == pytest.approx(0.01)
    assert values["evaluation"]["drift_percent"] < 1e-6


def test_a_height_without_focal_length_is_said(toys: Path, shell: Shell) -> None:
    values = shell.replay("walk.log", "--json").json
    assert values["unit"] == "px·m"
    assert "no focal length" in values["scale"]


def test_the_z_of_a_pose_can_be_the_height(toys: Path, shell: Shell) -> None:
    shell.replay("walk-camera.log", "--height", "/truth")
    got = toml("results/walk-camera/best.toml")["settings"]
    assert (got["height_stream"], got["height_m"]) == ("/truth", 0.7)


def test_a_calibration_for_another_size_is_not_used(toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    other = ToyMission(camera=toy_session.calibrated(width_px=640, height_px=480))
    monkeypatch.setattr(workbench.opening, "open_any", lambda path, options: other)
    values = shell.replay("other.log", "--json").json
    assert values["unit"] == "px·m"
    assert "640 x 480 px, but the images are 4 x 3 px" in values["notes"][0]


@pytest.mark.parametrize(
    ("words", "key", "value"),
    [
        (["--height", "none"], "metres_per_px", 0.01),
        (["--set", "metres_per_px=0.02"], "metres_per_px", 0.01),
        ([], "focal_px", 200.0),
    ],
)
def test_the_scale_is_calibrated_against_the_reference(
    toys: Path, shell: Shell, words: list[str], key: str, value: float
) -> None:
    got = shell.replay("walk.log", "--json", "--calibrate", *words).json["calibration"]
    assert got["key"] == key
    assert got["least_squares"] == pytest.approx(value)
    assert got["path_ratio"] == pytest.approx(value)
    assert f"--set {key}={value:g}" in shell.replay("walk.log", "--calibrate", *words).out


def test_a_calibration_without_reference_is_refused(toys: Path, shell: Shell) -> None:
    assert "needs a reference" in shell.replay("walk.log", "--calibrate", "--reference", "none").error
    said = shell.replay("walk.log", "--calibrate", "--reference-offset", "3")
    assert said.status == 2
    assert "cannot be compared" in said.err
    assert tomllib.loads(Path("results/walk/best.toml").read_text())["complete"]


# --------------------------------------------------------------------------------- damage


def test_damage_is_in_the_log_and_the_summary(toys: Path, shell: Shell) -> None:
    values = shell.replay("walk-damaged.log", "--json").json
    assert values["damage"] == ["chunk 3 is broken at byte 99 (10.0% of the file affected)"]
    assert "damage: chunk 3 is broken" in Path("results/walk-damaged/best.rrd").read_text()
    assert "damage: chunk 3 is broken" in Path("results/walk-damaged/sensors.rrd").read_text()


def test_a_file_that_ends_in_the_middle_gives_what_it_has_and_status_3(toys: Path, shell: Shell) -> None:
    said = shell.replay("walk-torn.log")
    assert said.status == 3
    assert said.err.startswith("error: walk-torn.log: the file ends in the middle; record again")
    assert len(lines("results/walk-torn/best.rrd", "step")) == 20
    run = toml("results/walk-torn/best.toml")
    assert run["summary"]["stopped_early"].startswith("walk-torn.log: the file ends")
    assert not Path("results/walk-torn/sensors.toml").exists()


def test_damaged_images_are_verdicts_events_and_facts(
    toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = ToyMission()
    mission._samples = [image(s.t_ns, damaged=k % 4 == 2) for k, s in enumerate(mission._samples[2::3])]
    monkeypatch.setattr(workbench.opening, "open_any", lambda path, options: mission)
    values = shell.replay("spots.log", "--json", "--reference", "none", "--height", "none").json
    assert values["verdicts"]["UNDECODABLE"] == 10
    assert any("25 % of the frames UNDECODABLE" in sentence for sentence in values["suitability"])
    assert len(lines("results/spots/best.rrd", "event")) == 10
    assert len(lines("results/spots/sensors.rrd", "undecodable")) == 10


# --------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["replay", "absent.bag", "-e", "toy"], "absent.bag: there is no such file"),
        (["replay", "walk.log", "-e", "kalman"], "there is no estimator 'kalman'; there are: toy"),
        (["replay", "walk.log", "-e", "toy", "--preset", "wild"], "no preset 'wild'; there are: best, slow"),
        (["replay", "walk.log", "-e", "toy", "--set", "sped_px=3"], "did you mean speed_px"),
        (["replay", "walk.log", "-e", "toy", "--set", "speed_px=fast"], "valid number"),
        (["replay", "walk.log", "-e", "toy", "--settings", "absent.toml"], "absent.toml: cannot be read"),
        (["replay", "walk.log", "-e", "toy", "--stride", "0"], "--stride 0: must be 1 or more"),
        (["replay", "walk.log", "-e", "toy", "--stride", "two"], "--stride"),
        (["replay", "walk.log", "-e", "toy", "--from", "soon"], "'soon' is not a time"),
        (["replay", "walk.log", "-e", "toy", "--from", "2", "--to", "1"], "--to 1 does not lie after --from 2"),
        (["replay", "walk.log", "-e", "toy", "--from", "900"], "has no frame in this window"),
        (["replay", "walk.log", "-e", "toy", "--to", "0.05"], "has one frame in this window"),
        (["replay", "walk.log", "-e", "toy", "--times-unit", "min"], "must be one of auto, s, ms, us, ns"),
        (["replay", "walk.log", "-e", "toy", "--rate", "0"], "--rate 0"),
        (["replay", "walk.log", "-e", "toy", "--tf", "map"], "write two frames with a comma"),
        (["replay", "walk.log", "-e", "toy", "--raw-images", "bmp"], "must be one of png, raw"),
        (["replay", "walk.log", "-e", "toy", "-o", "walk.log"], "choose another folder with -o"),
        (["replay", "walk.log", "-e", "toy", "-o", "full.txt"], "there is a file of that name"),
        (["replay"], "Missing argument 'PATH'"),
        (["replay", "walk.log", "--colour"], "No such option"),
        (["reply"], "No such command"),
        (["inspect", "absent.bag"], "absent.bag: there is no such file"),
        (["view", "absent.rrd"], "there is no such run"),
        (["settings", "-e", "kalman"], "there is no estimator 'kalman'"),
    ],
)
def test_a_request_that_cannot_be_met_is_one_line_and_status_2(
    toys: Path, shell: Shell, words: list[str], part: str
) -> None:
    Path("walk.log").touch()
    Path("full.txt").touch()
    assert part in shell(*words).error
    assert not Path("results").exists()


def test_results_never_go_into_the_recording(toys: Path, shell: Shell) -> None:
    Path("frames").mkdir()
    assert "would lie within the recording" in shell("replay", "frames", "-e", "toy", "-o", "frames/out").error
    assert not list(Path("frames").iterdir())


def test_debug_shows_where_an_error_arose(toys: Path, shell: Shell) -> None:
    said = shell("replay", "absent.bag", "-e", "toy", "--debug")
    assert said.status == 2
    assert "Traceback" in said.err
    assert said.err.splitlines()[-1].startswith("error: absent.bag")


def test_a_fault_of_ours_is_named_with_frame_and_time(
    toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(self: object, state: object, sample: Any) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(toy_session.WalkingEstimator, "step", explode)
    said = shell.replay("walk-bare.log")
    assert said.status == 1
    assert said.err.startswith("error: unexpected ZeroDivisionError: by nothing (at frame 0 of /camera, sensor time")
    assert toml("results/walk-bare/best.toml")["complete"] is False


# ------------------------------------------------------------------------------ interrupts


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-m", "tests.toy_session", *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_steps(file: Path, count: int) -> None:
    deadline = time.monotonic() + 30
    while not file.exists() or file.read_text().count("step") < count:
        assert time.monotonic() < deadline, "the replay did not begin"
        time.sleep(0.02)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_with_status_130_and_whole_files(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "walk-long-slow.log").touch()
    process = start(tmp_path, "replay", "walk-long-slow.log", "-e", "toy", "--json")
    folder = tmp_path / "results" / "walk-long-slow"
    wait_for_steps(folder / "best.rrd", 5)
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 130, err
    summary = json.loads(out)
    assert summary["interrupted"] is True
    assert 5 <= summary["frames"] < 400
    run = tomllib.loads((folder / "best.toml").read_text())
    assert run["interrupted"] is True
    assert run["complete"] is True
    assert len((folder / "best.tum").read_text().splitlines()) == summary["frames"]
    steps = (folder / "best.rrd").read_text().splitlines()
    assert sum(line.startswith("step") for line in steps) == summary["frames"]
    assert steps[-1].startswith("finish")
    assert not (folder / "sensors.toml").exists()
    checks = manifest.verify(folder, "best", toy_rows)
    assert {check.name for check in checks} == {
        "best.rrd", "best.toml", "best.tum", "best.checkpoints", "sensors.rrd",
    }  # fmt: skip
    assert not any(check.problems for check in checks)


def test_a_second_interrupt_ends_at_once_and_is_noted(
    toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: ToyRun, *_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ToyRun, "finish", interrupted)
    assert shell.replay("walk.log").status == 130
    state = tomllib.loads(Path("results/walk/best.toml").read_text())
    assert (state["complete"], state["interrupted"]) == (False, True)
    assert not Path("results/walk/best.sha256").exists()
    assert len(Path("results/walk/best.tum").read_text().splitlines()) == 40


def test_a_reference_of_another_time_is_refused_where_it_was_asked_for(toys: Path, shell: Shell) -> None:
    words = ["--reference-offset", "1000"]
    assert "at another time than the images" in shell.replay("walk.log", "--reference", "/truth", *words).error
    assert not Path("results").exists()
    summary = shell.replay("walk.log", "--json", *words).json
    assert summary["reference"].startswith("none: /truth lies from")


def test_a_folder_that_cannot_be_made_is_named(toys: Path, shell: Shell) -> None:
    Path("full.txt").touch()
    said = shell.replay("walk.log", "-o", "full.txt/deeper")
    assert "full.txt/deeper: no results can be written there" in said.error


def test_status_and_streams_of_the_real_command(tmp_path: Path) -> None:
    (tmp_path / "walk.log").touch()
    good = start(tmp_path, "replay", "walk.log", "-e", "toy", "--json")
    bad = start(tmp_path, "replay", "absent.log", "-e", "toy")
    out, err = good.communicate(timeout=30)
    assert good.returncode == 0
    assert json.loads(out)["frames"] == 40
    assert "toy: frame 40 of 40" in err
    out, err = bad.communicate(timeout=30)
    assert (bad.returncode, out) == (2, "")
    assert err == "error: absent.log: there is no such file or folder; check the path\n"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from workbench.cli import main; main(['replay', '--help']);"
        "print([m for m in ('numpy', 'numba', 'cv2', 'rerun', 'pandas', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "--calibrate" in done.stdout


@pytest.mark.parametrize("command", [[], ["inspect"], ["replay"], ["view"], ["demo"], ["settings"]])
def test_every_help_has_an_example(shell: Shell, command: list[str]) -> None:
    said = shell(*command, "--help") if command else shell()
    assert said.status == 0
    assert "  workbench " in said.out


# --------------------------------------------------------------------------------- inspect


def test_inspect_lists_streams_oddities_and_damage(toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    fact = Fact(stream="/imu", code="gap", count=2, sentence="2 gaps")
    monkeypatch.setattr(readers.clock, "examine", lambda recording: readers.clock.Survey((fact,), {}))
    Path("walk-damaged-camera.log").touch()
    said = shell("inspect", "walk-damaged-camera.log")
    assert said.status == 3
    rows = said.out.splitlines()
    assert rows[0] == "walk-damaged-camera.log: toy"
    assert rows[1] == "from 2023-11-14 22:13:20.000 UTC for 3.900 s (log time)"
    (row,) = [r.split() for r in rows if r.startswith("/camera")]
    assert row[:4] == ["/camera", "image", "40", "10"]
    assert "camera of /camera: 4 x 3 px, f 200 200" in said.out
    assert "chunk 3 is broken" in said.out
    assert "/imu: 2 gaps" in said.out
    values = shell("inspect", "walk-damaged-camera.log", "--json").json
    assert [s["name"] for s in values["streams"]] == ["/camera", "/imu", "/range", "/truth"]
    assert values["streams"][1]["rate_hz"] is None
    assert values["facts"] == [{"stream": "/imu", "code": "gap", "count": 2, "sentence": "2 gaps"}]
    assert shell("inspect", "walk-damaged-camera.log", "--json", "--quick").json["facts"] == []


def test_texts_from_files_cannot_write_to_the_terminal() -> None:
    assert shown("/a\x1b[31m\n\x07b") == "/a\\x1b[31m\\n\\x07b"
    assert shown("näme") == "näme"
    assert len(shown("x" * 1_000_000)) == 400
    rows = table(("name", "n"), [("a\nb", "1"), ("long name", "22")], right=(1,))
    assert rows == ["name        n", "a\\nb        1", "long name  22"]


def test_moments_of_small_clocks_are_seconds() -> None:
    assert moment(1_500_000_000) == "1.500 s"
    assert moment(START + 1_000_000) == "2023-11-14 22:13:20.001 UTC"


# ------------------------------------------------------------------------ view, settings, demo


def test_view_opens_sensors_and_runs_on_this_machine_only(tmp_path: Path) -> None:
    for name in ("sensors.rrd", "best.rrd", "paper-a.rrd", "best.toml"):
        (tmp_path / name).touch()
    assert [f.name for f in files_of([tmp_path])] == ["sensors.rrd", "best.rrd", "paper-a.rrd"]
    assert [f.name for f in files_of([tmp_path / "best.toml", tmp_path / "best.rrd"])] == ["sensors.rrd", "best.rrd"]
    command = view_command([tmp_path / "best.rrd"], web=False)
    assert command[-2:] == ["--bind", "127.0.0.1"]
    assert view_command([tmp_path / "best.rrd"], web=True)[-1] == "--web-viewer"


def test_view_without_a_display_prints_the_command(
    tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workbench.cli.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    (tmp_path / "best.rrd").touch()
    said = shell("view", tmp_path)
    assert said.status == 0
    assert said.out == f"rerun {tmp_path}/best.rrd --bind 127.0.0.1\n"
    (tmp_path / "empty").mkdir()
    assert "there is no .rrd file" in shell("view", tmp_path / "empty").error


def test_settings_are_printed_as_a_file_that_reads_back(toys: Path, shell: Shell) -> None:
    said = shell("settings", "-e", "toy", "--preset", "slow")
    assert tomllib.loads(said.out) == {
        "height_stream": "",
        "height_offset_m": 0.0,
        "start_pose": [0.0, 0.0, 0.0],
        "speed_px": 5.0,
    }
    assert "# metres_per_px is not set" in said.out


def test_the_demo_replays_both_presets(toys: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("demo-camera.mcap").touch()
    monkeypatch.setattr(workbench.cli, "demo_recording", lambda: Path("demo-camera.mcap"))
    monkeypatch.setattr(toy_session.WalkSettings, "presets", classmethod(lambda cls: ("best", "paper-a")))
    monkeypatch.setattr(toy_session.WalkSettings, "preset", classmethod(lambda cls, name: cls()))
    plug = workbench.settings.Plugin("toy", toy_session.WalkSettings, toy_session.WalkingEstimator)
    monkeypatch.setattr(workbench.settings, "BUILT_IN", {"correlation": lambda: plug})
    said = shell("demo")
    assert said.status == 0
    assert said.out.endswith("workbench view results/demo\n")
    assert Path("results/demo/best.rrd").is_file()
    assert Path("results/demo/paper-a.rrd").is_file()
    runs = shell("demo", "--json").json["runs"]
    assert set(runs) == {"best", "paper-a"}
    assert all({"findings", "not_judged"} <= set(run) for run in runs.values())


# ---------------------------------------------------------------------------------- digest


def test_the_digest_sees_size_and_both_ends_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "big.bag"
    content = bytearray(3 << 20)
    seen = set()
    for place in (None, 0, -1, "longer"):
        changed = bytearray(content)
        if place == "longer":
            changed += b"\0"
        elif isinstance(place, int):
            changed[place] = 1
        file.write_bytes(changed)
        seen.add(digest(file))
    assert len(seen) == 4
    small = tmp_path / "small.bag"
    small.write_bytes(b"abc")
    first = digest(small)
    small.write_bytes(b"abd")
    assert digest(small) != first


def test_the_digest_of_a_folder_sees_names_and_content_but_not_where_it_lies(tmp_path: Path) -> None:
    seen = set()
    for folder, name, content in (
        ("a", "1.pgm", b"x"),
        ("b", "1.pgm", b"x"),
        ("c", "2.pgm", b"x"),
        ("d", "1.pgm", b"y"),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_bytes(content)
        seen.add(digest(tmp_path / folder))
    assert len(seen) == 3
    (tmp_path / "empty").mkdir()
    assert digest(tmp_path / "empty") not in seen
