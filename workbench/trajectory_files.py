"""Trajectories as text files: TUM (times, positions, quaternions) and KITTI (matrices, times apart).

Written times are exact to the nanosecond and numbers are the shortest decimals that read back as the very same
doubles. Both formats are taken as `world_T_body` in this workbench's axes: KITTI's own data set has poses of a camera
whose z axis looks ahead, and nothing here turns them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.spatial import SpatialPath
from readers.streams import RecordingError

Floats = NDArray[np.float64]

TUM_HEADER = "# timestamp tx ty tz qx qy qz qw\n"
SECOND_NS = 1_000_000_000
ORTHONORMAL = 1e-3
"""A matrix whose columns are off unit length and right angles by more is no rotation; files of 7 digits pass."""


# ------------------------------------------------------------------------------------ lines


def tum_line(t_ns: int, position_m: Sequence[float] | Floats, quat_xyzw: Sequence[float] | Floats) -> str:
    """One line of a TUM file: time (s), x, y, z (m), quaternion x, y, z, w."""
    numbers = " ".join([repr(float(v)) for v in (*position_m, *quat_xyzw)])
    return f"{seconds_text(t_ns)} {numbers}\n"


def tum_line_in_plane(t_ns: int, pose: Sequence[float]) -> str:
    """One line of a TUM file of a pose x, y (m), heading (rad)."""
    x, y, heading = map(float, pose)
    return f"{seconds_text(t_ns)} {x!r} {y!r} 0.0 0.0 0.0 {math.sin(heading / 2)!r} {math.cos(heading / 2)!r}\n"


def kitti_line(pose: Floats) -> str:
    """One line of a KITTI file: the upper three rows of a transform [4, 4], row by row."""
    return " ".join(map(repr, pose[:3].ravel().tolist())) + "\n"


def seconds_text(t_ns: int) -> str:
    """Nanoseconds as seconds with nine decimals, exactly."""
    seconds, rest = divmod(abs(t_ns), SECOND_NS)
    return f"{'-' if t_ns < 0 else ''}{seconds}.{rest:09d}"


# ---------------------------------------------------------------------------------- writing


def write_tum(file: Path, path: SpatialPath) -> None:
    """Write a TUM file, with the header that names the columns.

    Raises:
        RecordingError: the file cannot be written.
    """
    rows = zip(path.t_ns.tolist(), path.position_m.tolist(), path.quat_xyzw.tolist(), strict=True)
    _write(file, [TUM_HEADER, *(tum_line(t_ns, place, quat) for t_ns, place, quat in rows)])


def write_kitti(file: Path, path: SpatialPath, *, times_file: Path | None = None) -> None:
    """Write a KITTI file of poses, and their times in seconds, one a line, into a file of their own.

    Raises:
        RecordingError: a file cannot be written.
    """
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    if len(path):
        poses[:, :3, :3] = path.rotation.as_matrix()
        poses[:, :3, 3] = path.position_m
    _write(file, map(kitti_line, poses))
    if times_file is not None:
        _write(times_file, (f"{seconds_text(t_ns)}\n" for t_ns in path.t_ns.tolist()))


def _write(file: Path, lines: Iterable[str]) -> None:
    try:
        with file.open("w", encoding="ascii", newline="\n") as out:
            out.writelines(lines)
    except OSError as error:
        raise RecordingError(file, f"cannot be written ({error.strerror or error})", "choose another file") from error


# ---------------------------------------------------------------------------------- reading


def read_tum(file: Path) -> SpatialPath:
    """Read a TUM file; columns are parted by spaces, tabs or commas, and # begins a comment.

    Raises:
        RecordingError: the file cannot be read, or a line is not one of a TUM file.
    """
    rows = list(_rows(file, 8, "a TUM line has 8 numbers: time, x, y, z, qx, qy, qz, qw"))
    values = np.array([numbers[1:] for _, _, numbers in rows], dtype=np.float64).reshape(-1, 7)
    empty = np.flatnonzero(~np.any(values[:, 3:], axis=1))
    if len(empty):
        raise _wrong(file, rows[empty[0]][0], "the quaternion is zero")
    return SpatialPath.of(_times(file, rows), values[:, :3], values[:, 3:])


def read_kitti(file: Path, *, times_file: Path | None = None, rate_hz: float | None = None) -> SpatialPath:
    """Read a KITTI file of poses; their times are in a file of their own, or follow from a rate, from 0 on.

    Raises:
        ValueError: neither the times nor the rate are given, or both, or the rate is not positive.
        RecordingError: a file cannot be read, a line is not one of a KITTI file, or the numbers of lines differ.
    """
    if (times_file is None) == (rate_hz is None) or (rate_hz is not None and not rate_hz > 0):
        raise ValueError("a KITTI file has no times: give either times_file or a positive rate_hz")
    rows = list(_rows(file, 12, "a KITTI line has 12 numbers: the upper three rows of a transform"))
    poses = np.array([numbers for _, _, numbers in rows], dtype=np.float64).reshape(-1, 3, 4)
    turns = poses[:, :, :3]
    off = np.abs(turns.transpose(0, 2, 1) @ turns - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = np.flatnonzero((off > ORTHONORMAL) | (np.linalg.det(turns) < 0))
    if len(bad):
        raise _wrong(file, rows[bad[0]][0], "the left 3 x 3 numbers are no rotation")
    if times_file is None:
        assert rate_hz is not None
        t_ns = np.array([round(k * 1e9 / rate_hz) for k in range(len(rows))], dtype=np.int64)
    else:
        t_ns = _times(times_file, list(_rows(times_file, 1, "a line of times has one number, in seconds")))
        if len(t_ns) != len(rows):
            raise RecordingError(
                times_file, f"{len(t_ns)} times for the {len(rows)} poses of {file}", "give the times of these poses"
            )
    quats = Rotation.from_matrix(turns).as_quat() if len(rows) else np.empty((0, 4))
    return SpatialPath.of(t_ns, poses[:, :, 3], quats)


Row = tuple[int, str, list[float]]
"""Number of the line, its first word, its numbers."""


def _rows(file: Path, columns: int, demand: str) -> Iterator[Row]:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise RecordingError(file, f"cannot be read ({reason})", "give a TUM or KITTI text file") from error
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise _wrong(file, number, f"{line.strip()[:40]!r} holds other things than numbers; {demand}") from None
        if len(values) != columns:
            raise _wrong(file, number, f"{len(values)} numbers; {demand}")
        if not all(map(math.isfinite, values)):
            raise _wrong(file, number, "a number is not finite")
        yield number, words[0], values


def _times(file: Path, rows: Sequence[Row]) -> NDArray[np.int64]:
    """Times in nanoseconds, from the first word of each row: exact, where a double would lose digits."""
    return np.array([_nanoseconds(file, number, word) for number, word, _ in rows], dtype=np.int64)


def _nanoseconds(file: Path, number: int, word: str) -> int:
    try:
        t_ns = round(Decimal(word).scaleb(9))
    except InvalidOperation:
        raise _wrong(file, number, f"{word[:40]!r} is no time in seconds") from None
    if not -(2**63) <= t_ns < 2**63:
        raise _wrong(file, number, f"{word[:40]} s is beyond the years that nanoseconds reach; times are in seconds")
    return t_ns


def _wrong(file: Path, line: int, problem: str) -> RecordingError:
    return RecordingError(file, f"line {line}: {problem}", "mend the file, or give another one")
