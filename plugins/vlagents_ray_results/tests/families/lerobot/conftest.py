"""What of LeRobot's tests runs without Ray."""

from __future__ import annotations

import importlib.util

collect_ignore = [] if importlib.util.find_spec("ray") else ["test_datasets.py"]
