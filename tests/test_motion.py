"""Curves, speeds and motions: every derivative is the derivative, every integral the integral."""

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipe

from pipelines.simulation import curves
from pipelines.simulation import trajectories as ways
from pipelines.simulation.curves import Curve, Piece, Pieces, curve
from pipelines.simulation.driving import Chain, Disturbed, Drive, Placed, Swaying, Turn, stop
from pipelines.simulation.faults import ExposureJump, HeightChange, ShiftJump, TurnJump
from pipelines.simulation.motion import (
    FORWARD,
    NADIR,
    Hold,
    Kinematics,
    Motion,
    Mount,
    Waypoints,
    looking,
    rotations,
    smooth_step,
)
from pipelines.simulation.signals import Constant, Fluctuation, Schedule, fluctuation
from pipelines.simulation.speeds import Speed, speed

W = 0.2002 / 256.0
POINTS = [[0.0, 0.0], [4.0, 0.5], [5.0, 3.0], [2.0, 4.0], [-1.0, 2.0]]
CURVES = {
    "line": curve("line", heading_rad=0.4),
    "circle": curve("circle"),
    "square": curve("square"),
    "eased-square": curve("square", ease=0.7),
    "figure-eight": curve("figure-eight", length_m=3.45, width_m=1.37),
    "spiral": curve("spiral"),
    "serpentine": curve("serpentine"),
    "wander": curve("wander", seed=3),
    "hypotrochoid": curve("hypotrochoid"),
    "spline": curve("spline", points=POINTS, closed=True),
    "open-spline": curve("spline", points=POINTS),
    "polyline": curve("polyline", points=POINTS, corner_m=0.4),
    "lanes": curve("lanes", length_m=1.2, spacing_m=0.4, count=9),
    "eased-lanes": curve("lanes", length_m=1.2, spacing_m=-0.4, count=9, ease=1.0),
}
every_curve = pytest.mark.parametrize("way", CURVES.values(), ids=CURVES)


def joints_of(way: Curve) -> list[float]:
    """Arc lengths within 12 m where a curve of pieces is not smooth."""
    if isinstance(way, Pieces):
        joints = list(way.joints_m)
    elif isinstance(way, curves.Spline):
        lengths = [quad(lambda t: np.hypot(*way.tangent(t)), k, k + 1, epsabs=1e-13)[0] for k in range(int(way.end))]
        joints = list(np.cumsum([0.0, *lengths]))
    else:
        return []
    return [j + n * way.length_m for n in (range(-1, 3) if way.closed else range(1)) for j in joints]


# ------------------------------------------------------------------------------------ curves


@every_curve
def test_derivatives_are_derivatives(way: Curve) -> None:
    h = 1e-5
    t = np.random.default_rng(0).uniform(0.05, 3.9, 60)
    for joint in joints_of(way) if isinstance(way, Pieces) else range(5):
        t = t[np.abs(t - joint) > 2 * h]
    for order in range(3):
        difference = (way.derivative(t + h, order) - way.derivative(t - h, order)) / (2 * h)
        scale = np.max(np.abs(way.derivative(t, order + 1))) + 1
        np.testing.assert_allclose(way.derivative(t, order + 1), difference, atol=2e-8 * scale)
    np.testing.assert_array_equal(way.tangent(t), way.derivative(t, 1).T)


@every_curve
def test_by_arc_length_the_speed_is_one_and_heading_and_curvature_are_derivatives(way: Curve) -> None:
    at, h = way.measured(-0.1, 9.0), 1e-5
    s = np.random.default_rng(1).uniform(0.01, 8.9, 200)
    for joint in joints_of(way):
        s = s[np.abs(s - joint) > 2 * h]
    here, before, after = at(s), at(s - h), at(s + h)
    step = (after.point_m - before.point_m) / (2 * h)
    np.testing.assert_allclose(step, [np.cos(here.heading_rad), np.sin(here.heading_rad)], atol=1e-8)
    np.testing.assert_allclose((after.heading_rad - before.heading_rad) / (2 * h), here.curvature, atol=1e-7)
    rate = (after.curvature - before.curvature) / (2 * h)
    np.testing.assert_allclose(rate, here.curvature_rate, atol=1e-7 * (1 + np.max(np.abs(rate))))


@every_curve
def test_points_lie_on_the_curve_at_the_right_length(way: Curve) -> None:
    if isinstance(way, Pieces):
        s = np.linspace(0, 9, 40)
        np.testing.assert_array_equal(way.measured(0, 9)(s).point_m, way.derivative(s, 0))
        return
    table = curves.ArcLength(way, 0.0, 9.0)
    s = np.linspace(0, 9, 40)
    t = table.parameter(s)
    np.testing.assert_array_equal(table(s).point_m, way.derivative(t, 0))
    between = [quad(lambda x: np.hypot(*way.tangent(x)), a, b, epsabs=1e-13)[0] for a, b in itertools.pairwise(t)]
    np.testing.assert_allclose(between, np.diff(s), atol=3e-12)


def test_closed_forms() -> None:
    s = np.linspace(-3, 12, 50)
    line = curve("line", heading_rad=0.4).measured(-3, 12)(s)
    np.testing.assert_allclose(line.point_m, np.outer([np.cos(0.4), np.sin(0.4)], s), atol=1e-14)
    circle = curve("circle", radius_m=2.5).measured(-3, 12)(s)
    np.testing.assert_allclose(circle.point_m, 2.5 * np.array([np.sin(s / 2.5), 1 - np.cos(s / 2.5)]), atol=1e-13)
    np.testing.assert_allclose(circle.heading_rad, s / 2.5, atol=1e-13)
    np.testing.assert_allclose(circle.curvature, 1 / 2.5, atol=1e-13)
    spiral = curves.ArcLength(curve("spiral", start_m=0.0, pitch_m=2 * math.pi), 0.0, 60.0)  # r = φ
    phi = spiral.parameter(np.array([1.0, 10.0, 60.0]))
    np.testing.assert_allclose((phi * np.sqrt(1 + phi**2) + np.arcsinh(phi)) / 2, [1, 10, 60], atol=1e-12)
    assert math.isinf(curve("spiral").length_m)
    ellipse = curves.Waves([curves.Wave(1.0, (2.0, 0.0), (0.0, 0.05))], end=2 * math.pi)
    assert ellipse.length_m == pytest.approx(8 * ellipe(1 - 0.05**2 / 4), abs=1e-13)


@pytest.mark.parametrize(
    ("way", "turns"),
    [("circle", 1), ("square", 1), ("eased-square", 1), ("figure-eight", 0), ("hypotrochoid", 2), ("spline", 1)],
)
def test_closed_curves_close(way: str, turns: int) -> None:
    closed = CURVES[way]
    length = closed.length_m
    at = closed.measured(-length, 2 * length)(np.array([-length, 0.0, length, 2 * length]))
    np.testing.assert_allclose(at.point_m, np.tile(at.point_m[:, 1:2], 4), atol=2e-12)
    np.testing.assert_allclose(np.diff(at.heading_rad), 2 * np.pi * turns, atol=1e-11)
    assert -np.pi <= at.heading_rad[1] <= np.pi


@pytest.mark.parametrize("way", ["circle", "square", "figure-eight", "hypotrochoid", "spline"])
def test_long_ways_stay_on_the_curve(way: str) -> None:
    closed = CURVES[way]
    rounds = 300.0
    at = closed.measured(0.0, rounds * closed.length_m)(np.array([1.0, 1.0 + rounds * closed.length_m]))
    np.testing.assert_allclose(at.point_m[:, 1], at.point_m[:, 0], atol=1e-9)


def test_the_square_has_four_sides_and_four_quarter_circles() -> None:
    way = curve("square", side_m=2.0, corner_m=0.3)
    assert way.length_m == pytest.approx(4 * 1.4 + 2 * np.pi * 0.3, abs=1e-12)
    s = np.linspace(0, way.length_m, 4001)
    at = way.measured(0, 0)(s)
    assert set(np.round(at.curvature, 9)) == {0.0, round(1 / 0.3, 9)}
    np.testing.assert_allclose(np.ptp(at.point_m, axis=1), 2.0, atol=1e-6)
    np.testing.assert_allclose(at.point_m[:, 0], 0, atol=1e-15)


@pytest.mark.parametrize("ease", [0.3, 1.0])
def test_eased_corners_have_no_jump_of_curvature(ease: float) -> None:
    for way in (curve("square", ease=ease), curve("lanes", ease=ease), curve("polyline", points=POINTS, ease=ease)):
        s = np.linspace(0, way.length_m, 200_001)
        at = way.measured(0, way.length_m)(s)
        steepest = np.max(np.abs(at.curvature_rate)) * (s[1] - s[0])
        assert np.max(np.abs(np.diff(at.curvature))) <= steepest * 1.001 + 1e-12


def test_clothoids_are_the_integral_of_their_heading() -> None:
    way = Pieces([Piece(2.0, -0.4, 0.9), Piece(1.5, 1.4, -1.1)], origin=(3.0, -1.0), heading_rad=0.7)
    for s in (0.3, 2.0, 3.5):
        heading = lambda v: float(way.frenet(np.array(v)).heading_rad)  # noqa: E731
        x, y = (quad(lambda v: f(heading(v)), 0, s, epsabs=1e-14, points=[2.0])[0] for f in (np.cos, np.sin))  # noqa: B023
        np.testing.assert_allclose(way.point(s), [3 + x, -1 + y], atol=1e-12)


def test_lanes_have_their_length_and_number() -> None:
    way = curve("lanes", length_m=100.0, spacing_m=15.0, count=7)
    assert way.length_m == pytest.approx(7 * 100 + 6 * np.pi * 7.5, abs=1e-9)
    s = np.linspace(0, way.length_m, 20_001)
    at = way.measured(0, way.length_m)(s)
    straight = at.point_m[:, (at.curvature == 0) & (at.point_m[0] > 1) & (at.point_m[0] < 99)]
    np.testing.assert_allclose(sorted(set(np.round(straight[1], 6))), 15 * np.arange(7), atol=1e-6)
    np.testing.assert_allclose(at.point_m[:, -1], [100, 90], atol=1e-10)
    right = curve("lanes", length_m=100.0, spacing_m=-15.0, count=2, ease=0.5)
    end = right.measured(0, right.length_m)(np.array([right.length_m]))
    np.testing.assert_allclose(end.point_m[:, 0], [0, -15], atol=1e-10)
    assert end.heading_rad[0] == pytest.approx(-np.pi)


def test_polylines_pass_by_and_splines_through_their_points() -> None:
    way = CURVES["polyline"]
    ends = way.measured(0, way.length_m)(np.array([0.0, way.length_m])).point_m.T
    np.testing.assert_allclose(ends, [POINTS[0], POINTS[-1]], atol=1e-12)
    s = np.linspace(0, way.length_m, 5001)
    path = way.point(s)
    for before, corner, after in zip(POINTS, POINTS[1:], POINTS[2:], strict=False):
        inwards, outwards = (np.subtract(p, corner) / np.hypot(*np.subtract(p, corner)) for p in (before, after))
        turn = np.pi - np.arccos(inwards @ outwards)
        missed = 0.4 * (1 / np.cos(turn / 2) - 1)  # from the corner to its arc
        assert np.min(np.hypot(*(path - corner).T)) == pytest.approx(missed, abs=1e-5)
    np.testing.assert_allclose(CURVES["open-spline"].point(np.arange(5)), POINTS, atol=1e-14)


def crossings(way: Curve, length_m: float, n: int = 800) -> int:
    """How often a curve crosses itself: pairs of chords that cut each other."""
    p = way.measured(0, length_m)(np.linspace(0, length_m, n + 1)).point_m.T

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.sign((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])

    a, b, c, d = p[:-1, None], p[1:, None], p[None, :-1], p[None, 1:]
    cut = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return int(np.sum(np.triu(cut, 2)))


@pytest.mark.parametrize(
    ("name", "length_m", "expected"),
    [
        ("figure-eight", 17.0, 1),
        ("hypotrochoid", 30.0, 5),
        ("spiral", 30.0, 0),
        ("serpentine", 30.0, 0),
        ("wander", 30.0, 0),
        ("lanes", 13.0, 0),
        ("square", 7.0, 0),
    ],
)
def test_curves_cross_themselves_or_not(name: str, length_m: float, expected: int) -> None:
    found = crossings(CURVES[name], min(length_m, CURVES[name].length_m * 0.999))
    assert found == expected


def test_curves_by_name_and_what_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no curve is named 'ellipse'; there are: circle, figure-eight"):
        curve("ellipse")
    with pytest.raises(ValueError, match=r"'radius'; its parameters are: radius_m"):
        curve("circle", radius=3)
    with pytest.raises(ValueError, match="points"):
        curve("spline")
    for radius in ("three", math.nan):
        with pytest.raises(ValueError, match="no number"):
            curve("circle", radius_m=radius)
    with pytest.raises(ValueError, match=r"count = 2\.5"):
        curve("lanes", count=2.5)
    for name, parameters in {
        "circle": {"radius_m": 0},
        "square": {"corner_m": 1.5},
        "figure-eight": {"width_m": 0},
        "spiral": {"pitch_m": 0},
        "serpentine": {"wavelength_m": 0},
        "wander": {"n_waves": 0},
        "hypotrochoid": {"loop": 2 / 3},
        "lanes": {"count": 0},
        "polyline": {"points": [[0, 0], [1, 0], [0.5, 0]]},
        "spline": {"points": [[0, 0], [0, 0], [1, 0]]},
    }.items():
        with pytest.raises(ValueError, match=r"change its parameters|smaller corners|twice in a row"):
            curve(name, **parameters)
    with pytest.raises(ValueError, match="0…1"):
        curve("square", ease=1.1)
    with pytest.raises(ValueError, match="not closed"):
        Pieces([Piece(1.0)], closed=True)
    with pytest.raises(ValueError, match="cusp"):  # x = cos t, y = cos 2t turns on its heel at t = π
        curves.ArcLength(curves.Waves([curves.Wave(1, (1, 0), (0, 0)), curves.Wave(2, (0, 1), (0, 0))]), 0, 9)


# ---------------------------------------------------------------------------- frame by frame


@every_curve
def test_arc_lengths_and_headings_are_exact(way: Curve) -> None:
    lengths = np.random.default_rng(0).uniform(-0.005, 0.025, 300)
    lengths[0] = 0.02
    poses = ways.follow(way, lengths)
    # the same way in one piece, and in steps twenty times as short
    np.testing.assert_allclose(ways.follow(way, np.repeat(lengths / 20, 20))[::20], poses, atol=1e-11)
    fine = ways.follow(way, np.full(5000, lengths.sum() / 5000))
    np.testing.assert_allclose(fine[-1], poses[-1], atol=1e-10)
    chords = np.linalg.norm(np.diff(fine[:, :2], axis=0), axis=1).sum()
    assert chords == pytest.approx(abs(lengths.sum()), rel=1e-6)
    mid = (fine[:-1, 2] + fine[1:, 2]) / 2
    step = np.diff(fine[:, :2], axis=0)
    across = np.cos(mid) * step[:, 1] - np.sin(mid) * step[:, 0]
    assert np.max(np.abs(across)) < (1e-6 if isinstance(way, Pieces) else 1e-9)  # a joint lies within a step


def test_a_drive_rises_from_standstill_to_its_speed() -> None:
    poses = ways.drive(ways.figure_eight(), 2111, speed_mps=0.51, rng=np.random.default_rng(0))
    speeds = 60 * np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert speeds[0] == 0
    assert speeds[100:].mean() == pytest.approx(0.51, rel=0.03)
    assert speeds[100:].std() == pytest.approx(0.051, rel=0.25)
    assert np.all(np.abs(np.diff(poses[:, 2])) < 0.02)
    # the demo and the benchmarks rest on this very drive
    np.testing.assert_allclose(poses[2110], [-1.169598724241, -0.873890508858, 0.576478834186], atol=1e-9)


def test_fast_drives_have_slow_waves() -> None:
    poses = ways.drive(ways.line(), 600, speed_mps=8 / 3.6, rng=np.random.default_rng(0), ramp_frames=0)
    speeds = 60 * np.diff(poses[:, 0])
    assert speeds.max() == pytest.approx(8 / 3.6 * 1.035, rel=1e-3)
    assert np.abs(np.diff(speeds)).max() < 0.005


def test_the_lever_moves_the_camera_ahead() -> None:
    poses = ways.ahead(np.array([[1.0, 2.0, np.pi / 2]]), 0.1)
    np.testing.assert_allclose(poses, [[1.0, 2.1, np.pi / 2]], atol=1e-15)


def test_image_motion_integrates_to_the_poses() -> None:
    poses = ways.drive(ways.spiral(), 400, speed_mps=0.5, rng=np.random.default_rng(1), lever_m=0.1)
    shift, turn = ways.image_motion(poses, W)
    pose = poses[0].copy()
    for (u, v), delta in zip(shift, turn, strict=True):
        pose[2] += delta
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        pose[:2] -= W * np.array([cos * u + sin * v, sin * u - cos * v])
    np.testing.assert_allclose(pose, poses[-1], atol=1e-12)


# ------------------------------------------------------------------------------------ speeds

PROFILES = {
    "constant": speed("constant", speed_mps=0.55, duration_s=4.0),
    "ramp": speed("constant", speed_mps=2.2, duration_s=3.0, ramp_s=1.0),
    "jitter": speed("jitter", speed_mps=0.55, duration_s=3.0, seed=2),
    "waves-with-stops": speed("waves", speed_mps=2.2, duration_s=4.0).with_stops([(1.5, 0.5)], ramp_s=0.4),
    "forth-and-back": speed("forth-and-back", distance_m=0.6, speed_mps=0.5, stop_s=0.2),
}
every_profile = pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)


@every_profile
def test_arc_lengths_are_the_integral_of_the_speed(profile: Speed) -> None:
    t = np.sort(np.random.default_rng(0).uniform(0, profile.duration_s, 40))
    arc, _, _ = profile.at(t)
    edges = np.union1d(t, profile.t_s)
    nodes = edges[:-1, None] + np.diff(edges)[:, None] * [0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12)]
    v = np.interp(nodes, profile.t_s, profile.speed_mps)
    running = np.concatenate([[0.0], np.cumsum(np.diff(edges) * v.mean(axis=1))])
    np.testing.assert_allclose(arc, np.interp(t, edges, running), atol=1e-13)
    least, most = profile.extent()
    fine = profile.at(np.linspace(0, profile.duration_s, 100_001))[0]
    assert (least, most) == pytest.approx((fine.min(), fine.max()), abs=1e-6)
    assert least <= fine.min()
    assert most >= fine.max()


def test_the_farthest_point_may_lie_between_knots() -> None:
    assert speed("knots", t_s=[0, 2, 4], speed_mps=[1, -1, -1]).extent() == pytest.approx((-2.0, 0.5))


def test_trapezoids_run_from_standstill_to_standstill() -> None:
    run = speed("trapezoid", distance_m=-3.0, speed_mps=0.8, acceleration_mps2=0.4)
    assert run.duration_s == pytest.approx(3.0 / 0.8 + 0.8 / 0.4)
    assert run.at(np.array([run.duration_s]))[0] == pytest.approx(-3.0)
    assert (run.speed_mps[0], run.speed_mps.min(), run.speed_mps[-1]) == (0, -0.8, 0)
    short = speed("trapezoid", distance_m=0.1, speed_mps=0.8, acceleration_mps2=0.4)
    assert short.arc_m[-1] == pytest.approx(0.1)
    assert short.speed_mps.max() == pytest.approx(0.2)
    exact = speed("trapezoid", distance_m=1.6, speed_mps=0.8, acceleration_mps2=0.4)  # no stretch at full speed
    assert exact.arc_m[-1] == pytest.approx(1.6)


def test_forth_and_back_returns() -> None:
    run = speed("forth-and-back", distance_m=2.0, speed_mps=0.5, stop_s=1.5, runs=2)
    assert run.arc_m[-1] == pytest.approx(0, abs=1e-12)
    assert run.extent() == pytest.approx((0, 2), abs=1e-12)
    assert np.all(run.at(np.linspace(0, 1.5, 50))[1] == 0)


def test_stops_stand_and_the_rest_is_as_before() -> None:
    free = speed("constant", speed_mps=1.0, duration_s=10.0)
    stopped = free.with_stops([(3.0, 1.5), (7.0, 1.0)], ramp_s=0.5)
    t = np.linspace(0, 10, 2001)
    v = stopped.at(t)[1]
    assert np.all(v[((t >= 3) & (t <= 4.5)) | ((t >= 7) & (t <= 8))] == 0)
    away = (t <= 2.5) | ((t >= 5) & (t <= 6.5)) | (t >= 8.5)
    assert np.all(v[away] == 1)
    assert stopped.arc_m[-1] == pytest.approx(10 - 2.5 - 4 * 0.25)
    late = free.with_stops([(9.8, 5.0)], ramp_s=0.5)  # the mission ends during the stop
    assert late.at(np.array([9.9]))[1] == 0
    with pytest.raises(ValueError, match="in order"):
        free.with_stops([(3.0, 1.0), (4.5, 1.0)], ramp_s=0.5)


def test_profiles_end_at_a_length_and_go_on_with_others() -> None:
    profile = PROFILES["jitter"].until(0.9)
    assert profile.arc_m[-1] == pytest.approx(0.9, abs=1e-14)
    assert profile.speed_mps[-1] == pytest.approx(PROFILES["jitter"].at(np.array([profile.duration_s]))[1][0])
    assert speed("constant", speed_mps=2.0, duration_s=9).until(4.0).duration_s == pytest.approx(2.0)
    with pytest.raises(ValueError, match="not to 50 m"):
        profile.until(50.0)
    with pytest.raises(ValueError, match="put a ramp"):
        profile.then(speed("constant", speed_mps=9.0, duration_s=1.0))


def test_jitter_and_waves_have_their_size() -> None:
    slow = speed("jitter", speed_mps=0.5, duration_s=600.0, seed=1)
    v = slow.speed_mps[100:] / 0.5 - 1
    assert v.std() == pytest.approx(0.10, rel=0.06)
    assert np.corrcoef(v[14:], v[:-14])[0, 1] == pytest.approx(math.exp(-1), abs=0.06)
    fast = speed("waves", speed_mps=4.0, duration_s=60.0)
    assert np.ptp(fast.speed_mps[100:]) == pytest.approx(2 * 0.035 * 4.0, rel=1e-3)
    again, other = (speed("jitter", speed_mps=0.5, duration_s=600.0, seed=seed) for seed in (1, 2))
    assert np.array_equal(slow.speed_mps, again.speed_mps)
    assert abs(np.corrcoef(slow.speed_mps[100:], other.speed_mps[100:])[0, 1]) < 0.1


def test_what_is_no_profile_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no speed profile is named 'fast'; there are: constant"):
        speed("fast")
    with pytest.raises(ValueError, match="must rise"):
        speed("knots", t_s=[0, 1, 1], speed_mps=[0, 1, 2])
    with pytest.raises(ValueError, match="first at 0 s"):
        speed("knots", t_s=[1, 2], speed_mps=[0, 1])
    with pytest.raises(ValueError, match="one value for each time"):
        speed("knots", t_s=[0, 1, 2], speed_mps=[0, 1])
    with pytest.raises(ValueError, match="finite"):
        speed("knots", t_s=[0, 1], speed_mps=[0, np.nan])
    for name, parameters in {
        "constant": {"speed_mps": 1, "duration_s": 0},
        "trapezoid": {"distance_m": 0, "speed_mps": 1},
        "forth-and-back": {"distance_m": 1, "speed_mps": 1, "runs": 0},
        "jitter": {"speed_mps": 1, "duration_s": -1},
    }.items():
        with pytest.raises(ValueError, match="change its parameters"):
            speed(name, **parameters)


# ----------------------------------------------------------------------------------- signals


@pytest.mark.parametrize(
    "signal",
    [Constant(0.3), Schedule([1.0, 2.0, 4.0], [0.1, -0.2, 0.5]), fluctuation(0.3, 0.4, seed=1, name="x", mean=2.0)],
    ids=["constant", "schedule", "fluctuation"],
)
def test_signals_carry_their_derivatives(signal: Constant | Schedule | Fluctuation) -> None:
    t, h = np.linspace(0, 5, 400) + 1e-3, 1e-5
    value, rate, change = signal.at(t)
    before, after = signal.at(t - h), signal.at(t + h)
    np.testing.assert_allclose(rate, (after[0] - before[0]) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(change, (after[1] - before[1]) / (2 * h), atol=1e-6)
    assert value.shape == rate.shape == change.shape == t.shape


def test_schedules_hold_their_values() -> None:
    schedule = Schedule([1.0, 2.0, 4.0], [0.1, -0.2, 0.5])
    np.testing.assert_allclose(schedule.at(np.array([-9, 1, 2, 4, 9.0]))[0], [0.1, 0.1, -0.2, 0.5, 0.5])
    np.testing.assert_array_equal(Schedule([1.0], [0.7]).at(np.array([0.0, 5.0])), [[0.7] * 2, [0] * 2, [0] * 2])
    with pytest.raises(ValueError, match="must rise"):
        Schedule([1.0, 1.0], [0.0, 1.0])


def test_fluctuations_have_their_mean_rms_and_correlation_time() -> None:
    tau, lags = 0.5, np.array([0.25, 0.5, 0.8])
    t = np.arange(0, 3000, 0.05)
    found = []
    for seed in range(4):
        x = fluctuation(0.02, tau, seed=seed, name="roll", mean=0.3).at(t)[0]
        assert x.mean() == pytest.approx(0.3, abs=1e-3)
        assert x.std() == pytest.approx(0.02, rel=0.02)
        found.append([np.corrcoef(x[k:], x[:-k])[0, 1] for k in np.rint(lags / 0.05).astype(int)])
    np.testing.assert_allclose(np.mean(found, axis=0), np.exp(-((lags / tau) ** 2)), atol=0.02)


def test_fluctuations_are_nearly_normal_and_seeded_by_name() -> None:
    t = np.arange(0, 2000, 0.2)
    make = functools.partial(fluctuation, 1.0, 0.5)
    x = make(seed=1, name="roll").at(t)[0]
    assert np.mean(np.abs(x) < 1) == pytest.approx(0.683, abs=0.02)
    np.testing.assert_array_equal(x, make(seed=1, name="roll").at(t)[0])
    for other in (make(seed=2, name="roll"), make(seed=1, name="pitch")):
        assert abs(np.corrcoef(x, other.at(t)[0])[0, 1]) < 0.1
    with pytest.raises(ValueError, match="rms"):
        fluctuation(-1, 0.5, seed=0, name="x")


def test_smooth_steps_are_smooth() -> None:
    x, h = np.linspace(-0.2, 1.2, 141), 1e-6
    value, slope, bend = smooth_step(x)
    assert (value[0], value[-1]) == (0, 1)
    np.testing.assert_allclose(slope, (smooth_step(x + h)[0] - smooth_step(x - h)[0]) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(bend, (smooth_step(x + h)[1] - smooth_step(x - h)[1]) / (2 * h), atol=1e-4)


# ----------------------------------------------------------------------------------- motions


def sway(seed: int = 5) -> dict[str, Fluctuation]:
    return {
        "height_m": fluctuation(0.002, 0.3, seed=seed, name="height", mean=0.2),
        "roll_rad": fluctuation(0.03, 0.4, seed=seed, name="roll"),
        "pitch_rad": fluctuation(0.02, 0.5, seed=seed, name="pitch", mean=-0.05),
    }


def swaying_drive(way: str, profile: str) -> Drive:
    slip = Schedule([0.5, 1.0, 2.0], [0.0, 0.1, -0.05])
    return Drive(CURVES[way], PROFILES[profile], sideslip_rad=slip, start_m=0.7, **sway())


def corner_and_back() -> Chain:
    run = Drive(curve("line"), speed("trapezoid", distance_m=0.8, speed_mps=0.6, acceleration_mps2=1.0))
    back = Drive(curve("circle", radius_m=0.5), run.speed.backwards())
    return Chain([run, stop(0.2), Turn(math.pi / 2, 1.2), run, Turn(-0.5, 0.5), back])


FAULTS = [
    ShiftJump(start_s=0.5, stop_s=1.5, forward_m=0.02, left_m=0.05, ramp_s=0.2),
    TurnJump(start_s=0.3, stop_s=2.0, turn_rad=-0.3, ramp_s=0.4),
    HeightChange(start_s=1.0, stop_s=2.5, lift_m=0.05, ramp_s=0.5),
    ExposureJump(start_s=0.0, stop_s=1.0, gain=2.0),
]
MOTIONS: dict[str, Motion] = {
    **{f"{way} {profile}": swaying_drive(way, profile) for way in CURVES for profile in PROFILES},
    "chain": corner_and_back(),
    "swaying chain": Swaying(Placed(corner_and_back(), 1.0, -2.0, 0.6), **sway()),
    "swaying drive twice": Swaying(swaying_drive("figure-eight", "ramp"), **sway(6)),
    "disturbed": Disturbed(swaying_drive("figure-eight", "jitter"), FAULTS),
    "disturbed chain": Disturbed(corner_and_back(), FAULTS),
}
every_motion = pytest.mark.parametrize("name", MOTIONS)


def smooth_between(motion: Motion) -> np.ndarray:
    """Times between which a motion is smooth, at most 4 ms apart."""
    t = np.arange(0, motion.duration_s, 0.004)
    breaks = [0.0, motion.duration_s]
    pending: list[tuple[Motion, float]] = [(motion, 0.0)]
    while pending:
        part, begin = pending.pop()
        if isinstance(part, Chain):
            begins = np.cumsum([begin, *(inner.duration_s for inner in part.parts)])
            breaks += list(begins)
            pending += zip(part.parts, begins, strict=False)
        elif isinstance(part, Swaying | Placed | Disturbed):
            pending.append((part.motion, begin))
            faults = part.faults if isinstance(part, Disturbed) else ()
            for f in faults:
                ramp = getattr(f, "ramp_s", 0.0)
                breaks += [f.start_s, f.start_s + ramp, f.stop_s - ramp, f.stop_s]
        elif isinstance(part, Drive):
            breaks += [begin + k for k in part.speed.t_s]
            breaks += [begin + k for k in getattr(part.sideslip_rad, "t_s", ())]
            grid = np.union1d(np.linspace(0, part.duration_s, 2001), part.speed.t_s)
            for joint in joints_of(part.curve):
                gap = lambda x, p=part, j=joint: p.start_m + p.speed.at(np.asarray(x))[0] - j  # noqa: E731
                for k in np.flatnonzero(np.diff(np.sign(gap(grid)))):
                    breaks.append(begin + brentq(gap, grid[k], grid[k + 1], xtol=1e-14))
    edges = np.unique(np.concatenate([t, breaks]))
    edges = edges[(edges >= 0) & (edges <= motion.duration_s)]
    return edges[np.concatenate([[True], np.diff(edges) > 1e-13])]


def spin(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix()


def product(matrices: np.ndarray) -> np.ndarray:
    """The product of matrices [n, k, k] in their order."""
    while len(matrices) > 1:
        odd = matrices[len(matrices) // 2 * 2 :]
        pairs = matrices[: len(matrices) // 2 * 2]
        matrices = np.concatenate([pairs[::2] @ pairs[1::2], odd])
    return matrices[0]


@every_motion
def test_velocities_and_rates_integrate_to_the_pose(name: str) -> None:
    motion = MOTIONS[name]
    edges = smooth_between(motion)
    steps = np.diff(edges)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    t = edges[:-1, None] + steps[:, None] * (1 + nodes) / 2
    inner = motion.at(t.ravel())
    start, end = motion.at(edges[:1]), motion.at(edges[-1:])

    def integral(values: np.ndarray) -> np.ndarray:
        return np.einsum("n,k,nkd->d", steps / 2, weights, values.reshape(len(steps), 4, -1))

    np.testing.assert_allclose(start.position_m[0] + integral(inner.velocity_mps), end.position_m[0], atol=1e-9)
    got = start.velocity_mps[0] + integral(inner.acceleration_mps2)
    np.testing.assert_allclose(got, end.velocity_mps[0], atol=1e-9)
    np.testing.assert_allclose(
        start.world_r_body[0] @ rotation_of(motion, edges), end.world_r_body[0], atol=1e-9, err_msg="attitude"
    )
    if not name.startswith(("square", "lanes", "polyline")):  # where arcs meet straight lines the rate jumps
        got = start.angular_velocity_radps[0] + integral(inner.angular_acceleration_radps2)
        np.testing.assert_allclose(got, end.angular_velocity_radps[0], atol=1e-9)


def rotation_of(motion: Motion, edges: np.ndarray) -> np.ndarray:
    """What the body's rates integrate to: Magnus' expansion of fourth order on two Gauss nodes a step."""
    steps, root = np.diff(edges), math.sqrt(3)
    first, second = (motion.at(edges[:-1] + steps * (0.5 + side * root / 6)).angular_velocity_radps for side in (-1, 1))
    h = steps[:, None]
    return product(spin(h / 2 * (first + second) + root / 12 * h**2 * np.cross(first, second)))


@every_motion
def test_derivatives_of_motions_are_derivatives(name: str) -> None:
    motion, h = MOTIONS[name], 2e-5
    edges = smooth_between(motion)
    t = np.random.default_rng(0).uniform(h, motion.duration_s - h, 150)
    distance = np.min(np.abs(t[:, None] - edges[None, :]), axis=1)
    t = t[distance > 2 * h]
    here, before, after = motion.at(t), motion.at(t - h), motion.at(t + h)

    def slope(name: str) -> np.ndarray:
        return (getattr(after, name) - getattr(before, name)) / (2 * h)

    np.testing.assert_allclose(here.velocity_mps, slope("position_m"), atol=3e-6)
    np.testing.assert_allclose(here.acceleration_mps2, slope("velocity_mps"), atol=2e-5)
    turn = np.swapaxes(here.world_r_body, 1, 2) @ slope("world_r_body")
    rates = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=-1)
    np.testing.assert_allclose(here.angular_velocity_radps, rates, atol=1e-6)
    np.testing.assert_allclose(here.angular_acceleration_radps2, slope("angular_velocity_radps"), atol=2e-4)
    np.testing.assert_allclose(
        here.world_r_body @ here.world_r_body.swapaxes(1, 2), np.tile(np.eye(3), (len(t), 1, 1)), atol=1e-14
    )


@pytest.mark.parametrize("name", ["figure-eight jitter", "eased-lanes waves-with-stops", "disturbed", "swaying chain"])
def test_increments_between_frames_compose_to_the_pose(name: str) -> None:
    motion = MOTIONS[name]
    at = motion.at(np.arange(0, motion.duration_s, 1 / 60))
    n = len(at.t_s)
    world_t_body = np.tile(np.eye(4), (n, 1, 1))
    world_t_body[:, :3, :3], world_t_body[:, :3, 3] = at.world_r_body, at.position_m
    increments = np.linalg.inv(world_t_body[:-1]) @ world_t_body[1:]
    np.testing.assert_allclose(world_t_body[0] @ product(increments), world_t_body[-1], atol=1e-9)
    x, y, heading = at.poses.T
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    forward, left = cos * np.diff(x) + sin * np.diff(y), cos * np.diff(y) - sin * np.diff(x)
    px, py, angle = at.poses[0]
    for u, v, turn in zip(forward, left, np.diff(heading), strict=True):
        px, py, angle = (
            px + math.cos(angle) * u - math.sin(angle) * v,
            py + math.sin(angle) * u + math.cos(angle) * v,
            angle + turn,
        )
    np.testing.assert_allclose([px, py, angle], at.poses[-1], atol=1e-9)


@pytest.mark.parametrize(
    "name",
    ["figure-eight jitter", "lanes forth-and-back", "spline ramp", "disturbed", "swaying chain", "disturbed chain"],
)
def test_what_is_found_for_a_time_does_not_depend_on_the_others(name: str) -> None:
    motion = MOTIONS[name]
    t = np.linspace(-0.1, motion.duration_s + 0.1, 700)
    order = np.random.default_rng(0).permutation(len(t))

    def columns(times: np.ndarray) -> list[np.ndarray]:
        at = motion.at(times).at_point(np.array([0.1, 0.2, 0.3]))
        return [getattr(at, item.name) for item in dataclasses.fields(Kinematics)] + [at.body_velocity_mps]

    whole = columns(t)
    for picked in ([0], [350], [1, 2], range(100, 107), range(100, 611), order):
        for part, column in zip(columns(t[list(picked)]), whole, strict=True):
            np.testing.assert_array_equal(part, column[list(picked)])
    assert len(motion.at(np.zeros(0)).poses) == 0


def test_a_circle_pulls_to_its_middle() -> None:
    v, radius = 0.55, 1.2
    at = Drive(curve("circle", radius_m=radius), speed("constant", speed_mps=v, duration_s=9.0)).at(
        np.linspace(0, 9, 50)
    )
    middle = np.array([0, radius, 0]) - at.position_m
    np.testing.assert_allclose(at.acceleration_mps2, v**2 / radius**2 * middle, atol=1e-13)
    np.testing.assert_allclose(at.angular_velocity_radps, np.tile([0, 0, v / radius], (50, 1)), atol=1e-13)
    np.testing.assert_allclose(at.angular_acceleration_radps2, 0, atol=1e-12)
    np.testing.assert_allclose(at.body_velocity_mps, np.tile([v, 0, 0], (50, 1)), atol=1e-13)


def test_reverse_returns_along_the_same_points() -> None:
    motion = Drive(CURVES["wander"], speed("forth-and-back", distance_m=5.0, speed_mps=1.0, stop_s=1.0))
    t = np.linspace(0, motion.duration_s, 301)
    there, back = motion.at(t), motion.at(motion.duration_s - t)
    np.testing.assert_allclose(there.poses, back.poses, atol=1e-12)
    np.testing.assert_allclose(there.velocity_mps, -back.velocity_mps, atol=1e-12)
    assert np.all(motion.at(np.linspace(0, 0.99, 30)).velocity_mps == 0)
    assert there.poses[150, 0] > 3


def test_the_sideslip_is_the_angle_from_the_heading_to_the_way() -> None:
    slip = Schedule([0.5, 1.0, 2.0], [0.0, 0.2, -0.1])
    at = Drive(CURVES["figure-eight"], PROFILES["ramp"], sideslip_rad=slip).at(np.linspace(0.01, 3, 90))
    forward, left, _ = at.body_velocity_mps.T
    np.testing.assert_allclose(np.arctan2(left, forward), slip.at(at.t_s)[0], atol=1e-12)


def test_height_roll_and_pitch_are_those_of_their_signals() -> None:
    motion = swaying_drive("serpentine", "jitter")
    at = motion.at(np.linspace(0, 3, 50))
    np.testing.assert_allclose(at.position_m[:, 2], motion.height_m.at(at.t_s)[0], atol=1e-15)
    pitch, roll = motion.pitch_rad.at(at.t_s)[0], motion.roll_rad.at(at.t_s)[0]
    np.testing.assert_allclose(at.world_r_body, rotations(at.heading_rad, pitch, roll), atol=1e-14)
    plane = Drive(motion.curve, motion.speed, sideslip_rad=motion.sideslip_rad, start_m=0.7)
    swung = Swaying(plane, motion.height_m, motion.roll_rad, motion.pitch_rad).at(at.t_s)
    for item in dataclasses.fields(Kinematics):
        np.testing.assert_array_equal(getattr(swung, item.name), getattr(at, item.name))


@pytest.mark.parametrize("name", ["figure-eight ramp", "lanes waves-with-stops", "disturbed", "swaying chain"])
def test_motions_stand_still_outside(name: str) -> None:
    motion = MOTIONS[name]
    last = motion.duration_s
    for inside, outside in ((0.0, -1.0), (last, last + 1.0)):
        still, edge = motion.at(np.array([outside])), motion.at(np.array([inside]))
        np.testing.assert_array_equal(still.poses, edge.poses)
        np.testing.assert_array_equal(still.position_m, edge.position_m)
        np.testing.assert_array_equal(still.world_r_body, edge.world_r_body)
        for name in ("velocity_mps", "acceleration_mps2", "angular_velocity_radps", "angular_acceleration_radps2"):
            assert np.all(getattr(still, name) == 0), name
    if name == "figure-eight ramp":
        assert np.hypot(*motion.at(np.array([last])).velocity_mps[0, :2]) == pytest.approx(2.2)


def test_drives_beyond_the_end_of_a_curve_are_refused() -> None:
    far = speed("constant", speed_mps=10.0, duration_s=60.0)
    with pytest.raises(ValueError, match=r"to 600 m of a curve of \d+"):
        Drive(CURVES["lanes"], far)
    with pytest.raises(ValueError, match="from -600 m"):
        Drive(CURVES["open-spline"], far.backwards())
    with pytest.raises(ValueError, match="from 0 m to 50 m"):
        ways.follow(CURVES["polyline"], np.ones(50))
    whole = speed("trapezoid", distance_m=CURVES["lanes"].length_m, speed_mps=1.0)
    end = Drive(CURVES["lanes"], whole).at(np.array([whole.duration_s]))
    np.testing.assert_allclose(end.poses[0, :2], [1.2, 3.2], atol=1e-9)


def test_turns_on_the_spot() -> None:
    turn = Turn(-math.pi / 2, 2.0)
    at = turn.at(np.linspace(0, 2, 401))
    assert np.all(at.position_m == 0)
    assert at.heading_rad[-1] == pytest.approx(-math.pi / 2)
    assert np.max(np.abs(at.angular_velocity_radps)) == pytest.approx(1.875 * math.pi / 4)
    with pytest.raises(ValueError, match="some time"):
        Turn(1.0, 0.0)


def test_chains_join_their_parts() -> None:
    run = Drive(curve("line"), speed("trapezoid", distance_m=2.0, speed_mps=1.0))
    square = Chain([run, Turn(math.pi / 2, 1.0)] * 4)
    assert square.duration_s == pytest.approx(4 * (run.duration_s + 1))
    end = square.at(np.array([square.duration_s, square.duration_s + 5]))
    np.testing.assert_allclose(end.poses, np.tile([0, 0, 2 * np.pi], (2, 1)), atol=1e-12)
    corner = square.at(np.array([run.duration_s, 2 * run.duration_s + 1]))
    np.testing.assert_allclose(corner.poses, [[2, 0, 0], [2, 2, np.pi / 2]], atol=1e-12)
    circle = Drive(curve("circle"), speed("constant", speed_mps=1.0, duration_s=1.0))
    with pytest.raises(ValueError, match="another angular velocity"):
        Chain([circle, Drive(curve("line"), speed("constant", speed_mps=1.0, duration_s=1.0))])
    with pytest.raises(ValueError, match="another velocity"):
        Chain([circle, stop(1.0)])
    with pytest.raises(ValueError, match="another height"):
        Chain([run, Swaying(run, height_m=0.1)])
    with pytest.raises(ValueError, match="roll and pitch"):
        Chain([run, Swaying(run, roll_rad=0.1)])
    with pytest.raises(ValueError, match="no motions"):
        Chain([])
    short = [Drive(curve("circle"), speed("constant", speed_mps=1.0, duration_s=t)) for t in (0.1, 0.2)]
    moving = Chain(short)  # 0.1 + 0.2 - 0.1 > 0.2 in floating point, and yet it has not ended
    assert np.hypot(*moving.at(np.array([moving.duration_s])).velocity_mps[0, :2]) == pytest.approx(1)
    moving = Chain([circle, circle])
    assert moving.at(np.array([2.0])).velocity_mps[0] == pytest.approx([math.cos(2 / 1.2), math.sin(2 / 1.2), 0])


def test_disturbances_move_turn_and_lift_and_let_go() -> None:
    base = swaying_drive("figure-eight", "jitter")
    t = np.linspace(0, 3, 301)
    still = base.at(t)
    push = ShiftJump(start_s=1.0, stop_s=2.0, forward_m=0.02, left_m=0.05, ramp_s=0.1)
    pushed = Disturbed(base, [push]).at(t)
    heading = float(base.at(np.array([1.0])).heading_rad[0])
    vector = [0.02 * np.cos(heading) - 0.05 * np.sin(heading), 0.02 * np.sin(heading) + 0.05 * np.cos(heading), 0]
    held, free = (t >= 1.1) & (t <= 1.9), (t <= 1.0) | (t >= 2.0)
    np.testing.assert_allclose(
        (pushed.position_m - still.position_m)[held], np.tile(vector, (held.sum(), 1)), atol=1e-14
    )
    np.testing.assert_array_equal(pushed.world_r_body, still.world_r_body)
    turned = Disturbed(base, [TurnJump(start_s=1.0, stop_s=2.0, turn_rad=0.3, ramp_s=0.1)]).at(t)
    np.testing.assert_allclose((turned.heading_rad - still.heading_rad)[held], 0.3, atol=1e-14)
    np.testing.assert_array_equal(turned.position_m, still.position_m)
    lifted = Disturbed(base, [HeightChange(start_s=1.0, stop_s=2.0, lift_m=0.4, ramp_s=0.1)]).at(t)
    np.testing.assert_allclose(
        (lifted.position_m - still.position_m)[held], np.tile([0, 0, 0.4], (held.sum(), 1)), atol=1e-14
    )
    for disturbed in (pushed, turned, lifted):
        for item in dataclasses.fields(Kinematics):
            np.testing.assert_array_equal(getattr(disturbed, item.name)[free], getattr(still, item.name)[free])
    with pytest.raises(ValueError, match=r"height-change from 1 s to 1.5 s with ramps of 0.5 s"):
        Disturbed(base, [HeightChange(start_s=1.0, stop_s=1.5, lift_m=0.4)])


def test_a_push_goes_where_the_turned_body_looks() -> None:
    faults = [
        ShiftJump(start_s=1.0, stop_s=2.0, forward_m=1.0),
        TurnJump(start_s=0.5, stop_s=2.5, turn_rad=math.pi / 2),
    ]
    at = Disturbed(stop(3.0), faults).at(np.array([1.5]))
    np.testing.assert_allclose(at.poses[0], [0, 1, math.pi / 2], atol=1e-12)


# -------------------------------------------------------------------- contract: points, mounts


def test_other_points_of_the_body_move_rigidly() -> None:
    motion, point, h = MOTIONS["disturbed"], np.array([0.3, -0.1, 0.2]), 2e-5
    edges = smooth_between(motion)
    t = (edges[:-1] + edges[1:])[np.diff(edges) > 8 * h] / 2
    here, before, after = (motion.at(x).at_point(point) for x in (t, t - h, t + h))
    np.testing.assert_allclose(here.velocity_mps, (after.position_m - before.position_m) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(here.acceleration_mps2, (after.velocity_mps - before.velocity_mps) / (2 * h), atol=2e-5)
    np.testing.assert_allclose(here.position_m - motion.at(t).position_m, here.world_r_body @ point, atol=1e-14)
    np.testing.assert_array_equal(here.at_point(-point).angular_velocity_radps, here.angular_velocity_radps)
    np.testing.assert_allclose(here.at_point(-point).acceleration_mps2, motion.at(t).acceleration_mps2, atol=1e-12)


def test_cameras_hang_as_they_are_told() -> None:
    at = MOTIONS["figure-eight jitter"].at(np.linspace(0, 3, 20))
    place = np.array([0.1, 0.0, 0.05])
    rigid, levelled, gimballed = (Mount(place, NADIR, hold).world_t_camera(at) for hold in Hold)
    for _, position in (rigid, levelled, gimballed):
        np.testing.assert_allclose(position, at.position_m + at.world_r_body @ place, atol=1e-15)
    np.testing.assert_allclose(rigid[0], at.world_r_body @ NADIR, atol=1e-15)
    assert np.min(levelled[0][:, 2, 2]) == -1  # straight down
    np.testing.assert_allclose(np.arctan2(levelled[0][:, 1, 0], levelled[0][:, 0, 0]), at.heading_rad, atol=1e-12)
    np.testing.assert_allclose(gimballed[0], np.tile(NADIR, (20, 1, 1)), atol=0)


def test_cameras_look_where_they_are_turned() -> None:
    np.testing.assert_allclose(FORWARD @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_allclose(NADIR @ [1, 0, 0], [1, 0, 0])
    np.testing.assert_allclose(looking(FORWARD, pitch_rad=math.pi / 2) @ [0, 0, 1], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(looking(FORWARD, yaw_rad=math.pi / 2) @ [0, 0, 1], [0, 1, 0], atol=1e-15)


def test_rotations_turn_by_the_right_hand() -> None:
    h, p, r = np.random.default_rng(0).uniform(-1, 1, (3, 5))
    expected = Rotation.from_euler("ZYX", np.column_stack([h, p, r])).as_matrix()
    np.testing.assert_allclose(rotations(h, p, r), expected, atol=1e-15)
    np.testing.assert_allclose(
        rotations(h, np.zeros(1), np.zeros(1)) @ [1, 0, 0], np.column_stack([np.cos(h), np.sin(h), 0 * h])
    )


def test_waypoints_go_straight_between_poses() -> None:
    t_s = np.array([0.0, 1.0, 3.0])
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5], [1.0, 4.0, 3.0]])
    way = Waypoints(t_s, poses, height_m=np.array([0.2, 0.3, 0.3]), roll_rad=np.array([0.0, 0.1, 0.3]), pitch_rad=0.05)
    assert way.duration_s == 3
    np.testing.assert_array_equal(way.at(t_s).poses, poses)
    t, h = np.array([0.25, 0.8, 1.7, 2.9]), 1e-6
    here, before, after = way.at(t), way.at(t - h), way.at(t + h)
    np.testing.assert_allclose(here.velocity_mps, (after.position_m - before.position_m) / (2 * h), atol=1e-8)
    turn = here.world_r_body.swapaxes(1, 2) @ (after.world_r_body - before.world_r_body) / (2 * h)
    rates = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=-1)
    np.testing.assert_allclose(here.angular_velocity_radps, rates, atol=1e-8)
    outside = way.at(np.array([-1.0, 9.0]))
    np.testing.assert_array_equal(outside.poses, poses[[0, 2]])
    assert not np.any(outside.velocity_mps)
    assert not np.any(outside.angular_velocity_radps)
    with pytest.raises(ValueError, match="for 3 poses"):
        Waypoints(t_s, poses, height_m=np.zeros(2))
    with pytest.raises(ValueError, match=r"\[2, 3\] is needed"):
        Waypoints(t_s[:2], poses)
