"""Pages that are made from the code are current, and what the pages show runs."""

import re
from pathlib import Path

from pipelines.simulation.scenario import Scenario
from pipelines.simulation.sections import is_section, meanings
from workbench import scenario_page, scenarios

DOCS = Path(__file__).parents[1] / "docs"


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
