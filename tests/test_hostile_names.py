"""Names and texts of a log that would command a terminal or a page: they come out as text, in every place."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from made_logs import MS, ROS1, ROS2, START_NS, Entry, Maker, raw_ros, write_mcap, write_ros1, write_ros2
from rerun.chunk import RrdReader

from readers import open_recording
from workbench import rrd
from workbench.cli import main

CODES = "\x1b[31m\x07\u202e"
HTML = "<script>alert(1)</script><img src=x onerror=alert(2)>"
HOSTILE = f"/cam{CODES}{HTML}"
KINDS = ("mcap", "ros1", "db3")


def log(folder: Path, kind: str) -> Path:
    """Textured images, an IMU, poses between frames and texts, whose names and contents are all hostile."""
    store = ROS1 if kind == "ros1" else ROS2
    make, entries = Maker(store), []
    ground = np.random.default_rng(2).integers(0, 255, (96, 128), np.uint8)
    for k in range(6):
        t = START_NS + k * 50 * MS
        pixels = np.ascontiguousarray(ground[:, 2 * k : 2 * k + 96]).ravel()
        header = make.header(t, HOSTILE)
        image = make.image(t, header=header, height=96, width=96, step=96, data=pixels)
        broken = make.image(t, header=header, encoding=HOSTILE)
        entries += [
            Entry(HOSTILE, "sensor_msgs/msg/Image", t + 4 * MS, broken if k == 3 else image),
            Entry(f"/imu{HOSTILE}", "sensor_msgs/msg/Imu", t, make.imu(t, header=header)),
            Entry("/tf", "tf2_msgs/msg/TFMessage", t, make.tf(make.transform(t, HOSTILE, f"b{HOSTILE}"))),
            Entry("/words", "std_msgs/msg/String", t, make("std_msgs/msg/String", data=HOSTILE)),
        ]
    if kind == "mcap":
        return write_mcap(folder / "a.mcap", raw_ros(entries, 2), "ros2")
    if kind == "ros1":
        return write_ros1(folder / "a.bag", entries)
    return write_ros2(folder / "bag", entries)


def harmless(text: str) -> bool:
    return all(c.isprintable() or c in "\n\t" for c in text)


@pytest.mark.parametrize("kind", KINDS)
def test_names_of_streams_can_be_shown_anywhere(tmp_path: Path, kind: str) -> None:
    with open_recording(log(tmp_path, kind)) as recording:
        names = [info.name for info in recording.streams]
        assert len(names) == 4
        assert all(map(harmless, names)), names
        assert "/cam\\x1b[31m\\x07\\u202e" + HTML in names
        assert sum(1 for _ in recording.read()) == 24


@pytest.mark.parametrize("kind", KINDS)
def test_the_terminal_is_not_commanded(tmp_path: Path, kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = str(log(tmp_path, kind))
    for words in (["inspect", path], ["inspect", path, "--json"], ["replay", path, "--image", HOSTILE], ["sync", path]):
        main([*words, "-o", str(tmp_path / "out")] if words[0] == "replay" else words)
        out, err = capfd.readouterr()
        assert harmless(out), words
        assert harmless(err), words
        assert out or err


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)


def texts_of(file: Path) -> list[str]:
    """Every text in the columns and the view of a recording, and every name of an entity."""
    reader, found = RrdReader(file), []
    for store in [None, *reader.blueprints()]:
        for chunk in reader.stream() if store is None else reader.stream(store=store):
            found.append(chunk.entity_path)
            for column in chunk.to_record_batch().columns:
                values = column
                while pa.types.is_list(values.type):
                    values = values.flatten()
                found += [v for v in values.to_pylist() if v] if pa.types.is_string(values.type) else []
    return found


def test_a_run_of_a_hostile_log_and_its_report_hold_text_only(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, out = log(tmp_path, "mcap"), tmp_path / "out"
    with open_recording(path) as recording:
        (image,) = [info.name for info in recording.streams if info.kind == "image"]
    small = ("fragment_side_px=9", "search_radius_px=6")
    words = ["replay", str(path), "--image", image, "-o", str(out), *(w for s in small for w in ("--set", s))]
    assert main(words) in (0, 3), capfd.readouterr().err
    (run,) = (file for file in out.rglob("*.rrd") if file.name != "sensors.rrd")
    for file in (run, run.with_name("sensors.rrd")):
        texts = texts_of(file)
        assert len(texts) > 20
        shown = [text for text in texts if not harmless(text)]
        assert shown == []
        documents = [t for t in texts if "\n" in t or t.startswith("- ")]
        assert not [t for t in documents if re.search("<(script|img)", t)]
    assert any("alert(1)" in text for text in texts_of(run.with_name("sensors.rrd")))
    page = tmp_path / "report.html"
    assert main(["report", str(run), "-o", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert harmless(text)
    assert "alert(1)" in text
    assert Tags(text).tags.count("script") == 1
    assert "src=x" not in re.sub(r"&lt;img.*?&gt;", "", text)


def test_texts_that_are_written_into_a_recording_are_escaped(tmp_path: Path) -> None:
    with rrd.SensorWriter(tmp_path / "a.rrd", recording_id="mission") as writer:
        writer.facts([HOSTILE])
        writer.undecodable(0, START_NS, HOSTILE)
    texts = texts_of(tmp_path / "a.rrd")
    assert all(map(harmless, texts))
    assert sum("alert(1)" in text for text in texts) == 2
