"""The rules of visual odometry on made steps, and what plants their faults."""

import dataclasses
import math
from typing import Any

import fake_semidirect as fake
import numpy as np
import pytest

from pipelines.evaluation import Trajectory
from pipelines.replay import replay
from pipelines.semidirect.odometry import SemidirectOdometry
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.step import SemidirectStep
from pipelines.simulation.mission import HEIGHT, IMAGE
from pipelines.simulation.scenario import build
from pipelines.verdict import Verdict
from workbench.diagnosis import diagnose, rules_of
from workbench.diagnosis.finding import Case, Finding
from workbench.diagnosis.scoring import PRESETS, TABLES, Planted, Trial, score, table_of
from workbench.diagnosis.visual_scoring import FRAMES, scenario, settings_for

FIRST = fake.LOST.stop + 1
"""From here on the made camera has a pose in every frame."""


def flight(number: int = 200, metres: float = 1.0, bend: float = 0.0) -> tuple[list[SemidirectStep], Trajectory]:
    """Steps of a level flight along x, whose path is so many times its reference, and so much more at its end."""
    steps, truth = [], []
    x = 0.0
    for k, step in enumerate(list(fake.steps(number + FIRST))[FIRST:]):
        x += 0.03 * metres * (1 + bend * k / number)
        place = np.array([x, 0.0, 1.5])
        sharpness, grey = 0.02 + 1e-5 * math.sin(k), 100 + math.sin(k)
        alike = {"position_m": place, "pose": np.array([x, 0.0, 0.0]), "mean_grey": grey, "sharpness": sharpness}
        steps.append(dataclasses.replace(step, alarms=Verdict.OK, scene_depth_m=1.5, **alike))
        truth.append((step.t_ns, 0.03 * (k + 1)))
    times, way = (np.array(column) for column in zip(*truth, strict=True))
    reference = Trajectory.of(times.astype(np.int64), np.column_stack([way, 0 * way, 0 * way]))
    return steps, reference


def found(steps: list[SemidirectStep], reference: Trajectory | None = None) -> dict[str, Finding]:
    case = Case.of_steps(steps, "semidirect", {"min_tracked": 1}, reference)
    return {finding.rule: finding for finding in diagnose(case)}


def changed(steps: list[SemidirectStep], rows: range, **values: Any) -> list[SemidirectStep]:
    return [dataclasses.replace(s, **values) if k in rows else s for k, s in enumerate(steps)]


NEW = {"repeated-frames", "swapped-stamps", "blur", "image-noise", "wrong-scale", "scale-drift-by-reference"}


def test_a_clean_flight_has_none_of_these() -> None:
    assert not NEW & set(found(*flight()))


def test_a_picture_that_came_twice_is_told() -> None:
    steps, _ = flight()
    steps = changed(steps, range(60, 63), mean_grey=steps[59].mean_grey, sharpness=steps[59].sharpness)
    first = steps[0].frame
    assert found(steps)["repeated-frames"].spans == ((first + 60, first + 62),)
    black = changed(flight()[0], range(60, 80), mean_grey=0.0, sharpness=0.0)
    assert "repeated-frames" not in found(black)  # all black frames are alike


def test_pairs_of_frames_with_each_others_stamps_are_told_and_are_no_drift() -> None:
    steps, reference = flight()
    places = [(step.position_m, step.pose) for step in steps]
    for k in range(50, 70, 2):
        steps[k] = dataclasses.replace(steps[k], position_m=places[k + 1][0], pose=places[k + 1][1])
        steps[k + 1] = dataclasses.replace(steps[k + 1], position_m=places[k][0], pose=places[k][1])
    told = found(steps, reference)
    first = steps[0].frame
    assert told["swapped-stamps"].spans == ((first + 50, first + 69),)
    assert "scale-drift-by-reference" not in told
    one = flight()[0]
    one[50], one[51] = (dataclasses.replace(one[a], position_m=places[b][0]) for a, b in ((50, 51), (51, 50)))
    assert "swapped-stamps" not in found(one)  # again and again, says the rule


@pytest.mark.parametrize(("times", "rule", "other"), [(0.5, "blur", "image-noise"), (2.5, "image-noise", "blur")])
def test_pictures_less_sharp_or_rougher_than_those_about_them(times: float, rule: str, other: str) -> None:
    steps, _ = flight()
    steps = [dataclasses.replace(s, sharpness=times * s.sharpness) if 80 <= k < 100 else s for k, s in enumerate(steps)]
    told = found(steps)
    first = steps[0].frame
    assert told[rule].spans == ((first + 80, first + 99),)
    assert told[rule].evidence[0].value / told[rule].evidence[0].usual == pytest.approx(times, rel=0.01)
    assert other not in told
    dark = changed(steps, range(80, 100), mean_grey=1.0)
    assert rule not in found(dark)  # nothing is to be seen there


def test_a_path_of_another_length_is_a_wrong_scale_and_no_drift() -> None:
    told = found(*flight(metres=1.08))
    assert told["wrong-scale"].evidence[0].value == pytest.approx(0.08, abs=1e-3)
    assert "scale-drift-by-reference" not in told
    assert "wrong-scale" not in found(*flight(metres=1.03))
    steps, reference = flight(metres=1.08)
    unknown = changed(steps, range(len(steps)), scale_known=0)
    assert "wrong-scale" not in found(unknown, reference)  # lengths are no metres there


def test_a_path_that_grows_is_a_drift() -> None:
    told = found(*flight(metres=0.95, bend=0.1))
    assert told["scale-drift-by-reference"].evidence[0].value == pytest.approx(0.07, abs=0.03)
    assert "wrong-scale" not in told


def test_a_late_stamp_is_a_gap_and_no_drift() -> None:
    """From frame 60 on the reference is read 0.1 s later than the pictures were taken."""
    steps, reference = flight()
    late = [dataclasses.replace(s, t_ns=s.t_ns + 100_000_000) if k >= 60 else s for k, s in enumerate(steps)]
    late[60] = dataclasses.replace(late[60], alarms=Verdict.FRAME_GAP)
    told = found(late[:180], reference)
    assert "frame-gap" in told
    assert "scale-drift-by-reference" not in told


def test_a_map_that_ran_out_over_bare_ground_is_lost_for_want_of_texture() -> None:
    steps = list(fake.steps(90))
    usual = [dataclasses.replace(step, filters=200) for step in steps]
    assert "lost-points" in found(usual)
    before = range(fake.LOST.start - 12, fake.LOST.start)
    told = found(changed(usual, before, filters=20))
    assert "lost-points" not in told
    assert told["lost-flat"].evidence[1].name == "filters"
    assert told["lost-flat"].evidence[1].value == 20


# ------------------------------------------------------------------------------- planted faults


def test_every_rule_that_is_planted_exists() -> None:
    table = table_of("semidirect", PRESETS["semidirect"])
    names = {rule.name for rule in rules_of("semidirect")}
    assert {planted.rule for planted in table} - {""} <= names
    assert {name for planted in table for name in planted.also} <= names
    assert len({planted.fault for planted in table}) == len(table) > 15
    assert set(TABLES) == {"correlation", "range", "semidirect"}


def test_a_flight_follows_from_its_seed_and_brings_its_calibration() -> None:
    fault = {"kind": "wrong-calibration", "start_s": 0.0, "stop_s": 1e3, "focal_factor": 1.1}
    assert scenario(7, {}) == scenario(7, {})
    assert scenario(7, {}) != scenario(8, {})
    mission = build(scenario(7, {"faults": [fault]}))
    settings = settings_for(mission, "fast", {"settings": {"height_offset_m": 0.2}})
    assert settings.focal_px == pytest.approx(1.1 * 268.0)
    assert settings.height_offset_m == 0.2
    assert settings.min_tracked == SemidirectSettings.preset("fast").min_tracked
    assert scenario(7, {}).frames == FRAMES


def test_what_a_fault_leads_to_counts_neither_way() -> None:
    steps = list(fake.steps(120))
    case = Case.of_steps(steps, "semidirect", {"min_tracked": 10})
    planted = Planted(
        fault="x",
        rule="lost-points",
        trial=lambda seed: Trial(case, np.array([step.frame in fake.LOST for step in steps])),
        strength="",
    )
    assert "after-relocalisation" in score(planted, 0).here
    assert (
        "after-relocalisation"
        not in score(dataclasses.replace(planted, also=frozenset({"after-relocalisation"})), 0).here
    )


def test_a_leap_over_weak_texture_is_lost_by_the_looks_of_the_points() -> None:
    """On concrete half of the points settle on something near and agree by chance."""
    leap = {"kind": "turn-jump", "start_s": 0.705, "stop_s": 1.0, "turn_rad": -0.93}
    mission = build(scenario(23, {"faults": [leap], "frames": 60}))
    usual = settings_for(mission, "fast", {"settings": {"min_tracked": 10, "max_drop": 0.95}})
    for most_px, lost in ((usual.unlike_px, True), (1e3, False)):
        estimator = SemidirectOdometry(usual.model_copy(update={"unlike_px": most_px}))
        steps = [one.step for one in replay(mission, estimator, image_stream=IMAGE, other_streams=[HEIGHT])]
        hit = next(k for k, step in enumerate(steps) if step.t_ns - steps[0].t_ns >= 705_000_000)
        assert steps[hit - 1].accepted
        assert (Verdict.POINTS_UNLIKE in steps[hit].alarms) == lost
        assert any(step.accepted for step in steps[hit : hit + 10]) == (not lost)
