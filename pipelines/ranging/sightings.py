"""What the range filter is fed with: image points of landmarks, whatever they were found by."""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from readers.streams import Sample

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]

SourceState = TypeVar("SourceState")


class Sighting(NamedTuple):
    """The landmarks that one frame shows, n of them.

    Attributes:
        ids: number of each landmark, the same as long as it is the same point [n].
        points_px: image points (u, v) as an undistorted pinhole would show them [n, 2].
        sigma_px: their standard deviation per axis [n].
    """

    ids: Longs
    points_px: Floats
    sigma_px: Floats


class LandmarkSource(Protocol[SourceState]):
    """Finds landmarks in frames: recorded tracks, corners, boards; pure, its state is a value."""

    def start(self) -> SourceState:
        """The state before the first frame."""
        ...

    def sight(self, state: SourceState, sample: Sample, /) -> tuple[SourceState, Sighting | None]:
        """The landmarks of one frame; None where the sample is no frame of this source."""
        ...
