"""Ways between two places that stay within a region: the shortest in time, by a graph of what sees what."""

from __future__ import annotations

import numpy as np
import scipy.sparse.csgraph
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from pipelines.patrol.area import EASE_M
from pipelines.patrol.vehicle import Vehicle

Floats = NDArray[np.float64]
NO_WAY = -9999
"""The predecessor of a node that cannot be reached, of scipy's."""


class Roads:
    """The quickest ways between places of a region; they bend only at its inward corners.

    Args:
        region: where the vehicle may be.
        places: places [n, 2] in it.
        vehicle: how fast it is, which depends on the wind.

    Attributes:
        seconds: travelling time from place to place [n, n]; infinite where no way leads.
    """

    def __init__(self, region: Polygon, places: Floats, vehicle: Vehicle) -> None:
        self._nodes = np.concatenate([places, inward_corners(region)])
        ways = self._nodes[None] - self._nodes[:, None]
        time = vehicle.travel_s(ways)
        time[~self._visible(region)] = np.inf
        np.fill_diagonal(time, 0.0)
        graph = scipy.sparse.csgraph.csgraph_from_dense(time, null_value=np.inf)
        indices = np.arange(len(places))
        found, self._before = scipy.sparse.csgraph.dijkstra(graph, indices=indices, return_predecessors=True)
        self.seconds: Floats = found[:, : len(places)]

    def _visible(self, region: Polygon) -> NDArray[np.bool_]:
        """Which nodes see one another [m, m]."""
        eased = region.buffer(EASE_M, join_style="mitre")
        shapely.prepare(eased)
        one, other = np.triu_indices(len(self._nodes), 1)
        lines = shapely.linestrings(np.stack([self._nodes[one], self._nodes[other]], axis=1))
        seen = np.eye(len(self._nodes), dtype=bool)
        seen[one, other] = seen[other, one] = shapely.covers(eased, lines)
        return seen

    def way(self, start: int, stop: int) -> Floats:
        """The quickest way [k, 2] from one place to another, both included.

        Raises:
            ValueError: no way leads there.
        """
        nodes = [stop]
        while nodes[-1] != start:
            before = int(self._before[start, nodes[-1]])
            if before == NO_WAY:
                raise ValueError("no way within the area leads there")
            nodes.append(before)
        return np.asarray(self._nodes[nodes[::-1]])


def inward_corners(region: Polygon) -> Floats:
    """The corners [n, 2] of a region that a shortest way can bend at: those that reach into it."""
    found = [np.zeros((0, 2))]
    oriented = shapely.orient_polygons(region)
    for ring in (oriented.exterior, *oriented.interiors):
        points = np.array(ring.coords)[:-1]
        into, out = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        found.append(points[into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0] < 0])
    return np.concatenate(found)
