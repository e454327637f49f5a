"""A family's tests run in its own environment (`PYTHON -m pytest tests/families/NAME`); elsewhere they are left out."""

from __future__ import annotations

import importlib.util

# folder -> the package without which its tests cannot be imported
NEEDS = {"lerobot": "lerobot"}

collect_ignore = [folder for folder, package in NEEDS.items() if importlib.util.find_spec(package) is None]
