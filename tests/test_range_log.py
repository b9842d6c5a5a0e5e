"""The log of the range filter: bit for bit, what is drawn is where it belongs, and the same data every time."""

import dataclasses
import math
from pathlib import Path

import fake_ranges
import numpy as np
import pytest
from rerun.chunk import RrdReader
from test_rrd import assert_same, entities, rows_of

from pipelines.ranging.filter import Outcome, Status
from pipelines.ranging.step import RangeStep
from workbench import range_traces as ranges
from workbench import rrd, traces
from workbench.range_traces import Beside, RangeScene
from workbench.schema import RANGE

SLOTS, COUNT = 6, 4


def logged(path: Path, number: int = 60, scene: RangeScene | None = None) -> list[RangeStep]:
    steps = list(fake_ranges.steps(number, slots=SLOTS, count=COUNT))
    with rrd.RunWriter(
        path,
        recording_id="m",
        run="best",
        estimator="range",
        step_type=RangeStep,
        settings_text="a = 1",
        scene=scene or fake_ranges.scene(COUNT),
    ) as writer:
        for step in steps:
            writer.step(step, fake_ranges.beside(step.frame, SLOTS, COUNT))
        writer.finish({"frames": number}, None)
    return steps


def table_of(steps: list[RangeStep]) -> dict[str, np.ndarray]:
    return traces.columns(RANGE, steps)


# ---------------------------------------------------------------------------------- read back


def test_every_field_reads_back_bit_for_bit(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 450)
    odd = {step.outcome[COUNT - 1] for step in steps}
    assert {Outcome.PREDICTED, Outcome.UPDATED, Outcome.REJECTED} <= odd
    read = rrd.read_steps(tmp_path / "run.rrd", "best", RangeStep)
    assert len(read) == len(steps)
    for a, b in zip(steps, read, strict=True):
        assert_same(a, b)


def test_some_fields_read_back_alone_and_as_a_table(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 20)
    fields = rrd.read_fields(tmp_path / "run.rrd", "best", RangeStep, ["covariance", "nis"])
    np.testing.assert_array_equal(fields["covariance"], [step.covariance for step in steps])
    table = rrd.read_table(tmp_path / "run.rrd", "best", RangeStep, ["range_m", "omega_radps"])
    assert list(table.columns) == [*(f"range_m[{k}]" for k in range(SLOTS)), "omega_radps"]
    assert table.loc[7, "range_m[2]"] == steps[7].range_m[2]


def test_the_same_steps_give_equal_data_however_they_are_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digests = []
    for name, rows in (("a", 1024), ("b", 7)):
        monkeypatch.setattr(rrd, "MAX_ROWS", rows)
        monkeypatch.setattr(rrd, "MAX_AGE_S", 99.0)
        logged(tmp_path / f"{name}.rrd", scene=RangeScene())  # a dead-reckoned path goes on from cut to cut
        digests.append(rrd.digest(tmp_path / f"{name}.rrd"))
    assert digests[0] == digests[1]


# ------------------------------------------------------------------------------- what is drawn


def test_a_landmark_has_its_plots_to_itself(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 12)
    there = entities(tmp_path / "run.rrd")
    for slot in range(1, SLOTS + 1):
        assert {f"/runs/best/range/landmark/{slot}/{plot.name}" for plot in ranges.PLOTS} <= there
    values = rows_of(tmp_path / "run.rrd", "/runs/best/range/landmark/2/range", "Scalars:scalars")
    step, depth = steps[9], fake_ranges.beside(9, SLOTS, COUNT).depth_m[1]
    assert values[9] == [step.range_m[1], *step.range_interval_m[1], depth]
    reference = rows_of(tmp_path / "run.rrd", "/runs/best/range/reference", "Scalars:scalars")
    np.testing.assert_array_equal(reference[9], fake_ranges.beside(9, SLOTS, COUNT).depth_m)


def test_points_lie_half_a_pixel_further_on_the_image(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 12)
    points = rows_of(tmp_path / "run.rrd", "/camera/image/best/measured", "Points2D:positions")
    for step in steps:
        seen = step.measured_px[np.isfinite(step.measured_px).all(axis=1)]
        np.testing.assert_allclose(np.array(points[step.frame]).reshape(-1, 2), seen + 0.5, rtol=1e-6)


def test_landmarks_from_above_come_to_lie_on_their_surveyed_places(tmp_path: Path) -> None:
    logged(tmp_path / "run.rrd", 100)
    points = rows_of(tmp_path / "run.rrd", "/world/runs/best/landmarks/points", "Points3D:positions")
    truth = fake_ranges.places(COUNT)[:, :2]
    np.testing.assert_allclose(np.array(points[99])[:, :2], truth, atol=0.25)


def test_the_gate_is_where_the_nis_is_13_8() -> None:
    spread = np.array([[[4.0, 1.5], [1.5, 1.0]]])
    (line,) = ranges.gates(np.array([[10.0, 20.0]]), spread)
    away = line - [10.0, 20.0]
    np.testing.assert_allclose(np.einsum("mi,ij,mj->m", away, np.linalg.inv(spread[0]), away), ranges.GATE)
    np.testing.assert_allclose(line[0], line[-1])


def test_ellipses_from_above_are_the_spread_of_samples() -> None:
    step = list(fake_ranges.steps(60, slots=SLOTS, count=COUNT))[-1]
    table = table_of([step])
    camera = ranges.level(np.array([[1.0, 2.0, 0.7]]))
    scene = fake_ranges.scene(COUNT)
    above = ranges.from_above(table, camera, scene)
    rng = np.random.default_rng(1)
    x, _, xi = rng.multivariate_normal(step.mean[0], step.covariance[0], 20_000).T
    z = 1 / xi
    left = -(x - scene.centre_px[0]) / scene.focal_px * z
    c, s = math.cos(0.7), math.sin(0.7)
    samples = np.column_stack([1 + c * z - s * left, 2 + s * z + c * left])
    np.testing.assert_allclose(above.points[0], samples.mean(axis=0), atol=0.05)
    direction = np.array([math.cos(above.angle[0]), math.sin(above.angle[0])])
    assert above.half_axes[0, 0] == pytest.approx(2 * (samples @ direction).std(), rel=0.1)
    across = np.array([-direction[1], direction[0]])
    assert above.half_axes[0, 1] == pytest.approx(2 * (samples @ across).std(), rel=0.1)


def test_dead_reckoning_turns_right_for_a_positive_rate_about_the_axis_that_points_down() -> None:
    steps = [
        dataclasses.replace(step, omega_radps=0.1, speed_mps=1.0, dt_s=0.1)
        for step in fake_ranges.steps(100, slots=SLOTS, count=COUNT)
    ]
    path = ranges.dead_reckoned(table_of(steps), np.zeros(3))
    np.testing.assert_allclose(path[-1], [10 * math.sin(1.0), -10 * (1 - math.cos(1.0)), -1.0], atol=1e-3)


def test_colours_of_ranges_run_from_red_to_blue_and_have_a_place_for_everything() -> None:
    near, far, none, endless = ranges.range_colours(np.array([0.1, 90.0, np.nan, np.inf]))
    red, blue = near >> 24 & 0xFF, near >> 8 & 0xFF
    assert red > 2 * blue
    red, blue = far >> 24 & 0xFF, far >> 8 & 0xFF
    assert blue > red
    assert far == none == endless


def test_numbers_tell_each_carried_landmark_with_its_matrices() -> None:
    steps = list(fake_ranges.steps(30, slots=SLOTS, count=COUNT))
    table = table_of(steps)
    depth = np.array([fake_ranges.beside(step.frame, SLOTS, COUNT).depth_m for step in steps])
    texts = ranges.numbers(table, depth)
    lines = [line for line in texts[20].splitlines() if line.startswith(("| 0 |", "| 3 |"))]
    assert len(lines) == 6
    first = lines[0].split("|")
    assert first[4].strip() == f"{steps[20].range_m[0]:.3f}"
    assert first[7].strip() == f"{100 * (steps[20].range_m[0] / depth[20, 0] - 1):.2f}"
    assert "more landmarks" not in texts[20]


def test_labels_name_the_landmark_and_its_range_where_it_is_told() -> None:
    step = list(fake_ranges.steps(60, slots=SLOTS, count=COUNT))[-1]
    status = step.status.copy()
    status[1] = Status.UNKNOWN
    table = table_of([dataclasses.replace(step, status=status)])
    named = ranges.labels(table, np.isfinite(table["landmark_id"]))
    assert named[0] == f"0: {step.range_m[0]:.2f} m"
    assert named[1] == "1"


def test_the_view_has_a_tab_for_every_landmark_that_came(tmp_path: Path) -> None:
    logged(tmp_path / "run.rrd", 30)
    reader = RrdReader(tmp_path / "run.rrd")
    names = set()
    for blueprint in reader.blueprints():
        for chunk in reader.stream(store=blueprint).filter(components=["ContainerBlueprint:display_name"]):
            batch = chunk.to_record_batch()
            for row in batch.column("ContainerBlueprint:display_name").to_pylist():
                names.update(row or [])
    assert {"All", "1: no. 0", "2: no. 1", "3: no. 2", "4: no. 3"} <= names


def test_a_step_without_landmarks_and_without_reference_is_logged(tmp_path: Path) -> None:
    step = next(fake_ranges.steps(1, slots=SLOTS, count=COUNT))
    empty = {
        f.name: np.full_like(getattr(step, f.name), np.nan)
        for f in dataclasses.fields(step)
        if isinstance(getattr(step, f.name), np.ndarray)
    }
    bare = dataclasses.replace(step, **empty, speed_mps=math.nan, omega_radps=math.nan, landmarks=0, measured=0)
    with rrd.RunWriter(
        tmp_path / "run.rrd", recording_id="m", run="a", estimator="range", step_type=RangeStep, settings_text=""
    ) as writer:
        writer.step(bare)
        writer.step(dataclasses.replace(bare, frame=1), Beside(np.full((4, 4), np.nan), np.full(SLOTS, np.nan)))
        writer.finish({}, None)
    assert len(rrd.read_steps(tmp_path / "run.rrd", "a", RangeStep)) == 2
