"""Converts our observation to another system's format, and the other system's actions to ours: a
`KeyMapping` in reverse.

In reverse, the key of each entry of a mapping is the destination of a value. The vectors of several
entries with the same key are joined according to their `start` and `stop`. If an entry has
alternatives `a|b`, the first key is used. The `*` of a name matches all cameras or states that no
other entry names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    MissingCamera,
    MissingState,
)
from vlagents_ray.interface import Obs
from vlagents_ray.validation import described
from vlagents_ray.wire.mapping import KeyMapping, StateKey

_MOST = 4096  # largest number of elements of a joined vector


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A mapping in reverse.

    Raises: ConfigError: A state has several parts without `stop`, so that their lengths are
    unknown.
    """

    mapping: KeyMapping
    # Returns whether a key `a/b` means `b` within `a`; otherwise it is a single key.
    is_nested: Callable[[str], bool] = lambda _key: True
    text_key: str = "task"  # replaces `*` in the key of the instruction

    def __post_init__(self) -> None:
        for name, state_keys in self.mapping.state.items():
            open_ended = sum(state_key.stop is None for state_key in state_keys)
            if open_ended > 1:
                raise ConfigError(
                    f"mapping.state.{name}: expected at most one part without `stop`, got "
                    f"{open_ended}; add `stop` to the others"
                )

    def observation(self, obs: Obs, instruction: str | None) -> dict[str, Any]:
        """Convert an observation to the other system's format.

        Args:
            obs: The observation.
            instruction: The task in words, or None.

        Returns:
            The other system's observation, whose arrays may be views of the arrays of `obs`.

        Raises:
            MissingCamera: The observation lacks a camera of the mapping.
            MissingState: The observation lacks a part of the state or the gripper.
            InvalidObservation: The numbers of a state do not fit the mapping.
        """
        theirs: dict[str, Any] = {}
        for name, camera in self.mapping.cameras.items():
            for key, image in _matching(name, camera.key, obs.cameras, self.mapping.cameras):
                converted = image.transpose(2, 0, 1) if camera.layout == "chw" else image
                self._put(theirs, key, converted)
            if "*" not in name and name not in obs.cameras and not camera.optional:
                raise MissingCamera(name, have=obs.cameras)

        for key, vector in self._vectors(obs).items():
            self._put(theirs, key, vector)

        if self.mapping.instruction is not None and instruction is not None:
            text_key = _first(self.mapping.instruction).replace("*", self.text_key)
            self._put(theirs, text_key, instruction)

        for name, key in self.mapping.info.items():
            value = obs.info.get(name)
            if value is not None:
                self._put(theirs, key, value)
        return theirs

    def rows(self, theirs: np.ndarray | Mapping[str, np.ndarray]) -> np.ndarray:
        """Convert the other system's actions to our format.

        Args:
            theirs: The actions, (D,) or (H, D), or several such arrays by name.

        Returns:
            The actions, (D,) or (H, D) float32.

        Raises:
            InvalidAction: The arrays do not fit `action` of the mapping.
        """
        if not isinstance(theirs, Mapping):
            return _numbers("action", theirs)

        arrays = {name: _numbers(name, value) for name, value in theirs.items()}
        ranges = self.mapping.action
        if not ranges:
            if len(arrays) == 1:
                return next(iter(arrays.values()))
            raise InvalidAction(
                f"action: expected one array, got {sorted(arrays)[:16]}; list in mapping.action "
                "the columns of each"
            )

        absent = [name for name in ranges if name not in arrays]
        if absent:
            raise InvalidAction(
                f"action: got {sorted(arrays)[:16]}, which lacks {absent}; change mapping.action"
            )
        if len({arrays[name].shape[:-1] for name in ranges}) != 1:
            shapes = {name: arrays[name].shape for name in ranges}
            raise InvalidAction(
                f"action: expected the same number of rows in all arrays, got {shapes}"
            )

        pieces = []
        for name, columns in ranges.items():
            start, stop = columns.start or 0, columns.stop
            width = arrays[name].shape[-1]
            if stop is not None and width != stop - start:
                raise InvalidAction(
                    f"action {name!r}: expected {stop - start} columns, {start} to {stop} in "
                    f"mapping.action, got {width}; change it"
                )
            pieces.append((start, arrays[name]))
        return _joined("action", pieces, InvalidAction)

    def contract(self) -> Contract:
        """Return the contract that follows from the mapping: the inputs of the policy, and the
        commands of the gripper.
        """
        mapping = self.mapping

        cameras = {}
        for name, camera in mapping.cameras.items():
            if "*" not in name and not camera.optional:
                cameras[name] = CameraSpec()

        state = {}
        for name, state_keys in mapping.state.items():
            is_optional = all(state_key.optional for state_key in state_keys)
            if "*" not in name and not is_optional:
                state[name] = StateSpec(dim=_width(state_keys))

        needs_gripper = (
            self._has_separate_gripper()
            and mapping.gripper is not None
            and not mapping.gripper.optional
        )

        commands = {(command.open, command.closed) for command in mapping.action_gripper}
        opened, closed = commands.pop() if len(commands) == 1 else (None, None)
        stops = [columns.stop for columns in mapping.action.values()]
        known_stops = [stop for stop in stops if stop is not None]
        action_dim = None
        if len(known_stops) == len(stops):
            action_dim = max(known_stops, default=None)

        return Contract(
            cameras=cameras,
            state=state,
            gripper=needs_gripper or None,
            instruction=True if mapping.instruction is not None else None,
            action=ActionSpec(dim=action_dim, gripper_open=opened, gripper_closed=closed),
        )

    def _has_separate_gripper(self) -> bool:
        """Return whether the gripper has a separate number; if not, a state of the observation sets
        it.
        """
        gripper = self.mapping.gripper
        if gripper is None:
            return False

        for state_keys in self.mapping.state.values():
            for state_key in state_keys:
                is_same_key = _first(state_key.key) == _first(gripper.key)
                begins_before = (state_key.start or 0) <= gripper.index
                ends_after = state_key.stop is None or gripper.index < state_key.stop
                if is_same_key and begins_before and ends_after:
                    return False
        return True

    def _vectors(self, obs: Obs) -> dict[str, np.ndarray]:
        """Return the vectors of the state and the gripper by their keys."""
        pieces: dict[str, list[tuple[int, np.ndarray]]] = {}  # (start, values) by key
        for name, state_keys in self.mapping.state.items():
            for matched, vector in _matching(name, name, obs.state, self.mapping.state):
                keys = []
                for state_key in state_keys:
                    key = _first(state_key.key).replace("*", _rest(matched, name))
                    keys.append((key, state_key))
                for key, state_key, values in _split(matched, vector, keys):
                    pieces.setdefault(key, []).append((state_key.start or 0, values))

            is_optional = all(state_key.optional for state_key in state_keys)
            if "*" not in name and name not in obs.state and not is_optional:
                raise MissingState(name, have=obs.state)

        gripper = self.mapping.gripper
        if gripper is not None and self._has_separate_gripper():
            if obs.gripper is not None:
                reading = gripper.closed + obs.gripper * (gripper.open - gripper.closed)
                values = np.array([reading], np.float32)
                pieces.setdefault(_first(gripper.key), []).append((gripper.index, values))
            elif not gripper.optional:
                raise MissingState("gripper", have=obs.state)

        vectors = {}
        for key, pieces_of_key in pieces.items():
            first_start, first_values = pieces_of_key[0]
            if len(pieces_of_key) == 1 and first_start == 0:
                vectors[key] = first_values
            else:
                vectors[key] = _joined(key, pieces_of_key, InvalidObservation)
        return vectors

    def _put(self, theirs: dict[str, Any], key: str, value: Any) -> None:
        """Set a value in `theirs`, or, for a nested key, in the map within `theirs` that the key
        names.
        """
        key = _first(key)
        target = theirs
        if self.is_nested(key):
            *folders, key = key.split("/")
            for folder in folders:
                target = target.setdefault(folder, {})
        target[key] = value


def _first(key: str) -> str:
    """Return the first alternative of a key."""
    return key.partition("|")[0]


def _rest(name: str, pattern: str) -> str:
    """Return the part of a name that the `*` of a pattern matches."""
    return name.removeprefix(pattern.partition("*")[0])


def _matching(
    name: str, key: str, values: Mapping[str, np.ndarray], entries: Mapping[str, Any]
) -> list[tuple[str, np.ndarray]]:
    """Return the keys and values of one entry.

    Args:
        name: The name of the entry; a `*` matches all values that no other entry names.
        key: The key of the entry, in which `*` is replaced.
        values: The values of the observation by name.
        entries: All entries of the mapping by name.
    """
    if "*" not in name:
        return [(key, values[name])] if name in values else []

    matches = []
    for value_name, value in values.items():
        if value_name not in entries and value_name.startswith(name[:-1]):
            matches.append((key.replace("*", _rest(value_name, name)), value))
    return matches


def _width(state_keys: tuple[StateKey, ...]) -> int | None:
    """Return the length of a state; None if the mapping does not declare it."""
    width = 0
    for state_key in state_keys:
        if state_key.stop is None:
            return None
        width += state_key.stop - (state_key.start or 0)
    return width


def _split(
    name: str, vector: np.ndarray, keys: list[tuple[str, StateKey]]
) -> list[tuple[str, StateKey, np.ndarray]]:
    """Split the vector of a state for its keys; the key without `stop` receives the remaining
    numbers.
    """
    widths = [_width((state_key,)) for _, state_key in keys]
    known_width = sum(width for width in widths if width is not None)
    remaining = vector.size - known_width
    is_mismatch = remaining < 0 if None in widths else remaining != 0
    if is_mismatch:
        raise InvalidObservation(
            f"state {name!r}: got {vector.size} numbers, the mapping says {known_width}; change "
            f"one of them"
        )

    pieces = []
    begin = 0
    for (key, state_key), width in zip(keys, widths, strict=True):
        end = begin + (remaining if width is None else width)
        pieces.append((key, state_key, vector[begin:end]))
        begin = end
    return pieces


def _joined(
    key: str, pieces: list[tuple[int, np.ndarray]], error: type[InvalidObservation | InvalidAction]
) -> np.ndarray:
    """Join vectors or columns at their positions along the last axis, which they must fill
    without gaps.
    """
    end = max(start + piece.shape[-1] for start, piece in pieces)
    if min(start for start, _ in pieces) < 0 or end > _MOST:
        raise ConfigError(
            f"mapping: {key!r}: expected places from 0 to {_MOST}, counted from the front, got "
            f"some up to {end}"
        )

    whole = np.empty((*pieces[0][1].shape[:-1], end), np.float32)
    filled = np.zeros(end, bool)
    for start, piece in pieces:
        whole[..., start : start + piece.shape[-1]] = piece
        filled[start : start + piece.shape[-1]] = True

    if not filled.all():
        missing = np.flatnonzero(~filled)[:8].tolist()
        raise error(f"{key!r}: nothing in the mapping fills the numbers at {missing}; add them")
    return whole


def _numbers(name: str, value: Any) -> np.ndarray:
    """Return an array of actions as float32; raise `InvalidAction` for any other value."""
    is_numeric = isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    if not is_numeric or not 0 < value.ndim <= 2:
        raise InvalidAction(f"{name!r}: expected (D,) or (H, D) numbers, got {described(value)}")
    actions: np.ndarray = value.astype(np.float32)
    return actions
