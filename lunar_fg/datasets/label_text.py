"""Text of PDS3 and VICAR labels to nested groups of items, from a bounded part of the file.

PDS3 labels are parsed by pvl. VICAR labels are lists of ``KEY=VALUE`` in which
``PROPERTY='NAME'`` begins a group. Both give the same nested mapping.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pvl
from pvl.decoder import OmniDecoder
from pvl.grammar import OmniGrammar
from pvl.parser import PVLParser

from frontends.errors import InputError

MAX_LABEL_BYTES = 256_000
_VICAR_ITEM = re.compile(r"(\w+)\s*=\s*(\((?:[^()']|'[^']*')*\)|'(?:[^']|'')*'|[^\s']+)")
_END = re.compile(rb"(?:^|[\r\n])\s*END\s*(?:[\r\n]|$)")


def is_label(path: Path) -> bool:
    """Whether a file begins like a PDS3 or VICAR label."""
    try:
        with path.open("rb") as file:
            head = file.read(400)
    except OSError:
        return False
    return b"PDS_VERSION_ID" in head or head.startswith((b"LBLSIZE=", b"ODL_VERSION_ID"))


@dataclass(frozen=True, slots=True)
class LabelGroup:
    """A group of a label; values are checked as they are asked for.

    Attributes
    ----------
    path
        Of the label, for errors.
    values
        Items by name; groups within the group are mappings, too.
    """

    path: Path
    values: Mapping[str, object]

    def group(self, *names: str) -> LabelGroup:
        """The first of these groups that is there; an empty one if none is."""
        for name in names:
            found = self.values.get(name)
            if isinstance(found, Mapping):
                return LabelGroup(self.path, found)
        return LabelGroup(self.path, {})

    def text(self, name: str, default: str = "") -> str:
        """An item as text."""
        value = self.values.get(name)
        return default if value is None or isinstance(value, Mapping) else str(value).strip()

    def numbers(self, name: str, count: int | None = None) -> list[float] | None:
        """An item as finite numbers, without units; None where it is no number.

        Raises
        ------
        InputError
            A number is out of range, or there are not `count`.
        """
        value = self.values.get(name)
        if value is None:
            return None
        # a quantity with its unit is a tuple, too
        several = isinstance(value, list | tuple) and not hasattr(value, "units")
        items: list[Any] = list(cast(Any, value)) if several else [value]
        try:
            numbers = [float(getattr(item, "value", item)) for item in items]
        except (TypeError, ValueError):
            return None
        if not all(math.isfinite(number) and abs(number) < 1e12 for number in numbers):
            raise InputError("holds a number out of range", source=self.path, field=name)
        if count is not None and len(numbers) != count:
            raise InputError(
                f"has {len(numbers)} values, must have {count}",
                source=self.path,
                field=name,
                remedy="the label is damaged: fetch the product again",
            )
        return numbers

    def whole(self, name: str) -> int | None:
        """An item as one whole number."""
        numbers = self.numbers(name)
        return None if not numbers or numbers[0] != int(numbers[0]) else int(numbers[0])


def read_label_text(path: Path) -> tuple[LabelGroup, bool]:
    """Items of a label, and whether it is a VICAR one; from a bounded part of the file.

    Raises
    ------
    InputError
        It cannot be read, or is neither a PDS3 nor a VICAR label.
    """
    head = _read(path)
    if head.startswith(b"LBLSIZE="):
        return LabelGroup(path, _vicar(path, head)), True
    return LabelGroup(path, _pvl(path, head)), False


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            head = file.read(MAX_LABEL_BYTES)
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", source=path, remedy="check the path and its rights"
        ) from error
    if not head:
        raise InputError("is an empty file", source=path)
    return head


def _pvl(path: Path, head: bytes) -> Mapping[str, object]:
    end = _END.search(head)
    if end is None:
        raise InputError(
            f"has no END within {MAX_LABEL_BYTES} bytes",
            source=path,
            field="label",
            remedy="the file is cut off, or no PDS3 label",
        )
    text = head[: end.end()].decode("latin-1")
    try:
        found = pvl.loads(text, parser=_strict_parser())
    # pvl raises its own errors and, on garbage, whatever its parser runs into
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, StopIteration,
            RecursionError) as error:  # fmt: skip
        brief = " ".join(str(error).split())[:150]
        raise InputError(
            f"is no PDS3 label: {brief}", source=path, field="label", remedy="fetch it again"
        ) from error
    return dict(found)


def _strict_parser() -> Any:
    """Accept what missions write; give up at the first thing that is none of it.

    pvl's default parser goes on after errors, which a damaged label turns into hours.
    """
    grammar = OmniGrammar()
    return PVLParser(grammar=grammar, decoder=OmniDecoder(grammar=grammar))


def _vicar(path: Path, head: bytes) -> Mapping[str, object]:
    match = re.match(rb"LBLSIZE=(\d{1,7})\s", head)
    size = 0 if match is None else int(match[1])
    if not 0 < size <= min(len(head), MAX_LABEL_BYTES):
        raise InputError(
            f"states a label of {size} bytes", source=path, field="LBLSIZE",
            remedy="the file is cut off, or no VICAR image",
        )  # fmt: skip
    text = head[:size].split(b"\0")[0].decode("latin-1")
    groups: dict[str, object] = {}
    current = groups
    for name, value in _VICAR_ITEM.findall(text):
        if name in ("PROPERTY", "TASK"):
            current = groups.setdefault(value.strip("'"), {})  # type: ignore[assignment]
            continue
        if isinstance(current, dict):
            current.setdefault(name, _vicar_value(value))
    _as_pds(path, groups)
    return groups


def _vicar_value(text: str) -> object:
    if text.startswith("("):
        return [_vicar_value(item.strip()) for item in re.findall(r"'[^']*'|[^,()]+", text)]
    return text.strip("'")


def _as_pds(path: Path, groups: dict[str, object]) -> None:
    """Put VICAR's system items and groups where PDS3 has them."""
    bits = {"BYTE": 8, "HALF": 16, "FULL": 32, "REAL": 32}.get(str(groups.get("FORMAT")), 0)
    image = {"LINES": groups.get("NL"), "LINE_SAMPLES": groups.get("NS"), "SAMPLE_BITS": bits}
    extra = groups.get("IMAGE_DATA") or groups.get("IMAGE")
    groups["IMAGE"] = {**(extra if isinstance(extra, dict) else {}), **image}
    for name in ("IDENTIFICATION", "TELEMETRY"):
        values = groups.get(name)
        if isinstance(values, dict):
            for key, value in values.items():
                groups.setdefault(key, value)
