"""Checks of an environment's outputs, before the policy, the recorder or the result gets any of them.

An error here is the environment's. Without the check it would surface later, in the encoder or in the policy, as if it
were theirs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ContractMismatch, EnvFailed, InvalidObservation, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.validation import check_observation


class EnvStep(NamedTuple):
    """The outputs of one step."""

    obs: Obs
    reward: float
    terminated: bool
    truncated: bool
    success: bool


def checked_instruction(instruction: object, where: str) -> str:
    """Return `instruction`; raises `EnvFailed` if it is not text."""
    if not isinstance(instruction, str):
        raise EnvFailed(f"env {where}: got the instruction {instruction!r}, want a str, empty if there is none")
    return instruction


def checked_step(
    obs: object,
    reward: object,
    terminated: object,
    truncated: object,
    info: object,
    contract: Contract,
    *,
    images: bool = True,
) -> EnvStep:
    """Return the checked outputs of `EvalEnv.step`; without `images`, the environment may have left these out.

    Raises:
        EnvFailed: The observation does not fit the environment's own contract, the reward is not a finite number, or a
            flag is not a bool.
    """
    if not isinstance(info, (dict, Mapping)) or "success" not in info:
        got = f"info with {sorted(map(str, info))}" if isinstance(info, Mapping) else f"{type(info).__name__} as info"
        raise EnvFailed(f"env step: got {got}, want 'success' among it; see EvalEnv.step")
    return EnvStep(
        checked_obs(obs, contract, "step", images=images),
        _number(reward),
        _truth(terminated, "terminated"),
        _truth(truncated, "truncated"),
        _truth(info["success"], "info['success']"),
    )


def checked_obs(obs: object, contract: Contract, where: str, *, images: bool = True) -> Obs:
    """Return `obs`, checked against the environment's own `contract`.

    Raises:
        ContractMismatch: The first observation does not fit: every episode would fail in the same way.
        EnvFailed: A number is not finite, or a later observation does not fit.
    """
    wrong: type[VLAgentsError] = ContractMismatch if where == "reset" else EnvFailed
    if not isinstance(obs, Obs):
        raise wrong(f"env {where}: got {type(obs).__name__} in place of the observation, want an Obs")
    for name, part in (("cameras", obs.cameras), ("state", obs.state), ("info", obs.info)):
        if not isinstance(part, (dict, Mapping)):  # testing for a dict first is faster
            raise wrong(f"env {where}: got {type(part).__name__} as the observation's {name}, want a dict")
    try:
        check_observation(obs, contract if images else replace(contract, cameras=None))
    except InvalidObservation as error:
        if _has_diverged(obs):
            wrong = EnvFailed
        raise wrong(f"env {where}: the observation does not fit the env's own contract: {error}") from error
    except TypeError as error:  # a gripper that cannot be compared with 0 and 1
        raise wrong(f"env {where}: got {obs.gripper!r} as the gripper, want a number in [0, 1]") from error
    return obs


def _has_diverged(obs: Obs) -> bool:
    numbers = [*map(np.asarray, obs.state.values()), np.asarray(0 if obs.gripper is None else obs.gripper)]
    return not all(np.isfinite(part).all() for part in numbers if part.dtype.kind == "f")


def _number(reward: Any) -> float:
    try:
        if math.isfinite(reward):  # a diverged simulation; neither the results file nor JSON has a NaN
            return float(reward)
    except (TypeError, ValueError):
        pass
    raise EnvFailed(f"env step: got the reward {reward!r}, want a finite number")


def _truth(value: object, name: str) -> bool:
    """Return the bool that `value` is, also as a number, 0 or 1; raises for text: "no" would be true."""
    if value is True or value is False:  # the usual case
        return value
    if isinstance(value, bool | np.bool_) or (isinstance(value, Real) and value in (0, 1)):
        return bool(value)
    raise EnvFailed(f"env step: got {value!r} as {name}, want a bool")
