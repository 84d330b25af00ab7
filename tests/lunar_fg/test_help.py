"""The help is a tutorial, and machines can read what the commands print."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from lunar_fg import doctor
from lunar_fg.cli import app

COMMANDS = sorted(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example_that_its_own_parser_knows(name: str) -> None:
    command = typer.main.get_command(app).commands[name]  # type: ignore[attr-defined]
    examples = re.findall(r"^\s*Example: lunar-fg (\S+)(.*)$", command.help or "", re.M)
    assert examples, command.help
    known = {"--help", "-h"}
    for parameter in command.params:
        known |= set(parameter.opts) | set(parameter.secondary_opts)
        if not parameter.opts[0].startswith("-"):
            continue
        assert parameter.help, f"{name} {parameter.opts}: no help"
    for called, rest in examples:
        assert called == name
        for option in re.findall(r"(?<=\s)--?[a-z][a-z-]*", rest):
            assert option in known, f"{name}: {option} in the example is not an option"


def test_the_doctor_says_it_for_people_and_machines() -> None:
    answer = CliRunner().invoke(app, ["doctor", "--json"])
    found = json.loads(answer.stdout)
    assert answer.exit_code == (1 if found["problems"] else 0)
    assert found["packages"]["gtsam"]
    assert found["kernels"] > 10
    assert 0 <= found["kernels_cached"] <= found["kernels"]
    assert found["free_bytes"] > 0
    text = CliRunner().invoke(app, ["doctor"]).stdout
    assert "kernels" in text
    assert "processors" in text


def test_the_doctor_names_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor.PACKAGES, "no-such-package", "")
    monkeypatch.setattr(doctor, "ROOMY_BYTES", 10**18)
    answer = CliRunner().invoke(app, ["doctor"])
    assert answer.exit_code == 1
    assert "no-such-package is not installed" in answer.stdout
    assert "GB are free" in answer.stdout


def test_no_command_waits_for_what_another_needs() -> None:
    code = "import sys, lunar_fg.cli; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"plotly", "pandas", "pyarrow", "pyogrio", "rerun", "distributed", "playwright"}
    assert not heavy & set(found.stdout.split())


def test_the_shell_can_complete() -> None:
    shell = {"COMP_WORDS": "lunar-fg doc", "COMP_CWORD": "1"}
    answer = CliRunner().invoke(
        app, [], prog_name="lunar-fg", env={"_LUNAR_FG_COMPLETE": "complete_bash", **shell}
    )
    assert answer.stdout.split() == ["doctor"]
