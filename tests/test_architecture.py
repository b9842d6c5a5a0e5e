"""Data flows readers → pipelines → workbench; imports point the other way and nothing crosses."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OURS = {"readers", "pipelines", "workbench"}
ALLOWED = {
    "readers": {"readers"},
    "pipelines": {"pipelines", "readers.streams"},
    "workbench": OURS,
}
FORBIDDEN = {
    "readers": {"rerun", "typer", "rich"},
    "pipelines": {"rerun", "typer", "rich", "rosbags", "mcap", "pandas"},
    "workbench": set(),
}


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
    return found


def modules() -> list[Path]:
    return sorted(p for package in OURS for p in (ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_to_the_left(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    for name in imports_of(path):
        top = name.split(".")[0]
        if top in OURS:
            assert any(name == a or name.startswith(a + ".") for a in ALLOWED[package]), name
        assert top not in FORBIDDEN[package], name


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(ROOT)))
def test_only_rrd_and_blueprints_know_rerun(path: Path) -> None:
    if {n.split(".")[0] for n in imports_of(path)} & {"rerun", "rerun_bindings"}:
        assert path.name in {"blueprints.py", "schema.py"} or path.name.startswith("rrd"), path


def test_no_module_is_named_like_a_library() -> None:
    names = {p.stem for p in modules()} - {"__init__", "__main__"}
    assert not names & set(sys.stdlib_module_names)
