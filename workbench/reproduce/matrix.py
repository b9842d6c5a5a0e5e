"""Both presets over all surfaces, speeds and trajectories: failure rates and end errors of short drives."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workbench.reproduce.conditions import NOISE_GREY, SPEEDS_KMH, TRAJECTORIES, motion_of, short_drive
from workbench.reproduce.estimates import estimates, settings_of
from workbench.reproduce.experiment import BEST, PAPER
from workbench.reproduce.ledger import Ledger, Value
from workbench.reproduce.measures import accuracy
from workbench.reproduce.tasks import Tick
from workbench.settings import settings_values

FRAMES = 240
PRESETS = (PAPER, BEST)
KEY = ("surface", "speed_kmh", "trajectory", "preset", "frames", "noise_grey", "seed", "settings")
FIELDS = ("path_m", "failures", "failed", "end_m", "end_path", "rms_m", "yaw_rad", "shift_px", "turn_rad")


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """One cell of the matrix: a drive that both presets see; `overrides` are settings over those of paper-a."""

    surface: str
    speed_kmh: float
    trajectory: str
    frames: int = FRAMES
    seed: int = 0
    overrides: tuple[str, ...] = ()

    def key(self, preset: str) -> dict[str, Value]:
        """What tells a row of the results."""
        settings = settings_of(preset, np.zeros(3), self._overrides(preset))
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

    @property
    def keys(self) -> list[dict[str, Value]]:
        """What tells its rows: one for each preset."""
        return [self.key(preset) for preset in PRESETS]

    @property
    def steps(self) -> int:
        """One for every frame."""
        return self.frames

    def _overrides(self, preset: str) -> tuple[str, ...]:
        return self.overrides if preset == PAPER else ()

    def rows(self, tick: Tick) -> list[dict[str, Value]]:
        """Drive there and judge both presets."""
        drive = short_drive(self.surface, self.trajectory, self.speed_kmh, self.seed, self.frames)
        settings = {preset: settings_of(preset, drive.truth[0], self._overrides(preset)) for preset in PRESETS}
        shift, turn = motion_of(drive.truth)
        path_m = float(np.hypot(*np.diff(drive.truth[:, :2], axis=0).T).sum())
        rows = []
        for preset, seen in estimates(drive.recording, settings, tick).items():
            found = accuracy(seen.pose, drive.truth, seen.shift_px - shift, seen.turn_rad - turn)
            values: dict[str, Value] = {**dataclasses.asdict(found), "failed": found.failed, "path_m": path_m}
            rows.append(self.key(preset) | {name: values[name] for name in FIELDS})
        return rows


def places(
    surfaces: Sequence[str],
    *,
    speeds_kmh: Sequence[float] = SPEEDS_KMH,
    trajectories: Sequence[str] = tuple(TRAJECTORIES),
    frames: int = FRAMES,
    seed: int = 0,
    overrides: tuple[str, ...] = (),
) -> list[Place]:
    """All cells."""
    return [
        Place(surface=a, speed_kmh=b, trajectory=c, frames=frames, seed=seed, overrides=overrides)
        for a in surfaces
        for b in speeds_kmh
        for c in trajectories
    ]


def ledger(folder: Path) -> Ledger:
    """The results in that folder."""
    return Ledger(folder / "matrix.csv", KEY, FIELDS)


def rows_of(wanted: Sequence[Place], results: Ledger) -> list[Mapping[str, str]]:
    """The rows of the cells that are done."""
    return [results.row(key) for place in wanted for key in place.keys if key in results]
