"""Simulated datasets kept for the next time, by what they were made from."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from platformdirs import user_cache_path

from frontends.errors import InputError
from lunar_fg.simulation.dataset import SPEC_NAME
from lunar_fg.simulation.simulate import Progress, simulate
from lunar_fg.simulation.spec import SimulationSpec

#: Datasets that are kept; the least lately used goes first.
_KEPT = 6


def cached_dataset(
    spec: SimulationSpec,
    *,
    root: Path | None = None,
    workers: int | None = None,
    on_progress: Progress | None = None,
) -> Path:
    """Folder of a simulated dataset; rendered only when it is not there yet.

    Parameters
    ----------
    spec
        What to simulate.
    root
        Folder of the cache; default the user's cache folder.
    workers, on_progress
        See `lunar_fg.simulation.simulate.simulate`.

    Raises
    ------
    InputError
        As `simulate`; also when the cache cannot be written.
    """
    root = user_cache_path("lunar-fg") / "simulations" if root is None else root
    folder = root / spec.key()
    if (folder / SPEC_NAME).is_file():
        os.utime(folder)
        return folder
    # rendered beside and moved in whole: an interrupted run leaves nothing half-made
    beside = root / f".{spec.key()}.{os.getpid()}"
    try:
        simulate(spec, beside, workers=workers, on_progress=on_progress)
        if not (folder / SPEC_NAME).is_file():
            shutil.rmtree(folder, ignore_errors=True)
            beside.rename(folder)
    except OSError as error:
        remedy = "free some space, or set XDG_CACHE_HOME to a folder that can be written"
        raise InputError(f"cannot be written: {error}", source=root, remedy=remedy) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    _prune(root)
    return folder


def _prune(root: Path) -> None:
    whole = [path.parent for path in root.glob(f"*/{SPEC_NAME}")]
    whole.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    for path in whole[_KEPT:]:
        shutil.rmtree(path, ignore_errors=True)
