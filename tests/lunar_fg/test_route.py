"""The planned route: geometry, probabilities against closed forms, range against propagation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from frontends.errors import InputError
from frontends.geometry import adjoint, inverse, pose, so3_exp
from frontends.measurements import Estimate
from lunar_fg.datasets.base import MapReference
from lunar_fg.georeference import Georeference
from lunar_fg.route import PlannedRoute, RouteConfig, RouteMonitor, states_text
from lunar_fg.route_file import read_route

MOON = Georeference.of(MapReference("IAU_2015:30135", (12_000.0, -8_000.0, 0.0)))


def at(x: float, y: float, yaw: float = 0.0, index: int = 0, sigma: float = 0.1) -> Estimate:
    covariance = np.diag([1e-4, 1e-4, 1e-4, sigma**2, sigma**2, sigma**2])
    place = pose(so3_exp([0.0, 0.0, yaw]), [x, y, 0.0])
    return Estimate(index, float(index), place, covariance)


def straight(length: float = 100.0) -> PlannedRoute:
    return PlannedRoute(np.array([[0.0, 0.0], [length, 0.0]]), name="plan")


def test_signs_and_stations() -> None:
    route = PlannedRoute(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 20.0]]))
    monitor = RouteMonitor(route)
    first = monitor.observe(at(2.0, 1.0))
    assert (first.station_m, first.cross_track_m, first.along_track_m) == (2.0, 1.0, 0.0)
    assert first.remaining_m == 28.0
    second = monitor.observe(at(12.0, 5.0, np.pi / 2, index=1))
    # Now northward: east of the route is to its right.
    assert second.station_m == pytest.approx(15.0)
    assert second.cross_track_m == pytest.approx(-2.0)
    # 13 m further along the route, by a straight line of 10.8 m: ahead of the driven distance.
    assert second.along_track_m == pytest.approx(13.0 - np.hypot(10.0, 4.0))


def test_sigmas_are_taken_along_and_across_whatever_the_heading() -> None:
    route = PlannedRoute(np.array([[0.0, 0.0], [100.0, 100.0]]))
    yaw = 1.2
    covariance = np.diag([1e-6, 1e-6, 1e-6, 0.0, 0.0, 1e-6])
    turn = so3_exp([0.0, 0.0, yaw])[:2, :2]
    along, across = np.array([1.0, 1.0]) / np.sqrt(2), np.array([-1.0, 1.0]) / np.sqrt(2)
    wanted = 0.09 * np.outer(along, along) + 0.01 * np.outer(across, across)
    covariance[3:5, 3:5] = turn.T @ wanted @ turn
    place = pose(so3_exp([0.0, 0.0, yaw]), [50.0, 50.0, 0.0])
    state = RouteMonitor(route).observe(Estimate(0, 0.0, place, covariance))
    assert state.sigma_along_m == pytest.approx(0.3)
    assert state.sigma_cross_m == pytest.approx(0.1)


@pytest.mark.parametrize("offset", [0.0, 1.0, 2.0, -2.5, 4.0])
def test_the_probability_on_a_straight_is_the_closed_form(offset: float) -> None:
    monitor = RouteMonitor(straight(), RouteConfig(half_width_m=2.0))
    state = monitor.observe(at(50.0, offset, sigma=0.8))
    exact = norm.sf((2.0 - offset) / 0.8) + norm.cdf((-2.0 - offset) / 0.8)
    assert state.outside_probability == pytest.approx(exact, abs=2e-3)


def test_the_probability_at_a_bend_is_that_of_a_large_sample() -> None:
    route = PlannedRoute(np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0]]))
    estimate = at(18.5, 1.0, sigma=1.0)
    found = RouteMonitor(route, RouteConfig(half_width_m=1.0)).observe(estimate)
    rng = np.random.default_rng(1)
    x, y = rng.normal([[18.5], [1.0]], 1.0, (2, 200_000))
    first = np.hypot(np.maximum(np.maximum(-x, x - 20.0), 0.0), y)
    second = np.hypot(x - 20.0, np.maximum(np.maximum(-y, y - 20.0), 0.0))
    exact = np.mean(np.minimum(first, second) > 1.0)
    assert found.outside_probability == pytest.approx(exact, abs=5e-3)


def drive(steps: int, noise: np.ndarray, start: float = 0.0) -> list[Estimate]:
    """Dead reckoning straight on, half a metre a step, each adding `noise` (6 variances)."""
    motion = pose(np.eye(3), [0.5, 0.0, 0.0])
    covariance = np.diag(np.full(6, 1e-8))
    place = pose(np.eye(3), [start, 0.0, 0.0])
    found = []
    for index in range(steps):
        found.append(Estimate(index, float(index), place, covariance))
        carry = adjoint(inverse(motion))
        covariance = carry @ covariance @ carry.T + np.diag(noise)
        place = place @ motion
    return found


@pytest.mark.parametrize(
    "noise",
    [
        np.array([1e-8, 1e-8, 4e-6, 1e-6, 1e-6, 1e-6]),  # yaw decides
        np.array([1e-8, 1e-8, 1e-8, 9e-4, 1e-6, 1e-6]),  # along-track decides
        np.array([1e-8, 1e-8, 1e-8, 1e-6, 4e-4, 1e-6]),  # sideways slip decides
    ],
)
def test_the_range_is_where_the_propagated_covariance_reaches_the_bound(noise: np.ndarray) -> None:
    estimates = drive(1200, noise)
    bound = 1.5
    sigmas = np.array([np.sqrt(np.diag(e.covariance)[3:5].max()) for e in estimates])
    reached = 0.5 * np.argmax(3.0 * sigmas > bound)
    assert reached > 40.0
    monitor = RouteMonitor(straight(1000.0), RouteConfig(bound_m=bound))
    for estimate in estimates[:60]:
        state = monitor.observe(estimate)
    driven = 0.5 * 59
    assert driven + state.range_m == pytest.approx(reached, rel=0.05)


def test_a_fix_on_the_way_does_not_spoil_the_growth() -> None:
    noise = np.array([1e-8, 1e-8, 4e-6, 1e-5, 1e-5, 1e-6])
    estimates = drive(120, noise)
    plain, fixed = RouteMonitor(straight(1000.0)), RouteMonitor(straight(1000.0))
    for estimate in estimates[:40]:
        state = plain.observe(estimate)
    for estimate in [*estimates[20:60], *estimates[0:40]]:
        after = fixed.observe(estimate)
    assert after.range_m == pytest.approx(state.range_m, rel=0.1)


def test_the_range_is_unknown_before_the_first_metre_and_zero_beyond_the_bound() -> None:
    monitor = RouteMonitor(straight(), RouteConfig(bound_m=1.0))
    assert np.isnan(monitor.observe(at(0.0, 0.0)).range_m)
    assert monitor.observe(at(1.0, 0.0, index=1, sigma=0.5)).range_m == 0.0


def test_alarms_say_it_once(caplog: pytest.LogCaptureFixture) -> None:
    monitor = RouteMonitor(straight(), RouteConfig(half_width_m=2.0))
    for index, y in enumerate([0.0, 1.0, 3.0, 3.0, 3.1, 0.0, 3.0]):
        monitor.observe(at(float(index), y, index=index))
    outside = [alarm for alarm in monitor.alarms if "outside the corridor" in alarm]
    assert [alarm.split(",")[0] for alarm in outside] == ["frame 2", "frame 6"]
    assert "outside the corridor" in caplog.text
    assert monitor.summary().cross_track_max_m == pytest.approx(3.1)
    assert len(states_text(monitor.states).splitlines()) == 8


def test_a_short_range_is_an_alarm() -> None:
    monitor = RouteMonitor(straight(1000.0), RouteConfig(bound_m=1.0))
    for estimate in drive(40, np.array([1e-8, 1e-8, 4e-6, 1e-4, 1e-4, 1e-6])):
        monitor.observe(estimate)
    assert sum("an absolute fix is needed" in alarm for alarm in monitor.alarms) == 1


def test_where_a_route_crosses_itself_the_station_does_not_jump() -> None:
    loop = np.array([[0, 0], [40, 0], [40, 40], [20, 40], [20, -40]], dtype=float)
    monitor = RouteMonitor(PlannedRoute(loop))
    stations = [monitor.observe(at(x, 0.01, index=i)).station_m
                for i, x in enumerate(np.arange(0.0, 38.0, 1.0))]  # fmt: skip
    np.testing.assert_allclose(stations, np.arange(0.0, 38.0, 1.0), atol=1e-9)


def feature(coordinates: object, crs: str | None = None, **properties: object) -> str:
    geometry = {"type": "LineString", "coordinates": coordinates}
    content: dict[str, object] = {
        "type": "FeatureCollection",
        "features": [{"type": "Feature", "properties": properties, "geometry": geometry}],
    }
    if crs is not None:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    return json.dumps(content)


def test_three_ways_to_write_the_same_route(tmp_path: Path) -> None:
    points = np.array([[0.0, 0.0], [50.0, 20.0], [90.0, 10.0]])
    plane, lonlat = MOON.to_plane(points), MOON.to_lonlat(points)
    for name, text in {
        "map": feature(points.tolist(), "map", half_width_m=3, name="to the crater"),
        "plane": feature(plane.tolist(), "urn:ogc:def:crs:IAU_2015::30135"),
        "lonlat": feature(lonlat.tolist()),
        "named": feature(lonlat.tolist(), "IAU_2015:30100"),
    }.items():
        path = tmp_path / f"{name}.geojson"
        path.write_text(text)
        route = read_route(path, MOON)
        np.testing.assert_allclose(route.points_m, points, atol=1e-5, err_msg=name)
    named = read_route(tmp_path / "map.geojson", None)
    assert (named.half_width_m, named.name) == (3.0, "to the crater")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "JSON"),
        ("[]", "GeoJSON"),
        ("[" * 100_000, "JSON"),
        ('{"type": "FeatureCollection", "features": []}', "LineString"),
        ('{"type": "FeatureCollection", "features": [3, null]}', "LineString"),
        (feature([[0, 0]]), "LineString|points"),
        (feature([[0, 0], [0, 0]]), "points"),
        (feature([[0, 0], ["a", 1]]), "LineString"),
        (feature([[0, 0], [1, 1]], half_width_m=-1), "half_width_m"),
        (feature([[12_000, -8_000], [12_100, -8_000]]), "longitude and latitude"),
        (feature([[0, 0], [1, 1]], "IAU_2015:49900"), "another body"),
        (feature([[0, 0], [1, 1]], "IAU_2015:49935"), "another body"),
        (feature([[0, 0], [1, 1]], "no such thing"), "not known"),
    ],
)
def test_a_bad_route_is_refused_with_a_reason(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "route.geojson"
    path.write_text(text)
    with pytest.raises(InputError, match=word):
        read_route(path, MOON)
