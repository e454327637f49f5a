"""The tasks of RCS and DuoBench, and the protocols that they are played by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from vlagents_ray.envs.protocol import Protocol
from vlagents_ray.registry import require

ControlMode = Literal["joints", "xyzrpy", "tquat"]


@dataclass(frozen=True, slots=True)
class Task:
    """What makes a scene that RCS has registered with Gymnasium into a task."""

    id: str  # of the scene, Gymnasium's
    module: str | None  # registers it when it is imported; None: the user says which
    protocol: Protocol | None = None  # None: the user sets `max_steps`
    control_mode: ControlMode = "joints"  # an action's, absolute unless the user says otherwise
    control_hz: float = 30.0
    instruction: str = ""  # where the simulator's info has none
    prepare: Callable[[Any], None] = lambda _config: None  # puts the task into RCS's configuration of a scene without


def _pick(config: Any) -> None:
    config.task_cfg = require("rcs.envs.tasks").PickTaskConfig(robot_name=next(iter(config.robot_cfgs)))


RCS_TASKS = {
    "pick": Task(
        id="rcs/fr3",
        module="rcs.envs.configs",
        protocol=Protocol(
            name="RCS pick",
            source="rcs-core 0.7.3, rcs/envs/tasks.py, for the task; it states neither rate nor step limit: ours",
            max_steps=300,
            control_hz=30.0,
            control="tquat",
            success="the cuboid's middle is 7.8 cm or more above the robot's base, and the gripper is neither open "
            "nor closed",
            begins="the cuboid's place in a square of 20 cm, 50 cm in front of the robot, and its turn: the seed's",
            ends_on_success=True,
        ),
        control_mode="tquat",
        instruction="pick up the green cuboid",
        prepare=_pick,
    )
}

_DUOBENCH = Protocol(
    name="DuoBench",
    source="DuoBench 0.1.2, README, 'Evaluation Environment' (arXiv 2606.11901); it states no step limit: ours",
    max_steps=900,
    control_hz=30.0,
    control="joints",
    success="the task's last stage has been reached; stages are not lost again",
    begins="where the objects are: the seed's",
    ends_on_success=True,
)
_DUOBENCH_NAMES = (
    "ball_maze",
    "bin_sort",
    "block_balance",
    "carry_pot",
    "hinge_chest",
    "join_blocks",
    "pour_marbles",
    "spring_door",
    "transfer_cube",
    "transfer_gate",
    "transfer_reorient",
)
DUOBENCH_TASKS = {
    name: Task(id=f"duobench/{name}", module=f"duobench.tasks.{name}", protocol=_DUOBENCH) for name in _DUOBENCH_NAMES
}
