"""What is written is read back bit for bit, whole or killed, and nothing of the wall clock is in it."""

import dataclasses
import functools
import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import fake_ranges
import fake_semidirect
import fake_steps
import numpy as np
import pytest
from rerun.chunk import RrdReader

import readers
from pipelines.correlation.step import CorrelationStep
from pipelines.estimator import Step
from pipelines.ranging.step import RangeStep
from pipelines.semidirect.baseline_step import BaselineStep
from pipelines.semidirect.step import SemidirectStep
from pipelines.verdict import Severity, Verdict
from readers.streams import ImageSample, RecordingError, ScalarSample, WorkbenchError
from workbench import rrd, traces
from workbench.blueprints import blueprint_of
from workbench.rrd_reading import chunks
from workbench.schema import CORRELATION, SCHEMAS

HALF_STEP = 2.0**-11  # half the distance of float16 numbers just below 2


def write_run(path: Path, steps: Iterable[Step], **more: Any) -> Path:
    with run_writer(path, **more) as writer:
        for step in steps:
            writer.step(step)
    return path


def run_writer(
    path: Path, *, run: str = "best", settings_text: str = "a = 1\n", step_type: type[Step] = CorrelationStep
) -> rrd.RunWriter:
    return rrd.RunWriter(
        path,
        recording_id="mission",
        run=run,
        estimator="correlation",
        step_type=step_type,
        settings_text=settings_text,
    )


def assert_same(written: Step, read: Step) -> None:
    for field in dataclasses.fields(written):
        a, b = getattr(written, field.name), getattr(read, field.name)
        if field.name == "surface":
            assert b.dtype == np.float32
            np.testing.assert_allclose(b, a, rtol=0, atol=HALF_STEP)
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype, field.name
            np.testing.assert_array_equal(a, b, strict=True)
        else:
            assert type(a) is type(b), field.name
            assert a == b or (math.isnan(a) and math.isnan(b)), field.name


def rows_of(path: Path, entity: str, component: str) -> dict[int, Any]:
    """Values of a component by frame."""
    found = {}
    for chunk in RrdReader(path).stream().filter(content=entity, is_static=False):
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            frames = batch.column("frame").to_pylist()
            found.update(zip(frames, batch.column(component).to_pylist(), strict=True))
    return found


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def timelines(path: Path) -> set[str]:
    return {name for chunk in RrdReader(path).stream() for name in chunk.timeline_names}


# ------------------------------------------------------------------------------ steps


@pytest.mark.parametrize("fragments", [2, 9])
def test_every_field_reads_back_bit_for_bit(tmp_path: Path, fragments: int) -> None:
    steps = list(fake_steps.steps(450, fragment_count=fragments))
    read = rrd.read_steps(write_run(tmp_path / "run.rrd", steps), "best", CorrelationStep)
    assert len(read) == len(steps)
    for a, b in zip(steps, read, strict=True):
        assert_same(a, b)


def test_large_integers_and_odd_floats_are_exact(tmp_path: Path) -> None:
    step = next(fake_steps.steps(1))
    odd = dataclasses.replace(
        step,
        t_ns=2**62 + 1,
        received_ns=-(2**53) - 1,
        alarms=Verdict.LOST | Verdict.FIRST_FRAME,
        mean_grey=5e-324,
        pose=np.array([1e300, -0.0, np.inf]),
    )
    (read,) = rrd.read_steps(write_run(tmp_path / "run.rrd", [odd]), "best", CorrelationStep)
    assert isinstance(read, CorrelationStep)
    assert (read.t_ns, read.received_ns, read.alarms, read.mean_grey) == (
        odd.t_ns,
        odd.received_ns,
        odd.alarms,
        odd.mean_grey,
    )
    assert read.pose.tobytes() == odd.pose.tobytes()


def test_a_set_of_alarms_never_seen_by_this_process_reads_back() -> None:
    step = next(fake_steps.steps(1))
    table = {name: list(values) for name, values in traces.columns(CORRELATION, [step]).items()}
    table["alarms"] = [np.float64(1 << 3 | 1 << 9 | 1 << 17)]
    (read,) = traces.rebuild(CORRELATION, table)
    assert read.alarms == Verdict.DUPLICATE_FRAME | Verdict.PEAK_AT_BORDER | Verdict.NOT_RIGID


def test_some_fields_read_back_alone(tmp_path: Path) -> None:
    steps = list(fake_steps.steps(20))
    path = write_run(tmp_path / "run.rrd", steps)
    read = rrd.read_fields(path, "best", CorrelationStep, ["pose", "frame", "verdict"])
    assert list(read) == ["pose", "frame", "verdict"]
    assert read["frame"] == list(range(20))
    np.testing.assert_array_equal(read["pose"], [step.pose for step in steps])
    np.testing.assert_array_equal(read["verdict"], [step.verdict for step in steps])
    table = rrd.read_table(path, "best", CorrelationStep, ["pose", "inliers", "shift_px"])
    assert table.index.name == "frame"
    assert list(table.columns[:4]) == ["pose[0]", "pose[1]", "pose[2]", "inliers"]
    for step in steps:
        assert table.loc[step.frame, "pose[2]"] == step.pose[2]
        np.testing.assert_array_equal(table.loc[step.frame, "shift_px[1,0]"], step.shift_px[1, 0])


def test_a_step_whose_fragments_change_reads_back(tmp_path: Path) -> None:
    steps = [*fake_steps.steps(5), *fake_steps.steps(5, fragment_count=2, start=5), *fake_steps.steps(3, start=10)]
    read = rrd.read_steps(write_run(tmp_path / "run.rrd", steps), "best", CorrelationStep)
    for a, b in zip(steps, read, strict=True):
        assert_same(a, b)


def test_runs_of_one_file_are_told_apart(tmp_path: Path) -> None:
    for run, seed in (("a", 1), ("b", 2)):
        write_run(tmp_path / f"{run}.rrd", fake_steps.steps(4, seed=seed), run=run)
    rrd.merge([tmp_path / "a.rrd", tmp_path / "b.rrd"], tmp_path / "both.rrd")
    for run, seed in (("a", 1), ("b", 2)):
        read = rrd.read_steps(tmp_path / "both.rrd", run, CorrelationStep)
        for a, b in zip(fake_steps.steps(4, seed=seed), read, strict=True):
            assert_same(a, b)


def test_an_unknown_run_and_a_missing_file_are_refused_by_name(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run.rrd", fake_steps.steps(2))
    with pytest.raises(RecordingError, match="no steps of a run named 'paper'"):
        rrd.read_steps(path, "paper", CorrelationStep)
    with pytest.raises(RecordingError, match="no such file"):
        rrd.read_steps(tmp_path / "none.rrd", "best", CorrelationStep)
    (tmp_path / "text.rrd").write_text("not a recording")
    with pytest.raises(RecordingError, match=r"text\.rrd: is not a Rerun recording"):
        rrd.read_steps(tmp_path / "text.rrd", "best", CorrelationStep)


def test_rerun_switched_off_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(WorkbenchError, match="unset RERUN"):
        run_writer(tmp_path / "run.rrd")


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        run_writer(tmp_path / "file" / "run.rrd")


# ------------------------------------------------------------------ time, size, survival


def test_only_the_two_timelines_and_equal_runs_give_equal_data(tmp_path: Path) -> None:
    digests = []
    for name, wait in (("a", 0.0), ("b", 0.02)):
        with run_writer(tmp_path / f"{name}.rrd") as writer:
            for step in fake_steps.steps(40):
                writer.step(step)
                if step.frame % 10 == 3:
                    time.sleep(wait)
                    writer.flush()
            writer.finish({"frames": 40}, np.zeros((3, 2)))
        digests.append(rrd.digest(tmp_path / f"{name}.rrd"))
        assert timelines(tmp_path / f"{name}.rrd") == {"frame", "sensor_time"}
    assert digests[0] == digests[1]
    assert rrd.digest(write_run(tmp_path / "c.rrd", fake_steps.steps(40, seed=2))) != digests[0]


def test_buffers_stay_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rrd, "MAX_AGE_S", math.inf)
    sizes = []
    with run_writer(tmp_path / "run.rrd") as writer:
        for step in fake_steps.steps(600):
            writer.step(step)
            sizes.append(len(writer._steps))
    bytes_a_step = next(fake_steps.steps(1)).surface.nbytes
    assert max(sizes) * bytes_a_step <= rrd.MAX_BYTES
    assert sizes.count(0) >= 2
    image = ImageSample(stream="i", t_ns=0, received_ns=0, encoding="jpeg", payload=bytes(300_000))
    with rrd.SensorWriter(tmp_path / "sensors.rrd", recording_id="mission") as sensors:
        for frame in range(30):
            sensors.image(frame, image)
            assert sensors._bytes <= rrd.MAX_BYTES


def test_full_buffers_are_sent_at_once_and_old_ones_are_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[str] = []
    waited = 0
    send, flush = rrd.RrdFile.send, rrd.RrdFile.flush

    def noted(file: Any, entity: str, *columns: Any) -> None:
        sent.append(entity)
        send(file, entity, *columns)

    def counted(file: Any) -> None:
        nonlocal waited
        waited += 1
        flush(file)

    monkeypatch.setattr(rrd.RrdFile, "send", noted)
    monkeypatch.setattr(rrd.RrdFile, "flush", counted)
    monkeypatch.setattr(rrd, "MAX_AGE_S", math.inf)
    image = ImageSample(stream="i", t_ns=0, received_ns=0, encoding="jpeg", payload=bytes(rrd.MAX_BYTES // 2))
    path = tmp_path / "sensors.rrd"
    with rrd.SensorWriter(path, recording_id="mission") as sensors:
        sensors.reference(fake_steps.reference(9))
        sent.clear()
        for frame in range(8):
            one = dataclasses.replace(image, t_ns=fake_steps.t_of(frame), frame=frame)
            sensors.sample(one, one)
            sensors.image(frame, one)
        assert set(sent) == {rrd.IMAGE}  # large, while the rows beside them are few
        assert len(sent) > 1
        assert waited == 0
        monkeypatch.setattr(rrd, "MAX_AGE_S", -1.0)
        sensors.image(8, dataclasses.replace(image, t_ns=fake_steps.t_of(8), frame=8))
        assert waited == 1
        assert "/sensors/streams/i" in sent
    assert sorted(rows_of(path, rrd.IMAGE, "EncodedImage:blob")) == list(range(9))
    assert sorted(rows_of(path, f"{rrd.REFERENCE}/pose", "Points3D:positions")) == list(range(9))
    assert sorted(rows_of(path, "/sensors/streams/i", "Sample:order")) == list(range(8))


def test_a_frame_costs_at_most_25_kb_beyond_its_image(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run.rrd", fake_steps.steps(300))
    assert path.stat().st_size / 300 < 25_000


def test_a_killed_process_loses_less_than_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    child = subprocess.Popen(
        [sys.executable, "-c", _ENDLESS, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env=dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)),
    )
    assert child.stdout is not None
    logged = [line.split() for _, line in zip(range(120), child.stdout, strict=False)]
    child.send_signal(signal.SIGKILL)
    logged += [line.split() for line in child.stdout if line.endswith("\n")]
    child.wait()
    child.stdout.close()
    read = rrd.read_steps(path, "best", CorrelationStep)
    last_s = float(logged[-1][1])
    due = sum(float(at) <= last_s - 1.0 for _, at in logged)
    assert len(read) >= due > 20
    for a, b in zip(fake_steps.steps(len(read)), read, strict=True):
        assert_same(a, b)


_ENDLESS = textwrap.dedent(
    """
    import sys, time
    import fake_steps
    from test_rrd import run_writer
    writer = run_writer(sys.argv[1])
    for step in fake_steps.steps(100_000):
        writer.step(step)
        print(step.frame, time.monotonic(), flush=True)
        time.sleep(0.015)
    """
)


def test_a_torn_file_reads_up_to_the_tear_and_can_be_recovered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rrd, "MAX_AGE_S", -1.0)
    whole = write_run(tmp_path / "run.rrd", fake_steps.steps(20))
    torn = tmp_path / "torn.rrd"
    torn.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * 0.55)])
    read = rrd.read_steps(torn, "best", CorrelationStep)
    assert 3 < len(read) < 20
    for a, b in zip(fake_steps.steps(len(read)), read, strict=True):
        assert_same(a, b)
    rrd.recover(torn, tmp_path / "fixed.rrd")
    assert RrdReader(tmp_path / "fixed.rrd").store().schema() is not None
    assert len(rrd.read_steps(tmp_path / "fixed.rrd", "best", CorrelationStep)) == len(read)


# ---------------------------------------------------------------------------- sensors


def test_stored_images_pass_through_unaltered(tmp_path: Path) -> None:
    surface = fake_steps.texture()
    images = [fake_steps.image(k, surface, encoding) for k, encoding in enumerate(["jpeg", "png", "jpeg"])]
    images[1] = dataclasses.replace(images[1], payload=memoryview(images[1].data))
    path = tmp_path / "sensors.rrd"
    with rrd.SensorWriter(path, recording_id="mission") as writer:
        for frame, image in enumerate(images):
            writer.image(frame, image)
    blobs = rows_of(path, rrd.IMAGE, "EncodedImage:blob")
    media = rows_of(path, rrd.IMAGE, "EncodedImage:media_type")
    for frame, image in enumerate(images):
        assert bytes(blobs[frame][0]) == bytes(image.data)
        assert media[frame] == [image.media_type]


@pytest.mark.parametrize("raw_images", ["png", "raw"])
def test_raw_images_keep_every_pixel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raw_images: Any) -> None:
    pixels = np.random.default_rng(0).integers(0, 65536, (6, 8), np.uint16)
    rgb = np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)
    decoders = type(readers)("readers.images")
    decoders.decode_grey = lambda sample: pixels
    decoders.decode_colour = lambda sample: rgb
    monkeypatch.setitem(sys.modules, "readers.images", decoders)
    path = tmp_path / "sensors.rrd"
    with rrd.SensorWriter(path, recording_id="mission", raw_images=raw_images) as writer:
        for frame, encoding in enumerate(["mono16", "bgr8"]):
            sample = ImageSample(stream="i", t_ns=frame, received_ns=frame, encoding=encoding, payload=b"")
            writer.image(frame, sample)
    if raw_images == "raw":
        buffers = rows_of(path, rrd.IMAGE, "Image:buffer")
        assert bytes(buffers[0][0]) == pixels.tobytes()
        assert bytes(buffers[1][0]) == rgb.tobytes()
    else:
        blobs = rows_of(path, rrd.IMAGE, "EncodedImage:blob")
        stored = [cv2.imdecode(np.array(blobs[k][0], np.uint8), cv2.IMREAD_UNCHANGED) for k in (0, 1)]
        np.testing.assert_array_equal(stored[0], pixels)
        np.testing.assert_array_equal(stored[1][..., ::-1], rgb)


def test_a_frame_without_an_image_says_why_and_shows_none(tmp_path: Path) -> None:
    path = tmp_path / "sensors.rrd"
    with rrd.SensorWriter(path, recording_id="mission") as writer:
        writer.image(0, fake_steps.image(0, fake_steps.texture()))
        writer.undecodable(1, fake_steps.t_of(1), "JPEG ends early")
    assert rows_of(path, "/camera/problems", "TextLog:text") == {1: ["JPEG ends early"]}
    assert rows_of(path, rrd.IMAGE, "Clear:is_recursive") == {1: [False]}


def test_the_reference_lies_at_every_image_between_its_poses(tmp_path: Path) -> None:
    surface = fake_steps.texture()
    path = tmp_path / "sensors.rrd"
    with rrd.SensorWriter(path, recording_id="mission") as writer:
        writer.facts(["format: made up"])
        writer.reference(fake_steps.reference(9)[::-1])
        for frame in range(12):
            writer.image(frame, fake_steps.image(frame, surface))
    points = rows_of(path, f"{rrd.REFERENCE}/pose", "Points3D:positions")
    assert sorted(points) == list(range(9))
    for frame in (0, 3, 8):
        np.testing.assert_allclose(points[frame][0][:2], fake_steps.path(frame)[:2], atol=1e-5)
    assert {"/recording/facts", f"{rrd.REFERENCE}/path", "/world/scale"} <= entities(path)


# ------------------------------------------------------------------- pictures and verdicts


def test_surfaces_lie_as_their_fragments_on_the_image() -> None:
    px = np.array([[300.0, 100.0], [100.0, 300.0], [100.0, 103.0], [300.0, 297.0]])
    assert traces.cells(px, 21).tolist() == [[0, 1], [1, 0], [0, 0], [1, 1]]
    assert traces.cells(np.full((3, 2), np.nan), 21).tolist() == [[0, 0], [0, 1], [0, 2]]
    surfaces = np.arange(4 * 9, dtype=np.float32).reshape(1, 4, 3, 3)
    image = traces.mosaic(surfaces, traces.cells(px, 21))[0]
    assert image.shape == (7, 7)
    assert np.isnan(image[3]).all()
    assert np.isnan(image[:, 3]).all()
    np.testing.assert_array_equal(image[:3, 4:], surfaces[0, 0])
    np.testing.assert_array_equal(traces.unmosaic(image, traces.cells(px, 21)), surfaces[0])


def test_the_peaks_are_marked_where_the_surface_is_highest(tmp_path: Path) -> None:
    steps = list(fake_steps.steps(30))
    (group,) = traces.mosaics(traces.columns(CORRELATION, steps))
    for row in range(1, 30):
        if Verdict.PEAK_AMBIGUOUS in steps[row].alarms:
            continue
        for k, corner in enumerate(group.corners.astype(int)):
            surface = np.nan_to_num(steps[row].surface[k], nan=-1)
            v, u = np.unravel_index(surface.argmax(), surface.shape)
            marked = group.first[row, k] - 0.5 - corner
            assert np.abs(marked - [u, v]).max() <= 1  # noise may lift a neighbour


def test_matches_lie_where_the_shift_says(tmp_path: Path) -> None:
    steps = list(fake_steps.steps(3))
    path = write_run(tmp_path / "run.rrd", steps)
    boxes = rows_of(path, f"{rrd.IMAGE}/best/matches", "Boxes2D:centers")
    assert boxes[0] == []
    np.testing.assert_allclose(boxes[2], steps[2].fragment_px + steps[2].shift_px + 0.5, atol=1e-4)
    halves = rows_of(path, f"{rrd.IMAGE}/best/search", "Boxes2D:half_sizes")
    assert halves[2][0] == [fake_steps.SIDE / 2 + fake_steps.RADIUS] * 2


def test_the_ellipse_has_the_axes_of_the_covariance() -> None:
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = np.zeros((2, 3, 3))
    covariance[0, :2, :2] = turn @ np.diag([4.0, 1.0]) @ turn.T
    covariance[1] = np.nan
    half, angle = traces.ellipses(covariance, sigmas=1.0)
    np.testing.assert_allclose(half[0], [1, 2])
    np.testing.assert_allclose(abs(np.cos(angle[0])), 0.6)  # the first axis is the shorter one
    assert np.isnan(half[1]).all()


def test_events_stand_where_the_verdict_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rrd, "MAX_ROWS", 50)
    path = tmp_path / "run.rrd"
    with run_writer(path) as writer:
        for step in fake_steps.steps(320):
            writer.step(step)
        writer.event(7, fake_steps.t_of(7), Severity.ERROR, "3 frames missing")
    root = "/runs/best/correlation"
    events = {k: v[0] for k, v in rows_of(path, f"{root}/events", "TextLog:text").items()}
    assert sorted(events) == [0, 7, 120, 128, 140, 300, 306]
    assert events[120].startswith("PEAK_AMBIGUOUS: the second correlation peak")
    assert events[140] == "OK again after 12 frames of NOT_RIGID"
    levels = rows_of(path, f"{root}/events", "TextLog:level")
    assert [levels[k] for k in (7, 120, 128, 140)] == [["ERROR"], ["WARN"], ["ERROR"], ["INFO"]]
    states = rows_of(path, f"{root}/verdict", "StateChange:state")
    assert states[1] == ["OK"]
    assert states[306] == ["OK"]
    lane = rows_of(path, f"{root}/verdicts/PEAK_AMBIGUOUS", "StateChange:state")
    assert lane == {120: ["PEAK_AMBIGUOUS"], 135: [""]}
    alarms = rows_of(path, f"{root}/alarms", "TextLog:text")
    assert len(alarms) == 1 + 20 + 6
    assert alarms[130][0].startswith("NOT_RIGID, PEAK_AMBIGUOUS: ")


def test_the_lag_of_log_time_after_the_stamps_is_a_series(tmp_path: Path) -> None:
    """Of the samples that have a stamp: 5 ms, 7 ms and one that came before its stamp."""
    path, second = tmp_path / "sensors.rrd", 1_000_000_000
    with rrd.SensorWriter(path, recording_id="mission") as writer:
        for k, lag_ms in enumerate((5, 7, None, -2)):
            t_ns = (k + 1) * second
            own = -1 if lag_ms is None else t_ns
            received_ns = t_ns + 1_000_000 * (lag_ms or 0)
            sample = ScalarSample(stream="/h", t_ns=t_ns, received_ns=received_ns, header_ns=own, value=1.0)
            writer.sample(sample, sample)
        writer.sample(*[ScalarSample(stream="/bare", t_ns=second, received_ns=second, value=2.0)] * 2)
    rows = {}
    for chunk in chunks(path, "/sensors/clocks/h"):
        batch = chunk.to_record_batch()
        times = (moment.value for moment in batch.column("sensor_time").to_pylist())
        rows |= dict(zip(times, batch.column("Scalars:scalars").to_pylist(), strict=True))
    assert rows == {second: [5.0], 2 * second: [7.0], 4 * second: [-2.0]}
    assert "/sensors/clocks/bare" not in entities(path)
    assert "Log time after stamp, ms" in view_names(path)


def test_the_tables_show_the_matrices() -> None:
    step = list(fake_steps.steps(2))[1]
    (text,) = traces.numbers(traces.columns(CORRELATION, [step]))
    assert f"{step.pose_covariance[0, 0]:.2e}" in text
    assert f"{step.motion_covariance[2, 2]:.2e}" in text
    assert f"{step.hessian[8, 0, 1]:.4g}" in text


def test_finish_adds_errors_summary_paths_and_the_view(tmp_path: Path) -> None:
    steps = list(fake_steps.steps(12))
    path = tmp_path / "run.rrd"
    values = np.arange(48.0).reshape(12, 4)
    with run_writer(path) as writer:
        for step in steps:
            writer.step(step)
        writer.errors(np.arange(12), np.array([s.t_ns for s in steps]), values)
        writer.finish({"frames": 12, "path m": 1 / 3}, np.array([[0.0, 1.0], [np.nan, 0.0], [2.0, 2.0]]))
    assert rows_of(path, "/runs/best/correlation/error", "Scalars:scalars")[5] == values[5].tolist()
    assert len(RrdReader(path).blueprints()) >= 1
    lines = {f"/world/runs/best/path/{name}" for name in ("raw", "corrected", "aligned")}
    assert {*lines, "/world/runs/best/heading", "/runs/best/summary", "/runs/best/settings"} <= entities(path)


def test_a_run_of_no_steps_closes(tmp_path: Path) -> None:
    with run_writer(tmp_path / "run.rrd") as writer:
        writer.finish({}, None)
    assert RrdReader(tmp_path / "run.rrd").store() is not None


def test_a_second_close_does_nothing(tmp_path: Path) -> None:
    writer = run_writer(tmp_path / "run.rrd")
    steps: Sequence[Step] = list(fake_steps.steps(3))
    for step in steps:
        writer.step(step)
    writer.close()
    writer.close()
    assert len(rrd.read_steps(tmp_path / "run.rrd", "best", CorrelationStep)) == 3


RUNS: dict[type[Step], tuple[Callable[[int], Iterable[Step]], set[str]]] = {
    CorrelationStep: (fake_steps.steps, {"Correlation surfaces", "Second / first"}),
    RangeStep: (fake_ranges.steps, {"Ranges Z, m", "Ranges: 0.5 m red to 50 m blue"}),
    BaselineStep: (fake_semidirect.baseline_steps, {"Corners of the frame", "Map: path blue, reference green"}),
    SemidirectStep: (fake_semidirect.steps, {"Cost, grey²", "By outcome"}),
}


@pytest.mark.parametrize("step_type", SCHEMAS)
def test_both_files_can_bring_the_same_view(tmp_path: Path, step_type: type[Step]) -> None:
    view = functools.partial(blueprint_of, step_type, "best", "correlation")
    shown = []
    for name, given in (("plain", {}), ("run", {"view": view})):
        with rrd.SensorWriter(tmp_path / f"{name}.rrd", recording_id="mission", **given) as writer:
            writer.reference(fake_steps.reference(20))
        shown.append(view_names(tmp_path / f"{name}.rrd"))
    steps, own = RUNS[step_type]
    write_run(tmp_path / "best.rrd", steps(3), step_type=step_type)
    run = view_names(tmp_path / "best.rrd")
    assert shown[1] <= run
    assert shown[1] > shown[0] - {"Image", "Map: reference green, raw grey, corrected blue, aligned violet"}
    assert {"Verdicts", "Events", "Recording", *own} <= shown[1]


def view_names(path: Path) -> set[str]:
    reader = RrdReader(path)
    names: set[str] = set()
    for blueprint in reader.blueprints():
        for chunk in reader.stream(store=blueprint).filter(components="ViewBlueprint:display_name"):
            for row in chunk.to_record_batch().column("ViewBlueprint:display_name").to_pylist():
                names.update(row)
    return names
