"""The sentences at the end of a run: what they say of good and of hopeless recordings."""

import math

import numpy as np
import pytest

from pipelines.evaluation import Trajectory, evaluate
from pipelines.verdict import Severity, Verdict
from tests.toys import WalkSettings
from workbench.session import calibration
from workbench.summary import ADVICE, Tally, evaluation_values, percent, suitability, without_nan


def tally(frames: int, **alarms: int) -> Tally:
    """A run of so many frames, of which so many have each alarm; LOST ones are not used."""
    counted = Tally()
    for k in range(frames):
        flags = Verdict.OK
        for name, count in alarms.items():
            if k < count:
                flags |= Verdict[name]
        used = k > 0 and Verdict.LOST not in flags
        counted.add(flags if flags is Verdict.OK else next(iter(flags)), flags, used)
    return counted


def test_a_good_run_is_called_good() -> None:
    assert suitability(tally(101), 0.016) == [
        "100 % of the motions passed every check; nothing in the images speaks against the method"
    ]


def test_a_lost_run_is_not_to_be_trusted_and_says_why() -> None:
    upshot, first, second = suitability(tally(100, LOST=61, PEAK_AMBIGUOUS=41), 0.016)
    assert upshot.startswith("do not trust this path: 39 % of the motions passed every check, 61 % hold the last")
    assert first.startswith("61 % of the frames LOST: the search does not lock")
    assert second.startswith("41 % of the frames PEAK_AMBIGUOUS: the surface repeats itself")


def test_motions_that_failed_a_check_are_not_called_measured() -> None:
    upshot, *_ = suitability(tally(101, NOT_RIGID=91), 0.016)
    assert upshot.startswith("do not trust this path: 10 % of the motions passed every check, 90 % failed a check")


def test_slow_frames_are_named_before_their_consequences() -> None:
    sentences = suitability(tally(42, LOST=30), 2.0)
    assert sentences[1].startswith("median time between frames 2 s")


def test_alarms_of_measured_frames_still_raise_doubt() -> None:
    upshot, cause = suitability(tally(101, PEAK_AMBIGUOUS=21, BLURRED=4), 0.016)
    assert upshot == "80 % of the motions passed every check, 20 % are doubtful; look at what follows"
    assert "PEAK_AMBIGUOUS" in cause


def test_alarms_about_the_recording_leave_a_motion_measured() -> None:
    upshot, cause = suitability(tally(101, HEIGHT_CHANGE=90), 0.016)
    assert upshot == "100 % of the motions passed every check; look at what follows"
    assert "HEIGHT_CHANGE" in cause


def test_a_reference_that_disagrees_is_named_first() -> None:
    t = np.arange(50) * 1_000_000_000
    true = Trajectory.of(t, np.column_stack([np.arange(50.0), np.zeros(50), np.zeros(50)]))
    short = Trajectory.of(t, true.pose * [0.5, 1, 1])
    upshot, cause = suitability(tally(50), 0.016, evaluate(short, true))
    assert upshot.endswith("look at what follows")
    assert (
        cause
        == "the reference disagrees: the end is off by 50 % of the path, whose length is 0.5 times the reference's"
    )
    assert len(suitability(tally(50), 0.016, evaluate(true, true))) == 1
    still = Trajectory.of(t, true.pose * [1e-5, 1, 1])
    assert suitability(tally(50), 0.016, evaluate(short, still))[1].startswith("the reference moves 0.00049 m in all")


def test_the_list_of_causes_is_short_and_gravest_first() -> None:
    everything = {str(v.name): 90 for v in ADVICE}
    sentences = suitability(tally(100, **everything), 0.016)
    assert len(sentences) == 7
    graves = [Verdict[s.split(" of the frames ")[1].split(":")[0]].severity for s in sentences[1:]]
    assert graves == sorted(graves, reverse=True)


def test_one_frame_is_no_motion() -> None:
    assert suitability(tally(1), math.nan) == ["fewer than two frames: there is no motion to estimate"]


def test_every_worrying_verdict_has_advice() -> None:
    assert {v for v in Verdict if v.severity >= Severity.WARNING} <= set(ADVICE)


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (0.0001, "0.1 %"), (0.05, "5 %"), (0.614, "61 %"), (0.9999, "99.9 %"), (1.0, "100 %")],
)
def test_a_percentage_is_never_rounded_to_all_or_nothing(share: float, text: str) -> None:
    assert percent(share) == text


def test_an_evaluation_becomes_plain_values() -> None:
    t = np.arange(5) * 1_000_000_000
    path = Trajectory.of(t, np.column_stack([np.arange(5.0), np.zeros(5)]))
    values = without_nan(evaluation_values(evaluate(path, path)))
    assert values["ape_m"]["max"] == pytest.approx(0)
    assert values["yaw_drift_deg"] is None
    assert values["rpe"][0]["compared"] == "distance"


def test_a_calibration_that_contradicts_itself_says_so() -> None:
    t = np.arange(50) * 1_000_000_000
    true = Trajectory.of(t, np.column_stack([np.arange(50.0), np.zeros(50), np.zeros(50)]))
    zigzag = Trajectory.of(t, true.pose + np.column_stack([np.zeros(50), np.arange(50) % 2, np.zeros(50)]))
    settings = WalkSettings(metres_per_px=2.0)
    good = calibration(settings, evaluate(true, true))
    assert good["least_squares"] == pytest.approx(2.0)
    assert "do not agree" not in good["sentence"]
    bad = calibration(settings, evaluate(zigzag, true))
    assert bad["path_ratio"] < 0.8 * bad["least_squares"]
    assert "do not agree" in bad["sentence"]
    still = Trajectory.of(t, np.zeros((50, 3)))
    assert calibration(settings, evaluate(still, true))["key"] == ""


class TurnedSettings(WalkSettings):
    """Settings of an estimator whose camera may be turned in the vehicle."""

    mounting_yaw_rad: float = 0.1


def test_the_mounting_yaw_is_calibrated_from_the_path_against_its_own_headings() -> None:
    t = np.arange(50) * 1_000_000_000
    heading = np.linspace(0, 1, 50)
    true = Trajectory.of(t, np.column_stack([np.sin(heading), 1 - np.cos(heading), heading]))
    c, s = np.cos(-0.3), np.sin(-0.3)
    turned = np.column_stack([c * true.pose[:, 0] - s * true.pose[:, 1], s * true.pose[:, 0] + c * true.pose[:, 1]])
    estimate = Trajectory.of(t, np.column_stack([turned, heading]))
    found = calibration(TurnedSettings(metres_per_px=2.0), evaluate(estimate, true))
    assert found["mounting_yaw_rad"] == pytest.approx(0.1 + 0.3)
    assert "--set mounting_yaw_rad=0.4000" in found["sentence"]
    without = Trajectory.of(t, np.column_stack([true.pose[:, :2], np.full(50, np.nan)]))
    assert "mounting_yaw_rad" not in calibration(TurnedSettings(metres_per_px=2.0), evaluate(estimate, without))
