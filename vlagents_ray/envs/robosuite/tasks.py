"""robosuite's tasks by name, and the protocol of the study that results of them are compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol

CONTROL_HZ = 20.0
_PROTOCOL = BenchmarkProtocol(
    name="robomimic",
    source="Mandlekar et al. 2021, arXiv 2108.03298; robomimic 0.3.0, dataset registry and base_config.py",
    max_steps=400,
    control_hz=CONTROL_HZ,
    control="pose of the hand, delta, by OSC_POSE: 0.05 m and 0.5 rad a unit",
    success="robosuite's own check of the task holds after a step",
    begins="where the objects lie, and noise on the arm's joints: the seed's",
    ends_on_success=True,
    episodes=50,
)


@dataclass(frozen=True, slots=True)
class RobosuiteTask:
    """A task of robosuite, and what robomimic observes and allows in it."""

    instruction: str
    max_steps: int = 400  # robomimic's horizon for demonstrations of proficient humans
    cameras: tuple[str, ...] = ("agentview", "robot0_eye_in_hand")
    size: int = 84  # of each image, pixels
    arms: tuple[str, ...] = ("robot0",)

    @property
    def protocol(self) -> BenchmarkProtocol:
        """The protocol of the task."""
        return replace(_PROTOCOL, max_steps=self.max_steps)


TASKS: Mapping[str, RobosuiteTask] = {
    "Lift": RobosuiteTask("lift the red cube"),
    "PickPlaceCan": RobosuiteTask("pick up the can and place it in its bin"),
    "NutAssemblySquare": RobosuiteTask("put the square nut onto the square peg"),
    "ToolHang": RobosuiteTask(
        "assemble the frame and hang the tool on it", 700, ("sideview", "robot0_eye_in_hand"), size=240
    ),
    "TwoArmTransport": RobosuiteTask(
        "move the hammer from its bin into the other one, and the trash out of that",
        700,
        ("shouldercamera0", "shouldercamera1", "robot0_eye_in_hand", "robot1_eye_in_hand"),
        arms=("robot0", "robot1"),
    ),
}


def contract(task: RobosuiteTask, cameras: Mapping[str, CameraSpec]) -> Contract:
    """Return the contract of an env; names and units of the state are those of robomimic's data."""
    parts = {
        "eef_pos": StateSpec(3, "m"),
        "eef_quat": StateSpec(4, "quat_xyzw"),
        "gripper_qpos": StateSpec(2, "m"),
        "joint_pos": StateSpec(7, "rad"),
    }
    return Contract(
        cameras=cameras,
        state={f"{arm}_{part}": spec for arm in task.arms for part, spec in parts.items()},
        gripper=len(task.arms) == 1,
        instruction=True,
        action=ActionSpec(
            dim=7 * len(task.arms),
            space="ee_pose",
            delta=True,
            rotation="axis_angle",
            frame="base",
            gripper_open=-1.0,
            gripper_closed=1.0,
            low=-1.0,
            high=1.0,
            arms=task.arms if len(task.arms) > 1 else None,
        ),
        control_hz=CONTROL_HZ,
    )
