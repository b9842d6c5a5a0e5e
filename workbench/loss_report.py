"""What was lost of a log, for people, for JSON and for the .rrd: by topic, and piece by piece."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from readers.message_log import Message
from readers.salvage import Loss, Tally, tallies
from readers.streams import Recording

HEADS = ("topic", "recovered", "lost", "withheld", "undecodable", "first good s", "last good s")


@dataclass(slots=True)
class Good:
    """The messages of a topic that could be read: how many, and the first and last log time, -1 without one."""

    count: int = 0
    first_ns: int = -1
    last_ns: int = -1

    def add(self, log_ns: int) -> None:
        """Count one message."""
        self.count += 1
        self.first_ns = log_ns if self.count == 1 else min(self.first_ns, log_ns)
        self.last_ns = log_ns if self.count == 1 else max(self.last_ns, log_ns)


class GoodMessages(dict[str, Good]):
    """By topic the messages that could be read."""

    @property
    def total(self) -> int:
        """How many messages there are of all topics."""
        return sum(good.count for good in self.values())

    def add(self, message: Message) -> None:
        """Count one message."""
        self.setdefault(message.channel.topic, Good()).add(message.log_ns)


def read_through(recording: Recording) -> GoodMessages:
    """Read all messages of a log, none of them decoded, and count them; nothing where it is no log of messages."""
    from readers.log_recording import LogRecording

    good = GoodMessages()
    if isinstance(recording, LogRecording):
        for channel in recording.channels:
            good.setdefault(channel.topic, Good())
        for message in recording.messages():
            good.add(message)
    return good


def values(good: Mapping[str, Good], losses: Iterable[Loss]) -> dict[str, Any]:
    """The report as plain values: by topic the counts and good times, and each loss with its place and times."""
    losses = tuple(losses)
    counted = tallies({topic: found.count for topic, found in good.items()}, losses)
    return {
        "topics": [_topic(name, tally, good.get(name, Good())) for name, tally in sorted(counted.items())],
        "losses": [_loss(loss) for loss in losses],
    }


def _topic(name: str, tally: Tally, good: Good) -> dict[str, Any]:
    return {
        "name": name,
        "recovered": tally.recovered,
        "lost": tally.lost,
        "withheld": tally.withheld,
        "undecodable": tally.undecodable,
        "first_good_ns": good.first_ns if good.count else None,
        "last_good_ns": good.last_ns if good.count else None,
    }


def _loss(loss: Loss) -> dict[str, Any]:
    return {
        "what": str(loss.what),
        "text": loss.text,
        "bytes": None if loss.start < 0 else [loss.start, loss.stop],
        "first_ns": None if loss.first_ns < 0 else loss.first_ns,
        "last_ns": None if loss.last_ns < 0 else loss.last_ns,
    }


def rows(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The topics of a report as the rows of a table, see `HEADS`; times count from the first good one."""
    times = [topic["first_good_ns"] for topic in report["topics"] if topic["first_good_ns"] is not None]
    origin_ns = min(times, default=0)

    def seconds(t_ns: int | None) -> str:
        return "" if t_ns is None else f"{(t_ns - origin_ns) / 1e9:.3f}"

    return [
        (
            topic["name"],
            *(str(topic[key]) for key in HEADS[1:5]),
            seconds(topic["first_good_ns"]),
            seconds(topic["last_good_ns"]),
        )
        for topic in report["topics"]
    ]


def sentences(losses: Iterable[Loss]) -> list[str]:
    """What was lost by topic, one sentence each; nothing where no topic is known to have lost a message."""
    found = []
    for topic, tally in sorted(tallies({}, losses).items()):
        counts = {"lost": tally.lost, "withheld as damaged": tally.withheld, "undecodable": tally.undecodable}
        told = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
        if told:
            found.append(f"{topic}: messages {told}")
    return found
