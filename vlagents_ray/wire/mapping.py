"""How another system's observation becomes an `Obs`, and our action theirs: keys, layouts, gripper conventions.

A deployment file states a mapping as a preset's name (see `vlagents_ray.wire.presets`), as an object, or as an object
that names a preset and changes some of it:

    {"cameras": {"front": "observation/image", "wrist": {"key": "images/wrist", "layout": "chw"}},
     "state": {"joints": {"key": "state", "stop": 6}, "pose": ["position", "rotation"]},
     "gripper": {"key": "state", "index": 6, "open": 0.04, "closed": 0.0},
     "instruction": "prompt",
     "info": {"unnorm_key": "unnorm_key"},
     "action": {"arm": {"stop": 6}, "hand": {"start": 6}},
     "action_gripper": {"index": 6, "open": -1, "closed": 1}}

Their keys are paths: `images/wrist` is either that very key or `wrist` within `images`. A name and a key that end with
`*` stand for as many as there are: `"*": "video/*"`. Left sides are our names, right sides theirs, except in `action`,
whose left sides are the names that their client looks for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    MessageTooLarge,
    MissingCamera,
    MissingState,
)
from vlagents_ray.interface import Obs
from vlagents_ray.wire.keys import (
    ActionGripper,
    ActionRange,
    CameraKey,
    GripperKey,
    StateKey,
    closed,
    each,
    entry,
    parts,
    stated,
)
from vlagents_ray.wire.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.wire.observations import as_camera, as_state, is_number
from vlagents_ray.wire.paths import keys, lookup, matches, pick

_OVERSHOOT = 0.25  # of a gripper's range: what a sensor may read beyond its ends


@dataclass(frozen=True, slots=True)
class KeyMapping:
    """One system's convention; see the module."""

    cameras: Mapping[str, CameraKey] = field(default_factory=dict)
    state: Mapping[str, tuple[StateKey, ...]] = field(default_factory=dict)  # joined, in this order
    gripper: GripperKey | None = None
    instruction: str | None = None
    info: Mapping[str, str] = field(default_factory=dict)  # taken if it is there
    action: Mapping[str, ActionRange] = field(default_factory=dict)
    action_gripper: tuple[ActionGripper, ...] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> KeyMapping:
        """From plain JSON values; `ConfigError` for an unknown key or a wrong type."""
        top = closed(cls, data, "mapping")
        instruction = top.get("instruction")
        if instruction is not None and not isinstance(instruction, str):
            raise ConfigError(f"mapping.instruction: got {type(instruction).__name__}, want a key")
        gripper = top.get("gripper")
        grippers = top.get("action_gripper") or []
        return cls(
            cameras=each(top, "cameras", lambda value, where: entry(CameraKey, value, where)),
            state=each(top, "state", parts),
            gripper=None if gripper is None else entry(GripperKey, gripper, "mapping.gripper"),
            instruction=instruction,
            info=each(top, "info", lambda value, where: entry(StateKey, value, where).key),
            action=each(top, "action", lambda value, where: entry(ActionRange, value, where)),
            action_gripper=tuple(
                entry(ActionGripper, one, "mapping.action_gripper")
                for one in (grippers if isinstance(grippers, list) else [grippers])
            ),
        )

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values, which `from_json` takes; what is not stated is left out."""
        return {name: stated(value) for name, value in asdict(self).items() if value not in (None, {}, ())}

    def obs(self, flat: Mapping[str, Any], limits: Limits = DEFAULT_LIMITS) -> tuple[Obs, str | None]:
        """Their observation as ours, and the instruction in it, if any. Arrays may view those of `flat`.

        Raises `MissingCamera`, `MissingState` or `InvalidObservation`, naming their key.
        """
        cameras: dict[str, np.ndarray] = {}
        for name, camera in self.cameras.items():
            for ours, key, value in pick(flat, name, camera.key, camera.optional, MissingCamera):
                cameras[ours] = _image(key, value, camera.layout, limits)
        state: dict[str, np.ndarray] = {}
        for name, sources in self.state.items():
            state |= _state(flat, name, sources, limits)
        if max(len(cameras), len(state)) > limits.cameras:
            raise MessageTooLarge(
                f"observation: got {len(cameras)} cameras and {len(state)} states, the limit is {limits.cameras}"
            )
        info = {name: value for name, key in self.info.items() if (value := lookup(flat, key)) is not None}
        return Obs(cameras, self._opening(flat, limits), state, info), self._instruction(flat, limits)

    def rows(self, action: np.ndarray, spec: ActionSpec | None = None) -> np.ndarray:
        """Our action, (D,) or (H, D), as (H, D) float32 with the gripper's commands as their client means them.

        What opens and closes the policy's gripper is in `spec`, its contract's action; where that
        does not say, the command stays as it is.
        """
        rows = np.atleast_2d(np.asarray(action, np.float32))
        if spec is None or spec.gripper_open is None or spec.gripper_closed is None:
            return rows
        ours = spec.gripper_open - spec.gripper_closed
        for one in self.action_gripper:
            if (one.open, one.closed) == (spec.gripper_open, spec.gripper_closed):
                continue
            if not -rows.shape[1] <= one.index < rows.shape[1]:
                raise InvalidAction(f"action: got {rows.shape[1]} numbers a row, want a gripper's at {one.index}")
            rows = rows.copy()
            opening = (rows[:, one.index] - spec.gripper_closed) / ours
            rows[:, one.index] = one.closed + opening * (one.open - one.closed)
        return rows

    def actions(self, action: np.ndarray, spec: ActionSpec | None = None) -> dict[str, np.ndarray]:
        """`rows` by the names that their client looks for, each (H, n); as `action` if the mapping names none."""
        rows = self.rows(action, spec)
        if not self.action:
            return {"action": rows}
        return {name: rows[:, one.start : one.stop] for name, one in self.action.items()}

    def lacks(self, contract: Contract | None) -> list[str]:
        """What the policy needs and no observation of this mapping can have, one sentence each with its cure."""
        if contract is None:
            return []
        found = [
            f"{kind} {name!r}: the policy needs it, the mapping gives {sorted(given)}; add it to mapping.{field_}"
            for kind, field_, needs, given in (
                ("camera", "cameras", contract.cameras or {}, self.cameras),
                ("state", "state", contract.state or {}, self.state),
            )
            for name in needs
            if not any(matches(name, pattern) for pattern in given)
        ]
        if contract.gripper and self.gripper is None:
            found.append("gripper: the policy needs it, the mapping has none; add mapping.gripper")
        if contract.instruction and self.instruction is None:
            found.append("instruction: the policy needs one, the mapping has none; add mapping.instruction")
        dim = contract.action.dim
        last = max((one.index + 1 if one.index >= 0 else -one.index for one in self.action_gripper), default=0)
        last = max([last, *(max(one.start or 0, one.stop or 0) for one in self.action.values())])
        if dim is not None and last > dim:
            found.append(
                f"action: the policy gives {dim} numbers a row, the mapping wants {last}; change mapping.action"
            )
        return found

    def _opening(self, flat: Mapping[str, Any], limits: Limits) -> float | None:
        """In [0, 1], 1 = open."""
        if (gripper := self.gripper) is None:
            return None
        value = lookup(flat, gripper.key)
        if value is None:
            if gripper.optional:
                return None
            raise MissingState(gripper.key, have=keys(flat))
        vector = _vector(gripper.key, value, limits)
        if not -vector.size <= gripper.index < vector.size:
            raise InvalidObservation(
                f"{gripper.key!r}: got {vector.size} numbers, want the gripper's at {gripper.index}"
            )
        reading = float(vector[gripper.index])
        opening = (reading - gripper.closed) / (gripper.open - gripper.closed)
        if not -_OVERSHOOT <= opening <= 1 + _OVERSHOOT:  # NaN is not, either
            raise InvalidObservation(
                f"{gripper.key!r}: got {reading:g} for the gripper, want {gripper.closed:g} (closed) to "
                f"{gripper.open:g} (open); scale it, or change mapping.gripper"
            )
        return min(1.0, max(0.0, opening))

    def _instruction(self, flat: Mapping[str, Any], limits: Limits) -> str | None:
        found = [] if self.instruction is None else pick(flat, "", self.instruction, True, MissingState)
        value = found[0][2] if found else None
        while isinstance(value, (list, tuple)) and len(value) == 1:  # a batch of one, as some clients send it
            value = value[0]
        if isinstance(value, np.ndarray) and value.dtype.kind == "U" and value.size == 1:
            value = value.item()
        if value is not None and not isinstance(value, str):
            raise InvalidObservation(f"{self.instruction!r}: got {type(value).__name__}, want text")
        if value is not None and len(value) > limits.text:
            raise MessageTooLarge(f"{self.instruction!r}: got {len(value)} characters, the limit is {limits.text}")
        return value


def _image(key: str, value: Any, layout: str, limits: Limits) -> np.ndarray:
    if isinstance(value, np.ndarray):
        value = _newest(key, value, 3)
        if layout == "chw" and value.ndim == 3 and value.shape[0] == 3:
            value = np.ascontiguousarray(value.transpose(1, 2, 0))
        elif layout == "chw":
            raise InvalidObservation(f"camera {key!r}: got {value.shape} {value.dtype}, want (3, H, W) uint8 RGB")
    return as_camera(key, value, limits)


def _state(flat: Mapping[str, Any], name: str, sources: tuple[StateKey, ...], limits: Limits) -> dict[str, np.ndarray]:
    joined: dict[str, list[np.ndarray]] = {}
    for part in sources:
        found = pick(flat, name, part.key, part.optional, MissingState)
        for ours, key, value in found:
            vector = _vector(key, value, limits)
            if part.stop is not None and part.stop > vector.size:
                raise InvalidObservation(f"state {key!r}: got {vector.size} numbers, want {part.stop} at least")
            joined.setdefault(ours, []).append(vector[part.start : part.stop])
    return {ours: vectors[0] if len(vectors) == 1 else np.concatenate(vectors) for ours, vectors in joined.items()}


def _vector(key: str, value: Any, limits: Limits) -> np.ndarray:
    """(D,) float32."""
    if isinstance(value, np.ndarray):
        value = np.atleast_1d(_newest(key, value, 1))
    elif isinstance(value, np.number):
        value = [value.item()]
    elif is_number(value):
        value = [value]
    return as_state(key, value, limits)


def _newest(key: str, value: np.ndarray, ndim: int) -> np.ndarray:
    """Without the batch and time axes that some clients put in front: a batch of one, and the last of its times."""
    if value.ndim > ndim and value.shape[0] != 1:
        raise InvalidObservation(
            f"{key!r}: got {value.shape}, a batch of {value.shape[0]}, want one; send each by itself"
        )
    if value.ndim == ndim + 2 and value.shape[1] > 0:
        value = value[:, -1]
    return value if value.ndim != ndim + 1 else value.reshape(value.shape[1:])
