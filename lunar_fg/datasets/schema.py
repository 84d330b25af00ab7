"""``traverse.yaml``, version 1: the models and the errors they give."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from frontends.camera import StereoCamera, level_rover_T_camera
from frontends.errors import InputError
from frontends.geometry import is_rigid
from frontends.measurements import StartPrior, SunDirection
from lunar_fg.datasets.base import FloatArray, MapReference
from lunar_fg.datasets.strict_yaml import read_yaml

#: JSON Schema of the file, for editors; made by `json_schema_text`.
JSON_SCHEMA_PATH = Path(__file__).with_name("traverse.schema.json")

_LIMIT = 1e12
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-_LIMIT, le=_LIMIT)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0, le=_LIMIT)]
Pixels = Annotated[int, Field(strict=True, gt=0, le=20_000)]
Text = Annotated[str, Field(min_length=1, max_length=20_000)]
Azimuth = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-360.0, le=360.0)]
Elevation = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-90.0, le=90.0)]
_Row = tuple[Number, Number, Number, Number]
_Rows = tuple[_Row, _Row, _Row, _Row]


def _rigid(rows: _Rows) -> _Rows:
    if not is_rigid(np.array(rows)):
        raise ValueError(
            "is not a rigid transform: a right-handed rotation (to 1e-4), a translation in "
            "metres and the last row 0 0 0 1"
        )
    return rows


Transform = Annotated[_Rows, AfterValidator(_rigid)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CameraModel(_Strict):
    """The rectified pair; pixel (0, 0) is the centre of the top-left pixel."""

    width: Pixels
    height: Pixels
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    baseline_m: Positive

    def build(self) -> StereoCamera:
        """Make the camera of the frontends."""
        return StereoCamera(
            self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.baseline_m
        )


class MapModel(_Strict):
    """The map frame: CRS less origin (east, north, height; m)."""

    crs: Text
    origin: tuple[Number, Number, Number]


class StartModel(_Strict):
    """Where the rover starts, with sigmas about and along its own axes."""

    map_T_rover: Transform | None = None
    sigma_rot_rad: tuple[Positive, Positive, Positive] | None = None
    sigma_trans_m: tuple[Positive, Positive, Positive] | None = None


class OrbitalModel(_Strict):
    """Orbital maps; paths relative to the folder."""

    ortho: Text | None = None
    dem: Text | None = None
    sun_azimuth_deg: Azimuth | None = None
    sun_elevation_deg: Elevation | None = None

    @model_validator(mode="after")
    def _complete(self) -> OrbitalModel:
        if self.ortho is None and self.dem is None:
            raise ValueError("names neither an ortho image nor a DEM")
        if (self.sun_azimuth_deg is None) != (self.sun_elevation_deg is None):
            raise ValueError("sun_azimuth_deg and sun_elevation_deg go together")
        return self

    def sun(self) -> SunDirection | None:
        """Light of the ortho image."""
        if self.sun_azimuth_deg is None or self.sun_elevation_deg is None:
            return None
        return SunDirection(self.sun_azimuth_deg, self.sun_elevation_deg)


class SunModel(_Strict):
    """Direction to the Sun during the traverse, azimuth clockwise from map north."""

    azimuth_deg: Azimuth
    elevation_deg: Elevation


class Traverse(_Strict):
    """The whole file."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={"$schema": "https://json-schema.org/draft/2020-12/schema"},
    )

    version: Literal["lunar-fg/traverse/1"] = Field(alias="schema")
    camera: CameraModel
    rover_T_camera: Transform | None = None
    map: MapModel | None = None
    start: StartModel | None = None
    orbital: OrbitalModel | None = None
    sun: SunModel | None = None

    def camera_mount(self) -> FloatArray:
        """``rover_T_camera``, (4, 4); level and forward-looking where not given."""
        if self.rover_T_camera is None:
            return level_rover_T_camera()
        return np.array(self.rover_T_camera)

    def start_prior(self) -> StartPrior:
        """Prior of the first pose; identity and tight where not given."""
        default, start = StartPrior(), self.start or StartModel()
        return StartPrior(
            default.map_T_rover if start.map_T_rover is None else np.array(start.map_T_rover),
            start.sigma_rot_rad or default.sigma_rot_rad,
            start.sigma_trans_m or default.sigma_trans_m,
        )

    def map_reference(self) -> MapReference | None:
        """CRS and origin, where given."""
        return None if self.map is None else MapReference(self.map.crs, self.map.origin)

    def sun_direction(self) -> SunDirection | None:
        """Direction to the Sun, where given."""
        if self.sun is None:
            return None
        return SunDirection(self.sun.azimuth_deg, self.sun.elevation_deg)


def nearest_known(name: str, known: Iterable[str]) -> str:
    """Remedy for an unknown name: the nearest known one, or all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(name[:80], names, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names)}"


def read_traverse(path: Path) -> Traverse:
    """Read and check a ``traverse.yaml``.

    Raises
    ------
    InputError
        One line that names the file, the field, what is wrong and the remedy.
    """
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(
            "holds no keys",
            source=path,
            remedy="start with 'schema: lunar-fg/traverse/1'; docs/formats.md has an example",
        )
    try:
        return Traverse.model_validate(content)
    except ValidationError as error:
        raise _one_line(path, error) from error


def json_schema_text() -> str:
    """Text of the JSON Schema that is shipped beside this module."""
    return json.dumps(Traverse.model_json_schema(by_alias=True), indent=2) + "\n"


def _one_line(path: Path, error: ValidationError) -> InputError:
    problems = error.errors(include_url=False)
    # An unknown key explains a missing one better than the other way round.
    first = min(problems, key=lambda item: item["type"] != "extra_forbidden")
    loc = first["loc"]
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)[1:]
    kind, given = first["type"], " ".join(repr(first["input"]).split())
    remedy = "docs/formats.md has an example"
    if kind == "extra_forbidden":
        problem = "is not a known key"
        remedy = nearest_known(str(loc[-1]), _known_keys(loc[:-1]))
    elif kind == "missing":
        problem = "is missing"
    elif kind == "value_error":
        problem = first["msg"].removeprefix("Value error, ")
    else:
        message = first["msg"][:1].lower() + first["msg"][1:]
        problem = f"is {given[:60]}{'...' if len(given) > 60 else ''}: {message}"
    if len(problems) > 1:
        problem += f"; {len(problems) - 1} more to correct"
    field = " ".join(field.split())[:120] or "traverse"
    return InputError(" ".join(problem.split()), source=path, field=field, remedy=remedy)


def _known_keys(loc: tuple[int | str, ...]) -> list[str]:
    sections: dict[str, type[BaseModel]] = {
        "camera": CameraModel,
        "map": MapModel,
        "start": StartModel,
        "orbital": OrbitalModel,
        "sun": SunModel,
    }
    model = sections.get(str(loc[0]), Traverse) if loc else Traverse
    return [info.alias or name for name, info in model.model_fields.items()]
