"""LeRobot's own asynchronous client, in a separate process, drives an arm by a policy behind
our gateway.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from in_process_replicas import Replicas

from plugins.vlagents_ray_models.tests.families.lerobot import robot_client
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import FILTERS, Load, Made, begun
from vlagents_ray import Obs
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray_models.lerobot import LeRobot

pytestmark = FILTERS

ACTIONS = 20


@pytest.mark.program("LeRobot asynchronous inference")
def test_it_performs_the_policys_actions(loaded: Load, made: Made, tmp_path: Path) -> None:
    replicas = Replicas([LeRobot.from_config({"checkpoint": str(made("act"))})])
    cls, port, contract = dialect_class("lerobot"), free_port(), loaded("act").contract
    context = GatewayContext(
        "app", lambda *_: replicas.agent(), MessageLimits(), 4, 60.0, contract, NoKey.OPEN
    )
    dialect = cls("lerobot", cls.Config(port=port, checkpoint="me/tiny"), context)
    dialect.serve(reserve("lerobot", "127.0.0.1", port))
    try:
        done = subprocess.run(
            [sys.executable, robot_client.__file__, str(port), str(ACTIONS)],
            cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
    finally:
        dialect.close()
        replicas.close()
    assert done.returncode == 0, done.stderr
    performed = np.array(json.loads(done.stdout.splitlines()[-1]), np.float32)
    np.testing.assert_array_equal(performed, expected(loaded("act"))[:ACTIONS])


def expected(policy: LeRobot) -> np.ndarray:
    """The arm's actions: all rows of each chunk but the first of later ones, whose number the
    client has performed.
    """
    session, joints, rows = begun(policy), np.zeros(6, np.float32), list[np.ndarray]()
    while len(rows) < ACTIONS:
        obs = Obs(cameras={robot_client.CAMERA: robot_client.image()}, state={"joints": joints})
        chunk = np.atleast_2d(session.act(obs).action)
        rows += list(chunk[1:] if rows else chunk)
        joints = rows[-1]
    return np.array(rows)
