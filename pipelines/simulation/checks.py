"""Checks of a simulator's parameters: a bad one is named, with what it should be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

_RULES: Mapping[str, Callable[[float], bool]] = {
    "a finite number": lambda value: True,
    "above 0": lambda value: value > 0,
    "0 or more": lambda value: value >= 0,
    "a share within 0 and 1": lambda value: 0 <= value <= 1,
    "a share within 0 and 0.5": lambda value: 0 <= value <= 0.5,
    "within ±1e9": lambda value: abs(value) <= 1e9,
    "a whole number above 0": lambda value: value > 0 and value == round(value),
    "an even number above 0": lambda value: value > 0 and value % 2 == 0,
}


def check(settings: object, rule: str, *names: str) -> None:
    """Hold the named fields of `settings`, numbers or tuples of numbers, against one of the rules.

    Raises:
        ValueError: a field breaks the rule or is not finite.
    """
    for name in names:
        value = getattr(settings, name)
        if not all(np.isfinite(x) and _RULES[rule](float(x)) for x in np.ravel(value)):
            raise ValueError(f"{type(settings).__name__}: {name} is {value!r}, it must be {rule}")


def check_word(settings: object, name: str, words: Sequence[str]) -> None:
    """Demand that a field of `settings` is one of some words.

    Raises:
        ValueError: it is not.
    """
    value = getattr(settings, name)
    if value not in words:
        raise ValueError(f"{type(settings).__name__}: {name} is {value!r}, it must be one of {', '.join(words)}")
