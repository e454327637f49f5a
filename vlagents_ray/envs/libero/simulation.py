"""LIBERO's simulator of one task, and the eyes of its robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.envs.libero.benchmark_protocol import LiberoProtocol
from vlagents_ray.envs.libero.tasks import LiberoTask
from vlagents_ray.envs.robosuite.base import CameraRenderer, seeded
from vlagents_ray.errors import EnvFailed
from vlagents_ray.registry import require

_ATTEMPTS = 1000  # to place the scene's objects; one is enough nearly always


@dataclass(frozen=True, slots=True)
class SimulatorObs:
    """The simulator's observation after a step."""

    raw: Mapping[str, Any]  # robosuite's observation
    views: Mapping[str, np.ndarray]  # MuJoCo's camera -> (H, W, 3) uint8, upside down, in the size for the record
    success: bool


class LiberoSimulation:
    """Steps the simulator by the protocol, and renders only images that are used."""

    def __init__(
        self, task: LiberoTask, protocol: LiberoProtocol, assets: Path, record_size: tuple[int, int] | None
    ) -> None:
        self._package: Any = require("libero.libero")
        self._assets = assets
        self._protocol = protocol
        self._use_assets()
        self._env: Any = require("libero.libero.envs").OffScreenRenderEnv(
            bddl_file_name=str(task.problem),
            controller=protocol.controller,
            control_freq=protocol.control_hz,
            camera_names=list(protocol.cameras.values()),
            camera_heights=protocol.image_size[0],
            camera_widths=protocol.image_size[1],
            horizon=protocol.settling_steps + protocol.max_steps + 1,  # robosuite's own limit stays out of the way
        )
        self._cameras = CameraRenderer(self._env.env, record_size)

    def begin(self, state: np.ndarray) -> SimulatorObs:
        """Seed, reset, set the initial `state`, (D,) float64, and let the objects settle."""
        settling = self._protocol.settling_steps
        self._use_assets()
        self._cameras.make_current()  # the last episode's rendering resources are freed in their own context
        self._cameras.open = False
        with seeded(self._protocol.simulator_seed):
            self._reset()
            self._cameras.open = settling == 0
            raw = self._env.set_init_state(state)
            success = bool(self._env.check_success())
            for i in range(settling):
                self._cameras.open = i == settling - 1
                raw, _, success, _ = self._env.step(list(self._protocol.settling_action))
        self._cameras.open = True
        return SimulatorObs(raw, self._cameras.views, bool(success))

    def step(self, action: np.ndarray, *, look: bool = True) -> SimulatorObs:
        """Execute an action, (7,) float64, clipped to [-1, 1] by the controller; without `look` nothing is rendered."""
        self._cameras.open = look
        raw, _, success, _ = self._env.step(action)
        return SimulatorObs(raw, self._cameras.views, bool(success))

    @property
    def goal(self) -> list[list[str]]:
        """The goal's predicates, all of which must hold, e.g. [["on", "akita_black_bowl_1", "plate_1"]]."""
        return [[str(word) for word in predicate] for predicate in self._env.env.parsed_problem["goal_state"]]

    def positions(self) -> dict[str, np.ndarray]:
        """Return the positions of all objects and other parts of the goal, (3,) float64, m in the world's frame."""
        domain = self._env.env
        states = domain.object_states_dict
        named = {*domain.objects_dict, *(name for _, *names in self.goal for name in names)}
        return {
            name: np.array(states[name].get_geom_state()["pos"], np.float64) for name in sorted(named & set(states))
        }

    def flat_state(self) -> np.ndarray:
        """MuJoCo's time, qpos and qvel, (D,) float64, as the initial states are written."""
        state: np.ndarray = self._env.get_sim_state()
        return state

    def close(self) -> None:
        self._cameras.make_current()
        self._env.close()

    def _reset(self) -> None:
        """Do the work of `OffScreenRenderEnv.reset`, which itself repeats it after any error, without end."""
        crowded = require("robosuite.utils.errors").RandomizationError
        for _ in range(_ATTEMPTS):
            try:
                self._env.env.reset()
            except crowded:  # the drawn places overlap: draw again
                continue
            return
        raise EnvFailed(f"the scene's objects found no place in {_ATTEMPTS} draws")

    def _use_assets(self) -> None:
        self._package._assets_path_cache = str(self._assets)  # global in the process: another env may have set it
