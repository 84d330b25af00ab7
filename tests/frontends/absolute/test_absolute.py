import math

import numpy as np
import pytest

from frontends.absolute import (
    AbsoluteAdjustment,
    AbsoluteConfig,
    RelitRelief,
    Search,
    SurfMatching,
    estimate_sun,
    locate_everywhere,
    make_patch,
    match_layers,
)
from frontends.absolute.correlation import MaskedCorrelator
from frontends.geometry import yaw_pitch_roll
from frontends.measurements import SunDirection
from frontends.orbital import MapWindow, OrbitalMap
from frontends.terrain import Grid
from tests.frontends.absolute.relief import drive, heightfield, moved, see, write_dem, write_map

ANCHOR = 10
WINDOW = Search(8.0, 8.0, math.radians(3.0))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    z = heightfield(1)
    ortho, dem = write_map(folder / "ortho.tif", z), write_dem(folder / "dem.tif", z)
    wrong = write_map(folder / "wrong.tif", heightfield(2))
    flat = write_map(folder / "flat.tif", heightfield(3, 1e-5))
    poses = drive()
    return z, ortho, dem, wrong, flat, poses, see(z, poses)


def locate(place, orbital, *, off=(1.7, -2.3, 0.02), search=WINDOW, proposers=None, frames=None):
    _, _, _, _, _, poses, terrain = place
    estimate = moved(poses, *off, ANCHOR)
    if frames is not None:
        estimate = {k: estimate[k] for k in frames}
    adjustment = AbsoluteAdjustment(orbital, AbsoluteConfig(), proposers)
    patch = make_patch(terrain, estimate, ANCHOR, adjustment.cell_m)
    return adjustment.locate(patch, ANCHOR, search)


def error(place, candidate):
    true = place[5][ANCHOR]
    yaw = yaw_pitch_roll(true)[0]
    return np.array([candidate.x_m - true[0, 3], candidate.y_m - true[1, 3],
                     candidate.yaw_rad - yaw])  # fmt: skip


def test_relief_lit_by_the_maps_sun_is_found_to_a_fraction_of_a_cell(place):
    fix = locate(place, OrbitalMap.open(place[1])).fix
    assert fix.reason == ""
    best = fix.candidates[0]
    off = error(place, best)
    assert math.hypot(*off[:2]) < 0.1
    assert abs(off[2]) < math.radians(0.5)
    assert off @ np.linalg.solve(best.covariance, off) < 16.3  # 99.9 % of chi-square, 3
    assert best.proposer == "relit relief"
    assert fix.second_best_ratio < 0.7


def test_a_turned_prior_leads_to_the_same_place(place):
    orbital = OrbitalMap.open(place[1])
    one = locate(place, orbital, off=(0.0, 0.0, -0.03)).fix.candidates[0]
    other = locate(place, orbital, off=(-3.1, 2.2, 0.03)).fix.candidates[0]
    assert math.hypot(one.x_m - other.x_m, one.y_m - other.y_m) < 0.1
    assert abs(one.yaw_rad - other.yaw_rad) < math.radians(0.5)


@pytest.mark.parametrize("azimuth", [105.0, 195.0])
def test_any_sun_of_the_map_will_do(place, tmp_path, azimuth):
    ortho = write_map(tmp_path / "o.tif", place[0], SunDirection(azimuth, 35.0))
    fix = locate(place, OrbitalMap.open(ortho)).fix
    assert math.hypot(*error(place, fix.candidates[0])[:2]) < 0.12


def test_another_place_and_featureless_ground_are_refused(place):
    for ortho in (place[3], place[4]):
        fix = locate(place, OrbitalMap.open(ortho)).fix
        assert not fix.candidates
        assert fix.reason


def test_what_cannot_be_located_says_why(place, tmp_path):
    orbital = OrbitalMap.open(place[1])
    assert "too small" in locate(place, orbital, frames=(10,)).fix.reason
    flat = see(heightfield(3, 1e-5), place[5])
    patch = make_patch(flat, place[5], ANCHOR, 0.25)
    assert "too flat" in AbsoluteAdjustment(orbital).locate(patch, ANCHOR, WINDOW).fix.reason
    assert "no ground" in AbsoluteAdjustment(orbital).locate(None, ANCHOR, WINDOW).fix.reason
    unlit = OrbitalMap(orbital.ortho, None, None)
    assert "sun is not known" in locate(place, unlit).fix.reason
    night = OrbitalMap(orbital.ortho, None, SunDirection(90.0, -3.0))
    assert "too dark" in locate(place, night).fix.reason
    # the place lies outside of what the prior allows
    away = locate(place, orbital, off=(11.0, 0.0, 0.0), search=Search(4.0, 4.0, 0.05))
    assert not away.fix.candidates


def test_the_elevation_model_finds_the_place_and_gives_the_height(place):
    _, ortho, dem, *_ = place
    alone = locate(place, OrbitalMap.open(None, dem)).fix
    assert alone.candidates[0].proposer == "relief in DEM"
    assert math.hypot(*error(place, alone.candidates[0])[:2]) < 0.5
    both = locate(place, OrbitalMap.open(ortho, dem)).fix
    assert both.candidates[0].proposer == "relit relief"
    assert len(both.candidates) == 1  # the second method agrees: nothing to choose from
    # the rover's origin drives at height 0 whatever the ground: the drive is laid out so
    assert both.height_m == pytest.approx(0.0, abs=0.1)
    assert both.sigma_height_m > 0


def test_fixes_of_many_places_are_as_good_as_they_say(place):
    z, ortho = place[0], OrbitalMap.open(place[1])
    squares = []
    for k in range(6):
        poses = drive(18, 1.2, (20.0 + 2 * k, 22.0 + 6 * k), 0.4 * k - 1.0)
        patch = make_patch(see(z, poses, seed=k), moved(poses, 1.1, 0.8, 0.01, 9), 9, 0.25)
        fix = AbsoluteAdjustment(ortho).locate(patch, 9, WINDOW).fix
        if fix.candidates:
            best, true = fix.candidates[0], poses[9]
            off = np.array([best.x_m - true[0, 3], best.y_m - true[1, 3]])
            squares.append(off @ np.linalg.solve(best.covariance[:2, :2], off))
    assert len(squares) >= 5
    assert np.mean(squares) < 2 * 3.0
    assert max(squares) < 18.4  # 99.99 % of chi-square, 2


def test_a_lost_rover_is_found_without_prior(place):
    adjustment = AbsoluteAdjustment(OrbitalMap.open(place[1]))
    estimate = moved(place[5], 9.0, -7.0, 0.4, ANCHOR)
    patch = make_patch(place[6], estimate, ANCHOR, 0.25)
    fix = locate_everywhere(adjustment, patch, patch, Search(12.0, 12.0, 0.5)).fix
    assert fix.reason == ""
    off = error(place, fix.candidates[0])
    assert math.hypot(*off[:2]) < 0.2
    assert abs(math.remainder(off[2], math.tau)) < math.radians(1.0)


def test_the_sun_of_an_image_by_its_elevation_model(place):
    orbital = OrbitalMap.open(place[1], place[2])
    window = orbital.ortho.window(orbital.bounds_m)
    heights = orbital.height_on(window.grid).values
    found = estimate_sun(window.values, heights, 0.25)
    assert abs(math.remainder(found.sun.azimuth_deg - 285.0, 360.0)) < 3.0 * found.sigma_deg + 1.0
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(window.values.shape).astype(np.float32)
    assert estimate_sun(noise, heights, 0.25) is None


def test_surf_finds_a_turned_crop_and_refuses_another_place(place):
    window = OrbitalMap.open(place[1]).ortho.window((10.0, 10.0, 70.0, 70.0))
    angle = math.radians(25.0)
    side = 120
    grid = Grid(-15.0, 15.0, 0.25, side, side)
    x, y = np.meshgrid(*grid.centres())
    c, s = math.cos(angle), math.sin(angle)
    column, row = window.grid.pixel(40.0 + c * x - s * y, 38.0 + s * x + c * y)
    import cv2

    crop = cv2.remap(
        window.values, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR
    )
    found = match_layers(MapWindow(grid, crop), window)
    assert not isinstance(found, str)
    assert found.yaw_rad == pytest.approx(angle, abs=0.003)
    assert (found.x_m, found.y_m) == pytest.approx((40.0, 38.0), abs=0.1)
    assert found.scale == pytest.approx(1.0, abs=0.01)
    other = OrbitalMap.open(place[3]).ortho.window((10.0, 10.0, 70.0, 70.0))
    assert isinstance(match_layers(MapWindow(grid, crop), other), str)


def test_an_uncertain_path_makes_an_uncertain_fix(place):
    _, ortho, _, _, _, poses, terrain = place
    adjustment = AbsoluteAdjustment(OrbitalMap.open(ortho), proposers=(RelitRelief(),))
    motions = [np.diag([0.01**2, 0.01**2, 0.002**2])] * (len(poses) - 1)
    motions[6] = np.diag([0.3**2, 0.1**2, 0.03**2])  # not seen
    stated = []
    for known in (None, motions):
        patch = make_patch(terrain, poses, ANCHOR, adjustment.cell_m, known)
        fix = adjustment.locate(patch, ANCHOR, WINDOW).fix
        stated.append(fix.candidates[0].covariance)
    more = stated[1] - stated[0]
    np.testing.assert_allclose(more, patch.bending, rtol=0.02, atol=1e-6)
    # a third of the ground lies behind the motion that was lost
    assert 0.05 < np.sqrt(more[0, 0] + more[1, 1]) < 0.3


def test_proposers_are_asked_in_turn_and_named(place):
    proposers = (RelitRelief(), SurfMatching("relit"))
    result = locate(place, OrbitalMap.open(place[1]), proposers=proposers)
    assert [p.proposer for p in result.proposals] == ["relit relief", "SURF, relit"]
    assert all(p.peak or p.reason for p in result.proposals)


def test_masked_correlation_is_the_coefficient_over_the_common_cells():
    rng = np.random.default_rng(8)
    image = rng.standard_normal((37, 41)).astype(np.float32)
    known = rng.random((37, 41)) > 0.05
    template = rng.standard_normal((11, 14)).astype(np.float32)
    mask = rng.random((11, 14)) > 0.3
    surface = MaskedCorrelator(image, known, template.shape).surface(template, mask)
    assert surface.shape == (27, 28)
    for i, j in ((0, 0), (26, 27), (13, 5)):
        both = mask & known[i : i + 11, j : j + 14]
        expected = np.corrcoef(template[both], image[i : i + 11, j : j + 14][both])[0, 1]
        assert surface[i, j] == pytest.approx(expected, abs=2e-3)
