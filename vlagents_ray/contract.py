"""The contracts of policies and of robots or environments, and their comparison.

Both sides state a `Contract`: the inputs and the actions that a policy needs and returns, and those
that a robot or an env provides and accepts. `require_match` compares them before the first step and
lists every difference with its cure. `None` means "not stated", and a field that is not stated is
not compared. Images are always upright RGB; the env of a simulator that renders upside down rotates
them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import combinations
from typing import Any, Literal, TypeGuard, get_args

import numpy as np

from vlagents_ray.errors import ConfigError, ContractMismatch, MalformedMessage
from vlagents_ray.naming import says_its_fields

_MOST_PARTS = 12  # of the env's state, whose combinations are tried
_SHOWN = 3  # combinations in a message

Rotation = Literal["none", "axis_angle", "euler_xyz", "quat_xyzw", "quat_wxyz", "rot6d"]


@says_its_fields()
@dataclass(frozen=True, slots=True)
class CameraSpec:
    """The size of a camera's upright RGB images in pixels; None accepts any."""

    height: int | None = None
    width: int | None = None


@says_its_fields()
@dataclass(frozen=True, slots=True)
class StateSpec:
    """The size and unit of one part of the proprioception, (dim,) float32."""

    dim: int | None = None
    unit: str | None = None  # e.g. "rad", "m", "m+quat_wxyz"


@says_its_fields("; the rows of a chunk are Contract(chunk=…)")
@dataclass(frozen=True, slots=True)
class ActionSpec:
    """The meaning of the numbers in an action, (dim,) float32, or in each row of a chunk of
    actions.
    """

    dim: int | None = None
    space: str | None = None  # the commanded quantity: "joint", "ee_position", "ee_pose", ...
    delta: bool | None = None  # whether it is relative to the current pose, else absolute
    rotation: Rotation | None = None  # the representation of a commanded rotation
    frame: str | None = None  # frame of a Cartesian command: "base", "tool"
    gripper_open: float | None = None  # the value that opens the gripper
    gripper_closed: float | None = None  # the value that closes it
    low: float | None = None  # lower bound of every number
    high: float | None = None  # upper bound of every number
    # Names of several arms in the row's order: the command of each, then its gripper.
    arms: tuple[str, ...] | None = None
    # Of the joints in the row's order, with or without grippers.
    names: tuple[str, ...] | None = None

    @property
    def relative(self) -> bool | None:
        """Whether zeros command no motion (deltas, velocities) instead of a target pose; None if
        that is not stated.
        """
        return True if self.delta or "velocity" in (self.space or "") else self.delta

    def gripper_columns(self, dim: int) -> list[int]:
        """Return the columns of the grippers in an action: the last one of each arm's part.

        A gripper's number is a position, also in relative actions.

        Args:
            dim: The number of values in an action.

        Returns:
            The columns in rising order; empty if neither `gripper_open` nor `gripper_closed` is
            set.

        Raises:
            ConfigError: `arms` does not divide `dim`.
        """
        if self.gripper_open is None and self.gripper_closed is None:
            return []
        arms = len(self.arms or ("",))
        if dim % arms:
            raise ConfigError(
                f"action.arms: expected a number of values that {arms} arms {self.arms} share "
                f"equally, got {dim}; "
                "correct `arms` or `dim` of the contract"
            )
        width = dim // arms
        return [(arm + 1) * width - 1 for arm in range(arms)]

    def delta_columns(self, dim: int) -> list[int]:
        """Return the columns of an action that are deltas or velocities; raises as
        `gripper_columns` does.

        Args:
            dim: The number of values in an action.

        Returns:
            The columns in rising order: all but the grippers' if actions are relative, else none.
        """
        if not self.relative:
            return []
        grippers = self.gripper_columns(dim)
        return [column for column in range(dim) if column not in grippers]


@says_its_fields()
@dataclass(frozen=True, slots=True)
class Contract:
    """The inputs and actions of a policy, or of a robot or env, to be compared with the other
    side's.

    The comments at the fields describe the meaning for each side.
    """

    cameras: Mapping[str, CameraSpec] | None = None  # policy: needs; env: provides
    state: Mapping[str, StateSpec] | None = None  # policy: needs; env: provides
    gripper: bool | None = None  # policy: needs `Obs.gripper`; env: provides it
    instruction: bool | None = None  # policy: needs an instruction; env: provides one
    action: ActionSpec = field(default_factory=ActionSpec)  # policy: returns; env: accepts
    # policy: rate of its training data, Hz; env: rate of its steps, Hz.
    control_hz: float | None = None
    chunk: int | None = None  # policy: rows of an `Act`; env: rows it accepts at once (None: any)
    history: int | None = None  # policy: consecutive observations it keeps per session
    # policy: values that an `Act` has on request, e.g. "logprob", "value".
    behaviour: tuple[str, ...] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the contract as plain JSON values, which processes with another version of
        numpy can read.
        """
        stated = asdict(self)
        if self.behaviour is None:
            del stated["behaviour"]  # only policies for learners state it
        if self.action.names is None:
            del stated["action"]["names"]
        plain: dict[str, Any] = json.loads(json.dumps(stated, default=np.generic.item))
        return plain

    @classmethod
    def from_json(cls, data: object) -> Contract:
        """Read a contract from the result of `to_json`.

        Args:
            data: The decoded JSON document.

        Raises:
            MalformedMessage: The document has an unknown key or a value of a wrong type.
        """
        top = closed(cls, data, "contract")
        for name, spec in (("cameras", CameraSpec), ("state", StateSpec)):
            if top.get(name) is not None:
                if not isinstance(top[name], dict):
                    raise MalformedMessage(
                        f"contract.{name}: got {type(top[name]).__name__}, want an object"
                    )
                top[name] = {
                    str(k): spec(**closed(spec, v, f"contract.{name}.{k}"))
                    for k, v in top[name].items()
                }
        if "action" in top:
            action = closed(ActionSpec, top["action"], "contract.action")
            lists = {
                name: _names(action.get(name), f"contract.action.{name}")
                for name in ("arms", "names")
            }
            top["action"] = ActionSpec(**{**action, **lists})
        return cls(**{**top, "behaviour": _names(top.get("behaviour"), "contract.behaviour")})


def _names(value: object, where: str) -> tuple[str, ...] | None:
    if isinstance(value, (list, tuple)) and all(isinstance(name, str) for name in value):
        return tuple(value)
    if value is not None:
        raise MalformedMessage(f"{where}: got {value!r}, want a list of names")
    return None


def differences(policy: Contract, env: Contract) -> list[str]:
    """List the differences between the contracts of a policy and an env, one sentence each with
    its cure.
    """
    found, given = [], env.cameras or {}
    for name, need in ((policy.cameras or {}) if env.cameras is not None else {}).items():
        if (have := given.get(name)) is None:
            found.append(
                f"camera {name!r}: the policy needs it, the env gives {sorted(given)}; "
                f"add or rename a camera of the env"
            )
        elif _differ(need.height, have.height) or _differ(need.width, have.width):
            found.append(
                f"camera {name!r}: the policy needs {need.height}x{need.width} pixels (height x "
                "width), "
                f"the env gives {have.height}x{have.width}; set the env's camera size"
            )
    found += _state_differences(policy, env)
    if policy.gripper and env.gripper is False:
        found.append(
            "gripper: the policy needs Obs.gripper, which the env does not provide; fill it, 1 = "
            "open"
        )
    if policy.instruction and env.instruction is False:
        found.append(
            "instruction: the policy needs one, the env has none; set it in the env's options"
        )
    found += _action_differences(policy.action, env.action)
    if _differ(policy.control_hz, env.control_hz):
        found.append(
            f"control_hz: the policy was made for {policy.control_hz} Hz, the env runs at "
            f"{env.control_hz} Hz; "
            f"set the env's control rate"
        )
    if _differ(policy.chunk, env.chunk):
        found.append(
            f"chunk: the policy returns {policy.chunk} rows, the env takes {env.chunk}; set the "
            "policy's chunk length"
        )
    return found


def _differ(a: object, b: object) -> bool:
    """Return whether both values are stated and differ."""
    return a is not None and b is not None and a != b


def _state_differences(policy: Contract, env: Contract) -> Iterator[str]:
    if env.state is None:
        return
    # The part may be several of the env's, concatenated.
    alone = len(policy.state or {}) == 1 and not policy.gripper
    for name, need in (policy.state or {}).items():
        have = env.state.get(name)
        cure = _parts_cure(need.dim, env) if alone else ""
        if have is None:
            yield (
                f"state {name!r}: the policy needs it, the env gives {sorted(env.state)}; "
                f"{cure or 'add or rename a state of the env'}"
            )
            continue
        if _differ(need.dim, have.dim):
            cure = cure or "is this another task's or robot's policy?"
            yield (
                f"state {name!r}: the policy needs {need.dim} numbers, the env gives "
                f"{have.dim}; "
                f"{cure}"
            )
        if _differ(need.unit, have.unit):
            yield (
                f"state {name!r}: the policy needs {need.unit!r}, the env gives {have.unit!r}; "
                "convert it"
            )


def _parts_cure(dim: int | None, env: Contract) -> str:
    """Name parts of the env's state whose sizes add up to `dim`, as a cure; "" if there are
    none.
    """
    widths = {name: spec.dim for name, spec in sorted((env.state or {}).items()) if spec.dim}
    if env.gripper:
        widths["gripper"] = 1
    if dim is None or len(widths) > _MOST_PARTS:
        return ""
    found = [
        parts
        for size in range(len(widths), 0, -1)
        for parts in combinations(widths, size)
        if sum(widths[part] for part in parts) == dim
    ]
    if not found:
        return ""
    shown = " or ".join(f"[{', '.join(parts)}]" for parts in found[:_SHOWN])
    return (
        "if it was trained on several parts, set the policy's `state` to them in their order: "
        f"{shown}"
        f"{' or others' if len(found) > _SHOWN else ''} {'has' if len(found) == 1 else 'have'} "
        f"{dim} numbers here"
    )


def _action_differences(policy: ActionSpec, env: ActionSpec) -> Iterator[str]:
    for name, cure in _ACTION_CURES.items():
        gives, takes = getattr(policy, name), getattr(env, name)
        if _differ(gives, takes):
            yield f"action.{name}: the policy gives {gives!r}, the env takes {takes!r}; {cure}"
    for number, ours, theirs in reordered(policy.names or (), env.names or ()):
        yield (
            f"action.names: number {number} is {ours!r} of the policy and {theirs!r} of the "
            "env; "
            "use one order"
        )
    if policy.low is not None and env.low is not None and policy.low < env.low:
        yield (
            f"action.low: the policy goes down to {policy.low}, the env takes {env.low}; scale "
            "or clip the actions"
        )
    if policy.high is not None and env.high is not None and policy.high > env.high:
        yield (
            f"action.high: the policy goes up to {policy.high}, the env takes {env.high}; scale "
            "or clip the actions"
        )


def reordered(ours: Sequence[str], theirs: Sequence[str]) -> list[tuple[int, str, str]]:
    """Return where two lists have the joints that both name in another order: (number, ours,
    theirs).

    LeRobot's suffix ".pos" does not count.
    """
    mine, others = ([name.removesuffix(".pos") for name in names] for names in (ours, theirs))
    pairs = zip(
        (one for one in mine if one in others), (one for one in others if one in mine), strict=False
    )
    return [(mine.index(one), one, other) for one, other in pairs if one != other]


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


def require_match(policy: Contract | None, env: Contract | None, where: str = "") -> None:
    """Raise `ContractMismatch` with every difference of a policy and an env; `where` names both
    in an evaluation.
    """
    if policy is not None and env is not None and (found := differences(policy, env)):
        raise ContractMismatch(
            f"{where}policy and env do not fit:\n" + "\n".join(f"- {line}" for line in found)
        )


def closed(
    cls: type,
    data: object,
    where: str,
    error: type[MalformedMessage | ConfigError] = MalformedMessage,
) -> dict[str, Any]:
    """Return the entries of `data`; raise `error` unless it is a mapping with only fields of the
    dataclass `cls`.

    Fields that are numbers, texts or booleans are checked; the caller reads all others.
    """
    if not isinstance(data, Mapping):
        raise error(f"{where}: got {type(data).__name__}, want an object")
    known = {one.name: str(one.type) for one in fields(cls)}
    if unknown := sorted(str(key) for key in data if key not in known):
        raise error(f"{where}: unknown keys {unknown}, want some of {sorted(known)}")
    for name, value in data.items():
        if not _FITS.get(known[name], lambda _: True)(value):
            raise error(f"{where}.{name}: got {repr(value)[:80]}, want {known[name]}")
    return dict(data)


def _number(value: object) -> TypeGuard[float]:
    return type(value) in (int, float)


_FITS: dict[str, Callable[[Any], bool]] = {  # by the type of a field
    "str": lambda value: isinstance(value, str),
    "str | None": lambda value: value is None or isinstance(value, str),
    "int": lambda value: type(value) is int,
    "int | None": lambda value: value is None or type(value) is int,
    "float": lambda value: _number(value) and math.isfinite(value),
    "float | None": lambda value: value is None or _number(value),
    "bool": lambda value: isinstance(value, bool),
    "bool | None": lambda value: value is None or isinstance(value, bool),
    "Rotation | None": lambda value: value is None or value in get_args(Rotation),
}
