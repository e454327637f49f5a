"""The tasks of RCS and DuoBench, and their protocols."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol
from vlagents_ray.registry import require

ControlMode = Literal["joints", "xyzrpy", "tquat"]


@dataclass(frozen=True, slots=True)
class RcsTask:
    """The settings that make a task of a scene which RCS has registered with Gymnasium."""

    id: str  # Gymnasium's id of the scene
    module: str | None  # module that registers it; None if the user names it
    protocol: BenchmarkProtocol | None = None  # None: the user sets `max_steps`
    control_mode: ControlMode = "joints"  # of an action, absolute by default
    control_hz: float = 30.0
    instruction: str = ""  # used if the simulator's info has none
    prepare: Callable[[Any], None] = lambda _config: None  # puts the task into RCS's configuration of a scene without


def _pick(config: Any) -> None:
    config.task_cfg = require("rcs.envs.tasks").PickTaskConfig(robot_name=next(iter(config.robot_cfgs)))


RCS_TASKS = {
    "pick": RcsTask(
        id="rcs/fr3",
        module="rcs.envs.configs",
        protocol=BenchmarkProtocol(
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

_DUOBENCH = BenchmarkProtocol(
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
    name: RcsTask(id=f"duobench/{name}", module=f"duobench.tasks.{name}", protocol=_DUOBENCH)
    for name in _DUOBENCH_NAMES
}
