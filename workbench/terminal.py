"""What the commands share: texts made safe for a terminal, tables, JSON, bars of progress, exit statuses."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from workbench.progress import Progress

REFUSED, IN_PART, NOT_MET, INTERRUPTED, FAULT = 2, 3, 4, 130, 1
EPOCH_NS = 100_000_000_000_000_000
WIDEST = 60
BAR_SECONDS = 0.1
LINE_SECONDS = 5.0
PATIENCE_SECONDS = 2.0

FIRST_START = "the first start compiles what it needs, which takes up to a minute; later ones do not"


def examples(*lines: str) -> str:
    """Examples below a command's help, line by line as they stand."""
    return "\n  ".join(("\b\nExamples:", *lines))


def shown(text: str, widest: int | None = 400) -> str:
    """A text from a file, safe for a terminal: control characters escaped, at most `widest` characters."""
    safe = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return safe if widest is None or len(safe) <= widest else f"{safe[: widest - 1]}…"


def moment(t_ns: int) -> str:
    """A time as a date (UTC) where it can be one, else in seconds."""
    if t_ns < EPOCH_NS:
        return f"{t_ns / 1e9:.3f} s"
    seconds, rest = divmod(t_ns, 1_000_000_000)
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(seconds)) + f".{rest // 1_000_000:03d} UTC"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> list[str]:
    """Lines of a table with columns as wide as their longest entry; the last one is not padded."""
    cells = [tuple(heads), *(tuple(shown(cell, WIDEST) for cell in row) for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(heads))]
    return [
        "  ".join(
            c.rjust(w) if k in right else c.ljust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]


def print_list(title: str, texts: Sequence[str]) -> None:
    """Print a title and some texts below it, nothing where there are none."""
    if texts:
        print(f"\n{title}:")
        for text in texts:
            print(f"  {shown(text)}")


def print_json(values: Mapping[str, Any]) -> None:
    """Print one JSON object; numbers that are not finite are null."""
    from workbench.summary import without_nan

    print(json.dumps(without_nan(values), indent=2, ensure_ascii=True, allow_nan=False))


class Bar:
    """Progress on stderr: a bar with the time left on a terminal, else a line every few seconds."""

    def __init__(self, title: str, unit: str = "frame") -> None:
        self._title, self._unit = title, unit
        self._live: Any = None
        self._task: Any = None
        self._told = time.monotonic()
        self._began = self._told
        self._patience = threading.Timer(PATIENCE_SECONDS, self._console, [f"no {unit} yet: " + FIRST_START])
        self._patience.daemon = True

    def __enter__(self) -> Self:
        self._patience.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._patience.cancel()
        if self._live is not None:
            self._live.stop()

    def __call__(self, progress: Progress) -> None:
        """Take note of a frame; show it if the last time is long enough ago."""
        self._patience.cancel()
        now = time.monotonic()
        terminal = sys.stderr.isatty()
        if now - self._told < (BAR_SECONDS if terminal else LINE_SECONDS) and progress.done != progress.total:
            return
        self._told = now
        if terminal:
            self._draw(progress)
        else:
            of = "" if progress.total is None else f" of {progress.total}"
            speed = progress.done / max(now - self._began, 1e-9)
            self._console(f"{self._unit} {progress.done}{of}, {speed:.0f} {self._unit}s/s")

    def _console(self, text: str) -> None:
        print(f"{self._title}: {text}", file=sys.stderr, flush=True)

    def _draw(self, progress: Progress) -> None:
        if self._live is None:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Live

            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._live = Live(*columns, console=Console(stderr=True))
            self._live.start()
            self._task = self._live.add_task(self._title, total=progress.total)
        self._live.update(self._task, completed=progress.done)


class Bars:
    """Progress of several things, one bar after the other."""

    def __init__(self) -> None:
        self._title = ""
        self._bar: Bar | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)

    def __call__(self, title: str, done: int, total: int) -> None:
        """Show how far the thing of that title is."""
        from workbench.progress import Progress

        if self._bar is None or title != self._title:
            self.__exit__(None, None, None)
            self._title, self._bar = title, Bar(title)
        self._bar(Progress(done, total, 0))


def print_error(text: str) -> None:
    """Print one line about what went wrong, on stderr."""
    print(f"error: {shown(text, None)}", file=sys.stderr, flush=True)


def has_display() -> bool:
    """Whether there is a screen to open a window on."""
    if sys.platform != "linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
