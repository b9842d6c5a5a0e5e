"""One flight: every frame is rendered once and given to all methods in turns, whose answers are scored."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.estimator import Estimator
from pipelines.replay import grey_sample
from pipelines.semidirect import scoring
from pipelines.semidirect.scoring import Accuracy, Curves, Floats, Ground, MapErrors, Track, Work
from pipelines.semidirect.step import VisualStep
from pipelines.simulation.mission import IMAGE, SimulatedMission
from pipelines.simulation.scenario import height_of
from pipelines.simulation.sensors import level_ground
from pipelines.spatial import SpatialPath, path_lengths
from readers.streams import Camera, ImageSample, Sample
from workbench import scenarios
from workbench.reproduce.flights.methods import Values, built
from workbench.reproduce.ranging.parts import Curve, Part
from workbench.reproduce.tasks import Tick
from workbench.session import versions
from workbench.settings import settings_values

FLIGHTS = (
    "flight-gravel",
    "flight-grass",
    "flight-paving",
    "flight-fractal",
    "flight-repetitive",
    "flight-slow",
    "flight-relief",
    "flight-100m",
)
MOST_PLACES = 600
"""Places along a flight that are kept of a curve."""


class Result(Part):
    """What one method came to; curves along the true path, at most `MOST_PLACES` places each."""

    method: str
    accuracy: Accuracy
    map_errors: MapErrors
    work: Work
    path_m: Curve
    position_m: Curve
    attitude_rad: Curve
    scale_path_m: Curve
    scale: Curve


class Flown(Part):
    """A flight and what the methods came to; `height_m` is the camera's mean height over z = 0."""

    flight: str
    about: str
    frames: int
    seconds: float
    path_m: float
    height_m: float
    results: tuple[Result, ...]

    def of(self, method: str) -> Result | None:
        """What a method came to, None if it did not fly."""
        return next((result for result in self.results if result.method == method), None)


@dataclasses.dataclass(frozen=True, slots=True)
class Flight:
    """A flight to be flown: its scenario, its length in frames (None for its own), and the methods."""

    name: str
    frames: int | None
    methods: tuple[str, ...]

    def load(self) -> scenarios.Loaded:
        """The scenario."""
        return scenarios.load(self.name, overrides=[] if self.frames is None else [f"frames={self.frames}"])

    @property
    def ticks(self) -> int:
        """How many steps of progress `flown` makes."""
        frames = self.load().scenario.frames
        assert frames is not None
        return frames

    @property
    def identity(self) -> str:
        """All that the result depends on, as text."""
        scenario = self.load().scenario
        assert scenario.camera is not None
        camera: Values = {"focal_px": scenario.camera.focal_px, "height_m": scenario.camera.height_m}
        settings = {method: settings_values(built(method, camera).settings) for method in self.methods}
        depends = {"scenario": scenario.model_dump(mode="json"), "settings": settings, "versions": versions()}
        return json.dumps(depends, sort_keys=True)


def flown(tick: Tick, *, flight: Flight) -> Flown:
    """Render the flight and let all methods fly it.

    Raises:
        WorkbenchError: a method refuses it.
        KeyboardInterrupt: it was stopped.
    """
    loaded = flight.load()
    mission = scenarios.mission(loaded)
    truth = truth_of(mission)
    camera, ground = mission.camera, ground_of(mission)
    given = settings_for(mission, truth)
    crew = {method: Pilot(built(method, **given), camera, ground) for method in flight.methods}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for k, sample in enumerate(frames_of(mission)):
            for pilot in crew.values():
                pilot.take(sample, truth.rotation[k].as_matrix(), truth.position_m[k])
            tick()
    finally:
        cv2.setNumThreads(threads)
    height = float(truth.position_m[:, 2].mean())
    return Flown(
        flight=flight.name,
        about=loaded.scenario.about,
        frames=len(truth),
        seconds=1e-9 * float(truth.t_ns[-1] - truth.t_ns[0]),
        path_m=float(path_lengths(truth)[-1]),
        height_m=height,
        results=tuple(pilot.result(method, truth, height) for method, pilot in crew.items()),
    )


class Pilot:
    """One method on a flight: takes the frames, notes its answers and their CPU time."""

    def __init__(self, estimator: Estimator[Any], camera: Camera, ground: Ground) -> None:
        self._estimator, self._state = estimator, estimator.start()
        focal, size = camera.matrix[0, 0], (camera.width_px, camera.height_px)
        self._map = scoring.MapNotes(ground, (size[0] / 2 / focal, size[1] / 2 / focal))
        self._rows: list[tuple[Any, ...]] = []
        self._cpu_ms: list[float] = []
        self._stage_ms: list[Floats] = []

    def take(self, sample: Sample, true_turn: Floats, true_place: Floats) -> None:
        """Give it a frame, of which the camera's true pose is known."""
        begin = time.thread_time()
        self._state, step = self._estimator.step(self._state, sample)
        self._cpu_ms.append(1e3 * (time.thread_time() - begin))
        assert isinstance(step, VisualStep)
        self._rows.append(
            (step.t_ns, step.accepted, step.position_m, step.quat_xyzw, step.stage, step.map_number, step.scale_known)
        )
        self._stage_ms.append(np.asarray(getattr(step, "stage_ms", np.empty(0))))
        turn = Rotation.from_quat(step.quat_xyzw).as_matrix() if step.accepted else np.eye(3)
        self._map.add(step, turn, true_turn, true_place)

    @property
    def track(self) -> Track:
        """What it said of each frame."""
        t_ns, accepted, places, quats, stages, maps, _ = zip(*self._rows, strict=True)
        return Track(
            np.array(t_ns, np.int64),
            np.array(accepted, np.bool_),
            np.array(places, np.float64),
            np.array(quats, np.float64),
            np.array(stages, np.int64),
            np.array(maps, np.int64),
        )

    def result(self, method: str, truth: SpatialPath, height_m: float) -> Result:
        """Its scores."""
        accuracy, curves, fit = scoring.scored(self.track, truth)
        return Result(
            method=method,
            accuracy=accuracy,
            map_errors=self._map.errors(fit, height_m),
            work=Work.of(self.cpu_ms, self.stage_ms),
            **{name: _thinned(values) for name, values in _curves(curves)},
        )

    @property
    def cpu_ms(self) -> Floats:
        """CPU time of each frame's step, ms [n]."""
        return np.array(self._cpu_ms)

    @property
    def stage_ms(self) -> Floats:
        """Time of the stages of each frame, ms [n, k]; k is 0 for a method that does not tell them."""
        return np.array(self._stage_ms).reshape(len(self._cpu_ms), -1)


def _curves(curves: Curves) -> Iterator[tuple[str, Floats]]:
    for field in dataclasses.fields(curves):
        yield field.name, getattr(curves, field.name)


def _thinned(values: Floats) -> Curve:
    return tuple(values[:: max(1, -(-len(values) // MOST_PLACES))].tolist())


# ---------------------------------------------------------------------------- the mission


def truth_of(mission: SimulatedMission) -> SpatialPath:
    """The first camera's pose, camera axes to world, in each of its frames."""
    first = mission.on_board[0]
    turns, places = first.mount.world_t_camera(mission.motion.at(first.plan.t_s))
    return SpatialPath(first.t_ns, places, Rotation.from_matrix(turns).as_quat())


def ground_of(mission: SimulatedMission) -> Ground:
    """The height of the ground that the first camera sees."""
    relief = mission.on_board[0].scene.relief
    return level_ground if relief is None else partial(height_of, relief)


def frames_of(mission: SimulatedMission) -> Iterator[Sample]:
    """The images in the order of time, each rendered, numbered and decoded once."""
    for k, sample in enumerate(mission.read([IMAGE])):
        assert isinstance(sample, ImageSample)
        yield grey_sample(dataclasses.replace(sample, frame=k))


def settings_for(mission: SimulatedMission, truth: SpatialPath) -> Values:
    """What `built` needs for a flight: the camera, the true height at the start, and stage times where there are."""
    camera = mission.camera
    values: Values = {
        "focal_px": float(camera.matrix[0, 0]),
        "image_size_px": (camera.width_px, camera.height_px),
        "height_m": float(truth.position_m[0, 2]),
    }
    return {"camera": values, "stage_times": True}


def methods_flown(found: Sequence[Flown]) -> tuple[str, ...]:
    """The methods that flew at least one of the flights, in their order."""
    return tuple(dict.fromkeys(result.method for flight in found for result in flight.results))
