"""Pages that are made when the site is built: what the code says of itself.

The commands come from typer, the settings from pydantic, the benchmark tables from the JSON in
``docs/benchmarks``. Pages of ``docs/`` that the navigation does not name are put under "Parts".
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import typer
from griffe import Docstring, DocstringSectionKind
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from pydantic import BaseModel, TypeAdapter
from typer.cli import get_docs_for_click

from lunar_fg.cli import app
from lunar_fg.config import Config

#: Modules of each package whose public names make its reference, in reading order.
REFERENCE = {
    "frontends": (
        "measurements", "camera", "stereo", "tracking", "relative", "detector", "surf.surf",
        "matching.nearest", "matching.homography", "matching.epipolar",
        "matching.chance", "mosaic", "disparity_check", "terrain.dense", "terrain.map",
        "terrain.hazards", "orbital", "absolute.adjustment", "photometry", "errors",
    ),
    "lunar_fg": (
        "navigator", "config", "runs", "log", "trajectory", "trajectory_io", "datasets.base",
        "datasets.opening", "graph.incremental", "graph.batch", "graph.keyframe",
        "evaluation.comparison", "evaluation.consistency", "evaluation.drift",
        "evaluation.alignment", "route", "route_file", "georeference", "geo_export", "results",
        "report.page",
    ),
}  # fmt: skip


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put pages that the navigation does not name under "Parts"."""
    docs = Path(config.docs_dir)
    nav = config.nav or []
    named = set(_named(nav))
    others = sorted(path.name for path in docs.glob("*.md") if path.name not in named)
    for entry in nav:
        if isinstance(entry, dict) and "Parts" in entry:
            entry["Parts"] = [*others, "benchmarks/surf.md"]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from the code."""
    pages = {
        "reference/commands.md": commands_page(),
        "reference/configuration.md": configuration_page(),
        "reference/benchmarks.md": benchmarks_page(Path(config.docs_dir) / "benchmarks"),
        **{f"reference/{name}.md": package_page(name) for name in REFERENCE},
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def commands_page() -> str:
    """All commands with their help, arguments and options, from typer."""
    command = typer.main.get_command(app)
    context = typer.Context(command, info_name="lunar-fg")
    text = get_docs_for_click(obj=command, ctx=context, name="lunar-fg", title="Commands")
    # The help's examples are plain text: make them code that can be copied.
    return re.sub(r"^Example: (lunar-fg .*)$", r"```\n\1\n```", text, flags=re.M)


def configuration_page() -> str:
    """All settings with type, default, bounds and meaning, from pydantic."""
    lines = [
        "# Configuration",
        "",
        "Give what differs from the defaults as YAML:",
        "`lunar-fg run DATASET --config my.yaml -o RUN`.",
        "`config.yaml` in a run's folder lists every setting that was in effect.",
        "",
    ]
    groups = {name: _group(field.annotation) for name, field in Config.model_fields.items()}
    grouped = {name: group for name, group in groups.items() if group is not None}
    lines += ["## Run", "", *_settings(Config, grouped)]
    for name, group in grouped.items():
        lines += [f"## {name}", "", _summary(group), "", *_settings(group)]
    return "\n".join(lines) + "\n"


def benchmarks_page(folder: Path) -> str:
    """Every benchmark's JSON as tables."""
    lines = [
        "# Benchmarks",
        "",
        "Made from the JSON files that the programs in `benchmarks/` write; the texts beside "
        "them say how and on what machine.",
        "",
    ]
    for path in sorted(folder.glob("*.json")):
        lines += [f"## {path.stem.replace('_', ' ')}", ""]
        lines += _tables(json.loads(path.read_text(encoding="utf-8")), 3)
    return "\n".join(lines) + "\n"


def package_page(name: str) -> str:
    """API reference of a package."""
    modules = [f"::: {name}.{module}\n" for module in REFERENCE[name]]
    return f"# {name}\n\n" + "\n".join(modules)


def _named(nav: Any) -> Iterator[str]:
    if isinstance(nav, str):
        yield nav
    for entry in nav if isinstance(nav, list) else []:
        yield from _named(entry)
    for entry in nav.values() if isinstance(nav, dict) else []:
        yield from _named(entry)


def _group(annotation: Any) -> type | None:
    """A group of settings: a pydantic model or a dataclass; None for a plain value."""
    if not isinstance(annotation, type):
        return None
    grouped = issubclass(annotation, BaseModel) or is_dataclass(annotation)
    return annotation if grouped else None


def _summary(group: type) -> str:
    return (group.__doc__ or "").strip().split("\n\n")[0]


def _settings(group: type, leave_out: Collection[str] = ()) -> Iterator[str]:
    meanings = _meanings(group)
    yield "| setting | default | allowed | meaning |"
    yield "|---|---|---|---|"
    for name, schema in TypeAdapter(group).json_schema()["properties"].items():
        if name in leave_out:
            continue
        cells = (f"`{name}`", f"`{schema['default']}`", _allowed(schema), meanings.get(name, ""))
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
    yield ""


def _allowed(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    options = [_allowed(option) for option in schema.get("anyOf", ())]
    if options:
        return " or ".join(options)
    signs = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    bounds = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    return " ".join([str(schema.get("type", "")), *bounds])


def _meanings(group: type) -> dict[str, str]:
    """Descriptions of the attributes in a class's docstring."""
    found: dict[str, str] = {}
    sections = Docstring(group.__doc__ or "", lineno=1).parse("numpy", warnings=False)
    for section in sections:
        if section.kind is DocstringSectionKind.attributes:
            for item in section.value:
                for name in item.name.split(", "):
                    found[name] = " ".join(item.description.split()).replace("``", "`")
    return found


def _tables(value: Any, level: int) -> Iterator[str]:
    """Tables of nested JSON: scalars as a list, equal records as rows, the rest by heading."""
    if isinstance(value, list):
        value = {str(number): item for number, item in enumerate(value)}
    scalars = {key: item for key, item in value.items() if not isinstance(item, dict | list)}
    if scalars:
        yield from _table(("", "value"), list(scalars.items()))
    records = {key: item for key, item in value.items() if _is_record(item)}
    shapes = {tuple(_fields(item)) for item in records.values()}
    if len(records) > 1 and len(shapes) == 1:
        head = ("", *shapes.pop())
        rows = [(key, *_fields(item).values()) for key, item in records.items()]
        yield from _table(head, rows)
        records = dict.fromkeys(records)
    else:
        records = {}
    for key, item in value.items():
        if key not in records and key not in scalars and item:
            yield f"{'#' * min(level, 6)} {key}"
            yield ""
            yield from _tables(item, level + 1)


def _is_record(item: Any) -> bool:
    return (
        bool(item)
        and isinstance(item, dict | list)
        and all(not isinstance(cell, dict | list) for cell in _fields(item).values())
    )


def _fields(item: Any) -> dict[str, Any]:
    return item if isinstance(item, dict) else {str(i): cell for i, cell in enumerate(item)}


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> Iterator[str]:
    yield "| " + " | ".join(head) + " |"
    yield "|---" + "|--:" * (len(head) - 1) + "|"
    for row in rows:
        yield "| " + " | ".join(_cell(cell) for cell in row) + " |"
    yield ""


def _cell(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("|", "\\|")
