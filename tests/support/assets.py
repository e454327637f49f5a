"""Data of simulators that no package brings, for tests: the folder `VLAGENTS_RAY_ASSETS`, or ../shared/assets."""

from __future__ import annotations

import os
from pathlib import Path

BESIDE = Path(__file__).parents[3] / "shared" / "assets"  # the checkout


def assets(simulator: str) -> Path | None:
    """The folder of a simulator's assets, e.g. "libero"; None where there is none."""
    folder = Path(os.environ.get("VLAGENTS_RAY_ASSETS", BESIDE)) / simulator
    return folder if folder.is_dir() else None
