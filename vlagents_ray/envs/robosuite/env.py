"""robosuite's tasks by name, and one of them as an environment for evaluations."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.robosuite.base import RobosuiteEnv, importing_robosuite, seeded
from vlagents_ray.envs.simulator import BenchmarkProtocol
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

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


class Robosuite(RobosuiteEnv):
    """One environment of one of robosuite's tasks, e.g. "Lift".

    Observation: cameras by robosuite's names, upright; in `state`, by robomimic's names, for each arm
    `robot0_eef_pos` (3,) m and `robot0_eef_quat` (4,) xyzw of the hand in the world's frame, `robot0_gripper_qpos`
    (2,) m of the fingers, and `robot0_joint_pos` (7,) rad. In `info["sim_state"]`, for scripted experts only: the
    positions and quaternions xyzw of objects, and `target_pos`, where one of them belongs.

    Action: (7,) in [-1, 1] for each arm: the hand's target moves by 0.05 m a unit along the base's axes, and turns by
    0.5 rad a unit about them, axis-angle; the last is the gripper, -1 opens, 1 closes, and only its sign counts.
    """

    suite = title = "robosuite"
    packages, distributions = ("robosuite", "mujoco"), ("robosuite", "mujoco")
    cure = "run `vlagents-ray env make requirements/robosuite.txt` and give the evaluation's workers that Python"

    def __init__(
        self,
        task: str = "Lift",
        *,
        width: int | None = None,
        height: int | None = None,
        cameras: Sequence[str] | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
        ends_on_success: bool = True,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment; raises the errors of `make_env`.

        Args:
            task: robosuite's name, one of `tasks()`.
            width: Width of each image, pixels; None is robomimic's for the task.
            height: Height of each image, pixels; None is robomimic's for the task.
            cameras: MuJoCo's names; None are robomimic's for the task.
            instruction: The task in words; None is one for the task.
            max_steps: The step limit; None is the protocol's for the task.
            ends_on_success: As in robomimic; False: success at the end can be measured, too.
            record_size: Height and width of further views by the same cameras, for recordings only.
        """
        self.require_task(task)
        super().__init__(f"robosuite/{task}", record_size=record_size, width=width, height=height, max_steps=max_steps)
        self._task = TASKS[task]
        self._protocol, self._ends_on_success = self._task.protocol, ends_on_success
        self.max_steps = max_steps or self._task.protocol.max_steps
        self._contract = self.known_contract({"task": task, "width": width, "height": height, "cameras": cameras})
        self._instruction = instruction or self._task.instruction
        with importing_robosuite("robosuite"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of upstream code
            simulator = require("robosuite")
        if task not in simulator.ALL_ENVIRONMENTS:
            raise ConfigError(f"{self._name}: robosuite {simulator.__version__} has no such task, 1.5 has; {self.cure}")
        images = self._contract.cameras or {}
        with self._making(), seeded(0):
            made = simulator.make(
                task,
                robots=["Panda"] * len(self._task.arms),
                controller_configs=_controllers(simulator),
                control_freq=CONTROL_HZ,
                ignore_done=True,
                has_renderer=False,
                has_offscreen_renderer=bool(images),
                renderer="mujoco",  # with 1.5's own, a reset leaves the last episode's to a garbage collection
                use_camera_obs=bool(images),
                camera_names=list(images) or "agentview",
                camera_heights=[spec.height for spec in images.values()] or 1,
                camera_widths=[spec.width for spec in images.values()] or 1,
            )
            for arm in self._task.arms:  # which robosuite leaves out, and robomimic has
                made.modify_observable(f"{arm}_joint_pos", "active", modifier=True)
            self._use(made)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        """Return the contract; names and units of the state are those of robomimic's data."""
        task = TASKS[arguments["task"]]
        chosen = task.cameras if arguments["cameras"] is None else arguments["cameras"]
        size = CameraSpec(arguments["height"] or task.size, arguments["width"] or task.size)
        parts = {
            "eef_pos": StateSpec(3, "m"),
            "eef_quat": StateSpec(4, "quat_xyzw"),
            "gripper_qpos": StateSpec(2, "m"),
            "joint_pos": StateSpec(7, "rad"),
        }
        return Contract(
            cameras=dict.fromkeys(chosen, size),
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

    @classmethod
    def tasks(cls) -> list[str]:
        return list(TASKS)

    def _sim_state(self, raw: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The positions and orientations of objects, and the place where one belongs."""
        env, found = self._env, super()._sim_state(raw)
        if hasattr(env, "target_bin_placements"):
            found["target_pos"] = np.array(env.target_bin_placements[env.object_id], np.float64)
        elif hasattr(env, "peg1_body_id"):
            found["target_pos"] = np.array(env.sim.data.body_xpos[env.peg1_body_id], np.float64)
        return found


def _controllers(simulator: Any) -> Any:
    """Return OSC_POSE with robosuite's own settings, which are robomimic's."""
    if hasattr(simulator, "load_composite_controller_config"):  # 1.5
        return simulator.load_composite_controller_config(robot="Panda")
    return simulator.load_controller_config(default_controller="OSC_POSE")
