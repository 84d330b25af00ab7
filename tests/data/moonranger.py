"""Complete ``tests/data/moonranger-run1`` from the data beside the checkout.

The source of that data states no licence, so neither its stamps nor its positions are in
the repository; this writes them beside the calibration, where git ignores them::

    python tests/data/moonranger.py ../shared/data/moonranger-run1
    lunar-fg run tests/data/moonranger-run1 --images ../shared/data/moonranger-run1 -o runs/run1
"""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

FOLDER = Path(__file__).with_name("moonranger-run1")


def write_folder(source: Path, folder: Path = FOLDER) -> Path:
    """Write traverse.yaml, frames.csv and ground_truth_position.csv into `folder`."""
    with (source / "ground_truth.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    folder.mkdir(parents=True, exist_ok=True)
    if folder != FOLDER:
        shutil.copy(FOLDER / "traverse.yaml", folder)
    with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "stamp_s", "left", "right"])
        for row in rows:
            name = f"{int(row['frame']):06d}.png"
            writer.writerow([row["frame"], row["time_s"], f"left/{name}", f"right/{name}"])
    with (folder / "ground_truth_position.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["stamp_s", "x_m", "y_m"])
        writer.writerows([row["time_s"], row["x_m"], row["y_m"]] for row in rows)
    return folder


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    write_folder(Path(sys.argv[1]))
