"""Compile the kernels."""

from __future__ import annotations

from lunar_fg.commands.shared import out
from lunar_fg.warmup import warmup as warm_up


def warmup() -> None:
    """Compile all kernels now, so that the first run starts at once.

    Example: lunar-fg warmup
    """
    out.print(f"kernels ready after {warm_up():.1f} s")
