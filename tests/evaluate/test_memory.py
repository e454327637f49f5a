"""The memory that an evaluation keeps for each episode while it runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import PYTHONPATH

EPISODES = 500
SETTLED = 100  # number of episodes after which most caches are full
MOST_BYTES = 1024  # maximum growth for each further episode
# In a process of its own, as pytest keeps the lines of the log.
PROGRAM = """
import gc, sys, tracemalloc
from eval_fakes import LINE, ToZero
from in_process_evaluation import flat_config
from vlagents_ray.evaluate import Progress, evaluate

out, settled, episodes = sys.argv[1], *map(int, sys.argv[2:])
done = 0

class Held(Progress):
    def episode(self, case, result):
        global done
        done += 1
        if done in (settled, episodes):
            gc.collect()
            print(tracemalloc.get_traced_memory()[0])

def play(episodes, out, progress):
    config = flat_config(
        envs=[LINE], episodes=episodes, workers=0, video="none", policy="to zero", out=out
    )
    evaluate(config, agent_factory=ToZero, progress=progress)

# A short evaluation loads all modules: some are loaded only after a while, or at the end.
play(2, out + "/short", Progress())
tracemalloc.start()
play(episodes, out + "/long", Held())
"""


@pytest.mark.slow
def test_an_evaluation_keeps_hardly_any_memory_for_an_episode(tmp_path: Path) -> None:
    words = [str(tmp_path / "out"), str(SETTLED), str(EPISODES)]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *words],
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    before, after = map(int, done.stdout.split())
    assert (after - before) / (EPISODES - SETTLED) < MOST_BYTES
