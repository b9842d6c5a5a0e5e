"""What a log may hold beside its messages: attached files, and metadata."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import NamedTuple


class ExtraKind(enum.StrEnum):
    """What is stored beside messages."""

    ATTACHMENT = "attachment"
    METADATA = "metadata"


class Attachment(NamedTuple):
    """A file inside of a log; its times in ns, its bytes a view of the log."""

    name: str
    media_type: str
    log_ns: int
    create_ns: int
    data: memoryview


class Metadata(NamedTuple):
    """Texts by name, under a name."""

    name: str
    values: dict[str, str]


class LostExtra(NamedTuple):
    """An attachment or metadata record that cannot be read, and why (a clause).

    Those of which nothing but their number is known are one, without a name; the reason tells how many they are.
    """

    kind: ExtraKind
    name: str
    reason: str


@dataclass(slots=True)
class Extras:
    """What a log holds beside its messages, in the order of the file."""

    attachments: list[Attachment] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    lost: list[LostExtra] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.attachments or self.metadata or self.lost)

    def add(self, other: Extras) -> None:
        """Take those of another part of the same log."""
        self.attachments += other.attachments
        self.metadata += other.metadata
        self.lost += other.lost
