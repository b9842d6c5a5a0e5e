"""Options that several commands have, with the same words."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EstimatorName = Annotated[str, typer.Option("--estimator", "-e", help="Name of the estimator.")]
PresetName = Annotated[str | None, typer.Option(help="Preset of its settings, such as best or paper-a.")]
SettingsFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Settings over the preset: TOML, JSON, or a RUN.toml.")
]
StartTime = Annotated[
    str | None, typer.Option("--from", metavar="T", help="Begin: seconds after the first frame, ns, or ISO 8601.")
]
StopTime = Annotated[str | None, typer.Option("--to", metavar="T", help="End (excluded), likewise.")]
Stride = Annotated[int, typer.Option(help="Use every n-th frame.")]
