"""A patrol's plan: which passes, in which order, by which vehicle; and what it costs and sweeps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from pipelines.patrol import turns
from pipelines.patrol.area import EASE_M, Area, parts
from pipelines.patrol.lanes import Strip, best_direction, border_passes, lanes
from pipelines.patrol.order import ordered, shares
from pipelines.patrol.roads import Roads
from pipelines.patrol.vehicle import Vehicle, corner_count

Floats = NDArray[np.float64]

WIDEST_TURN = 1 + math.sqrt(3)
"""How far a turn to the opposite heading reaches ahead at most, in radii: that on the spot, RLR."""


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A polyline [n, 2] that is flown; `sweeping` where it is a pass, not a way between two."""

    points: Floats
    sweeping: bool


@dataclass(frozen=True, slots=True)
class Flight:
    """What one vehicle flies from take-off to landing."""

    legs: tuple[Leg, ...]

    @property
    def points(self) -> Floats:
        """All way points [n, 2], none twice in a row."""
        joined = np.concatenate([leg.points for leg in self.legs])
        new = np.hypot(*np.diff(joined, axis=0).T) > EASE_M
        return np.asarray(joined[np.concatenate([[True], new])])

    @property
    def length_m(self) -> float:
        """Length of the way."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked for.

    Attributes:
        area: what is to be seen and where the vehicle may be.
        strip: what the camera sweeps.
        vehicle: how it flies.
        direction_rad: direction of the lanes, counter-clockwise from +x; None for the one with the fewest.
        vehicles: how many fly at once.
        home: where all take off and land (x, y); None if flights begin and end at their passes.
        run_out_m: how far beyond the area arcs of a turn may lead.

    Raises:
        ValueError: no vehicle, or a negative run-out.
    """

    area: Area
    strip: Strip
    vehicle: Vehicle = field(default_factory=Vehicle)
    direction_rad: float | None = None
    vehicles: int = 1
    home: tuple[float, float] | None = None
    run_out_m: float = 0.0

    def __post_init__(self) -> None:
        if self.vehicles < 1:
            raise ValueError(f"{self.vehicles} vehicles: at least one must fly")
        if not 0 <= self.run_out_m < math.inf:
            raise ValueError(f"a run-out of {self.run_out_m:g} m: it must be 0 or more")


@dataclass(frozen=True, slots=True)
class Plan:
    """A task with the flights that fulfil it; `direction_rad` is that of the lanes, NaN where there are none."""

    task: Task
    direction_rad: float
    flights: tuple[Flight, ...]

    @property
    def passes(self) -> list[Floats]:
        """All passes, in the order in which they are flown."""
        return [leg.points for flight in self.flights for leg in flight.legs if leg.sweeping]

    @property
    def swept(self) -> BaseGeometry:
        """The ground that the passes sweep."""
        return shapely.union_all([self.task.strip.swept(line) for line in self.passes])


@dataclass(frozen=True, slots=True)
class Account:
    """What a plan costs and brings.

    Attributes:
        flights: number of flights.
        passes: number of passes.
        turns: corners, or ways between passes of a vehicle that flies arcs.
        length_m: length of all flights.
        sweeping_m: length of the passes in it.
        time_s: of the longest flight.
        time_all_s: of all flights.
        energy_wh: of all flights, NaN where the power is not known.
        target_m2: area that is to be seen.
        reachable_share: share of it within half a swath of where the vehicle may be.
        swept_m2: ground that the passes sweep, within the target or not.
        covered_share: share of the target that is swept.
        covered_reachable_share: share of the reachable target that is swept.
        useful_m2_per_m: swept target per metre flown.
    """

    flights: int
    passes: int
    turns: int
    length_m: float
    sweeping_m: float
    time_s: float
    time_all_s: float
    energy_wh: float
    target_m2: float
    reachable_share: float
    swept_m2: float
    covered_share: float
    covered_reachable_share: float
    useful_m2_per_m: float


def account(plan: Plan) -> Account:
    """What a plan costs and brings."""
    task = plan.task
    times = [task.vehicle.duration_s(flight.points) for flight in plan.flights]
    length = sum(flight.length_m for flight in plan.flights)
    target, reachable, swept = task.area.target, task.area.reachable(task.strip.swath_m), plan.swept
    covered = float(swept.intersection(target).area)
    return Account(
        flights=len(plan.flights),
        passes=len(plan.passes),
        turns=sum(_turns(flight, task.vehicle) for flight in plan.flights),
        length_m=length,
        sweeping_m=float(sum(LineString(line).length for line in plan.passes)),
        time_s=max(times),
        time_all_s=sum(times),
        energy_wh=task.vehicle.power_w * sum(times) / 3600,
        target_m2=float(target.area),
        reachable_share=float(reachable.area / target.area),
        swept_m2=float(swept.area),
        covered_share=covered / float(target.area),
        covered_reachable_share=float(swept.intersection(reachable).area / reachable.area),
        useful_m2_per_m=covered / length,
    )


def _turns(flight: Flight, vehicle: Vehicle) -> int:
    if vehicle.turn_radius_m > 0:
        return sum(not leg.sweeping for leg in flight.legs)
    return corner_count(flight.points)


# ---------------------------------------------------------------------------------- planning


def snake(task: Task) -> Plan:
    """Parallel lanes, forth and back, and passes along the border where they leave something out.

    Where no-go zones or the clearance cut the area in parts, no flight leads from one to another: there are at
    least as many flights as parts. A vehicle that flies arcs keeps as far from zones, and from the border as far as
    the run-out does not give it, as its widest turn reaches: the area of the plan's task says so.

    Raises:
        ValueError: nothing can be seen from where the vehicle may be, or a turn does not fit.
    """
    task = _with_room(task)
    direction = best_direction(task.area, task.strip) if task.direction_rad is None else task.direction_rad
    lines = lanes(task.area, task.strip, direction)
    lines += border_passes(task.area, task.strip, lines)
    if task.vehicle.turn_radius_m > 0:
        lines = [line[k : k + 2] for line in lines for k in range(len(line) - 1)]
    rows = []
    regions = list(parts(task.area.allowed))
    owners = [_owner(line, regions) for line in lines]
    for k, region in enumerate(regions):
        own = [line for line, owner in zip(lines, owners, strict=True) if owner == k]
        rows += [_Row(task, region, own)] if own else []
    if not rows:
        raise ValueError("nothing of the area is within half a swath of where the vehicle may be: take less clearance")
    flights = [
        flight for row, count in zip(rows, _crews(rows, task.vehicles), strict=True) for flight in row.cut(count)
    ]
    return Plan(task, direction, tuple(flights))


def _owner(line: Floats, regions: Sequence[Polygon]) -> int:
    """Which of some regions holds most of a pass."""
    shared = [LineString(line).intersection(region.buffer(EASE_M)).length for region in regions]
    return int(np.argmax(shared))


def _with_room(task: Task) -> Task:
    """The task with room for turns in its area."""
    if not task.vehicle.turn_radius_m:
        return task
    reach = WIDEST_TURN * task.vehicle.turn_radius_m
    area = replace(task.area, border_room_m=max(0.0, reach - task.run_out_m), zone_room_m=reach)
    return replace(task, area=area)


def _crews(rows: Sequence[_Row], vehicles: int) -> list[int]:
    """How many vehicles each part gets: one at least, the others where the longest flight is."""
    crews = [1] * len(rows)
    for _ in range(vehicles - len(rows)):
        longest = max(range(len(rows)), key=lambda k: rows[k].longest_s(crews[k]))
        crews[longest] += 1
    return crews


class _Row:
    """The passes of one connected region, in the order in which they are flown, with the ways between them."""

    def __init__(self, task: Task, region: Polygon, lines: Sequence[Floats]) -> None:
        self._task, self._region = task, region
        ends = np.array([line[end] for line in lines for end in (0, -1)])
        roads = Roads(region, ends, task.vehicle)
        forth_back = np.array([[_travel(task.vehicle, line), _travel(task.vehicle, line[::-1])] for line in lines])
        between = roads.seconds if task.vehicle.turn_radius_m == 0 else _arcs_s(task.vehicle, lines)
        tour = ordered(between, forth_back)
        self.passes = [lines[k][::-1] if back else lines[k] for k, back in tour]
        exits, entries = [2 * k + (not back) for k, back in tour], [2 * k + back for k, back in tour]
        self._joints = [self._joint(k, roads.way(exits[k], entries[k + 1])) for k in range(len(tour) - 1)]
        vehicle = task.vehicle
        self._pass_s = np.array([vehicle.duration_s(line) for line in self.passes])
        self._joint_s = np.array([vehicle.duration_s(line) + 2 * vehicle.turn_s for line in self._joints])
        self._commute()

    def _joint(self, k: int, way: Floats) -> Floats:
        """The way from pass k to the next: on the roads, or in arcs."""
        if self._task.vehicle.turn_radius_m == 0:
            return way
        before, after = self.passes[k], self.passes[k + 1]
        start, goal = _pose(before[-1], before[-1] - before[-2]), _pose(after[0], after[1] - after[0])
        radius, run_out = self._task.vehicle.turn_radius_m, self._task.run_out_m
        room = self._task.area.room(run_out).buffer(EASE_M)
        for arcs in turns.ways(start, goal, radius):
            if room.covers(LineString(arcs)):
                return arcs
        bends = [_pose(at, onto - last) for last, at, onto in zip(way, way[1:], way[2:], strict=False)]
        stops = [start, *bends, goal]
        found = [
            next((arcs for arcs in turns.ways(one, other, radius) if room.covers(LineString(arcs))), None)
            for one, other in itertools.pairwise(stops)
        ]
        whole = [arcs for arcs in found if arcs is not None]
        if len(whole) < len(found):
            x, y = before[-1].tolist()
            raise ValueError(
                f"a turn of radius {radius:g} m at ({x:.1f}, {y:.1f}) m does not fit within {run_out:g} m beyond the "
                "area and off the no-go zones: allow more run-out, a smaller radius or other lanes"
            )
        return np.concatenate(whole)

    def _commute(self) -> None:
        """Ways from home to every pass's begin, and from every end home."""
        count, home, area = len(self.passes), self._task.home, self._task.area
        if home is None:
            self._out_s = self._home_s = np.zeros(count)
            return
        hull = self._region.union(Point(home)).convex_hull.difference(area.forbidden)
        region = next((part for part in parts(hull) if part.buffer(EASE_M).covers(Point(home))), None)
        if region is None:
            raise ValueError(f"home ({home[0]:g}, {home[1]:g}) m is within a no-go zone or its clearance: move it")
        ends = [line[end] for line in self.passes for end in (0, -1)]
        self._roads = Roads(region, np.array([home, *ends]), self._task.vehicle)
        self._out_s, self._home_s = self._roads.seconds[0, 1::2], self._roads.seconds[2::2, 0]
        if not np.isfinite([self._out_s, self._home_s]).all():
            raise ValueError(f"no way leads from home ({home[0]:g}, {home[1]:g}) m to all of the area: move it")

    def _parts(self, count: int) -> list[range]:
        return shares(self._pass_s, self._joint_s, self._out_s, self._home_s, count)

    def longest_s(self, count: int) -> float:
        """Time of the longest flight if so many vehicles share the passes."""
        return max(
            float(self._out_s[part.start] + self._home_s[part.stop - 1] + self._pass_s[part.start : part.stop].sum())
            + float(self._joint_s[part.start : part.stop - 1].sum())
            for part in self._parts(count)
        )

    def cut(self, count: int) -> list[Flight]:
        """The flights of so many vehicles."""
        return [self._flight(part) for part in self._parts(count)]

    def _flight(self, part: range) -> Flight:
        legs = []
        for k in part:
            if k > part.start:
                legs.append(Leg(self._joints[k - 1], sweeping=False))
            legs.append(Leg(self.passes[k], sweeping=True))
        if self._task.home is not None:
            out = self._roads.way(0, 1 + 2 * part.start)
            back = self._roads.way(2 * part.stop, 0)
            legs = [Leg(out, sweeping=False), *legs, Leg(back, sweeping=False)]
        return Flight(tuple(leg for leg in legs if len(leg.points) > 1))


def _pose(point: Floats, way: Floats) -> Floats:
    return np.array([*point, math.atan2(way[1], way[0])])


def _travel(vehicle: Vehicle, line: Floats) -> float:
    return float(vehicle.travel_s(np.diff(line, axis=0)).sum())


def _arcs_s(vehicle: Vehicle, lines: Sequence[Floats]) -> Floats:
    """Time [2n, 2n] from the end of a pass to the begin of another, in arcs, as if there were no wind."""
    headings = [math.atan2(*(line[1] - line[0])[::-1]) for line in lines]
    ends = np.array([[*line[end], h] for line, h in zip(lines, headings, strict=True) for end in (0, -1)])
    turned = ends + np.array([0.0, 0.0, math.pi])
    begin = np.arange(len(ends)) % 2 == 0
    leaving = np.where(begin[:, None], turned, ends)
    entering = np.where(begin[:, None], ends, turned)
    return turns.lengths(leaving[:, None], entering[None], vehicle.turn_radius_m) / vehicle.speed_mps
