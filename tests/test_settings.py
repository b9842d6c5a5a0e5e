"""Settings over a preset: precedence, values, and errors of one line that name key, place and cure."""

import json
from pathlib import Path
from typing import Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

import workbench.settings
from tests.toys import ToyEstimator
from workbench.settings import (
    Plugin,
    SettingsError,
    estimator_names,
    parse_override,
    plugin,
    read_settings,
    resolve,
    settings_values,
    to_toml,
)


class Inner(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    depth_m: float = 1.0
    layers: int = 2


class Settings(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    search_radius_px: int = Field(8, ge=2, description="reach")
    mount: Literal["rigid", "gimballed"] = "rigid"
    focal_px: float | None = None
    spans: tuple[float, ...] = (1.0, 2.0)
    keep: bool = True
    inner: Inner = Inner()

    @classmethod
    def presets(cls) -> tuple[str, ...]:
        return ("small", "best")

    @classmethod
    def preset(cls, name: str) -> "Settings":
        return cls(search_radius_px={"small": 4, "best": 16}[name])


TOY = Plugin("toy", Settings, lambda settings: ToyEstimator())


def get(*overrides: str, preset: str | None = None, file: Path | None = None) -> Settings:
    settings = resolve(TOY, preset=preset, file=file, overrides=overrides).settings
    assert isinstance(settings, Settings)
    return settings


def complaint(*overrides: str, file: Path | None = None, preset: str | None = None) -> str:
    with pytest.raises(SettingsError) as caught:
        get(*overrides, file=file, preset=preset)
    text = str(caught.value)
    assert "\n" not in text
    return text


def written(folder: Path, text: str, name: str = "settings.toml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def test_the_preset_is_the_base() -> None:
    assert get().search_radius_px == 16
    assert get(preset="small").search_radius_px == 4


def test_overrides_win_over_the_file_and_the_file_over_the_preset(tmp_path: Path) -> None:
    file = written(tmp_path, "search_radius_px = 5\nfocal_px = 300\n[inner]\ndepth_m = 3\n")
    got = get("search_radius_px=6", file=file)
    assert (got.search_radius_px, got.focal_px, got.inner) == (6, 300.0, Inner(depth_m=3.0, layers=2))


def test_values_are_written_as_in_toml() -> None:
    got = get("mount=gimballed", "spans=[3, 4.5]", "keep=false", "focal_px=1e3", "inner.layers=7")
    assert (got.mount, got.spans, got.keep, got.focal_px, got.inner.layers) == ("gimballed", (3, 4.5), False, 1e3, 7)
    assert get('mount="rigid"').mount == "rigid"
    assert get("focal_px=5", "focal_px=none").focal_px is None


def test_the_given_keys_are_known() -> None:
    assert resolve(TOY, overrides=["inner.layers=7", "keep=true"]).given == {"inner", "keep"}


def test_an_equals_sign_and_a_line_break_stay_in_the_value() -> None:
    assert parse_override("a = b=c") == {"a": "b=c"}
    assert parse_override("a=1\nb=2") == {"a": "1\nb=2"}


def test_json_and_the_toml_of_a_run_are_read(tmp_path: Path) -> None:
    assert get(file=written(tmp_path, json.dumps({"keep": False}), "s.json")).keep is False
    run = written(tmp_path, '[run]\nname = "x"\n[settings]\nsearch_radius_px = 9\n', "RUN.toml")
    assert get(file=run).search_radius_px == 9


def test_what_is_written_reads_back(tmp_path: Path) -> None:
    settings = get("mount=gimballed", "spans=[1, 7]", "inner.layers=4", preset="small")
    file = written(tmp_path, to_toml(settings_values(settings)))
    assert get(file=file) == settings
    assert "focal_px" not in read_settings(file, Settings)


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("serch_radius_px=4", ["--set serch_radius_px=4", "unknown setting 'serch_radius_px'", "search_radius_px"]),
        ("focal_mm=4", ["focal_mm", "did you mean focal_px"]),
        ("zzz=4", ["'zzz'", "known are: search_radius_px, mount"]),
        ("inner.leyers=4", ["'inner.leyers'", "did you mean layers"]),
        ("search_radius_px=abc", ["--set search_radius_px=abc", "search_radius_px = 'abc'", "valid integer"]),
        ("search_radius_px=1", ["search_radius_px = 1", "greater than or equal to 2"]),
        ("mount=loose", ["mount = 'loose'", "'rigid' or 'gimballed'"]),
        ("inner.depth_m=deep", ["inner.depth_m = 'deep'", "valid number"]),
        ("keep", ["--set keep", "key=value"]),
        ("=3", ["key=value"]),
    ],
)
def test_a_wrong_override_is_explained_in_one_line(override: str, parts: list[str]) -> None:
    text = complaint(override)
    assert all(part in text for part in parts), text


def test_a_fault_in_the_file_names_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, "serch_radius_px = 5\nkeep = 'maybe'")
    text = complaint("spans=[1]", file=file)
    assert text.startswith((f"{file}: unknown setting", f"{file}: keep"))
    assert text.endswith("(and 1 more)")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    assert "absent.toml: cannot be read: No such file" in complaint(file=tmp_path / "absent.toml")
    assert "not valid TOML" in complaint(file=written(tmp_path, "a = = 1"))
    assert "not valid JSON" in complaint(file=written(tmp_path, "{", "s.json"))
    assert "not a list" in complaint(file=written(tmp_path, "[1]", "s.json"))


def test_an_unknown_preset_names_the_known_ones() -> None:
    assert "small, best" in complaint(preset="larger")


def test_settings_without_presets_have_one_called_default() -> None:
    plain = Plugin("plain", Inner, lambda settings: ToyEstimator())
    assert (plain.presets, plain.usual_preset) == (("default",), "default")
    assert plain.preset("default") == Inner()


def test_estimators_come_from_entry_points_too(monkeypatch: pytest.MonkeyPatch) -> None:
    class Point:
        def __init__(self, name: str, made: object) -> None:
            self.name, self.value, self.made = name, f"somewhere:{name}", made

        def load(self) -> object:
            if isinstance(self.made, Exception):
                raise self.made
            return self.made

    points = [Point("toy", lambda: TOY), Point("own", TOY), Point("broken", ImportError("gone")), Point("odd", dict)]

    def fake(group: str, name: str | None = None) -> list[Point]:
        assert group == "estimator_workbench.estimators"
        return [p for p in points if name in (None, p.name)]

    monkeypatch.setattr(workbench.settings, "entry_points", fake)
    assert estimator_names() == ("correlation", "range", "semidirect", "ptam", "broken", "odd", "own", "toy")
    assert plugin("toy") is TOY
    assert plugin("own") is TOY
    with pytest.raises(SettingsError, match="cannot be loaded: gone"):
        plugin("broken")
    with pytest.raises(SettingsError, match="not a Plugin"):
        plugin("odd")
    with pytest.raises(SettingsError, match="there is no estimator 'absent'; there are: correlation"):
        plugin("absent")
