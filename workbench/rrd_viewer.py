"""The viewer, opened with its cursor at a frame."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

from readers.streams import WorkbenchError

WAIT_S = 60.0
POLL_S = 0.2


def show_at(files: Sequence[Path], frame: int, options: Sequence[str] = ()) -> int:
    """Open the viewer with some files, move its cursor to a frame, and wait until it is closed.

    Args:
        files: recordings of one mission.
        frame: number of the frame.
        options: more of the viewer's options.

    Returns:
        The viewer's exit status.

    Raises:
        WorkbenchError: the viewer did not become ready.
    """
    port = _free_port()
    command = [sys.executable, "-m", "rerun", *map(str, files), "--bind", "127.0.0.1", "--port", str(port), *options]
    viewer = subprocess.Popen(command)
    try:
        _move_cursor(viewer, port, frame)
        return viewer.wait()
    except BaseException:
        viewer.terminate()
        raise


def _free_port() -> int:
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        return int(door.getsockname()[1])


def _move_cursor(viewer: subprocess.Popen[bytes], port: int, frame: int) -> None:
    """Move the cursor as soon as the viewer has the recording."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rerun.experimental import ViewerClient

    until = time.monotonic() + WAIT_S
    while viewer.poll() is None and time.monotonic() < until:
        with contextlib.suppress(Exception):  # not there yet, or not loaded: whatever it says, it is asked again
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = client.get_state()
            if state.recordings and state.views and not state.loading:
                client.set_time("frame", sequence=frame, play_state="paused")
                return
        time.sleep(POLL_S)
    if viewer.poll() is None:
        raise WorkbenchError(f"the viewer was not ready within {WAIT_S:g} s: open the run with workbench view")
