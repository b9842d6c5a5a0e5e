"""TUM and KITTI files: exact to the nanosecond and the last bit, read by evo, and refused with a reason."""

import math
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from pipelines.geometry import heading_of_quat
from pipelines.spatial import SpatialPath
from readers.streams import RecordingError
from workbench.trajectory_files import (
    read_kitti,
    read_tum,
    seconds_text,
    tum_line_in_plane,
    write_kitti,
    write_tum,
)


def some_path(n: int = 200) -> SpatialPath:
    rng = np.random.default_rng(4)
    t = 1_700_000_000_123_456_789 + np.cumsum(rng.integers(1, 40_000_000, n))
    places = rng.normal(0, 1, (n, 3)) * 10.0 ** rng.integers(-9, 5, (n, 3))
    return SpatialPath.of(t, places, Rotation.random(n, random_state=3).as_quat())


def test_tum_files_read_back_bit_for_bit(tmp_path: Path) -> None:
    path = some_path()
    write_tum(tmp_path / "a.tum", path)
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.t_ns, path.t_ns)
    np.testing.assert_array_equal(back.position_m, path.position_m)
    np.testing.assert_array_equal(back.quat_xyzw, path.quat_xyzw)


def test_evo_reads_our_tum_files(tmp_path: Path) -> None:
    path = some_path()
    write_tum(tmp_path / "a.tum", path)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    np.testing.assert_array_equal(theirs.positions_xyz, path.position_m)
    np.testing.assert_array_equal(theirs.orientations_quat_wxyz[:, [1, 2, 3, 0]], path.quat_xyzw)
    np.testing.assert_array_equal(theirs.timestamps, [float(seconds_text(t)) for t in path.t_ns.tolist()])


def test_we_read_evos_tum_and_kitti_files(tmp_path: Path) -> None:
    path = some_path()
    write_tum(tmp_path / "a.tum", path)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    file_interface.write_tum_trajectory_file(tmp_path / "b.tum", theirs)
    back = read_tum(tmp_path / "b.tum")
    np.testing.assert_allclose(back.position_m, path.position_m, rtol=1e-15)
    assert np.abs(back.t_ns - path.t_ns).max() <= 256  # evo keeps times as doubles
    file_interface.write_kitti_poses_file(tmp_path / "b.txt", theirs)
    poses = read_kitti(tmp_path / "b.txt", rate_hz=10)
    np.testing.assert_allclose(poses.position_m, path.position_m, rtol=1e-14)
    assert (path.rotation.inv() * poses.rotation).magnitude().max() < 1e-12
    assert poses.t_ns[:3].tolist() == [0, 100_000_000, 200_000_000]


def test_kitti_files_read_back_and_evo_reads_them(tmp_path: Path) -> None:
    path = some_path()
    write_kitti(tmp_path / "a.txt", path, times_file=tmp_path / "times.txt")
    back = read_kitti(tmp_path / "a.txt", times_file=tmp_path / "times.txt")
    np.testing.assert_array_equal(back.t_ns, path.t_ns)
    np.testing.assert_array_equal(back.position_m, path.position_m)
    assert (path.rotation.inv() * back.rotation).magnitude().max() < 1e-14
    theirs = file_interface.read_kitti_poses_file(tmp_path / "a.txt")
    np.testing.assert_array_equal(theirs.positions_xyz, path.position_m)
    np.testing.assert_array_equal([p[:3, :3] for p in theirs.poses_se3], path.rotation.as_matrix())


def test_lines_of_the_plane() -> None:
    line = tum_line_in_plane(1_500_000_000_000_000_001, (0.1, -2.0, math.pi / 3))
    words = line.split()
    assert words[:4] == ["1500000000.000000001", "0.1", "-2.0", "0.0"]
    assert heading_of_quat(np.array(words[4:], dtype=float)) == pytest.approx(math.pi / 3, abs=1e-15)
    assert line.endswith("\n")


@pytest.mark.parametrize(
    ("t_ns", "text"),
    [(0, "0.000000000"), (-100_000_000, "-0.100000000"), (-1_900_000_000, "-1.900000000"), (5, "0.000000005")],
)
def test_times_are_exact(tmp_path: Path, t_ns: int, text: str) -> None:
    assert seconds_text(t_ns) == text
    (tmp_path / "a.tum").write_text(f"{text} 0 0 0 0 0 0 1\n")
    assert read_tum(tmp_path / "a.tum").t_ns.tolist() == [t_ns]


def test_foreign_spellings(tmp_path: Path) -> None:
    text = "\ufeff# a comment\n\n1.5e9,1,2,3,0,0,0,2 # more\n1500000001.25\t1 2 3 0 0 0 1\n"
    (tmp_path / "a.tum").write_text(text, encoding="utf-8")
    path = read_tum(tmp_path / "a.tum")
    assert path.t_ns.tolist() == [1_500_000_000_000_000_000, 1_500_000_001_250_000_000]
    np.testing.assert_array_equal(path.quat_xyzw, [[0, 0, 0, 1]] * 2)
    (tmp_path / "b.tum").write_text("# nothing\n")
    assert len(read_tum(tmp_path / "b.tum")) == 0
    write_kitti(tmp_path / "c.txt", read_tum(tmp_path / "b.tum"))
    assert len(read_kitti(tmp_path / "c.txt", rate_hz=1)) == 0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1 0 0 0 0 0 0 1\n1 2 3\n", "line 2: 3 numbers; a TUM line has 8"),
        ("1 0 0 0 0 0 0 one\n", "line 1: .*other things than numbers"),
        ("1 0 nan 0 0 0 0 1\n", "line 1: a number is not finite"),
        ("1 0 0 0 0 0 0 0\n", "line 1: the quaternion is zero"),
        ("1500000000000000000 0 0 0 0 0 0 1\n", "times are in seconds"),
    ],
)
def test_files_that_are_not_tum_are_refused(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "bad.tum").write_text(text)
    with pytest.raises(RecordingError, match=rf"bad\.tum: .*{problem}"):
        read_tum(tmp_path / "bad.tum")


def test_files_that_are_not_kitti_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    file.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 2 0\n")
    with pytest.raises(RecordingError, match=r"line 2: .*no rotation"):
        read_kitti(file, rate_hz=10)
    file.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "times.txt").write_text("0\n1\n")
    with pytest.raises(RecordingError, match="2 times for the 1 poses"):
        read_kitti(file, times_file=tmp_path / "times.txt")
    for wrong in ({}, {"rate_hz": 0.0}, {"rate_hz": 1.0, "times_file": file}):
        with pytest.raises(ValueError, match="times_file or a positive rate_hz"):
            read_kitti(file, **wrong)  # type: ignore[arg-type]


def test_what_cannot_be_read_or_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(RecordingError, match="it is no text"):
        read_tum(tmp_path / "binary")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_tum(tmp_path / "no" / "a.tum", some_path(3))
