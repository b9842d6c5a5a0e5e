"""The offset between clocks: found at different rates and scales, with the accuracy that it tells, or not claimed."""

import numpy as np
import pytest

from pipelines.evaluation import Trajectory, evaluate
from pipelines.time_offset import time_offset

SECOND = 1_000_000_000


def drive(t_s: np.ndarray, seed: int) -> np.ndarray:
    """Positions of a drive of changing speed and heading, at any times."""
    rng = np.random.default_rng(seed)
    grid = np.arange(-20, 140, 0.01)
    speed, heading = np.full(len(grid), 0.8), np.zeros(len(grid))
    for _ in range(12):
        w, a, p = rng.uniform(0.2, 2.0), rng.uniform(0.03, 0.09), rng.uniform(0, 6)
        speed += a * np.sin(w * grid + p)
        heading += 0.3 * np.sin(0.3 * w * grid - p)
    place = np.cumsum(speed * np.exp(1j * heading)) * 0.01
    x, y = np.interp(t_s, grid, place.real), np.interp(t_s, grid, place.imag)
    return np.column_stack([x, y])


def pair(seed: int, offset_s: float, noise_m: float) -> tuple[Trajectory, Trajectory]:
    """Estimate of 20 Hz in other units and another frame, reference of 33 Hz that knows the time."""
    rng = np.random.default_rng(seed)
    at, known = np.arange(0, 60, 0.05), np.arange(-5, 70, 0.0303)
    place = drive(at + offset_s, seed) + rng.normal(0, noise_m, (len(at), 2))
    turned = 37 * place @ np.array([[0, -1], [1, 0]]) + 5
    truth = drive(known, seed) + rng.normal(0, noise_m, (len(known), 2))
    epoch = 1_700_000_000 * SECOND
    return (
        Trajectory.of(epoch + np.round(at * 1e9).astype(np.int64), turned),
        Trajectory.of(epoch + np.round(known * 1e9).astype(np.int64), truth),
    )


@pytest.mark.parametrize("offset_s", [0.0, 0.123, -3.456])
def test_the_offset_is_found(offset_s: float) -> None:
    estimate, reference = pair(1, offset_s, 0.0005)
    found = time_offset(estimate, reference)
    assert found.determined
    assert found.offset_ns / 1e9 == pytest.approx(offset_s, abs=0.005)
    assert found.correlation > 0.98
    assert found.scale == pytest.approx(1 / 37, rel=0.02)
    with_it = evaluate(estimate, reference, with_scale=True, offset_ns=found.offset_ns).ape_m.rmse
    assert with_it < 0.01
    if offset_s:
        assert evaluate(estimate, reference, with_scale=True).ape_m.rmse > 2 * with_it


@pytest.mark.parametrize("noise_m", [0.001, 0.004])
def test_the_accuracy_is_told(noise_m: float) -> None:
    errors = []
    for seed in range(30):
        found = time_offset(*pair(seed, 0.4, noise_m), max_offset_s=2)
        assert found.determined
        errors.append((found.offset_ns / 1e9 - 0.4) / found.sigma_s)
    assert 0.6 < float(np.sqrt(np.mean(np.square(errors)))) < 1.5


def test_the_sign_is_that_of_evaluate() -> None:
    estimate, reference = pair(2, 0.0, 0.0005)
    late = Trajectory(estimate.t_ns + SECOND, estimate.pose)
    assert time_offset(late, reference).offset_ns == pytest.approx(-SECOND, abs=5_000_000)
    assert time_offset(late, reference, max_offset_s=0.2, around_s=-1.1).offset_ns == pytest.approx(-SECOND, abs=5e6)


def test_what_speeds_do_not_tell_is_not_claimed() -> None:
    estimate, reference = pair(3, 0.0, 0.001)
    other = pair(4, 0.0, 0.001)[1]
    assert not (found := time_offset(estimate, other, max_offset_s=2)).determined
    assert "do not go together" in found.reason
    far = Trajectory(reference.t_ns + 1000 * SECOND, reference.pose)
    assert "too little time in common" in time_offset(estimate, far).reason
    near = Trajectory(reference.t_ns + 2 * SECOND, reference.pose)
    assert "border" in time_offset(estimate, near, max_offset_s=1.9).reason
    assert "fewer than 3" in time_offset(Trajectory.of([0], np.zeros((1, 2))), reference).reason
    still = Trajectory(estimate.t_ns, estimate.pose * 0)
    assert not time_offset(still, reference).determined
    with pytest.raises(ValueError, match="must be positive"):
        time_offset(estimate, reference, max_offset_s=0)
