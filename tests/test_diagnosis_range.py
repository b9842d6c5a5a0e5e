"""The rules of the range estimator: the geometry behind them against planted truth, and planted failures told."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from pipelines.ranging.landmarks.settings import TrackSettings
from pipelines.simulation.channels import rng_of
from pipelines.simulation.faults import GyroBias
from pipelines.verdict import Severity, Verdict
from workbench.diagnosis import diagnose, range_evidence, range_missions, range_rules, range_scoring, rules_of
from workbench.diagnosis.finding import Case
from workbench.diagnosis.range_missions import CLEAN, MISSIONS, OTHERS, UNSEEN, Plan
from workbench.diagnosis.scoring import score

SHARP = {"noise_px": 1e-3, "gyro": 1e-6, "speed": 1e-6}
USUAL = {"tracks": TrackSettings(sigma_px=0.2), "sigma_omega": 1e-3, "sigma_speed": 1e-2}


def case_of(monkeypatch: pytest.MonkeyPatch, plan: Plan) -> Case:
    """The case of a plan of one's own."""
    monkeypatch.setattr(range_missions, "MISSIONS", {"own": lambda rng: plan})
    return range_missions.replayed("own", 3).case


def sharp(seed: int = 3, **changes: Any) -> Plan:
    """A straight drive, nearly without noise; in turns the last rate, which is held, is no longer exact."""
    rng = rng_of(seed, "sharp")
    plan = range_missions.plan_of(rng, range_missions.straight(rng), **SHARP)
    settings = {**USUAL, **changes.pop("settings", {})}
    return dataclasses.replace(plan, settings=settings, **changes)


# ------------------------------------------------------------------- geometry and its truth


def test_tracks_tell_their_noise() -> None:
    made = range_missions.replayed("measurement-noise-too-small", 1).case
    plan = MISSIONS["measurement-noise-too-small"](rng_of(1, "measurement-noise-too-small"))
    noise = range_evidence.track_noise(made)
    assert noise.shown_px == pytest.approx(plan.noise_px, rel=0.1)
    assert noise.taken_px == pytest.approx(made.settings["tracks"]["sigma_px"], rel=1e-6)


def test_a_bias_of_the_gyro_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    bias = 0.01
    fault = GyroBias(start_s=0.0, stop_s=99.0, bias_radps=(0.0, 0.0, bias))
    case = case_of(monkeypatch, sharp(faults=(fault,)))
    found = range_evidence.pairs(case, 2.0, 1.0)
    assert len(found) >= 12
    # the gyro turns to the left beyond the image, which so turns to the right of it
    rates = [range_evidence.turn_of(pair, 1e-6)[0] for pair in found]
    assert np.median(rates) == pytest.approx(bias, rel=0.02)


@pytest.mark.parametrize("off", [(5.0, -8.0), (0.0, 6.0)])
def test_a_wrong_principal_point_is_measured(monkeypatch: pytest.MonkeyPatch, off: tuple[float, float]) -> None:
    centre = (range_missions.CENTRE_PX[0] + off[0], range_missions.CENTRE_PX[1] + off[1])
    case = case_of(monkeypatch, sharp(settings={"centre_px": centre}))
    found = range_evidence.focus_of(range_evidence.pairs(case, 7.0, 3.5), 1e-4)
    assert found is not None
    np.testing.assert_allclose(found.off_px, [-off[0], -off[1]], atol=0.1 * math.hypot(*off))


def test_slopes_of_a_pair_are_differences() -> None:
    run = range_evidence.drive(range_missions.replayed(CLEAN, 1).case)
    pair = range_evidence._pair(run, 20, 60, 1.0)
    assert pair is not None
    focal = run.camera.focal_px
    h = 1e-5

    def off(turn: float = 0.0, focus: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """How far the points are off, in σ, with the motion changed by hand; scaled as the pair is."""
        whole, shift = run.between(20, 60)
        axis = run.camera.axis
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turned = (np.eye(3) - turn * cross) @ whole
        way = (np.eye(3) - 0.5 * turn * cross) @ shift + shift[2] / focal * np.array([*focus, 0.0])
        slots = run.shared(20, 60)
        before = (turned @ run.camera.rays(run.pixel[20, slots]).T).T
        return (run.camera.rays(run.pixel[60, slots]) * np.cross(way, before)).sum(axis=1)

    scale = pair.off / off()
    np.testing.assert_allclose(scale * (off(h) - off(-h)) / (2 * h), pair.by_turn, rtol=1e-6)
    for k, axis in enumerate(((1.0, 0.0), (0.0, 1.0))):
        other = (-axis[0], -axis[1])
        np.testing.assert_allclose(scale * (off(0.0, axis) - off(0.0, other)) / 2, pair.by_focus[:, k], rtol=1e-6)


def test_two_views_tell_the_depth_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    case = case_of(monkeypatch, sharp())
    assert case.reference_depth_m is not None
    drive = range_evidence.drive(case)
    told = [range_evidence.depth_at(drive, slot, 5, 60, 1e-3)[0] for slot in drive.shared(5, 60)]
    np.testing.assert_allclose(told, 1 / case.reference_depth_m[5, drive.shared(5, 60)], rtol=5e-3)


def test_steps_are_those_of_the_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    found = range_evidence.steps(case_of(monkeypatch, sharp()))
    assert np.abs(np.nan_to_num(found.turn_rad[20:])).max() < 1e-4
    np.testing.assert_allclose(found.ratio[20:], 1.0, atol=0.03)


# ---------------------------------------------------------------------- planted failures

HARD = ("late-images", "wrong-mounting", "track-outliers", "track-slip")


PLANTED = {planted.fault: planted for planted in range_scoring.planted()}


@pytest.mark.parametrize(("failure", "seed"), [*((f, 0) for f in MISSIONS), *((f, 1) for f in HARD)])
def test_planted_failures_are_told_and_nothing_else(failure: str, seed: int) -> None:
    assert set(score(PLANTED[failure], seed).here) == {failure}


@pytest.mark.parametrize("seed", range(4))
def test_nothing_grave_is_told_of_clean_missions(seed: int) -> None:
    assert score(PLANTED[CLEAN], seed).errors == ()


def test_an_odometers_scale_leaves_no_trace_without_a_reference() -> None:
    told = score(PLANTED[UNSEEN], 0)
    assert not {"odometer-scale", *told.errors} & {*told.here, *told.elsewhere}


def test_a_finding_says_what_a_reader_needs() -> None:
    made = range_missions.replayed("gyro-bias", 2)
    (finding,) = diagnose(made.case)
    plan = MISSIONS["gyro-bias"](rng_of(2, "gyro-bias"))
    (fault,) = plan.faults
    assert isinstance(fault, GyroBias)
    planted = fault.bias_radps[2]
    # a gyro that tells too much to the left tells too little to the right
    assert finding.evidence[0].value == pytest.approx(-planted, rel=0.35)
    assert f"more to the {'left' if planted > 0 else 'right'} than the image turns" in finding.sentence
    assert finding.severity is Severity.ERROR
    assert "gyro_bias_radps" in finding.remedy
    assert finding.covers(finding.worst_frame)


def test_every_failure_has_its_rule_and_every_cause_is_one() -> None:
    names = [rule.name for rule in range_rules.RULES]
    assert len(set(names)) == len(names)
    assert set(names) == set(MISSIONS) == set(range_rules.DETECTORS)
    assert rules_of("range") == range_rules.RULES
    for name, causes in range_rules.CAUSES.items():
        assert {name, *causes} <= set(names)
    for rule in range_rules.RULES:
        assert rule.cause
        assert rule.remedy


def test_stamps_that_do_not_rise_are_swapped_stamps() -> None:
    made = range_missions.replayed(CLEAN, 2).case
    alarms = made["alarms"].copy()
    alarms[50] |= int(Verdict.OUT_OF_ORDER)
    get = made.get
    case = dataclasses.replace(made, get=lambda name: alarms if name == "alarms" else get(name), kept={})
    (finding,) = [f for f in diagnose(case) if f.rule == "swapped-stamps"]
    assert finding.covers(50)
    assert "1 frames have a stamp that is not after the one before" in finding.sentence


def test_of_a_few_frames_nothing_is_told() -> None:
    made = range_missions.replayed("gyro-bias", 2).case
    get = made.get
    few = dataclasses.replace(made, frame=made.frame[:5], t_ns=made.t_ns[:5], get=lambda name: get(name)[:5], kept={})
    assert diagnose(few) == []


# ------------------------------------------------------------------------------ the table


def test_the_table_has_every_failure_with_its_rule() -> None:
    assert {name: one.rule for name, one in PLANTED.items()} == {f: f for f in MISSIONS} | dict.fromkeys(OTHERS, "")
