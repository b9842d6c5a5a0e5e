"""A report says what the run's files say, harms nobody, and stands on its own feet in a browser."""

import dataclasses
import html.parser
import json
import math
import re
import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import tomli_w
from browser import Browser, chromium

from pipelines.ranging.filter import Status
from pipelines.verdict import Severity, Verdict
from workbench import cli, report
from workbench.diagnosis.finding import Evidence, Finding
from workbench.judgement import Drift
from workbench.report import curves, markup, plots
from workbench.report.facts import commands, length, trials
from workbench.report.pictures import pictures
from workbench.runs import Run, open_run
from workbench.session import Request, run

FRAMES = 30
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)> \"quoted' \u202e&amp;\x07"


def finding(worst: int = 12, text: str = "contrast fell", **more: object) -> Finding:
    values: dict[str, object] = {
        "rule": "motion-blur",
        "severity": Severity.WARNING,
        "spans": ((10, 14), (20, 20)),
        "worst_frame": worst,
        "sentence": text,
        "evidence": (Evidence(name="residual_rms", value=12.5, unit="grey", usual=2.0, bound=6.0),),
        "cause": "the exposure is long",
        "remedy": "raise search_radius_px or shorten the exposure",
        "harm_m": 0.0125,
    }
    return Finding(**(values | more))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("report") / "mission"
    stop = str((FRAMES - 0.5) / 30)
    run(Request(path=Path("sim:demo"), stop=stop, out=folder, overrides=("max_peak_ratio=0.9",)))
    return open_run(folder)


@pytest.fixture(scope="module")
def ranges(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("ranges") / "mission"
    run(Request(path=Path("sim:fault-track-slip"), estimator="range", stop="1.1", out=folder))
    return open_run(folder)


@pytest.fixture(scope="module")
def facts(replayed: Run) -> report.Facts:
    n = len(replayed.frames)
    drift = Drift.of_rows(n, np.arange(1, n), np.full(n - 1, 2e-3), np.full(n - 1, 1e-3), 3e-3 * (n - 1))
    return report.facts_of(replayed, findings=[finding(), finding(25, spans=((24, 26),), harm_m=math.nan)], drift=drift)


def other_run(original: Run, folder: Path, /, **changes: object) -> Run:
    """The run in another folder, with changes in its RUN.toml."""
    shutil.copytree(original.folder, folder)
    values = json.loads(json.dumps(dict(original.toml)))
    for key, value in changes.items():
        if value is None:
            del values[key]
        elif isinstance(value, dict):
            values[key] |= value
        else:
            values[key] = value
    (folder / f"{original.name}.toml").write_text(tomli_w.dumps(values))
    return open_run(folder)


class Page(html.parser.HTMLParser):
    """The tags of a page with their attributes, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


# ------------------------------------------------------------------------------------ facts


def test_facts_are_those_of_the_run(replayed: Run, facts: report.Facts) -> None:
    assert ("max_peak_ratio", "0.9", "0.95") in facts.settings
    assert "fragment_side_px" not in [name for name, _, _ in facts.settings]
    assert sum(c.frames for c in facts.verdicts) == FRAMES
    metrics = {m.name: m for m in facts.metrics}
    ape = replayed.summary["evaluation"]["ape_m"]
    assert metrics["APE: distance after alignment"].rms == ape["rmse"]
    assert metrics["end-point error"].value == replayed.summary["evaluation"]["end_error_m"]
    assert facts.missing == []
    assert [name for name, _, _ in facts.digests] == ["recording", "sensors.rrd", "best.rrd", "best.toml", "best.tum"]
    assert facts.digests[0][2] == replayed.digest
    assert report.values(facts)["findings"][0]["harm_m"] == 0.0125
    json.dumps(report.values(facts))


def test_error_curve_has_the_largest_error_of_the_summary(replayed: Run, facts: report.Facts) -> None:
    chart = next(chart for chart in facts.charts if chart.key == "position-error")
    largest = replayed.summary["evaluation"]["ape_m"]["max"]
    assert np.nanmax(chart.curves[0].values) == pytest.approx(largest, rel=1e-9)
    assert facts.ways is not None
    distance = np.hypot(*(facts.ways.estimate - facts.ways.reference).T)
    np.testing.assert_allclose(distance, chart.curves[0].values, atol=1e-9)


def test_upshot_is_grave_with_an_error_a_far_end_or_a_killed_replay(replayed: Run, tmp_path: Path) -> None:
    fine = report.facts_of(replayed, findings=[])
    assert fine.gravity is Severity.FINE
    assert report.facts_of(replayed, findings=[finding(severity=Severity.ERROR)]).gravity is Severity.ERROR
    far = other_run(replayed, tmp_path / "far", summary={
        "evaluation": {**replayed.summary["evaluation"], "drift_percent": 58.0, "end_error_m": 2.33}
    })  # fmt: skip
    told = report.facts_of(far, findings=[])
    assert told.gravity is Severity.ERROR
    assert told.upshot.startswith("do not trust this path: the end is 2.33 m off, 58 % of the path; ")
    killed = other_run(replayed, tmp_path / "killed", complete=False, summary=None)
    assert report.facts_of(killed, findings=[]).gravity is Severity.WARNING


def test_commands_name_the_frame_and_settings_that_are_accepted(replayed: Run, facts: report.Facts) -> None:
    assert trials("raise search_radius_px, lower fragment_side_px, set recovery or key_frames", replayed) == [
        ("search_radius_px", "16"),
        ("fragment_side_px", "11"),
        ("key_frames", "false"),
    ]
    assert trials("raise accepted_gain, min_correlation or no_such_thing", replayed) == []
    assert trials("raise min_correlation", dataclasses.replace(replayed, toml={
        **replayed.toml, "settings": {**replayed.settings, "min_correlation": 0.9}
    })) == []  # fmt: skip
    named = dataclasses.replace(facts, path="results/my mission")
    assert commands(named, finding()) == [
        "workbench explain 'results/my mission' --frame 12",
        "workbench whatif 'results/my mission' --from 0 --to 24 --set search_radius_px=16",
    ]


def test_lengths_come_in_the_unit_that_suits() -> None:
    assert [length(v) for v in (12.3456, 0.0125, -3e-5, math.nan)] == ["12.3 m", "12.5 mm", "-30 µm", "unknown"]


# ------------------------------------------------------------------------------------ curves


def test_thinning_keeps_every_extreme() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(20_000, 3))
    values[12_345, 1], values[777, 2], values[:100, 0] = 50.0, -60.0, np.nan
    rows = curves.extremes(values, 2000)
    assert len(rows) <= 2000
    assert {0, 19_999, 12_345, 777} <= set(rows.tolist())
    np.testing.assert_array_equal(np.nanmax(values[rows], axis=0), np.nanmax(values, axis=0))
    np.testing.assert_array_equal(np.nanmin(values[rows], axis=0), np.nanmin(values, axis=0))
    assert curves.extremes(values[:50], 2000).tolist() == list(range(50))


def test_strip_keeps_the_gravest_verdict_of_each_stretch() -> None:
    verdicts = [Verdict.OK] * 20_000
    verdicts[7777], verdicts[7778] = Verdict.LOST, Verdict.BLURRED
    run = cast("Run", SimpleNamespace(verdicts=verdicts, frames=np.arange(20_000), t_ns=np.arange(20_000) * 10**7))
    strip = curves.strip(run)
    assert len(strip.verdicts) == 500
    assert strip.verdicts.count(Verdict.LOST) == 1
    assert strip.frame[strip.verdicts.index(Verdict.LOST)] == 7777
    assert strip.t_s[strip.verdicts.index(Verdict.LOST)] == 77.77


def test_axes_have_round_numbers_inside() -> None:
    for low, high in ((0.0, 1.0), (-3.2e-5, 7.1e-5), (1234.0, 98765.0)):
        axis = plots.Axis(low, high, 1000, flip=True)
        ticks = axis.ticks(5)
        assert 2 <= len(ticks) <= 6
        assert all(low <= t <= high for t in ticks)
        assert axis(low) == 1000
        assert axis(high) == 0
    assert plots.path(np.array([0.0, 1, 2, 3]), np.array([5.0, np.nan, 7, 8])) == "M0 5h0M2 7L3 8"


def test_shades_lie_at_the_frames_of_the_finding() -> None:
    axis = plots.frame_axis(np.arange(101))
    (shade,) = plots.shades([finding(spans=((10, 14), (15, 16), (50, 50)))], axis)
    assert re.findall(r"M(\d+) 0H(\d+)V", shade.get("d", "")) == [("190", "330"), ("990", "1010")]


def test_small_errors_are_plotted_in_small_units_and_wild_values_leave_the_plot() -> None:
    frame = np.arange(3)
    tiny = curves.Chart("a", "a", "m", "a", frame, frame / 10, (curves.Curve("a", np.array([0.0, np.nan, 3e-5])),))
    assert tiny.readable().unit == "µm"
    np.testing.assert_allclose(tiny.readable().curves[0].values, [0, np.nan, 30])
    wild = dataclasses.replace(tiny, curves=(curves.Curve("a", np.array([1.0, 2, 500])),), ceiling=6.0)
    assert wild.readable() is wild
    text = markup.drawing(plots.chart_plot(wild, []))
    assert "500" in text  # still to be read under the cursor
    assert "&quot;y&quot;:[0.75,6.25]" in text


# ------------------------------------------------------------------------------------ pictures


def test_picture_shows_the_peaks_where_the_surfaces_have_them(replayed: Run) -> None:
    picture = pictures(replayed, [7])[7]
    step = replayed.steps(7, 8)[0]
    assert picture.closer is not None
    view = [float(v) for v in picture.closer.get("viewBox", "").split()]
    side = step.surface.shape[-1]  # type: ignore[attr-defined]
    assert view == [0, 0, 3 * (side + 1) - 1, 3 * (side + 1) - 1]
    white = [c for c in picture.closer.iter("circle") if c.get("stroke") == "#ffffff"]
    row, col = np.unravel_index(np.nanargmax(step.surface[0]), (side, side))  # type: ignore[attr-defined]
    assert (float(white[0].get("cx", 0)), float(white[0].get("cy", 0))) == (col + 0.5, row + 0.5)
    assert picture.image is not None
    rectangles = [r for r in picture.image.iter("rect") if r.get("stroke") == "#ffffff"]
    assert len(rectangles) == 9
    assert float(rectangles[0].get("width", 0)) == replayed.settings["fragment_side_px"]
    assert [row[0] for row in picture.rows] == [str(k) for k in range(1, 10)]
    assert float(picture.rows[3][1]) == pytest.approx(step.peak_correlation[3], rel=1e-3)  # type: ignore[attr-defined]


def test_picture_of_ranges_shows_the_measured_points(ranges: Run) -> None:
    frame = int(ranges.frames[-1])
    picture = pictures(ranges, [frame])[frame]
    measured = ranges.column("measured_px")[-1]
    measured = measured[np.isfinite(measured).all(axis=1)] + 0.5
    assert picture.image is not None
    red = [(float(c.get("cx", 0)), float(c.get("cy", 0))) for c in picture.image.iter("circle")]
    np.testing.assert_allclose(sorted(red), sorted(map(tuple, measured)), atol=0.01)
    assert picture.closer is not None
    nis = ranges.column("nis")[-1]
    assert f"number {int(ranges.column('landmark_id')[-1][np.nanargmax(nis)])}" in picture.closer_caption
    assert len(picture.rows) == len(measured)


def test_ranges_without_images_are_drawn_on_a_canvas(ranges: Run, tmp_path: Path) -> None:
    blind = other_run(ranges, tmp_path / "blind")
    blind.sensors_file.unlink()
    frame = int(blind.frames[-1])
    picture = pictures(blind, [frame])[frame]
    assert picture.image is not None
    assert picture.image.get("viewBox") == "0 0 640 480"
    assert not list(picture.image.iter("image"))
    assert len(list(picture.image.iter("circle"))) == len(picture.rows)
    assert "no image of this frame" in picture.caption


# ------------------------------------------------------------------------------------ the page


def test_page_has_every_section_and_asks_for_nothing(facts: report.Facts) -> None:
    text = report.page_of(facts)
    page = Page(text)
    headings = re.findall(r"<h2[^>]*>([^<]+)</h2>", text)
    assert headings == [
        "Verdict", "Path", "Findings", "Drift budget", "Metrics", "Verdicts of the frames",
        "What the estimator computed", "Mission and run", "Changed settings", "Damage and clocks",
        "Versions and digests",
    ]  # fmt: skip
    anchors = {a["href"] for tag, a in page.tags if tag == "a"}
    identities = {f"#{a['id']}" for _, a in page.tags if "id" in a}
    assert anchors <= identities
    for tag, attributes in page.tags:
        assert "style" not in attributes
        assert not any(name.startswith("on") for name in attributes)
        assert tag not in ("link", "iframe", "object", "base")
        assert (attributes.get("href") or "#").startswith(("#", "data:image/"))
        assert (attributes.get("src")) is None
    assert "12.5 mm of the end-point error" in page.text
    assert "max_peak_ratio" in page.text
    assert "The end is 87 mm off: 58 mm by wrong shifts, 29 mm by wrong turns" in page.text


def test_drift_section_is_the_runs_own_budget_and_is_left_out_without_one(replayed: Run) -> None:
    facts = report.facts_of(replayed, findings=[])
    assert facts.drift is not None
    assert np.nansum(facts.drift.harm_m) == pytest.approx(facts.drift.end_error_m, rel=1e-6)
    assert "Drift budget" in report.page_of(facts)
    assert "Drift budget" not in report.page_of(dataclasses.replace(facts, drift=None))


def test_page_of_ranges_has_each_landmark_and_nis(ranges: Run) -> None:
    facts = report.facts_of(ranges, findings=[finding(int(ranges.frames[-1]), spans=((5, 9),))])
    keys = [chart.key for chart in facts.charts if chart.key != "range-error"]
    assert keys == ["range-1", "range-2", "range-3", "range-4", "nis", "relative-sigma"]
    chart = next(chart for chart in facts.charts if chart.key == "range-1")
    depth = ranges.column("range_m")[:, 0]
    np.testing.assert_allclose(chart.curves[0].values, depth, equal_nan=True)
    reference = next(c for c in chart.curves if c.role == "reference").values
    assert np.nanmax(np.abs(depth[-3:] / reference[-3:] - 1)) < 0.5
    assert "Path" not in re.findall(r"<h2[^>]*>([^<]+)</h2>", report.page_of(facts))


def test_range_error_is_that_of_the_ranges_that_count(ranges: Run) -> None:
    settled = dataclasses.replace(ranges, _columns=ranges.columns([*ranges.fields, "frame", "t_ns"]))
    settled._columns["status"] = np.full_like(ranges.column("status"), Status.CONVERGED)
    settled._columns["status"][:, 0] = Status.CONVERGING
    charts = {chart.key: chart for chart in curves.own(settled)}
    assert "range-error" not in [chart.key for chart in curves.own(ranges)]  # nothing counts so early
    worst = charts["range-error"].curves[1].values
    slots = [{c.name: c.values for c in charts[f"range-{k}"].curves} for k in (2, 3, 4)]
    errors = [100 * abs(c["range Z"][-1] / c["reference"][-1] - 1) for c in slots]
    assert worst[-1] == pytest.approx(max(errors))


def test_hostile_names_stay_text(replayed: Run, tmp_path: Path) -> None:
    hostile = other_run(
        replayed,
        tmp_path / "<script>alert(3)<script>",
        run={"recording": HOSTILE, "image_stream": HOSTILE, "reference_stream": HOSTILE},
        summary={"notes": [HOSTILE], "damage": [HOSTILE], "facts": [HOSTILE], "reference": HOSTILE, "scale": HOSTILE},
        versions={"rerun-sdk": HOSTILE, HOSTILE: "1"},
    )
    bad = finding(text=HOSTILE, rule=HOSTILE, cause=HOSTILE, remedy=HOSTILE,
                  evidence=(Evidence(name=HOSTILE, value=1.0, unit=HOSTILE),))  # fmt: skip
    facts = report.facts_of(hostile, findings=[bad])
    page = Page(report.page_of(facts))
    assert [tag for tag, _ in page.tags].count("script") == 1
    assert not [tag for tag, _ in page.tags if tag == "img"]
    assert page.text.count("<img src=x onerror=alert(2)>") > 10
    assert "\u202e" not in page.text
    text = report.text_of(facts)
    outside_code = re.sub(r"`[^`\n]*`", "", text)
    assert "<script" not in outside_code
    assert "<img" not in outside_code


def test_style_and_script_are_the_ones_that_the_policy_lets_in(facts: report.Facts) -> None:
    import base64
    import hashlib

    text = report.page_of(facts)
    policy = next(a["content"] for tag, a in Page(text).tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        body = re.search(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        assert body is not None
        assert base64.b64encode(hashlib.sha256(body[1].encode()).digest()).decode() in policy


def test_printable_text_has_no_mark_that_turns_it_round() -> None:
    element = markup.el("p", "a\u202eb\x00c", title='"<&\udc80')
    assert markup.drawing(element).startswith('<p title="&quot;&lt;&amp;\\udc80"')
    assert "a\\u202eb\\x00c" in markup.drawing(element)


# ------------------------------------------------------------------------------------ runs with something missing


def test_killed_run_without_sensors_tells_what_is_missing(replayed: Run, tmp_path: Path) -> None:
    killed = other_run(replayed, tmp_path / "killed", complete=False, summary=None)
    whole = killed.file.read_bytes()
    killed.file.write_bytes(whole[: int(0.9 * len(whole))])
    killed.sensors_file.unlink()
    facts = report.facts_of(open_run(killed.folder), findings=[finding(3, spans=((2, 4),))])
    page = Page(report.page_of(facts)).text
    assert "incomplete: the replay was killed before its end" in page
    assert "sensors.rrd is not beside the run" in page
    assert "The run holds no image of this frame" in page
    assert page.count("Not known: the replay did not come to its end.") == 2
    assert facts.metrics == []


def test_damaged_sensors_leave_the_rest(replayed: Run, tmp_path: Path) -> None:
    damaged = other_run(replayed, tmp_path / "damaged")
    damaged.sensors_file.write_bytes(b"nothing of the kind")
    facts = report.facts_of(open_run(damaged.folder), findings=[finding()])
    assert any(line.startswith("the path: ") and "sensors.rrd" in line for line in facts.missing)
    seen = report.facts_of(open_run(damaged.folder))
    assert any(line.startswith("the reference: ") for line in seen.missing)
    assert "There is no image" in Page(report.page_of(facts)).text


# ------------------------------------------------------------------------------------ the command


def test_command_writes_page_markdown_and_json(
    replayed: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "out" / "report.html"
    assert cli.main(["report", str(replayed.folder), "-o", str(page)]) == 0
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    capsys.readouterr()
    assert cli.main(["report", str(replayed.file), "--md"]) == 0
    assert "| end-point error |" in capsys.readouterr().out
    assert cli.main(["report", str(replayed.file), "--json"]) == 0
    assert ["max_peak_ratio", "0.9", "0.95"] in json.loads(capsys.readouterr().out)["settings"]
    assert cli.main(["report", str(tmp_path / "nothing")]) == 2
    assert "there is no such run" in capsys.readouterr().err
    assert cli.main(["report", str(replayed.folder), "--pictures", str(tmp_path)]) == 2
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert cli.main(["report", str(replayed.folder), "-o", str(blocked / "report.html")]) == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_markdown_links_the_pictures_that_it_wrote(facts: report.Facts, tmp_path: Path) -> None:
    text = report.text_of(facts, tmp_path / "pictures", tmp_path)
    links = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert len(links) == 4
    assert all((tmp_path / link).read_text().startswith("<svg") for link in links)
    assert "image/jpeg" not in report.text_of(facts)


def test_same_run_gives_the_same_page(facts: report.Facts) -> None:
    assert report.page_of(facts) == report.page_of(facts)


# ------------------------------------------------------------------------------------ in a browser


@pytest.mark.skipif(chromium() is None, reason="there is no Chromium on this machine")
def test_page_in_a_browser(replayed: Run, facts: report.Facts, tmp_path: Path) -> None:
    hostile = dataclasses.replace(facts, recording=HOSTILE, notes=[HOSTILE],
                                  findings=[finding(rule=HOSTILE), finding(25, spans=((24, 26),))])  # fmt: skip
    page = report.write(report.page_of(hostile), tmp_path / "report.html")
    first = "document.querySelector('.readout').textContent"
    with Browser() as browser:
        browser.open(page)
        assert [address for address in browser.requests if not address.startswith(("file:", "data:image/"))] == []
        assert browser.requests.count(page.as_uri()) == 1
        assert browser.errors == []
        assert browser.evaluate("document.querySelectorAll('img').length") == 0

        for _ in range(100):
            browser.press("Tab")
            if browser.evaluate("document.activeElement.className") == "plot":
                break
        for _ in range(12):
            browser.press("ArrowRight")
        chart = next(chart for chart in facts.charts if chart.key == "position-error").readable()
        told = browser.evaluate(first)
        assert told.startswith("frame 12, 0.400 s: position error ")
        assert f"{chart.curves[0].values[12]:.5g}" in told
        assert "finding: </script>" in told
        browser.press("End")
        assert browser.evaluate(first).startswith(f"frame {FRAMES - 1}, ")

        middle = "(() => {const r = document.querySelector('.plane').getBoundingClientRect();"
        x, y = browser.evaluate(middle + "return [r.x + r.width * 10.1 / 29, r.y + r.height / 2]})()")
        browser.hover(x, y)
        assert browser.evaluate(first).startswith("frame 10, ")
        linked = "[...document.querySelectorAll('.upright')].map((line) => line.getAttribute('d'))"
        assert len(set(browser.evaluate(linked))) == 1

        for width in (1400, 400):
            browser.resize(width, 900)
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
        assert browser.printed().startswith(b"%PDF")


def test_long_run_makes_a_small_page_quickly() -> None:
    n = 20_000
    rng = np.random.default_rng(0)
    frame, t_s = np.arange(n), np.arange(n) / 60
    chart = curves.Chart("a", "a", "m", "a", frame, t_s, tuple(curves.Curve(c, rng.normal(size=n)) for c in "abc"))
    spans = tuple((k, k + 1) for k in range(0, n, 4))
    began = time.process_time()
    size = len(markup.drawing(plots.chart_plot(chart, [finding(spans=spans)])))
    assert time.process_time() - began < 2
    assert size < 200_000
