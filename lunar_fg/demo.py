"""The demo: a simulated lunar traverse through everything that the project does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from frontends.measurements import Estimate, Verdict
from lunar_fg import offline, runs
from lunar_fg.config import Config
from lunar_fg.datasets.base import Dataset
from lunar_fg.evaluation import Accuracy
from lunar_fg.log import TraverseLog
from lunar_fg.replay import without_fixes
from lunar_fg.run_folder import RunFolder
from lunar_fg.run_source import RunSource
from lunar_fg.truth import compare


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo found.

    Attributes
    ----------
    frames, frames_lost
        Stereo pairs, and those whose motion was only predicted.
    wheels, vision, fixed, batch
        Accuracy of wheels and attitude alone, of the run without its fixes on the map, of the
        run, and of the batch over its log.
    fixes_believed, fixes
        How many fixes were believed in the end, and how many there were.
    report
        The page.
    """

    frames: int
    frames_lost: int
    wheels: Accuracy
    vision: Accuracy
    fixed: Accuracy
    batch: Accuracy
    fixes_believed: int
    fixes: int
    report: Path


def demo(
    dataset: Dataset, folder: RunFolder, on_estimate: Callable[[Estimate], None] | None = None
) -> DemoResult:
    """Navigate through a simulated traverse, smooth it in batch, and report.

    Parameters
    ----------
    dataset
        A traverse with truth, wheels and attitude.
    folder
        A new run folder; ``batch/`` is written into it.
    on_estimate
        Called with each frame's estimate.
    """
    from lunar_fg.report import write_report

    RunSource.of(dataset).write(folder)
    metrics = runs.run(dataset, folder, Config(), on_estimate)
    _, batch = offline.optimize(folder)
    truth = folder.read_truth()
    with TraverseLog.open(folder.database_path) as log:
        ledger = log.ledger()
    page = folder.path / "report.html"
    write_report([folder], page)
    return DemoResult(
        metrics.frames,
        metrics.frames_lost,
        metrics.dead_reckoning or Accuracy(),
        compare(without_fixes(folder), truth),
        compare(folder.read_trajectory(), truth),
        batch,
        sum(entry.ruling.verdict is Verdict.ACCEPTED for entry in ledger),
        len(ledger),
        page,
    )
