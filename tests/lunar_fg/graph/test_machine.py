"""The smoother and its log against a model, in a process that may die."""

import os
import subprocess
import sys
from pathlib import Path

CHILD = Path(__file__).with_name("machine_child.py")


def test_no_sequence_of_calls_breaks_the_smoother_or_its_log():
    child = subprocess.run(
        [sys.executable, str(CHILD), "25"],
        capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONFAULTHANDLER": "1"},
    )  # fmt: skip
    assert child.returncode == 0, f"ended with {child.returncode}\n{child.stderr[-4000:]}"
    assert "25 examples" in child.stdout


def test_a_broken_smoother_would_be_seen():
    spoil = (
        "import machine_child as m\n"
        "add_fix = m.IncrementalSmoother.add_fix\n"
        "def leaky(self, fix):\n"
        "    self._index.append(10**6)\n"
        "    return add_fix(self, fix)\n"
        "m.IncrementalSmoother.add_fix = leaky\n"
        "from hypothesis import settings\n"
        "m.run_state_machine_as_test(m.Traverse, settings=settings(\n"
        "    max_examples=30, database=None, deadline=None, derandomize=True))\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", spoil], cwd=CHILD.parent, capture_output=True, check=False
    )
    assert child.returncode != 0
