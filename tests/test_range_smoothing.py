"""`replay -e range --smooth` from the command to the recording."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_range_log import rows_of

from pipelines.ranging.step import RangeStep
from workbench import rrd
from workbench.blueprints import Bounds, range_blueprint
from workbench.cli import main
from workbench.session import Request, run
from workbench.summary import lines

NOISE = ("sigma_speed=0.002", "tracks.sigma_px=0.1")  # that of the scenario
NAMES = ("range", "state", "covariance")


def replay(out: Path, *overrides: str) -> dict[str, Any]:
    """The whole of the scenario with 12 landmarks."""
    request = Request(
        path=Path("sim:paper-b"),
        estimator="range",
        overrides=(*NOISE, "max_landmarks=12", *overrides),
        image="none",
        out=out,
        smooth=True,
    )
    return run(request).summary


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("smooth")
    (out / "summary.json").write_text(json.dumps(replay(out, "mode=joint"), default=str))
    return out


def test_smoothed_ranges_are_better_and_told(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    told = summary["smoothed"]
    assert told["sentence"] == "converged"
    assert told["converged"]
    assert (told["landmarks"], told["left_out"], told["groups"]) == (12, 0, 1)
    assert told["same"]["count"] > 100
    assert told["same"]["smoothed_median_percent"] < 0.8 * told["same"]["filter_median_percent"]  # the joint filter's
    assert told["error"]["count"] >= summary["ranging"]["error"]["count"]
    assert told["error"]["median_percent"] < 0.3
    assert told["error"]["nees"] < 4
    assert [name for name, _ in lines(summary)].count("smoothed") == 3
    kept = tomllib.loads((folder / "best.toml").read_text())["summary"]["smoothed"]
    assert kept["error"]["median_percent"] == pytest.approx(told["error"]["median_percent"])


def test_the_recording_holds_them_beside_the_filters(folder: Path) -> None:
    fields = rrd.read_fields(folder / "best.rrd", "best", RangeStep, ["frame", "range_m"])
    root, part = "/runs/best/range/smoothed/3", "Scalars:scalars"
    shown, state, spread = (rows_of(folder / "best.rrd", f"{root}/{name}", part) for name in NAMES)
    assert shown.keys() == state.keys() == spread.keys()
    assert len(shown) >= 250
    last = max(shown)
    z, near, far = shown[last]
    xi, sigma = state[last][2], np.sqrt(spread[last][8])
    np.testing.assert_allclose([z, near, far], [1 / xi, 1 / (xi + 2 * sigma), 1 / (xi - 2 * sigma)], rtol=1e-9)
    assert z == pytest.approx(fields["range_m"][fields["frame"].index(last)][2], rel=0.1)
    assert sigma / xi < 0.05


def test_the_plot_of_a_landmark_shows_them_only_where_they_are() -> None:
    landmarks = ((1, "1", 9.0), (2, "2", 9.0))
    text = str(list(_contents(range_blueprint("r", "range", Bounds(landmarks=landmarks, smoothed=frozenset({2}))))))
    assert "/runs/r/range/smoothed/2/range" in text
    assert "/runs/r/range/smoothed/1/range" not in text


def _contents(blueprint: Any) -> Any:
    """The contents of all views of a blueprint."""
    queue = [blueprint.root_container]
    while queue:
        part = queue.pop()
        inside = part.contents
        if isinstance(inside, (list, tuple)) and inside and not isinstance(inside[0], str):
            queue += list(inside)
        else:
            yield inside


def test_ctrl_c_ends_without_smoothing_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from workbench import session

    class Impatient(session.Interrupt):
        """A user who presses Ctrl-C at the thirtieth frame."""

        asked = 0

        @property
        def requested(self) -> bool:
            self.asked += 1
            return self.asked > 30

        @requested.setter
        def requested(self, value: bool) -> None:
            pass

    monkeypatch.setattr(session, "Interrupt", Impatient)
    summary = replay(tmp_path)
    assert summary["interrupted"]
    assert 25 <= summary["frames"] <= 31
    assert summary["smoothed"] == {"sentence": "not smoothed to the end: the replay was stopped"}
    assert ("smoothed", "not smoothed to the end: the replay was stopped") in lines(summary)


def test_other_estimators_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", "sim:figure-eight", "--smooth", "-o", str(tmp_path / "out")]) == 2
    problems = capsys.readouterr().err.strip().splitlines()
    assert len(problems) == 1
    assert "--smooth is for ranges, not for correlation: leave it out, or take -e range" in problems[0]
    assert not (tmp_path / "out").exists()
