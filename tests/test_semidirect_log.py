"""The log of the visual odometries: bit for bit, what is drawn is where it belongs, and the same data every time."""

from pathlib import Path

import fake_semidirect as fake
import numpy as np
import pytest
from test_rrd import assert_same

from pipelines.semidirect import depth_filter
from pipelines.semidirect.baseline_step import BaselineStep
from pipelines.semidirect.step import SemidirectStep
from workbench import rrd, rrd_reading
from workbench.schema import BASELINE, SCHEMAS, SEMIDIRECT, Archetype, quantities


def logged(path: Path, number: int = 90, **more: bool) -> list[SemidirectStep]:
    steps = list(fake.steps(number, **more))
    with rrd.RunWriter(
        path, recording_id="m", run="fast", estimator="semidirect", step_type=SemidirectStep, settings_text="a = 1"
    ) as writer:
        for step in steps:
            writer.step(step)
        writer.finish({"frames": number}, None)
    return steps


def test_every_field_reads_back_bit_for_bit(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 200)
    assert len({len(step.found_px) for step in steps}) > 10
    read = rrd.read_steps(tmp_path / "run.rrd", "fast", SemidirectStep)
    assert len(read) == len(steps)
    for a, b in zip(steps, read, strict=True):
        assert_same(a, b)


def test_every_field_of_the_baseline_reads_back_bit_for_bit(tmp_path: Path) -> None:
    steps = list(fake.baseline_steps(80))
    with rrd.RunWriter(
        tmp_path / "run.rrd", recording_id="m", run="b", estimator="ptam", step_type=BaselineStep, settings_text=""
    ) as writer:
        for step in steps:
            writer.step(step)
        writer.finish({}, None)
    for a, b in zip(steps, rrd.read_steps(tmp_path / "run.rrd", "b", BaselineStep), strict=True):
        assert_same(a, b)


def test_some_frames_read_back_alone(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 90)
    read = rrd.read_steps(tmp_path / "run.rrd", "fast", SemidirectStep, frames=range(61, 64))
    for a, b in zip(steps[61:64], read, strict=True):
        assert_same(a, b)  # lost: all its lists are empty


def test_a_list_reads_alone_as_an_array_of_arrays(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 30)
    names = ["found_px", "align_cost", "outcome_count", "tracked"]
    found = rrd_reading.columns(tmp_path / "run.rrd", "/runs/fast/semidirect", SEMIDIRECT, names)
    assert list(found) == ["frame", "t_ns", *names]
    assert found["found_px"].dtype == object
    for name in names:
        for step, value in zip(steps, found[name], strict=True):
            np.testing.assert_array_equal(value, getattr(step, name))
    assert found["outcome_count"].dtype == np.int64


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=lambda s: s.step_type.__name__)
def test_a_list_of_two_open_axes_has_a_list_as_long_as_the_first(schema: object) -> None:
    for field in schema.lists:  # type: ignore[attr-defined]
        shape = schema.shape(field)  # type: ignore[attr-defined]
        open_axes = [n for n in shape if isinstance(n, str)]
        assert open_axes == list(shape[: len(open_axes)])
        assert len(open_axes) == 1 or schema.leading(field)  # type: ignore[attr-defined]


def test_the_filters_outcomes_are_called_as_they_are() -> None:
    row = next(row for row in SEMIDIRECT.rows if row.field == "filter_count")
    names = tuple(outcome.name.lower().replace("_", " ") for outcome in sorted(depth_filter.Outcome))
    assert row.axes == (*names, "given up")
    assert "given up" in quantities(SemidirectStep)["filter_count"]["meaning"]


def test_every_open_length_is_a_list() -> None:
    for schema in (SEMIDIRECT, BASELINE):
        for row in schema.rows:
            open_axes = any(isinstance(n, str) for n in schema.shape(row.field))
            assert open_axes == (row.archetype is Archetype.LISTS), row.field
