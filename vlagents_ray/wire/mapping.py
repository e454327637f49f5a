"""Conversion of another system's observation to an `Obs`, and of our action to theirs: keys,
layouts, grippers.

A deployment file declares a mapping as a preset's name (`presets`), as an object, or as an object
that names a preset and overrides some of its fields:

    {"cameras": {"front": "observation/image", "wrist": {"key": "images/wrist", "layout": "chw"}},
     "state": {"joints": {"key": "state", "stop": 6}, "pose": ["position", "rotation"]},
     "gripper": {"key": "state", "index": 6, "open": 0.04, "closed": 0.0},
     "instruction": "prompt|task_id", "instructions": {"0": "turn on the radio"},
     "info": {"unnorm_key": "unnorm_key"},
     "action": {"arm": {"stop": 6}, "hand": {"start": 6}},
     "action_gripper": {"index": 6, "open": -1, "closed": 1}}

The client's keys are paths: `images/wrist` is either that key itself or `wrist` within `images`.
`states|state` is the first of the two that exists. A name and a key that end with `*` match all
keys with that beginning: `"*": "video/*"`. The left sides are our names, and the right sides are
the client's keys. There are two exceptions: in `action`, the left sides are the names that the
client reads; `instructions` contains the text for each integer that a client sends instead of an
instruction. Unknown fields are errors. A text is short for an entry with that key and no other
field.

An observation is rejected if the mapping reads nothing in it. It is also rejected if it has cameras
and the mapping reads none of them, or if it has states and the mapping reads none of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache
from itertools import islice
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract, closed
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    MessageTooLarge,
    MissingCamera,
    MissingState,
    shown,
)
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, MessageLimits
from vlagents_ray.protocol.values import as_camera, as_state, is_number

logger = logging.getLogger(__name__)

Layout = Literal["hwc", "chw", "any", "rgba"]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class CameraKey:
    """The location of an image, (H, W, 3) or (3, H, W) RGB. If the value is (1, T, H, W, 3), the
    newest image is used, which is the last of T.

    Pixels are uint8, or floats in [0, 1]. The layout `any` means channels first if the length of
    the first axis is 3; from an `rgba` image, (H, W, 4), the alpha channel is dropped.
    """

    key: str
    layout: Layout = "hwc"
    optional: bool = False


@dataclass(frozen=True, slots=True)
class StateKey:
    """The location of a vector (D,), of which the values from `start` to `stop` are used. If the
    value is (1, T, D), the newest vector is used, which is the last of T.
    """

    key: str
    start: int | None = None
    stop: int | None = None
    optional: bool = False


@dataclass(frozen=True, slots=True)
class GripperKey:
    """The location of the gripper's reading, and the readings of an open and of a closed gripper.
    Readings between the two are interpolated linearly.
    """

    key: str
    index: int = 0
    open: float = 1.0
    closed: float = 0.0
    optional: bool = False


@dataclass(frozen=True, slots=True)
class ActionRange:
    """The columns of our action, (H, D), that the client reads under one name."""

    start: int | None = None
    stop: int | None = None


@dataclass(frozen=True, slots=True)
class ActionGripper:
    """A gripper's column in an action, and the client's commands to open and close it."""

    index: int = -1
    open: float = 1.0
    closed: float = 0.0


def each(top: Mapping[str, Any], name: str, read: Callable[[Any, str], T]) -> dict[str, T]:
    """Return the entries of `top[name]`, each the result of `read(value, where)`; `where` is the
    path of the entry, for error messages.
    """
    entries = top.get(name) or {}
    if not isinstance(entries, Mapping):
        raise ConfigError(f"mapping.{name}: expected an object, got {type(entries).__name__}")
    return {str(key): read(value, f"mapping.{name}.{key}") for key, value in entries.items()}


def entry(cls: type[T], value: Any, where: str) -> T:
    """Return an entry of a mapping as the dataclass `cls`; a text is its key."""
    values = closed(cls, {"key": value} if isinstance(value, str) else value, where, ConfigError)
    known = [field.name for field in fields(cls)]  # type: ignore[arg-type]
    if "key" in known and not values.get("key"):
        raise ConfigError(f"{where}: expected a key of the client's observation, got none; add it")
    if values.get("layout", "hwc") not in get_args(Layout):
        raise ConfigError(
            f"{where}.layout: expected one of {get_args(Layout)}, got {values['layout']!r}"
        )
    key = values.get("key", "")
    if "*" in key and key.index("*") != len(key) - 1:
        raise ConfigError(f"{where}: expected '*' only at the end of a key, got {key!r}")
    if "open" in known and values.get("open", 1.0) == values.get("closed", 0.0):
        raise ConfigError(f"{where}: open and closed are the same, {values.get('open', 1.0)}")
    return cls(**values)


def parts(value: Any, where: str) -> tuple[StateKey, ...]:
    """Return the keys of one state, whose values are concatenated."""
    values = value if isinstance(value, list) else [value]
    if not values:
        raise ConfigError(f"{where}: expected at least one key, got an empty list")
    return tuple(entry(StateKey, item, where) for item in values)


def text(value: Any, where: str) -> str:
    """Return a value that must be text."""
    if not isinstance(value, str):
        raise ConfigError(f"{where}: expected text, got {type(value).__name__}")
    return value


def without_none(value: Any) -> Any:
    """Return `value` as plain JSON values, without fields that are None."""
    if isinstance(value, dict):
        return {name: without_none(item) for name, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [without_none(item) for item in value]
    return value


# The following functions use paths into nested observations. `images/wrist` is either that key
# itself, or `wrist` within `images`; `states|state` is the first of the two that exists.

_SHOWN = 40  # maximum number of keys in an error message, and of characters of each key
_LONGEST = 200  # number of characters of a client's key that are compared


def lookup(nested: Mapping[Any, Any], path: str) -> Any:
    """Return the value at `path`; None if it is missing."""
    if path in nested:
        return nested[path]
    if "|" in path:
        for alternative in path.split("|"):
            value = lookup(nested, alternative)
            if value is not None:
                return value
        return None

    end = path.find("/")
    while end >= 0:
        inner = nested.get(path[:end])
        if isinstance(inner, Mapping):
            value = lookup(inner, path[end + 1 :])
            if value is not None:
                return value
        end = path.find("/", end + 1)
    return None


def keys(nested: Mapping[Any, Any]) -> list[str]:
    """Return the paths of all values that are not mappings, in order, at most 40, for an error
    message.
    """
    return [short_path(path) for path, _ in islice(leaves(nested), _SHOWN)]


def short_path(path: str) -> str:
    """Return a path for an error message, each key cut to 40 characters."""
    return "/".join(key[:_SHOWN] for key in path.split("/"))


def leaves(nested: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the paths and values of all values that are not mappings, in order. `short_path`
    shortens such a path.
    """
    for key, value in nested.items():
        path = f"{prefix}{(key if isinstance(key, str) else shown(key))[:_LONGEST]}"
        if isinstance(value, Mapping):
            yield from leaves(value, f"{path}/")
        else:
            yield path, value


def matches(name: str, pattern: str) -> bool:
    """Return whether `pattern`, which may end with `*`, matches `name`."""
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def pick(
    flat: Mapping[str, Any],
    name: str,
    key: str,
    optional: bool,
    missing: Callable[..., InvalidObservation],
) -> list[tuple[str, str, Any]]:
    """Return the values that a key of a mapping matches.

    The `*` of our `name` is replaced by the text that the `*` of the client's `key` matches.
    `missing` creates the error for a missing value.

    Returns:
        For each value, our name, the client's key and the value.
    """
    if "*" not in key:
        value = lookup(flat, key)
        if value is not None and not isinstance(value, Mapping):
            return [(name, key, value)]
        if not optional:
            raise missing(key, have=keys(flat))
        return []

    folder, _, last = key.rpartition("/")
    inner = lookup(flat, folder) if folder else flat
    if not isinstance(inner, Mapping):
        return []
    prefix = last.removesuffix("*")
    picked = []
    for their_name, value in inner.items():
        if not isinstance(their_name, str) or not their_name.startswith(prefix):
            continue
        matched = their_name.removeprefix(prefix)
        if matched:
            path = f"{folder}/{their_name}".removeprefix("/")
            picked.append((name.replace("*", matched), path, value))
    return picked


# The following functions convert values in another system's observation to ours.


def read_image(key: str, value: Any, layout: str, limits: MessageLimits) -> np.ndarray:
    """Return an image as (H, W, 3) uint8 RGB; raise `InvalidObservation` or `MessageTooLarge`."""
    if isinstance(value, np.ndarray):
        value = _newest(key, value, 3)
        # Floats are rounded down, as in openpi's own server (`_parse_image` in its policies).
        if value.dtype.kind == "f":
            if value.size and not (value.min() >= 0 and value.max() <= 1):  # also true for NaN
                raise InvalidObservation(
                    f"camera {key!r}: expected uint8, or floats in [0, 1], got {value.dtype} from "
                    f"{value.min():g} to {value.max():g}; scale it"
                )
            value = (255 * value).astype(np.uint8)
        if layout == "rgba" and value.ndim == 3 and value.shape[2] == 4:
            value = np.ascontiguousarray(value[:, :, :3])
        elif layout in ("chw", "any") and value.ndim == 3 and value.shape[0] == 3:
            value = np.ascontiguousarray(value.transpose(1, 2, 0))
        elif layout == "chw":
            raise InvalidObservation(
                f"camera {key!r}: expected (3, H, W) uint8 RGB, got {value.shape} {value.dtype}"
            )
    return as_camera(key, value, limits)


def may_be_camera(value: Any) -> bool:
    """Return whether a value may be an image."""
    return isinstance(value, np.ndarray) and value.ndim >= 3


def may_be_state(value: Any) -> bool:
    """Return whether a value is a vector of numbers; images and camera matrices are not."""
    if isinstance(value, list):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.squeeze().ndim == 1


def read_state(
    flat: Mapping[str, Any], name: str, sources: tuple[StateKey, ...], limits: MessageLimits
) -> dict[str, np.ndarray]:
    """Return the state `name`, its parts concatenated, (D,) float32; if the name ends with `*`,
    return several states.
    """
    vectors_by_name: dict[str, list[np.ndarray]] = {}
    for source in sources:
        picked = pick(flat, name, source.key, source.optional, MissingState)
        for our_name, key, value in picked:
            vector = read_vector(key, value, limits)
            if source.stop is not None and source.stop > vector.size:
                raise InvalidObservation(
                    f"state {key!r}: expected at least {source.stop} numbers, got {vector.size}"
                )
            vectors = vectors_by_name.setdefault(our_name, [])
            vectors.append(vector[source.start : source.stop])
    return {
        our_name: vectors[0] if len(vectors) == 1 else np.concatenate(vectors)
        for our_name, vectors in vectors_by_name.items()
    }


def read_vector(key: str, value: Any, limits: MessageLimits) -> np.ndarray:
    """Return a number, or a vector of numbers, as (D,) float32."""
    if isinstance(value, np.ndarray):
        value = np.atleast_1d(_newest(key, value, 1))
    elif isinstance(value, np.number):
        value = [value.item()]
    elif is_number(value):
        value = [value]
    return as_state(key, value, limits)


def _newest(key: str, value: np.ndarray, ndim: int) -> np.ndarray:
    """Remove the batch axis, of length 1, and the time axis that some clients add in front; keep
    the last time step.
    """
    if value.ndim > ndim and value.shape[0] != 1:
        raise InvalidObservation(
            f"{key!r}: expected one row, got a batch of {value.shape[0]}, {value.shape}; send each "
            "row separately"
        )
    if value.ndim == ndim + 2 and value.shape[1] > 0:
        value = value[:, -1]
    return value if value.ndim != ndim + 1 else value.reshape(value.shape[1:])


def read_text(
    key: str, value: Any, texts: Mapping[str, str], limits: MessageLimits, *, needed: bool
) -> str | None:
    """Return an instruction. The value is a text, a list or array of one text, or an array of one
    integer, which is the key of a text in `texts`.

    An integer without a text is an error if the instruction is `needed`; otherwise, None is
    returned.
    """
    # Some clients send a batch with one element.
    while isinstance(value, (list, tuple)) and len(value) == 1:
        value = value[0]
    if isinstance(value, np.ndarray) and value.dtype.kind in "Uiu" and value.size == 1:
        value = value.item()
        if isinstance(value, int):
            if needed and str(value) not in texts:
                raise InvalidObservation(
                    f"{key!r}: expected one of {sorted(texts)}, got {value}; add its text to "
                    "mapping.instructions"
                )
            value = texts.get(str(value))
    if value is not None and not isinstance(value, str):
        raise InvalidObservation(f"{key!r}: expected text, got {type(value).__name__}")
    if value is not None and len(value) > limits.text:
        raise MessageTooLarge(
            f"{key!r}: expected at most {limits.text} characters, got {len(value)}"
        )
    return value


_OVERSHOOT = 0.25  # share of a gripper's range by which a reading may exceed its ends


@dataclass(frozen=True, slots=True)
class KeyMapping:
    """The key mapping of one system; the module's docstring describes its fields."""

    cameras: Mapping[str, CameraKey] = field(default_factory=dict)
    # The keys of each state, whose values are concatenated in this order.
    state: Mapping[str, tuple[StateKey, ...]] = field(default_factory=dict)
    gripper: GripperKey | None = None
    instruction: str | None = None
    # The instruction for each integer that a client sends in its place.
    instructions: Mapping[str, str] = field(default_factory=dict)
    info: Mapping[str, str] = field(default_factory=dict)  # missing values are left out
    action: Mapping[str, ActionRange] = field(default_factory=dict)
    action_gripper: tuple[ActionGripper, ...] = ()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> KeyMapping:
        """Read a mapping from plain JSON values; raise `ConfigError` for an unknown key or a
        wrong type.
        """
        top = closed(cls, data, "mapping", ConfigError)
        instruction = top.get("instruction")
        if instruction is not None and not isinstance(instruction, str):
            raise ConfigError(
                f"mapping.instruction: expected a key, got {type(instruction).__name__}"
            )
        gripper = top.get("gripper")
        grippers = top.get("action_gripper") or []
        if not isinstance(grippers, list):
            grippers = [grippers]
        return cls(
            cameras=each(top, "cameras", lambda value, where: entry(CameraKey, value, where)),
            state=each(top, "state", parts),
            gripper=None if gripper is None else entry(GripperKey, gripper, "mapping.gripper"),
            instruction=instruction,
            instructions=each(top, "instructions", text),
            info=each(top, "info", lambda value, where: entry(StateKey, value, where).key),
            action=each(top, "action", lambda value, where: entry(ActionRange, value, where)),
            action_gripper=tuple(
                entry(ActionGripper, item, "mapping.action_gripper") for item in grippers
            ),
        )

    def to_json(self) -> dict[str, Any]:
        """Return the mapping as plain JSON values for `from_json`, without fields that are not
        set.
        """
        values = asdict(self)
        return {
            name: without_none(value)
            for name, value in values.items()
            if value not in (None, {}, ())
        }

    def obs(
        self,
        flat: Mapping[str, Any],
        limits: MessageLimits = DEFAULT_LIMITS,
        contract: Contract | None = None,
    ) -> tuple[Obs, str | None]:
        """Convert a client's observation.

        An invalid gripper reading is dropped if the policy's contract does not require the gripper.

        Returns:
            Our observation, whose arrays may be views of the arrays in `flat`, and its instruction,
            which is None if the observation has none.

        Raises:
            MissingCamera, MissingState: A key is missing.
            InvalidObservation: A value is invalid, or the mapping reads nothing in the observation,
                none of its cameras or none of its states.
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
                f"observation: expected at most {limits.cameras} cameras and states, got "
                f"{len(cameras)} cameras and {len(state)} states"
            )

        info = {name: lookup(flat, key) for name, key in self.info.items()}
        info = {name: value for name, value in info.items() if value is not None}
        is_gripper_needed = contract is not None and bool(contract.gripper)
        gripper = self._opening(flat, limits, needed=is_gripper_needed)

        obs = Obs(cameras, gripper, state, info)
        if not cameras or not state:
            self._require_read(flat, obs)
        return obs, self.read_instruction(flat, limits, contract)

    def read_instruction(
        self,
        flat: Mapping[str, Any],
        limits: MessageLimits = DEFAULT_LIMITS,
        contract: Contract | None = None,
    ) -> str | None:
        """Return the instruction in a client's observation; None if there is none. Raise
        `InvalidObservation` if it is invalid.
        """
        if self.instruction is None:
            return None
        picked = pick(flat, "", self.instruction, True, MissingState)
        if not picked:
            return None
        _, _, value = picked[0]
        is_needed = contract is not None and bool(contract.instruction)
        return read_text(self.instruction, value, self.instructions, limits, needed=is_needed)

    def rows(self, action: np.ndarray, spec: ActionSpec | None = None) -> np.ndarray:
        """Return our action, (D,) or (H, D), as (H, D) float32 with the gripper's commands in the
        client's convention.

        `spec`, the action of the policy's contract, contains the policy's convention; without
        `spec`, the commands stay unchanged.
        """
        rows = np.atleast_2d(np.asarray(action, np.float32))
        if spec is None or spec.gripper_open is None or spec.gripper_closed is None:
            return rows

        our_range = spec.gripper_open - spec.gripper_closed
        for gripper in self.action_gripper:
            if (gripper.open, gripper.closed) == (spec.gripper_open, spec.gripper_closed):
                continue
            index = gripper.index
            if not -rows.shape[1] <= index < rows.shape[1]:
                raise InvalidAction(
                    f"action: expected the gripper's number at {index}, got {rows.shape[1]} "
                    "numbers in each row; change mapping.action"
                )
            rows = rows.copy()
            opening = (rows[:, index] - spec.gripper_closed) / our_range
            rows[:, index] = gripper.closed + opening * (gripper.open - gripper.closed)
        return rows

    def actions(self, action: np.ndarray, spec: ActionSpec | None = None) -> dict[str, np.ndarray]:
        """Return the arrays (H, n) that the client reads, by name. If the mapping has no names, all
        columns have the name `action`.
        """
        rows = self.rows(action, spec)
        return self.columns(rows) or {"action": rows}

    def columns(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the columns of (H, D) rows, or of a row (D,), by the client's names; an empty dict
        if the mapping has no names.
        """
        return {name: rows[..., span.start : span.stop] for name, span in self.action.items()}

    def lacks(self, contract: Contract | None) -> list[str]:
        """Return a sentence, which includes the cure, for each input of the policy that this
        mapping does not provide.
        """
        if contract is None:
            return []

        sentences = []
        for kind, setting, needed, patterns in (
            ("camera", "cameras", contract.cameras or {}, self.cameras),
            ("state", "state", contract.state or {}, self.state),
        ):
            for name in needed:
                if not any(matches(name, pattern) for pattern in patterns):
                    sentences.append(
                        f"{kind} {name!r}: the policy needs it, the mapping provides "
                        f"{sorted(patterns)}; add it to mapping.{setting}"
                    )
        if contract.gripper and self.gripper is None:
            sentences.append(
                "gripper: the policy needs it, the mapping has none; add mapping.gripper"
            )
        if contract.instruction and self.instruction is None:
            sentences.append(
                "instruction: the policy needs one, the mapping has none; add mapping.instruction"
            )

        dim = contract.action.dim
        mapped_dims = [0]
        for gripper in self.action_gripper:
            mapped_dims.append(gripper.index + 1 if gripper.index >= 0 else -gripper.index)
        for span in self.action.values():
            mapped_dims.append(max(span.start or 0, span.stop or 0))
        if dim is not None and max(mapped_dims) > dim:
            sentences.append(
                f"action: expected {max(mapped_dims)} numbers a row, as in the mapping, got {dim} "
                "from the policy; change mapping.action"
            )
        return sentences

    def warn_of_unread_cameras(self, flat: Mapping[str, Any], dialect: str) -> None:
        """Log the cameras of a client's observation that the mapping does not read, and the policy
        never receives.

        A message is logged once for all clients of a dialect with the same cameras. The function
        examines every key, so call it when a session begins, not for each observation.
        """
        unread = self._unread(flat, may_be_camera)
        if unread:
            _log_unread(dialect, tuple(unread), tuple(self._camera_keys()))

    def _camera_keys(self) -> list[str]:
        """Return the client's keys of the cameras."""
        return [camera.key for camera in self.cameras.values()]

    def _state_keys(self) -> list[str]:
        """Return the client's keys of the states."""
        keys_of_states = []
        for sources in self.state.values():
            keys_of_states += [source.key for source in sources]
        return keys_of_states

    def _gripper_keys(self) -> list[str]:
        """Return a list of the client's key of the gripper, which is empty if there is none."""
        return [] if self.gripper is None else [self.gripper.key]

    def _unread(self, flat: Mapping[str, Any], is_relevant: Callable[[Any], bool]) -> list[str]:
        """Return the paths of the values for which `is_relevant` is true and which no key of the
        mapping matches.
        """
        known = [*self._camera_keys(), *self._state_keys(), *self.info.values()]
        known += self._gripper_keys()
        patterns: list[str] = []
        for key in known:
            patterns += key.split("|")

        unread = []
        for path, value in islice(leaves(flat), _SHOWN):
            if is_relevant(value) and not any(matches(path, pattern) for pattern in patterns):
                unread.append(short_path(path))
        return unread

    def _require_read(self, flat: Mapping[str, Any], obs: Obs) -> None:
        """Raise `InvalidObservation` if `obs` contains nothing from the client's observation, none
        of its cameras or none of its states.
        """
        camera_keys, state_keys = self._camera_keys(), self._state_keys()
        known = [*camera_keys, *state_keys, *self._gripper_keys()]
        if known and not obs.cameras and not obs.state and obs.gripper is None:
            raise InvalidObservation(
                f"observation: expected at least one of {known}, which the mapping reads, got "
                f"{keys(flat)}; choose the preset of this client, or change the mapping"
            )

        for kind, mapped_keys, values, is_relevant in (
            ("cameras", camera_keys, obs.cameras, may_be_camera),
            ("state", state_keys, obs.state, may_be_state),
        ):
            unread = self._unread(flat, is_relevant) if mapped_keys and not values else []
            if unread:
                raise InvalidObservation(
                    f"observation: expected {mapped_keys}, which the mapping reads, got {unread}; "
                    f"add them to mapping.{kind}, or to mapping.info if the policy does not need "
                    "them"
                )

    def _opening(
        self, flat: Mapping[str, Any], limits: MessageLimits, *, needed: bool
    ) -> float | None:
        """Return the gripper's opening in [0, 1], 1 = open; None if it is missing, or invalid
        and not `needed`.
        """
        gripper = self.gripper
        if gripper is None:
            return None
        value = lookup(flat, gripper.key)
        if value is None:
            if gripper.optional:
                return None
            raise MissingState(gripper.key, have=keys(flat))

        vector = read_vector(gripper.key, value, limits)
        if not -vector.size <= gripper.index < vector.size:
            raise InvalidObservation(
                f"{gripper.key!r}: expected the gripper's number at {gripper.index}, got "
                f"{vector.size} numbers; change mapping.gripper"
            )

        reading = float(vector[gripper.index])
        opening = (reading - gripper.closed) / (gripper.open - gripper.closed)
        if not -_OVERSHOOT <= opening <= 1 + _OVERSHOOT:  # also true for NaN
            if not needed:
                return None
            raise InvalidObservation(
                f"{gripper.key!r}: expected a gripper from {gripper.closed:g} (closed) to "
                f"{gripper.open:g} (open), got {reading:g}; scale it, or change mapping.gripper"
            )
        return min(1.0, max(0.0, opening))


@lru_cache(maxsize=64)  # each message is logged once
def _log_unread(dialect: str, unread: tuple[str, ...], read: tuple[str, ...]) -> None:
    """Log the cameras of a client that the mapping does not read."""
    logger.warning(
        f"{dialect}: a client sends the cameras {list(unread)}, which the policy does not receive, "
        f"since the mapping reads only {list(read)}; if the policy needs them, add them to "
        "mapping.cameras"
    )
