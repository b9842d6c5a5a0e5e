"""Pages that are made from the code are current, and what the pages show runs."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from pipelines.simulation import scenario as making
from pipelines.simulation.faults import FAULTS
from pipelines.simulation.scenario import Scenario
from pipelines.simulation.sections import is_section, meanings
from workbench import scenario_page, scenarios, session
from workbench.cli import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
DEMO = ROOT / "recordings" / "demo.mcap"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))


def blocks_of(page: str, language: str) -> list[str]:
    """The code blocks of a language on a page."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_the_page_of_scenarios_is_current() -> None:
    current = scenario_page.document()
    assert (DOCS / "scenarios.md").read_text(encoding="utf-8") == current, "run python -m workbench.scenario_page"


def test_the_page_of_scenarios_has_every_key_of_a_full_scenario() -> None:
    page = scenario_page.document()

    def check(section: object, name: str) -> None:
        for key in meanings(type(section)):
            inner = getattr(section, key)
            if is_section(inner) and key != "timing" and type(inner).__name__ != "Timing":
                assert f"### `[{name}{key}]`" in page
                check(inner, f"{name}{key}.")
            elif key not in ("faults", "truth"):
                assert f"| `{key}` |" in page, key

    everything = scenarios.load("sensors", overrides=["surroundings.chessboard={}"]).scenario
    assert {key for key in Scenario.model_fields if getattr(everything, key) is None} == {"frames"}
    check(everything, "")


def test_the_code_on_the_page_of_simulation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    blocks = blocks_of("simulation.md", "python")
    assert len(blocks) == 2
    for number, block in enumerate(blocks):
        exec(compile(block, f"simulation.md, block {number}", "exec"), names)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("exposure-jump from 1700000000300000000 to 1700000000500000000 ns: {'gain': 1.4")
    assert "EXPOSURE_JUMP" in lines[1]
    assert "FIRST_FRAME" in lines[2]


def test_the_code_on_the_page_of_debugging_runs_and_names_the_grating(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    session.run(session.Request(path=DEMO, preset="paper-a", out=tmp_path / "results" / "demo"))
    monkeypatch.chdir(tmp_path)
    (block,) = blocks_of("debugging.md", "python")
    exec(compile(block, "debugging.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert float(lines[0]) > 20
    assert lines[1].startswith("repetitive-texture ((193, 229),) 2.3")
    assert lines[-1].startswith("NOT_RIGID (2, 33, 33) [[")
    assert 193 <= int(lines[-2]) <= 229


def test_the_scenario_on_the_page_of_simulation_is_one(tmp_path: Path) -> None:
    (block,) = blocks_of("simulation.md", "toml")
    (tmp_path / "mine.toml").write_text(block)
    mission = scenarios.mission(scenarios.load(str(tmp_path / "mine.toml"), overrides=["ground.size_px=256"]))
    assert [fault.name for fault in mission.faults] == ["lens-dirt"]
    assert {stream.name for stream in mission.streams} >= {"/camera/image_raw", "/imu", "/reference/pose"}


def test_the_table_of_faults_has_each_with_what_it_needs() -> None:
    text = (DOCS / "simulation.md").read_text(encoding="utf-8").partition("## Faults")[2].partition("## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| `")]
    assert [row[0].strip("`") for row in rows] == list(FAULTS)
    for name, needs, *_ in rows:
        (fault,) = scenarios.load(f"fault-{name.strip('`')}").scenario.faults
        assert needs == " or ".join(making._needs(fault)).replace("trajectory", "")


def commands() -> Iterator[tuple[str, str]]:
    """Every `workbench …` that a page shows, and the page."""
    for page in PAGES:
        for line in re.findall(r"^ *(workbench (?:.|\\\n)*?)(?<!\\)$", page.read_text(encoding="utf-8"), re.MULTILINE):
            yield page.name, line.replace("\\\n", " ")


@pytest.mark.parametrize(("page", "line"), list(commands()))
def test_every_command_that_is_shown_can_be_given(page: str, line: str) -> None:
    words = shlex.split(re.split(r" [|>&]", line)[0], comments=True)[1:]
    command: Any = typer.main.get_command(app)
    context = command.make_context("workbench", words)
    while hasattr(command, "resolve_command"):  # a group of commands
        name, command, words = command.resolve_command(context, words)
        assert command is not None
        context = command.make_context(name, list(words), parent=context)
    named = context.params.get("scenario")
    assert named is None or named.endswith(".toml") or named in scenarios.names()


@pytest.mark.parametrize("page", [*PAGES, DOCS / "pictures" / "README.md"], ids=lambda page: page.name)
def test_what_a_page_links_to_is_there(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_every_picture_is_listed_with_the_command_that_makes_it() -> None:
    text = (DOCS / "pictures" / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `([^`]+)`", text, re.MULTILINE)
    assert {p.name for p in (DOCS / "pictures").glob("*.png")} == {
        p.name for pattern in listed for p in (DOCS / "pictures").glob(pattern)
    }
