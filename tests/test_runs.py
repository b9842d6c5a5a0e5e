"""A run is read back as it was written: by its files, its numbers, its images, its reference."""

from pathlib import Path

import numpy as np
import pytest

from pipelines.correlation.step import CorrelationStep
from readers.streams import RecordingError
from workbench import rrd
from workbench.runs import Run, open_run, runs_in
from workbench.scenarios import open_scenario
from workbench.session import Request, run

FRAMES = 40


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("runs")
    request = Request(
        path=Path("sim:demo"), stop=str((FRAMES - 0.5) / 60), out=folder, overrides=("max_peak_ratio=0.9",)
    )
    run(request)
    return open_run(folder)


def test_run_is_found_by_any_of_its_files(replayed: Run) -> None:
    for name in ("best.rrd", "best.toml", "best.tum", "best"):
        assert open_run(replayed.folder / name).file == replayed.file
    assert [one.name for one in runs_in([replayed.folder])] == ["best"]
    assert replayed.estimator == "correlation"
    assert replayed.complete


def test_columns_are_the_steps(replayed: Run) -> None:
    steps = rrd.read_steps(replayed.file, "best", CorrelationStep)
    columns = replayed.columns(replayed.fields)
    assert len(steps) == len(replayed.frames) == replayed.summary["frames"]
    for name, values in columns.items():
        np.testing.assert_array_equal(values, np.array([getattr(step, name) for step in steps]), err_msg=name)
    assert replayed.verdicts == [step.verdict for step in steps]
    table = replayed.trace("correlation", ["shift_px", "dt_s"])
    assert table.loc[5, "shift_px[3,1]"] == steps[5].shift_px[3, 1]
    assert table.loc[5, "t_ns"] == steps[5].t_ns


def test_steps_of_some_frames_are_the_same_as_those_of_all(replayed: Run) -> None:
    whole = rrd.read_steps(replayed.file, "best", CorrelationStep)
    some = replayed.steps(7, 12)
    assert [step.frame for step in some] == [7, 8, 9, 10, 11]
    np.testing.assert_array_equal(some[2].surface, whole[9].surface)
    with pytest.raises(RecordingError, match="frame 900 to before 901"):
        replayed.steps(900, 901)


def test_image_and_reference_are_those_of_the_recording(replayed: Run) -> None:
    mission = open_scenario(Path("sim:demo"))
    image = replayed.image(7)
    assert image is not None
    np.testing.assert_array_equal(image.grey(), mission.frame(7))
    assert replayed.image(10_000) is None
    reference, errors = replayed.reference, replayed.errors
    assert reference is not None
    assert errors is not None
    np.testing.assert_allclose(reference.pose[7], mission.truth_poses[7], atol=1e-9)
    assert len(errors.frame) == len(replayed.frames)


def test_changed_settings_are_those_that_differ_from_the_preset(replayed: Run) -> None:
    changed = replayed.changed_settings()
    assert changed["max_peak_ratio"] == (0.9, 0.95)
    assert "fragment_side_px" not in changed


def test_what_is_no_run_is_refused_by_name(replayed: Run, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="holds no run"):
        open_run(tmp_path)
    with pytest.raises(RecordingError, match="there is no such run"):
        open_run(tmp_path / "nothing.rrd")
    (tmp_path / "bad.toml").write_text("a = [", encoding="utf-8")
    with pytest.raises(RecordingError, match="cannot be read"):
        open_run(tmp_path / "bad.rrd")
    (tmp_path / "bad.toml").write_text("a = 1", encoding="utf-8")
    with pytest.raises(RecordingError, match=r"is not the RUN\.toml"):
        open_run(tmp_path / "bad.rrd")
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_bytes((replayed.folder / "best.toml").read_bytes())
    with pytest.raises(RecordingError, match="several runs"):
        open_run(tmp_path)
    with pytest.raises(KeyError, match="has no field 'shift'"):
        replayed.column("shift")
    with pytest.raises(RecordingError, match="no frame 900"):
        replayed.row_of(900)
