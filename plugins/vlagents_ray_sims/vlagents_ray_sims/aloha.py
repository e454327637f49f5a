"""ALOHA in simulation: two ViperX 300 arms at a table in MuJoCo, with the two tasks of ACT.

Zhao et al. 2023, "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", arXiv
2304.13705, as packaged by gym-aloha. Images need OpenGL without a display: EGL, which Mesa also
provides in software.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.simulator import BenchmarkProtocol, MujocoCameras, SimulatorEnv
from vlagents_ray.interface import Obs
from vlagents_ray.registry import pip_install, require

PROTOCOL = BenchmarkProtocol(
    name="ALOHA",
    source="gym-aloha 0.1.5; ACT, imitate_episodes.py and constants.py; LeRobot 0.4.4, AlohaEnv "
    "and EvalConfig",
    max_steps=400,
    control_hz=50.0,
    control="absolute joint positions",
    success="the reward is 4, its largest value, after any step",
    metric="success_once",
    begins="the seed draws the positions of the objects; episode i has the first seed + i",
    ends_on_success=True,
    episodes=50,
)
_TASKS = {
    "transfer_cube": "pick up the cube with the right arm and transfer it to the left arm",
    "insertion": "insert the peg into the socket",
}
# Indices of each value of the state in gym-aloha's vector (14,). A gripper position is 0 closed, 1
# open.
_STATE = {
    "left/joints": slice(0, 6),
    "left/gripper": slice(6, 7),
    "right/joints": slice(7, 13),
    "right/gripper": slice(13, 14),
}


class Aloha(SimulatorEnv):
    """One environment of one of ALOHA's two tasks, "transfer_cube" or "insertion".

    Observation: the cameras, by default "top" as in the data of ACT and LeRobot. `state` contains
    "left/joints" (6,) rad, "left/gripper" (1,), "right/joints" and "right/gripper", in the order of
    gym-aloha's `agent_pos`. `info["sim_state"]` contains the poses of the cube, (7,) float64, or of
    the peg and the socket, (14,) float64, in the world frame: position, m, and quaternion wxyz.

    Action: (14,), for the left arm and then for the right arm: six joint angles, rad, and the
    gripper, 0 closed, 1 open. Actions are not clipped to gym-aloha's action space, [-1, 1], as in
    ACT and LeRobot: even the initial pose of the arms is outside that space.
    """

    suite, title, known = "aloha", "gym-aloha", tuple(_TASKS)
    packages, distributions = (
        ("gym_aloha", "dm_control", "mujoco"),
        ("gym-aloha", "dm-control", "mujoco"),
    )
    cure = pip_install("aloha", "vlagents-ray-sims")
    _protocol = PROTOCOL

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
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: "transfer_cube" or "insertion".
            cameras: MuJoCo's names of the cameras: "top", "angle", "front_close", "left_wrist",
                "right_wrist", ….
        """
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        self.max_steps, self._ends_on_success = max_steps, ends_on_success
        self._instruction = instruction or _TASKS[task]
        self._contract = self.known_contract({"cameras": cameras, "width": width, "height": height})

        simulator = require("gym_aloha.env")
        with self._making():
            self._env = simulator.AlohaEnv(task)
            # gym-aloha would render three cameras at 640x480 in each step. Here, only the cameras
            # of the contract are rendered.
            self._env._env.task.get_observation = self._env._env.task.get_qpos
            self._env._format_raw_obs = np.array
            self._physics = self._env._env.physics
            self._cameras = MujocoCameras(
                self._name, self._physics.model.ptr, cameras, (height, width)
            )
            self._resources.callback(self._cameras.close)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        image = CameraSpec(arguments["height"], arguments["width"])
        state = {}
        for name, span in _STATE.items():
            unit = "rad" if name.endswith("joints") else None
            state[name] = StateSpec(span.stop - span.start, unit)
        return Contract(
            cameras=dict.fromkeys(arguments["cameras"], image),
            state=state,
            gripper=False,
            instruction=True,
            action=ActionSpec(
                dim=14,
                space="joint",
                delta=False,
                gripper_open=1.0,
                gripper_closed=0.0,
                arms=("left", "right"),
            ),
            control_hz=PROTOCOL.control_hz,
        )

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"control_mode": "joint_position"}

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        qpos, _ = self._env.reset(seed=seed)
        return self._observe(qpos), {}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        """Execute an action; the reward is the stage of the task in the new state, 0 to 4."""
        qpos, reward, *_ = self._env.step(action.astype(np.float64))
        success = bool(reward == 4)
        obs = self._observe(qpos, look=self.looked_at)
        return obs, float(reward), *self._solved(success)

    def _observe(self, qpos: np.ndarray, *, look: bool = True) -> Obs:
        """Convert gym-aloha's vector, (14,), to an observation; without `look` it has no images."""
        images = self._cameras.render(self._physics.data.ptr) if look else {}
        state = {name: qpos[span].astype(np.float32) for name, span in _STATE.items()}
        # MuJoCo's first 16 positions are those of the arms.
        objects = self._physics.data.qpos[16:].copy()
        return Obs(images, state=state, info={"sim_state": objects})
