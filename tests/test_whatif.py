"""What if: the same settings give the logged numbers bit for bit, other settings go on from the old state."""

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import workbench.session
from pipelines.correlation.odometry import CorrelationOdometry
from pipelines.correlation.settings import CorrelationSettings
from pipelines.estimator import EstimatorError
from pipelines.ranging.range_filter import RangeFilter
from pipelines.ranging.range_settings import RangeSettings
from pipelines.replay import grey_sample
from pipelines.verdict import Verdict
from readers.images import RAW_FORMATS
from readers.streams import (
    UNKNOWN_QUAT,
    UNKNOWN_VEC3,
    ImageSample,
    ImuSample,
    LandmarkSample,
    OdometrySample,
    Problem,
    RangeSample,
    Recording,
    RecordingError,
    Sample,
    StreamError,
    StreamKind,
    TrackSample,
    WorkbenchError,
    array,
)
from tests.toys import ToyRecording
from workbench import manifest
from workbench.cli import main
from workbench.rrd import SensorWriter
from workbench.rrd_sensors import SensorReader
from workbench.session import Request, run
from workbench.settings import SettingsError
from workbench.whatif import Question, ask, write

START = 1_700_000_000_000_000_000
PERIOD = 33_000_000
EVERY = 7
"""Frames between checkpoints in these tests."""


class Mission(ToyRecording):
    identity = "a mission"


# ------------------------------------------------------------------------------- correlation

SIDE = 96
FRAMES = 40
DAMAGED, DUPLICATE, LOST, BACK, FIRST_AFTER = 10, 15, (20, 21, 22), 26, 27


def ground() -> np.ndarray[Any, np.dtype[np.uint8]]:
    noise = np.random.default_rng(4).random((SIDE + 140, SIDE + 140)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(255 * (smooth - smooth.min()) / np.ptp(smooth), np.uint8)


def png(pixels: Any) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def frames() -> Iterator[Sample]:
    """A walk over the ground with heights; one frame damaged, one twice, three blank, one out of order."""
    picture = ground()
    before = b""
    for k in range(FRAMES):
        t_ns = START + k * PERIOD
        yield RangeSample(stream="/height", t_ns=t_ns - 9, received_ns=t_ns, range_m=1.0 + 0.01 * np.sin(k),
                          min_range_m=0.0, max_range_m=9.0, field_of_view_rad=np.nan)  # fmt: skip
        x, y = 3 * k, int(20 + 15 * np.sin(k / 5))
        pixels = picture[y : y + SIDE, x : x + SIDE]
        data = png(np.full_like(pixels, 90 + k) if k in LOST else pixels)
        data = data[:40] if k == DAMAGED else before if k == DUPLICATE else data
        when = t_ns - 2 * PERIOD if k == BACK else t_ns
        yield ImageSample(
            stream="/camera", t_ns=when, received_ns=t_ns + 5, encoding="png", payload=data, source=f"{k}"
        )
        before = data


def walk() -> Mission:
    return Mission(list(frames()), {"/camera": StreamKind.IMAGE, "/height": StreamKind.RANGE})


SMALL = ("fragment_side_px=25", "span_u_px=30", "search_radius_px=8")
COMMON = (*SMALL, "focal_px=100", "height_stream='/height'")


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workbench.session, "CHECKPOINT_FRAMES", EVERY)


def replayed(folder: Path, mission: Recording, estimator: str, preset: str, *overrides: str, **more: Any) -> Path:
    request = Request(path=Path("toy"), estimator=estimator, preset=preset, overrides=overrides, out=folder, **more)
    run(request, recording=mission)
    return folder / f"{more.get('name') or preset}.rrd"


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder with a run of each preset."""
    folder = tmp_path_factory.mktemp("walked")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workbench.session, "CHECKPOINT_FRAMES", EVERY)
        return {preset: replayed(folder, walk(), "correlation", preset, *COMMON) for preset in ("best", "paper-a")}


def same(path: Path, start: int, stop: int) -> Any:
    answer = ask(Question(run=path, start=str(start), stop=str(stop)))
    assert [row.frame for row in answer.rows] == list(range(start, stop))
    assert answer.summary["frames_changed"] == 0
    assert answer.summary["verdicts_changed"] == 0
    assert all(not row.changes for row in answer.rows)
    return answer


@pytest.mark.parametrize("preset", ["best", "paper-a"])
def test_the_same_settings_give_the_logged_numbers(walked: dict[str, Path], preset: str) -> None:
    for start, stop in (
        (0, 3),
        (1, FRAMES),
        (7, 9),
        (8, 12),
        (DAMAGED + 1, 18),
        (DUPLICATE + 1, 18),
        (21, 30),
        (27, 40),
    ):
        answer = same(walked[preset], start, stop)
        assert answer.summary["frames_verified"] == (start % EVERY if start else 0)
    verdicts = {row.frame: row.old.name for row in same(walked[preset], 0, FRAMES).rows}
    assert verdicts[DAMAGED] == "UNDECODABLE"
    assert verdicts[DUPLICATE] == "DUPLICATE_FRAME"
    if preset == "best":
        assert {verdicts[k] for k in LOST} == {"LOST"}


def test_other_settings_go_on_from_the_old_state(walked: dict[str, Path]) -> None:
    answer = ask(
        Question(run=walked["best"], start="12", stop="30", overrides=("height_offset_m=1.0", "median_frames=5"))
    )
    assert answer.summary["changed_settings"] == {"height_offset_m": [0.0, 1.0], "median_frames": [31, 5]}
    steps = {step.frame: step for step in answer.steps}
    logged = dict(zip(answer.logged["frame"], answer.logged["path_step_m"], strict=True))
    for frame in (13, 14, 17, 30 - 1):  # at twice the height a pixel is twice as wide, to the height's own wobble
        assert steps[frame].path_step_m == pytest.approx(logged[frame] * (1 + 1 / (1 + 0.01 * np.sin(frame))), rel=1e-9)
    assert answer.rows[-1].distance_m > 0.1
    height = next(change for change in answer.rows[3].changes if change.field == "height_m")
    assert height.new - height.old == pytest.approx(1.0)
    assert all(change.field != "height_offset_m" for row in answer.rows for change in row.changes)
    before = ask(Question(run=walked["best"], start="11", stop="12")).steps[0]
    gap = np.hypot(*(steps[12].pose[:2] - before.pose[:2]))
    assert gap == pytest.approx(steps[12].path_step_m, rel=1e-9)  # from where the run was, not from its start


def test_a_whole_run_with_other_settings_is_that_run(walked: dict[str, Path], tmp_path: Path) -> None:
    other = replayed(
        tmp_path, walk(), "correlation", "best", *COMMON, "search_radius_px=10", "start_pose=[1.0,2.0,0.5]"
    )
    answer = ask(Question(run=walked["best"], overrides=("search_radius_px=10", "start_pose=[1.0,2.0,0.5]")))
    fresh = ask(Question(run=other))
    assert [s.pose.tobytes() for s in answer.steps] == [s.pose.tobytes() for s in fresh.steps]


def test_shapes_that_the_settings_change_are_adopted() -> None:
    settings = CorrelationSettings.preset("best").model_copy(update={"metres_per_px": 1.0})
    old = CorrelationOdometry(settings)
    history = np.arange(3.0 * settings.median_frames).reshape(3, -1)
    state = dataclasses.replace(old.start(), frames=50, history=history, last_shift=np.zeros((9, 2)), height_m=4.0)
    new = CorrelationOdometry(settings.model_copy(update={"median_frames": 7, "rows": 1, "height_m": 2.0}))
    found = new.adopted(state)
    latest = [history[:, (50 - 1 - k) % settings.median_frames] for k in range(7)]
    assert found.history is not None
    for k in range(7):
        np.testing.assert_array_equal(found.history[:, (50 - 1 - k) % 7], latest[k])
    assert found.usual.residual == np.median([one[0] for one in latest])
    assert found.last_shift is None
    assert found.height_m == 2.0
    assert old.adopted(state) == state


# ---------------------------------------------------------------------------------- ranging


def drive() -> Iterator[Sample]:
    """Towards five points at 5 Hz with odometry and a gyro; a frame damaged, one twice, one out of order."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-2, 2, 5), rng.uniform(-1, 1, 5), rng.uniform(8, 14, 5)])
    pixels = np.zeros((5, 2))
    for k in range(300):
        t_ns, ahead = START + k * 20_000_000, 0.5 * 0.02 * k
        nothing = {"position_m": UNKNOWN_VEC3, "quat_xyzw": UNKNOWN_QUAT}
        speed = array(0.5 + rng.normal(0, 0.01), 0, 0)
        gyro = array(0, 0, rng.normal(0, 0.001))
        if k == 133:
            yield Problem(stream="/imu", t_ns=t_ns, received_ns=t_ns, kind=StreamKind.IMU, reason="cut short")
        yield OdometrySample(stream="/odom", t_ns=t_ns, received_ns=t_ns + 7, linear_velocity_mps=speed,
                             angular_velocity_radps=gyro * 1.1, **nothing)  # fmt: skip
        yield ImuSample(stream="/imu", t_ns=t_ns, received_ns=t_ns + 3, angular_velocity_radps=gyro,
                        linear_acceleration_mps2=UNKNOWN_VEC3, quat_xyzw=UNKNOWN_QUAT)  # fmt: skip
        if k % 10:
            continue
        frame = k // 10
        if frame != 17:
            seen = points[:, :2] / (points[:, 2:] - ahead) * 500 + [320, 240]
            pixels = seen + rng.normal(0, 0.5, (5, 2))
        if frame == 12:
            yield Problem(stream="/tracks", t_ns=t_ns, received_ns=t_ns, kind=StreamKind.TRACK, reason="cut short")
            continue
        shown = slice(0, 3) if frame == 9 else slice(None)
        when = t_ns - 500_000_000 if frame == 21 else t_ns
        yield TrackSample(stream="/tracks", t_ns=when, received_ns=t_ns + 1, ids=np.arange(5)[shown] + 3,
                          points_px=pixels[shown])  # fmt: skip


KINDS = {"/tracks": StreamKind.TRACK, "/odom": StreamKind.ODOMETRY, "/imu": StreamKind.IMU}
CAMERA = ("focal_px=500", "centre_px=[320.0,240.0]")


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("driven")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workbench.session, "CHECKPOINT_FRAMES", EVERY)
        runs = {p: replayed(folder, Mission(list(drive()), KINDS), "range", p, *CAMERA) for p in ("best", "paper-b")}
        joint = (*CAMERA, "mode='joint'")
        runs["joint"] = replayed(folder, Mission(list(drive()), KINDS), "range", "best", *joint, name="joint")
        return runs


@pytest.mark.parametrize("preset", ["best", "paper-b", "joint"])
def test_ranges_come_out_as_logged(driven: dict[str, Path], preset: str) -> None:
    for start, stop in ((0, 3), (1, 30), (8, 11), (13, 16), (18, 20), (22, 30)):
        same(driven[preset], start, stop)
    alarms = [step.alarms for step in same(driven[preset], 0, 30).steps]
    assert Verdict.UNDECODABLE in alarms[12]
    assert Verdict.DUPLICATE_FRAME in alarms[17]
    assert Verdict.OUT_OF_ORDER in alarms[21]
    assert Verdict.INPUT_UNREADABLE in alarms[14]


def test_ranges_with_other_settings(driven: dict[str, Path]) -> None:
    answer = ask(Question(run=driven["best"], start="15", stop="25", overrides=("tracks.sigma_px=3.0",)))
    assert 0 < answer.summary["end_range_share"] < 1
    assert np.isnan(answer.rows[0].distance_m)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("mode=joint", "mode: .*as a whole"),
        ("max_landmarks=3", "set max_landmarks=5"),
        ("landmarks=tracks", "landmarks: "),
    ],
)
def test_states_that_cannot_be_taken_over(driven: dict[str, Path], override: str, words: str) -> None:
    with pytest.raises(EstimatorError, match=words):
        ask(Question(run=driven["best"], start="15", stop="25", overrides=(override,)))


# ------------------------------------------------------------------------------- the samples


def samples_back(tmp_path: Path, samples: list[Sample], stream: str, raw: Any = "png") -> list[Sample]:
    """Samples through a file and back, as a session writes them."""
    path = tmp_path / "sensors.rrd"
    with SensorWriter(path, recording_id="x", raw_images=raw) as writer:
        for sample in samples:
            decoded = grey_sample(sample) if isinstance(sample, ImageSample) else sample
            writer.sample(sample, decoded)
            if isinstance(decoded, ImageSample) and isinstance(sample, ImageSample):
                writer.image(sample.frame, sample)
    with SensorReader(path, stream) as reader:
        return list(reader.samples(sorted({s.stream for s in samples}), -1, len(samples)))


def test_samples_come_back_bit_for_bit_in_order(tmp_path: Path) -> None:
    given = list(drive())
    number = 0
    for i, sample in enumerate(given):
        if sample.stream == "/tracks":
            given[i], number = dataclasses.replace(sample, frame=number), number + 1
    oddly = array(np.nan, -0.0, np.inf)
    given.append(LandmarkSample(stream="/seen", t_ns=5, received_ns=6, ids=np.array([2**62, -1, 3]), range_m=oddly,
                                bearing_rad=oddly, oddities=("foreign_stamp", "x y"), frame=0))  # fmt: skip
    for before, after in zip(given, samples_back(tmp_path, given, "/tracks"), strict=True):
        assert type(after) is type(before)
        for field in dataclasses.fields(before):
            a, b = getattr(before, field.name), getattr(after, field.name)
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), field.name
            assert not isinstance(a, np.ndarray) or a.shape == b.shape


@pytest.mark.parametrize("raw", ["png", "raw"])
def test_every_encoding_gives_the_same_grey_levels(tmp_path: Path, raw: str) -> None:
    rng = np.random.default_rng(1)
    given: list[Sample] = []
    for name, form in RAW_FORMATS.items():
        row, rows = 8 * form.channels * form.bits // 8, 6 * form.rows // 2
        data = rng.integers(0, 256, row * rows, dtype=np.uint8).tobytes()
        given.append(ImageSample(stream="/c", t_ns=len(given), received_ns=9, encoding=name, payload=data,
                                 width_px=8, height_px=6, frame=len(given)))  # fmt: skip
    colours = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    for suffix, name in ((".png", "png"), (".jpg", "jpeg"), (".tiff", "tiff"), (".bmp", "bmp"), (".webp", "webp")):
        data = cv2.imencode(suffix, colours)[1].tobytes()
        given.append(ImageSample(stream="/c", t_ns=len(given), received_ns=9, encoding=name, payload=data,
                                 frame=len(given)))  # fmt: skip
    for before, after in zip(given, samples_back(tmp_path, given, "/c", raw), strict=True):
        assert isinstance(before, ImageSample)
        assert isinstance(after, ImageSample)
        assert (after.frame, after.t_ns, after.received_ns) == (before.frame, before.t_ns, before.received_ns)
        assert after.grey().dtype == before.grey().dtype, before.encoding
        np.testing.assert_array_equal(after.grey(), before.grey(), err_msg=before.encoding)


def test_stride_and_window_keep_their_numbers(tmp_path: Path) -> None:
    path = replayed(tmp_path, walk(), "correlation", "best", *COMMON, stride=2, start="0.1", stop="1.0")
    numbers = ask(Question(run=path)).logged["frame"]
    assert numbers[:3] == [4, 6, 8]
    answer = ask(Question(run=path, start="9", stop="17"))
    assert [row.frame for row in answer.rows] == [10, 12, 14, 16]
    assert answer.summary["frames_changed"] == 0


def test_a_later_run_adds_its_streams_and_takes_none_away(tmp_path: Path) -> None:
    replayed(tmp_path, walk(), "correlation", "best", *COMMON)
    constant = (*SMALL, "metres_per_px=0.01")
    later = replayed(tmp_path, walk(), "correlation", "best", *constant, name="later")
    same(tmp_path / "best.rrd", 12, 16)
    same(later, 12, 16)
    shutil.rmtree(tmp_path)
    replayed(tmp_path, walk(), "correlation", "best", *constant, name="later")
    replayed(tmp_path, walk(), "correlation", "best", *COMMON)
    same(tmp_path / "best.rrd", 12, 16)
    same(later, 12, 16)


# -------------------------------------------------------------------------- command, errors


def test_the_command(walked: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    shutil.copytree(walked["best"].parent, folder)
    words = ["whatif", str(folder / "best.rrd"), "--from", "0.3s", "--to", "14", "--set", "search_radius_px=10"]
    assert main([*words, "--fields", "inliers,pose", "--name", "wide"]) == 0
    table = capsys.readouterr().out
    assert "search_radius_px: 8 → 10" in table or "→ 10" in table
    assert table.splitlines()[1].split()[0] == "10"
    assert main([*words, "--json", "--name", "wide"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [one["frame"] for one in values["frames"]] == [10, 11, 12, 13]
    from workbench.rrd import read_fields

    answer = ask(
        Question(run=folder / "best.rrd", start="10", stop="14", overrides=("search_radius_px=10",), name="wide")
    )
    write(answer)
    kept = read_fields(folder / "best.whatif-wide.rrd", "best.whatif-wide", type(answer.steps[0]), ["frame", "pose"])
    assert kept["frame"] == [10, 11, 12, 13]
    np.testing.assert_array_equal(kept["pose"], [step.pose for step in answer.steps])
    assert not any(check.problems for check in manifest.verify(folder, "best.whatif-wide"))
    (folder / "paper-a.toml").unlink()
    assert len(same(folder, 10, 14).rows) == 4  # one run, what-ifs not counted


@pytest.mark.parametrize(
    ("spoil", "question", "kind", "words"),
    [
        (None, {"start": "60"}, StreamError, "no frame from 60 to the end; the run has frames 0 to 39"),
        (None, {"start": "9", "stop": "9"}, StreamError, "no frame from 9 to 9"),
        (None, {"start": "soon"}, StreamError, "'soon' is not a time"),
        (None, {"overrides": ("serch=3",)}, SettingsError, "unknown setting 'serch'"),
        (None, {"overrides": ("height_stream='/z'",)}, StreamError, "did not read it; replay"),
        (None, {"fields": ("colour",)}, StreamError, "--fields colour"),
        (None, {"name": "a/b"}, SettingsError, "--name 'a/b'"),
        ("best.checkpoints", {"start": "9"}, RecordingError, "best.checkpoints: the run has no checkpoints; replay"),
        ("sensors.rrd", {}, RecordingError, "sensors.rrd: is missing.*; replay"),
        ("sensors.toml", {}, RecordingError, "sensors.rrd: is missing.*; replay"),
        ("best.toml", {}, RecordingError, "run/best: there is no such run"),
    ],
)
def test_what_cannot_be_answered(
    walked: dict[str, Path], tmp_path: Path, spoil: str | None, question: Any, kind: Any, words: str
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(walked["best"].parent, folder)
    if spoil:
        (folder / spoil).unlink()
    with pytest.raises(kind, match=words) as error:
        ask(Question(run=folder / "best.rrd", **question))
    assert isinstance(error.value, WorkbenchError)
    assert "\n" not in str(error.value)


def test_samples_of_another_recording_or_window_are_refused(walked: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(walked["best"].parent, folder)
    record = folder / "sensors.toml"
    text = record.read_text()
    record.write_text(text.replace('digest = "', 'digest = "0'))
    with pytest.raises(RecordingError, match="of another recording than best"):
        ask(Question(run=folder / "best.rrd"))
    record.write_text(text.replace("stride = 1", "stride = 2"))
    with pytest.raises(RecordingError, match="another window, stream"):
        ask(Question(run=folder / "best.rrd"))
    with pytest.raises(RecordingError, match=r"holds several runs: best, paper-a; give one"):
        ask(Question(run=folder))


def test_a_run_that_does_not_come_out_as_logged_is_told(walked: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(walked["best"].parent, folder)
    toml = folder / "best.toml"
    toml.write_text(toml.read_text().replace("mounting_yaw_rad = 0.0", "mounting_yaw_rad = 0.1"))
    with pytest.raises(RecordingError, match="frame 7 does not come out as it was logged"):
        ask(Question(run=folder / "best.rrd", start="9", stop="12"))


def test_both_estimators_can_be_resumed() -> None:
    from pipelines.estimator import Resumable

    assert isinstance(CorrelationOdometry(CorrelationSettings(metres_per_px=1.0)), Resumable)
    assert isinstance(RangeFilter(RangeSettings(focal_px=500.0, centre_px=(1.0, 1.0))), Resumable)
