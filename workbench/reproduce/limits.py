"""How often the integer correlation peak is false, by the size of the fragment and what it is up against.

Pairs of frames with a known motion between them are rendered, fragments of one frame are searched in the other by
the estimator's own kernel, and a peak that is more than 1.5 px away from the truth is false (study 4.1-4.3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.correlation import kernels
from pipelines.correlation.odometry import eight_bit
from pipelines.geometry import Floats
from pipelines.simulation.channels import rng_of
from readers.streams import ImageSample, StreamKind
from workbench.reproduce.conditions import METRES_PER_PX, mission, motion_of, surface_of
from workbench.reproduce.ledger import Ledger, Value
from workbench.reproduce.tasks import Tick

SIDES_PX = (5, 7, 9, 11, 15, 21, 31)
NOISES_GREY = (0.0, 2.0, 5.0, 10.0)
RADII_PX = (8, 16, 32, 56, 104)
ROTATIONS_DEG = (0.0, 0.44, 2.5, 5.0, 7.0, 10.0, 15.0)
USUAL_NOISE, USUAL_RADIUS, USUAL_ROTATION = 2.0, 16, 0.44
REACH_OF_SPEED = {"2 km/h": 16, "8 km/h": 56, "15 km/h": 104}
"""The radius that the search needs without a prediction."""
SAMPLES = 480
FALSE_PX = 1.5
ACCEPTED = 0.01
"""A fragment is large enough where no more than this share of the peaks is false."""

GRID_PX = np.array([(u, v) for v in (-40, 0, 40) for u in (-60, -20, 20, 60)])
SHIFT_PX = 6.0

KEY = ("surface", "noise_grey", "radius_px", "rotation_deg", "side_px", "samples", "seed")
FIELDS = ("false_peaks", "false")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What fragments of all sizes are up against."""

    surface: str
    noise_grey: float = USUAL_NOISE
    radius_px: int = USUAL_RADIUS
    rotation_deg: float = USUAL_ROTATION
    samples: int = SAMPLES
    seed: int = 0

    def key(self, side_px: int) -> dict[str, Value]:
        """What tells a row of the results."""
        return {
            "surface": self.surface,
            "noise_grey": self.noise_grey,
            "radius_px": self.radius_px,
            "rotation_deg": self.rotation_deg,
            "side_px": side_px,
            "samples": self.samples,
            "seed": self.seed,
        }

    @property
    def keys(self) -> list[dict[str, Value]]:
        """What tells its rows: one for each size of the fragment."""
        return [self.key(side) for side in SIDES_PX]

    @property
    def steps(self) -> int:
        """One for every frame."""
        return 2 * self.pairs

    def rows(self, tick: Tick) -> list[dict[str, Value]]:
        """Count the false peaks of fragments of all sizes."""
        rng = rng_of(self.seed, "limits", self.surface, f"{self.rotation_deg:g}")
        poses = self._poses(rng)
        name = f"limits-{self.surface}"
        pairs = mission(
            surface_of(self.surface, self.seed), poses, noise_grey=self.noise_grey, seed=self.seed, name=name
        )
        (images,) = (info.name for info in pairs.of_kind(StreamKind.IMAGE))
        shift, turn = motion_of(poses)
        false = dict.fromkeys(SIDES_PX, 0)
        before: NDArray[np.uint8] | None = None
        left = self.samples
        for k, sample in enumerate(pairs.read([images])):
            assert isinstance(sample, ImageSample)
            frame = eight_bit(sample.grey())
            if k % 2:
                assert before is not None
                count = min(left, len(GRID_PX))
                far = self._far(before, frame, (*shift[k - 1], turn[k - 1]), count, rng)
                for side, wrong in far.items():
                    false[side] += int(wrong.sum())
                left -= count
            before = frame
            tick()
        return [
            self.key(side) | {"false_peaks": number, "false": number / self.samples} for side, number in false.items()
        ]

    @property
    def pairs(self) -> int:
        """Number of pairs of frames."""
        return math.ceil(self.samples / len(GRID_PX))

    def _poses(self, rng: np.random.Generator) -> Floats:
        """Poses [2 · pairs, 3]: a random place, and one a small random motion away."""
        first = np.column_stack([rng.uniform(-5, 5, (self.pairs, 2)), rng.uniform(-math.pi, math.pi, self.pairs)])
        move = rng.uniform(-SHIFT_PX, SHIFT_PX, (self.pairs, 2)) * METRES_PER_PX
        sign = rng.choice([-1.0, 1.0], self.pairs)
        second = first + np.column_stack([move, sign * math.radians(self.rotation_deg)])
        return np.stack([first, second], axis=1).reshape(-1, 3)

    def _far(
        self,
        before: NDArray[np.uint8],
        frame: NDArray[np.uint8],
        motion: tuple[float, float, float],
        count: int,
        rng: np.random.Generator,
    ) -> Mapping[int, NDArray[np.bool_]]:
        """Which of `count` fragments of every size are found in a wrong place.

        The search is off its aim by up to half its radius, as a prediction may be.
        """
        height, width = frame.shape
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        centres = np.array([width // 2, height // 2]) + GRID_PX[:count]
        true = kernels.shifts_of(centres - middle, *motion, 1.0)
        miss = rng.integers(-(self.radius_px // 2), self.radius_px // 2, (count, 2), endpoint=True)
        search = centres + np.rint(true).astype(np.int64) + miss
        found = {}
        for side in SIDES_PX:
            m = kernels.new_matches(count, self.radius_px)
            kernels.match_one_step(before, frame, centres, search, side, self.radius_px, m.surface, m.hessian, m.block)
            found[side] = ~(np.hypot(*(m.peak_px - true).T) <= FALSE_PX)
        return found


def cases(surfaces: Sequence[str], *, samples: int = SAMPLES, seed: int = 0) -> list[Case]:
    """All cases: one of noise, radius and rotation is varied at a time."""
    found: dict[Case, None] = {}
    for surface in surfaces:
        usual = Case(surface=surface, samples=samples, seed=seed)
        found |= dict.fromkeys(replace(usual, noise_grey=noise) for noise in NOISES_GREY)
        found |= dict.fromkeys(replace(usual, radius_px=radius) for radius in RADII_PX)
        found |= dict.fromkeys(replace(usual, rotation_deg=rotation) for rotation in ROTATIONS_DEG)
    return list(found)


def ledger(folder: Path) -> Ledger:
    """The results in that folder."""
    return Ledger(folder / "limits.csv", KEY, FIELDS)


def false_rates(case: Case, results: Ledger) -> dict[int, float]:
    """Share of false peaks by size of the fragment; empty where the case is not done."""
    keys = {side: case.key(side) for side in SIDES_PX}
    return {side: float(results.row(key)["false"]) for side, key in keys.items() if key in results}


def smallest_side(rates: Mapping[int, float]) -> int | None:
    """The smallest side with no more than 1 % false peaks, None where none of them is."""
    return min((side for side, false in rates.items() if false <= ACCEPTED), default=None)
