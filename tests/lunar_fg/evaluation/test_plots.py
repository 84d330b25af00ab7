"""Pictures: they are made, they say what they show, they leave no global state."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lunar_fg.evaluation.alignment import AlignmentKind, align
from lunar_fg.evaluation.association import associate
from lunar_fg.evaluation.drift import drift_profile
from lunar_fg.evaluation.plots import drift_plot, timing_plot, top_view, write_plots
from lunar_fg.trajectory import PositionTrack, Trajectory

Simulate = Callable[..., tuple[Trajectory, Trajectory]]


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_all_pictures_are_written(tmp_path: Path, simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0))
    baseline, _ = simulate(np.random.default_rng(1))
    timing = {"surf": np.full(40, 20.0), "graph": np.full(40, 3.0)}
    written = write_plots(tmp_path, estimate, truth, baseline, timing_ms=timing, name="arc")
    assert sorted(path.name for path in written) == ["drift.png", "timing.png", "top_view.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(p.name for p in written)


def test_pyplot_is_not_imported() -> None:
    check = "import sys, lunar_fg.evaluation.plots; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0


def test_without_truth_there_is_still_a_path(tmp_path: Path, simulate: Simulate) -> None:
    estimate, truth = simulate(np.random.default_rng(0))
    assert [path.name for path in write_plots(tmp_path, estimate)] == ["top_view.png"]
    placed = PositionTrack(truth.stamp_s, truth.positions[:, :2])
    assert len(write_plots(tmp_path, estimate, placed)) == 2


def test_small_ellipses_are_enlarged_and_say_so() -> None:
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = np.arange(20) * 5.0
    small = np.tile(np.eye(6) * 1e-4, (20, 1, 1))
    figure = top_view(Trajectory(np.arange(20.0), poses, small))
    assert "95 % ellipse, 50 x enlarged" in legend_of(figure)
    figure = top_view(Trajectory(np.arange(20.0), poses, small * 1e5))
    assert "95 % ellipse" in legend_of(figure)
    assert figure.axes[0].get_aspect() == 1.0
    assert figure.axes[0].get_xlabel() == "x (m)"


def test_a_single_pose_can_be_drawn(tmp_path: Path) -> None:
    one = Trajectory(np.zeros(1), np.eye(4)[None], np.eye(6)[None] * 1e-6)
    assert len(write_plots(tmp_path, one, one, timing_ms={"surf": [3.0]})) == 3


def test_drift_has_units(simulate: Simulate) -> None:
    pair = associate(*simulate(np.random.default_rng(0)))
    profile = drift_profile(pair, align(AlignmentKind.ORIGIN, pair))
    figure = drift_plot(profile, sigma_m=np.full(len(pair), 0.1))
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "position error (m)",
        "orientation error (deg)",
    ]
    assert "estimate" in legend_of(figure)


def test_one_slow_step_does_not_flatten_the_rest() -> None:
    surf = np.full(50, 20.0)
    surf[0] = 5000.0
    figure = timing_plot({"surf": surf, "graph": np.full(50, np.nan)})
    assert figure.axes[0].get_ylim()[1] < 100.0
    assert "longest 5000 ms" in figure.get_suptitle()
