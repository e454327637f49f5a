"""The Gymnasium spaces of an environment's contract, and its observations as members of them."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs

Observation = Literal["all", "state"]


def action_space(spaces: Any, contract: Contract) -> Any:
    """Return Box (D,) float32 within the contract's bounds; raises `ConfigError` if it does not state D."""
    spec = contract.action
    low, high = (-np.inf if spec.low is None else spec.low), (np.inf if spec.high is None else spec.high)
    return spaces.Box(low, high, (_stated(spec.dim, "action.dim"),), np.float32)


def observation_space(spaces: Any, contract: Contract, observation: Observation) -> Any:
    """Return the space of `observed`; raises `ConfigError` if the contract does not state a size."""
    state = {
        f"state/{name}": spaces.Box(-np.inf, np.inf, (_stated(spec.dim, f"state {name!r}: dim"),), np.float32)
        for name, spec in sorted((contract.state or {}).items())
    }
    if contract.gripper:
        state["gripper"] = spaces.Box(0.0, 1.0, (1,), np.float32)
    if observation == "all":
        cameras = {
            f"cameras/{name}": spaces.Box(
                0, 255, (_stated(one.height, f"{name}: height"), _stated(one.width, f"{name}: width"), 3), np.uint8
            )
            for name, one in sorted((contract.cameras or {}).items())
        }
        return spaces.Dict(cameras | state)
    if not state:
        raise ConfigError("observation: got 'state', but the env's contract has none and no gripper; want 'all'")
    low, high = (np.concatenate([getattr(part, bound) for part in state.values()]) for bound in ("low", "high"))
    return spaces.Box(low, high, dtype=np.float32)


def observed(obs: Obs, observation: Observation) -> Any:
    """Return an observation as a member of its space, in arrays of its own.

    Args:
        obs: The observation of the environment.
        observation: "all" is a dict of `cameras/NAME`, `state/NAME` and, if there is one, `gripper`, (1,). "state" is
            one vector: the parts of the state by name, then the gripper.
    """
    state = {f"state/{name}": np.array(part, np.float32) for name, part in sorted(obs.state.items())}
    if obs.gripper is not None:
        state["gripper"] = np.array([obs.gripper], np.float32)
    if observation == "state":
        return np.concatenate(list(state.values()))
    return {f"cameras/{name}": np.array(image) for name, image in sorted(obs.cameras.items())} | state


def _stated(size: int | None, what: str) -> int:
    if size is None:
        raise ConfigError(f"{what}: the env's contract does not state it, but Gymnasium wants to know; state it there")
    return size
