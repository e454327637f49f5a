"""Tasks in words, cameras, rates and protocols of Gymnasium environments, which these do not state themselves."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol


@dataclass(frozen=True, slots=True)
class Known:
    """Defaults of the options of `Gymnasium` for one id; None uses the environment's own values."""

    module: str | None = None  # registers the id
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    cameras: Mapping[str, str] | None = None
    instruction: str = ""
    control_hz: float | None = None
    protocol: BenchmarkProtocol | None = None


def known(task: str) -> Known:
    """Return the defaults for a Gymnasium id; empty ones if it is not known."""
    if task == "gym_pusht/PushT-v0":
        return _PUSHT
    fetch = re.fullmatch(r"Fetch(\w+?)(?:Dense)?-v\d+", task)
    if fetch is None or fetch[1] not in _FETCH_INSTRUCTIONS:
        return Known()
    return Known(
        module="gymnasium_robotics",
        instruction=_FETCH_INSTRUCTIONS[fetch[1]],
        control_hz=_FETCH.control_hz,
        protocol=_FETCH,
    )


_PUSHT = Known(
    module="gym_pusht",
    kwargs={"obs_type": "pixels_agent_pos"},
    cameras={"front": "pixels"},
    instruction="push the T-shaped block onto the green target",
    control_hz=10.0,
    protocol=BenchmarkProtocol(
        name="PushT",
        source="gym-pusht 0.1.8, PushTEnv; LeRobot 0.4.4, PushtEnv and EvalConfig",
        max_steps=300,
        control_hz=10.0,
        control="absolute position",
        success="the block covers more than 95 % of the target",
        begins="where agent and block stand: the seed's; episode i has the first seed + i",
        ends_on_success=True,
        episodes=50,
    ),
)

_FETCH_INSTRUCTIONS = {
    "Reach": "move the gripper to the red target",
    "Push": "push the block to the red target",
    "Slide": "slide the puck to the red target",
    "PickAndPlace": "pick up the block and move it to the red target",
}
_FETCH = BenchmarkProtocol(
    name="Fetch",
    source="Gymnasium-Robotics 1.4.2; Plappert et al. 2018, arXiv 1802.09464",
    max_steps=50,
    control_hz=25.0,
    control="position of the gripper, delta",
    success="gripper or object is within 5 cm of the target after the last step: success_at_end",
    begins="where object and target are: the seed's",
    ends_on_success=False,
)
