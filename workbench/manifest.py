"""The manifest of a run, ``RUN.sha256``: what its files are, to the bit, and how many rows each entity holds.

It is a list that ``sha256sum -c`` checks, with remarks that it passes over:

    # estimator workbench manifest 1
    5f70bf18…  best.rrd
    # rows 300 best.rrd /runs/best/correlation/motion
    # lines 9b74c989…

`rows` counts what could be read back of a file when it was written; `lines`, the last line, is the SHA-256 of all
lines before it. Rerun's own check passes most flipped bits and an empty file; this one passes neither.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from readers.streams import RecordingError

SUFFIXES = ("rrd", "toml", "tum", "checkpoints")
SENSORS = "sensors.rrd"
LONGEST_S = 300
HEAD = "# estimator workbench manifest 1"

Rows = Mapping[str, int]
CountRows = Callable[[Path], Rows]
_DIGEST, _ROWS, _LINES = (
    re.compile(pattern)
    for pattern in (r"([0-9a-f]{64})  ([^/\0]+)", r"# rows (\d+) (\S+) (/.*)", r"# lines ([0-9a-f]{64})")
)


@dataclass(frozen=True, slots=True)
class Manifest:
    """Digests by file name, and rows by file name and entity."""

    digests: dict[str, str] = field(default_factory=dict)
    rows: dict[str, dict[str, int]] = field(default_factory=dict)

    def text(self) -> str:
        """The manifest as it is written."""
        lines = [HEAD]
        for name, digest in self.digests.items():
            lines.append(f"{digest}  {name}")
            lines += [f"# rows {count} {name} {entity}" for entity, count in sorted(self.rows.get(name, {}).items())]
        body = "".join(f"{line}\n" for line in lines)
        return f"{body}# lines {hashlib.sha256(body.encode()).hexdigest()}\n"

    @classmethod
    def of_text(cls, text: str) -> Manifest:
        """The manifest that was written.

        Raises:
            ValueError: the text is no manifest, or was changed; a clause says which.
        """
        head, _, _ = text.partition("\n")
        if head != HEAD:
            raise ValueError("it does not begin like a manifest")
        body, mark, _ = text.rpartition("# lines ")
        end = _LINES.fullmatch(text[len(body) :].removesuffix("\n"))
        if not mark or end is None:
            raise ValueError("its last line is missing: it was cut")
        if end[1] != hashlib.sha256(body.encode()).hexdigest():
            raise ValueError("its own lines were changed")
        found = cls()
        for line in body.splitlines()[1:]:
            if row := _ROWS.fullmatch(line):
                found.rows.setdefault(row[2], {})[row[3]] = int(row[1])
            elif digest := _DIGEST.fullmatch(line):
                found.digests[digest[2]] = digest[1]
            else:
                raise ValueError(f"it has the line {line!r}")
        return found


def file_of(folder: Path, run: str) -> Path:
    """Where the manifest of a run lies."""
    return folder / f"{run}.sha256"


def runs_of(path: Path) -> list[tuple[Path, str]]:
    """Folder and name of each run that a path means: of a folder all that have a manifest or a RUN.toml.

    Raises:
        RecordingError: there is none.
    """
    if not path.is_dir():
        known = path.suffix.removeprefix(".") in (*SUFFIXES, "sha256")
        name = path.stem if known else path.name
        if not any((path.parent / f"{name}.{suffix}").is_file() for suffix in (*SUFFIXES, "sha256")):
            raise RecordingError(path, "there is no such run", "give the folder or the RUN.rrd of a replay")
        return [(path.parent, name)]
    files = [*path.glob("*.sha256"), *path.glob("*.toml")]
    names = sorted({file.stem for file in files} - {Path(SENSORS).stem})
    if not names:
        raise RecordingError(path, "holds no run", "give the folder or the RUN.rrd of a replay")
    return [(path, name) for name in names]


def write(folder: Path, run: str, made: Manifest) -> None:
    """Write the manifest of a run, so that it is there as a whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    file = file_of(folder, run)
    part = file.with_name(f"{file.name}.part")
    part.write_text(made.text(), encoding="utf-8")
    part.replace(file)


def digest_of(file: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def stored_rows(file: Path) -> Rows:
    """How many rows each entity of an .rrd file holds, from its data.

    Raises:
        RecordingError: it cannot be read.
    """
    from workbench.rrd_reading import stored_rows as read

    return read(file)


def taken(folder: Path, run: str, count_rows: CountRows = stored_rows, *, known: Manifest | None = None) -> Manifest:
    """The manifest of the files of a run as they are now; the sensors' file as it is `known`, where it is.

    Raises:
        RecordingError: a file that was just written cannot be read back.
    """
    files = [file for suffix in SUFFIXES if (file := folder / f"{run}.{suffix}").is_file()]
    if known is not None and SENSORS in known.digests:
        own = taken_of(files, count_rows)
        own.digests[SENSORS], own.rows[SENSORS] = known.digests[SENSORS], known.rows.get(SENSORS, {})
        return own
    return taken_of(files + [file for file in (folder / SENSORS,) if file.is_file()], count_rows)


def taken_of(files: Sequence[Path], count_rows: CountRows) -> Manifest:
    """The manifest of files as they are now, in their order; errors as `taken`."""
    with ThreadPoolExecutor(1) as other:  # digests do not need the interpreter while rows are counted
        digests = other.map(digest_of, files)
        rows = {file.name: dict(count_rows(file)) for file in files if file.suffix == ".rrd"}
        return Manifest({file.name: digest for file, digest in zip(files, digests, strict=True)}, rows)


def read(folder: Path, run: str) -> Manifest:
    """The manifest of a run.

    Raises:
        RecordingError: there is none, or it was changed.
    """
    file = file_of(folder, run)
    try:
        return Manifest.of_text(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        problem = "there is no manifest: the replay was killed, or is of an older version"
        raise RecordingError(file, problem, "replay the recording again") from None
    except (OSError, ValueError) as error:
        raise RecordingError(file, f"cannot be relied on: {error}", "replay the recording again") from error


def rows_apart(file: Path) -> Rows:
    """The same of a file that is damaged, in a process of its own: Rerun's reader may take the process down with it.

    Raises:
        RecordingError: it cannot be read.
    """
    code = "import json, sys; from workbench import manifest; print(json.dumps(manifest.rows_or_problem(sys.argv[1])))"
    environment = os.environ | {"RUST_LOG": "off", "PYTHONPATH": os.pathsep.join(sys.path)}
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, str(file)],
            capture_output=True,
            text=True,
            check=True,
            timeout=LONGEST_S,
            env=environment,
        )
        rows, problem = json.loads(done.stdout)
    except (subprocess.SubprocessError, ValueError):
        rows, problem = {}, "its rows cannot be read"
    if problem:
        raise RecordingError(file, problem, "replay the recording again")
    return {str(entity): int(count) for entity, count in rows.items()}


def rows_or_problem(file: str) -> tuple[Rows, str]:
    """The rows of a file and an empty text, or none and what is wrong with it."""
    try:
        return stored_rows(Path(file)), ""
    except RecordingError as error:
        return {}, error.problem


@dataclass(frozen=True, slots=True)
class Check:
    """What became of one file: `problems` is empty where it is as it was written."""

    name: str
    rows: int
    problems: tuple[str, ...]


def verify(
    folder: Path, run: str, count_rows: CountRows = stored_rows, count_damaged: CountRows = rows_apart
) -> list[Check]:
    """Hold the files of a run against its manifest; rows of files whose bytes differ are counted by `count_damaged`.

    Raises:
        RecordingError: there is no manifest, or it was changed.
    """
    manifest = read(folder, run)
    needed = [name for name in (f"{run}.rrd", f"{run}.toml", SENSORS) if name not in manifest.digests]
    checks = [Check(name, 0, ("the manifest does not list it",)) for name in needed]
    for name, digest in manifest.digests.items():
        expected = manifest.rows.get(name, {})
        problems = tuple(_problems(folder / name, digest, expected, count_rows, count_damaged))
        if problems and name == SENSORS and (other := _owner(folder, run)):
            problems += (f"it was written again by the run {other}: this run was of another window or choice",)
        checks.append(Check(name, sum(expected.values()), problems))
    return checks


def _problems(
    file: Path, digest: str, expected: Rows, count_rows: CountRows, count_damaged: CountRows
) -> Iterator[str]:
    """What is wrong with one file."""
    if not file.is_file():
        yield "it is missing"
        return
    if not file.stat().st_size and file.suffix == ".rrd":
        yield "it is empty (0 bytes)"
        return
    differs = digest_of(file) != digest
    if differs:
        yield "its bytes are not those that were written (SHA-256 differs)"
    if file.suffix == ".rrd":
        yield from _row_problems(file, expected, count_damaged if differs else count_rows)


def _row_problems(file: Path, expected: Rows, count_rows: CountRows) -> Iterator[str]:
    """Entities with another number of rows than the manifest says; the first ten by name."""
    if not expected:
        yield "the manifest knows no rows of it"
    try:
        found = count_rows(file)
    except RecordingError as error:
        yield error.problem
        return
    differing = [name for name in sorted({*expected, *found}) if expected.get(name, 0) != found.get(name, 0)]
    for name in differing[:10]:
        yield f"{name} holds {found.get(name, 0)} rows, not {expected.get(name, 0)}"
    if len(differing) > 10:
        yield f"{len(differing) - 10} more entities differ in their rows"


def _owner(folder: Path, run: str) -> str:
    """Another run whose manifest knows the sensors' file as it is now; empty where there is none."""
    file = folder / SENSORS
    if not file.is_file():
        return ""
    digest = digest_of(file)
    for other in sorted(folder.glob("*.sha256")):
        if other.stem == run:
            continue
        try:
            known = read(folder, other.stem).digests.get(SENSORS)
        except RecordingError:
            continue
        if known == digest:
            return other.stem
    return ""
