"""The state of the installation."""

from __future__ import annotations

import sys
from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from lunar_fg.commands.shared import out
from lunar_fg.doctor import diagnose


def doctor(
    json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Look at the installation: versions, compiled kernels, disk, threads.

    Exit code 1 when something should be mended.

    Example: lunar-fg doctor
    """
    found = diagnose(Path.cwd())
    if json:
        sys.stdout.write(dumps(asdict(found), indent=2) + "\n")
    else:
        out.print(f"lunar-fg {found.version}, Python {found.python}, {found.system}", markup=False)
        for name, version in found.packages.items():
            out.print(f"  {name:32} {version or '-'}", markup=False)
        out.print(f"kernels    {found.kernels_cached} of {found.kernels} compiled", markup=False)
        out.print(f"disk       {found.free_bytes / 1e9:.0f} GB free here", markup=False)
        out.print(
            f"threads    {found.processors} processors, OpenCV uses {found.opencv_threads}",
            markup=False,
        )
        for name, value in found.environment.items():
            out.print(f"  {name}={value}", markup=False)
        for text in found.hints:
            out.print(f"hint: {text}", markup=False)
        for text in found.problems:
            out.print(f"problem: {text}", style="red", markup=False)
        if not found.problems:
            out.print("all is well", style="green")
    if found.problems:
        raise typer.Exit(1)
