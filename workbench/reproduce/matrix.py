"""Both presets over all surfaces, speeds and trajectories: failure rates and end errors of short drives."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from workbench.reproduce.conditions import NOISE_GREY, motion_of, short_drive
from workbench.reproduce.estimates import estimates, settings_of
from workbench.reproduce.experiment import BEST, PAPER
from workbench.reproduce.ledger import Ledger, Value
from workbench.reproduce.measures import accuracy
from workbench.reproduce.tasks import OnTick, Tick, carried_out
from workbench.settings import settings_values

FRAMES = 240
KEY = ("surface", "speed_kmh", "trajectory", "preset", "frames", "noise_grey", "seed", "settings")
FIELDS = ("path_m", "failures", "failed", "end_m", "end_path", "rms_m", "yaw_rad", "shift_px", "turn_rad")


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """One cell of the matrix: a drive that both presets see."""

    surface: str
    speed_kmh: float
    trajectory: str
    frames: int = FRAMES
    seed: int = 0
    overrides: tuple[str, ...] = ()

    def key(self, preset: str) -> dict[str, Value]:
        """What tells a row of the results."""
        settings = settings_of(preset, _ORIGIN, self.overrides if preset == PAPER else ())
        text = json.dumps(settings_values(settings), sort_keys=True)
        return {
            "surface": self.surface,
            "speed_kmh": self.speed_kmh,
            "trajectory": self.trajectory,
            "preset": preset,
            "frames": self.frames,
            "noise_grey": NOISE_GREY,
            "seed": self.seed,
            "settings": hashlib.sha256(text.encode()).hexdigest()[:12],
        }


_ORIGIN = settings_of.__defaults__ and None
