"""Gyro bias, focus of expansion and time offset from simulated drives with known answers."""

import math
from itertools import pairwise

import numpy as np
import pytest

from pipelines.ranging import calibration as cal
from pipelines.ranging import equations as eq
from pipelines.ranging import filter as rf
from pipelines.ranging.filter import Inputs, Landmarks
from pipelines.ranging.settings import FilterSettings
from pipelines.ranging.start import from_range

F, CENTRE = 800.0, (320.0, 240.0)


def pitched_drive(pitch_rad: float, r: float, seed: int, *, turn: float = 0.0, steps: int = 40):
    """Tracks [n, m, 2] of a straight drive with a camera pitched down, turns [m], depths at the end [n]."""
    rng = np.random.default_rng(seed)
    point = rng.uniform([-2, -1.5, 6], [2, 1.5, 12], (20, 3))
    s, c = math.sin(pitch_rad), math.cos(pitch_rad)
    down = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    turns, pixels = [0.0], []
    for k in range(steps + 1):
        pixels.append(eq.project(point @ down.T, F, CENTRE)[:, :2])
        omega = turn * math.sin(k)
        turns.append(turns[-1] + 0.1 * omega)
        point = eq.carried(point, eq.held(omega, 0.5, 0.1))
    exact = np.stack(pixels, axis=1)
    return exact + rng.normal(0, r, exact.shape), np.array(turns[:-1])


def test_gyro_bias_at_standstill() -> None:
    rng, dt = np.random.default_rng(0), np.full(75, 0.02)
    found = [cal.gyro_bias(0.01 + rng.normal(0, 1e-3 / 0.02**0.5, 75), dt, 1e-3) for _ in range(2000)]
    bias, sigma = np.array(found).T
    assert math.degrees(sigma[0]) == pytest.approx(0.047, abs=1e-3)  # the study's figure for 1.5 s
    assert bias.std() == pytest.approx(sigma[0], rel=0.06)
    assert bias.mean() == pytest.approx(0.01, abs=3 * sigma[0] / 2000**0.5)
    with pytest.raises(ValueError, match="at standstill"):
        cal.gyro_bias(np.zeros(0), np.zeros(0), 1e-3)


def test_focus_of_a_pitched_camera_is_found_with_its_covariance() -> None:
    pitch = math.radians(1.15)
    true = np.array([CENTRE[0], CENTRE[1] - F * math.tan(pitch)])
    np.testing.assert_allclose(true, eq.focus_of_expansion(np.array([0, -math.sin(pitch), math.cos(pitch)]), F, CENTRE))
    errors, nees = [], []
    for seed in range(200):
        pixel, turns = pitched_drive(pitch, 0.1, seed)
        found = cal.focus_from_tracks(list(pixel), [turns] * 20, 0.1, F, CENTRE)
        errors.append(found.pixel - true)
        nees.append(errors[-1] @ np.linalg.solve(found.covariance, errors[-1]))
    print(f"focus: error {np.std(errors, axis=0).round(3)} px, NEES {np.mean(nees):.2f} of 2")
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05
    assert np.mean(nees) == pytest.approx(2.0, abs=0.5)


def test_focus_with_a_weave_needs_the_turns() -> None:
    pixel, turns = pitched_drive(0.0, 0.1, 3, turn=0.1)
    right = cal.focus_from_tracks(list(pixel), [turns] * 20, 0.1, F, CENTRE).pixel
    wrong = cal.focus_from_tracks(list(pixel), [0 * turns] * 20, 0.1, F, CENTRE).pixel
    assert np.abs(right - CENTRE).max() < 1.0
    assert np.abs(wrong - CENTRE).max() > 3 * np.abs(right - CENTRE).max()
    with pytest.raises(ValueError, match="drive farther"):
        cal.focus_from_tracks(list(pixel[:, :2]), [turns[:2]] * 20, 0.1, F, CENTRE, min_length_px=50)
    line = np.linspace([0, 0], [50, 20], 10)
    with pytest.raises(ValueError, match="parallel"):
        cal.focus_from_tracks([line, line + 30], [np.zeros(10)] * 2, 0.1, F, CENTRE)


def test_focus_in_place_of_the_principal_point_cures_the_bias() -> None:
    pitch, settings = math.radians(1.15), FilterSettings(pixel_sigma=0.1)
    s, c = math.sin(pitch), math.cos(pitch)
    point, pixels = np.array([0.4, 0.4, 8.0]), []
    for _ in range(41):
        pixels.append(eq.project(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ point, F, CENTRE)[:2])
        point = eq.carried(point, eq.held(0.0, 0.5, 0.1))
    bias = {}
    for name, centre in (("principal point", CENTRE), ("focus", (CENTRE[0], CENTRE[1] - F * math.tan(pitch)))):
        model = settings.model(F, centre)
        now = Landmarks.of([from_range(pixels[0], 0.01, 11.0, 5.0)])
        for z in pixels[1:]:
            now, update = rf.step(model, now, Inputs(0.0, 0.5, 0.1), z[None], 0.01)
        bias[name] = update.range_m[0] / point[2] - 1
    print({k: f"{100 * v:+.1f} %" for k, v in bias.items()})
    assert abs(bias["principal point"]) > 0.2
    assert abs(bias["focus"]) < 0.02


@pytest.mark.parametrize("late", [-0.08, 0.0, 0.05])
def test_time_offset_between_camera_and_gyro(late) -> None:
    rng = np.random.default_rng(0)

    def omega(t):
        return 0.3 * np.sin(1.3 * t) + 0.1 * np.sin(3.1 * t)

    gyro_s = np.arange(0, 20, 0.02)
    gyro = omega(gyro_s - late) + rng.normal(0, 7e-3, len(gyro_s))
    frames = np.arange(0, 20, 0.2)
    point, pixels = rng.uniform([-3, -1, 6], [3, 1, 30], (40, 3)), []
    for t in frames:
        pixels.append(eq.project(point, F, CENTRE)[:, :2])
        for k in range(20):
            point = eq.carried(point, eq.held(float(omega(t + 0.01 * (k + 0.5))), 0.1, 0.01))
    rates = [cal.image_turn_rate(a, b, 0.2, F, CENTRE) for a, b in pairwise(pixels)]
    middle = 0.5 * (frames[1:] + frames[:-1])
    found = cal.time_offset(middle, np.array(rates), gyro_s, gyro, 0.3)
    print(f"offset {found.seconds:.4f} s for {late} s, correlation {found.correlation:.4f}")
    assert found.seconds == pytest.approx(late, abs=0.01)
    assert found.correlation > 0.99
    with pytest.raises(ValueError, match="needs turns"):
        cal.time_offset(middle, 0 * middle, gyro_s, gyro, 0.3)
