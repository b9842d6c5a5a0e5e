"""`workbench simulate`: listed, shown, written, replayed, interrupted, refused."""

import json
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from pipelines.simulation.faults import FAULTS_STREAM, from_text
from readers import open_recording
from readers.streams import TextSample
from workbench import scenarios
from workbench.cli import main

ROOT = Path(__file__).parents[1]
TINY = ("--set", "ground.size_px=256", "--set", "camera.width_px=160", "--set", "camera.height_px=160")


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_the_list_names_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(scenarios.names())
    assert all(len(line.split()) > 2 for line in lines)


def test_what_is_shown_is_toml_with_the_overrides(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["simulate", "fault-exposure-jump", "--set", "faults.0.gain=1.25", "--set", "camera.noise_grey=5"]
    assert main([*command, "--seed", "9", "--show"]) == 0
    shown = tomllib.loads(capsys.readouterr().out)
    assert (shown["faults"][0]["gain"], shown["camera"]["noise_grey"], shown["seed"]) == (1.25, 5.0, 9)
    assert shown["trajectory"]["curve"] == "figure-eight"


def test_a_mission_is_written_with_its_faults(capsys: pytest.CaptureFixture[str]) -> None:
    cut = ("--set", "frames=12", "--set", "faults.0.start_s=0.05", "--set", "faults.0.stop_s=0.1")
    command = ["simulate", "fault-exposure-jump", *TINY, *cut, "-o", "m.mcap", "--images", "png"]
    assert main([*command, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["messages"]["/camera/image_raw/compressed"] == 12
    assert told["faults"] == [{"name": "exposure-jump", "start_s": 0.05, "stop_s": 0.1}]
    with open_recording(Path("m.mcap")) as recording:
        (text,) = (s.text for s in recording.read([FAULTS_STREAM]) if isinstance(s, TextSample))
    assert [(f.name, f.stop_ns - f.start_ns) for f in from_text(text)] == [("exposure-jump", 50_000_000)]
    first = Path("m.mcap").read_bytes()
    Path("m.mcap").unlink()
    assert main(command) == 0
    assert Path("m.mcap").read_bytes() == first
    assert "exposure-jump from 0.050 to 0.100 s" in capsys.readouterr().out
    assert main(command) == 2
    assert "it exists already" in capsys.readouterr().err


def test_streams_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    brief = ("--set", "duration_s=0.2", "--set", "reference.timing.rate_hz=60", "--as", "paper-a", "-o", "folder")
    assert main(["simulate", "sensors", *TINY, *brief]) == 2
    assert "name the streams to write" in capsys.readouterr().err
    chosen = ("--stream", "/camera/image_raw", "--stream", "/reference/pose")
    assert main(["simulate", "sensors", *TINY, *brief, *chosen, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"].keys() == {"images", "file.csv"}
    assert main(["simulate", "line", *TINY, "-o", "m.mcap", "--stream", "/imu"]) == 2
    assert "no stream named '/imu'" in capsys.readouterr().err
    assert not Path("m.mcap").exists()


def test_a_mission_is_replayed_without_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    small = ("--set", "frames=6", "--set", "ground.size_px=256")
    assert main(["simulate", "line", *small, "--replay", "--preset", "paper-a", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["frames"], summary["unit"], summary["preset"]) == (6, "m", "paper-a")
    assert sorted(p.name for p in Path("results/line").glob("*.rrd")) == ["paper-a.rrd", "sensors.rrd"]
    Path("mine.toml").write_text("frames = 5\nground.size_px = 256\n[camera]\n[reference.timing]\nrate_hz = 60\n")
    assert main(["replay", "mine.toml", "-o", "here", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 5


def test_inspect_opens_a_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "sim:paper-b", "--quick", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["format"] == "simulated mission"
    assert {"/front/image_raw", "/imu", "/truth/faults"} <= {s["name"] for s in told["streams"]}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "name a scenario, or a TOML file"),
        (["line"], "say where to: -o FILE writes it, --replay replays it, --show prints it"),
        (["lime", "--show"], "there is no scenario 'lime'; did you mean line"),
        (["line", "--set", "seed", "--show"], "write key=value"),
        (["line", "--set", "camera.nois=1", "--show"], "did you mean noise_grey?"),
        (["line", "--replay", "--as", "mcap"], "--replay writes no recording"),
        (["line", "-o", "a.mcap", "--images", "gif"], "--images gif: must be one of jpeg, png, stored"),
        (["line", "-o", "a.mcap", "--as", "zip"], "no container is named 'zip'"),
        (["line", "-o", "a.xyz"], "name the container"),
        (["line", "--picture", "none.png", "-o", "a.mcap"], "the picture of the ground cannot be read"),
        (
            ["paper-b", "--set", "ground.relief_height_m=0.001", "-o", "a.mcap"],
            "/front/image_raw frame 0: a relief of slope",
        ),
    ],
)
def test_refusals_are_one_line(words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--set", "ground.size_px=256"] if words else []
    assert main(["simulate", *words, *small]) == 2
    said = capsys.readouterr()
    assert text in said.err
    assert len(said.err.splitlines()) == 1
    assert said.out == ""
    assert not list(Path().iterdir())


def test_an_interrupted_file_stays_readable(tmp_path: Path) -> None:
    code = f"import sys; sys.path[0] = {str(ROOT)!r}; from workbench.cli import main; sys.exit(main())"
    words = ["simulate", "line", *TINY, "--set", "duration_s=600", "-o", "long.mcap", "--images", "stored"]
    process = subprocess.Popen([sys.executable, "-c", code, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    file = tmp_path / "long.mcap"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (file.exists() and file.stat().st_size > 4_000_000):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "long.mcap holds what was written so far" in said
    with open_recording(file) as recording:
        assert not recording.damage
        assert recording.stream("/camera/image_raw").count > 50
        assert sum(1 for _ in recording.read(["/camera/image_raw"])) == recording.stream("/camera/image_raw").count
