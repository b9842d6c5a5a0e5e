"""The manifest of a run: what was written verifies, and whatever differs is named."""

import dataclasses
import json
import random
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.correlation.step import CorrelationStep
from readers.streams import ImageSample, RecordingError
from tests.fake_steps import steps
from workbench import manifest
from workbench.cli import main
from workbench.rrd import RunWriter, SensorWriter
from workbench.rrd_reading import chunks as rows_of

FRAMES = 30


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small run with its manifest."""
    folder = tmp_path_factory.mktemp("run")
    with SensorWriter(folder / "sensors.rrd", recording_id="mission") as sensors:
        for k in range(FRAMES):
            sensors.image(k, picture(k))
    with RunWriter(
        folder / "best.rrd",
        recording_id="mission",
        run="best",
        estimator="correlation",
        step_type=CorrelationStep,
        settings_text="",
    ) as run:
        for step in steps(FRAMES):
            run.step(step)
    (folder / "best.toml").write_text("format = 1\n")
    (folder / "best.tum").write_text("0 0 0 0 0 0 0 1\n")
    write_manifest(folder)
    return folder


def picture(k: int) -> ImageSample:
    pixels = np.random.default_rng(k).integers(0, 255, (16, 16), np.uint8)
    return ImageSample(
        stream="/camera", t_ns=k, received_ns=k, encoding="mono8", payload=pixels.tobytes(), width_px=16, height_px=16
    )


def write_manifest(folder: Path) -> None:
    manifest.file_of(folder, "best").write_text(manifest.taken(folder, "best").text())


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    for file in whole.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def problems(folder: Path, count: manifest.CountRows = manifest.rows_apart) -> dict[str, tuple[str, ...]]:
    checks = manifest.verify(folder, "best", count_damaged=count)
    return {check.name: check.problems for check in checks if check.problems}


def unread(file: Path) -> manifest.Rows:
    raise RecordingError(file, "not read here", "no cure")


def test_what_was_written_verifies_with_all_its_rows(whole: Path) -> None:
    assert problems(whole) == {}
    rows = manifest.read(whole, "best").rows
    assert rows["sensors.rrd"]["/camera/image"] == FRAMES
    read = sum(
        len(chunk.to_record_batch()) for chunk in rows_of(whole / "best.rrd", "/world/runs/best/raw", is_static=None)
    )
    assert rows["best.rrd"]["/world/runs/best/raw"] == read > FRAMES


def test_the_usual_tool_checks_the_same_list(copy: Path) -> None:
    command = ["sha256sum", "--strict", "--quiet", "-c", "best.sha256"]
    assert subprocess.run(command, cwd=copy, check=False, capture_output=True).returncode == 0
    flip(copy / "best.tum", 3, 0)
    done = subprocess.run(command, cwd=copy, check=False, capture_output=True, text=True)
    assert done.returncode == 1
    assert "best.tum" in done.stdout


def flip(file: Path, at: int, bit: int) -> None:
    data = bytearray(file.read_bytes())
    data[at] ^= 1 << bit
    file.write_bytes(data)


@pytest.mark.parametrize("name", ["best.rrd", "sensors.rrd", "best.toml", "best.tum"])
def test_a_flipped_bit_is_found_wherever_it_is(copy: Path, name: str) -> None:
    size = (copy / name).stat().st_size
    rng = random.Random(name)
    edges = [0, 5, 13, size // 2, size - 30, size - 1]  # the magic, the version, a frame's header, data, the footer
    for at in (min(max(edge, 0), size - 1) for edge in [*edges, *(rng.randrange(size) for _ in range(6))]):
        bit = rng.randrange(8)
        flip(copy / name, at, bit)
        assert set(problems(copy, unread)) == {name}, (at, bit)
        flip(copy / name, at, bit)
    assert problems(copy) == {}


def test_what_stands_in_a_flipped_file_is_read_apart(copy: Path) -> None:
    flip(copy / "best.rrd", (copy / "best.rrd").stat().st_size // 2, 3)
    assert "SHA-256" in problems(copy)["best.rrd"][0]  # and the test goes on, whatever became of the reader
    with pytest.raises(RecordingError, match=r"cannot be read"):
        manifest.rows_apart(copy / "best.toml")


def test_every_flipped_bit_of_the_manifest_is_found(copy: Path) -> None:
    file = copy / "best.sha256"
    for at in range(0, file.stat().st_size, 97):
        flip(file, at, at % 8)
        with pytest.raises(RecordingError, match="relied on"):
            manifest.read(copy, "best")
        flip(file, at, at % 8)
    text = file.read_text()
    file.write_text(text[: len(text) // 2])
    with pytest.raises(RecordingError, match="cut"):
        manifest.read(copy, "best")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda file: file.write_bytes(b""), "it is empty"),
        (lambda file: file.unlink(), "it is missing"),
        (lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2]), "SHA-256 differs"),
        (lambda file: file.write_bytes(file.read_bytes()[:-1]), "SHA-256 differs"),
        (lambda file: file.write_bytes(file.read_bytes() + b"\0"), "SHA-256 differs"),
    ],
)
@pytest.mark.parametrize("name", ["best.rrd", "sensors.rrd"])
def test_empty_missing_and_cut_files_are_named(
    copy: Path, name: str, damage: Callable[[Path], object], words: str
) -> None:
    damage(copy / name)
    assert words in "; ".join(problems(copy)[name])


def test_a_file_with_fewer_rows_is_told_by_its_entities(copy: Path) -> None:
    with SensorWriter(copy / "sensors.rrd", recording_id="mission") as sensors:
        for k in range(FRAMES - 4):
            sensors.image(k, picture(k))
    assert f"/camera/image holds {FRAMES - 4} rows, not {FRAMES}" in problems(copy)["sensors.rrd"]


def test_a_manifest_that_was_made_up_does_not_hide_missing_rows(copy: Path) -> None:
    listed = manifest.read(copy, "best")
    entity = "/camera/image"
    more = listed.rows["sensors.rrd"] | {entity: FRAMES + 1}
    lied = dataclasses.replace(listed, rows=listed.rows | {"sensors.rrd": more})
    (copy / "best.sha256").write_text(lied.text())
    assert problems(copy) == {"sensors.rrd": (f"{entity} holds {FRAMES} rows, not {FRAMES + 1}",)}


def test_sensors_that_another_run_wrote_again_are_said_to_be_its(copy: Path) -> None:
    with SensorWriter(copy / "sensors.rrd", recording_id="mission") as sensors:
        sensors.image(0, picture(0))
    made = manifest.Manifest({"sensors.rrd": manifest.digest_of(copy / "sensors.rrd")})
    (copy / "later.sha256").write_text(made.text())
    assert "written again by the run later" in problems(copy)["sensors.rrd"][-1]


def test_the_command_tells_and_has_its_status(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(copy)]) == 0
    assert "best.rrd: as written" in capsys.readouterr().out
    (copy / "best.rrd").write_bytes(b"")
    assert main(["verify", str(copy / "best.rrd"), "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert told["good"] is False
    assert told["runs"][str(copy / "best")]["best.rrd"]["problems"] == ["it is empty (0 bytes)"]
    (copy / "best.sha256").unlink()
    assert main(["verify", str(copy / "best.rrd")]) == 2
    assert "no manifest" in capsys.readouterr().err
    assert main(["verify", str(copy / "nothere")]) == 2
    assert "nothere: there is no such run" in capsys.readouterr().err
