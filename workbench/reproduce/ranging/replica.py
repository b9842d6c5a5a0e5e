"""The simulated replica of the paper's robot, the scenario `paper-b`: what is true of a run, and what is estimated.

The range filter runs over it as it does in `workbench replay`: the same streams, camera and settings by name. It is
told the noise of the sensors and starts half of the range too far, the largest error of a start that the paper
allows. Of the board only the upper-left corner is its landmark, as in the paper; the other landmarks of the scenario
are carried along. The reference is the truth; the paper's own, perspective-n-point from the board, stands beside it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pipelines.estimator import Step
from pipelines.ranging.landmarks.settings import BoardSettings
from pipelines.ranging.reference import of_chessboard
from pipelines.ranging.sightings import Sighting
from pipelines.ranging.step import RangeStep
from pipelines.replay import Replayed, replay
from pipelines.simulation.mission import SimulatedMission
from pipelines.simulation.scenario import FRONT_TRACKS, Scenario, landmarks_of
from pipelines.simulation.sensors import Imu, Odometer, Tracks
from readers.streams import TrackSample
from workbench import inputs, range_inputs, scenarios, session
from workbench.reproduce.logged import logged
from workbench.settings import plugin, resolve

Floats = NDArray[np.float64]

SCENARIO = "paper-b"
START_FACTOR, START_SIGMA = 1.5, 0.5
"""The start's range over the true one; its σ over itself."""
START_PIXEL_VARIANCE = 10.0
LOGGED_SEED = 0
"""Seed of the run that is logged: that of the scenario itself."""
NO_GROUND_SEEN = ("ground.size_px=256",)
"""Of runs whose images are not rendered: the least ground."""


# ---------------------------------------------------------------------------- what is true


@dataclass(frozen=True)
class Drive:
    """One run: its recording, what its camera saw of the landmarks, and what was true.

    Attributes:
        scenario: what was simulated.
        mission: the recording.
        stop_ns: where the run ends, None for its end.
        tracks: the frames, k of them.
        frame_s: their times since the start of the recording [k], s.
        corner: number of the board's upper-left corner among the landmarks.
        point_m: its true place in camera axes [k, 3].
        way_m: driven so far [k].
    """

    scenario: Scenario
    mission: SimulatedMission
    stop_ns: int | None
    tracks: tuple[TrackSample, ...]
    frame_s: Floats
    corner: int
    point_m: Floats
    way_m: Floats

    @property
    def distance_m(self) -> float:
        """D₀."""
        return float(np.linalg.norm(self.point_m[0]))

    @property
    def scale(self) -> Floats:
        """L at the frames [k]."""
        return self.way_m / self.distance_m

    def at(self, scale: float) -> int:
        """The frame of that L on the first way forth."""
        return int(np.argmin(np.abs(self.scale - scale)))


def drive(seed: int, stop_s: float | None = None) -> Drive:
    """One run of the scenario up to `stop_s`; None for all of it."""
    loaded = scenarios.load(SCENARIO, seed=seed, overrides=NO_GROUND_SEEN)
    mission, around = scenarios.mission(loaded), loaded.scenario.surroundings
    corner, points = len(around.landmarks_m), landmarks_of(around)
    stop_ns = None if stop_s is None else mission.start_ns + round(stop_s * 1e9)
    frames = mission.read([FRONT_TRACKS], None, stop_ns)
    tracks = tuple(sample for sample in frames if isinstance(sample, TrackSample))
    frame_s = np.array([(sample.t_ns - mission.start_ns) / 1e9 for sample in tracks])
    state = mission.motion.at(frame_s)
    turn, place = mission.on_board[0].mount.world_t_camera(state)
    steps = np.linalg.norm(np.diff(state.position_m, axis=0), axis=1)
    return Drive(
        scenario=loaded.scenario,
        mission=mission,
        stop_ns=stop_ns,
        tracks=tracks,
        frame_s=frame_s,
        corner=corner,
        point_m=np.einsum("kij,ki->kj", turn, points[corner] - place),
        way_m=np.concatenate([[0.0], np.cumsum(steps)]),
    )


def board_depths(found: Drive) -> Floats:
    """Depth of the upper-left corner by perspective-n-point from the corners of the board [k], m.

    This is the paper's reference. NaN where the corner or the board's pose is not seen.
    """
    board = found.scenario.surroundings.chessboard
    if board is None:
        raise ValueError(f"scenario {found.scenario.name}: without a chessboard there is no reference range")
    settings = BoardSettings(columns=board.columns, rows=board.rows, square_m=board.square_m)
    depths = np.full(len(found.tracks), np.nan)
    for k, sample in enumerate(found.tracks):
        of_board = sample.ids >= found.corner
        numbers = sample.ids[of_board] - found.corner
        seen = Sighting(numbers, sample.points_px[of_board], np.zeros(len(numbers)))
        for depth in of_chessboard(seen, settings, found.mission.camera).depth_m[numbers == 0]:
            depths[k] = depth
    return depths


# ------------------------------------------------------------------------------ what is estimated


class Way(NamedTuple):
    """How the filter is fed: a preset, and ``key=value`` over it, as of ``--set``."""

    preset: str
    changes: tuple[str, ...] = ()


class Ranged(NamedTuple):
    """What the filter says of the corner at the frames, NaN where it says nothing.

    Attributes:
        mean: X [k, 3].
        covariance: P [k, 3, 3].
        interval_m: depth at ξ ± 2 σ_ξ [k, 2].
        nis: NIS [k].
        omega: ω̃ about the camera's y axis, mean since the frame before [k], rad/s.
        speed: Ṽ along the camera's z axis, mean since the frame before [k], m/s.
    """

    mean: Floats
    covariance: Floats
    interval_m: Floats
    nis: Floats
    omega: Floats
    speed: Floats

    @classmethod
    def of(cls, steps: Iterable[Step], corner: int) -> Self:
        """What is said in the steps of a run of the landmark of that number."""
        rows = []
        for step in steps:
            assert isinstance(step, RangeStep)
            (slots,) = np.nonzero(step.landmark_id == corner)
            values = (step.mean, step.covariance, step.range_interval_m, step.nis)
            own = (value[slots[0]] if len(slots) else np.full(value.shape[1:], np.nan) for value in values)
            rows.append((*own, step.omega_radps, step.speed_mps))
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))

    @property
    def depth_m(self) -> Floats:
        """Ẑ [k]."""
        return np.asarray(1.0 / self.mean[:, 2])

    @property
    def sigma_xi(self) -> Floats:
        """σ_ξ [k]."""
        return np.asarray(np.sqrt(self.covariance[:, 2, 2]))


def ranged(found: Drive, way: Way) -> Ranged:
    """The range filter over one drive."""
    return Ranged.of((item.step for item in steps_of(found, way)), found.corner)


def steps_of(found: Drive, way: Way) -> Generator[Replayed]:
    """The range filter over one drive, step by step, with the streams and the camera that a replay chooses."""
    mission, estimator = found.mission, plugin("range")
    resolved = resolve(estimator, preset=way.preset, overrides=overrides(found, way))
    streams = range_inputs.choose_streams(mission, resolved.settings)
    camera = range_inputs.camera_of(mission, streams)
    resolved, _ = range_inputs.with_camera(resolved, mission, camera, streams)
    return replay(
        mission,
        estimator.build(resolved.settings),
        image_stream=streams.frames,
        other_streams=streams.others,
        stop_ns=found.stop_ns,
    )


def ranged_and_logged(found: Drive, way: Way, folder: Path) -> Ranged:
    """The range filter over the scenario as it is, which is a whole drive, logged as ``PRESET.rrd`` in a folder.

    The images, which nothing here needs, are not rendered.

    Raises:
        KeyboardInterrupt: it was stopped.
    """
    steps: list[Step] = []
    logged(request(found, way, folder), steps.append)
    return Ranged.of(steps, found.corner)


def request(found: Drive, way: Way, folder: Path) -> session.Request:
    """What a user would ask of `workbench replay`."""
    return session.Request(
        path=Path(f"{scenarios.PREFIX}{SCENARIO}"),
        estimator="range",
        preset=way.preset,
        overrides=overrides(found, way),
        image=inputs.NONE,
        out=folder,
    )


def overrides(found: Drive, way: Way) -> tuple[str, ...]:
    """What the filter is told, as ``key=value``: the sensors' noise, the start, and what the way changes."""
    imu, odometer, tracks = sensors(found.scenario)
    start_m = START_FACTOR * float(found.point_m[0, 2])
    return (
        f"sigma_omega={imu.gyro_density!r}",
        f"sigma_speed={odometer.speed_density!r}",
        f"tracks.sigma_px={tracks.noise_px!r}",
        "start=range",
        f"start_range_m={start_m:.6g}",
        f"start_sigma_m={START_SIGMA * start_m:.6g}",
        f"start_pixel_variance={START_PIXEL_VARIANCE!r}",
        f"max_landmarks={found.corner + 1}",
        *way.changes,
    )


def sensors(scenario: Scenario) -> tuple[Imu, Odometer, Tracks]:
    """IMU, odometer and tracks of the replica."""
    if scenario.imu is None or scenario.odometer is None or scenario.tracks is None:
        raise ValueError(f"scenario {scenario.name}: it needs the sections imu, odometer and tracks")
    return scenario.imu, scenario.odometer, scenario.tracks
