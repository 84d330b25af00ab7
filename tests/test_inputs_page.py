"""docs/inputs.md: the tests it names exist, and its ROS 2 node runs."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

from frontends.camera import StereoCamera

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "inputs.md").read_text(encoding="utf-8")


def test_every_format_names_a_test_that_is_there() -> None:
    table = PAGE.split("## All formats")[1].split("##")[0]
    rows = [line for line in table.splitlines() if line.startswith("|")][2:]
    assert len(rows) > 20
    code = "\n".join(file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("*.py"))
    for row in rows:
        name = re.findall(r"`([^`]+)`", row.split("|")[-2])[0]
        assert (ROOT / name).is_file() if name.endswith(".py") else f"def {name}(" in code, row


def test_the_node_steps_the_navigator(monkeypatch) -> None:
    """The lines as they stand on the page, with stand-ins for ROS 2."""
    code = PAGE.split("```python")[1].split("```")[0]
    callbacks = []
    synchroniser = SimpleNamespace(registerCallback=callbacks.append)
    stamp = SimpleNamespace(sec=12, nanosec=500_000_000)
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp))
    for name, values in {
        "rclpy": {
            "create_node": lambda name: name,
            "spin": lambda node: [call(message, message) for call in callbacks],
        },
        "message_filters": {
            "Subscriber": lambda *given: given,
            "ApproximateTimeSynchronizer": lambda *given: synchroniser,
        },
        "cv_bridge": {
            "CvBridge": lambda: SimpleNamespace(
                imgmsg_to_cv2=lambda message, how: np.zeros((4, 6), np.uint8)
            )
        },
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": object},
    }.items():
        module = ModuleType(name)
        module.__dict__.update(values)
        monkeypatch.setitem(sys.modules, name, module)
    scope: dict[str, object] = {}
    exec(compile(code, "docs/inputs.md", "exec"), scope)
    seen = []
    navigator = SimpleNamespace(step=lambda frame: frame)
    camera = StereoCamera(6, 4, 5.0, 5.0, 2.5, 1.5, 0.1)
    scope["serve"](navigator, camera, seen.append)
    assert [(frame.index, frame.stamp_s, frame.left.shape) for frame in seen] == [(0, 12.5, (4, 6))]
