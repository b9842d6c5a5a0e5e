"""What a paper's experiment is asked for and gives back, whichever paper it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from workbench.settings import SettingsError

R = TypeVar("R")

OnProgress = Callable[[str, int, int], None]
"""Told what is being done, how many steps of it are done, and how many there are."""


@dataclass(frozen=True, slots=True)
class Reproduced(Generic[R]):
    """What came of it: the folder, the report, the results, and whether it was interrupted."""

    folder: Path
    file: Path
    results: R
    interrupted: bool


def at_least(option: str, value: int, least: int) -> None:
    """Demand that a number is large enough.

    Raises:
        SettingsError: it is not.
    """
    if value < least:
        raise SettingsError(f"--{option} {value}: must be {least} or more")
