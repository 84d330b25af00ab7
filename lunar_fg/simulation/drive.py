"""The drive: a route over waypoints that avoids steep ground, and the rover's pose on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from frontends.geometry import pose
from lunar_fg.simulation.levels import Level
from lunar_fg.simulation.spec import PathSpec
from lunar_fg.simulation.terrain import Extent, GridFrame, Terrain

FloatArray = NDArray[np.float64]

#: A slope that costs as much again as level ground.
_COSTLY_SLOPE = np.tan(np.deg2rad(6.0))
#: The route's corners are rounded over so many metres.
_ROUNDING_M = 2.5
#: No two laps of a circuit are the same: 1-sigma of the way beside the track, and how soon it
#: changes.
_WEAVING_M = 0.3
_WEAVING_LENGTH_M = 4.0
#: Poses are found this close together and thinned to the stereo frames later.
FINE_STEP_M = 0.05


@dataclass(frozen=True, slots=True)
class Drive:
    """True poses along the drive, every few centimetres.

    Attributes
    ----------
    distance_m
        (N,) along the ground.
    map_T_rover
        (N, 4, 4).
    """

    distance_m: FloatArray
    map_T_rover: FloatArray

    def __len__(self) -> int:
        return len(self.distance_m)

    def nearest(self, distance_m: FloatArray) -> NDArray[np.int64]:
        """Indices of the poses next to given distances, increasing."""
        index = np.searchsorted(self.distance_m, distance_m)
        return np.minimum(index, len(self.distance_m) - 1).astype(np.int64)


def region_of(spec: PathSpec) -> Extent:
    """Where the drive can lead: from the map's zero to the east, or around, m."""
    side = spec.waypoint_offset_m + 12.0
    if spec.circuit_m is not None:
        radius = spec.circuit_m / math.tau
        return (-radius - side, -side, radius + side, 2.0 * radius + side)
    return (-4.0, -side, spec.length_m + 4.0, side)


def plan_route(terrain: Terrain, spec: PathSpec, rng: np.random.Generator) -> FloatArray:
    """Route over random waypoints, the least steep way between them, (N, 2), m.

    Points are `FINE_STEP_M` apart on the plane; the route is a bit longer than asked for.
    """
    frame = GridFrame.covering(region_of(spec), 1.0)
    height = gaussian_filter(terrain.height(frame), 1.0)
    slope = np.hypot(*np.gradient(height))
    cost = 1.0 + (slope / _COSTLY_SLOPE) ** 3
    if spec.circuit_m is None:
        way = _cheapest_way(frame, cost, _stops_east(spec, rng))
    else:
        lap = _cheapest_way(frame, cost, _stops_around(spec, spec.circuit_m, rng))
        # rounding makes a small circle smaller, by a seventh at the least circumference
        laps = math.ceil(1.3 * (spec.length_m + 2.0) / spec.circuit_m)
        way = np.concatenate([lap, *[lap[1:]] * (laps - 1)])
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    even = np.arange(0.0, chord[-1], 0.5)
    dense = np.stack([np.interp(even, chord, way[:, k]) for k in (0, 1)], axis=1)
    smooth = gaussian_filter1d(dense, _ROUNDING_M / 0.5, axis=0, mode="nearest")
    if spec.circuit_m is not None:
        smooth += _weaving(len(smooth), rng)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(length) > 1e-6])
    spline = CubicSpline(length[keep], smooth[keep])
    return np.asarray(spline(np.arange(0.0, length[-1], FINE_STEP_M)))


def _stops_east(spec: PathSpec, rng: np.random.Generator) -> FloatArray:
    count = max(int(spec.length_m // 30.0), 1)
    stops = np.linspace(0.0, spec.length_m + 2.0, count + 1)
    offsets = rng.uniform(-spec.waypoint_offset_m, spec.waypoint_offset_m, count + 1)
    offsets[0] = 0.0
    return np.stack([stops, offsets], axis=1)


def _stops_around(spec: PathSpec, circuit_m: float, rng: np.random.Generator) -> FloatArray:
    """Waypoints of one lap, counter-clockwise from the map's zero and back to it."""
    count = max(int(circuit_m // 15.0), 4)
    radius = circuit_m / math.tau
    beside = min(spec.waypoint_offset_m, 0.25 * radius)
    radii = radius + rng.uniform(-beside, beside, count + 1)
    radii[[0, -1]] = radius
    angle = np.linspace(-0.5 * math.pi, 1.5 * math.pi, count + 1)
    return np.stack([radii * np.cos(angle), radius + radii * np.sin(angle)], axis=1)


def _weaving(count: int, rng: np.random.Generator) -> FloatArray:
    """How far a driver is beside the track, (N, 2), m; slow along the way, 0 at the start."""
    noise = gaussian_filter1d(rng.standard_normal((count, 2)), _WEAVING_LENGTH_M / 0.5, axis=0)
    return np.asarray((noise - noise[0]) * (_WEAVING_M / noise.std()))


def drive_along(
    route: FloatArray, ground: Level, spec: PathSpec, side_slip_per_slope: float
) -> Drive:
    """Poses of the rover on its four wheels' contacts, cut to the length asked for.

    The rover's origin lies on the ground between the wheels. On a side slope it slides
    down, so it points a little uphill of where it goes.

    Parameters
    ----------
    route
        (N, 2) from `plan_route`.
    ground
        Finest level.
    spec
        Wheels, and length.
    side_slip_per_slope
        Sideways motion a metre of way, over the tangent of the side slope.
    """
    # a wheel rests on what its own width and radius average
    rolled = gaussian_filter(ground.height, 0.08 / ground.frame.spacing_m)
    soft = Level(ground.frame, rolled, ground.shading, ground.cells)
    tangent = np.gradient(route, axis=0)
    course = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    plane = _contact(soft, route, course, spec)
    uphill = np.arctan(side_slip_per_slope * plane[:, 2])
    heading = course + gaussian_filter1d(uphill, 1.0 / FINE_STEP_M, mode="nearest")
    plane = _contact(soft, route, heading, spec)
    poses = _poses(route, heading, plane)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    keep = distance <= spec.length_m + 0.5 * FINE_STEP_M
    return Drive(distance[keep], poses[keep])


def _contact(ground: Level, route: FloatArray, heading: FloatArray, spec: PathSpec) -> FloatArray:
    """Plane under the wheels: height at the middle, slope forward, slope left; (N, 3)."""
    c, s = np.cos(heading), np.sin(heading)
    heights = []
    for ahead in (0.5, -0.5):
        for aside in (0.5, -0.5):
            along, left = ahead * spec.wheel_base_m, aside * spec.track_m
            x = route[:, 0] + c * along - s * left
            y = route[:, 1] + s * along + c * left
            heights.append(ground.at(x, y))
    fl, fr, bl, br = heights
    return np.stack(
        [
            0.25 * (fl + fr + bl + br),
            0.5 * (fl + fr - bl - br) / spec.wheel_base_m,
            0.5 * (fl - fr + bl - br) / spec.track_m,
        ],
        axis=1,
    )


def _poses(route: FloatArray, heading: FloatArray, plane: FloatArray) -> FloatArray:
    poses = np.empty((len(route), 4, 4))
    for k, (xy, yaw, (z, forward, left)) in enumerate(zip(route, heading, plane, strict=True)):
        c, s = np.cos(yaw), np.sin(yaw)
        x_axis = np.array([c, s, forward])
        x_axis /= np.linalg.norm(x_axis)
        up = np.array([-forward * c + left * s, -forward * s - left * c, 1.0])
        up /= np.linalg.norm(up)
        poses[k] = pose(np.stack([x_axis, np.cross(up, x_axis), up], axis=1), [*xy, z])
    return poses


def _cheapest_way(frame: GridFrame, cost: FloatArray, stops: FloatArray) -> FloatArray:
    rows, columns = cost.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    starts, ends, weights = [], [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1)):
        a = (slice(0, rows - di), slice(max(-dj, 0), columns - max(dj, 0)))
        b = (slice(di, rows), slice(max(dj, 0), columns - max(-dj, 0)))
        starts.append(index[a].ravel())
        ends.append(index[b].ravel())
        weights.append(np.hypot(di, dj) * 0.5 * (cost[a] + cost[b]).ravel())
    shape = (rows * columns, rows * columns)
    graph = coo_array(
        (np.concatenate(weights), (np.concatenate(starts), np.concatenate(ends))), shape=shape
    ).tocsr()
    j, i = np.rint((stops - [frame.x0, frame.y0]) / frame.spacing_m).astype(int).T
    nodes = index[i, j]
    way: list[int] = [int(nodes[0])]
    for start, end in pairwise(nodes):
        _, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        leg = [int(end)]
        while leg[-1] != start:
            leg.append(int(before[leg[-1]]))
        way += leg[-2::-1]
    row, column = np.divmod(np.array(way), columns)
    return np.stack([frame.x0 + frame.spacing_m * column, frame.y0 + frame.spacing_m * row], axis=1)
