"""The door to the sources of landmarks: one by its name, with its settings."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

from pipelines.ranging.landmarks.boards import Chessboard, Markers
from pipelines.ranging.landmarks.corners import TrackedCorners
from pipelines.ranging.landmarks.frames import is_frame
from pipelines.ranging.landmarks.recorded import RecordedBearings, RecordedTracks
from pipelines.ranging.landmarks.settings import LandmarkKind, LandmarkSettings
from pipelines.ranging.sightings import LandmarkSource, Sighting
from readers.streams import Camera, LandmarkSample, Problem, Sample, StreamKind, TrackSample


def source_of(
    settings: LandmarkSettings, camera: Camera | None, *, surveyed: Collection[int] | None = None
) -> LandmarkSource[Any]:
    """The source of landmarks that the settings name.

    Args:
        settings: the name and the sections.
        camera: whose images or tracks they are; bearings need none.
        surveyed: the numbers of bearings that count; None: all.

    Raises:
        ValueError: a source that needs a camera without one, or with one that has no calibration.
    """
    return _source(settings.landmarks, settings, camera, surveyed)


def _source(
    kind: LandmarkKind, settings: LandmarkSettings, camera: Camera | None, surveyed: Collection[int] | None
) -> LandmarkSource[Any]:
    if kind is LandmarkKind.AUTO:
        return AutomaticSource(settings, camera, surveyed)
    if kind is LandmarkKind.BEARINGS:
        return RecordedBearings(settings.bearings, surveyed)
    if camera is None:
        raise ValueError(f"landmarks = {kind.value!r} needs a calibrated camera; give its matrix")
    if kind is LandmarkKind.TRACKS:
        return RecordedTracks(camera, settings.tracks)
    if kind is LandmarkKind.CORNERS:
        return TrackedCorners(camera, settings.corners)
    if kind is LandmarkKind.CHESSBOARD:
        return Chessboard(camera, settings.board)
    return Markers(camera, settings.markers)


class Chosen(NamedTuple):
    """The source that the first frame chose, and its state."""

    source: LandmarkSource[Any] | None
    state: Any


class Named(NamedTuple):
    """A source that was chosen, by its name without its settings, and its state."""

    kind: LandmarkKind | None
    state: Any


@dataclass(frozen=True, slots=True)
class AutomaticSource:
    """The source that suits the first frame, from then on; frames of another kind are then no frames."""

    settings: LandmarkSettings
    camera: Camera | None
    surveyed: Collection[int] | None = None

    def start(self) -> Chosen:
        """The state before the first frame."""
        return Chosen(None, None)

    def sight(self, state: Chosen, sample: Sample, /) -> tuple[Chosen, Sighting | None]:
        """The landmarks of one frame, by the source that suits the first.

        Raises:
            ValueError: the first frame needs a calibrated camera, and there is none.
        """
        source, inner = state
        if source is None:
            kind = _kind_of(sample)
            if kind is None:
                return state, None
            source = _source(kind, self.settings, self.camera, self.surveyed)
            inner = source.start()
        inner, sighting = source.sight(inner, sample)
        return Chosen(source, inner), sighting

    def packed(self, state: Chosen) -> Named:
        """The state without settings."""
        kinds = {RecordedBearings: LandmarkKind.BEARINGS, RecordedTracks: LandmarkKind.TRACKS}
        kind = None if state.source is None else kinds.get(type(state.source), LandmarkKind.CORNERS)
        return Named(kind, state.state)

    def unpacked(self, packed: Named) -> Chosen:
        """The state, going on with these settings.

        Raises:
            ValueError: the source needs a calibrated camera, and there is none.
        """
        source = None if packed.kind is None else _source(packed.kind, self.settings, self.camera, self.surveyed)
        return Chosen(source, packed.state)


def _kind_of(sample: Sample) -> LandmarkKind | None:
    if is_frame(sample):
        return LandmarkKind.CORNERS
    missing = sample.kind if isinstance(sample, Problem) else None
    if isinstance(sample, TrackSample) or missing is StreamKind.TRACK:
        return LandmarkKind.TRACKS
    if isinstance(sample, LandmarkSample) or missing is StreamKind.LANDMARKS:
        return LandmarkKind.BEARINGS
    return None
