"""The results of a campaign: written one by one, found again after an interruption."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import pyarrow as arrow
import pyarrow.parquet as parquet

from frontends.errors import InputError
from lunar_fg.campaign.study import Study
from lunar_fg.campaign.trial import Outcome

_STUDY = "study.json"
_LINES = "results.jsonl"


@dataclass(frozen=True, slots=True)
class Results:
    """The folder of a campaign: ``study.json``, ``results.jsonl``, then Parquet and HTML."""

    path: Path

    @classmethod
    def open(cls, path: Path, study: Study) -> Results:
        """Start a campaign's folder, or go on with one of the same study.

        Raises
        ------
        InputError
            The folder belongs to another study, or cannot be written.
        """
        text = study.model_dump_json(by_alias=True, indent=2)
        described = path / _STUDY
        try:
            if described.exists():
                if described.read_text(encoding="utf-8") != text:
                    raise InputError(
                        "holds the results of another study", source=path,
                        remedy="choose another folder, or remove this one",
                    )  # fmt: skip
            else:
                path.mkdir(parents=True, exist_ok=True)
                if any(path.iterdir()):
                    raise InputError(
                        "is not empty", source=path, remedy="choose another folder for the results"
                    )
                described.write_text(text, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot be written ({error})", source=path) from error
        return cls(path)

    @property
    def table_path(self) -> Path:
        """The table, for pandas, DuckDB, R."""
        return self.path / "results.parquet"

    @property
    def page_path(self) -> Path:
        """The summary."""
        return self.path / "summary.html"

    def append(self, outcome: Outcome) -> None:
        """Write one outcome at once, on a line of its own."""
        with (self.path / _LINES).open("a+b") as lines:
            if lines.tell() > 0:
                lines.seek(-1, os.SEEK_END)
                if lines.read(1) != b"\n":  # an interruption cut the last line off
                    lines.write(b"\n")
            lines.write(json.dumps(asdict(outcome)).encode() + b"\n")

    def read(self) -> list[Outcome]:
        """Read all outcomes so far, by number; a line that an interruption spoiled is left out."""
        path = self.path / _LINES
        if not path.exists():
            return []
        found: dict[int, Outcome] = {}
        for line in path.read_bytes().splitlines():
            try:
                row = json.loads(line)
                outcome = Outcome(**{**row, "warnings": tuple(row["warnings"])})
            except (ValueError, TypeError, KeyError):
                continue
            found[outcome.number] = outcome
        return [found[number] for number in sorted(found)]

    def write_table(self, outcomes: Sequence[Outcome]) -> None:
        """Write the table as Parquet, a column a field."""
        columns = {
            field.name: [getattr(outcome, field.name) for outcome in outcomes]
            for field in fields(Outcome)
            if field.name != "warnings"
        }
        columns["warnings"] = [list(outcome.warnings) for outcome in outcomes]
        schema = arrow.schema([(name, _TYPES.get(name, arrow.float64())) for name in columns])
        parquet.write_table(arrow.table(columns, schema=schema), self.table_path)


_TYPES = {
    "number": arrow.int64(),
    "seed": arrow.int64(),
    "group": arrow.string(),
    "error": arrow.string(),
    "frames": arrow.int64(),
    "frames_lost": arrow.int64(),
    "fixes_tried": arrow.int64(),
    "fixes_right": arrow.int64(),
    "fixes_accepted": arrow.int64(),
    "fixes_accepted_right": arrow.int64(),
    "warnings": arrow.list_(arrow.string()),
}
