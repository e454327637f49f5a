"""Scripted experts: small classes that solve simulated tasks without learning.

`EXPERTS` maps the full name of an env, or the name of a suite, to "module:Class"; the full name has
priority. A module is imported when the first of its experts is used. `examples/experts/README.md`
lists experts for more simulators.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from vlagents_ray.errors import ContractMismatch, InvalidObservation
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import env_suite, named_class

EXPERTS: dict[str, str] = {
    "tabletop": "vlagents_ray.policies.experts.tabletop:TabletopExpert",
    "maniskill/PushCube-v1": "vlagents_ray.policies.experts.maniskill:PushCube",
    "maniskill/PickCube-v1": "vlagents_ray.policies.experts.maniskill:PickCube",
}


class Expert(Protocol):
    """The expert of a session. A new one is created for each episode."""

    def __init__(self, env_name: str) -> None: ...

    def reset(self, obs: Obs, instruction: str) -> None:
        """Begin an episode; raises `InvalidObservation` if the task cannot be determined."""

    def act(self, obs: Obs) -> Act:
        """Compute an action, (D,) float32, in the units of the env's contract."""


def expert_class(env_name: str) -> type[Expert]:
    """Return the expert for an env, e.g. "tabletop/slide".

    Raises:
        ContractMismatch: There is no expert for this env.
    """
    target = EXPERTS.get(env_name) or EXPERTS.get(env_suite(env_name))
    if target is None:
        raise ContractMismatch(
            f"no scripted expert for env {env_name!r}: there are experts for {sorted(EXPERTS)}; "
            "choose one of these envs, set `expert` to one of examples/experts/README.md, such as "
            "'experts.pusht:PushTExpert', or choose another policy"
        )
    return named_class(target)


def sim_vector(
    obs: Obs, size: int, env_name: str, cure: str = "this expert cannot act on images"
) -> np.ndarray:
    """Return `info["sim_state"]` of an observation.

    Args:
        obs: The observation.
        size: The expected length.
        env_name: The name of the env, for errors.
        cure: The end of the error message.

    Returns:
        (`size`,).

    Raises:
        InvalidObservation: The observation has no such state.
    """
    state = obs.info.get("sim_state")
    if not isinstance(state, np.ndarray) or state.shape != (size,):
        content = f"shape {state.shape}" if isinstance(state, np.ndarray) else type(state).__name__
        raise InvalidObservation(
            f"info['sim_state']: expected shape ({size},), as the env {env_name} returns it, got "
            f"{content}; {cure}"
        )
    return state
