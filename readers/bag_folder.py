"""What lies around the files of a bag: metadata.yaml of ROS 2, numbered parts, zstd around whole files."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import NamedTuple

import zstandard
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from readers.streams import RecordingError


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key by which ``part_10`` comes after ``part_9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


class BagMetadata(NamedTuple):
    """What a ROS 2 bag's metadata.yaml says: its files (None if it cannot tell); serialisation and count by topic."""

    files: list[str] | None
    formats: Mapping[str, str]
    counts: Mapping[str, int]
    remarks: Sequence[str]

    @classmethod
    def missing(cls, *remarks: str) -> BagMetadata:
        """What is known without it."""
        return cls(None, {}, {}, remarks)


def read_metadata(folder: Path) -> BagMetadata:
    """Read metadata.yaml of a ROS 2 bag, if there is one.

    Only the last part of a stated path counts, so nothing outside of the folder is opened.
    """
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        return BagMetadata.missing("The bag has no metadata.yaml; its files were found by their names.")
    try:
        stated = YAML(typ="safe", pure=True).load(metadata.read_text("utf-8"))["rosbag2_bagfile_information"]
        files = [PurePosixPath(str(name)).name for name in stated["relative_file_paths"]]
        entries = stated.get("topics_with_message_count") or ()
        topics = [entry["topic_metadata"] for entry in entries]
        formats = {str(topic["name"]): str(topic["serialization_format"]) for topic in topics}
        counts: Counter[str] = Counter()
        for topic, entry in zip(topics, entries, strict=True):
            counts[str(topic["name"])] += int(entry["message_count"])
        return BagMetadata(files, formats, counts, ())
    except (YAMLError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return BagMetadata.missing("metadata.yaml cannot be parsed; the bag's files were found by their names.")


def unpack(path: Path, scratch: list[TemporaryDirectory[str]]) -> Path:
    """Unpack a zstd file into a temporary folder, which is made and added to `scratch` if there is none.

    Raises:
        RecordingError: the file cannot be unpacked.
    """
    if not scratch:
        scratch.append(TemporaryDirectory(prefix="workbench-"))
    target = Path(scratch[0].name) / (path.stem if path.suffix in (".zstd", ".zst") else path.name)
    try:
        with path.open("rb") as packed, target.open("wb") as plain:
            stream = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            shutil.copyfileobj(stream, plain, 1 << 20)
    except zstandard.ZstdError as error:
        raise RecordingError(path, f"it cannot be unpacked ({error})", "copy it again") from error
    return target
