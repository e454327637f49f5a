"""A key of rate 1 sends the largest messages that it may, as fast as they are taken: robots do not notice."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import flood
import numpy as np
import pytest

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.local.shm import ShmTransport
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import Request

pytestmark = [pytest.mark.alone, pytest.mark.slow]

FLOOD = Path(flood.__file__)
IMAGE = np.zeros((224, 224, 3), np.uint8)
OBS = Obs({"front": IMAGE, "wrist": IMAGE.copy()}, state={"joints": np.zeros(7, np.float32)})
ACTS = 150
ATTEMPTS = 3  # a machine that does something else meanwhile misleads


def _child(*args: str) -> subprocess.Popen[str]:
    paths = os.pathsep.join([str(FLOOD.parents[2]), str(FLOOD.parent), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, str(FLOOD), *args],
        env={**os.environ, "PYTHONPATH": paths},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


@pytest.fixture(scope="module")
def where() -> Iterator[flood.Where]:
    with _child("serve") as server:
        assert server.stdout is not None
        assert server.stdin is not None
        yield json.loads(server.stdout.readline())
        server.stdin.close()


@pytest.fixture(scope="module")
def robot(where: flood.Where) -> Iterator[ShmTransport]:
    transport = ShmTransport(where["local"], Credentials("robot"))
    transport.connect(10)
    [reply] = transport.call([Request("reset", OBS)], 30)
    assert reply.error is None
    yield transport
    transport.close()


def _median_s(robot: ShmTransport) -> float:
    """Of as many acts, a few ms after each other."""
    taken = []
    for _ in range(ACTS):
        begun = time.perf_counter()
        [reply] = robot.call([Request("act", OBS)], 30)
        taken.append(time.perf_counter() - begun)
        assert reply.error is None
        time.sleep(0.005)
    return statistics.median(taken)


@pytest.mark.parametrize("way", flood.WAYS)
def test_a_robots_act_takes_less_than_twice_as_long(where: flood.Where, robot: ShmTransport, way: str) -> None:
    ratios = []
    for _ in range(ATTEMPTS):
        alone_s = _median_s(robot)
        with _child("attack", way, json.dumps(where), "60") as attacker:
            try:
                assert attacker.stdout is not None
                assert attacker.stdout.readline() == "begun\n"
                ratios.append(_median_s(robot) / alone_s)
            finally:
                attacker.kill()
        if ratios[-1] < 2:
            return
    raise AssertionError(f"a robot's act took {ratios} times as long as alone")
