"""What all pictures of the reports have in common: PNG and SVG, the same bytes for the same numbers.

Colours are those of Okabe and Ito, which colour-blind people can tell apart; every curve has a sign of its own too.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 110
BLACK, ORANGE, BLUE, GREEN, RED = "#000000", "#E69F00", "#0072B2", "#009E73", "#D55E00"


def save(file: Path, draw: Callable[[], Figure]) -> Path:
    """Draw a picture into FILE.png and FILE.svg; returns the PNG."""
    import matplotlib as mpl

    style: Any = {"svg.hashsalt": "workbench", "font.size": 9.0, "axes.grid": True, "grid.alpha": 0.3}
    with mpl.rc_context(style):
        figure = draw()
        figure.savefig(file.with_suffix(".png"), dpi=DOTS_PER_INCH, metadata={"Software": None})
        figure.savefig(file.with_suffix(".svg"), metadata={"Date": None, "Creator": None})
    return file.with_suffix(".png")


def figure_of(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    """A figure of that size in inches, and its axes [rows, columns]; no window is opened."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)
