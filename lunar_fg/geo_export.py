"""Results for geographic information systems: GeoPackage and GeoJSON.

The layers are path, poses, 1-sigma ellipses, fixes with their verdicts, the planned route,
the truth and the dead reckoning, as far as a run has them. A GeoPackage is in the map's own
projection; GeoJSON in longitude and latitude of the body, as RFC 7946 wants it, with a ``crs``
member that names the body. Without a map reference both are in metres of the map frame.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from frontends.errors import InputError
from frontends.measurements import AbsoluteFix
from lunar_fg.georeference import CRS_TAG, Georeference, authority_code
from lunar_fg.graph.ledger import LedgerEntry
from lunar_fg.ledger import entry_values
from lunar_fg.results import RunResults, read_results
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.trajectory import Trajectory

FloatArray = NDArray[np.float64]
Column = NDArray[Any]

#: Corners of an ellipse.
_CORNERS = 48
#: What the ledger says of a fix in a table.
_FIX_COLUMNS = (
    "keyframe", "proposer", "score", "inliers", "second_best_ratio", "mahalanobis", "verdict",
    "reason",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Geometries of one kind in the map frame, each with its attributes.

    Attributes
    ----------
    name
        Of the layer.
    kind
        OGC geometry type.
    geometries
        (N,) shapely geometries, map frame, m.
    columns
        (N,) each, by name.
    """

    name: str
    kind: str
    geometries: NDArray[np.object_]
    columns: Mapping[str, Column]


def layers(results: RunResults) -> Iterator[Layer]:
    """All layers that a run has, in drawing order."""
    trajectory = results.trajectory
    if results.route is not None:
        yield _line("route", results.route.points_m, label=results.route.name)
    if results.dead_reckoning is not None:
        yield _line("dead_reckoning", results.dead_reckoning.positions)
    if isinstance(results.truth, Trajectory):
        yield _line("truth", results.truth.positions)
    if len(trajectory) > 1:
        yield _line("path", trajectory.positions, length_m=trajectory.distance_m)
    if trajectory.covariance is not None:
        yield _ellipses(trajectory)
    yield _poses(trajectory)
    fixes = _fixes(results.ledger)
    if len(fixes.geometries):
        yield fixes


def export_geopackage(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """GeoPackage of a run folder, see `write_geopackage`."""
    write_geopackage(read_results(folder), target)
    return (target,)


def export_geojson(folder: RunFolder, target: Path) -> tuple[Path, ...]:
    """GeoJSON of a run folder, see `write_geojson`."""
    write_geojson(read_results(folder), target)
    return (target,)


def write_geopackage(results: RunResults, path: Path) -> None:
    """Write all layers as one GeoPackage, in the map's projection.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    # pyogrio imports pandas where that is installed: seconds that no other command should wait.
    import pyogrio.errors
    import pyogrio.raw

    georeference = results.georeference
    crs = None if georeference is None else georeference.code or georeference.crs.to_wkt()
    beside = path.with_name(f".{path.stem}.{os.getpid()}.tmp.gpkg")
    try:
        for layer in layers(results):
            shapes = layer.geometries
            if georeference is not None:
                shapes = _transformed(shapes, georeference.to_plane)
            with warnings.catch_warnings():
                # A local map frame has no CRS, and the GeoPackage says so.
                warnings.filterwarnings("ignore", message="'crs' was not provided")
                # GDAL finds its own rounding in the entry that the first layer has made.
                warnings.filterwarnings("ignore", message="Passed SRS uses")
                pyogrio.raw.write(
                    beside,
                    shapely.to_wkb(shapes, output_dimension=3),
                    list(layer.columns.values()),
                    list(layer.columns),
                    layer=layer.name,
                    driver="GPKG",
                    geometry_type=layer.kind,
                    crs=crs,
                    append=beside.exists(),
                    layer_metadata={CRS_TAG: georeference.code} if georeference else None,
                )
        os.replace(beside, path)
    except (OSError, pyogrio.errors.DataSourceError) as error:
        raise InputError(f"cannot be written ({error})", source=path) from error
    finally:
        beside.unlink(missing_ok=True)


def write_geojson(results: RunResults, path: Path) -> None:
    """Write all layers as one GeoJSON collection; the property ``layer`` tells them apart.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    georeference = results.georeference
    features = []
    for layer in layers(results):
        shapes = layer.geometries
        if georeference is not None:
            shapes = _transformed(shapes, georeference.to_lonlat)
        for row, text in enumerate(shapely.to_geojson(shapes)):
            values = {name: _plain(column[row]) for name, column in layer.columns.items()}
            geometry = json.loads(text)
            properties = {"layer": layer.name, **values}
            features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    name = "map" if georeference is None else _geographic_name(georeference)
    content = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": name}},
        "features": features,
    }
    write_whole(path, json.dumps(content, allow_nan=False, separators=(",", ":")).encode())


def ellipse_axes(trajectory: Trajectory) -> tuple[FloatArray, FloatArray, FloatArray]:
    """1-sigma ellipses of the positions in the map's plane.

    Returns
    -------
    tuple of FloatArray
        (N,) major and minor semi-axes, m, and the direction of the major one,
        counter-clockwise from map x, rad.
    """
    block = trajectory.covariance_in("map")[:, 3:5, 3:5]
    values, vectors = np.linalg.eigh(block)
    minor, major = np.sqrt(np.maximum(values, 0.0)).T
    return major, minor, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])


def ellipse_outlines(trajectory: Trajectory, scale: float = 1.0) -> FloatArray:
    """Closed outlines (N, corners, 2) of the 1-sigma ellipses, `scale` times as large, m."""
    major, minor, angle = ellipse_axes(trajectory)
    t = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    a, b = scale * major[:, None] * np.cos(t), scale * minor[:, None] * np.sin(t)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    offset = np.stack([a * cos - b * sin, a * sin + b * cos], axis=-1)
    return np.asarray(trajectory.positions[:, None, :2] + offset)


def _line(name: str, points: FloatArray, **values: str | float) -> Layer:
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    line = np.array([shapely.LineString(points)], dtype=object)
    columns = {
        key: np.array([value], dtype=object if isinstance(value, str) else np.float64)
        for key, value in {"label": name, **values}.items()
    }
    return Layer(name, "LineString Z", line, columns)


def _ellipses(trajectory: Trajectory) -> Layer:
    outlines = ellipse_outlines(trajectory)
    height = np.broadcast_to(trajectory.positions[:, None, 2:], (*outlines.shape[:2], 1))
    polygons = shapely.polygons(np.concatenate([outlines, height], axis=-1))
    major, minor, angle = ellipse_axes(trajectory)
    columns = {
        "stamp_s": trajectory.stamp_s,
        "semi_major_m": major,
        "semi_minor_m": minor,
        "major_ccw_from_x_deg": np.rad2deg(angle),
    }
    return Layer("ellipses_1_sigma", "Polygon Z", polygons, columns)


def _poses(trajectory: Trajectory) -> Layer:
    rotation = trajectory.map_T_rover[:, :3, :3]
    columns: dict[str, Column] = {
        "stamp_s": trajectory.stamp_s,
        "yaw_deg": np.rad2deg(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])),
    }
    if trajectory.covariance is not None:
        variance = np.einsum("nii->ni", trajectory.covariance_in("map"))
        sigmas = np.sqrt(np.maximum(variance, 0.0))
        names = ("sigma_yaw_rad", "sigma_x_m", "sigma_y_m", "sigma_z_m")
        columns |= {name: sigmas[:, axis] for name, axis in zip(names, (2, 3, 4, 5), strict=True)}
    return Layer("poses", "Point Z", shapely.points(trajectory.positions), columns)


def _fixes(ledger: Sequence[LedgerEntry]) -> Layer:
    """Places of the absolute fixes: the believed one, else the best."""
    rows, places = [], []
    for entry in ledger:
        measurement = entry.measurement
        if not isinstance(measurement, AbsoluteFix) or not measurement.candidates:
            continue
        place = measurement.candidates[entry.ruling.candidate or 0]
        height = 0.0 if measurement.height_m is None else measurement.height_m
        places.append([place.x_m, place.y_m, height])
        rows.append(
            {
                **{k: v for k, v in entry_values(entry).items() if k in _FIX_COLUMNS},
                "yaw_deg": np.rad2deg(place.yaw_rad),
                "sigma_x_m": np.sqrt(place.covariance[0, 0]),
                "sigma_y_m": np.sqrt(place.covariance[1, 1]),
            }
        )
    names = rows[0] if rows else {}
    columns = {name: _column([row[name] for row in rows]) for name in names}
    points = np.array(places, dtype=np.float64).reshape(-1, 3)
    return Layer("fixes", "Point Z", shapely.points(points), columns)


def _column(values: list[Any]) -> Column:
    if all(isinstance(value, str) for value in values):
        return np.array(values, dtype=object)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _transformed(shapes: NDArray[np.object_], move: Any) -> NDArray[np.object_]:
    return np.asarray(shapely.transform(shapes, move, include_z=True))


def _geographic_name(georeference: Georeference) -> str:
    geographic = georeference.crs.geodetic_crs
    code = "" if geographic is None else authority_code(geographic)
    authority, _, number = code.partition(":")
    return f"urn:ogc:def:crs:{authority}::{number}" if code else georeference.body


def _plain(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
