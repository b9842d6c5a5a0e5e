"""Take `viewer.png` and `failure.png`, or `range.png`: results in the viewer, without its title bar.

    workbench demo && python docs/pictures/viewer.py results/demo
    workbench replay sim:paper-b -e range --set tracks.sigma_px=0.1 --set sigma_speed=0.002 -o results/ranges
    python docs/pictures/viewer.py results/ranges --of range

It needs a graphics driver, of software will do (Debian: mesa-vulkan-drivers).
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
from rerun.experimental import ViewerClient

FOLDER = Path(__file__).parent
WIDTH_PX, HEIGHT_PX, TITLE_PX = 1600, 1000, 36
PATIENCE_S, SETTLE_S = 120.0, 2.0
SHOTS = {
    "demo": (("viewer.png", "best", 205, None), ("failure.png", "paper-a", 198, "Errors")),
    "range": (("range.png", "best", 24, None),),
    "semidirect": (("semidirect.png", "fast", 270, None),),
    "semidirect-lost": (("semidirect-lost.png", "one", 80, None),),
}
"""By what the results are of: file, run, frame, and the tab to bring to the front."""


def shoot(files: list[Path], frame: int, tab: str | None, target: Path) -> None:
    """A picture of the viewer with these recordings at a frame."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    viewer = _started(files, port)
    try:
        client = _ready(viewer, port)
        client.set_time("frame", sequence=frame, play_state="paused")
        if tab:
            _bring_to_front(client, tab)
        time.sleep(SETTLE_S)
        client.save_screenshot(str(target))
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait(10)
    picture = cv2.imread(str(target))[TITLE_PX:]
    cv2.imwrite(str(target), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _started(files: list[Path], port: int) -> subprocess.Popen[bytes]:
    size = f"{WIDTH_PX}x{HEIGHT_PX + TITLE_PX}"
    options = ["--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", size]
    return subprocess.Popen(
        [sys.executable, "-m", "rerun", *options, "--hide-welcome-screen", *map(str, files)],
        env=os.environ | {"WGPU_BACKEND": "vulkan"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _ready(viewer: subprocess.Popen[bytes], port: int) -> ViewerClient:
    """A connection to the viewer when it has loaded everything."""
    deadline, client = time.monotonic() + PATIENCE_S, None
    while viewer.poll() is None and time.monotonic() < deadline:
        time.sleep(0.25)
        try:
            client = client or ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = client.get_state()
        except (OSError, RuntimeError, TimeoutError):
            continue
        if state.recordings and state.views and not state.loading:
            return client
    sys.exit("the viewer did not become ready: is there a graphics driver?")


def _bring_to_front(client: ViewerClient, tab: str) -> None:
    blueprint = client.get_blueprint().blueprint
    containers = {
        path: parts["ContainerBlueprint"] for path, parts in blueprint.items() if "ContainerBlueprint" in parts
    }
    (wanted,) = (path for path, parts in containers.items() if parts.get("display_name") == tab)
    for parts in containers.values():
        if wanted in parts["contents"]:
            parts["active_tab"] = wanted
    client.set_blueprint(blueprint, of="recording")


def main() -> None:
    """Take the pictures of one folder of results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of the results")
    parser.add_argument("--of", choices=SHOTS, default="demo", help="what they are the results of")
    arguments = parser.parse_args()
    results = arguments.results.resolve()
    for file, run, frame, tab in SHOTS[arguments.of]:
        shoot([results / "sensors.rrd", results / f"{run}.rrd"], frame, tab, FOLDER / file)


if __name__ == "__main__":
    main()
