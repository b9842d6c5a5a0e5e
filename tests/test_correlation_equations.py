"""Paper A's equations against closed forms and the exact motion of simulated poses (study A1-A3)."""

import math

import numpy as np
import pytest

from pipelines.correlation import equations as eq
from pipelines.correlation.equations import Motion
from pipelines.correlation.kernels import shifts_of
from pipelines.simulation import trajectories as way

W = 0.2002 / 256


def exact_way(name: str, lever_m: float = 0.0, speed_kmh: float = 2.0) -> np.ndarray:
    curve = {
        "eight": way.figure_eight(),
        "circle": way.circle(),
        "spiral": way.spiral(),
        "serpentine": way.serpentine(),
    }[name]
    return way.drive(curve, 2111, speed_mps=speed_kmh / 3.6, rng=np.random.default_rng(3), lever_m=lever_m)


@pytest.mark.parametrize(("half", "limit_rad"), [(2, 0.17498), (3, 0.11731), (4, 0.08816), (5, 0.07059), (6, 0.05886)])
def test_rotation_limit_obeys_the_table_of_1(half: int, limit_rad: float) -> None:
    assert eq.rotation_limit(2 * half + 1) == pytest.approx(limit_rad, abs=1.2e-5)
    assert eq.rotation_limit(2 * half + 1) == pytest.approx(math.atan(0.5 / (half * math.sqrt(2))), abs=1e-12)


@pytest.mark.parametrize("name", ["eight", "circle", "spiral", "serpentine"])
def test_exact_integration_returns_the_exact_way_with_a_lever(name: str) -> None:
    poses = exact_way(name, lever_m=0.10)
    shifts, turns = way.image_motion(poses, W)
    x, y, heading = poses[0]
    worst = 0.0
    for (u, v), turn, truth in zip(shifts.tolist(), turns.tolist(), poses[1:], strict=True):
        heading += turn
        dx, dy = eq.increment_of_vector((u, v), W, heading)
        x, y = x + dx, y + dy
        worst = max(worst, math.hypot(x - truth[0], y - truth[1]))
    print(f"A1 {name} m:", worst)
    assert worst < 1e-11  # metres: 1e-9 cm


def integrate_by_length(poses: np.ndarray, mid: bool) -> float:
    shifts, turns = way.image_motion(poses, W)
    x, y, heading = poses[0]
    worst = 0.0
    for shift, turn, truth in zip(shifts.tolist(), turns.tolist(), poses[1:], strict=True):
        heading += turn
        dx, dy = eq.increment_along(eq.path_step(tuple(shift), W), heading - turn / 2 if mid else heading)
        x, y = x + dx, y + dy
        worst = max(worst, math.hypot(x - truth[0], y - truth[1]))
    return worst


def test_integration_by_length_is_off_by_a_frame_or_by_next_to_nothing() -> None:
    poses = exact_way("eight")
    step_m = np.hypot(*np.diff(poses[:, :2], axis=0).T).mean()
    # the chord leaves the mid heading by κ' S²/12, along the way that makes S²/12 times the range of curvature
    bound_m = step_m**2 / 12 * np.ptp(np.diff(poses[5:, 2]) / np.hypot(*np.diff(poses[5:, :2], axis=0).T))
    errors = [integrate_by_length(poses, mid=mid) for mid in (True, False)]
    print("A2 m: mid heading, heading after the step", *errors, "theory of the former", bound_m)
    assert errors[0] < 1.5 * bound_m < 3e-5
    assert 0.008 < errors[1] < 0.011


def test_integration_by_length_loses_the_lever() -> None:
    assert integrate_by_length(exact_way("eight", lever_m=0.10), mid=True) > 0.10


def test_two_fragments_give_the_motion_of_the_frame() -> None:
    motion = Motion(-11.0, 3.0, 0.0077)
    front, rear = map(tuple, shifts_of(np.array([[100.0, 0.0], [-100.0, 0.0]]), *motion).tolist())
    assert eq.centre_shift(front, rear) == pytest.approx((-11.0, 3.0), abs=1e-12)
    assert eq.rotation_between_frames(front[1], rear[1], 200.0) == pytest.approx(0.0077, abs=1e-12)
    assert math.isnan(eq.rotation_between_frames(150.0, -150.0, 200.0))


def test_motions_compose_and_invert() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a = Motion(*rng.normal(0, 20, 2), rng.normal(0, 1), float(np.exp(rng.normal(0, 0.1))))
        b = Motion(*rng.normal(0, 20, 2), rng.normal(0, 1), float(np.exp(rng.normal(0, 0.1))))
        points = rng.normal(0, 100, (5, 2))
        first = shifts_of(points, *a)
        second = shifts_of(points + first, *b)
        np.testing.assert_allclose(shifts_of(points, *a.then(b)), first + second, atol=1e-9)
        np.testing.assert_allclose(shifts_of(points + first, *a.inverse()), -first, atol=1e-9)


def test_forward_motion_moves_the_content_backward() -> None:
    # the camera heads north (90 degrees) and the content moves towards -u: the vehicle goes north
    assert eq.increment_of_vector((-10.0, 0.0), 0.01, math.pi / 2) == pytest.approx((0.0, 0.1), abs=1e-12)
    # content moving to the right of the image (+v): the vehicle slips to the left, here west
    assert eq.increment_of_vector((0.0, 10.0), 0.01, math.pi / 2) == pytest.approx((-0.1, 0.0), abs=1e-12)


def test_correction_of_a_segment() -> None:
    relative, deviation = eq.deviation_of_segment(1.05, 1.0)
    assert (relative, deviation) == pytest.approx((0.05 / 1.05, 0.05))
    assert eq.correction_fires(relative, deviation, 0.1, 0.002)
    assert not eq.correction_fires(relative, deviation, 0.04, 0.002)
    assert not eq.correction_fires(relative, deviation, 0.1, 0.06)
    standing = eq.deviation_of_segment(0.0, 1.0)
    assert math.isnan(standing[0])
    assert not eq.correction_fires(*standing, 0.1, 0.002)
    slow = eq.deviation_of_segment(0.1, 1.0)  # a stop: the ratio is -9, which the printed form lets pass
    assert not eq.correction_fires(*slow, 0.1, 0.002)
    assert eq.correction_speed_prior(0.05, 1.0) == -0.05
    assert eq.correction_speed_prior(-0.05, 0.5) == 0.025
    for sign in (1.0, -1.0):  # (21) as printed cannot change sign
        assert eq.correction_as_printed(sign * 0.05, sign * 0.01, 0.25) == pytest.approx(0.0125)
