"""Conversion of another system's observation to an `Obs`, and of our action to theirs: keys, layouts, grippers.

A deployment file states a mapping as a preset's name (see `vlagents_ray.serve.presets`), as an object, or as an
object that names a preset and changes some of its fields:

    {"cameras": {"front": "observation/image", "wrist": {"key": "images/wrist", "layout": "chw"}},
     "state": {"joints": {"key": "state", "stop": 6}, "pose": ["position", "rotation"]},
     "gripper": {"key": "state", "index": 6, "open": 0.04, "closed": 0.0},
     "instruction": "prompt|task_id", "instructions": {"0": "turn on the radio"},
     "info": {"unnorm_key": "unnorm_key"},
     "action": {"arm": {"stop": 6}, "hand": {"start": 6}},
     "action_gripper": {"index": 6, "open": -1, "closed": 1}}

The client's keys are paths: `images/wrist` is either that key itself or `wrist` within `images`. `states|state` is the
first of the two that exists. A name and a key that end with `*` stand for all keys that match: `"*": "video/*"`. Left
sides are our names, right sides the client's, except in `action`, whose left sides are the names that the client reads,
and in `instructions`, which has the text of each integer that a client sends in place of an instruction.

An observation is refused if the mapping reads nothing of it, or none of the cameras or none of the states in it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
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
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.wire.mapping.fields import (
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
    text,
)
from vlagents_ray.wire.mapping.key_paths import (
    keys,
    leaves,
    lookup,
    matches,
    pick,
    reads,
    short_path,
)
from vlagents_ray.wire.mapping.values import may_be_camera, may_be_state, read_image, read_state, read_text, read_vector

logger = logging.getLogger(__name__)

_OVERSHOOT = 0.25  # share of a gripper's range by which a sensor may read beyond its ends


@dataclass(frozen=True, slots=True)
class KeyMapping:
    """The key mapping of one system; the module describes its fields."""

    cameras: Mapping[str, CameraKey] = field(default_factory=dict)
    state: Mapping[str, tuple[StateKey, ...]] = field(default_factory=dict)  # joined in this order
    gripper: GripperKey | None = None
    instruction: str | None = None
    instructions: Mapping[str, str] = field(default_factory=dict)  # by the integer that is sent in their place
    info: Mapping[str, str] = field(default_factory=dict)  # all optional
    action: Mapping[str, ActionRange] = field(default_factory=dict)
    action_gripper: tuple[ActionGripper, ...] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> KeyMapping:
        """Read a mapping from plain JSON values; raise `ConfigError` for an unknown key or a wrong type."""
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
            instructions=each(top, "instructions", text),
            info=each(top, "info", lambda value, where: entry(StateKey, value, where).key),
            action=each(top, "action", lambda value, where: entry(ActionRange, value, where)),
            action_gripper=tuple(
                entry(ActionGripper, one, "mapping.action_gripper")
                for one in (grippers if isinstance(grippers, list) else [grippers])
            ),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the mapping as plain JSON values for `from_json`, without fields that are not set."""
        return {name: stated(value) for name, value in asdict(self).items() if value not in (None, {}, ())}

    def obs(
        self, flat: Mapping[str, Any], limits: Limits = DEFAULT_LIMITS, contract: Contract | None = None
    ) -> tuple[Obs, str | None]:
        """Convert a client's observation.

        Args:
            flat: The client's observation.
            limits: The limits of a request.
            contract: The policy's contract: a gripper that it does not need is left out if its reading is invalid.

        Returns:
            Our observation, whose arrays may view those of `flat`, and its instruction; None if there is none.

        Raises:
            MissingCamera, MissingState: A key is missing.
            InvalidObservation: A value is invalid, or the mapping reads nothing of the observation, or none of the
                cameras or none of the states in it.
        """
        cameras: dict[str, np.ndarray] = {}
        for name, camera in self.cameras.items():
            for ours, key, value in pick(flat, name, camera.key, camera.optional, MissingCamera):
                cameras[ours] = read_image(key, value, camera.layout, limits)
        state: dict[str, np.ndarray] = {}
        for name, sources in self.state.items():
            state |= read_state(flat, name, sources, limits)
        if max(len(cameras), len(state)) > limits.cameras:
            raise MessageTooLarge(
                f"observation: got {len(cameras)} cameras and {len(state)} states, the limit is {limits.cameras}"
            )
        info = {name: value for name, key in self.info.items() if (value := lookup(flat, key)) is not None}
        gripper = self._opening(flat, limits, needed=contract is not None and bool(contract.gripper))
        obs = Obs(cameras, gripper, state, info)
        if not cameras or not state:
            self._require_read(flat, obs)
        return obs, self._instruction(flat, limits, needed=contract is not None and bool(contract.instruction))

    def rows(self, action: np.ndarray, spec: ActionSpec | None = None) -> np.ndarray:
        """Return our action, (D,) or (H, D), as (H, D) float32 with the gripper's commands in the client's convention.

        `spec`, the action of the policy's contract, states the policy's own convention; without it, the commands are
        not changed.
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
        """Return `rows` by the names that the client reads, each (H, n); as `action` if the mapping names none."""
        rows = self.rows(action, spec)
        if not self.action:
            return {"action": rows}
        return {name: rows[:, one.start : one.stop] for name, one in self.action.items()}

    def lacks(self, contract: Contract | None) -> list[str]:
        """Return what the policy needs and no observation of this mapping has, one sentence each with its remedy."""
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

    def warn_of_unread_cameras(self, flat: Mapping[str, Any], dialect: str) -> None:
        """Log the cameras of a client's observation that the mapping does not read, which the policy never sees.

        It is logged once for all clients of a dialect that send the same ones. This looks at each key: call it when a
        session begins, not for each observation.
        """
        if unread := self._unread(flat, may_be_camera):
            _log_unread(dialect, tuple(unread), tuple(camera.key for camera in self.cameras.values()))

    def _unread(self, flat: Mapping[str, Any], is_one: Callable[[Any], bool]) -> list[str]:
        """Return the paths of the values for which `is_one` holds and which no key of the mapping stands for."""
        known = [one.key for one in self.cameras.values()] + [one.key for all_ in self.state.values() for one in all_]
        known += [*self.info.values(), *([] if self.gripper is None else [self.gripper.key])]
        return [
            short_path(path)
            for path, value in leaves(flat)
            if is_one(value) and not any(reads(key, path) for key in known)
        ]

    def _require_read(self, flat: Mapping[str, Any], obs: Obs) -> None:
        """Raise if `obs` has nothing of the client's observation, or none of its cameras or none of its states."""
        images = [camera.key for camera in self.cameras.values()]
        numbers = [part.key for sources in self.state.values() for part in sources]
        grippers = [] if self.gripper is None else [self.gripper.key]
        known = [*images, *numbers, *grippers]
        if known and not obs.cameras and not obs.state and obs.gripper is None:
            raise InvalidObservation(
                f"observation: got {keys(flat)}, of which the mapping reads nothing; it looks for {known}: "
                f"choose the preset of this client, or change the mapping"
            )
        for kind, wanted, found, is_one in (
            ("cameras", images, obs.cameras, may_be_camera),
            ("state", numbers, obs.state, may_be_state),
        ):
            if not wanted or found:
                continue
            if lost := self._unread(flat, is_one):
                raise InvalidObservation(
                    f"observation: got {lost}, which the mapping does not read, and nothing at {wanted}; add them to "
                    f"mapping.{kind}, or to mapping.info if the policy does without"
                )

    def _opening(self, flat: Mapping[str, Any], limits: Limits, *, needed: bool) -> float | None:
        """Return the gripper's opening in [0, 1], 1 = open; None if there is none or it is invalid and not `needed`."""
        if (gripper := self.gripper) is None:
            return None
        value = lookup(flat, gripper.key)
        if value is None:
            if gripper.optional:
                return None
            raise MissingState(gripper.key, have=keys(flat))
        vector = read_vector(gripper.key, value, limits)
        if not -vector.size <= gripper.index < vector.size:
            raise InvalidObservation(
                f"{gripper.key!r}: got {vector.size} numbers, want the gripper's at {gripper.index}"
            )
        reading = float(vector[gripper.index])
        opening = (reading - gripper.closed) / (gripper.open - gripper.closed)
        if not -_OVERSHOOT <= opening <= 1 + _OVERSHOOT:  # true for NaN, too
            if not needed:
                return None
            raise InvalidObservation(
                f"{gripper.key!r}: got {reading:g} for the gripper, want {gripper.closed:g} (closed) to "
                f"{gripper.open:g} (open); scale it, or change mapping.gripper"
            )
        return min(1.0, max(0.0, opening))

    def _instruction(self, flat: Mapping[str, Any], limits: Limits, *, needed: bool) -> str | None:
        found = [] if self.instruction is None else pick(flat, "", self.instruction, True, MissingState)
        if not found or self.instruction is None:
            return None
        return read_text(self.instruction, found[0][2], self.instructions, limits, needed=needed)


@lru_cache(maxsize=64)  # logs only what it did not log before
def _log_unread(dialect: str, unread: tuple[str, ...], read: tuple[str, ...]) -> None:
    logger.warning(
        f"{dialect}: a client sends the cameras {list(unread)}, which the policy does not get: the mapping reads "
        f"{list(read)}; if the policy takes them, add them to mapping.cameras"
    )
