"""Draw `trajectories.png` and `views.png`: same script, same libraries, same pictures.

python docs/pictures/make.py
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipelines.simulation.curves import CURVES, Curve, curve
from workbench import scenarios

FOLDER = Path(__file__).parent
STYLE = {"font.size": 9, "axes.titlesize": 9, "savefig.dpi": 110, "svg.hashsalt": "0"}

SHOWN: Mapping[str, tuple[dict[str, Any], float]] = {
    "line": ({}, 6.0),
    "circle": ({}, 7.5),
    "square": ({}, 7.4),
    "figure-eight": ({}, 19.0),
    "spiral": ({}, 32.0),
    "serpentine": ({}, 8.0),
    "wander": ({}, 14.0),
    "hypotrochoid": ({}, 21.0),
    "spline": ({"points": [[0, 0], [1.2, 1.0], [2.6, -0.4], [3.4, 1.2], [5.0, 0.5]]}, 7.0),
    "polyline": ({"points": [[0, 0], [2.0, 0], [2.6, 1.6], [4.2, 1.6], [5.0, 0.2]]}, 7.4),
    "lanes": ({"length_m": 4.0, "spacing_m": 0.7, "count": 5}, 24.4),
}
"""Parameters of each curve, and how much of it is driven at the most, m."""


# ------------------------------------------------------------------------------ trajectories


def trajectories() -> Figure:
    """All curves by name, coloured by the way driven."""
    figure, axes = plt.subplots(3, 4, figsize=(11, 7.4), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    panels = iter(axes.flat)
    for name in CURVES:
        parameters, length_m = SHOWN[name]
        _trajectory(next(panels), name, curve(name, **parameters), length_m)
    legend = next(panels)
    legend.axis("off")
    inset = legend.inset_axes((0.1, 0.62, 0.8, 0.08))
    bar = figure.colorbar(plt.cm.ScalarMappable(cmap="viridis"), cax=inset, orientation="horizontal", ticks=[0, 1])
    bar.ax.set_xticklabels(["start", "end"])
    legend.text(0.5, 0.15, "dot: start\ngrid: 1 m\nx to the right, y up", ha="center", transform=legend.transAxes)
    return figure


def _trajectory(axes: Axes, name: str, way: Curve, length_m: float) -> None:
    length_m = min(length_m, way.length_m)
    x, y = way.along(0.0, length_m)(np.linspace(0, length_m, 1200)).point_m
    points = np.stack([x, y], axis=-1)
    pieces = LineCollection(
        np.stack([points[:-1], points[1:]], axis=1).tolist(), cmap="viridis", lw=2.2, capstyle="round"
    )
    pieces.set_array(np.linspace(0, 1, len(points) - 1))
    axes.add_collection(pieces)
    axes.plot(x[0], y[0], "o", color="#1a9850", ms=7, zorder=3)
    middle_x, middle_y = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
    reach = 0.56 * max(np.ptp(x), np.ptp(y) / 0.8)
    axes.set(xlim=(middle_x - reach, middle_x + reach), ylim=(middle_y - 0.8 * reach, middle_y + 0.8 * reach))
    axes.set_aspect("equal")
    axes.xaxis.set_major_locator(plt.MultipleLocator(1))
    axes.yaxis.set_major_locator(plt.MultipleLocator(1))
    axes.tick_params(length=0, labelbottom=False, labelleft=False)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("0.85")
    endless = np.isinf(way.length_m)
    axes.set_title(f"{name}  ({'endless' if endless else 'closed' if way.closed else 'open'})", family="monospace")


# ------------------------------------------------------------------------------------ views

NADIR = ("ground.family=street", "ground.size_px=1024", "camera.noise_grey=1", "frames=150")
VIEWS: Mapping[str, tuple[str, int, tuple[str, ...]]] = {
    "nadir, 2 km/h\n": ("line", 120, NADIR),
    "motion blur, 8 km/h\nexposure_s = 0.015": (
        "line",
        120,
        (*NADIR, "camera.exposure_s=0.015", "trajectory.speed_kmh=8"),
    ),
    "rolling shutter, 8 km/h in a sharp turn\nreadout_s = 0.016": (
        "line",
        120,
        (
            *NADIR,
            "camera.readout_s=0.016",
            "trajectory.speed_kmh=8",
            'faults=[{kind="turn-jump", start_s=1.99, stop_s=2.3, turn_rad=0.5, ramp_s=0.02}]',
        ),
    ),
    "relief of 4 mm\nrelief_height_m, relief_correlation_m": (
        "line",
        120,
        (*NADIR, "ground.relief_height_m=0.004", "ground.relief_correlation_m=0.06"),
    ),
    "tilted 20°, barrel distortion\npitch_rad, distortion": (
        "line",
        120,
        (*NADIR, "camera.pitch_rad=-0.35", "camera.distortion=[-0.2, 0.05]"),
    ),
    "front camera of paper-b\nchessboard and posters": ("paper-b", 46, ()),
}


def views() -> Figure:
    """What the cameras see, with and without what disturbs them."""
    figure, axes = plt.subplots(2, 3, figsize=(11, 8.0), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    for panel, (caption, (name, frame, overrides)) in zip(axes.flat, VIEWS.items(), strict=True):
        panel.imshow(_frame(name, frame, overrides), cmap="gray", vmin=0, vmax=255)
        panel.set_title(caption)
        panel.set_axis_off()
    return figure


def _frame(name: str, number: int, overrides: tuple[str, ...]) -> NDArray[np.uint8]:
    return scenarios.mission(scenarios.load(name, overrides=overrides)).frame(number)


PICTURES: Mapping[str, Callable[[], Figure]] = {"trajectories.png": trajectories, "views.png": views}


def main() -> None:
    """Draw all pictures beside this script."""
    plt.switch_backend("agg")
    with plt.rc_context(STYLE):
        for file, draw in PICTURES.items():
            draw().savefig(FOLDER / file, metadata={"Software": None})


if __name__ == "__main__":
    main()
