"""examples/two_models on real servers: one robot with a planner and a policy, and the effect when
one of them is down.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator

import pytest
import two_models
from readme_blocks import EXAMPLES
from shared_ray import shared_server

from vlagents_ray import ChunkPlayer, PlayerSettings, RemoteAgent
from vlagents_ray.robot import LoopReport, RobotWithPlanner, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.launch.server import Server

FILE = EXAMPLES / "two_models" / "two_models.yaml"


@pytest.fixture
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(read_deployment(str(FILE))) as server:
        yield server


def drive_until_down(server: Server, app: str, max_age_s: float) -> LoopReport:
    """Drive the robot for 12 s, delete an application after 3 s, and return the report."""
    from ray import serve

    planner = RemoteAgent(f"{server.url}/planner", timeout_s=2)
    policy = RemoteAgent(f"{server.url}/policy", timeout_s=2)
    arm = SimulatedRobot(two_models.CONTRACT)
    down = threading.Timer(3.0, serve.delete, [app])
    with (
        RobotWithPlanner(arm, planner, max_age_s=max_age_s) as robot,
        ChunkPlayer(policy, PlayerSettings(mode="async")) as player,
    ):
        down.start()
        try:
            return run_loop(robot, player, hz=10, seconds=12)
        finally:
            down.join()


def test_the_program_does_its_task_with_both_models(
    server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    two_models.main(server.url)
    out = capsys.readouterr().out
    assert out.startswith("put the cup away: done\n")
    share = re.search(r"policy: (\S+)% of \d+ ticks in time", out)
    assert share is not None
    assert float(share[1]) > 80, out
    assert re.search(r"planner: \S+% of \d+ ticks in time", out)


def test_a_planner_that_ends_leaves_the_policy_its_subtask_and_then_the_robot_holds(
    server: Server,
) -> None:
    report = drive_until_down(server, "planner", max_age_s=3.0)
    assert report.reasons["robot"].startswith("planner: expected a subtask of at most 3 s")
    held = report.safe["robot"]
    assert held >= 20, "the robot holds from 3 s after the planner's last answer"
    # Until then the policy continued with the last subtask, for about 3 + 3 s of the 12 s.
    assert report.jitter["ticks"] - report.safe_ticks >= 40
    assert "lost" not in report.safe, "the policy's server must answer all the time"


def test_a_policy_that_ends_is_named_by_its_own_reason(server: Server) -> None:
    report = drive_until_down(server, "policy", max_age_s=5.0)
    assert "robot" not in report.safe, "the planner must answer all the time"
    assert report.safe_ticks >= 40
    assert any(cause in report.reasons for cause in ("lost", "failed", "waiting")), report.reasons
    assert not any(reason.startswith("planner") for reason in report.reasons.values())
