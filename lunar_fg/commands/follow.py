"""Navigate through image pairs as they arrive: estimates as JSON lines, latencies in the end."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from frontends.errors import InputError
from frontends.measurements import Estimate
from lunar_fg import runs
from lunar_fg.commands.progress import text_log
from lunar_fg.commands.shared import err
from lunar_fg.config import Config
from lunar_fg.console import run_summary
from lunar_fg.follow import FollowedFolder, Policy
from lunar_fg.log_entries import Sitting
from lunar_fg.run_folder import RunFolder, write_whole
from lunar_fg.run_source import RunSource


def follow(
    path: Path,
    traverse: Path | None,
    output: Path,
    settings: Config,
    overwrite: bool,
    policy: Policy,
    quiet_s: float | None,
    estimates: Path | None,
) -> None:
    """Navigate until the folder's end marker, quiet, or Ctrl-C; see `FollowedFolder`."""
    followed = FollowedFolder(path, traverse, policy, quiet_s)
    folder = RunFolder.create(output, settings, overwrite=overwrite)
    RunSource.of(followed, None, followed.traverse).write(folder)
    sitting = Sitting(str(path.resolve()), traverse=str(followed.traverse.resolve()))
    latencies: list[float] = []
    with _lines(estimates) as lines, _interruptible(followed), text_log(folder):

        def tell(estimate: Estimate) -> None:
            written_s = followed.arrivals.written_s.get(estimate.index)
            latency_ms = None if written_s is None else 1e3 * (time.time() - written_s)
            if latency_ms is not None:
                latencies.append(latency_ms)
            lines.write(json.dumps(_line(estimate, latency_ms)) + "\n")
            lines.flush()

        metrics = runs.run(followed, folder, settings, tell, sitting=sitting)
    summary = {
        "policy": policy.value,
        "frames": len(latencies),
        "skipped": followed.arrivals.skipped,
        "late": followed.arrivals.late,
        "latency_ms": {
            name: round(float(np.percentile(latencies, share)), 3)
            for name, share in (("p50", 50), ("p95", 95), ("p99", 99), ("max", 100))
        },
    }
    write_whole(folder.path / "follow.json", (json.dumps(summary, indent=2) + "\n").encode())
    ms = summary["latency_ms"]
    err.print(run_summary(followed.name, metrics, output), markup=False)
    err.print(
        f"latency from image to estimate, ms: {ms}; {followed.arrivals.skipped} pairs skipped, "
        f"{followed.arrivals.late} late",
        markup=False,
    )


def _line(estimate: Estimate, latency_ms: float | None) -> dict[str, object]:
    transform, covariance = estimate.map_T_rover, estimate.covariance
    x, y, z = transform[:3, 3].tolist()
    qx, qy, qz, qw = Rotation.from_matrix(transform[:3, :3]).as_quat(canonical=True).tolist()
    in_map = transform[:3, :3] @ covariance[3:, 3:] @ transform[:3, :3].T
    return {
        "frame": estimate.index,
        "stamp_s": estimate.stamp_s,
        "x_m": x, "y_m": y, "z_m": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw,
        "sigma_xyz_m": np.sqrt(np.diag(in_map)).tolist(),
        "sigma_rot_rad": np.sqrt(np.diag(covariance)[:3]).tolist(),
        "lost": estimate.lost,
        "used": estimate.used,
        "refused": estimate.refused,
        "latency_ms": latency_ms,
    }  # fmt: skip


@contextmanager
def _lines(path: Path | None) -> Iterator[TextIO]:
    if path is None:
        yield sys.stdout
        return
    try:
        file = path.open("w", encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", source=path) from error
    with file:
        yield file


@contextmanager
def _interruptible(followed: FollowedFolder) -> Iterator[None]:
    """Let Ctrl-C end the frames, not the frame that is being processed."""
    before = signal.signal(signal.SIGINT, lambda *_: followed.stop())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
