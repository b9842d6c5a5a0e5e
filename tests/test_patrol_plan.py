"""Planned patrols: all that can be reached is swept, nothing is crossed, and every number has a second source."""

import itertools
import math
import os

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from shapely.geometry import LineString, Point, Polygon, box

from pipelines.patrol import spirals, turns
from pipelines.patrol.area import Area
from pipelines.patrol.flight import motion, picture_spacing, trigger_times
from pipelines.patrol.lanes import Strip, best_direction, lane_offsets, lanes, swept
from pipelines.patrol.order import ordered, shares
from pipelines.patrol.plan import Plan, Task, account, snake
from pipelines.patrol.roads import Roads, inward_corners
from pipelines.patrol.vehicle import Vehicle, corner_count

NEAR = 1e-5
EXAMPLES = int(os.environ.get("PATROL_EXAMPLES", "30"))


def star(radii: list[float], turn: float) -> Polygon:
    """A polygon with corners at those distances from the origin, evenly around it."""
    angle = turn + np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    return Polygon(np.array(radii)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


@st.composite
def tasks(draw: st.DrawFn) -> Task:
    """Areas with up to one hole and two no-go zones, and any way of flying over them on the spot."""
    radii = draw(st.lists(st.floats(20, 120), min_size=3, max_size=9))
    shape = star(radii, draw(st.floats(0, 6)))
    if draw(st.booleans()):
        x, y = draw(st.floats(-40, 40)), draw(st.floats(-40, 40))
        shape = shape.difference(box(x, y, x + draw(st.floats(3, 30)), y + draw(st.floats(3, 30))))
    zones = [
        shapely.affinity.translate(star(draw(st.lists(st.floats(3, 20), min_size=3, max_size=5)), 0.3), x, y)
        for x, y in draw(st.lists(st.tuples(st.floats(-60, 60), st.floats(-60, 60)), max_size=2))
    ]
    strip = Strip(draw(st.floats(8, 40)), draw(st.floats(0, 10)), draw(st.floats(0, 0.7)))
    clearance = draw(st.floats(0, 3))
    assume(shape.buffer(-1.1 * clearance - 0.1).difference(shapely.union_all([z.buffer(5) for z in zones])).area > 1)
    area = Area(shape, tuple(zones), clearance)
    assume(area.reachable(strip.swath_m).area > 50)
    wind = draw(st.tuples(st.floats(-3, 3), st.floats(-3, 3)))
    vehicle = Vehicle(5.0, draw(st.floats(0, 4)), 0.0, wind)
    direction = draw(st.none() | st.floats(0, 3))
    cut = any(zone.buffer(4).intersects(shape.exterior if shape.geom_type == "Polygon" else shape) for zone in zones)
    home = None if cut else draw(st.none() | st.just((-200.0, 10.0)))
    return Task(area, strip, vehicle, direction, draw(st.integers(1, 4)), home)


def seen_by(passes: list[np.ndarray], strip: Strip, points: np.ndarray) -> np.ndarray:
    """Which points a bar sweeps that is drawn along passes and turned in their corners; without any polygon."""
    seen = np.zeros(len(points), dtype=bool)
    half = strip.swath_m / 2 + NEAR
    for line in passes:
        for k, (start, stop) in enumerate(itertools.pairwise(line)):
            way = (stop - start) / np.hypot(*(stop - start))
            along, across = (points - start) @ way, (points - start) @ np.array([-way[1], way[0]])
            low = -strip.along_m / 2 if k == 0 else 0.0
            high = np.hypot(*(stop - start)) + (strip.along_m / 2 if k == len(line) - 2 else 0.0)
            seen |= (np.abs(across) <= half) & (along >= low - NEAR) & (along <= high + NEAR)
        for before, corner, after in zip(line, line[1:], line[2:], strict=False):
            into, out = corner - before, after - corner
            offset = points - corner
            beyond = (offset @ into > 0) & (offset @ out < 0)
            seen |= beyond & (np.hypot(*offset.T) <= half)
    return seen


@settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
@given(tasks(), st.integers(0, 2**31))
def test_a_random_area_is_swept_and_nothing_is_left_or_crossed(task: Task, seed: int) -> None:
    plan = snake(task)
    area = task.area

    points = np.random.default_rng(seed).uniform(-130, 130, (6000, 2))
    target = shapely.contains_xy(area.target, *points.T)
    near = shapely.distance(area.allowed, shapely.points(points)) <= task.strip.swath_m / 2
    points = points[target & near]
    if len(points) >= 200:
        assert seen_by(plan.passes, task.strip, points).mean() >= 0.995
    costs = account(plan)
    assert costs.covered_reachable_share >= 0.995

    outer = shapely.union_all([Polygon(p.exterior) for p in getattr(area.polygon, "geoms", [area.polygon])])
    for flight in plan.flights:
        for leg in flight.legs:
            line = LineString(leg.points)
            assert all(line.distance(zone) >= area.clearance_m - NEAR for zone in area.no_go)
            inner = line if task.home is None or leg.sweeping else None
            if inner is not None:
                assert outer.buffer(NEAR).covers(inner)
                assert inner.distance(outer.boundary) >= area.clearance_m - NEAR
            assert all(line.intersection(zone.buffer(-NEAR)).is_empty for zone in area.no_go)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(1, 300), st.floats(2, 60), st.floats(0, 0.9))
def test_lanes_overlap_as_stated_and_reach_both_borders(height: float, width: float, overlap: float) -> None:
    strip = Strip(width, 0.0, overlap)
    offsets = lane_offsets(0.0, height, strip)
    assert offsets[0] <= width / 2 + 1e-9
    assert offsets[-1] >= height - width / 2 - 1e-9
    assert np.all(np.diff(offsets) <= width * (1 - overlap) + 1e-6)
    fewer = len(offsets) - 1
    assert fewer == 0 or width + (fewer - 1) * width * (1 - overlap) < height + 1e-6


def test_lanes_of_a_square_are_those_of_the_paper_but_for_their_steps() -> None:
    plan = snake(Task(Area.square(), Strip(15.0), Vehicle(3.0, turn_s=2.0)))
    costs = account(plan)
    assert costs.passes == 7
    assert costs.turns == 12
    assert costs.length_m == pytest.approx(700 + 85)
    assert costs.time_s == pytest.approx(785 / 3 + 24)
    assert costs.covered_share == pytest.approx(1)
    assert costs.useful_m2_per_m == pytest.approx(10_000 / 785)


def test_lanes_lie_along_the_longer_side_wherever_it_points() -> None:
    for angle in (0.0, 0.4, 1.9):
        field = shapely.affinity.rotate(box(0, 0, 200, 70), angle, use_radians=True)
        assert best_direction(Area(field), Strip(20.0)) % math.pi == pytest.approx(angle % math.pi, abs=1e-6)
        assert len(lanes(Area(field), Strip(20.0), angle)) == 4


def test_a_hole_may_be_flown_over_and_a_zone_not() -> None:
    middle = box(40, 40, 60, 60)
    over = snake(Task(Area(box(0, 0, 100, 100).difference(middle)), Strip(15.0), direction_rad=0.0))
    round_ = snake(Task(Area(box(0, 0, 100, 100), (middle,)), Strip(15.0), direction_rad=0.0))
    assert any(LineString(f.points).intersects(middle.buffer(-0.1)) for f in over.flights)
    assert not any(LineString(f.points).intersects(middle.buffer(-NEAR)) for f in round_.flights)
    assert account(over).length_m < account(round_).length_m


def test_zones_that_cut_the_area_make_flights_of_their_own() -> None:
    area = Area(box(0, 0, 100, 50), (box(45, -1, 55, 51),))
    plan = snake(Task(area, Strip(12.0)))
    assert len(plan.flights) == 2
    sides = [np.sign(flight.points[:, 0] - 50) for flight in plan.flights]
    assert all(np.all(side == side[0]) for side in sides)
    assert account(plan).covered_reachable_share >= 0.999


def test_vehicles_share_the_time() -> None:
    area = Area.square(200.0)
    one, three = (snake(Task(area, Strip(15.0), Vehicle(4.0), vehicles=n, home=(0.0, 0.0))) for n in (1, 3))
    assert len(three.flights) == 3
    assert account(three).time_s < account(one).time_s / 2
    assert account(three).time_all_s > account(one).time_all_s
    for flight in three.flights:
        assert flight.points[0].tolist() == [0.0, 0.0]
        assert flight.points[-1].tolist() == [0.0, 0.0]
    assert len(three.passes) == len(one.passes)


def test_shares_are_the_best_cuts() -> None:
    rng = np.random.default_rng(4)
    for count in (1, 2, 3, 9):
        p, j, out, home = rng.uniform(1, 9, 6), rng.uniform(0, 3, 5), rng.uniform(0, 5, 6), rng.uniform(0, 5, 6)

        def worst(cuts: tuple[int, ...], p=p, j=j, out=out, home=home) -> float:
            parts = itertools.pairwise((0, *cuts, 6))
            return max(p[a:b].sum() + j[a : b - 1].sum() + out[a] + home[b - 1] for a, b in parts)

        every = (c for k in range(min(count, 6)) for c in itertools.combinations(range(1, 6), k))
        found = shares(p, j, out, home, count)
        assert [k for part in found for k in part] == list(range(6))
        assert worst(tuple(part.start for part in found[1:])) == pytest.approx(min(map(worst, every)))


def test_the_order_of_few_passes_is_nearly_the_best() -> None:
    rng = np.random.default_rng(7)
    ratios = []
    for _ in range(10):
        ends = rng.uniform(0, 100, (10, 2))
        between = np.hypot(*(ends[None] - ends[:, None]).transpose(2, 0, 1))

        def cost(tour: list[tuple[int, bool]], between=between) -> float:
            return sum(between[2 * a + (not f), 2 * b + g] for (a, f), (b, g) in itertools.pairwise(tour))

        every = (
            list(zip(order, senses, strict=True))
            for order in itertools.permutations(range(5))
            for senses in itertools.product((False, True), repeat=5)
        )
        found = ordered(between, np.ones((5, 2)))
        assert sorted(k for k, _ in found) == list(range(5))
        ratios.append(cost(found) / min(map(cost, every)))
    assert np.median(ratios) < 1.05
    assert max(ratios) < 1.3


# ------------------------------------------------------------------------------- ways


def test_the_way_round_a_block_is_the_shorter_one() -> None:
    region = box(0, 0, 10, 10).difference(box(4, 2, 6, 9))
    roads = Roads(region, np.array([[1.0, 3.0], [9.0, 3.0], [1.0, 1.0]]), Vehicle(2.0))
    length = math.hypot(3, 1) + 2 + math.hypot(3, 1)
    assert roads.seconds[0, 1] == pytest.approx(length / 2)
    assert roads.way(0, 1).tolist() == [[1, 3], [4, 2], [6, 2], [9, 3]]
    assert roads.seconds[0, 2] == pytest.approx(1)
    assert len(inward_corners(region)) == 4
    assert len(inward_corners(box(0, 0, 1, 1))) == 0


def test_ground_speed_is_that_of_the_wind_triangle() -> None:
    vehicle = Vehicle(5.0, wind_mps=(3.0, 0.0))
    ways = np.array([[2.0, 0], [-2.0, 0], [0, 7.0]])
    assert vehicle.ground_speed(ways).tolist() == pytest.approx([8, 2, 4])
    assert vehicle.travel_s(ways).tolist() == pytest.approx([2 / 8, 1, 7 / 4])
    rng = np.random.default_rng(0)
    for way in rng.normal(size=(20, 2)):
        air = vehicle.ground_speed(way) * way / np.hypot(*way) - np.array(vehicle.wind_mps)
        assert np.hypot(*air) == pytest.approx(5)


def test_a_corner_costs_time_and_a_straight_joint_does_not() -> None:
    points = np.array([[0.0, 0], [5, 0], [10, 0], [10, 5], [10, 5], [10, 0]])
    assert corner_count(points) == 2
    assert Vehicle(1.0, turn_s=3.0).duration_s(points) == pytest.approx(20 + 6)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(*[st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3)) for _ in range(2)], st.floats(0.2, 3))
def test_arcs_lead_where_they_should(start: tuple, goal: tuple, radius: float) -> None:
    start, goal = np.array(start), np.array(goal)
    assume(np.hypot(*(goal - start)[:2]) > 1e-3)
    ways = list(turns.ways(start, goal, radius))
    for way in ways:
        assert way[-1] == pytest.approx(goal[:2], abs=1e-5)
        assert way[0] == pytest.approx(start[:2])
        steps = np.diff(way, axis=0)
        steps = steps[np.hypot(*steps.T) > 1e-6]
        bend = (np.diff(np.arctan2(steps[:, 1], steps[:, 0])) + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(bend).max(initial=0) < 2.1 * turns.STEP_RAD
        end = math.atan2(steps[-1, 1], steps[-1, 0])
        assert abs((end - goal[2] + np.pi) % (2 * np.pi) - np.pi) < 1.1 * turns.STEP_RAD
    length = LineString(ways[0]).length
    assert turns.lengths(start, goal, radius) == pytest.approx(length, rel=1e-3, abs=1e-3)


def test_arcs_of_known_length() -> None:
    start = np.zeros(3)
    known = {(5.0, 0.0, 0.0): 5.0, (0.0, 4.0, math.pi): 2 * math.pi, (1e-9, 0.0, math.pi): 14 * math.pi / 3}
    for goal, length in known.items():
        assert turns.lengths(start, np.array(goal), 2.0) == pytest.approx(length, abs=1e-6)
    back = next(turns.ways(start, np.array([1e-9, 0.0, math.pi]), 2.0))
    assert back[:, 0].max() == pytest.approx(2 * (1 + math.sqrt(3)), abs=1e-2)


def test_a_vehicle_that_flies_arcs_never_turns_sharply_and_keeps_off_the_zones() -> None:
    zone = box(60, 60, 80, 80)
    task = Task(Area(box(0, 0, 200, 200), (zone,), 2.0), Strip(30.0), Vehicle(10.0, turn_radius_m=8.0), run_out_m=25.0)
    plan = snake(task)
    for flight in plan.flights:
        assert corner_count(flight.points) > 0
        steps = np.diff(flight.points, axis=0)
        bend = (np.diff(np.arctan2(steps[:, 1], steps[:, 0])) + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(bend).max() < 2.5 * turns.STEP_RAD
        assert LineString(flight.points).distance(zone) >= 2 - NEAR
        assert box(-25, -25, 225, 225).contains(LineString(flight.points))
    costs = account(plan)
    assert costs.covered_reachable_share >= 0.995
    assert costs.reachable_share < 1


def test_what_cannot_be_planned_says_so() -> None:
    square = box(0, 0, 10, 10)
    with pytest.raises(ValueError, match="no simple polygon"):
        Area(Polygon([(0, 0), (1, 1), (1, 0), (0, 2)]))
    with pytest.raises(ValueError, match="leave no place to fly"):
        Area(square, clearance_m=6.0)
    with pytest.raises(ValueError, match="upwind"):
        Vehicle(3.0, wind_mps=(0.0, 3.0))
    with pytest.raises(ValueError, match="overlap of 1"):
        Strip(3.0, overlap=1.0)
    with pytest.raises(ValueError, match="at least one"):
        Task(Area(square), Strip(3.0), vehicles=0)
    with pytest.raises(ValueError, match="home"):
        snake(Task(Area(square, (box(-9, -9, -5, -5),)), Strip(3.0), home=(-7.0, -7.0)))


# ----------------------------------------------------------------------------- paper C


def test_table_2_is_the_papers_within_half_a_percent() -> None:
    for row in spirals.table_2():
        ours = (row.length_m, row.area_m2, row.time_min)
        assert ours == pytest.approx(row.printed, rel=0.005), row.name


def test_what_the_papers_paths_really_sweep() -> None:
    x, y = np.meshgrid(*[np.arange(-30, 130, 0.5) + 0.25] * 2)
    rows = spirals.table_2()
    for row, outermost in zip(rows[1:], (70.5, 50.0), strict=True):
        way = spirals.spiral((50, 50), outermost, 15.0)
        assert LineString(way).length == pytest.approx(row.length_m, rel=3e-4)
        rings = [abs(np.hypot(x - 50, y - 50) - r) < 7.5 for r in spirals.radii(outermost, 15.0)]
        inwards = (abs(y - 50) < 7.5) & (x > 50) & (x < 50 + outermost)
        assert (np.any(rings, axis=0) | inwards).sum() / 4 == pytest.approx(row.swept_m2, rel=2e-3)
    snake_, one, two = rows
    assert snake_.square_share == pytest.approx(1)
    assert one.swept_m2 == pytest.approx(19_087, rel=2e-3)
    assert (one.square_share, two.square_share) == pytest.approx((0.997, 0.924), abs=2e-3)
    assert [row.length_m for row in spirals.pulled_in()] == pytest.approx([1121.6, 575.9], abs=0.1)


def test_a_bar_along_the_spiral_sweeps_its_strip() -> None:
    way = spirals.spiral((0.0, 0.0), 20.0, 15.0)[1:]
    assert swept(way, 15.0).area == pytest.approx(spirals.spiral_strip((0.0, 0.0), 20.0, 15.0).area, rel=5e-3)


def test_a_bar_drawn_round_a_small_circle_sweeps_its_middle_too() -> None:
    angle = np.linspace(0, 2 * np.pi, 60)
    ring = 3.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert swept(ring, 15.0).area == pytest.approx(math.pi * 10.5**2, rel=0.01)
    assert swept(ring, 15.0).contains(Point(0, 0))


# ------------------------------------------------------------------------------ flight


def flown() -> tuple[Plan, float]:
    return snake(Task(Area.square(40.0), Strip(15.0), Vehicle(3.0), direction_rad=0.3)), 3.0


def test_a_planned_flight_is_a_motion_through_its_way_points() -> None:
    plan, speed = flown()
    flight = plan.flights[0]
    moving = motion(flight, speed_mps=speed)
    t_s = np.linspace(0, moving.duration_s, 4000)
    path = moving.at(t_s)
    assert path.position_m[0, :2] == pytest.approx(flight.points[0])
    assert path.position_m[-1, :2] == pytest.approx(flight.points[-1], abs=1e-6)
    places = shapely.points(path.position_m[:, :2])
    assert shapely.distance(LineString(flight.points), places).max() < 1e-6
    assert all(np.hypot(*(path.position_m[:, :2] - point).T).min() < 0.05 for point in flight.points)
    assert np.hypot(*path.velocity_mps[:, :2].T).max() == pytest.approx(speed, rel=1e-6)
    moving_on = np.hypot(*path.velocity_mps[:, :2].T) > 0.1
    course = np.arctan2(path.velocity_mps[:, 1], path.velocity_mps[:, 0])
    off = (course - path.heading_rad + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off[moving_on]).max() < 1e-6


def test_pictures_are_taken_by_distance() -> None:
    plan, speed = flown()
    moving = motion(plan.flights[0], speed_mps=speed)
    times = trigger_times(moving, picture_spacing(10.0, 0.6))
    gone = [LineString(plan.flights[0].points).length]
    assert len(times) == math.floor(gone[0] / 4.0 + 1e-6) + 1 or len(times) == math.floor(gone[0] / 4.0)
    with pytest.raises(ValueError, match="share below 1"):
        picture_spacing(10.0, 1.0)
