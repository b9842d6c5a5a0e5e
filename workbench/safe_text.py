"""Texts of unknown origin, made safe to show: topics, frames, file names and messages of logs."""

from __future__ import annotations


def printable(text: str) -> str:
    """A text without control characters, half surrogates and marks that turn the reading direction: their codes."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
