"""A planned route from GeoJSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError
from shapely.geometry import shape

from frontends.errors import InputError
from lunar_fg.datasets.base import Dataset
from lunar_fg.georeference import FloatArray, Georeference, parse_crs, require_same, same_body
from lunar_fg.route import PlannedRoute, RouteConfig, RouteMonitor

_LARGEST_BYTES = 20_000_000
_REMEDY = "docs/georeference.md has an example"


def read_route(path: Path, georeference: Georeference | None = None) -> PlannedRoute:
    """Read the first LineString of a GeoJSON file.

    Its coordinates are longitude and latitude of the map's body, in degrees, as RFC 7946 has
    it; or easting and northing where a ``crs`` member names the map's projection; or metres of
    the map frame itself where the ``crs`` is named ``map``, or where the run has no CRS.

    Parameters
    ----------
    path
        The file. The properties ``name`` and ``half_width_m`` are used.
    georeference
        Of the map frame; None for a local one.

    Raises
    ------
    InputError
        Names the file and what in it cannot be used.
    """
    content = _content(path)
    features = content.get("features") if content.get("type") == "FeatureCollection" else [content]
    feature = next((f for f in features or [] if _kind(f) == "LineString"), None)
    if feature is None:
        raise InputError("holds no LineString", source=path, remedy=_REMEDY)
    try:
        line = shape(feature["geometry"] if feature.get("type") == "Feature" else feature)
        points = shapely.get_coordinates(line)
    except (ValueError, TypeError, KeyError, IndexError, shapely.errors.ShapelyError) as error:
        raise InputError(f"holds a damaged LineString ({error})", source=path) from error
    if not np.isfinite(points).all():
        raise InputError("holds a NaN or infinity", source=path, field="coordinates")
    properties = feature.get("properties") or {}
    apart = np.ones(len(points), dtype=bool)
    apart[1:] = np.any(np.diff(points, axis=0) != 0.0, axis=1)
    return PlannedRoute(
        _in_map(points[apart], content.get("crs"), georeference, path),
        _half_width(properties.get("half_width_m"), path),
        " ".join(str(properties.get("name") or path.stem).split())[:80],
    )


def watch(path: Path, dataset: Dataset, config: RouteConfig) -> RouteMonitor:
    """Watch a dataset's run against the route of a GeoJSON file."""
    reference = dataset.map_reference
    georeference = None if reference is None else Georeference.of(reference, dataset.path)
    return RouteMonitor(read_route(path, georeference), config)


def _content(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise InputError("is larger than a route can be", source=path)
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", source=path) from error
    except (ValueError, RecursionError) as error:
        raise InputError("is not JSON", source=path, remedy=_REMEDY) from error
    if not isinstance(content, dict):
        raise InputError("is not GeoJSON", source=path, remedy=_REMEDY)
    return content


def _kind(feature: object) -> str:
    if not isinstance(feature, dict):
        return ""
    geometry = feature.get("geometry") if feature.get("type") == "Feature" else feature
    return str(geometry.get("type", "")) if isinstance(geometry, dict) else ""


def _half_width(value: object, path: Path) -> float | None:
    if value is None:
        return None
    if not isinstance(value, int | float) or not 0.0 < value < 1e6:
        raise InputError("must be a number of metres", source=path, field="half_width_m")
    return float(value)


def _in_map(
    points: FloatArray, crs: object, georeference: Georeference | None, path: Path
) -> FloatArray:
    name = ""
    if crs is not None:
        try:
            name = str(crs["properties"]["name"])  # type: ignore[index]
        except (KeyError, TypeError) as error:
            raise InputError("has no properties.name", source=path, field="crs") from error
    if name == "map" or (georeference is None and not name):
        return points
    if georeference is None:
        raise InputError(
            f"is in {name!r}, but the run has no map reference", source=path, field="crs",
            remedy='give `map: {crs, origin}` in traverse.yaml, or the crs "map" in metres',
        )  # fmt: skip
    if not name:
        return _from_degrees(points, georeference, path)
    try:
        # "urn:ogc:def:crs:IAU_2015::30135" is how GDAL spells a code.
        system = CRS.from_user_input(name)
    except CRSError as error:
        raise InputError(f"{name[:60]!r} is not known", source=path, field="crs") from error
    if system.is_geographic:
        if not same_body(system, georeference.crs):
            raise InputError(
                f"{system.name!r} is of another body than {georeference.body!r}",
                source=path, field="crs",
            )  # fmt: skip
        return _from_degrees(points, georeference, path)
    require_same(georeference, parse_crs(name, path), path)
    return georeference.to_map(points)


def _from_degrees(points: FloatArray, georeference: Georeference, path: Path) -> FloatArray:
    if (np.abs(points) > [360.0, 90.0]).any():
        raise InputError(
            "holds coordinates that are no longitude and latitude", source=path,
            field="coordinates",
            remedy='name their system in a "crs" member, or the crs "map" for map metres',
        )  # fmt: skip
    return georeference.from_lonlat(points)
