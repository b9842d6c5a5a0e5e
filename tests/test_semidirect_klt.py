"""The KLT peer: its homography's pose against the true one, a rendered flight, a loss, frames that cannot be used."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.estimator import EstimatorError
from pipelines.geometry import Floats
from pipelines.semidirect.klt import Keyframe, KltOdometry, KltSettings, Pose, decomposed
from pipelines.semidirect.scoring import Track, scored
from pipelines.semidirect.step import Stage, VisualStep
from pipelines.simulation.mission import IMAGE
from pipelines.spatial import SpatialPath
from pipelines.verdict import Verdict
from readers.streams import ImageSample, Problem, Sample, StreamKind
from workbench import scenarios
from workbench.reproduce.flights.flying import frames_of, truth_of

FOCAL_PX, HEIGHT_M, N = 150.0, 1.5, 90
SMALL = ("camera.width_px=240", "camera.height_px=180", f"camera.focal_px={FOCAL_PX}", "ground.metres_per_px=0.01")


@cache
def flight() -> tuple[list[Sample], SpatialPath]:
    mission = scenarios.mission(
        scenarios.load("flight-gravel", overrides=[*SMALL, "ground.size_px=256", f"frames={N}"])
    )
    return list(frames_of(mission)), truth_of(mission)


def odometry(**settings: Any) -> KltOdometry:
    truth = flight()[1]
    usual = {"focal_px": FOCAL_PX, "height_m": float(truth.position_m[0, 2]), "corner_distance_px": 8.0}
    return KltOdometry(KltSettings.model_validate(usual | settings))


def flown(samples: list[Sample], **settings: Any) -> list[VisualStep]:
    estimator, steps = odometry(**settings), []
    state = estimator.start()
    for sample in samples:
        state, step = estimator.step(state, sample)
        assert step is not None
        steps.append(step)
    return steps


def track_of(steps: list[VisualStep]) -> Track:
    names = ("t_ns", "accepted", "position_m", "quat_xyzw", "stage", "map_number")
    return Track(*(np.array([getattr(step, name) for step in steps]) for name in names))


# ------------------------------------------------------------------------------- geometry


def camera_at(place: Floats, *angles: float) -> Pose:
    return Pose(Rotation.from_euler("zyx", angles).as_matrix() @ np.diag([1.0, -1.0, -1.0]), place)


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_a_homography_gives_the_pose_and_the_ground(tilt: float) -> None:
    """H = R + t nᵀ/d of two cameras over z = 0; the ground's normal is known to 3 degrees only."""
    key = Keyframe(0, camera_at(np.array([0.3, 0.2, 1.4]), 0.5, tilt, -tilt), 1.4, 0)
    now = camera_at(np.array([0.8, 0.1, 1.6]), 0.7, -0.05, 0.08)
    now_r_key = now.turn.T @ key.pose.turn
    shift = now.turn.T @ (key.pose.place - now.place)
    normal = key.pose.turn.T @ np.array([0.0, 0.0, -1.0])
    homography = now_r_key + np.outer(shift, normal) / key.distance_m
    pose, found = decomposed(2.5 * homography, key, np.array([0.05, 0.0, -1.0]))
    np.testing.assert_allclose(pose.turn, now.turn, atol=1e-9)
    np.testing.assert_allclose(pose.place, now.place, atol=1e-9)
    np.testing.assert_allclose(found, [0, 0, -1], atol=1e-9)


# --------------------------------------------------------------------------------- flights


def test_it_flies() -> None:
    samples, truth = flight()
    steps = flown(samples)
    assert steps[0].verdict == Verdict.FIRST_FRAME
    assert all(step.accepted for step in steps)
    assert [step.frame for step in steps] == list(range(N))
    assert sum(step.keyframe for step in steps) > 2
    accuracy, _, _ = scored(track_of(steps), truth)
    assert accuracy.ate_share < 0.002
    assert accuracy.scale == pytest.approx(1, abs=0.05)
    travelled = sum(step.path_step_m for step in steps)
    assert travelled == pytest.approx(accuracy.path_m, rel=0.05)
    np.testing.assert_allclose(np.sum([s.increment_m for s in steps], axis=0), steps[-1].position_m[:2], atol=1e-9)


def test_the_same_flight_gives_the_same_steps() -> None:
    samples, _ = flight()
    one, two = flown(samples[:40]), flown(samples[:40])
    assert all(np.array_equal(a.position_m, b.position_m) for a, b in zip(one, two, strict=True))


def test_an_image_of_sixteen_bits_is_the_same() -> None:
    samples, _ = flight()
    eight = [s for s in samples[:30] if isinstance(s, ImageSample)]
    deep = [
        dataclasses.replace(
            s, encoding="mono16", step_bytes=480, big_endian=False, payload=(s.grey().astype("<u2") << 8).tobytes()
        )
        for s in eight
    ]
    np.testing.assert_array_equal(flown([*deep])[-1].position_m, flown([*eight])[-1].position_m)


def test_a_jump_is_lost_and_begun_anew() -> None:
    samples, _ = flight()
    later = [dataclasses.replace(s, t_ns=samples[39].t_ns + 1 + k) for k, s in enumerate(samples[85:])]
    steps = flown([*samples[:40], *later])
    assert (steps[40].stage, steps[40].verdict, steps[40].accepted) == (Stage.LOST, Verdict.LOST, False)
    np.testing.assert_array_equal(steps[40].position_m, steps[39].position_m)
    assert (steps[39].map_number, steps[41].map_number) == (0, 1)
    assert all(step.accepted for step in steps[41:])


def test_frames_that_cannot_be_used_are_said() -> None:
    samples, _ = flight()
    first = samples[5]
    assert isinstance(first, ImageSample)
    common: dict[str, Any] = {"stream": IMAGE, "t_ns": first.t_ns, "received_ns": first.received_ns, "frame": 5}
    broken = Problem(kind=StreamKind.IMAGE, reason="torn", **common)
    small = ImageSample(encoding="mono8", payload=bytes(100), width_px=10, height_px=10, step_bytes=10, **common)
    for odd, verdict in (
        (broken, Verdict.UNDECODABLE),
        (small, Verdict.SIZE_CHANGED),
        (samples[2], Verdict.OUT_OF_ORDER),
    ):
        steps = flown([*samples[:5], odd, *samples[5:10]])
        assert (steps[5].stage, steps[5].verdict, steps[5].accepted) == (Stage.SKIPPED, verdict, False)
        assert all(step.accepted for step in steps[6:])


def test_it_wants_a_height() -> None:
    with pytest.raises(EstimatorError, match="set height_m"):
        KltOdometry(KltSettings(focal_px=400))


def test_a_view_without_corners_is_lost_every_time() -> None:
    samples, _ = flight()
    first = samples[0]
    assert isinstance(first, ImageSample)
    grey = bytes(np.full(240 * 180, 90, np.uint8))
    flat: list[Sample] = [dataclasses.replace(s, payload=grey) for s in samples[:4] if isinstance(s, ImageSample)]
    steps = flown(flat)
    assert [step.stage for step in steps] == [Stage.STARTED, Stage.LOST, Stage.LOST, Stage.LOST]
    assert [step.map_number for step in steps] == [0, 1, 2, 3]
