"""ALOHA in simulation: two ViperX 300 arms over a table in MuJoCo, the two tasks that came with ACT.

Zhao et al. 2023, "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv 2304.13705, as packaged by
gym-aloha. Images need OpenGL without a display: EGL, which Mesa also provides in software.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row, require_known
from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import failing, without, without_egl
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import HIGH_RES, Act, Obs
from vlagents_ray.registry import require

PROTOCOL = BenchmarkProtocol(
    name="ALOHA",
    source="gym-aloha 0.1.5; ACT, imitate_episodes.py and constants.py; LeRobot 0.4.4, AlohaEnv and EvalConfig",
    max_steps=400,
    control_hz=50.0,
    control="absolute joint positions",
    success="the reward is 4, its largest value, after any step",
    begins="where the objects lie: the seed's; episode i has the first seed + i",
    ends_on_success=True,
    episodes=50,
)
_SOLVED = 4.0
_TASKS = {
    "transfer_cube": "pick up the cube with the right arm and transfer it to the left arm",
    "insertion": "insert the peg into the socket",
}
# Where each part of the state is in gym-aloha's vector (14,), whose gripper positions are 0 closed, 1 open.
_STATE = {
    "left/joints": slice(0, 6),
    "left/gripper": slice(6, 7),
    "right/joints": slice(7, 13),
    "right/gripper": slice(13, 14),
}


class Aloha(EvalEnv):
    """One environment of one of ALOHA's two tasks, "transfer_cube" or "insertion".

    Observation: cameras, by default "top", as in ACT's and LeRobot's data; `state`: "left/joints" (6,) rad,
    "left/gripper" (1,), "right/joints", "right/gripper", which in this order are gym-aloha's `agent_pos`; in
    `info["sim_state"]`, (7,) float64 or (14,), the poses of the cube, or of peg and socket, in the world's frame:
    position in m and quaternion w, x, y, z.

    Action: (14,), for the left arm and then for the right: six joint angles, rad, and the gripper, 0 closed, 1 open.
    They are not clipped to gym-aloha's action space, [-1, 1], in which the arms' first pose is not: neither ACT nor
    LeRobot clips them.
    """

    def __init__(
        self,
        task: str = "transfer_cube",
        *,
        width: int = 640,
        height: int = 480,
        cameras: Sequence[str] = ("top",),
        instruction: str | None = None,
        max_steps: int = PROTOCOL.max_steps,
        ends_on_success: bool = True,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: "transfer_cube" or "insertion".
            width: Width of each image, pixels.
            height: Height of each image, pixels.
            cameras: MuJoCo's names: "top", "angle", "front_close", "left_wrist", "right_wrist", ….
            instruction: The task in words; None is one for the task.
            max_steps: The step limit.
            ends_on_success: As in gym-aloha; False: success at the end can be measured, too.
            record_size: Height and width of further views by the same cameras, for recordings only.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator or its assets cannot be loaded.
        """
        self.require_task(task)
        for name, value in (("width", width), ("height", height), ("max_steps", max_steps)):
            if value < 1:
                raise ConfigError(f"aloha: {name} is {value}, want at least 1")
        prepare_rendering()
        self.max_steps = max_steps
        self._task, self._name = task, f"aloha/{task}"
        self._instruction = instruction or _TASKS[task]
        self._ends_on_success = ends_on_success
        self._steps: int | None = None
        self._env: Any = None
        self._renderers: dict[str, Any] = {}  # of the policy's images, and of those for recordings
        simulator = require("gym_aloha.env")
        with failing(self._name, "make"):
            self._env = simulator.AlohaEnv(task)
            # gym-aloha renders three cameras at 640x480 in each step; here only those of the contract are rendered.
            self._env._env.task.get_observation = self._env._env.task.get_qpos
            self._env._format_raw_obs = np.array
            self._physics = self._env._env.physics
            model = self._physics.model.ptr
            have = [model.camera(i).name for i in range(model.ncam)]
        unknown = sorted(set(cameras) - set(have))
        if unknown:
            raise ConfigError(f"{self._name} has no camera {unknown}: want some of {sorted(have)}")
        self._contract = self.known_contract({"cameras": cameras, "width": width, "height": height})
        sizes = {"": (height, width), HIGH_RES: record_size_of(record_size, self._name)}
        try:
            with failing(self._name, "make its renderer"):
                for use, size in sizes.items():
                    if size is not None:
                        model.vis.global_.offheight = max(size[0], model.vis.global_.offheight)
                        model.vis.global_.offwidth = max(size[1], model.vis.global_.offwidth)
                        self._renderers[use] = require("mujoco").Renderer(model, *size)
        except EnvFailed:
            self.close()
            raise

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        return Contract(
            cameras={name: CameraSpec(arguments["height"], arguments["width"]) for name in arguments["cameras"]},
            state={
                name: StateSpec(part.stop - part.start, "rad" if name.endswith("joints") else None)
                for name, part in _STATE.items()
            },
            gripper=False,
            instruction=True,
            action=ActionSpec(
                dim=14, space="joint", delta=False, gripper_open=1.0, gripper_closed=0.0, arms=("left", "right")
            ),
            control_hz=PROTOCOL.control_hz,
        )

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32; there are no options."""
        if options:
            raise ConfigError(f"{self._name}: unknown reset options {sorted(options)}, want none")
        env = self._alive()
        with failing(self._name, "reset"):
            qpos, _ = env.reset(seed=seed % 2**32)
            self._steps = 0
            return self._observe(qpos), {"success": False}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action; the reward is the stage of the task that the state is in, 0 to 4."""
        env = self._alive()
        if self._steps is None:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        with failing(self._name, "step"):
            qpos, reward, *_ = env.step(action.astype(np.float64))
            self._steps += 1
            success = bool(reward == _SOLVED)
            obs = self._observe(qpos, look=self.looked_at)
        ended = success and self._ends_on_success
        return obs, float(reward), ended, self._steps >= self.max_steps, {"success": success}

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("aloha", task or "transfer_cube", cls.tasks())

    @classmethod
    def tasks(cls) -> list[str]:
        return list(_TASKS)

    @classmethod
    def missing(cls) -> str | None:
        """Say why gym-aloha cannot run here; the first call in a process renders one frame in a child."""
        return without(("gym_aloha", "dm_control", "mujoco"), "pip install 'vlagents-ray[aloha]'") or without_egl(
            "gym-aloha"
        )

    def describe(self) -> dict[str, Any]:
        return {
            "simulator": "gym-aloha",
            "task": self._task,
            "gym-aloha": version("gym-aloha"),
            "dm-control": version("dm-control"),
            "mujoco": version("mujoco"),
            "control_mode": "joint_position",
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
            "protocol": PROTOCOL.describe(max_steps=self.max_steps, ends_on_success=self._ends_on_success),
        }

    def close(self) -> None:
        renderers, self._renderers = self._renderers, {}
        self._env, self._steps = None, None
        for renderer in renderers.values():
            renderer.close()

    def _observe(self, qpos: np.ndarray, *, look: bool = True) -> Obs:
        cameras = self._contract.cameras or {} if look else {}
        images = {use: {name: self._render(one, name) for name in cameras} for use, one in self._renderers.items()}
        info: dict[str, Any] = {"sim_state": self._physics.data.qpos[16:].copy()}
        if look and HIGH_RES in images:
            info[HIGH_RES] = images[HIGH_RES]
        return Obs(
            cameras=images[""],
            state={name: qpos[part].astype(np.float32) for name, part in _STATE.items()},
            info=info,
        )

    def _render(self, renderer: Any, camera: str) -> np.ndarray:
        renderer.update_scene(self._physics.data.ptr, camera=camera)
        image: np.ndarray = renderer.render()
        return image

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._env
