"""What a policy needs and gives, what a robot or env gives and takes, and whether they fit.

Both sides state a `Contract`; `require_match` compares them before the first step and names every
difference with its cure. `None` anywhere means "not stated", and what is not stated is not
compared. Images are always upright RGB; a simulator that renders upside down is turned by its env.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

import numpy as np

from vlagents_ray.errors import (
    ContractMismatch,
    InvalidAction,
    InvalidObservation,
    MalformedMessage,
    MissingCamera,
    MissingState,
)
from vlagents_ray.interface import Obs

_FEW = 64  # numbers

Rotation = Literal["none", "axis_angle", "euler_xyz", "quat_xyzw", "quat_wxyz", "rot6d"]


@dataclass(frozen=True, slots=True)
class CameraSpec:
    """Size of an upright RGB image in pixels; None accepts any."""

    height: int | None = None
    width: int | None = None


@dataclass(frozen=True, slots=True)
class StateSpec:
    """One part of the proprioception: (dim,) float32."""

    dim: int | None = None
    unit: str | None = None  # e.g. "rad", "m", "m+quat_wxyz"


@dataclass(frozen=True, slots=True)
class ActionSpec:
    """One row of an action."""

    dim: int | None = None
    space: str | None = None  # what is commanded: "joint", "ee_position", "ee_pose", ...
    delta: bool | None = None  # relative to the current pose, or absolute
    rotation: Rotation | None = None  # how a commanded rotation is written
    frame: str | None = None  # frame of a Cartesian command: "base", "tool"
    gripper_open: float | None = None  # the action's value that opens the gripper
    gripper_closed: float | None = None  # and the one that closes it
    low: float | None = None  # bounds of every component
    high: float | None = None
    arms: tuple[str, ...] | None = None  # of several, in the order of the row: each its command, then its gripper


@dataclass(frozen=True, slots=True)
class Contract:
    """One side of the comparison; the field's comments say what each side means by it."""

    cameras: Mapping[str, CameraSpec] | None = None  # policy: needs; env: gives
    state: Mapping[str, StateSpec] | None = None  # policy: needs; env: gives
    gripper: bool | None = None  # policy: needs `Obs.gripper`; env: gives it
    instruction: bool | None = None  # policy: needs an instruction; env: gives one
    action: ActionSpec = field(default_factory=ActionSpec)  # policy: gives; env: takes
    control_hz: float | None = None  # policy: trained at; env: runs at
    chunk: int | None = None  # policy: rows an `act` returns; env: rows it can take a step (None: any)
    history: int | None = None  # policy: consecutive observations it keeps per session

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values, for metadata and results, which processes with another numpy read."""
        return {key: _plain(value) for key, value in asdict(self).items()}

    @classmethod
    def from_json(cls, data: object) -> Contract:
        """The inverse of `to_json`; unknown keys raise `MalformedMessage`."""
        top = _closed(cls, data, "contract")
        for name, spec in (("cameras", CameraSpec), ("state", StateSpec)):
            if top.get(name) is not None:
                if not isinstance(top[name], dict):
                    raise MalformedMessage(f"contract.{name}: got {type(top[name]).__name__}, want an object")
                top[name] = {str(k): spec(**_closed(spec, v, f"contract.{name}.{k}")) for k, v in top[name].items()}
        if "action" in top:
            action = _closed(ActionSpec, top["action"], "contract.action")
            arms = action.get("arms")
            if isinstance(arms, (list, tuple)) and all(isinstance(name, str) for name in arms):
                action["arms"] = tuple(arms)
            elif arms is not None:
                raise MalformedMessage(f"contract.action.arms: got {arms!r}, want a list of names")
            top["action"] = ActionSpec(**action)
        return cls(**top)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return list(value)
    return value.item() if isinstance(value, np.generic) else value


def differences(policy: Contract, env: Contract) -> list[str]:
    """Everything in which `env` does not fit `policy`, one sentence each with its cure."""
    found = [*_camera_differences(policy, env), *_state_differences(policy, env)]
    if policy.gripper and env.gripper is False:
        found.append("gripper: the policy needs Obs.gripper, the env gives none; fill it, 1 = open")
    if policy.instruction and env.instruction is False:
        found.append("instruction: the policy needs one, the env gives none; set it in the env's options")
    found += _action_differences(policy.action, env.action)
    if _differ(policy.control_hz, env.control_hz):
        found.append(
            f"control_hz: the policy was made for {policy.control_hz} Hz, the env runs at {env.control_hz} Hz; "
            f"set the env's control rate"
        )
    if _differ(policy.chunk, env.chunk):
        found.append(
            f"chunk: the policy returns {policy.chunk} rows, the env takes {env.chunk}; set the policy's chunk length"
        )
    return found


def _differ(a: object, b: object) -> bool:
    """Are both stated, and not the same?"""
    return a is not None and b is not None and a != b


def _camera_differences(policy: Contract, env: Contract) -> Iterator[str]:
    if env.cameras is None:
        return
    for name, need in (policy.cameras or {}).items():
        have = env.cameras.get(name)
        if have is None:
            yield (
                f"camera {name!r}: the policy needs it, the env gives {sorted(env.cameras)}; "
                f"add or rename a camera of the env"
            )
        elif _differ(need.height, have.height) or _differ(need.width, have.width):
            yield (
                f"camera {name!r}: the policy needs {need.height}x{need.width} pixels (height x width), "
                f"the env gives {have.height}x{have.width}; set the env's camera size"
            )


def _state_differences(policy: Contract, env: Contract) -> Iterator[str]:
    if env.state is None:
        return
    for name, need in (policy.state or {}).items():
        have = env.state.get(name)
        if have is None:
            yield (
                f"state {name!r}: the policy needs it, the env gives {sorted(env.state)}; "
                f"add or rename a state of the env"
            )
            continue
        if _differ(need.dim, have.dim):
            yield (
                f"state {name!r}: the policy needs {need.dim} numbers, the env gives {have.dim}; "
                f"is this another task's or robot's policy?"
            )
        if _differ(need.unit, have.unit):
            yield f"state {name!r}: the policy needs {need.unit!r}, the env gives {have.unit!r}; convert it"


def _action_differences(policy: ActionSpec, env: ActionSpec) -> Iterator[str]:
    for name, cure in _ACTION_CURES.items():
        gives, takes = getattr(policy, name), getattr(env, name)
        if _differ(gives, takes):
            yield f"action.{name}: the policy gives {gives!r}, the env takes {takes!r}; {cure}"
    if policy.low is not None and env.low is not None and policy.low < env.low:
        yield f"action.low: the policy goes down to {policy.low}, the env takes {env.low}; scale or clip the actions"
    if policy.high is not None and env.high is not None and policy.high > env.high:
        yield f"action.high: the policy goes up to {policy.high}, the env takes {env.high}; scale or clip the actions"


_ACTION_CURES = {
    "dim": "choose the control mode the policy was trained with",
    "space": "choose the control mode the policy was trained with",
    "delta": "choose the matching delta or absolute control mode",
    "rotation": "convert the rotation, or choose another control mode",
    "frame": "choose the control mode of that frame",
    "gripper_open": "map the gripper's command",
    "gripper_closed": "map the gripper's command",
    "arms": "put the arms' commands into the env's order",
}


def require_match(policy: Contract | None, env: Contract | None) -> None:
    """Raise `ContractMismatch` with every difference, or return if the two fit."""
    if policy is None or env is None:
        return
    found = differences(policy, env)
    if found:
        raise ContractMismatch("policy and env do not fit:\n" + "\n".join(f"- {line}" for line in found))


def check_observation(obs: Obs, contract: Contract | None) -> None:
    """Raise `InvalidObservation` unless `obs` is well formed and has what `contract` needs."""
    for name, image in obs.cameras.items():
        if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise InvalidObservation(f"camera {name!r}: got {_describe(image)}, want (H, W, 3) uint8 RGB")
    for name, part in obs.state.items():
        if not isinstance(part, np.ndarray) or part.ndim != 1 or part.dtype.kind not in "fiu":
            raise InvalidObservation(f"state {name!r}: got {_describe(part)}, want (D,) float32")
        if not _finite(part):
            raise InvalidObservation(f"state {name!r}: got NaN or infinity, want finite numbers; check the sensor")
    if obs.gripper is not None and not 0.0 <= obs.gripper <= 1.0:
        raise InvalidObservation(f"gripper: got {obs.gripper}, want a number in [0, 1] where 1 = open")
    if contract is not None and (contract.cameras or contract.state or contract.gripper):
        _check_needs(obs, contract)


def _check_needs(obs: Obs, contract: Contract) -> None:
    for name, camera in (contract.cameras or {}).items():
        if name not in obs.cameras:
            raise MissingCamera(name, have=obs.cameras)
        height, width = obs.cameras[name].shape[:2]
        if _differ(camera.height, height) or _differ(camera.width, width):
            raise InvalidObservation(
                f"camera {name!r}: got {height}x{width}, want {camera.height}x{camera.width}; resize before sending"
            )
    for name, spec in (contract.state or {}).items():
        if name not in obs.state:
            raise MissingState(name, have=obs.state)
        if _differ(spec.dim, obs.state[name].shape[0]):
            raise InvalidObservation(
                f"state {name!r}: got {obs.state[name].shape}, want ({spec.dim},); see the policy's contract"
            )
    if contract.gripper and obs.gripper is None:
        raise InvalidObservation("gripper: got none, want a number in [0, 1] where 1 = open")


def check_action(action: object, contract: Contract | None) -> np.ndarray:
    """The action as (D,) or (H, D) float32; `InvalidAction` if it must not reach a robot."""
    try:
        array = np.ascontiguousarray(action, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise InvalidAction(f"action: got {_describe(action)}, want (D,) or (H, D) float32") from error
    if array.ndim not in (1, 2) or array.size == 0:
        raise InvalidAction(f"action: got {_describe(action)}, want (D,) or (H, D) float32")
    if not _finite(array):
        raise InvalidAction("action: got NaN or infinity; the policy's output is broken")
    if contract is not None and contract.action.dim not in (None, array.shape[-1]):
        raise InvalidAction(f"action: got {array.shape}, want {contract.action.dim} numbers a row")
    return array


def _finite(array: np.ndarray) -> bool:
    """No NaN, no infinity. Of a robot's few numbers Python itself knows four times as fast as numpy's."""
    if array.size <= _FEW:
        return all(map(math.isfinite, array.ravel().tolist()))
    return bool(np.isfinite(array).all())


def _describe(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.shape} {value.dtype}"
    return type(value).__name__


def _closed(cls: type, data: object, where: str) -> dict[str, Any]:
    if not isinstance(data, Mapping):
        raise MalformedMessage(f"{where}: got {type(data).__name__}, want an object")
    known = {f.name for f in fields(cls)}
    unknown = set(map(str, data)) - known
    if unknown:
        raise MalformedMessage(f"{where}: unknown keys {sorted(unknown)}, want some of {sorted(known)}")
    return {str(k): v for k, v in data.items()}
