"""Where the map frame lies on its body: coordinate reference systems of the Moon and Mars.

A GeoTIFF forgets the authority code of a planetary CRS, and a polar stereographic projection
comes back with other parameter names. So two CRSs are compared by what they do: the radii of
their ellipsoids, and where the same points of the body come to lie in their planes. The code
itself travels in the tag `CRS_TAG`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS, Proj
from pyproj.exceptions import CRSError, ProjError

from frontends.errors import InputError
from lunar_fg.datasets.base import MapReference

FloatArray = NDArray[np.float64]

#: GeoTIFF tag that keeps the authority code, e.g. ``IAU_2015:30135``.
CRS_TAG = "LUNAR_FG_CRS"
#: Radii closer than this are of the same body, m: codes of one body differ by less.
RADIUS_TOLERANCE_M = 1.0
#: Planes that put the same points this close are the same, m.
PLANE_TOLERANCE_M = 1e-3
#: Half width of the square in which two planes are compared, m.
_COMPARED_M = 10_000.0


@dataclass(frozen=True, slots=True)
class Georeference:
    """The map frame on its body.

    Attributes
    ----------
    crs
        Projected, metres, axes east and north.
    origin_m
        Of the map frame: easting, northing, height.
    code
        Authority code of `crs`; "" where it has none.
    """

    crs: CRS
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    code: str = ""

    @classmethod
    def of(cls, reference: MapReference, source: str | Path = "map") -> Georeference:
        """Georeference of a dataset's map frame.

        Raises
        ------
        InputError
            The CRS is not known, not projected, or not in metres.
        """
        crs = parse_crs(reference.crs, source)
        return cls(crs, reference.origin_m, authority_code(crs))

    @property
    def body(self) -> str:
        """Name of the body's geographic CRS, for people."""
        geographic = self.crs.geodetic_crs
        return self.crs.name if geographic is None else geographic.name

    def to_plane(self, points_m: FloatArray) -> FloatArray:
        """Map-frame points (N, 2 or 3) as easting, northing[, height], m."""
        points = np.asarray(points_m, dtype=np.float64)
        return np.asarray(points + np.array(self.origin_m)[: points.shape[1]])

    def to_map(self, plane_m: FloatArray) -> FloatArray:
        """Easting, northing[, height] (N, 2 or 3) as map-frame points, m."""
        plane = np.asarray(plane_m, dtype=np.float64)
        return np.asarray(plane - np.array(self.origin_m)[: plane.shape[1]])

    def to_lonlat(self, points_m: FloatArray) -> FloatArray:
        """Map-frame points (N, 2 or 3) as longitude and latitude, deg, and height, m."""
        plane = self.to_plane(points_m)
        longitude, latitude = Proj(self.crs)(plane[:, 0], plane[:, 1], inverse=True)
        return np.column_stack([longitude, latitude, *plane.T[2:]])

    def from_lonlat(self, lonlat_deg: FloatArray) -> FloatArray:
        """Longitude and latitude (N, 2), deg, as map-frame points (N, 2), m."""
        lonlat = np.asarray(lonlat_deg, dtype=np.float64)
        plane = np.column_stack(Proj(self.crs)(lonlat[:, 0], lonlat[:, 1]))
        return self.to_map(plane)


def parse_crs(text: str, source: str | Path = "map") -> CRS:
    """Read a CRS of a map: authority code or WKT; projected, metres.

    Raises
    ------
    InputError
        It is not known, or not a plane in metres.
    """
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(
            f"{text[:60]!r} is not a known coordinate reference system",
            source=source,
            field="crs",
            remedy="give a code like IAU_2015:30135 (Moon, south polar), or WKT",
        ) from error
    units = {axis.unit_conversion_factor for axis in crs.axis_info}
    if not crs.is_projected or units != {1.0}:
        raise InputError(
            f"{crs.name!r} is not a projected system in metres",
            source=source,
            field="crs",
            remedy="navigation needs a plane: project the map, e.g. with gdalwarp",
        )
    return crs


def authority_code(crs: CRS) -> str:
    """Code of a CRS such as ``IAU_2015:30135``, or "" where it has none."""
    found = crs.to_authority(min_confidence=100) if crs is not None else None
    return "" if found is None else ":".join(found)


def difference(a: CRS, b: CRS, origin_m: tuple[float, float] = (0.0, 0.0)) -> str:
    """Say in what two projected CRSs differ; "" when they are the same.

    Parameters
    ----------
    a, b
        Names and authority codes are ignored, and so is how a projection is spelled.
    origin_m
        Easting and northing about which the planes are compared.
    """
    if not same_body(a, b):
        radii, others = _radii_m(a), _radii_m(b)
        return f"radii {_metres(radii)} against {_metres(others)}: another body or another model"
    steps = np.linspace(-_COMPARED_M, _COMPARED_M, 5)
    x, y = (grid.ravel() for grid in np.meshgrid(origin_m[0] + steps, origin_m[1] + steps))
    try:
        back_x, back_y = Proj(b)(*Proj(a)(x, y, inverse=True, errcheck=True), errcheck=True)
    except ProjError:
        gap = float("inf")
    else:
        gap = float(np.hypot(back_x - x, back_y - y).max())
    if gap <= PLANE_TOLERANCE_M:
        return ""
    how_far = "too far apart to compare" if np.isinf(gap) else f"up to {gap:.3g} m apart"
    return f"the same points lie {how_far} ({_parameter_difference(a, b)})"


def same_body(a: CRS, b: CRS) -> bool:
    """Whether the ellipsoids of two CRSs agree, to `RADIUS_TOLERANCE_M`."""
    radii = zip(_radii_m(a), _radii_m(b), strict=True)
    return all(abs(first - second) <= RADIUS_TOLERANCE_M for first, second in radii)


def require_same(georeference: Georeference, crs: CRS, source: str | Path) -> None:
    """Refuse a map of another body or another projection.

    Raises
    ------
    InputError
        Says in what it differs from the map frame.
    """
    x, y, _ = georeference.origin_m
    found = difference(georeference.crs, crs, (x, y))
    if found:
        raise InputError(
            f"does not fit the map frame {georeference.code or georeference.crs.name}: {found}",
            source=source,
            field="crs",
            remedy="give the map that belongs to the traverse, or reproject it (gdalwarp)",
        )


def read_crs(path: str | Path) -> CRS:
    """CRS of a GeoTIFF, with its authority code where the file's tag keeps it.

    Raises
    ------
    InputError
        The file cannot be read, has no usable CRS, or tag and CRS contradict each other.
    """
    try:
        with rasterio.open(path) as raster:
            wkt = "" if raster.crs is None else raster.crs.to_wkt()
            code = raster.tags().get(CRS_TAG, "")
            centre = raster.xy(raster.height / 2, raster.width / 2)
    except rasterio.errors.RasterioIOError as error:
        raise InputError(f"cannot be read as a map ({error})", source=path) from error
    if not wkt:
        raise InputError(
            "has no coordinate reference system",
            source=path,
            field="crs",
            remedy="set one: gdal_edit.py -a_srs IAU_2015:30135 FILE",
        )
    embedded = parse_crs(wkt, path)
    if not code:
        return embedded
    tagged = parse_crs(code, path)
    found = difference(tagged, embedded, (float(centre[0]), float(centre[1])))
    if found:
        raise InputError(
            f"its tag says {code}, which is not its CRS: {found}", source=path, field=CRS_TAG
        )
    return tagged


def _parameter_difference(a: CRS, b: CRS) -> str:
    with warnings.catch_warnings():
        # PROJ strings lose details of datums; only the projection's numbers are read here.
        warnings.simplefilter("ignore", UserWarning)
        first, second = a.to_dict(), b.to_dict()
    ignored = {"R", "a", "b", "rf", "no_defs", "type", "units", "ellps", "datum"}
    names = sorted(name for name in first.keys() | second.keys() if name not in ignored)
    parts = [
        f"{name} {first.get(name, 'unset')} against {second.get(name, 'unset')}"
        for name in names
        if first.get(name) != second.get(name)
    ]
    return ", ".join(parts)


def _radii_m(crs: CRS) -> tuple[float, float]:
    if crs.ellipsoid is None:
        return (float("nan"), float("nan"))
    return crs.ellipsoid.semi_major_metre, crs.ellipsoid.semi_minor_metre


def _metres(radii: tuple[float, float]) -> str:
    return " x ".join(f"{radius:.0f}" for radius in dict.fromkeys(radii)) + " m"
