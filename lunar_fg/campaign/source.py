"""Where a trial's frames come from: a recording or a rendered traverse, with its faults."""

from __future__ import annotations

from pathlib import Path

from lunar_fg.campaign.study import Trial
from lunar_fg.datasets import open_dataset
from lunar_fg.datasets.base import Dataset
from lunar_fg.faults import FaultyDataset, parse_fault
from lunar_fg.simulation.cache import cached_dataset
from lunar_fg.simulation.spec import checked_spec


def open_source(trial: Trial, scratch: Path) -> Dataset:
    """Open, or make, the dataset of a trial with images.

    Parameters
    ----------
    trial
        What to run.
    scratch
        Folder for what is made along the way.

    Raises
    ------
    InputError
        The recording cannot be opened, or the traverse cannot be simulated.
    """
    base = trial.base
    if base.simulate is not None:
        spec = checked_spec({**base.simulate, "seed": trial.seed}, "study, simulate")
        dataset = open_dataset(cached_dataset(spec, workers=1))
    else:
        assert base.dataset is not None
        dataset = open_dataset(base.dataset)
    if not base.faults:
        return dataset
    return FaultyDataset(dataset, [parse_fault(text) for text in base.faults], trial.seed, scratch)
