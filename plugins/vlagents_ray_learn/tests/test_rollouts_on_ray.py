"""What only Ray's workers show of rollouts; test_rollouts.py has the rest."""

from __future__ import annotations

import itertools
import os
import re
import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE, PYTHONPATH, ToZero, wait_for

from vlagents_ray_learn import RolloutPlan, Rollouts, arrays

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("shared_ray")]

SETTINGS: dict[str, Any] = {"worker": {"runtime_env": {"env_vars": {"PYTHONPATH": PYTHONPATH}}}}
IMAGES = {"camera": [64, 64]}  # an episode has more bytes than Ray sends inside of a message


def in_plasma(values: np.ndarray) -> bool:
    """Whether an array lies in the memory of Ray's object store."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        if "plasma" in line and (span := re.match(r"([0-9a-f]+)-([0-9a-f]+) ", line)):
            low, high = (int(one, 16) for one in span.groups())
            if low <= values.ctypes.data < high:
                return True
    return False


def test_a_learner_on_the_node_maps_what_a_worker_wrote() -> None:
    with Rollouts(
        RolloutPlan(LINE, ToZero, workers=2, env_options=IMAGES, settings=SETTINGS)
    ) as rollouts:
        batches = list(itertools.islice(rollouts, 3))
        for got in map(arrays, batches):
            assert in_plasma(got["cameras.front"])
            assert in_plasma(got["action"])
            assert not got["cameras.front"].flags.writeable
        assert not in_plasma(np.zeros(10)), "or the test shows nothing"


def test_a_worker_that_is_killed_costs_neither_an_episode_nor_a_second_one(tmp_path: Path) -> None:
    gate = {"folder": str(tmp_path), "trouble": {"gate": [3]}}
    mark = tmp_path / "gate-3"

    def kill() -> None:
        wait_for(mark.exists)
        os.kill(int(mark.read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    with Rollouts(
        RolloutPlan(LINE, ToZero, workers=2, env_options=gate, settings=SETTINGS)
    ) as rollouts:
        killer.start()
        table = rollouts.collect(6)
        killer.join()
        keys = arrays(table)["key"]
        assert [key.partition("@")[0] for key in dict.fromkeys(keys)] == [
            f"{LINE}#{number}" for number in range(6)
        ]
        assert table.num_rows == 60
        assert rollouts.stats.retries == 1
