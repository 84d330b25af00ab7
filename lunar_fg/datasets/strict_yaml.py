"""YAML for untrusted files: bounded, no tags, no aliases, no repeated keys."""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any, cast

import yaml

from frontends.errors import InputError

MAX_BYTES = 1_000_000
MAX_DEPTH = 20
#: Python prints no integer of more than 4300 digits.
MAX_PLAIN_CHARACTERS = 3000

#: YAML 1.2 floats: PyYAML alone takes ``1e-3`` for text.
_FLOAT = re.compile(
    r"^[-+]?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+"
    r"|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$"
)


#: What OpenCV's files hold beyond YAML: their directive, and tags of types known from the keys.
_OPENCV_MARKS = re.compile(r"\A%YAML:1\.0[^\n]*|(?<=:) *!!opencv-(?:nd-)?matrix\b")


def _is_long_and_plain(event: yaml.ScalarEvent) -> bool:
    return event.style is None and len(event.value) > MAX_PLAIN_CHARACTERS


class _StrictLoader(yaml.SafeLoader):
    """`yaml.SafeLoader` that refuses tags, aliases, deep nesting and repeated keys."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = cast(Any, self).peek_event()
        problem = ""
        if isinstance(event, yaml.AliasEvent):
            problem = f"aliases (*{event.anchor}) are not allowed"
        elif getattr(event, "tag", None) is not None:
            problem = f"tags ({event.tag}) are not allowed"
        elif isinstance(event, yaml.ScalarEvent) and _is_long_and_plain(event):
            problem = f"a value without quotes is longer than {MAX_PLAIN_CHARACTERS} characters"
        elif self._depth >= MAX_DEPTH:
            problem = f"is nested deeper than {MAX_DEPTH}"
        if problem:
            raise yaml.composer.ComposerError(None, None, problem, event.start_mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key.value!r} is there twice", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


_StrictLoader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


def read_opencv_yaml(path: Path) -> object:
    """Content of a YAML file in OpenCV's dialect: ``%YAML:1.0`` and ``!!opencv-matrix``.

    Both are blanked, so that line numbers stay; plain YAML passes as it is. Raises what
    `read_yaml` raises.
    """
    return _parse(_OPENCV_MARKS.sub("", _read_text(path)), path)


def read_yaml(path: Path) -> object:
    """Content of a small YAML file as plain Python values.

    Raises
    ------
    InputError
        When the file cannot be read, is larger than 1 MB, is no YAML, or uses tags,
        aliases, repeated keys or deep nesting.
    """
    return _parse(_read_text(path), path)


def _read_text(path: Path) -> str:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"has {size} bytes, more than {MAX_BYTES}",
                source=path,
                remedy="give a hand-written file",
            )
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", source=path, remedy="check the path and its rights"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", source=path, remedy="save it as UTF-8") from error


def _parse(text: str, path: Path) -> object:
    loader: _StrictLoader | None = None
    try:
        loader = _StrictLoader(text)
        return cast(object, loader.get_single_data())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise InputError(
            _brief(error.problem or "is not YAML"),
            source=path,
            field=None if mark is None else f"line {mark.line + 1}",
            remedy="docs/formats.md has an example",
        ) from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(
            _brief(f"is not YAML: {error}"),
            source=path,
            remedy="docs/formats.md has an example",
        ) from error
    finally:
        if loader is not None:
            loader.dispose()


def _brief(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 200 else f"{line[:200]}..."
