"""The example of docs/evaluation/: Stable-Baselines3's PPO, as it is, improves on an environment of ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = "STABLE_BASELINES3_SRC"  # a checkout, or a folder of `pip install --target`


@pytest.mark.source(SOURCE)
@pytest.mark.torch
@pytest.mark.slow
def test_ppo_learns_to_swing_a_pendulum_up() -> None:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ[SOURCE]}", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "docs/evaluation/stable_baselines.py"]
    printed = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    curve = [float(line.split()[1]) for line in printed.splitlines()]
    assert curve[0] < -900, "or the test shows nothing: untrained"
    assert curve[-1] > -400, curve
