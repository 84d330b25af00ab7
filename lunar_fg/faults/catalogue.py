"""All faults by name, and how a user writes them: ``slip@40-60``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from types import MappingProxyType

from frontends.errors import InputError
from lunar_fg.datasets.schema import nearest_known
from lunar_fg.faults.base import Fault, Span
from lunar_fg.faults.images import (
    ExposureJumps,
    EyeLost,
    FrozenCamera,
    LensDust,
    Misalignment,
    MotionBlur,
)
from lunar_fg.faults.maps import MapError, WrongMap
from lunar_fg.faults.sensors import (
    AttitudeBias,
    ClockBack,
    ClockJump,
    WheelSlip,
    WheelsOnly,
    WrongBaseline,
)
from lunar_fg.faults.sequence import Dropped, Kidnapped, Swapped

#: Fault by name.
FAULTS: Mapping[str, Callable[[Span], Fault]] = MappingProxyType(
    {
        "dropped": Dropped,
        "swapped": Swapped,
        "kidnapped": Kidnapped,
        "frozen": FrozenCamera,
        "eye-lost": EyeLost,
        "dust": LensDust,
        "exposure": ExposureJumps,
        "blur": MotionBlur,
        "misalignment": Misalignment,
        "baseline": WrongBaseline,
        "slip": WheelSlip,
        "attitude-bias": AttitudeBias,
        "wheels-only": WheelsOnly,
        "clock-jump": ClockJump,
        "clock-back": ClockBack,
        "map-place": lambda span: WrongMap(span, MapError.PLACE),
        "map-scale": lambda span: WrongMap(span, MapError.SCALE),
        "map-rotated": lambda span: WrongMap(span, MapError.ROTATED),
        "map-seam": lambda span: WrongMap(span, MapError.SEAM),
    }
)

_WRITTEN = re.compile(r"(?P<name>[a-z-]+)@(?P<first>\d{1,9})(?:-(?P<last>\d{1,9}))?")


def parse_fault(text: str) -> Fault:
    """Read a fault from ``NAME@FIRST`` or ``NAME@FIRST-LAST`` (frames counted from 0).

    Raises
    ------
    InputError
        When there is no such fault, or its span cannot be read.
    """
    written = _WRITTEN.fullmatch(text)
    if written is None:
        raise InputError(
            f"{text!r} cannot be read", source="--inject",
            remedy="write NAME@FIRST-LAST, e.g. frozen@40-60",
        )  # fmt: skip
    name = written["name"]
    if name not in FAULTS:
        raise InputError(
            f"there is no fault {name!r}", source="--inject",
            remedy=nearest_known(name, list(FAULTS)),
        )  # fmt: skip
    first = int(written["first"])
    last = int(written["last"] or first)
    if last < first:
        raise InputError(
            f"{text!r} ends before it begins", source="--inject", remedy="write FIRST-LAST"
        )
    return FAULTS[name](Span(first, last))
