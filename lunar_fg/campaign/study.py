"""What a campaign tries: a base, what varies, and the seeds (``STUDY.yaml``)."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from frontends.errors import InputError
from lunar_fg.config import Config
from lunar_fg.datasets.strict_yaml import read_yaml
from lunar_fg.faults import parse_fault
from lunar_fg.simulation.measurements import TraverseSpec
from lunar_fg.simulation.spec import checked_spec

#: More runs than this are a slip of the pen.
MOST_TRIALS = 100_000

_TRAVERSE = TypeAdapter(TraverseSpec)


class Base(BaseModel):
    """One run: where its measurements come from, and how they are used.

    Attributes
    ----------
    dataset
        A recorded sequence. Or:
    simulate
        Settings of a rendered traverse, as `lunar-fg simulate` takes them. Or:
    measurements
        Settings of a traverse without images, `lunar_fg.simulation.measurements`.
    config
        Settings that differ from the defaults.
    faults
        What goes wrong, e.g. ``["frozen@20-30"]``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: Path | None = None
    simulate: dict[str, Any] | None = None
    measurements: dict[str, Any] | None = None
    config: dict[str, Any] = Field(default_factory=dict)
    faults: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        sources = (self.dataset, self.simulate, self.measurements)
        if sum(source is not None for source in sources) != 1:
            raise ValueError("needs one of dataset, simulate, measurements")
        Config.model_validate(self.config)
        for fault in self.faults:
            parse_fault(fault)
        if self.simulate is not None:
            checked_spec(self.simulate, "study, simulate")
        if self.measurements is not None:
            if self.faults:
                raise ValueError("faults are injected into frames, and measurements have none")
            self.traverse()
        return self

    def traverse(self) -> TraverseSpec:
        """Settings of a traverse without images."""
        return _TRAVERSE.validate_python(self.measurements or {})


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of a campaign.

    Attributes
    ----------
    number
        Its place in the study, from 0.
    seed
        Of everything random in it.
    varied
        What differs from the base, by dotted key.
    base
        All its settings.
    """

    number: int
    seed: int
    varied: Mapping[str, Any]
    base: Base

    @property
    def group(self) -> str:
        """What it varies, as text; trials that differ by the seed alone share it."""
        last = [key.rsplit(".", 1)[-1] for key in self.varied]
        names = last if len(set(last)) == len(last) else list(self.varied)
        values = map(_text, self.varied.values())
        return (
            ", ".join(f"{key} {value}" for key, value in zip(names, values, strict=True)) or "all"
        )


class Study(BaseModel):
    """A campaign.

    Attributes
    ----------
    name
        For titles.
    base
        What all runs share.
    vary
        Values by dotted key into the base; every combination is run.
    seeds
        How many (0, 1, ...), or which.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_name: Literal["lunar-fg/study/1"] = Field(alias="schema")
    name: Annotated[str, Field(min_length=1, max_length=200)]
    base: Base
    vary: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    seeds: Annotated[int, Field(ge=1, le=MOST_TRIALS)] | list[Annotated[int, Field(ge=0)]] = 1

    def trials(self) -> list[Trial]:
        """Every run, checked.

        Raises
        ------
        InputError
            A combination cannot be run, or there are too many.
        """
        seeds = list(range(self.seeds)) if isinstance(self.seeds, int) else self.seeds
        combinations = [
            dict(zip(self.vary, values, strict=True))
            for values in itertools.product(*self.vary.values())
        ]
        if len(seeds) * len(combinations) > MOST_TRIALS:
            raise InputError(
                f"asks for {len(seeds) * len(combinations)} runs, {MOST_TRIALS} is the most",
                source="study", field="vary", remedy="vary less, or take fewer seeds",
            )  # fmt: skip
        plain = self.base.model_dump(exclude_none=True)
        bases = [(varied, _with(plain, varied)) for varied in combinations]
        return [
            Trial(number, seed, varied, base)
            for number, ((varied, base), seed) in enumerate(itertools.product(bases, seeds))
        ]


def read_study(path: Path) -> Study:
    """Read and check ``STUDY.yaml``; a relative dataset path is relative to the file.

    Raises
    ------
    InputError
        Names file, field and what is wrong.
    """
    data = read_yaml(path)
    try:
        study = Study.model_validate(data)
    except ValidationError as error:
        raise _named(error, path) from error
    if study.base.dataset is not None:
        dataset = (path.parent / study.base.dataset).resolve()
        study = study.model_copy(
            update={"base": study.base.model_copy(update={"dataset": dataset})}
        )
    study.trials()
    return study


def _with(plain: Mapping[str, Any], varied: Mapping[str, Any]) -> Base:
    settings = copy.deepcopy(dict(plain))
    for key, value in varied.items():
        *way, last = key.split(".")
        place = settings
        for step in way:
            place = place.setdefault(step, {})
            if not isinstance(place, dict):
                raise InputError(
                    f"{step} is a value, not a group", source="study", field=f"vary.{key}"
                )
        place[last] = value
    try:
        return Base.model_validate(settings)
    except ValidationError as error:
        raise _named(error, f"study, {dict(varied)}") from error


def _named(error: ValidationError, source: Path | str) -> InputError:
    first = error.errors()[0]
    return InputError(
        str(first["msg"]).removeprefix("Value error, ").lower(),
        source=source,
        field=".".join(str(part) for part in first["loc"]),
        remedy="docs/campaigns.md has examples",
    )


def _text(value: Any) -> str:
    return " + ".join(map(str, value)) or "none" if isinstance(value, list) else str(value)
