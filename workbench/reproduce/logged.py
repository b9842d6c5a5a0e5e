"""Runs that are logged for the viewer as a user's are, while the experiment takes note of their steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pipelines.estimator import Step
from readers.streams import Recording
from workbench import session
from workbench.reproduce.tasks import Tick


def logged(
    request: session.Request,
    take: Callable[[Step], None],
    *,
    recording: Recording | None = None,
    tick: Tick = lambda: None,
) -> None:
    """Replay through the session, which writes the log; `take` gets every step.

    Args:
        request: what is asked of the session.
        take: called with every step.
        recording: the recording, where `request.path` cannot be opened.
        tick: called after every frame.

    Raises:
        KeyboardInterrupt: it was stopped; the log goes as far as it came.
    """
    usual = session.rerun_writers()
    writers = usual._replace(run=lambda *args, **options: _Noted(usual.run(*args, **options), take))
    outcome = session.run(request, recording=recording, on_progress=lambda _: tick(), writers=writers)
    if outcome.summary["interrupted"]:
        raise KeyboardInterrupt


class _Noted:
    """A log of a run, of whose steps notes are taken."""

    def __init__(self, log: session.RunLog, take: Callable[[Step], None]) -> None:
        self._log, self._take = log, take
        self.event, self.errors, self.finish, self.close = log.event, log.errors, log.finish, log.close
        self.smoothed = log.smoothed

    def step(self, step: Step, beside: Any = None) -> None:
        """Note and log a step."""
        self._take(step)
        self._log.step(step, beside)
