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
        "100 % of the motions were measured; nothing speaks against the method here"
    ]


def test_a_lost_run_is_not_to_be_trusted_and_says_why() -> None:
    upshot, first, second = suitability(tally(100, LOST=61, PEAK_AMBIGUOUS=41), 0.016)
    assert upshot.startswith("do not trust this path: only 39 % of the motions were measured")
    assert first.startswith("61 % of the frames LOST: the search does not lock")
    assert second.startswith("41 % of the frames PEAK_AMBIGUOUS: the surface repeats itself")


def test_slow_frames_are_named_before_their_consequences() -> None:
    sentences = suitability(tally(42, LOST=30), 2.0)
    assert sentences[1].startswith("median time between frames 2 s")


def test_alarms_of_measured_frames_still_raise_doubt() -> None:
    upshot, cause = suitability(tally(100, PEAK_AMBIGUOUS=20, BLURRED=4), 0.016)
    assert upshot == "100 % of the motions were measured, but look at what follows"
    assert "PEAK_AMBIGUOUS" in cause


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
