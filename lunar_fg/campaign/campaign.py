"""A campaign from its study to its table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lunar_fg.campaign.results import Results
from lunar_fg.campaign.study import Study
from lunar_fg.campaign.summary import write_summary
from lunar_fg.campaign.trial import Outcome
from lunar_fg.campaign.workers import Workers

OnOutcome = Callable[[Outcome], None]


def run_campaign(
    study: Study, results: Results, workers: Workers, on_outcome: OnOutcome | None = None
) -> Sequence[Outcome]:
    """Run what of a study has no result yet; write table and summary.

    Parameters
    ----------
    study
        What to run.
    results
        Where results are, and go.
    workers
        Who runs it.
    on_outcome
        Called for each result, those of an earlier sitting first.

    Returns
    -------
    sequence of Outcome
        All, by number.
    """
    earlier = results.read()
    for outcome in earlier:
        if on_outcome is not None:
            on_outcome(outcome)
    done = {outcome.number for outcome in earlier}
    for outcome in workers.outcomes([t for t in study.trials() if t.number not in done]):
        results.append(outcome)
        if on_outcome is not None:
            on_outcome(outcome)
    outcomes = results.read()
    results.write_table(outcomes)
    write_summary(results.page_path, study, outcomes)
    return outcomes
