"""All settings of a run, checked; what a run used is written beside its results."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from frontends.absolute import AbsoluteConfig
from frontends.disparity_check import DisparityCheckConfig
from frontends.errors import InputError
from frontends.relative import RelativeConfig
from frontends.stereo import StereoConfig
from frontends.terrain import DenseStereoConfig
from frontends.tracking import TrackingConfig
from lunar_fg.datasets.strict_yaml import read_yaml
from lunar_fg.graph.config import GraphConfig
from lunar_fg.localisation import LocalisationConfig
from lunar_fg.loop_closing import LoopClosingConfig
from lunar_fg.motion_config import MotionConfig
from lunar_fg.orbital_files import MapConfig
from lunar_fg.route import RouteConfig

_CORRELATION = "landmark_correlation"
#: Settings of `absolute` that are gone, with the values that older files have.
_GONE = {"inflation": 1.8, "floor_pixels": 0.1}


class Config(BaseModel):
    """Settings of the navigator, one group a part.

    Attributes
    ----------
    seed
        Of every random choice.
    stereo, tracking, relative, disparity_check, motion, graph, route, map, localisation,
    absolute, dense, loop_closing
        See the classes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = Field(default=0, ge=0)
    stereo: StereoConfig = Field(default_factory=StereoConfig)
    tracking: TrackingConfig = Field(default_factory=TrackingConfig)
    relative: RelativeConfig = Field(default_factory=RelativeConfig)
    disparity_check: DisparityCheckConfig = Field(default_factory=DisparityCheckConfig)
    motion: MotionConfig = Field(default_factory=MotionConfig)
    graph: GraphConfig = Field(default_factory=GraphConfig)
    route: RouteConfig = Field(default_factory=RouteConfig)
    map: MapConfig = Field(default_factory=MapConfig)
    localisation: LocalisationConfig = Field(default_factory=LocalisationConfig)
    absolute: AbsoluteConfig = Field(default_factory=AbsoluteConfig)
    dense: DenseStereoConfig = Field(default_factory=DenseStereoConfig)
    loop_closing: LoopClosingConfig = Field(default_factory=LoopClosingConfig)

    @model_validator(mode="before")
    @classmethod
    def _without_inflation(cls, data: object) -> object:
        """Leave out what a fix's covariance no longer needs, where a file has its old default."""
        absolute = data.get("absolute") if isinstance(data, dict) else None
        if not isinstance(data, dict) or not isinstance(absolute, dict):
            return data
        kept = {k: v for k, v in absolute.items() if k not in _GONE or v != _GONE[k]}
        return {**data, "absolute": kept}

    @model_validator(mode="before")
    @classmethod
    def _correlation_in_one_place(cls, data: object) -> object:
        """Take `relative.landmark_correlation`, where files had it too, as the graph's."""
        if not isinstance(data, dict) or not isinstance(data.get("relative"), dict):
            return data
        relative, graph = dict(data["relative"]), data.get("graph") or {}
        if _CORRELATION not in relative or not isinstance(graph, dict):
            return data
        value = relative.pop(_CORRELATION)
        if graph.get(_CORRELATION, value) != value:
            raise ValueError(
                f"relative.{_CORRELATION} is graph.{_CORRELATION} now: leave the former out"
            )
        return {**data, "relative": relative, "graph": {**graph, _CORRELATION: value}}


def read_config(path: Path) -> Config:
    """Read settings from YAML; keys that are left out keep their default.

    Raises
    ------
    InputError
        When the file cannot be read, or a key or value is wrong.
    """
    data = read_yaml(path)
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            str(first["msg"]).lower(),
            source=path,
            field=".".join(str(part) for part in first["loc"]),
            remedy="config.yaml of any run folder lists all keys",
        ) from error
