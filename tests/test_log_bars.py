"""The log of the real estimator: every field bit for bit, equal data for equal runs, and what an end leaves."""

import os
import signal
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from rerun.chunk import RrdReader
from test_rrd import HALF_STEP, assert_same, rows_of

from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import CorrelationSettings
from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step
from pipelines.replay import replay
from pipelines.simulation.faults import DuplicateFrames, ExposureJump
from pipelines.simulation.mission import IMAGE, SimulatedMission, nadir_mission
from pipelines.simulation.surfaces import gravel
from pipelines.simulation.trajectories import drive, figure_eight
from pipelines.verdict import Verdict
from workbench import rrd
from workbench.session import Request, run

DEMO = Path(__file__).parents[1] / "recordings" / "demo.mcap"
FRAMES = 40
PRESETS = pytest.mark.parametrize("preset", CorrelationSettings.presets())


@pytest.fixture(scope="module")
def mission() -> SimulatedMission:
    """A drive over gravel, 512 x 512, with a jump of the exposure and an image that is sent twice."""
    rng = np.random.default_rng(3)
    poses = drive(figure_eight(), FRAMES, speed_mps=0.5, rng=rng)
    faults = [
        ExposureJump(start_s=11.5 / 60, stop_s=29.5 / 60, gain=1.4),
        DuplicateFrames(start_s=19.5 / 60, stop_s=20.5 / 60),
    ]
    return nadir_mission(gravel(512, rng), poses, faults=faults)


def steps_of(mission: SimulatedMission, preset: str) -> list[Step]:
    settings = CorrelationSettings.preset(preset).model_dump() | {"metres_per_px": mission.metres_per_px}
    estimator = CorrelationOdometry(CorrelationSettings.model_validate(settings))
    return [one.step for one in replay(mission, estimator, image_stream=IMAGE)]


def logged(path: Path, steps: Iterable[Step], preset: str) -> Path:
    with rrd.RunWriter(
        path, recording_id="m", run=preset, estimator="correlation", step_type=CorrelationStep, settings_text=""
    ) as writer:
        for step in steps:
            writer.step(step)
    return path


# ------------------------------------------------------------------------ every field, bar 7


@PRESETS
def test_every_field_of_the_real_estimator_reads_back(tmp_path: Path, mission: SimulatedMission, preset: str) -> None:
    steps = steps_of(mission, preset)
    path = logged(tmp_path / "run.rrd", steps, preset)
    read = rrd.read_steps(path, preset, CorrelationStep)
    assert len(read) == FRAMES
    for written, back in zip(steps, read, strict=True):
        assert_same(written, back)
    alarms = [step.alarms for step in steps]
    assert Verdict.FIRST_FRAME in alarms[0]
    assert Verdict.DUPLICATE_FRAME in alarms[20]
    without = logged(tmp_path / "one.rrd", steps[:1], preset).stat().st_size
    assert (path.stat().st_size - without) / (FRAMES - 1) <= 25_000


def test_the_peaks_of_the_real_surfaces_are_marked_on_their_brightest_spot(
    tmp_path: Path, mission: SimulatedMission
) -> None:
    steps = steps_of(mission, "best")
    path = logged(tmp_path / "run.rrd", steps, "best")
    root = "/runs/best/correlation/search/surface"
    marks, buffers = rows_of(path, f"{root}/first", "Points2D:positions"), rows_of(path, root, "DepthImage:buffer")
    formats = rows_of(path, root, "DepthImage:format")
    seen = 0
    for step in steps:
        if not isinstance(step, CorrelationStep) or not step.accepted:
            continue
        shape = formats[step.frame][0]["height"], formats[step.frame][0]["width"]
        mosaic = np.array(buffers[step.frame][0], np.uint8).view(np.float16).reshape(shape).astype(float)
        for mark, value in zip(marks[step.frame], step.peak_correlation, strict=True):
            column, row = np.floor(mark).astype(int)
            assert mosaic[row, column] == pytest.approx(value, abs=HALF_STEP)
            seen += 1
    assert seen > 30 * 9


# ------------------------------------------------------------------------ equal data, bar 8


@PRESETS
def test_the_same_command_twice_gives_equal_data(tmp_path: Path, preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    digests = []
    for name, age_s in (("a", 0.5), ("b", 0.05)):
        monkeypatch.setattr(rrd, "MAX_AGE_S", age_s)  # another cut into chunks
        outcome = run(Request(path=DEMO, preset=preset, stop="2", out=tmp_path / name))
        digests.append((rrd.digest(outcome.run_file), rrd.digest(outcome.sensors_file)))
    assert digests[0] == digests[1]


# ------------------------------------------------------------------------ sudden ends, bar 6

SLOWED = textwrap.dedent(
    """
    import sys, time
    from workbench import cli

    class Slow(cli.Bar):
        def __call__(self, progress):
            print(progress.done, time.monotonic(), flush=True)
            time.sleep(0.012)

    cli.Bar = Slow
    sys.exit(cli.main())
    """
)
"""`workbench` at 80 frames/s or less, which says of every frame when it was done."""


class Ended(NamedTuple):
    """A replay that a signal ended: its exit status, and when (s) the step of each frame was made."""

    status: int
    made_s: list[float]
    folder: Path


def ended(folder: Path, number: signal.Signals, *, after: int) -> Ended:
    """Replay the demo's recording and send a signal after some frames."""
    child = subprocess.Popen(
        [sys.executable, "-c", SLOWED, "replay", str(DEMO), "-o", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=dict(os.environ, PYTHONPATH=str(DEMO.parents[1])),
    )
    assert child.stdout is not None
    lines = [line for _, line in zip(range(after), child.stdout, strict=False)]
    child.send_signal(number)
    lines += child.stdout
    child.stdout.close()
    words = [line.split() for line in lines if line.endswith("\n")]
    return Ended(child.wait(), [float(w[1]) for w in words if len(w) == 2 and w[0].isdigit()], folder)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_kill_loses_less_than_the_last_second(tmp_path: Path) -> None:
    end = ended(tmp_path / "out", signal.SIGKILL, after=200)
    assert end.status == -signal.SIGKILL
    due = sum(at <= end.made_s[-1] - 1.0 for at in end.made_s)
    steps = rrd.read_steps(end.folder / "best.rrd", "best", CorrelationStep)
    assert [step.frame for step in steps] == list(range(len(steps)))
    assert len(end.made_s) >= len(steps) >= due > 50
    images = rows_of(end.folder / "sensors.rrd", rrd.IMAGE, "EncodedImage:blob")
    assert sorted(images) == list(range(len(images)))
    assert len(images) >= due
    assert tomllib.loads((end.folder / "best.toml").read_text())["complete"] is False


def test_interrupt_loses_nothing(tmp_path: Path) -> None:
    end = ended(tmp_path / "out", signal.SIGINT, after=60)
    assert end.status == 130
    count = len(end.made_s)
    assert 60 <= count < 300
    for name in ("best.rrd", "sensors.rrd"):
        assert RrdReader(end.folder / name).store() is not None  # it has its footer
    assert len(rrd.read_steps(end.folder / "best.rrd", "best", CorrelationStep)) == count
    assert len(rows_of(end.folder / "sensors.rrd", rrd.IMAGE, "EncodedImage:blob")) == count
    assert len((end.folder / "best.tum").read_text().splitlines()) == count
    values = tomllib.loads((end.folder / "best.toml").read_text())
    assert values["interrupted"] is True
