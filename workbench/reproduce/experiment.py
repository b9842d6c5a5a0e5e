"""Paper A's experiment 3.2: one drive under one condition, seen by both presets, kept in a file, logged on demand."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pipelines.correlation.settings import CorrelationSettings
from pipelines.geometry import Floats
from workbench import session
from workbench.reproduce import estimates as est
from workbench.reproduce.conditions import METRES_PER_PX, NOISE_GREY, RATE_HZ, Condition, experiment_drive, motion_of
from workbench.reproduce.logged import logged
from workbench.reproduce.measures import Accuracy, accuracy
from workbench.reproduce.tasks import Tick
from workbench.settings import settings_values

PAPER, PRIOR, PRINTED = "paper-a", "paper-a, speed prior", "paper-a, as printed"
EXACT, BEST = "paper-a, whole vector", "best"
METHODS = (PAPER, PRIOR, PRINTED, EXACT, BEST)
"""The preset without correction; with its two readings; its measurements integrated exactly; the other preset."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One drive of the experiment: where it goes, what disturbs it, and the settings over the preset paper-a."""

    surface: str
    condition: Condition
    seed: int
    frames: int
    overrides: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.condition.name}-seed{self.seed}"

    def settings(self, start: Floats) -> dict[str, CorrelationSettings]:
        """The settings of both presets from a start pose [3]."""
        return {PAPER: est.settings_of(PAPER, start, self.overrides), BEST: est.settings_of(BEST, start)}

    @property
    def identity(self) -> str:
        """All that the result depends on, as text."""
        values = dataclasses.asdict(self) | {
            "settings": {name: settings_values(s) for name, s in self.settings(np.zeros(3)).items()},
            "noise_grey": NOISE_GREY,
            "versions": session.versions(),
        }
        return json.dumps(values, sort_keys=True)


@dataclass(frozen=True)
class Run:
    """A drive as it was and as both presets saw it: true poses [n, 3], and motions and poses by preset."""

    cell: Cell
    truth: Floats
    seen: dict[str, est.Estimate]

    @cached_property
    def poses(self) -> dict[str, Floats]:
        """The poses [n, 3] of every method; corrections and exact integration act on what paper-a measured."""
        measured = self.seen[PAPER]
        dt_s = np.full(len(self.truth) - 1, 1 / RATE_HZ)
        readings = est.variants(self.cell.settings(self.truth[0])[PAPER])
        again = {
            PRIOR: readings["speed prior"],
            PRINTED: readings["as printed"],
            EXACT: readings["none"].model_copy(update={"integration": "exact"}),
        }
        changed = {
            method: est.dead_reckoned(settings, measured.shift_px, measured.turn_rad, dt_s)
            for method, settings in again.items()
        }
        return {PAPER: measured.pose, **changed, BEST: self.seen[BEST].pose}

    @cached_property
    def accuracies(self) -> dict[str, Accuracy]:
        """How far every method is off."""
        shift, turn = motion_of(self.truth)
        found = {}
        for method, pose in self.poses.items():
            seen = self.seen[BEST if method == BEST else PAPER]
            found[method] = accuracy(pose, self.truth, seen.shift_px - shift, seen.turn_rad - turn)
        return found

    @property
    def t_s(self) -> Floats:
        """Times of the frames [n], seconds since the first."""
        return np.arange(len(self.truth)) / RATE_HZ


def kept(cell: Cell, folder: Path) -> Run | None:
    """The run of a cell that an earlier computation left in the folder, None where there is none."""
    try:
        with np.load(_file(cell, folder)) as data:
            if str(data["identity"]) != cell.identity:
                return None
            seen = {p: est.Estimate(*(data[f"{p}.{f}"] for f in est.Estimate._fields)) for p in (PAPER, BEST)}
            return Run(cell, data["truth"], seen)
    except (FileNotFoundError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        return None  # there is none, or it was not finished


def computed(tick: Tick, *, cell: Cell, folder: Path, log: bool) -> Run:
    """Render the drive, let both presets see it, keep the result in the folder, and log it if that is asked for.

    Raises:
        KeyboardInterrupt: it was stopped; nothing is kept.
    """
    drive = experiment_drive(cell.surface, cell.condition, cell.seed, cell.frames)
    if log:
        with contextlib.closing(
            est.RenderedOnce(drive.recording, folder / f"{cell.name}.frames", cell.identity)
        ) as once:
            seen = {preset: _logged(once, cell, preset, folder, tick) for preset in (PAPER, BEST)}
    else:
        seen = est.estimates(drive.recording, cell.settings(drive.truth[0]), tick)
    run = Run(cell, drive.truth, seen)
    _keep(run, folder)
    return run


def ticks(cell: Cell, log: bool) -> int:
    """How many steps of progress `computed` makes."""
    return cell.frames * (2 if log else 1)


def log_folder(cell: Cell, folder: Path) -> Path:
    """Where the log of a drive lies."""
    return folder / f"log-{cell.name}"


def has_log(cell: Cell, folder: Path) -> bool:
    """Whether the log of a drive is there."""
    files = ("sensors.rrd", f"{PAPER}.rrd", f"{BEST}.rrd")
    return all((log_folder(cell, folder) / file).is_file() for file in files)


def _logged(frames: est.RenderedOnce, cell: Cell, preset: str, folder: Path, tick: Tick) -> est.Estimate:
    """Replay one preset through the session, which writes the log, and take note of what it says."""
    overrides = (f"metres_per_px={METRES_PER_PX!r}", *(cell.overrides if preset == PAPER else ()))
    request = session.Request(
        path=frames.path, preset=preset, overrides=overrides, height="none", out=log_folder(cell, folder)
    )
    notes = est.Notes()
    logged(request, notes.add, recording=frames.lent(), tick=tick)
    return notes.estimate()


def _file(cell: Cell, folder: Path) -> Path:
    return folder / f"{cell.name}.npz"


def _keep(run: Run, folder: Path) -> None:
    seen = {f"{p}.{name}": array for p, e in run.seen.items() for name, array in e._asdict().items()}
    part = _file(run.cell, folder).with_suffix(".part")
    with part.open("wb") as stream:
        np.savez_compressed(stream, identity=run.cell.identity, truth=run.truth, **seen)
    part.replace(_file(run.cell, folder))
