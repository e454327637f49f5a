"""Scripted experts: for each simulator a small class that solves its tasks without learning.

`EXPERTS` maps an env's full name, or the suite alone, to "module:Class"; the full name wins. A
module is imported when the first of its experts is used.
"""

from __future__ import annotations

import importlib
from typing import Protocol

import numpy as np

from vlagents_ray.errors import ContractMismatch, InvalidObservation
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import env_suite

EXPERTS: dict[str, str] = {
    "tabletop": "vlagents_ray.policies.experts.tabletop:TabletopExpert",
    "maniskill/PushCube-v1": "vlagents_ray.policies.experts.maniskill:PushCube",
    "maniskill/PickCube-v1": "vlagents_ray.policies.experts.maniskill:PickCube",
    "aloha": "vlagents_ray.policies.experts.mujoco:AlohaExpert",
    "metaworld": "vlagents_ray.policies.experts.mujoco:MetaWorldExpert",
    "pusht": "vlagents_ray.policies.experts.pusht:PushTExpert",
    "rcs/pick": "vlagents_ray.policies.experts.mujoco:RcsPick",
    "gymnasium/FetchReach-v4": "vlagents_ray.policies.experts.mujoco:FetchReach",
    "gymnasium/FetchReachDense-v4": "vlagents_ray.policies.experts.mujoco:FetchReach",
    "libero": "vlagents_ray.policies.experts.osc_pose:LiberoExpert",
    "robosuite": "vlagents_ray.policies.experts.osc_pose:RobosuiteExpert",
    "simpler": "vlagents_ray.policies.experts.maniskill:SimplerExpert",
}


class Expert(Protocol):
    """The expert of a session, created for each episode."""

    def __init__(self, env_name: str) -> None: ...

    def reset(self, obs: Obs, instruction: str) -> None:
        """Begin an episode; raises `InvalidObservation` if the task cannot be determined."""
        ...

    def act(self, obs: Obs) -> Act:
        """Compute an action, (D,) float32, in the units of the env's contract."""
        ...


def expert_for(env_name: str) -> Expert:
    """Make an expert for an env, e.g. "tabletop/slide"; raises `ContractMismatch` if there is none."""
    target = EXPERTS.get(env_name) or EXPERTS.get(env_suite(env_name))
    if target is None:
        raise ContractMismatch(
            f"no scripted expert for env {env_name!r}: there are experts for {sorted(EXPERTS)}; "
            f"choose one of these envs, or another policy"
        )
    module, _, name = target.partition(":")
    expert: Expert = getattr(importlib.import_module(module), name)(env_name)
    return expert


def sim_vector(obs: Obs, size: int, env_name: str, cure: str = "this expert cannot act on images") -> np.ndarray:
    """Return `info["sim_state"]` of an observation, (`size`,); raises `InvalidObservation` if there is none."""
    state = obs.info.get("sim_state")
    if not isinstance(state, np.ndarray) or state.shape != (size,):
        got = f"shape {state.shape}" if isinstance(state, np.ndarray) else type(state).__name__
        raise InvalidObservation(
            f"info['sim_state']: got {got}, want ({size},), as the env {env_name} gives it; {cure}"
        )
    return state
