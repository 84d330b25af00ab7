"""No call of the public API reaches GTSAM unchecked: fuzzed in a process that may die."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CHILD = Path(__file__).with_name("fuzz_child.py")


def run(*arguments):
    environment = {**os.environ, "PYTHONFAULTHANDLER": "1"}
    command = [sys.executable, str(CHILD), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def test_no_abort_and_no_unnamed_error():
    child = run(80)
    assert child.returncode == 0, f"ended with {child.returncode}\n{child.stderr[-4000:]}"
    assert "80 examples" in child.stdout


@pytest.mark.parametrize("kind", ["abort", "error"])
def test_an_abort_or_an_unnamed_error_would_be_seen(kind):
    spoil = (
        "import os, fuzz_child\n"
        + ("def bad(*_): os.abort()\n" if kind == "abort" else "def bad(*_): raise KeyError(1)\n")
        + "fuzz_child.perform = bad\n"
        + "from hypothesis import settings\n"
        + "settings(max_examples=5, database=None)(fuzz_child.smoother_and_log)()\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", spoil], cwd=CHILD.parent, capture_output=True, check=False
    )
    assert child.returncode != 0
