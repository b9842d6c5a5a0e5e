"""Landmarks that the recording has already: pixel tracks, and bearings that a vehicle measured."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from pipelines.lens import pinhole
from pipelines.ranging.landmarks.frames import NOTHING, ideal_px, sighting
from pipelines.ranging.landmarks.settings import BearingSettings, TrackSettings
from pipelines.ranging.sightings import Sighting
from readers.streams import Camera, LandmarkSample, Problem, Sample, StreamKind, TrackSample


@dataclass(frozen=True, slots=True)
class RecordedTracks:
    """Pixel tracks, freed of the camera's distortion; of a number that comes twice in a frame the first counts.

    Raises:
        ValueError: the camera has no calibration.
    """

    camera: Camera
    settings: TrackSettings = TrackSettings()

    def __post_init__(self) -> None:
        ideal_px(self.camera, np.zeros((0, 2)))

    def start(self) -> None:
        """There is nothing to remember."""

    def sight(self, state: None, sample: Sample, /) -> tuple[None, Sighting | None]:
        """The tracks of one `TrackSample`; none of one that could not be read."""
        if isinstance(sample, Problem) and sample.kind is StreamKind.TRACK:
            return None, NOTHING
        if not isinstance(sample, TrackSample):
            return None, None
        ids, first = np.unique(sample.ids, return_index=True)
        points = ideal_px(self.camera, sample.points_px[first])
        return None, sighting(ids, points, np.full(len(ids), self.settings.sigma_px))


@dataclass(frozen=True, slots=True)
class RecordedBearings:
    """Bearings β as image points of `bearing_camera`: x = -f tan β (right is positive), y = 0.

    A bearing is counter-clockwise from the body's x axis. With σ_β its noise is f σ_β / cos² β px. `only` are the
    numbers that count, such as those of the surveyed landmarks: of others it is not known that they stand still.
    """

    settings: BearingSettings = BearingSettings()
    only: Collection[int] | None = None

    def start(self) -> None:
        """There is nothing to remember."""

    def sight(self, state: None, sample: Sample, /) -> tuple[None, Sighting | None]:
        """The bearings of one `LandmarkSample`; of a number that comes twice in it the first one."""
        if isinstance(sample, Problem) and sample.kind is StreamKind.LANDMARKS:
            return None, NOTHING
        if not isinstance(sample, LandmarkSample):
            return None, None
        s = self.settings
        seen = np.abs(sample.bearing_rad) <= s.limit_rad
        if self.only is not None:
            seen &= np.isin(sample.ids, list(self.only))
        ids, first = np.unique(sample.ids[seen], return_index=True)
        bearing = sample.bearing_rad[seen][first]
        points = np.column_stack([-s.focal_px * np.tan(bearing), np.zeros(len(ids))])
        return None, Sighting(ids, points, s.focal_px * s.sigma_rad / np.cos(bearing) ** 2)


def bearing_camera(settings: BearingSettings) -> Camera:
    """The camera of `RecordedBearings`: at the body's origin, looking along x, its principal point at (0, 0)."""
    body_t_camera = np.eye(4)
    body_t_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    camera = pinhole(1, 1, settings.focal_px, model="none", centre_px=(0.0, 0.0))
    return replace(camera, width_px=0, height_px=0, frame="bearings", body_t_camera=body_t_camera)
