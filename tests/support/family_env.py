"""An environment with the cameras and states of each policy family, and a worker that runs it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import ray

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.interface import GOAL_IMAGE, Act

DESK = "family_env:Desk"
SIDE = 64  # px; some checkpoints accept only this size
STATES = {"xyz_axis_angle": 6, "gripper_qpos": 2, "joints": 7, "xyzrpy": 6, "agent_pos": 2}


class Desk(EvalEnv):
    """An environment with random images and states. An episode succeeds after two steps."""

    max_steps = 3

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)
        self._steps = 0

    @property
    def contract(self) -> Contract:
        cameras = dict.fromkeys(("front", "wrist", "top"), CameraSpec(SIDE, SIDE))
        return Contract(
            cameras,
            {name: StateSpec(dim) for name, dim in STATES.items()},
            gripper=True,
            instruction=True,
        )

    @property
    def instruction(self) -> str:
        return "pick up the cube"

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        self._rng, self._steps = np.random.default_rng(seed), 0
        return self._look(), {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return (
            self._look(),
            0.0,
            False,
            self._steps == self.max_steps,
            {"success": self._steps == 2},
        )

    def close(self) -> None:
        self._steps = 0

    def _look(self) -> Obs:
        cameras = {
            name: self._rng.integers(0, 256, (SIDE, SIDE, 3), np.uint8)
            for name in self.contract.cameras or {}
        }
        state = {
            name: self._rng.uniform(-0.1, 0.1, dim).astype(np.float32)
            for name, dim in STATES.items()
        }
        return Obs(cameras, 0.5, state, {GOAL_IMAGE: cameras["front"]})


def play(
    url: str, transport: TransportName, seed: int, steps: int = 3
) -> tuple[str, list[np.ndarray]]:
    """Return the transport of the connection, and the first actions of an episode."""
    with Desk() as env, RemoteAgent(url, transport=transport, codec="raw", timeout_s=120) as agent:
        obs, _ = env.reset(seed=seed)
        agent.reset(obs, env.instruction, seed=seed)
        acts = [agent.act(env._look()).action for _ in range(steps)]
        return agent.transport, acts


@ray.remote(num_cpus=0)
class DeskActor:
    """A worker on the node of the policy."""

    def play(self, *arguments: Any) -> tuple[str, list[np.ndarray]]:
        return play(*arguments)
