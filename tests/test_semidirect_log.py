"""The log of the visual odometries: bit for bit, what is drawn is where it belongs, and the same data every time."""

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import fake_semidirect as fake
import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from test_rrd import assert_same, rows_of

from pipelines.semidirect import depth_filter
from pipelines.semidirect.baseline_step import BaselineStep
from pipelines.semidirect.step import Feature, SemidirectStep
from workbench import rrd, rrd_reading
from workbench import visual_traces as visual
from workbench.blueprints import Bounds, visual_blueprint
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


# ----------------------------------------------------------------------------------- what is drawn


def drawn(path: Path, entity: str, component: str) -> dict[int, Any]:
    return {frame: value for frame, value in rows_of(path, entity, component).items() if value is not None}


def test_the_same_steps_give_equal_data_however_they_are_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digests = []
    monkeypatch.setattr(rrd, "MAX_AGE_S", 99.0)
    for name, rows in (("a", 1024), ("b", 7)):
        monkeypatch.setattr(rrd, "MAX_ROWS", rows)
        logged(tmp_path / f"{name}.rrd", 120)
        digests.append(rrd.digest(tmp_path / f"{name}.rrd"))
    assert digests[0] == digests[1]


def test_points_lie_half_a_pixel_further_and_have_the_colour_of_their_outcome(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 40)
    places = drawn(tmp_path / "run.rrd", "/camera/image/fast/features", "Points2D:positions")
    colours = drawn(tmp_path / "run.rrd", "/camera/image/fast/features", "Points2D:colors")
    missed = drawn(tmp_path / "run.rrd", "/camera/image/fast/missed", "Points2D:positions")
    for step in steps[10:]:
        found = np.isin(step.outcome, (Feature.MATCHED, Feature.OUTLIER))
        np.testing.assert_allclose(places[step.frame], step.found_px[found] + 0.5, rtol=1e-6)
        np.testing.assert_allclose(missed[step.frame], step.predicted_px[~found] + 0.5, rtol=1e-6)
        red = [colour == 0xF44336FF for colour in colours[step.frame]]
        assert red == (step.outcome[found] == Feature.OUTLIER).tolist()


def test_segments_of_filters_that_were_searched_are_drawn_by_outcome(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 40)
    strips = drawn(tmp_path / "run.rrd", "/camera/image/fast/epipolar", "LineStrips2D:strips")
    colours = drawn(tmp_path / "run.rrd", "/camera/image/fast/epipolar", "LineStrips2D:colors")
    for step in steps[10:]:
        searched = step.filter_outcome != depth_filter.Outcome.UNSEEN
        ends = step.epipolar_px[searched].reshape(-1, 2, 2) + 0.5
        np.testing.assert_allclose(strips[step.frame], ends, rtol=1e-5)
        diverged = [colour == 0xF44336FF for colour in colours[step.frame]]
        assert diverged == (step.filter_outcome[searched] == depth_filter.Outcome.DIVERGED).tolist()


def test_map_and_camera_are_where_the_step_says(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 70)
    points = drawn(tmp_path / "run.rrd", "/world/runs/fast/map/points", "Points3D:positions")
    balls = drawn(tmp_path / "run.rrd", "/world/runs/fast/map/sigma", "Points3D:radii")
    frames = [step.frame for step in steps if len(step.map_id)]
    assert list(points) == frames
    for frame in frames:
        np.testing.assert_allclose(points[frame], steps[frame].map_point_m, rtol=1e-6)
        np.testing.assert_allclose(balls[frame], steps[frame].map_point_sigma_m, rtol=1e-6)
    halves = drawn(tmp_path / "run.rrd", "/world/runs/fast/map/covariance", "Ellipsoids3D:half_sizes")
    turns = drawn(tmp_path / "run.rrd", "/world/runs/fast/map/covariance", "Ellipsoids3D:quaternions")
    for frame in frames:
        axes = Rotation.from_quat(turns[frame]).as_matrix()
        spread = np.einsum("pij,pj,pkj->pik", axes, np.square(halves[frame]), axes)
        np.testing.assert_allclose(spread, steps[frame].map_point_covariance, atol=1e-8)
    camera = drawn(tmp_path / "run.rrd", "/world/runs/fast/camera", "Transform3D:translation")
    assert list(camera) == [step.frame for step in steps if step.accepted]
    np.testing.assert_allclose(camera[50][0], steps[50].position_m, rtol=1e-6)


def test_a_frustum_ends_where_the_corners_of_the_image_are() -> None:
    """A level camera at (1, 2, 3) that looks down: the corner (0, 0) of the image is ahead to the left."""
    down = fake.DOWN.as_quat()[None]
    (strip,) = visual.frusta(np.array([[1.0, 2, 3]]), down, (400.0, 200.0), np.array([800.0, 400.0]), np.array([0.5]))
    np.testing.assert_allclose(strip[0], [1, 2, 3])
    np.testing.assert_allclose(strip[1], [1 - 0.5, 2 + 0.5, 2.5], atol=1e-12)
    edges = {tuple(sorted((tuple(a), tuple(b)))) for a, b in itertools.pairwise(np.round(strip, 9).tolist())}
    assert len(edges) == 8


def test_the_lane_of_stages_changes_with_them(tmp_path: Path) -> None:
    logged(tmp_path / "run.rrd", 90)
    lane = drawn(tmp_path / "run.rrd", "/runs/fast/semidirect/stage", "StateChange:state")
    expected = {0: "FIRST", 1: "STARTING", 4: "STARTED", 5: "TRACKED", 60: "LOST", 75: "RELOCALISED", 76: "TRACKED"}
    assert {frame: value[0] for frame, value in lane.items()} == expected


def test_costs_of_a_level_are_the_first_and_the_last_one(tmp_path: Path) -> None:
    steps = logged(tmp_path / "run.rrd", 20)
    costs = drawn(tmp_path / "run.rrd", "/runs/fast/semidirect/alignment/level", "Scalars:scalars")
    assert costs[12] == steps[12].align_cost[:, [0, 3]].ravel().tolist()


# ---------------------------------------------------------------------------------------- filters


def table(rows: list[list[tuple[int, int, int]]]) -> dict[str, Any]:
    """A table of frames, each with filters (number, age, outcome), whose μ is number + frame / 100."""
    columns: dict[str, list[Any]] = {name: [] for name in ("filter_id", "filter_age", "filter_outcome")}
    for row in rows:
        for name, values in zip(columns, zip(*row, strict=True) if row else ((), (), ()), strict=True):
            columns[name].append(np.array(values, np.int64))
    n = len(rows)
    mu = [ids + frame / 100 for frame, ids in enumerate(columns["filter_id"])]
    one = [np.ones(len(ids)) for ids in mu]
    values = columns | {"filter_mu": mu, "filter_sigma": one, "filter_ratio": one, "filter_inlier": one}
    return values | {"frame": np.arange(n), "t_ns": np.arange(n) * 10}


def test_a_slot_follows_one_filter_to_its_end_then_the_next_that_starts() -> None:
    updated = int(depth_filter.Outcome.UPDATED)
    rows = [[(7, frame, updated), (9, frame, updated)] for frame in range(5)]
    rows += [[(9, frame, updated), (12, frame - 5, updated)] for frame in range(5, 9)]
    shown, diverged = visual.FilterLog().take(table(rows))
    followed = [[(row, number) for row, number, _ in slot] for slot in shown]
    assert followed[0] == [*((row, 7) for row in range(5)), *((row, 12) for row in range(5, 9))]
    assert followed[1] == [(row, 9) for row in range(9)]
    assert not any(followed[2:])
    assert not diverged
    np.testing.assert_allclose(shown[0][3][2], [7.03, 6.03, 8.03, 1, 1])


def test_a_filter_that_diverged_shows_its_course_up_to_there() -> None:
    gone = int(depth_filter.Outcome.DIVERGED)
    rows = [
        [(3, frame, gone if frame == visual.HISTORY_FRAMES + 4 else 0)] for frame in range(visual.HISTORY_FRAMES + 5)
    ]
    (course,) = visual.FilterLog().take(table(rows))[1]
    assert course.number == 3
    assert course.frame.tolist() == list(range(5, visual.HISTORY_FRAMES + 5))
    np.testing.assert_allclose(course.values[:, 0], 3 + course.frame / 100)


# ---------------------------------------------------------------------------------- the saved view


def shown(bounds: Bounds, step_type: type = SemidirectStep) -> dict[str, list[str]]:
    """The titles of the plots of each tab."""
    root = visual_blueprint(step_type, "r", "semidirect", bounds).root_container
    tabs = [tab for tab in walked(root) if isinstance(tab, rrb.Tabs)][2]
    return {str(tab.name): [str(view.name) for view in getattr(tab, "contents", ()) if hasattr(view, "name")]
            for tab in tabs.contents}  # fmt: skip


def walked(container: Any) -> list[Any]:
    inner = container.contents if isinstance(container, rrb.Container) else []
    return [container, *itertools.chain.from_iterable(walked(one) for one in inner)]


def logged_until_the_end(path: Path, steps: list[SemidirectStep], monkeypatch: pytest.MonkeyPatch) -> Bounds:
    """What the last view of a run of these steps is made from."""
    seen: list[Bounds] = []
    made = rrd.blueprint_of

    def spy(step_type: Any, run: str, estimator: str, bounds: Bounds) -> Any:
        seen.append(bounds)
        return made(step_type, run, estimator, bounds)

    monkeypatch.setattr(rrd, "blueprint_of", spy)
    with rrd.RunWriter(
        path, recording_id="m", run="fast", estimator="semidirect", step_type=SemidirectStep, settings_text=""
    ) as writer:
        for step in steps:
            writer.step(step)
        writer.finish({}, None)
    assert seen[0].silent == frozenset()  # before anything is known all plots are there
    return seen[-1]


def test_a_plot_that_would_be_empty_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = {"height_m": math.nan, "map_height_m": math.nan, "stage_ms": np.full(5, math.nan), "bundle_keyframes": 0,
               "bundle_points": 0, "bundle_outliers": 0}  # fmt: skip
    steps = [dataclasses.replace(step, **nothing, prior_position_m=step.position_m + 0.01) for step in fake.steps(80)]
    bounds = logged_until_the_end(tmp_path / "run.rrd", steps, monkeypatch)
    assert {"scale/height", "work/stages", "bundle/size", "error"} <= bounds.silent
    assert not {"tracked", "pose/position", "features/error", "alignment/level", "prior/correction"} & bounds.silent
    everything, left = shown(Bounds()), shown(bounds)
    assert set(everything) - set(left) == {"Height", "Errors"}
    assert "Bundle" in everything["Keyframes"]
    assert "Bundle" not in left["Keyframes"]
    assert everything["Times"] == ["Time of the stages, ms"]
    assert left["Times"] == []
    assert "stage_times=true" in fixed(tmp_path / "run.rrd", "/runs/fast/semidirect/untimed", "TextDocument:text")[0]


def fixed(path: Path, entity: str, component: str) -> Any:
    """What was logged once for the whole run."""
    chunk = next(iter(RrdReader(path).stream().filter(content=entity, components=component)))
    return chunk.to_record_batch().column(component).to_pylist()[0]


def test_a_run_without_a_map_shows_its_start_and_no_filters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bounds = logged_until_the_end(tmp_path / "run.rrd", list(fake.steps(4)), monkeypatch)
    tabs = shown(bounds)
    assert "features/error" in bounds.silent
    assert "One filter" not in tabs
    assert tabs["Start, lost"][:1] == ["Corners followed since the first view"]


def test_the_axis_of_times_leaves_out_the_compilation() -> None:
    stage_ms = np.full((500, 5), 2.0)
    stage_ms[3] = 9000.0  # the first start compiles
    assert visual.top_of_times(stage_ms) == pytest.approx(2.6)
    assert visual.top_of_times(np.full((4, 5), math.nan)) == 0.0
    assert visual.top_of_times(np.empty((0, 5))) == 0.0


def test_the_levels_of_the_alignment_have_colours_of_their_own(tmp_path: Path) -> None:
    colours = visual.level_colours(3).tolist()
    assert len(set(colours)) == 3
    assert all(colour & 0xFF == 0xFF for colour in colours)
    logged(tmp_path / "run.rrd", 40)
    pairs = fixed(tmp_path / "run.rrd", "/runs/fast/semidirect/alignment/level", "SeriesLines:colors")
    assert [colour | 0xFF for colour in pairs[::2]] == pairs[1::2]  # the same, paler before
    assert len(set(pairs)) == len(pairs)


def test_what_the_prior_was_off_is_drawn_where_there_is_a_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = [step.position_m for step in fake.steps(70)]
    steps = [
        dataclasses.replace(step, prior_position_m=there[max(k - 2, 0)], aligned_position_m=there[max(k - 1, 0)])
        for k, step in enumerate(fake.steps(70))
    ]
    logged_until_the_end(tmp_path / "run.rrd", steps, monkeypatch)
    rows = drawn(tmp_path / "run.rrd", "/runs/fast/semidirect/prior/correction", "Scalars:scalars")
    for step in steps:
        ends = (step.aligned_position_m, step.position_m)
        want = [np.linalg.norm(end - step.prior_position_m) if step.accepted else math.nan for end in ends]
        np.testing.assert_allclose(rows[step.frame], want, rtol=1e-12)


def test_the_numbers_tell_the_cost_of_every_iteration() -> None:
    step = next(step for step in fake.steps(60) if np.isfinite(step.align_cost).sum() > 3)
    columns = {field: np.array([getattr(step, field)]) if np.isscalar(getattr(step, field)) else [getattr(step, field)]
               for field in quantities(SemidirectStep)}  # fmt: skip
    text = visual.numbers({"frame": np.array([step.frame]), **columns}, semidirect=True)[0]
    for costs in step.align_cost:
        assert " → ".join(f"{cost:.4g}" for cost in costs[np.isfinite(costs)]) in text
