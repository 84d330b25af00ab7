"""Check at import that gtsam, numpy and OpenCV fit together, before they crash each other."""

from __future__ import annotations

import importlib
from importlib import metadata

from frontends.errors import DependencyError

_REMEDY = (
    'install what fits in one go: pip install "gtsam>=4.3,<5" "numpy>=2" '
    '"opencv-contrib-python-headless>=4.10"'
)
_OLDEST = {"gtsam": (4, 3), "numpy": (2, 0)}


def check_dependencies() -> None:
    """Raise one sentence that says what to install when the big three do not fit.

    Versions are compared before anything is imported: gtsam before 4.3 is built for
    numpy 1 and can abort the process when it meets numpy 2.

    Raises
    ------
    DependencyError
        A package is missing, too old, or fails to import.
    """
    for name, oldest in _OLDEST.items():
        found = _version(name)
        if found is None:
            raise DependencyError(f"{name} is not installed; {_REMEDY}")
        if found < oldest:
            need = ".".join(map(str, oldest))
            have = ".".join(map(str, found))
            raise DependencyError(f"{name} {have} is too old, {need} is needed; {_REMEDY}")
    for module in ("numpy", "cv2", "gtsam"):
        try:
            importlib.import_module(module)
        except (ImportError, AttributeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DependencyError(f"{module} cannot be imported ({reason}); {_REMEDY}") from error


def _version(name: str) -> tuple[int, int] | None:
    try:
        parts = metadata.version(name).split(".")
    except metadata.PackageNotFoundError:
        return None
    digits = ["".join(c for c in part if c.isdigit()) or "0" for part in (*parts, "0")]
    return int(digits[0]), int(digits[1])
