"""Checks of observations and actions against a policy's contract, and of a policy's `reset`."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract, _differ
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidInput,
    InvalidObservation,
    MissingCamera,
    MissingState,
    NotOffered,
)
from vlagents_ray.interface import WANT, Agent, Obs
from vlagents_ray.naming import did_you_mean

# Limit of the absolute value of an action's numbers; larger numbers are meaningless in any unit.
LARGEST_ACTION = 1e9
# Names that select a checkpoint in a policy's settings, but not at a reset.
_CHECKPOINT_OPTIONS = frozenset({"checkpoint", "checkpoint_step"})
# Options of a reset whose misspelling is found: these, and the weights of a learner
# (`serve.weights`). Shorter names, such as `seed`, are too similar to other words.
_KNOWN_OPTIONS = sorted({*_CHECKPOINT_OPTIONS, "weights"})
_MISSPELT = 0.8  # similarity of two names from which one is a misspelling of the other
_SMALL = 64  # largest array size for which Python's own check is faster than numpy's
_UINT8, _FLOAT32 = np.dtype(np.uint8), np.dtype(np.float32)


def check_reset(agent: Agent) -> None:
    """Raise `ConfigError` unless `agent.reset` accepts the options that every episode has."""
    signature = inspect.signature(agent.reset)
    try:
        signature.bind(Obs(), "", seed=0, env="")
    except TypeError as error:
        raise ConfigError(
            f"{type(agent).__name__}.reset: expected the parameters (obs, instruction, **kwargs), "
            f"got {signature} ({error}); episodes pass `seed`, evaluations also `env`, and clients "
            "may pass further options: add **kwargs"
        ) from error


def check_options(agent: Agent, options: Mapping[str, Any]) -> None:
    """Raise `InvalidInput` if an option of a reset selects a checkpoint, or has almost the name of
    an option that the server knows.

    A policy's own options are free, so a misspelt name would have no effect, and no error would
    tell the client. Options that the policy's `reset` names as parameters are accepted.
    """
    for name in options:
        suggestion = did_you_mean(name, _KNOWN_OPTIONS, similarity=_MISSPELT)
        is_known = name in _KNOWN_OPTIONS and name not in _CHECKPOINT_OPTIONS
        if not suggestion or is_known or name in inspect.signature(agent.reset).parameters:
            continue
        if name in _CHECKPOINT_OPTIONS:
            raise InvalidInput(
                f"reset: the option {name!r} selects no checkpoint, as a replica has only one; "
                "call the application that serves the other checkpoint"
            )
        raise InvalidInput(
            f"reset: the policy's `reset` has no parameter {name!r}{suggestion} If {name!r} is "
            "meant, name it among the parameters"
        )


def check_observation(obs: Obs, contract: Contract | None) -> None:
    """Raise `InvalidObservation` unless `obs` is well-formed and has the inputs that `contract`
    names.
    """
    for name, image in obs.cameras.items():
        if (
            not isinstance(image, np.ndarray)
            or image.ndim != 3
            or image.shape[2] != 3
            or image.dtype != _UINT8
        ):
            raise InvalidObservation(
                f"camera {name!r}: expected (H, W, 3) uint8 RGB, got {described(image)}"
            )
        if not image.size:
            raise InvalidObservation(
                f"camera {name!r}: expected at least one pixel, got {described(image)}"
            )
    if "" in obs.cameras or "" in obs.state:
        raise InvalidObservation(
            "observation: expected a name for each camera and state, got an empty one ('')"
        )
    for name, values in obs.state.items():
        if not isinstance(values, np.ndarray) or values.ndim != 1 or values.dtype.kind not in "fiu":
            raise InvalidObservation(
                f"state {name!r}: expected (D,) float32, got {described(values)}"
            )
        if not _finite(values):
            raise InvalidObservation(
                f"state {name!r}: expected finite numbers, got NaN or infinity; check the sensor"
            )
    if obs.gripper is not None and not 0.0 <= obs.gripper <= 1.0:
        raise InvalidObservation(
            f"gripper: expected a number in [0, 1] where 1 = open, got {obs.gripper}"
        )

    if WANT in obs.info:
        requested = obs.info[WANT]
        offered = (contract and contract.behaviour) or ()
        if not isinstance(requested, list) or not all(isinstance(name, str) for name in requested):
            raise InvalidObservation(
                f"info[{WANT!r}]: expected a list of names, got {described(requested)}"
            )
        unknown = sorted(set(requested) - set(offered))
        if unknown:
            raise NotOffered(
                f"info[{WANT!r}]: expected only {sorted(offered)}, the `behaviour` of the policy's "
                f"contract, got {unknown}; leave it out, or use a policy that returns it"
            )

    if contract is not None and (contract.cameras or contract.state or contract.gripper):
        _check_needs(obs, contract)


def _check_needs(obs: Obs, contract: Contract) -> None:
    """Raise `InvalidObservation` unless `obs` has the inputs that `contract` names."""
    for name, camera in (contract.cameras or {}).items():
        if name not in obs.cameras:
            raise MissingCamera(name, have=obs.cameras)
        height, width = obs.cameras[name].shape[:2]
        if _differ(camera.height, height) or _differ(camera.width, width):
            raise InvalidObservation(
                f"camera {name!r}: expected {camera.height}x{camera.width}, got {height}x{width}; "
                "resize before sending"
            )
    for name, spec in (contract.state or {}).items():
        if name not in obs.state:
            raise MissingState(name, have=obs.state)
        if _differ(spec.dim, obs.state[name].shape[0]):
            raise InvalidObservation(
                f"state {name!r}: expected shape ({spec.dim},), got {obs.state[name].shape}; see "
                "the policy's contract"
            )
    if contract.gripper and obs.gripper is None:
        raise InvalidObservation(
            "gripper: expected a number in [0, 1] where 1 = open, got None; set it in the "
            "observation"
        )


def check_action(action: object, contract: Contract | None) -> np.ndarray:
    """Return the action as (D,) or (H, D) float32; raises `InvalidAction` if it must not be sent
    to a robot.
    """
    try:
        array = np.ascontiguousarray(action, dtype=_FLOAT32)
    except (TypeError, ValueError, RuntimeError) as error:
        # A torch tensor that requires grad raises RuntimeError.
        raise InvalidAction(
            f"action: expected (D,) or (H, D) float32, got {described(action)}"
        ) from error
    if array.ndim not in (1, 2) or array.size == 0:
        raise InvalidAction(f"action: expected (D,) or (H, D) float32, got {described(action)}")

    largest = _largest(array)
    if not largest <= LARGEST_ACTION:
        if not math.isfinite(largest):
            raise InvalidAction(
                "action: expected finite numbers, got NaN or infinity; check the policy's output"
            )
        raise InvalidAction(
            f"action: expected numbers of at most {LARGEST_ACTION:g}, got a number of size "
            f"{largest:.3g}; check the policy's output"
        )
    if contract is not None and contract.action.dim not in (None, array.shape[-1]):
        raise InvalidAction(
            f"action: expected {contract.action.dim} numbers a row, got shape {array.shape}"
        )
    return array


def _finite(array: np.ndarray) -> bool:
    """Return whether all numbers are finite; for a robot's few numbers Python is four times as
    fast as numpy.
    """
    if array.size <= _SMALL:
        return all(map(math.isfinite, array.ravel().tolist()))
    return bool(np.isfinite(array).all())


def _largest(array: np.ndarray) -> float:
    """Return the largest absolute value; NaN or infinity if the array contains such a value."""
    if array.size <= _SMALL:
        values = array.ravel().tolist()
        return max(map(abs, values)) if all(map(math.isfinite, values)) else math.inf
    return float(np.abs(array).max())


def described(value: object) -> str:
    """Return the shape and type of an array, or the type of any other value, for an error."""
    return f"{value.shape} {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
