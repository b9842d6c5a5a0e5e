"""Frames without a layout: which images belong together, and when each was taken."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np

from readers.folder_streams import Draft
from readers.folder_tables import NS_PER_UNIT, Table, exact_ns, guess_unit, read_table, unit_of_name
from readers.streams import FloatArray, ReadOptions, RecordingError

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".pbm", ".pnm", ".bmp", ".tif", ".tiff", ".webp", ".jp2"}
)
_TIMES_STEM = re.compile(r"(.*[_-])?(times?|times?_?stamps?|stamps)", re.IGNORECASE)
_STAMP_NAME = re.compile(r"\D*?(\d+\.\d{3,9}|\d{9,19})")
_FAMILY = re.compile(r"(.*?)[_-]?(\d+)")


@dataclass(frozen=True, slots=True)
class Exif:
    """What a photo says of itself: time in ns, latitude and longitude in rad and altitude in m (NaN if unknown)."""

    t_ns: int
    position: tuple[float, float, float]


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that reads digits as numbers: frame2 before frame10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name)
    key = [(0, int(part), "") if part[0] in "0123456789" else (1, 0, part) for part in parts]
    return [*key, (2, 0, path.name)]


def frame_number(path: Path) -> int | None:
    """The last whole number in a file's name, None if it has none."""
    numbers = re.findall(r"[0-9]+", path.stem)
    return int(numbers[-1]) if numbers else None


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder in natural order, hidden ones left out."""
    if not folder.is_dir():
        return []
    files = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    return sorted(files, key=natural_key)


def image_folders(root: Path) -> dict[str, list[Path]]:
    """Images of the folders just below `root` (or of ``data`` below those), by the folder's name."""
    found = {}
    for folder in sorted((p for p in root.iterdir() if p.is_dir() and not p.name.startswith(".")), key=natural_key):
        if files := images_in(folder) or images_in(folder / "data"):
            found[folder.name] = files
    return found


def image_groups(root: Path) -> dict[str, list[Path]]:
    """The image streams of a folder: its own images, else those of the folders in it, by stream name.

    Images of one folder whose names differ in what stands before the number (``left01``, ``right01``) are
    separate streams, if most of the numbers are found in every family.
    """
    own = images_in(root)
    return _families(own) if own else image_folders(root)


def _families(files: Sequence[Path]) -> dict[str, list[Path]]:
    families: dict[str, list[Path]] = {}
    for file in files:
        match = _FAMILY.fullmatch(file.stem)
        families.setdefault(match[1] if match else "", []).append(file)
    numbers = [_numbers(family) for family in families.values()]
    named = len(families) > 1 and "" not in families and all(len(n) > 1 for n in numbers)
    paired = named and _paired_numbers(numbers)
    return families if paired else {"images": list(files)}


def ranks_of(groups: dict[str, list[Path]]) -> dict[Path, int]:
    """Index in time of every frame, empty if the streams have no order in common.

    Frames of several streams with the same number have the same index.
    """
    if len(groups) == 1:
        return {file: rank for files in groups.values() for rank, file in enumerate(files)}
    numbers = [_numbers(files) for files in groups.values()]
    if not _paired_numbers(numbers):
        return {}
    rank_of = {number: rank for rank, number in enumerate(sorted(set.union(*numbers)))}
    return {file: rank_of[frame_number(file) or 0] for files in groups.values() for file in files}


def _numbers(files: Sequence[Path]) -> set[int]:
    """The numbers in the files' names, empty if not every file has its own."""
    numbers = {number for file in files if (number := frame_number(file)) is not None}
    return numbers if len(numbers) == len(files) else set()


def _paired_numbers(numbers: Sequence[set[int]]) -> bool:
    """Whether most of the numbers are found in every stream."""
    return len(set.intersection(*numbers)) >= max(1, max(len(n) for n in numbers) / 2)


def frame_times(
    draft: Draft, name: str, files: Sequence[Path], ranks: dict[Path, int], options: ReadOptions
) -> dict[Path, int]:
    """When each frame of a stream was taken, and a note of how that is known.

    In this order: the given times file, a times file in the folder, file names that are time stamps,
    EXIF, the given frame rate.

    Args:
        draft: the recording, which gets the note, the damage, and a GNSS stream of photos that have one.
        name: the stream.
        files: its frames in natural order.
        ranks: index in time of each frame.
        options: what the user said.

    Returns:
        Time in ns by file; a frame whose row is damaged is left out.

    Raises:
        RecordingError: nothing tells the times.
    """
    if options.times_unit not in ("auto", *NS_PER_UNIT):
        raise RecordingError(draft.path, f"unknown unit of times {options.times_unit!r}", "give s, ms, us, ns or auto")
    if options.times_file is not None:
        draft.used_times_file = True
        return _from_table(draft, name, files, ranks, options.times_file, options.times_unit)
    if (table := _times_file(draft.path, files)) is not None:
        return _from_table(draft, name, files, ranks, table, options.times_unit)
    named = _from_names(draft, name, files, options.times_unit)
    times = named or _from_exif(draft, name, files) or _from_rate(draft, name, files, ranks, options)
    if times is None and not ranks:
        raise _unrelated(draft.path)
    if times is None:
        raise RecordingError(
            draft.path,
            f"holds {len(files)} images ({name}) and nothing says when they were taken "
            "(no file of times, no time stamps in their names, no useful EXIF times)",
            "give the frame rate with `--rate HZ` or a file of times with `--times FILE`",
        )
    return times


def _unrelated(root: Path) -> RecordingError:
    return RecordingError(
        root,
        f"its folders of images ({shortened(list(image_folders(root)))}) have no frame numbers in common",
        "give one of them",
    )


def rate_times(count: int, rate_hz: float) -> list[int]:
    """Times of frames at an even rate from 0, rounded to ns.

    Raises:
        ValueError: the rate is not a positive number.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise ValueError(f"a frame rate of {rate_hz} Hz")
    period = frame_period_ns(rate_hz)
    return [round(index * period) for index in range(count)]


def frame_period_ns(rate_hz: float) -> Fraction:
    """Exact time between frames; a rate such as 29.97002997 stands for its fraction 30000/1001."""
    return NS_PER_UNIT["s"] / Fraction(rate_hz).limit_denominator(100_000)


def exif_of(file: Path) -> Exif | None:
    """Time and position that a photo states, None without a time."""
    from PIL import Image

    try:
        with Image.open(file) as image:
            tags = image.getexif()
            photo, gps = tags.get_ifd(0x8769), tags.get_ifd(0x8825)
    except Exception:  # of a damaged file Pillow raises errors of many types
        return None
    try:
        t_ns = _exif_time(photo)
    except (ValueError, KeyError):
        return None
    return Exif(t_ns, _exif_position(gps))


def _exif_time(photo: dict[int, object]) -> int:
    """DateTimeOriginal with its fraction and zone (UTC if it states none)."""
    stamp = str(photo[0x9003]).strip("\0 ")
    fraction = str(photo.get(0x9291, "")).strip("\0 ")
    zone = str(photo.get(0x9011, "")).strip("\0 ")
    return exact_ns(stamp + (f".{fraction}" if fraction.isdecimal() else "") + zone, "s")


def _exif_position(gps: dict[int, object]) -> tuple[float, float, float]:
    """Latitude and longitude in rad, altitude in m, NaN where unknown."""
    nan = float("nan")
    try:
        latitude, longitude = (_degrees(gps[tag]) for tag in (2, 4))
        latitude *= -1 if str(gps.get(1, "N")).startswith("S") else 1
        longitude *= -1 if str(gps.get(3, "E")).startswith("W") else 1
    except (KeyError, ValueError, TypeError, ZeroDivisionError):
        return nan, nan, nan
    try:
        below = gps.get(5) in (1, b"\x01")
        altitude = float(str(gps[6])) * (-1 if below else 1)
    except (KeyError, ValueError, ZeroDivisionError):
        altitude = nan
    return math.radians(latitude), math.radians(longitude), altitude


def _degrees(value: object) -> float:
    degrees, minutes, seconds = (float(part) for part in value)  # type: ignore[attr-defined]
    angle: float = degrees + minutes / 60 + seconds / 3600
    if not (math.isfinite(angle) and 0 <= angle <= 180):
        raise ValueError(f"{value!r} is no angle")
    return angle


def _times_file(root: Path, files: Sequence[Path]) -> Path | None:
    """A file of times beside the frames or up to the root, None if there is none."""
    folder = files[0].parent
    places = [folder, *(p for p in folder.parents if p.is_relative_to(root))]
    for place in places:
        tables = (p for p in place.iterdir() if p.suffix.lower() in (".txt", ".csv") and p.is_file())
        if found := sorted(p for p in tables if _TIMES_STEM.fullmatch(p.stem)):
            return found[0]
    return None


def _from_table(
    draft: Draft, name: str, files: Sequence[Path], ranks: dict[Path, int], path: Path, unit: str
) -> dict[Path, int]:
    """Times of a table with a row for each frame, or with rows of file name and time."""
    table = read_table(path)
    by_name = _name_column(table, files)
    column = _time_column(table, by_name)
    if unit == "auto":
        unit = _table_unit(table, column)
    how = f"{name}: times from {path.name} in {unit}"
    if by_name is None:
        rows = _paired(table, files, ranks)
        draft.note(f"{how}, row by row")
    else:
        named = {_key(cells[by_name]): (line, cells) for line, cells in table.rows if by_name < len(cells)}
        rows = {f: named[key] for f in files for key in _keys(f) if key in named}
        draft.note(f"{how}, by file name" + _missing(files, rows))
    times = {}
    for file, (line, cells) in rows.items():
        try:
            times[file] = exact_ns(table.plain(cells[column]), unit)
        except (ValueError, IndexError):
            table.bad.append((line, f"no time in column {column + 1}"))
    draft.bad_rows(table)
    if not times:
        raise RecordingError(path, "no row holds a time", "give one time a line, or file name and time")
    return times


def _paired(table: Table, files: Sequence[Path], ranks: dict[Path, int]) -> dict[Path, tuple[int, list[str]]]:
    """The row of each frame by order.

    Raises:
        RecordingError: there are more or fewer rows than frames.
    """
    if len(table.rows) == len(files):
        return dict(zip(files, table.rows, strict=True))
    if len(table.rows) == max(ranks.values(), default=-1) + 1:
        return {file: table.rows[ranks[file]] for file in files}
    problem = f"has {len(table.rows)} rows for {len(files)} frames, and none of its columns names the files"
    raise RecordingError(table.path, problem, "give one time for each frame, or rows of file name and time")


def _name_column(table: Table, files: Sequence[Path]) -> int | None:
    """The column that names the frames, None if there is none."""
    widest = max((len(cells) for _, cells in table.rows), default=0)
    if widest < 2:
        return None
    columns = [{_key(cells[c]) for _, cells in table.rows if c < len(cells)} for c in range(widest)]
    names, stems, numbers = (set(kind) for kind in zip(*(_keys(file) for file in files), strict=True))
    for known in (names, stems):
        for column, keys in enumerate(columns):
            if 2 * len(keys & known) > min(len(keys), len(files)):
                return column
    # Numbers must all be there: a count of rows from 0 also meets most of the names that count from 1.
    return next((column for column, keys in enumerate(columns) if numbers <= keys), None)


def _keys(file: Path) -> tuple[str | int | None, ...]:
    """What a table may call a frame, the surest first: its name, the name without suffix, its number."""
    return file.name, None if file.stem.isdecimal() else file.stem, frame_number(file)


def _key(cell: str) -> str | int:
    return int(cell) if cell.isdecimal() else cell.rsplit("/", 1)[-1]


def _time_column(table: Table, name_column: int | None) -> int:
    """The column named so, else the first one that is neither a name nor a running number."""
    named = table.column("time", "stamp", "sec", "t ", "t_", "t[", "t(")
    if named is not None and named != name_column:
        return named
    others = [c for c in range(len(table.rows[0][1]) if table.rows else 1) if c != name_column]
    if len(others) > 1:
        counted = [cells[others[0]] for _, cells in table.rows if cells]
        if counted and all(cell.isdecimal() for cell in counted) and _running([int(cell) for cell in counted]):
            return others[1]
    return others[0]


def _running(numbers: list[int]) -> bool:
    return all(b == a + 1 for a, b in pairwise(numbers))


def _table_unit(table: Table, column: int) -> str:
    stated = unit_of_name(table.header[column]) if column < len(table.header) else None
    if stated:
        return stated
    cells = [table.plain(cells[column]) for _, cells in table.rows if column < len(cells)]
    try:
        return guess_unit([cell for cell in cells if cell[:1].isdigit()])
    except ValueError as error:
        raise RecordingError(table.path, str(error), "give the unit with `--times-unit s|ms|us|ns`") from None


def _missing(files: Sequence[Path], rows: dict[Path, tuple[int, list[str]]]) -> str:
    missing = [file.name for file in files if file not in rows]
    return f"; {len(missing)} images without a row are left out ({shortened(missing)})" if missing else ""


def shortened(names: Sequence[str], limit: int = 12) -> str:
    """Up to `limit` names, and how many more there are."""
    rest = len(names) - limit
    shown = [name if name.isprintable() else ascii(name) for name in names[:limit]]
    return ", ".join(shown) + (f" and {rest} more" if rest > 0 else "")


def _from_names(draft: Draft, name: str, files: Sequence[Path], unit: str) -> dict[Path, int] | None:
    """Times from names such as 1403715273262142976.png or 1341847980.722988.png, None if they are others."""
    stamps = [match[1] for file in files if (match := _STAMP_NAME.fullmatch(file.stem))]
    if len(stamps) < len(files):
        return None
    if all("." in stamp for stamp in stamps):
        unit = "s" if unit == "auto" else unit
    elif any(not _of_epoch(stamp) for stamp in stamps):
        return None
    elif unit == "auto":
        unit = guess_unit(stamps)
    draft.note(f"{name}: times from the file names in {unit}")
    return {file: exact_ns(stamp, unit) for file, stamp in zip(files, stamps, strict=True)}


def _of_epoch(stamp: str) -> bool:
    """Whether a number is a time of the years 1998 to 2103 in s, ms, us or ns, not a frame's number."""
    return any(9e8 * 1000**k <= float(stamp) < 4.2e9 * 1000**k for k in range(4)) and not stamp.startswith("0")


def _from_exif(draft: Draft, name: str, files: Sequence[Path]) -> dict[Path, int] | None:
    """Times and fixes of photos, None if a photo has no time or most of them share one."""
    if any(file.suffix.lower() not in (".jpg", ".jpeg", ".tif", ".tiff") for file in files):
        return None
    photos: dict[Path, Exif] = {}
    for file in files:
        if (photo := exif_of(file)) is None:
            return None
        photos[file] = photo
    times = {file: photo.t_ns for file, photo in photos.items()}
    if 2 * len(set(times.values())) <= len(files) and len(files) > 1:
        return None
    draft.note(f"{name}: times from EXIF (camera's clock, taken as UTC where it states no zone)")
    fixes = [photo for photo in photos.values() if not math.isnan(photo.position[0])]
    if fixes:
        values: FloatArray = np.array([photo.position for photo in fixes])
        draft.gnss(draft.free_name("gps"), [photo.t_ns for photo in fixes], values, "EXIF position")
    return times


def _from_rate(
    draft: Draft, name: str, files: Sequence[Path], ranks: dict[Path, int], options: ReadOptions
) -> dict[Path, int] | None:
    if options.rate_hz is None:
        return None
    if not ranks:
        raise _unrelated(draft.path)
    try:
        times = rate_times(max(ranks.values()) + 1, options.rate_hz)
    except ValueError as error:
        raise RecordingError(draft.path, f"{error} was asked for", "give a positive number with `--rate HZ`") from None
    draft.used_rate = True
    numbers = [number for file in files if (number := frame_number(file)) is not None]
    holes = max(numbers) - min(numbers) + 1 - len(set(numbers)) if len(numbers) == len(files) else 0
    spacing = f"; {holes} numbers are missing in the file names, the frames are evenly spaced all the same"
    draft.note(f"{name}: times from the given rate of {options.rate_hz:g} Hz" + (spacing if holes else ""))
    return {file: times[ranks[file]] for file in files}
