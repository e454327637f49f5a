"""The contracts of policies and of robots or environments, and their comparison.

Both sides have a `Contract`. A policy's contract describes the inputs that it needs and the actions
that it returns; the contract of a robot or an env describes the inputs that it provides and the
actions that it accepts. `require_match` compares them before the first step and lists every
difference with its cure. A field that is None is not compared. Images are always upright RGB; the
env of a simulator that renders upside down rotates them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import combinations
from typing import Any, Literal, TypeGuard, TypeVar, get_args

import numpy as np

from vlagents_ray.errors import ConfigError, ContractMismatch, MalformedMessage
from vlagents_ray.naming import explain_unknown_fields

# Largest number of state parts of an env for which an error message searches combinations of parts.
_MAX_STATE_PARTS = 12
_SHOWN_COMBINATIONS = 3  # largest number of combinations that a message lists

# Fields of an action that only few contracts declare.
_OMITTED_IF_NONE = ("absolute", "grippers", "rotation_columns", "names")
Rotation = Literal["none", "axis_angle", "euler_xyz", "quat_xyzw", "quat_wxyz", "rot6d"]


@explain_unknown_fields()
@dataclass(frozen=True, slots=True)
class CameraSpec:
    """The size of a camera's upright RGB images in pixels; None accepts any."""

    height: int | None = None
    width: int | None = None


@explain_unknown_fields()
@dataclass(frozen=True, slots=True)
class StateSpec:
    """The size and unit of one part of the proprioception, (dim,) float32."""

    dim: int | None = None
    unit: str | None = None  # e.g. "rad", "m", "m+quat_wxyz"


@explain_unknown_fields("; the rows of a chunk are Contract(chunk=…)")
@dataclass(frozen=True, slots=True)
class ActionSpec:
    """The meaning of the numbers in an action, (dim,) float32, or in each row of a chunk of
    actions.
    """

    dim: int | None = None
    space: str | None = None  # the commanded quantity: "joint", "ee_position", "ee_pose", ...
    delta: bool | None = None  # True: relative to the current pose; False: absolute
    rotation: Rotation | None = None  # the representation of a commanded rotation
    frame: str | None = None  # frame of a Cartesian command: "base", "tool"
    gripper_open: float | None = None  # the value that opens the gripper
    gripper_closed: float | None = None  # the value that closes the gripper
    low: float | None = None  # lower bound of every number
    high: float | None = None  # upper bound of every number
    # Names of several arms, in the order of their commands in a row; each command is followed by
    # the command of the arm's gripper.
    arms: tuple[str, ...] | None = None
    # Names of the joints in the order of a row, with or without the grippers. If each number has a
    # name, "gripper" in a name declares a gripper, and "velocity" or the ending ".vel" a velocity.
    names: tuple[str, ...] | None = None
    # Columns, from 0, that are targets although `delta` is True, such as a waist beside an arm. The
    # grippers, which are always targets, need not be among them.
    absolute: tuple[int, ...] | None = None
    # Columns of the grippers; None: the columns with "gripper" in their names, or else the last
    # column of each arm, if `gripper_open` or `gripper_closed` is set.
    grippers: tuple[int, ...] | None = None
    # First column of each rotation; None: the column after the position, x, y, z, of each arm.
    rotation_columns: tuple[int, ...] | None = None

    @property
    def relative(self) -> bool | None:
        """Whether the actions are motions (deltas, velocities) except for their targets and
        grippers; None if the contract does not specify it. `Columns` tells which numbers these are.
        """
        return True if self.delta or "velocity" in (self.space or "") else self.delta


@explain_unknown_fields()
@dataclass(frozen=True, slots=True)
class Contract:
    """The inputs and actions of a policy, or those of a robot or env.

    `require_match` compares both. The comments at the fields give the meaning for each side.
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
        values = asdict(self)
        if self.behaviour is None:
            del values["behaviour"]  # only policies for learners have this field
        for name in _OMITTED_IF_NONE:
            if values["action"][name] is None:
                del values["action"][name]

        plain: dict[str, Any] = json.loads(json.dumps(values, default=np.generic.item))
        return plain

    @classmethod
    def from_json(cls, data: object) -> Contract:
        """Read a contract from the result of `to_json`.

        Args:
            data: The decoded JSON document.

        Raises:
            MalformedMessage: The document has an unknown key or a value of a wrong type.
        """
        values = closed(cls, data, "contract")
        values["cameras"] = _specs(CameraSpec, values.get("cameras"), "contract.cameras")
        values["state"] = _specs(StateSpec, values.get("state"), "contract.state")
        values["behaviour"] = _names(values.get("behaviour"), "contract.behaviour")

        if "action" in values:
            action = closed(ActionSpec, values["action"], "contract.action")
            action["arms"] = _names(action.get("arms"), "contract.action.arms")
            action["names"] = _names(action.get("names"), "contract.action.names")
            for name in ("absolute", "grippers", "rotation_columns"):
                action[name] = _indices(action.get(name), f"contract.action.{name}")
            values["action"] = ActionSpec(**action)
        return cls(**values)


_Spec = TypeVar("_Spec", CameraSpec, StateSpec)


def _specs(spec: type[_Spec], data: object, where: str) -> dict[str, _Spec] | None:
    """Read the specifications of cameras or state parts by name; None stays None."""
    if data is None:
        return None
    if not isinstance(data, dict):
        raise MalformedMessage(f"{where}: expected an object, got {type(data).__name__}")

    specs = {}
    for name, values in data.items():
        specs[str(name)] = spec(**closed(spec, values, f"{where}.{name}"))
    return specs


def _names(value: object, where: str) -> tuple[str, ...] | None:
    """Read a list of names; None stays None."""
    if isinstance(value, (list, tuple)) and all(isinstance(name, str) for name in value):
        return tuple(value)
    if value is not None:
        raise MalformedMessage(f"{where}: expected a list of names, got {value!r}")
    return None


def _indices(value: object, where: str) -> tuple[int, ...] | None:
    """Read a list of columns; None stays None."""
    if isinstance(value, (list, tuple)) and all(type(index) is int for index in value):
        return tuple(value)
    if value is not None:
        raise MalformedMessage(f"{where}: expected a list of whole numbers, got {value!r}")
    return None


def differences(policy: Contract, env: Contract) -> list[str]:
    """List the differences between the contracts of a policy and an env; each is a sentence with
    its cure.
    """
    sentences = [*_camera_differences(policy, env), *_state_differences(policy, env)]

    if policy.gripper and env.gripper is False:
        sentences.append(
            "gripper: the policy needs Obs.gripper, which the env does not provide; set it, 1 = "
            "open"
        )
    if policy.instruction and env.instruction is False:
        sentences.append(
            "instruction: the policy needs an instruction, the env provides none; set it in the "
            "env's options"
        )

    sentences += _action_differences(policy.action, env.action)
    if _differ(policy.control_hz, env.control_hz):
        sentences.append(
            f"control_hz: the policy was made for {policy.control_hz} Hz, the env runs at "
            f"{env.control_hz} Hz; set the env's control rate"
        )
    if _differ(policy.chunk, env.chunk):
        sentences.append(
            f"chunk: the policy returns {policy.chunk} rows, the env accepts {env.chunk}; set the "
            "policy's chunk length"
        )
    return sentences


def _differ(policy_value: object, env_value: object) -> bool:
    """Return whether neither value is None, and they differ."""
    return policy_value is not None and env_value is not None and policy_value != env_value


def _camera_differences(policy: Contract, env: Contract) -> Iterator[str]:
    if env.cameras is None:
        return

    renamed = _renamed_cameras(policy.cameras or {}, env.cameras)
    for name, needed in (policy.cameras or {}).items():
        provided = env.cameras.get(name)
        if provided is None:
            cure = "add or rename a camera of the env"
            if name in renamed:
                cure += (
                    f", with {{{name}: {renamed[name]}}} in `env_options.cameras` of a Gymnasium "
                    "env, or in the policy's `cameras` if it has this setting"
                )
            yield (
                f"camera {name!r}: the policy needs it, the env provides {sorted(env.cameras)}; "
                f"{cure}"
            )
        elif _differ(needed.height, provided.height) or _differ(needed.width, provided.width):
            yield (
                f"camera {name!r}: the policy needs {needed.height}x{needed.width} pixels (height "
                f"x width), the env provides {provided.height}x{provided.width}; set the env's "
                "camera size"
            )


def _renamed_cameras(
    needed: Mapping[str, CameraSpec], provided: Mapping[str, CameraSpec]
) -> dict[str, str]:
    """Return the env's path of each camera that the policy needs under the last part of that path,
    such as "top" for "images/top".

    Names that are only similar are not matched: no later check finds the picture of the left wrist
    in the input of the right one.
    """
    paths: dict[str, list[str]] = {}
    for path in provided:
        paths.setdefault(path.rpartition("/")[2].lower(), []).append(path)
    renamed: dict[str, str] = {}
    for name in needed:
        matches = paths.get(name.lower(), [])
        if name not in provided and len(matches) == 1 and matches[0] not in needed:
            renamed[name] = matches[0]
    return renamed


def _state_differences(policy: Contract, env: Contract) -> Iterator[str]:
    if env.state is None:
        return

    # A policy's only state part may be several parts of the env, concatenated.
    has_single_part = len(policy.state or {}) == 1 and not policy.gripper
    for name, needed in (policy.state or {}).items():
        provided = env.state.get(name)
        cure = _parts_cure(needed.dim, env) if has_single_part else ""
        if provided is None:
            yield (
                f"state {name!r}: the policy needs it, the env provides {sorted(env.state)}; "
                f"{cure or 'add or rename a state of the env'}"
            )
            continue

        if _differ(needed.dim, provided.dim):
            cure = cure or "is this another task's or robot's policy?"
            yield (
                f"state {name!r}: the policy needs {needed.dim} numbers, the env provides "
                f"{provided.dim}; {cure}"
            )
        if _differ(needed.unit, provided.unit):
            yield (
                f"state {name!r}: the policy needs {needed.unit!r}, the env provides "
                f"{provided.unit!r}; convert it"
            )


def _parts_cure(dim: int | None, env: Contract) -> str:
    """Return a cure that names parts of the env's state whose sizes add up to `dim`; "" if there
    are no such parts.
    """
    dims = {name: spec.dim for name, spec in (env.state or {}).items() if spec.dim}
    if env.gripper:
        dims["gripper"] = 1
    if dim is None or len(dims) > _MAX_STATE_PARTS:
        return ""

    matches: list[tuple[str, ...]] = []
    for size in range(len(dims), 0, -1):
        for names in combinations(dims, size):
            if sum(dims[name] for name in names) == dim:
                matches.append(names)
    if not matches:
        return ""

    listed = " or ".join(f"[{', '.join(names)}]" for names in matches[:_SHOWN_COMBINATIONS])
    if len(matches) > _SHOWN_COMBINATIONS:
        listed += " or others"
    verb = "has" if len(matches) == 1 else "have"
    return (
        "if it was trained on several parts, set the policy's `state` to them in the order of the "
        f"training: {listed} {verb} {dim} numbers here"
    )


def _action_differences(policy: ActionSpec, env: ActionSpec) -> Iterator[str]:
    for name, cure in _ACTION_CURES.items():
        returned, accepted = getattr(policy, name), getattr(env, name)
        if _differ(returned, accepted):
            yield (
                f"action.{name}: the policy returns {returned!r}, the env accepts {accepted!r}; "
                f"{cure}"
            )

    for number, ours, theirs in reordered(policy.names or (), env.names or ()):
        yield (
            f"action.names: number {number} is {ours!r} in the policy and {theirs!r} in the env; "
            f"use the same order"
        )

    if policy.low is not None and env.low is not None and policy.low < env.low:
        yield (
            f"action.low: the policy goes down to {policy.low}, the env accepts {env.low}; scale "
            "or clip the actions"
        )
    if policy.high is not None and env.high is not None and policy.high > env.high:
        yield (
            f"action.high: the policy goes up to {policy.high}, the env accepts {env.high}; scale "
            "or clip the actions"
        )


def reordered(ours: Sequence[str], theirs: Sequence[str]) -> list[tuple[int, str, str]]:
    """Return where two lists have their common joints in different orders.

    LeRobot's suffix ".pos" of a name is ignored.

    Args:
        ours: The names of the joints in one order.
        theirs: The names of the joints in the other order.

    Returns:
        For each difference the index in `ours`, the name there, and the name in `theirs`.
    """
    our_names = [name.removesuffix(".pos") for name in ours]
    their_names = [name.removesuffix(".pos") for name in theirs]
    our_common = [name for name in our_names if name in their_names]
    their_common = [name for name in their_names if name in our_names]

    differences = []
    for our_name, their_name in zip(our_common, their_common, strict=False):
        if our_name != their_name:
            differences.append((our_names.index(our_name), our_name, their_name))
    return differences


_ACTION_CURES = {
    "dim": "choose the control mode the policy was trained with",
    "space": "choose the control mode the policy was trained with",
    "delta": "choose the matching delta or absolute control mode",
    "absolute": "choose the control mode with the same absolute numbers",
    "rotation": "convert the rotation, or choose another control mode",
    "rotation_columns": "put the rotations into the env's order",
    "frame": "choose the control mode of that frame",
    "grippers": "put the grippers into the env's order",
    "gripper_open": "map the gripper's command",
    "gripper_closed": "map the gripper's command",
    "arms": "put the arms' commands into the env's order",
}


def require_match(policy: Contract | None, env: Contract | None, where: str = "") -> None:
    """Raise `ContractMismatch` with every difference between a policy and an env. In an evaluation,
    `where` is a prefix of the message that names the policy and the env.
    """
    if policy is None or env is None:
        return
    sentences = differences(policy, env)
    if sentences:
        listed = "\n".join(f"- {sentence}" for sentence in sentences)
        raise ContractMismatch(f"{where}policy and env do not fit:\n{listed}")


def closed(
    cls: type,
    data: object,
    where: str,
    error: type[MalformedMessage | ConfigError] = MalformedMessage,
) -> dict[str, Any]:
    """Return the entries of `data`, whose keys must be fields of a dataclass.

    Numbers, texts and booleans are checked here; the caller checks values of other types.

    Args:
        cls: The dataclass.
        data: The decoded JSON or YAML document.
        where: The path of `data` in the whole document, for messages.
        error: The class of the error.

    Raises:
        MalformedMessage: `data` is not a mapping, has another key, or has a value of a wrong type;
            the exception is of the class `error`.
    """
    if not isinstance(data, Mapping):
        raise error(f"{where}: expected an object, got {type(data).__name__}")

    type_names = {field.name: str(field.type) for field in fields(cls)}
    unknown = sorted(str(key) for key in data if key not in type_names)
    if unknown:
        raise error(f"{where}: expected only {sorted(type_names)}, got {unknown}; leave these out")

    for name, value in data.items():
        is_of_type = _TYPE_CHECKS.get(type_names[name])
        if is_of_type is not None and not is_of_type(value):
            raise error(f"{where}.{name}: expected {type_names[name]}, got {repr(value)[:80]}")
    return dict(data)


def _number(value: object) -> TypeGuard[float]:
    return type(value) in (int, float)


# The check of a value, by the name of its field's type.
_TYPE_CHECKS: dict[str, Callable[[Any], bool]] = {
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
