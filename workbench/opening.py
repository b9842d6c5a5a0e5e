"""The one way to open whatever a user names: a recording of any format, or a scenario that is simulated.

Apart from the session, so that commands that only look into a recording start without the estimators.
"""

from __future__ import annotations

from pathlib import Path

from readers.streams import ReadOptions, Recording


def open_any(path: Path, options: ReadOptions) -> Recording:
    """Open a recording of any format that a reader knows, or the mission of a scenario.

    Raises:
        RecordingError: no reader can use it.
        SettingsError: it is a scenario that cannot be.
    """
    from readers import open_recording
    from workbench.scenarios import is_scenario, open_scenario

    if is_scenario(path):
        from readers.adjusted import adjusted

        return adjusted(open_scenario(path), options)
    return open_recording(path, options)
