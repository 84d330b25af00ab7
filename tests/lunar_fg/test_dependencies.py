"""The check at import: one sentence that says what to install."""

from __future__ import annotations

import importlib
from importlib import metadata
from types import ModuleType

import pytest

from frontends.errors import DependencyError
from lunar_fg.dependencies import check_dependencies


def test_what_is_installed_here_fits() -> None:
    check_dependencies()


@pytest.mark.parametrize(
    ("name", "version", "says"),
    [
        ("gtsam", "4.2.1", "gtsam 4.2 is too old, 4.3 is needed"),
        ("numpy", "1.26.4", "numpy 1.26 is too old, 2.0 is needed"),
        ("gtsam", None, "gtsam is not installed"),
    ],
)
def test_a_wrong_version_is_named_before_anything_is_imported(
    monkeypatch: pytest.MonkeyPatch, name: str, version: str | None, says: str
) -> None:
    real = metadata.version

    def fake(asked: str) -> str:
        if asked != name:
            return real(asked)
        if version is None:
            raise metadata.PackageNotFoundError(asked)
        return version

    def no_import(module: str) -> ModuleType:
        raise AssertionError(f"{module} was imported before the versions were compared")

    monkeypatch.setattr(metadata, "version", fake)
    monkeypatch.setattr(importlib, "import_module", no_import)
    with pytest.raises(DependencyError, match=says) as caught:
        check_dependencies()
    assert "pip install" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_package_that_breaks_at_import_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(module: str) -> ModuleType:
        if module == "cv2":
            raise ImportError("libGL.so.1: cannot open shared object file")
        return ModuleType(module)

    monkeypatch.setattr(importlib, "import_module", broken)
    with pytest.raises(DependencyError, match=r"cv2 cannot be imported \(libGL"):
        check_dependencies()
