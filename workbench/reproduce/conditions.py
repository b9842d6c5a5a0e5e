"""What paper A's vehicle drives on, and how: surfaces, trajectories, speeds, and the disturbances of its camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np

from pipelines.geometry import Floats
from pipelines.simulation import trajectories as way
from pipelines.simulation.channels import rng_of
from pipelines.simulation.families import FAMILIES, ground
from pipelines.simulation.mission import PAPER_HEIGHT_M, nadir_mission
from pipelines.simulation.noise import correlated
from pipelines.simulation.surfaces import PAPER_METRES_PER_PX, Surface, surface_from_image
from readers.streams import Recording
from workbench.settings import SettingsError

FRAMES, RATE_HZ, NOISE_GREY = 2111, 60.0, 2.0
SPEED_MPS = 0.51
"""The paper's "2 km/h": one round of its figure eight, 18 m, in its 35.18 s."""
START_RAD = 0.5
"""Where on the eight the drive begins. The paper does not say it; the study's figures (16.1 cm for a scale of 5 %)
are those of a path whose points lie 3.3 m from its start in the rms, which is so half a radian from the crossing."""
SPEEDS_KMH = (2.0, 8.0, 15.0)
METRES_PER_PX = PAPER_METRES_PER_PX
"""W = 0.0782 cm/px."""
TAU_FRAMES = 100.0
"""Correlation time of height and tilt, which gives the study's error per frame at its 0.04 degrees."""


# ------------------------------------------------------------------------------ the ground


@cache
def surface_of(name: str, seed: int) -> Surface:
    """The surface of that name, or the one that is made of a picture.

    Args:
        name: one of `FAMILIES`, or the path of a picture.
        seed: of the surface, where it is one of ours.

    Raises:
        SettingsError: there is neither a surface nor a picture of that name.
    """
    if name in FAMILIES:
        return ground(name, seed=seed)
    picture = cv2.imread(name, cv2.IMREAD_COLOR) if Path(name).is_file() else None
    if picture is None:
        raise SettingsError(f"--surface {name}: neither a picture nor one of the surfaces {', '.join(FAMILIES)}")
    return surface_from_image(picture.astype(np.float64) @ [0.114, 0.587, 0.299])


# --------------------------------------------------------------------------------- the way


TRAJECTORIES: Mapping[str, Callable[[], way.Curve]] = {
    "line": partial(way.curve, "line", heading_rad=0.3),
    "circle": partial(way.curve, "circle"),
    "square": partial(way.curve, "square"),
    "figure-eight": partial(way.curve, "figure-eight"),
    "intersecting": partial(way.curve, "hypotrochoid"),
    "non-intersecting": partial(way.curve, "wander"),
}
"""Those of the paper, by its names."""


# --------------------------------------------------------------------------- disturbances


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """How the camera is carried: standard deviations of roll, pitch and height, and its place ahead."""

    name: str
    meaning: str
    tilt_rad: float = 0.0
    height_share: float = 0.0
    lever_m: float = 0.0


_TILT, _HEIGHT, _LEVER = math.radians(0.04), 0.01, 0.10
CONDITIONS = (
    Condition(name="C0", meaning="ideal"),
    Condition(name="C1", meaning="roll and pitch 0.04°", tilt_rad=_TILT),
    Condition(name="C2", meaning="height 1 %", height_share=_HEIGHT),
    Condition(name="C3", meaning="camera 10 cm ahead of the turning point", lever_m=_LEVER),
    Condition(name="C4", meaning="tilt, height and lever", tilt_rad=_TILT, height_share=_HEIGHT, lever_m=_LEVER),
)


def fluctuation(n: int, sigma: float, rng: np.random.Generator, tau_frames: float = TAU_FRAMES) -> Floats:
    """Tilt or height [n] of standard deviation `sigma`: `correlated` noise."""
    return sigma * correlated(n, tau_frames, rng)


# -------------------------------------------------------------------------------- missions


@dataclass(frozen=True, slots=True)
class Drive:
    """A simulated drive: the recording, the camera's true poses [n, 3] and the frames' times [n] in ns."""

    recording: Recording
    truth: Floats


def motion_of(truth: Floats) -> tuple[Floats, Floats]:
    """True shift of the image centre [n - 1, 2] in px, at the nominal height, and turn [n - 1] between frames."""
    return way.image_motion(truth, METRES_PER_PX)


def mission(
    surface: Surface,
    poses: Floats,
    *,
    height_m: float | Floats = PAPER_HEIGHT_M,
    roll_rad: float | Floats = 0.0,
    pitch_rad: float | Floats = 0.0,
    noise_grey: float = NOISE_GREY,
    seed: int = 0,
    name: str = "simulated",
) -> Recording:
    """The simulated recording of a downward camera on a way of poses [n, 3]."""
    return nadir_mission(
        surface,
        poses,
        height_m=height_m,
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        rate_hz=RATE_HZ,
        noise_grey=noise_grey,
        seed=seed,
        name=name,
    )


def experiment_drive(surface: str, condition: Condition, seed: int, frames: int) -> Drive:
    """Paper A's drive (3.2) under one condition; equal seeds have equal speeds, ground and image noise."""
    rng = partial(rng_of, seed, "paper-a")
    poses = way.drive(
        way.figure_eight(start_rad=START_RAD),
        frames,
        speed_mps=SPEED_MPS,
        rng=rng("speed"),
        rate_hz=RATE_HZ,
        lever_m=condition.lever_m,
    )
    recording = mission(
        surface_of(surface, seed),
        poses,
        height_m=PAPER_HEIGHT_M * (1 + fluctuation(frames, condition.height_share, rng("height"))),
        roll_rad=fluctuation(frames, condition.tilt_rad, rng("roll")),
        pitch_rad=fluctuation(frames, condition.tilt_rad, rng("pitch")),
        seed=seed,
        name=f"paper-a-{condition.name}-seed{seed}",
    )
    return Drive(recording, poses)


def short_drive(surface: str, trajectory: str, speed_kmh: float, seed: int, frames: int) -> Drive:
    """An undisturbed drive along any trajectory at any speed."""
    rng = rng_of(seed, "paper-a", surface, trajectory, f"{speed_kmh:g}")
    poses = way.drive(TRAJECTORIES[trajectory](), frames, speed_mps=speed_kmh / 3.6, rng=rng, rate_hz=RATE_HZ)
    recording = mission(surface_of(surface, seed), poses, seed=seed, name=f"{surface}-{trajectory}-{speed_kmh:g}")
    return Drive(recording, poses)
