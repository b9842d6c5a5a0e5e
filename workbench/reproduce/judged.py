"""Verdicts on a paper's claims: what became of each, and the numbers that say so."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Upshot(StrEnum):
    """What became of a claim."""

    REACHED = "reached"
    IN_SCATTER = "within its scatter"
    """The median over the seeds misses the bar, the best seed reaches it."""
    MISSED = "missed"


@dataclass(frozen=True, slots=True)
class Statement:
    """A claim, what became of it, and the numbers that say so."""

    claim: str
    upshot: Upshot
    numbers: str


def worst(upshots: Iterable[Upshot]) -> Upshot:
    """The worst of some, of none the best."""
    order = list(Upshot)
    return max(upshots, key=order.index, default=Upshot.REACHED)
