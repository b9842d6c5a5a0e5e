"""All that was computed of paper C's flights, and the numbers that it is set beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from workbench.reproduce.flights.flying import Flown, Result
from workbench.reproduce.flights.methods import ACCURATE, BASELINE, FAST, METHODS


@dataclass(frozen=True, kw_only=True)
class Results:
    """The flights that were flown; what was not is in `unfinished`."""

    command: str
    methods: tuple[str, ...]
    flights: Sequence[Flown] = ()
    unfinished: Sequence[str] = ()

    def pairs(self, method: str, other: str) -> list[tuple[Flown, Result, Result]]:
        """The flights that both methods flew, with what they came to."""
        both = ((flight, flight.of(method), flight.of(other)) for flight in self.flights)
        return [(flight, a, b) for flight, a, b in both if a is not None and b is not None]

    def results(self) -> list[tuple[Flown, Result]]:
        """Every flight with every method that flew it."""
        order = METHODS.index
        return [(f, r) for f in self.flights for r in sorted(f.results, key=lambda result: order(result.method))]


@dataclass(frozen=True, slots=True)
class Published:
    """What a paper's measured flight has of a method: relative errors per second (rmse, median) and frames/s."""

    rpe_mps: tuple[float, float]
    rpe_degps: tuple[float, float]
    laptop_fps: float
    board_fps: float


SVO = {
    FAST: Published((0.0059, 0.0047), (0.4295, 0.3686), 300.0, 55.0),
    ACCURATE: Published((0.0051, 0.0038), (0.4519, 0.3858), 1e3 / 6, float("nan")),
    BASELINE: Published((0.0164, 0.0142), (0.4585, 0.3808), 91.0, 27.0),
}
"""C. Forster et al., ICRA 2014, whose numbers paper C repeats as far as it has any: 84 m at 1.2 m; `baseline` is the
modified PTAM of S. Weiss et al. (2013). Frames/s on a laptop (i7, 2.8 GHz) and a single-board computer (Odroid-U2)."""
FEWER_OUTLIERS = 10.0
"""Paper C: the filters cut wrong measurements tenfold."""
PAPER_RATIO = SVO[FAST].laptop_fps / SVO[BASELINE].laptop_fps


@dataclass(frozen=True, slots=True)
class Bar:
    """What a mode must reach on a flight: ATE and drift of the scale, shares."""

    ate_share: float
    scale_drift: float = float("inf")


BARS: dict[tuple[str, str], Bar] = {
    **{(f"flight-{ground}", FAST): Bar(4e-4) for ground in ("gravel", "grass", "paving")},
    **{(f"flight-{ground}", ACCURATE): Bar(7e-5) for ground in ("gravel", "grass", "paving")},
    ("flight-100m", FAST): Bar(8e-4, 0.02),
    ("flight-100m", ACCURATE): Bar(1e-4, 0.002),
    ("flight-relief", FAST): Bar(6e-4),
    ("flight-relief", ACCURATE): Bar(6e-4),
}
FASTEST = {FAST: 300.0, ACCURATE: 130.0}
"""Frames/s of the tracking that each mode must reach on an idle core."""
