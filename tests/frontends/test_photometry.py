"""Reflectance laws, and a relief shaded under a given sun."""

from __future__ import annotations

import numpy as np
import pytest

from frontends.errors import InputError
from frontends.measurements import SunDirection
from frontends.photometry import Hapke, LommelSeeliger, shade, shadowed, sun_vector


def test_sun_vector_azimuth_is_clockwise_from_north() -> None:
    np.testing.assert_allclose(sun_vector(SunDirection(0.0, 0.0)), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(sun_vector(SunDirection(90.0, 0.0)), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(sun_vector(SunDirection(12.0, 90.0)), [0, 0, 1], atol=1e-12)


def test_lommel_seeliger_closed_form_and_limb() -> None:
    law = LommelSeeliger()
    one = np.array(1.0)
    assert law(one, one, one) == pytest.approx(1.0)
    assert law(np.array(0.5), one, one) == pytest.approx(2 * 0.5 / 1.5)
    assert law(np.array(-0.1), one, one) == 0.0
    assert law(one, np.array(-0.1), one) == 0.0


def test_hapke_is_reciprocal() -> None:
    """Helmholtz: I/F over mu0 is the same with the light and the viewer exchanged."""
    law = Hapke()
    phase = np.cos(np.deg2rad(50.0))
    forward = law(np.array(0.4), np.array(0.9), phase) / 0.4
    backward = law(np.array(0.9), np.array(0.4), phase) / 0.9
    assert forward == pytest.approx(backward)


def test_hapke_surges_at_opposition_and_is_scaled() -> None:
    law = Hapke()

    def at(phase_deg: float) -> float:
        cosine = np.cos(np.deg2rad(phase_deg))
        return float(law(np.array(0.8), np.array(0.8), cosine))

    # the surge is a peak a few degrees wide, not a general slope
    assert at(0.0) / at(10.0) > 1.3
    assert at(10.0) / at(20.0) < 1.35
    level = law(np.array(np.cos(np.pi / 6)), np.array(1.0), np.cos(np.pi / 6))
    assert level == pytest.approx(np.cos(np.pi / 6))


def test_slopes_to_the_sun_are_bright_on_the_right_side() -> None:
    y, x = np.mgrid[:64, :64].astype(float)
    hill = 3.0 * np.exp(-((x - 32) ** 2 + (y - 32) ** 2) / 60.0)
    for azimuth, sunny, dark in (
        (90.0, (32, 40), (32, 24)),
        (0.0, (24, 32), (40, 32)),
        (270.0, (32, 24), (32, 40)),
        (180.0, (40, 32), (24, 32)),
    ):
        image = shade(hill, 1.0, SunDirection(azimuth, 30.0))
        assert image[sunny] > 1.5 * image[dark]


def test_shadow_of_a_wall_has_its_length_and_side() -> None:
    wall = np.zeros((101, 201))
    wall[:, 99:102] = 5.0
    dark = shadowed(wall, 0.5, SunDirection(90.0, np.rad2deg(np.arctan(0.25))))
    # 5 m high, tan = 1/4: 20 m = 40 cells to the west, none to the east
    row = dark[50]
    assert 38 <= row[:99].sum() <= 41
    assert row[60:98].all()
    assert not row[102:].any()
    turned = shadowed(wall.T, 0.5, SunDirection(180.0, np.rad2deg(np.arctan(0.25))))
    assert 38 <= turned[:99, 50].sum() <= 41


def test_shadow_follows_an_oblique_sun() -> None:
    ground = np.zeros((201, 201))
    ground[99:102, 99:102] = 10.0
    dark = shadowed(ground, 1.0, SunDirection(30.0, 20.0))
    rows, columns = np.nonzero(dark & (ground == 0.0))
    away = np.array([columns.mean() - 100, 100 - rows.mean()])  # east, north
    expected = -sun_vector(SunDirection(30.0, 0.0))[:2]
    assert away @ expected / np.linalg.norm(away) > 0.999
    assert np.hypot(*(columns - 100, rows - 100)).max() == pytest.approx(
        10.0 / np.tan(np.deg2rad(20.0)), abs=2.0
    )


def test_cast_shadows_option_and_unknown_heights() -> None:
    wall = np.zeros((60, 60))
    wall[:, 30] = 4.0
    wall[5, 5] = np.nan
    sun = SunDirection(90.0, 20.0)
    without, with_shadows = shade(wall, 1.0, sun), shade(wall, 1.0, sun, cast_shadows=True)
    assert without[40, 25] > 0.1
    assert with_shadows[40, 25] == 0.0
    assert np.isnan(with_shadows[5, 5])
    assert np.isnan(with_shadows[5, 6])
    assert np.isfinite(with_shadows[10:, :]).all()
    assert not shade(wall, 1.0, SunDirection(90.0, -5.0), cast_shadows=True)[10:].any()


@pytest.mark.parametrize(
    ("height", "gsd", "view"),
    [
        (np.zeros((1, 5)), 1.0, (0, 0, 1)),
        (np.zeros((5, 5)), 0.0, (0, 0, 1)),
        (np.zeros((5, 5)), 1.0, (0, 0, 0)),
    ],
)
def test_refusals(height: np.ndarray, gsd: float, view: tuple[float, float, float]) -> None:
    with pytest.raises(InputError):
        shade(height, gsd, SunDirection(0.0, 45.0), view=view)
