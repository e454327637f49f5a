"""The mapping of LeRobot's robots: the names of its datasets, which its own server makes of a robot's."""

from __future__ import annotations

from typing import Any

STATE, IMAGES, TASK = "observation.state", "observation.images.", "task"

PRESETS: dict[str, dict[str, Any]] = {
    "lerobot": {
        "cameras": {"*": f"{IMAGES}*"},
        "state": {"joints": {"key": STATE, "optional": True}},
        "instruction": TASK,
    },
}
