"""Meta-World: fifty table-top tasks of a Sawyer arm in MuJoCo, each with a scripted oracle.

Images need OpenGL without a display: EGL, which Mesa also provides in software.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import DELTA_POSE, require_cameras
from vlagents_ray.envs.graphics import prepare_rendering
from vlagents_ray.envs.simulator import BenchmarkProtocol, MujocoCameras, SimulatorEnv, camera_names
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.registry import pip_install, require

PROTOCOL = BenchmarkProtocol(
    name="Meta-World",
    source="Meta-World 3.1.1, metaworld.evaluation and MT1",
    max_steps=500,  # the maximum, after which the simulator rejects further steps
    control_hz=80.0,
    control="position of the hand, delta",
    success="the task is solved after any step: success_once",
    metric="success_once",
    begins="the episode's seed draws the positions of the object and the goal, or they are one of "
    "the 50 states that MT1 draws",
    ends_on_success=True,
    episodes=50,
)
_UPSIDE_DOWN = ("corner2",)  # cameras that Meta-World mounts upside down; the others are upright


class MetaWorld(SimulatorEnv):
    """One environment of one Meta-World task, e.g. "reach-v3".

    Observation: the cameras, by default "corner2", whose images are upright; `state["xyz"]` (3,) m,
    the hand in the world frame; and `gripper`. `info["sim_state"]`, (39,) float64, is Meta-World's
    observation including the goal, which its oracles need bit for bit.

    Action: (4,) in [-1, 1]. The hand's target moves by 0.01 m per unit along x, y and z of the
    world frame. The last value is the gripper's effort: -1 opens it, 1 closes it.

    The seed determines the positions of the object and the goal, which are drawn as by Meta-World's
    own generator of tasks. With `goals_seed`, the initial states are the 50 that MT1 draws with
    that seed, in order. Success ends the episode unless `ends_on_success` is False.
    """

    suite, title = "metaworld", "Meta-World"
    packages, distributions = ("metaworld", "mujoco"), ("metaworld", "mujoco")
    cure = pip_install("metaworld", "vlagents-ray-sims")
    _protocol = PROTOCOL

    def __init__(
        self,
        task: str = "reach-v3",
        *,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] = ("corner2",),
        instruction: str | None = None,
        max_steps: int = PROTOCOL.max_steps,
        goals_seed: int | None = None,
        ends_on_success: bool = True,
        camera_positions: Mapping[str, Sequence[float]] | None = None,
        shadows: bool = True,
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: Meta-World's name of the task.
            cameras: MuJoCo's names of the cameras, e.g. "corner2", "gripperPOV".
            instruction: None selects the task's name in words.
            max_steps: The step limit, 500 at most.
            goals_seed: The seed of MT1, whose 50 initial states are used. If it is None, the seed
                of each episode draws an initial state.
            camera_positions: Name -> (x, y, z) m in the world frame, for cameras whose position
                differs from Meta-World's.
            shadows: Whether images have shadows, reflections and smooth edges as in Meta-World.
                Without a GPU, such images take ten times as long.
        """
        if max_steps > PROTOCOL.max_steps:
            raise ConfigError(
                f"metaworld: max_steps: expected at most {PROTOCOL.max_steps}, Meta-World's own "
                f"limit, "
                f"got {max_steps}"
            )
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        self.max_steps, self._ends_on_success = max_steps, ends_on_success
        self._instruction = instruction or task.removesuffix("-v3").replace("-", " ")
        self._goals: list[Any] | None = None

        simulator = require("metaworld")
        with self._making():
            env = self._env = simulator.ALL_V3_ENVIRONMENTS[task]()
            self._resources.callback(env.close)
            # As in Meta-World's classes with an observable goal, but with our seed.
            env._partially_observable = False
            # Meta-World caches this space, which would clip the goal away.
            del env.sawyer_observation_space
            env._freeze_rand_vec = False
            env._set_task_called = True
            env.seeded_rand_vec = True
            if goals_seed is not None:
                self._goals = simulator.MT1(task, seed=goals_seed).train_tasks
                self.init_states = len(self._goals)

            positions = camera_positions or {}
            require_cameras(self._name, positions, camera_names(env.model))
            for name, position in positions.items():
                env.model.camera(name).pos = position

            self._cameras = MujocoCameras(
                self._name,
                env.model,
                cameras,
                (height, width),
                upside_down=_UPSIDE_DOWN,
                shadows=shadows,
            )
            self._resources.callback(self._cameras.close)

        contract = self.known_contract({"cameras": cameras, "width": width, "height": height})
        self._contract = replace(contract, control_hz=1.0 / self._env.dt)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        """Return the contract without the control rate, which only the simulator knows."""
        image = CameraSpec(arguments["height"], arguments["width"])
        return Contract(
            cameras=dict.fromkeys(arguments["cameras"], image),
            state={"xyz": StateSpec(3, "m")},
            gripper=True,
            instruction=True,
            action=replace(DELTA_POSE, dim=4, space="ee_position", rotation="none", frame="world"),
        )

    @classmethod
    def tasks(cls) -> list[str]:
        if importlib.util.find_spec("metaworld") is None:
            return []
        prepare_rendering()
        return sorted(require("metaworld").ALL_V3_ENVIRONMENTS)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {
            "control_mode": "ee_delta_position",
            "metres_per_unit": float(self._alive().action_scale),
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        self._env.seed(seed)
        if self._goals is not None:
            self._env.set_task(self._goals[state])
        raw, _ = self._env.reset()
        return self._observe(raw), {}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        raw, reward, _, _, info = self._env.step(np.clip(action, -1.0, 1.0))
        obs = self._observe(raw, look=self.looked_at)
        return obs, float(reward), *self._solved(bool(info["success"]))

    def _observe(self, raw: np.ndarray, *, look: bool = True) -> Obs:
        """Convert Meta-World's observation, (39,); without `look` the result has no images."""
        return Obs(
            cameras=self._cameras.render(self._env.data) if look else {},
            # The fingers' distance divided by 0.1 m, clipped to [0, 1] by Meta-World.
            gripper=float(raw[3]),
            state={"xyz": raw[:3].astype(np.float32)},
            info={"sim_state": raw},
        )
