"""The notebooks run from top to bottom in a kernel of their own, and their two forms agree."""

from __future__ import annotations

import os
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
SCRIPTS = sorted(FOLDER.glob("*.py"))
#: Those that show real images, which lie beside the checkout.
WITH_IMAGES = {"paper_step_by_step", "own_frontend"}


def test_every_notebook_has_both_forms() -> None:
    assert len(SCRIPTS) >= 4
    assert {path.stem for path in SCRIPTS} == {path.stem for path in FOLDER.glob("*.ipynb")}


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_the_notebook_is_its_script(path: Path) -> None:
    script = jupytext.read(path)
    notebook = nbformat.read(path.with_suffix(".ipynb"), as_version=4)
    cells, others = (
        [(cell.cell_type, cell.source) for cell in book.cells] for book in (script, notebook)
    )
    assert cells == others, "jupytext --sync notebooks/*.py"
    assert not any(cell.get("outputs") for cell in notebook.cells)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_the_notebook_runs(
    path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    if path.stem in WITH_IMAGES:
        monkeypatch.setenv("LUNAR_FG_DATA", str(request.getfixturevalue("shared_data")))
    monkeypatch.setenv("PYTHONPATH", f"{FOLDER.parent}:{os.environ.get('PYTHONPATH', '')}")
    notebook = nbformat.read(path.with_suffix(".ipynb"), as_version=4)
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any(output.output_type == "stream" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs) or (
        path.stem == "own_frontend"
    )
