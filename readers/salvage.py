"""What of a file could not be read: one form of report for every reader.

A reader notes a `Loss` where it meets one. `tallies` adds them up by topic, so that every message that the file
is known to have held is recovered, or one of the lost.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from readers.streams import Damage


class Cause(enum.StrEnum):
    """Why something could not be read, or is not what the file says of itself."""

    CUT = "cut"
    CHECKSUM = "checksum"
    CODEC = "codec"
    SCHEMA = "schema"
    ORDER = "order"
    COUNT = "count"
    LIMIT = "limit"


@dataclass(frozen=True, slots=True)
class Tally:
    """Messages of one topic: read, lost (not in the file any more), withheld (damaged), undecodable."""

    recovered: int = 0
    lost: int = 0
    withheld: int = 0
    undecodable: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.recovered + other.recovered,
            self.lost + other.lost,
            self.withheld + other.withheld,
            self.undecodable + other.undecodable,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """One piece of damage.

    Attributes:
        what: the kind of damage.
        text: what happened, one clause without a full stop.
        start: first byte of it in the file, -1 where it has no place.
        stop: byte after its last one, equal to `start` where no bytes are lost.
        file_bytes: size of the file.
        first_ns: first log time that it concerns, -1 if unknown.
        last_ns: last log time that it concerns, -1 if unknown.
        topics: messages known to be concerned, by topic; empty if it cannot be told.
    """

    what: Cause
    text: str
    start: int = -1
    stop: int = -1
    file_bytes: int = 0
    first_ns: int = -1
    last_ns: int = -1
    topics: Mapping[str, Tally] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def damage(self) -> Damage:
        """The loss as a `Recording` lists it."""
        if self.start < 0:
            return Damage(what=self.text, where="the whole file")
        where = f"byte {self.start} of {self.file_bytes}"
        return Damage(what=self.text, where=where, affected=(self.stop - self.start) / max(1, self.file_bytes))


def lost_by_topic(counts: Iterable[tuple[str, int]]) -> dict[str, Tally]:
    """Messages that are not there any more, by topic, of (topic, count); channels can share a topic."""
    return _by_topic((topic, Tally(lost=count)) for topic, count in counts)


def withheld_by_topic(counts: Iterable[tuple[str, int]]) -> dict[str, Tally]:
    """Messages that are damaged, likewise."""
    return _by_topic((topic, Tally(withheld=count)) for topic, count in counts)


def _by_topic(pairs: Iterable[tuple[str, Tally]]) -> dict[str, Tally]:
    found: dict[str, Tally] = {}
    for topic, tally in pairs:
        found[topic] = found.get(topic, Tally()) + tally
    return found


def tallies(recovered: Mapping[str, int], losses: Iterable[Loss]) -> dict[str, Tally]:
    """By topic: the messages that were read, and those that the losses are known to have cost."""
    total = {topic: Tally(recovered=count) for topic, count in recovered.items()}
    for loss in losses:
        for topic, tally in loss.topics.items():
            total[topic] = total.get(topic, Tally()) + tally
    return total
