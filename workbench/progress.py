"""How far long work is, as it is told to whoever shows it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a replay is: frames done, frames in all (None if unknown), sensor time of the last one."""

    done: int
    total: int | None
    t_ns: int
