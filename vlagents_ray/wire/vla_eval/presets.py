"""The mapping of vla-eval's benchmarks."""

from __future__ import annotations

from typing import Any

PRESETS: dict[str, dict[str, Any]] = {
    # The benchmark chooses the cameras' names. Most benchmarks call the state `states`, some `state`, as vla-eval's
    # types.py recommends; its own servers prefer the former.
    "vla-eval": {
        "cameras": {"*": "images/*"},
        "state": {"state": {"key": "states|state", "optional": True}},
        "instruction": "task_description",
    },
}
