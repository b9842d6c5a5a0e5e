"""States on file: what goes round bit for bit, what is refused, what a crash leaves."""

import struct
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.correlation.equations import Motion
from pipelines.correlation.odometry import CorrelationState
from pipelines.ranging.landmarks.settings import LandmarkKind
from pipelines.verdict import Verdict
from readers.streams import RangeSample, RecordingError
from workbench.checkpoints import CheckpointError, CheckpointWriter, decode, encode, nearest

ABOUT = {"digest": "abc", "run": "best", "estimator": "toy"}


def bits(number: float) -> bytes:
    return struct.pack("<d", number)


@pytest.mark.parametrize(
    "number", [0.1, -0.0, np.inf, -np.inf, struct.unpack("<d", b"\x07\x00\x00\x00\x00\x00\xf8\x7f")[0]]
)
def test_floats_keep_their_bits(number: float) -> None:
    assert bits(decode(encode(number))) == bits(number)


def test_arrays_keep_bits_kind_layout_and_lock() -> None:
    base = np.arange(24.0).reshape(4, 6)
    base[0, 0] = struct.unpack("<d", b"\x07\x00\x00\x00\x00\x00\xf8\xff")[0]
    locked = np.arange(3, dtype=np.int16)
    locked.setflags(write=False)
    arrays = [base, base.T, base[:, 1:3], locked, np.zeros((0, 3), np.float32), np.array(2.5), np.array([True, False])]
    for before, after in zip(arrays, decode(encode(arrays)), strict=True):
        assert (after.dtype, after.shape, after.strides) == (before.dtype, before.shape, before.strides)
        assert after.tobytes() == before.tobytes()
        assert after.flags.writeable == before.flags.writeable


def test_what_is_shared_stays_shared_and_containers_keep_their_classes() -> None:
    shared = np.arange(3.0)
    state = CorrelationState(history=shared, covariance=shared, velocity=Motion(1.0, 2.0, 3.0, 4.0))
    value = {"state": state, 3: (deque([1, 2], 5), frozenset({4}), b"\x00x"), "flags": Verdict.LOST | Verdict.BLURRED}
    found = decode(encode(value))
    assert found["state"].history is found["state"].covariance
    assert found["state"].velocity == state.velocity
    assert type(found["state"].velocity) is Motion
    assert found[3] == value[3]
    assert found[3][0].maxlen == 5
    assert found["flags"] is Verdict.LOST | Verdict.BLURRED
    assert decode(encode(LandmarkKind.TRACKS)) is LandmarkKind.TRACKS
    assert type(decode(encode(np.float32(0.1)))) is np.float32


def test_a_class_from_elsewhere_is_neither_written_nor_made() -> None:
    with pytest.raises(CheckpointError, match=r"pathlib:\w*Path"):
        encode(Path("x"))
    sample = RangeSample(stream="/h", t_ns=1, received_ns=2, range_m=1, min_range_m=0, max_range_m=9,
                         field_of_view_rad=0)  # fmt: skip
    assert decode(encode(sample)) == sample
    import zlib

    for name in ("pathlib:Path", "os:system", "pipelines.estimator:dataclasses", "pipelines.verdict:flags"):
        tree = f'["d","{name}",{{}}]'.encode()
        with pytest.raises(CheckpointError):
            decode(zlib.compress(struct.pack("<I", len(tree)) + tree))


def test_bytes_that_are_no_state() -> None:
    with pytest.raises(CheckpointError):
        decode(b"nothing")


def written(path: Path, frames: range = range(-1, 40, 10)) -> Path:
    with CheckpointWriter(path, ABOUT) as states:
        for frame in frames:
            states.write(frame, {"after": frame})
    return path


@pytest.mark.parametrize(("before", "found"), [(0, -1), (9, -1), (10, 9), (30, 29), (1000, 39)])
def test_the_nearest_state_before_a_frame(tmp_path: Path, before: int, found: int) -> None:
    assert nearest(written(tmp_path / "c"), before, ABOUT) == (found, {"after": found})


def test_a_torn_file_is_good_up_to_its_last_whole_record(tmp_path: Path) -> None:
    path = written(tmp_path / "c")
    path.write_bytes(path.read_bytes()[:-3])
    assert nearest(path, 1000, ABOUT).frame == 29


def broken(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: path.unlink(), "has no checkpoints; replay"),
        (lambda path: path.write_bytes(b"x"), "not a file of checkpoints; replay"),
        (lambda path: broken(path, -1), "state after frame 39 is damaged; replay"),
        (lambda path: path.write_bytes(path.read_bytes().replace(b'"format":1', b'"format":9')), "of format 9"),
        (lambda path: path.write_bytes(path.read_bytes().replace(b'"abc"', b'"abd"')), "of another digest"),
    ],
)
def test_files_that_cannot_serve(tmp_path: Path, spoil: Any, words: str) -> None:
    path = written(tmp_path / "c")
    spoil(path)
    with pytest.raises(RecordingError, match=words) as error:
        nearest(path, 1000, ABOUT)
    assert "\n" not in str(error.value)
