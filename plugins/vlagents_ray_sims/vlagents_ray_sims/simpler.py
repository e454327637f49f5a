"""SIMPLER's Bridge tasks in ManiSkill 3: digital twins of a real table with a WidowX.

Li et al. 2024, "Evaluating Real-World Robot Manipulation Policies in Simulation",
https://arxiv.org/abs/2405.05941. Visual matching: photographs of the real scene behind the
simulated robot and objects, and a fixed list of initial configurations.
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
_DATA = {"bridge_v2_real2sim": "tasks/bridge_v2_real2sim_dataset", "widowx250s": "robots/widowx"}
_DOWNLOADS = " && ".join(f"python -m mani_skill.utils.download_asset {name}" for name in _DATA)


# The protocol of SIMPLER's own script for ManiSkill 3, real2sim_eval_maniskill3.py.
PROTOCOL: dict[str, Any] = {
    "setting": "visual matching",
    "success": "at the end",  # in the last state; success at any step is also reported
    "metric": "success_at_end",
    "initial_states": "by episode id",
    "control_mode": "arm_pd_ee_target_delta_pose_align2_gripper_pd_joint_pos",
    "obs_mode": "rgb+segmentation",
    "shader": "default",
    "gripper_open_above": 0.5,  # the command is binarised at this value
    # 15 only for the Google robot, whose scenes ManiSkill 3 does not have.
    "sticky_gripper_steps": 1,
}


class Simpler(SimulatorEnv):
    """One Bridge task with its WidowX 250 S, at 5 Hz.

    Observation: "3rd_view_camera", (480, 640, 3), the size that the policies of the paper received
    and resized themselves; `state`: the arm's `joints` (6,) rad, and `tquat` and `xyzrpy`, the pose
    of the gripper's link in the robot's base frame; `gripper`. For scripted experts only,
    `info["sim_state"]`, (13,) float32 in that frame: the positions in m of object, target, gripper
    and commanded gripper, and the object's yaw in rad.

    Action, (7,), as policies trained on Bridge give it: the gripper's change of position in m along
    the base's axes, its change of roll, pitch and yaw in rad, and the gripper, 1 open, 0 closed. It
    is relative to the last command, not to the measured pose. As in SIMPLER's script, the
    controller reads the rotation as the numbers of a rotation vector.

    The initial state is `options["init_state"]`, SIMPLER's episode id; without it the seed modulo
    `init_states`. The seed has no other effect. The env continues after success, and never reports
    `terminated`.
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
            max_steps: None selects the task's own limit, 60, or 120 for the eggplant.
            sim_backend: "physx_cpu" or "physx_cuda".
            render_backend: "cpu", "gpu", or "auto": the GPU if both SAPIEN and torch can use it.
            shader: ManiSkill's name of the shader; the protocol uses "default".
        """
        super().__init__(task)
        if assets is not None and "mani_skill" not in sys.modules:
            os.environ["MS_ASSET_DIR"] = assets
        used = require("mani_skill").ASSET_DIR.parent
        if assets is not None and used.resolve() != Path(assets).resolve():
            raise ConfigError(
                f"simpler: assets is {assets!r}, but this process has read ManiSkill's from "
                f"{str(used)!r}; set MS_ASSET_DIR before it starts"
            )
        if missing := _missing_assets(used):
            raise EnvFailed(missing)
        self.max_steps, own_limit = step_limits(self._name, task, max_steps)
        self._deviations = (
            [] if self.max_steps == own_limit else [f"max_steps is {max_steps}, not {own_limit}"]
        )
        if shader != PROTOCOL["shader"]:
            self._deviations.append(f"shader is {shader}, not {PROTOCOL['shader']}")
        self._task = task
        self._given_instruction = instruction
        # ManiSkill keeps the photographs, and the objects that they must not hide, in lists of the
        # class. A second twin of this process would otherwise use the lists of the first one.
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
        return (
            self._alive().instructions()[0]
            if self._given_instruction is None
            else self._given_instruction
        )

    @classmethod
    def missing(cls) -> str | None:
        folder = Path(os.environ.get("MS_ASSET_DIR", Path.home() / ".maniskill"))
        return ManiSkill.missing() or _missing_assets(folder)

    def renderer(self) -> Renderer | None:
        found: Renderer | None = self._alive().renderer()
        return found

    def describe(self) -> dict[str, Any]:
        return {
            **self._alive().describe(),
            "success": TWINS[self._task],
            "assets": str(require("mani_skill").ASSET_DIR.parent),
            "protocol": {**PROTOCOL, "deviations": self._deviations},
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        now = self._env.reset(
            [seed], {"episode_id": require("torch").tensor([state]), "reconfigure": True}
        )
        return self._seen(now), {"success": now.success[0]}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        now = self._env.step(_command(action)[np.newaxis], look=self.looked_at)
        return self._seen(now), now.rewards[0], False, {"success": now.success[0]}

    def _seen(self, now: Moment) -> Obs:
        env, [obs] = self._env.alive(), now.obs
        base = env.agent.robot.pose.inv()
        arm = env.agent.controller.controllers["arm"]
        places = [base * env.objs[name].pose for name in (env.source_obj_name, env.target_obj_name)]
        w, x, y, z = places[0].q[0].tolist()
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        places += [arm.ee_pose_at_base, arm._target_pose]
        rows = [place.p[0].cpu().numpy() for place in places]
        obs.info["sim_state"] = np.array([*np.concatenate(rows), yaw], np.float32)
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
    """Convert an action to ManiSkill's controller, both (7,): rotation vector, gripper -1
    closed, 1 open.
    """
    roll, pitch, yaw = action[3:6].tolist()
    axis, angle = require("transforms3d.euler").euler2axangle(roll, pitch, yaw)
    gripper = 1.0 if action[6] > PROTOCOL["gripper_open_above"] else -1.0
    return np.concatenate([action[:3], np.asarray(axis) * angle, [gripper]]).astype(np.float32)


def _missing_assets(folder: Path) -> str | None:
    if not (lacks := [place for place in _DATA.values() if not (folder / "data" / place).is_dir()]):
        return None
    return (
        f"SIMPLER's assets are not in {folder} (no data/{lacks[0]}); set MS_ASSET_DIR, or get "
        f"them: {_DOWNLOADS}"
    )
