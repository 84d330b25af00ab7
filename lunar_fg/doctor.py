"""The state of an installation: versions, compiled kernels, disk, threads."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import cv2

from frontends.errors import DependencyError
from lunar_fg import __version__
from lunar_fg.dependencies import check_dependencies

#: What a run needs, and what the extras bring: distribution by extra ("" for none).
PACKAGES = {
    "numpy": "",
    "gtsam": "",
    "opencv-contrib-python-headless": "",
    "numba": "",
    "scipy": "",
    "rasterio": "",
    "pyproj": "",
    "pyogrio": "",
    "plotly": "",
    "rerun-sdk": "viz",
    "rosbags": "bags",
    "distributed": "cluster",
}
#: A run of an hour at one frame a second writes about this much, bytes.
ROOMY_BYTES = 2_000_000_000


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What `lunar-fg doctor` found.

    Attributes
    ----------
    version, python, system
        Of lunar-fg, of the interpreter, of the machine.
    packages
        Version by distribution; None where it is not installed.
    kernels_cached, kernels
        How many compiled kernels lie on disk, and how many there are.
    cache
        Folder of the compiled kernels.
    free_bytes
        On the disk of the present folder.
    processors, opencv_threads
        That this process may use, and that OpenCV uses.
    environment
        Settings of threads and caches that are in effect.
    problems
        What should be mended, with the remedy; empty when all is well.
    hints
        What is worth knowing.
    """

    version: str
    python: str
    system: str
    packages: dict[str, str | None]
    kernels_cached: int
    kernels: int
    cache: str
    free_bytes: int
    processors: int
    opencv_threads: int
    environment: dict[str, str]
    problems: tuple[str, ...]
    hints: tuple[str, ...]


def diagnose(folder: Path) -> Diagnosis:
    """Look at the installation; `folder` is where runs would be written."""
    packages = {name: _version(name) for name in PACKAGES}
    cached, total, cache = _kernels()
    free = shutil.disk_usage(folder).free
    problems = [
        f"{name} is not installed: pip install {name}"
        for name, extra in PACKAGES.items()
        if packages[name] is None and not extra
    ]
    try:
        check_dependencies()
    except DependencyError as error:
        problems.append(str(error))
    if free < ROOMY_BYTES:
        problems.append(
            f"only {free / 1e9:.1f} GB are free here: a long run may need {ROOMY_BYTES / 1e9:.0f}"
        )
    if cache and not os.access(cache, os.W_OK):
        problems.append(
            f"{cache} cannot be written: kernels are compiled anew in every process; "
            "set NUMBA_CACHE_DIR to a folder of yours"
        )
    hints = [
        f'{name} is not installed: pip install "lunar-fg[{extra}]" brings it'
        for name, extra in PACKAGES.items()
        if packages[name] is None and extra
    ]
    if cached < total:
        hints.append("not all kernels are compiled: lunar-fg warmup does it now, about a minute")
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "NUMBA_CACHE_DIR")
    return Diagnosis(
        version=__version__,
        python=platform.python_version(),
        system=f"{platform.system()} {platform.machine()}",
        packages=packages,
        kernels_cached=cached,
        kernels=total,
        cache=cache,
        free_bytes=free,
        processors=_processors(),
        opencv_threads=cv2.getNumThreads(),
        environment={name: os.environ[name] for name in names if name in os.environ},
        problems=tuple(problems),
        hints=tuple(hints),
    )


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _kernels() -> tuple[int, int, str]:
    """Kernels with code on disk that is not older than their source; all; the folder."""
    import lunar_fg.navigator  # noqa: F401 - brings in every module with kernels

    found: dict[str, bool] = {}
    folder = ""
    for name, module in list(sys.modules.items()):
        if not name.startswith(("frontends.", "lunar_fg.")):
            continue
        for item in vars(module).values():
            path = getattr(getattr(item, "stats", None), "cache_path", None)
            if not path:
                continue
            source = Path(item.py_func.__code__.co_filename)
            pattern = f"{source.stem}.{item.py_func.__name__}-*.nbi"
            newest = max((f.stat().st_mtime for f in Path(path).glob(pattern)), default=0.0)
            folder = folder or str(path)
            found[f"{source}:{item.py_func.__name__}"] = newest >= source.stat().st_mtime
    return sum(found.values()), len(found), folder
