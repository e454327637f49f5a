"""Mappings of GR00T's clients; the names of an action's columns depend on the robot, so a deployment adds `action`."""

from __future__ import annotations

from typing import Any

PRESETS: dict[str, dict[str, Any]] = {
    # N1.6 and newer: {"video": {k: (1, T, H, W, 3)}, "state": {k: (1, T, D)}, "language": {"task": [[text]]}}
    "gr00t": {
        "cameras": {"*": "video/*"},
        "state": {"*": "state/*"},
        "instruction": "language/*",
    },
    # N1.5 has the same with flat keys
    "gr00t-n1.5": {
        "cameras": {"*": "video.*"},
        "state": {"*": "state.*"},
        "instruction": "annotation.human.*",
    },
}
