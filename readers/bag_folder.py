"""What lies around the files of a bag: metadata.yaml of ROS 2, numbered parts, zstd around whole files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import NamedTuple

import zstandard
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from readers.message_log import HARMLESS_BYTES, LARGEST_RATIO, escaped
from readers.streams import RecordingError

BLOCK_BYTES = 1 << 17  # the largest block of zstd
MOST_MISSING = 1000


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
        formats = {escaped(str(topic["name"])): escaped(str(topic["serialization_format"])) for topic in topics}
        counts: Counter[str] = Counter()
        for topic, entry in zip(topics, entries, strict=True):
            counts[escaped(str(topic["name"]))] += int(entry["message_count"])
        return BagMetadata(files, formats, counts, ())
    except (YAMLError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return BagMetadata.missing("metadata.yaml cannot be parsed; the bag's files were found by their names.")


def missing_numbers(names: Sequence[str]) -> list[str]:
    """The names that lack between those of numbered parts, in their order; none where the gap is no count of parts."""
    found = []
    for before, after in pairwise(names):
        one, two = natural_key(before), natural_key(after)
        place = next((k for k, (a, b) in enumerate(zip(one, two, strict=False)) if a != b), 0)
        first, last = one[place][0], two[place][0]
        if (
            0 <= first < last - 1 < first + MOST_MISSING
            and one[:place] + one[place + 1 :] == two[:place] + two[place + 1 :]
        ):
            parts = re.split(r"(\d+)", before)
            found += ["".join((*parts[:place], str(n), *parts[place + 1 :])) for n in range(first + 1, last)]
    return found


def unpack(path: Path, scratch: list[TemporaryDirectory[str]]) -> tuple[Path, str]:
    """Unpack a zstd file, as far as that can be done, into a temporary folder.

    The folder is made and added to `scratch` if there is none. No more is unpacked than `LARGEST_RATIO` times the
    packed bytes, or `HARMLESS_BYTES`.

    Returns:
        The unpacked file, and a clause that says why it is not whole; "" if nothing is known to be wrong.

    Raises:
        RecordingError: not a byte of it can be unpacked.
    """
    if not scratch:
        scratch.append(TemporaryDirectory(prefix="workbench-"))
    target = Path(scratch[0].name) / (path.stem if path.suffix in (".zstd", ".zst") else path.name)
    limit, fault = max(HARMLESS_BYTES, LARGEST_RATIO * path.stat().st_size), ""
    with path.open("rb") as packed, target.open("wb") as plain:
        stream = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        try:
            while (piece := stream.read1(BLOCK_BYTES)) and plain.tell() < limit:
                plain.write(piece)
        except zstandard.ZstdError as error:
            fault = f"its zstd data break off ({error})"
        if plain.tell() >= limit:
            fault = f"only {limit} bytes are unpacked of what is packed in {path.stat().st_size}"
        if not plain.tell():
            problem = f"it cannot be unpacked: {fault or 'its first block of zstd data is not whole'}"
            raise RecordingError(path, problem, "copy it again")
    return target, fault
