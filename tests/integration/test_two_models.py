"""examples/two_models on real servers: one robot with a planner and a policy, and the effect when
the planner is down.
"""

from __future__ import annotations

import re
import threading
import urllib.request
from collections.abc import Iterator

import pytest
import two_models
from readme_blocks import EXAMPLES
from shared_ray import shared_server

from vlagents_ray import ChunkPlayer, PlayerSettings, RemoteAgent
from vlagents_ray.robot import run_loop
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.launch.server import Server

FILE = EXAMPLES / "two_models" / "two_models.yaml"


@pytest.fixture
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(read_deployment(str(FILE))) as server:
        yield server


def test_the_program_does_its_task_with_both_models(
    server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    with urllib.request.urlopen(
        f"{server.url}/healthz", timeout=30
    ) as answer:  # of all applications
        assert answer.status == 200

    two_models.main(server.url)
    out = capsys.readouterr().out
    assert out.startswith("put the cup away: done\n")
    share = re.search(r"policy: (\S+)% of its ticks in time", out)
    assert share is not None
    assert float(share[1]) > 80, out
    assert "held for: nothing" in out


def test_a_planner_that_ends_leaves_the_policy_its_subtask_and_then_the_robot_holds(
    server: Server,
) -> None:
    """The planner ends after 3 s of 12 s, and its last answer may be used for 3 s. On a busy machine
    its end takes some more seconds.
    """
    from ray import serve

    planner = RemoteAgent(f"{server.url}/planner", timeout_s=2)
    policy = RemoteAgent(f"{server.url}/policy", timeout_s=2)
    down = threading.Timer(3.0, serve.delete, ["planner"])
    player = ChunkPlayer(policy, PlayerSettings(mode="async"))
    with player, two_models.GuidedArm(planner, max_age_s=3.0) as arm:
        down.start()
        try:
            report = run_loop(arm, player, hz=10, seconds=12)
        finally:
            down.join()
    assert re.match(r"the planner's answer is \S+ s old: .*planner", report.reasons["robot"])
    assert report.safe["robot"] >= 15, "the robot holds from 3 s after the planner's last answer"
    # Until then the policy continued with the last subtask, for about 3 + 2 s.
    assert report.jitter["ticks"] - report.safe_ticks >= 35
    assert "lost" not in report.safe, "the policy's server must answer all the time"
