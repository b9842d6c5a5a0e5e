"""What every stream of a simulated mission is: when its messages come, and what is in them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from readers.streams import Sample, StreamKind

Longs = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """One stream: `m` messages that carry measurements by number, some of them perhaps twice or never.

    Attributes:
        stream: its name.
        kind: what its samples are.
        type: ROS type of its messages.
        frame: coordinate frame of its messages.
        number: which measurement each message carries [m].
        stamp_ns: the sensor's own time of each message [m].
        received_ns: the log's time of each message [m], rising.
        sample: the sample of (measurement, stamp, time received); pure, so that any can be made by itself.
    """

    stream: str
    kind: StreamKind
    type: str
    frame: str
    number: Longs
    stamp_ns: Longs
    received_ns: Longs
    sample: Callable[[int, int, int], Sample]


def rng_of(seed: int, *names: str) -> np.random.Generator:
    """The random numbers of one thing in a mission: unrelated for any two seeds or names."""
    return np.random.default_rng((seed, *(zlib.crc32(name.encode()) for name in names)))
