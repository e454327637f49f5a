"""Collects the tests with LeRobot that can run if Ray is not installed."""

from __future__ import annotations

import importlib.util

collect_ignore = [] if importlib.util.find_spec("ray") else ["test_datasets.py"]
