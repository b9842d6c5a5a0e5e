"""Messages of CDR and ROS 1 that are numbers behind texts, many at a time → samples.

As long as its texts have the same length, the messages of a channel have one length and are the rows of one array.
Rows of which there is something to note or to mend are left to the reading of single messages, `readers.fixed_layout`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from itertools import repeat
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from readers import ros1_wire
from readers.clock import DAY_NS
from readers.decoding import ros_name
from readers.fixed_layout import imu_numbers_at, odometry_numbers_at
from readers.message_log import Buffer, Message
from readers.messages import NORM_TOLERANCE
from readers.streams import UNKNOWN_QUAT, FloatArray, ImuSample, OdometrySample, Sample

AnySample = TypeVar("AnySample", bound=Sample)
Columns = dict[str, Iterable[FloatArray]]
_SECOND_NS = np.int64(1_000_000_000)


class _Rows(NamedTuple):
    """Messages of one layout: times [N] in ns, numbers [N, n], and which of them need no care."""

    kind: _Kind
    received_ns: NDArray[np.int64]
    header_ns: NDArray[np.int64]
    numbers: FloatArray
    plain: NDArray[np.bool_]


def _rows_of(messages: Sequence[Message]) -> _Rows | None:
    """The numbers of messages of one channel that has a fixed layout; None if they are not rows of one layout."""
    channel, first = messages[0].channel, messages[0].data
    kind = _KINDS.get((channel.encoding, ros_name(channel.type).replace("/msg/", "/")))
    if kind is None or (at := kind.numbers_at(first)) is None:
        return None
    data = [message.data for message in messages]
    if set(map(len, data)) != {len(first)}:
        return None
    table = np.frombuffer(b"".join(data), _row_type(len(first), at))
    if np.any(table["texts"] != table["texts"][0]):
        return None
    if channel.encoding == "cdr" and np.any(table["mark"] != table["mark"][0]):  # ROS 1 has a number there
        return None
    try:
        received_ns = np.array([message.log_ns for message in messages], np.int64)
    except OverflowError:
        return None
    header_ns = table["seconds"] * _SECOND_NS + table["nanoseconds"]
    numbers = np.frombuffer(table["numbers"].tobytes(), "<f8").reshape(len(data), -1)  # aligned, and read-only
    plain = kind.plain(numbers) & (header_ns > 0) & (np.abs(header_ns - received_ns) < DAY_NS)
    return _Rows(kind, received_ns, header_ns, numbers, plain)


def read_rows(messages: Sequence[Message], stream: str, offset_ns: int) -> Sequence[Sample | None]:
    """The samples of messages of one channel that has a fixed layout, at their header stamps plus `offset_ns`.

    None for a message that is to be read by itself; nothing at all if they are not rows of one layout.
    """
    if (rows := _rows_of(messages)) is None:
        return ()
    stamps = rows.header_ns.tolist()
    samples: list[Any] = _made(
        rows.kind.sample,
        len(messages),
        stream=repeat(stream),
        t_ns=stamps if not offset_ns else (rows.header_ns + offset_ns).tolist(),
        received_ns=[message.log_ns for message in messages],
        oddities=repeat(()),
        header_ns=stamps,
        published_ns=[message.publish_ns for message in messages],
        **rows.kind.columns(rows.numbers),
    )
    if not rows.plain.all():
        for place in np.flatnonzero(~rows.plain):
            samples[place] = None
    return samples


def fill_rows(messages: Sequence[Message], offset_ns: int, out: NDArray[np.void]) -> NDArray[np.bool_]:
    """Write what `read_rows` makes of the messages into rows of `readers.sample_arrays`.

    Returns:
        Which rows of `out` were written; the messages of the others are to be read by themselves.
    """
    none = np.zeros(len(messages), bool)
    if (rows := _rows_of(messages)) is None:
        return none
    try:
        out["published_ns"] = [message.publish_ns for message in messages]
    except OverflowError:
        return none
    out["t_ns"], out["header_ns"], out["received_ns"] = rows.header_ns + offset_ns, rows.header_ns, rows.received_ns
    for name, values in rows.kind.columns(rows.numbers).items():
        out[name] = values
    out["readable"] = True
    return rows.plain


@lru_cache(maxsize=64)
def _row_type(size: int, at: int) -> np.dtype[np.void]:
    """A message of `size` bytes whose numbers begin at `at`."""
    fields = {
        "mark": ("V4", 0),
        "seconds": ("<i4", 4),
        "nanoseconds": ("<u4", 8),
        "texts": (f"V{at - 12}", 12),
        "numbers": (("<f8", ((size - at) // 8,)), at),
    }
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": size})


def _made(kind: type[AnySample], count: int, **columns: Iterable[Any]) -> list[AnySample]:
    """Samples from one column for each of their fields, which is several times as quick as one by one."""
    assert columns.keys() == kind.__dataclass_fields__.keys()
    samples = list(map(kind.__new__, repeat(kind, count)))
    for name, values in columns.items():
        deque(map(getattr(kind, name).__set__, samples, values), maxlen=0)
    return samples


# ---------------------------------------------------------------------------------- messages


def _is_unit(quat: FloatArray) -> NDArray[np.bool_]:
    """Which of the quaternions [N, 4] are certainly of unit norm, within the tolerance."""
    with np.errstate(all="ignore"):
        squares = np.einsum("ij,ij->i", quat, quat)
        unit: NDArray[np.bool_] = np.abs(squares - 1.0) < NORM_TOLERANCE  # half the tolerance of the norm
    return unit


def _plain_imu(n: FloatArray) -> NDArray[np.bool_]:
    measured = (n[:, 16] != -1.0) & (n[:, 28] != -1.0)
    oriented = _is_unit(n[:, :4]) & (n[:, 3] != 1.0)  # one that is exactly the identity may mean nothing
    plain: NDArray[np.bool_] = measured & ((n[:, 4] == -1.0) | oriented)
    return plain


def _imu_columns(n: FloatArray) -> Columns:
    quat: Iterable[FloatArray] = n[:, :4]
    unknown = n[:, 4] == -1.0
    if unknown.any():
        quat = [UNKNOWN_QUAT if none else own for none, own in zip(unknown, n[:, :4], strict=True)]
    return {"angular_velocity_radps": n[:, 13:16], "linear_acceleration_mps2": n[:, 25:28], "quat_xyzw": quat}


def _plain_odometry(n: FloatArray) -> NDArray[np.bool_]:
    return _is_unit(n[:, 3:7])


def _odometry_columns(n: FloatArray) -> Columns:
    return {
        "linear_velocity_mps": n[:, 43:46],
        "angular_velocity_radps": n[:, 46:49],
        "position_m": n[:, :3],
        "quat_xyzw": n[:, 3:7],
    }


class _Kind(NamedTuple):
    """A type of message: where its numbers lie, which rows [N, n] need no care, and the fields of its samples."""

    sample: type[Sample]
    numbers_at: Callable[[Buffer], int | None]
    plain: Callable[[FloatArray], NDArray[np.bool_]]
    columns: Callable[[FloatArray], Columns]


_IMU = _Kind(ImuSample, imu_numbers_at, _plain_imu, _imu_columns)
_ODOMETRY = _Kind(OdometrySample, odometry_numbers_at, _plain_odometry, _odometry_columns)
_KINDS = {
    ("cdr", "sensor_msgs/Imu"): _IMU,
    ("cdr", "nav_msgs/Odometry"): _ODOMETRY,
    ("ros1", "sensor_msgs/Imu"): _IMU._replace(numbers_at=ros1_wire.imu_numbers_at),
    ("ros1", "nav_msgs/Odometry"): _ODOMETRY._replace(numbers_at=ros1_wire.odometry_numbers_at),
}
