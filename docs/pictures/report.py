"""Take `report.png`: the top of a run's report in a headless Chromium.

workbench demo && python docs/pictures/report.py results/demo/paper-a.rrd
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from workbench import report
from workbench.runs import open_run

TARGET = Path(__file__).with_name("report.png")
WIDTH_PX, HEIGHT_PX = 1000, 1700
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main(run: str) -> None:
    """Make the report of a run and take its picture."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise SystemExit(f"there is none of {', '.join(BROWSERS)}: install Chromium")
    with tempfile.TemporaryDirectory() as folder:
        page = report.write(report.page_of(report.facts_of(open_run(run), run)), Path(folder) / "report.html")
        command = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder}/b",
            f"--window-size={WIDTH_PX},{HEIGHT_PX}", f"--screenshot={TARGET}", page.as_uri(),
        ]  # fmt: skip
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    main(sys.argv[1])
