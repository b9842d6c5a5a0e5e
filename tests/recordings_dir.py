"""Where the shared recordings are: beside the checkout, or where WORKBENCH_RECORDINGS says."""

import os
from pathlib import Path

RECORDINGS = Path(os.environ.get("WORKBENCH_RECORDINGS", Path(__file__).parents[1].parent / "shared" / "recordings"))
