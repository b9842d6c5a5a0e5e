"""A flight held against its plan: how far beside it, and how much of it was flown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString

from pipelines.patrol.plan import Plan

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Beside:
    """Where n flown places lie against the plan's lines.

    Attributes:
        cross_m: distance from the nearest line [n], positive to the left of it in its sense of flight.
        leg: number of that line's leg [n], counted over all flights.
        sweeping: whether that leg is a pass [n].
    """

    cross_m: Floats
    leg: NDArray[np.int64]
    sweeping: NDArray[np.bool_]


def beside(points: Floats, plan: Plan) -> Beside:
    """Cross-track errors of flown places [n, 2]."""
    legs = [leg for flight in plan.flights for leg in flight.legs]
    starts = np.concatenate([leg.points[:-1] for leg in legs])
    ways = np.concatenate([np.diff(leg.points, axis=0) for leg in legs])
    owner = np.repeat(np.arange(len(legs)), [len(leg.points) - 1 for leg in legs])
    squared = np.maximum((ways**2).sum(axis=1), 1e-12)
    cross, leg = np.empty(len(points)), np.empty(len(points), np.int64)
    for n, point in enumerate(points):
        offset = point - starts
        at = np.clip((offset * ways).sum(axis=1) / squared, 0, 1)
        away = offset - at[:, None] * ways
        k = int(np.argmin((away**2).sum(axis=1)))
        left = ways[k, 0] * offset[k, 1] - ways[k, 1] * offset[k, 0]
        cross[n] = np.copysign(np.hypot(*away[k]), left)
        leg[n] = owner[k]
    return Beside(cross, leg, np.array([one.sweeping for one in legs])[leg])


def flown_shares(points: Floats, plan: Plan, within_m: float) -> Floats:
    """Share of each pass [n] that the flown path [m, 2] came within a distance of."""
    near = LineString(points).buffer(within_m)
    shapely.prepare(near)
    lines = [LineString(line) for line in plan.passes]
    return np.array([line.intersection(near).length / line.length for line in lines])
