"""A scripted expert that runs Meta-World's own oracles on the simulator's state."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.errors import ContractMismatch
from vlagents_ray.interface import Act, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.policies.experts import sim_vector
from vlagents_ray.registry import env_task, require

# Hand (3,), gripper (1,) and objects (14,); the same values at the previous step; and goal (3,).
_SIZE = 39


class MetaWorldExpert:
    """Passes the simulator's observation, in `info["sim_state"]`, to the task's oracle."""

    def __init__(self, env_name: str) -> None:
        oracles: dict[str, Any] = require("metaworld.policies").ENV_POLICY_MAP
        task = env_task(env_name) or "reach-v3"
        if task not in oracles:
            raise ContractMismatch(
                f"expected a task of Meta-World that has an oracle, one of {sorted(oracles)}, got "
                f"{env_name!r}{did_you_mean(task, oracles)}"
            )
        self._name = env_name
        self._oracle = oracles[task]()

    def reset(self, obs: Obs, instruction: str) -> None:
        sim_vector(obs, _SIZE, self._name)

    def act(self, obs: Obs) -> Act:
        state = sim_vector(obs, _SIZE, self._name)
        action = np.asarray(self._oracle.get_action(state), dtype=np.float32)
        return Act(action=np.clip(action, -1.0, 1.0))
