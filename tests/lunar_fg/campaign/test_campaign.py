"""Studies: what they try, who runs them, and what is left after an interruption."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as parquet
import pytest
from typer.testing import CliRunner

from frontends.errors import InputError
from lunar_fg.campaign.campaign import run_campaign
from lunar_fg.campaign.results import Results
from lunar_fg.campaign.study import Study, read_study
from lunar_fg.campaign.summary import groups_of
from lunar_fg.campaign.trial import Outcome, run_trial
from lunar_fg.campaign.workers import MOST_DEATHS, DaskCluster, LocalProcesses
from lunar_fg.cli import app

SMALL = {
    "schema": "lunar-fg/study/1",
    "name": "small",
    "base": {"measurements": {"keyframes": 12, "landmarks": 60}},
    "vary": {"measurements.bad_share": [0.0, 0.1]},
    "seeds": 2,
}


def study(**changes):
    return Study.model_validate({**SMALL, **changes})


class InThisProcess:
    def __init__(self):
        self.ran = []

    def outcomes(self, trials, run=run_trial):
        for trial in trials:
            self.ran.append(trial.number)
            yield run(trial)


class Interrupted(InThisProcess):
    def outcomes(self, trials, run=run_trial):
        yield from super().outcomes(trials[:2], run)
        raise KeyboardInterrupt


def dies_at_seed_1(trial):
    if trial.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(trial.number, trial.seed, trial.group, frames=1)


def slow(trial):
    time.sleep(0.3)
    return Outcome(trial.number, trial.seed, trial.group, frames=1, wall_s=float(os.getpid()))


def test_every_combination_with_every_seed():
    trials = study(
        vary={"measurements.bad_share": [0.0, 0.1], "config.graph.landmarks": ["segments", "full"]},
        seeds=[3, 5],
    ).trials()
    assert len(trials) == 8
    assert [t.number for t in trials] == list(range(8))
    assert {t.seed for t in trials} == {3, 5}
    assert len({t.group for t in trials}) == 4
    assert trials[-1].base.config == {"graph": {"landmarks": "full"}}
    assert trials[-1].base.traverse().bad_share == 0.1


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"base": {}}, "one of dataset"),
        ({"base": {"measurements": {"keyframe": 3}}}, "keyframe"),
        ({"base": {"measurements": {}, "config": {"graph": {"landmark": "full"}}}}, "landmark"),
        ({"base": {"measurements": {}, "faults": ["frozen@2-3"]}}, "none"),
        ({"base": {"dataset": "x", "faults": ["frosen@2-3"]}}, "frozen"),
        ({"vary": {"measurements.keyframes": ["many"]}}, "keyframes"),
        ({"vary": {"measurements.keyframes.odd": [1]}}, "not a group"),
        ({"seeds": 0}, "seeds"),
        ({"name": ""}, "name"),
        ({"vary": {"measurements.keyframes": list(range(2, 2000))}, "seeds": 1000}, "the most"),
    ],
)
def test_a_study_that_cannot_run_is_refused_before_anything_runs(tmp_path, changes, names):
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({**SMALL, **changes}))
    with pytest.raises(InputError, match=names):
        read_study(path)


def test_results_table_and_page(tmp_path):
    results = Results.open(tmp_path / "out", study())
    outcomes = run_campaign(study(), results, InThisProcess())
    assert len(outcomes) == 4
    assert not any(outcome.error for outcome in outcomes)
    table = parquet.read_table(results.table_path)
    assert table.column("number").to_pylist() == [0, 1, 2, 3]
    assert all(0.0 < error < 0.2 for error in table.column("final_error_m").to_pylist())
    assert all(0.0 <= share <= 1.0 for share in table.column("coverage").to_pylist())
    page = results.page_path.read_text()
    assert "bad_share 0.1" in page
    assert 'src="http' not in page
    assert [len(group.outcomes) for group in groups_of(outcomes)] == [2, 2]


def test_names_are_escaped(tmp_path):
    named = study(name="<script>alert(1)</script>")
    results = Results.open(tmp_path / "out", named)
    run_campaign(named, results, InThisProcess())
    assert "<script>alert(1)" not in results.page_path.read_text()


def test_an_interrupted_campaign_goes_on_where_it_was(tmp_path):
    results = Results.open(tmp_path / "out", study())
    with pytest.raises(KeyboardInterrupt):
        run_campaign(study(), results, Interrupted())
    with (results.path / "results.jsonl").open("ab") as sink:
        sink.write(b'{"number": 3, "group": "\xcb')  # cut off in the middle of a line
    workers, seen = InThisProcess(), []
    again = run_campaign(study(), Results.open(tmp_path / "out", study()), workers, seen.append)
    assert workers.ran == [2, 3]
    assert [outcome.number for outcome in seen] == [0, 1, 2, 3]
    whole = run_campaign(study(), Results.open(tmp_path / "whole", study()), InThisProcess())
    assert [o.final_error_m for o in again] == [o.final_error_m for o in whole]


def test_a_folder_belongs_to_one_study(tmp_path):
    Results.open(tmp_path / "out", study())
    with pytest.raises(InputError, match="another study"):
        Results.open(tmp_path / "out", study(seeds=3))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not empty"):
        Results.open(tmp_path / "mine", study())


def test_a_trial_that_kills_its_worker_costs_nobody_else_anything():
    trials = study(vary={}, seeds=3).trials()
    outcomes = {o.number: o for o in LocalProcesses(2).outcomes(trials, dies_at_seed_1)}
    assert sorted(outcomes) == [t.number for t in trials]
    for trial in trials:
        died = f"its worker died {MOST_DEATHS} times" if trial.seed == 1 else ""
        assert outcomes[trial.number].error == died


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, each a process of its own."""
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
    }
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    scheduler = subprocess.Popen(
        [*dask, "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
         "--scheduler-file", str(file)], **quiet,
    )  # fmt: skip
    deadline = time.monotonic() + 60.0
    while not file.exists() or not file.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    address = json.loads(file.read_text())["address"]
    workers = [
        subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1",
             "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path)], **quiet,
        )
        for _ in range(2)
    ]  # fmt: skip
    yield address, workers
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


def test_a_cluster_that_loses_a_worker_finishes_all(cluster):
    address, processes = cluster
    trials = study(seeds=8).trials()
    outcomes = []
    for outcome in DaskCluster(address).outcomes(trials, slow):
        outcomes.append(outcome)
        by_process = {o.wall_s for o in outcomes}
        if len(outcomes) >= 4 and processes[0].poll() is None and len(by_process) == 2:
            processes[0].kill()
    assert sorted(o.number for o in outcomes) == list(range(16))
    assert not any(o.error for o in outcomes)
    assert processes[0].poll() is not None


def test_no_scheduler_is_a_named_error():
    with pytest.raises(InputError, match="no scheduler"):
        DaskCluster("not-an-address")


def test_command(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({**SMALL, "vary": {}, "seeds": 1}))
    out = tmp_path / "out"
    arguments = ["campaign", str(path), "-o", str(out), "--workers", "1"]
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code == 0, first.output
    assert "1 runs, 0 failed" in first.output
    assert (out / "summary.html").exists()
    assert CliRunner().invoke(app, arguments).exit_code == 0
