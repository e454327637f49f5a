"""SIMPLER's Bridge tasks in ManiSkill 3: digital twins of a real table with a WidowX.

Li et al. 2024, "Evaluating Real-World Robot Manipulation Policies in Simulation",
https://arxiv.org/abs/2405.05941. The setting is visual matching: the simulated robot and objects
are rendered on a photograph of the real scene, and the initial configurations are a fixed list.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec
from vlagents_ray.envs.graphics import Renderer
from vlagents_ray.envs.maniskill import ManiSkill
from vlagents_ray.envs.maniskill.simulator import Moment, Simulator, step_limits
from vlagents_ray.envs.simulator import SimulatorEnv
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require

_TOUCHING = "the object lies on its target and touches it"
_WITHIN = "the object lies within its target's outline, at most {} m above it"

# The success criteria of ManiSkill 3 for each task.
TWINS: dict[str, str] = {
    "PutCarrotOnPlateInScene-v1": _TOUCHING,
    "PutEggplantInBasketScene-v1": _WITHIN.format(0.06),
    "PutSpoonOnTableClothInScene-v1": _WITHIN.format(0.02),
    "StackGreenCubeOnYellowCubeBakedTexInScene-v1": _TOUCHING,
}
# The folders in `data/`, by ManiSkill's name of the download that fills them.
_DATA = {"bridge_v2_real2sim": "tasks/bridge_v2_real2sim_dataset", "widowx250s": "robots/widowx"}
_DOWNLOADS = " && ".join(f"python -m mani_skill.utils.download_asset {name}" for name in _DATA)


# The protocol of SIMPLER's own script for ManiSkill 3, real2sim_eval_maniskill3.py.
PROTOCOL: dict[str, Any] = {
    "setting": "visual matching",
    # Success is judged in the last state; success at any step is also reported.
    "success": "at the end",
    "metric": "success_at_end",
    "initial_states": "by episode id",
    "control_mode": "arm_pd_ee_target_delta_pose_align2_gripper_pd_joint_pos",
    "obs_mode": "rgb+segmentation",
    "shader": "default",
    "gripper_open_above": 0.5,  # the command is binarised at this value
    # SIMPLER uses 15 for the Google robot, whose scenes are not in ManiSkill 3.
    "sticky_gripper_steps": 1,
}


class Simpler(SimulatorEnv):
    """One Bridge task with its WidowX 250 S, at 5 Hz.

    Observation: the camera "3rd_view_camera", (480, 640, 3), the size that the paper's policies
    received and resized. `state` contains the arm's `joints` (6,) rad, and `tquat` and `xyzrpy`,
    the pose of the gripper's link in the robot's base frame. `gripper` is its opening.
    `info["sim_state"]` is for scripted experts only. It contains, as (13,) float32 in the base
    frame, the positions, m, of the object, the target, the gripper and the commanded gripper, and
    the object's yaw, rad.

    Action: (7,), as policies trained on Bridge return it. It contains the gripper's change of
    position, m, along the base's axes, its change of roll, pitch and yaw, rad, and the gripper,
    1 open, 0 closed. The changes are relative to the last command, not to the measured pose. As in
    SIMPLER's script, the controller reads the rotation as a rotation vector.

    The initial state is `options["init_state"]`, SIMPLER's episode id. Without that option the
    episode id is the seed modulo `init_states`; the seed has no other effect. The env continues
    after success, and never reports `terminated`.
    """

    suite, known = "simpler", tuple(TWINS)

    def __init__(
        self,
        task: str = "PutCarrotOnPlateInScene-v1",
        *,
        assets: str | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
        sim_backend: str = "physx_cpu",
        render_backend: str = "auto",
        shader: str = PROTOCOL["shader"],
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: ManiSkill's id, one of `Simpler.tasks()`.
            assets: The folder that holds `data/`; None selects `MS_ASSET_DIR`, or ~/.maniskill.
                ManiSkill reads the variable once, so all environments of a process share one
                folder.
            max_steps: None selects ManiSkill's limit, which is 120 for the eggplant and 60 for the
                other tasks.
            sim_backend: "physx_cpu" or "physx_cuda".
            render_backend: "cpu", "gpu", or "auto": the GPU if both SAPIEN and torch can use it.
            shader: ManiSkill's name of the shader; the protocol uses "default".
        """
        super().__init__(task)
        if assets is not None and "mani_skill" not in sys.modules:
            os.environ["MS_ASSET_DIR"] = assets
        used_folder = require("mani_skill").ASSET_DIR.parent
        if assets is not None and used_folder.resolve() != Path(assets).resolve():
            raise ConfigError(
                f"simpler: assets is {assets!r}, but this process has read ManiSkill's from "
                f"{str(used_folder)!r}; set MS_ASSET_DIR before it starts"
            )
        missing = _missing_assets(used_folder)
        if missing is not None:
            raise EnvFailed(missing)

        self.max_steps, task_limit = step_limits(self._name, task, max_steps)
        self._deviations = []
        if self.max_steps != task_limit:
            self._deviations.append(f"max_steps is {max_steps}, not {task_limit}")
        if shader != PROTOCOL["shader"]:
            self._deviations.append(f"shader is {shader}, not {PROTOCOL['shader']}")
        self._task = task
        self._user_instruction = instruction

        # ManiSkill keeps the photographs, and the objects that they must not hide, in class
        # variables. Without this, a second environment of this process would use the photographs
        # and objects of the first one.
        twins: Any = require("mani_skill.envs.tasks.digital_twins.base_env").BaseDigitalTwinEnv
        twins._objects_to_remove_from_greenscreen, twins._rgb_overlay_images = [], {}

        self._env = Simulator(
            self._name,
            task,
            obs_mode=PROTOCOL["obs_mode"],
            sim_backend=sim_backend,
            render_backend=render_backend,
            control_mode=PROTOCOL["control_mode"],
            sensors={"shader_pack": shader},
        )
        self._resources.callback(self._env.close)
        env = self._env.alive()
        env._rgb_overlay_images = twins._rgb_overlay_images
        self.init_states = len(env.xyz_configs) * len(env.quat_configs)
        self._contract = self._env.contract(_ACTION)

    @property
    def instruction(self) -> str:
        if self._user_instruction is not None:
            return self._user_instruction
        task_instruction: str = self._alive().instructions()[0]
        return task_instruction

    @classmethod
    def not_installed(cls) -> str | None:
        return ManiSkill.not_installed()

    @classmethod
    def missing(cls) -> str | None:
        folder = Path(os.environ.get("MS_ASSET_DIR", Path.home() / ".maniskill"))
        return ManiSkill.missing() or _missing_assets(folder)

    def renderer(self) -> Renderer | None:
        renderer: Renderer | None = self._alive().renderer()
        return renderer

    def describe(self) -> dict[str, Any]:
        return {
            **self._alive().describe(),
            "success": TWINS[self._task],
            "assets": str(require("mani_skill").ASSET_DIR.parent),
            "protocol": {**PROTOCOL, "deviations": self._deviations},
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        episode_id = require("torch").tensor([state])
        moment = self._env.reset([seed], {"episode_id": episode_id, "reconfigure": True})
        return self._observe(moment), {"success": moment.success[0]}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        moment = self._env.step(_command(action)[np.newaxis], look=self.looked_at)
        return self._observe(moment), moment.rewards[0], False, {"success": moment.success[0]}

    def _observe(self, moment: Moment) -> Obs:
        """Return the observation of the only environment, with `info["sim_state"]`."""
        env, [obs] = self._env.alive(), moment.obs
        base_from_world = env.agent.robot.pose.inv()
        object_pose = base_from_world * env.objs[env.source_obj_name].pose
        target_pose = base_from_world * env.objs[env.target_obj_name].pose
        arm = env.agent.controller.controllers["arm"]
        poses = [object_pose, target_pose, arm.ee_pose_at_base, arm._target_pose]
        positions = [pose.p[0].cpu().numpy() for pose in poses]

        w, x, y, z = object_pose.q[0].tolist()
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        obs.info["sim_state"] = np.array([*np.concatenate(positions), yaw], np.float32)
        return obs


_ACTION = ActionSpec(
    dim=7,
    space="ee_pose",
    delta=True,
    rotation="euler_xyz",
    frame="base",
    gripper_open=1.0,
    gripper_closed=0.0,
)


def _command(action: np.ndarray) -> np.ndarray:
    """Convert an action, (7,), to the command of ManiSkill's controller, (7,) float32.

    The command contains a rotation vector, and the gripper is -1 closed, 1 open.
    """
    roll, pitch, yaw = action[3:6].tolist()
    axis, angle = require("transforms3d.euler").euler2axangle(roll, pitch, yaw)
    gripper = 1.0 if action[6] > PROTOCOL["gripper_open_above"] else -1.0
    return np.concatenate([action[:3], np.asarray(axis) * angle, [gripper]]).astype(np.float32)


def _missing_assets(folder: Path) -> str | None:
    """Return a message about the assets that `folder` lacks, with the cure; None if it has all of
    them.
    """
    missing = [name for name in _DATA.values() if not (folder / "data" / name).is_dir()]
    if not missing:
        return None
    return (
        f"SIMPLER's assets are not in {folder} (no data/{missing[0]}); set MS_ASSET_DIR, or get "
        f"them: {_DOWNLOADS}"
    )
