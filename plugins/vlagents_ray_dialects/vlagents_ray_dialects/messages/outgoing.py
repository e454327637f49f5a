"""Conversion of our observation to another system's, and of its actions to ours: a `KeyMapping` in
reverse.

Each entry of a mapping is then the destination of a value. The vectors of several entries with one
key are joined by their `start` and `stop`; of `a|b` the first key is used; the `*` of a name
matches all cameras or states that no other entry names.
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

    Raises:
        ConfigError: A state has several parts without `stop`, so that their lengths are unknown.
    """

    mapping: KeyMapping
    # Whether a key `a/b` means `b` within `a`; else a single key.
    is_nested: Callable[[str], bool] = lambda _key: True
    text_key: str = "task"  # the replacement of `*` in the instruction's key

    def __post_init__(self) -> None:
        for name, parts in self.mapping.state.items():
            if (open_ended := sum(part.stop is None for part in parts)) > 1:
                raise ConfigError(
                    f"mapping.state.{name}: got {open_ended} parts without `stop`, want one at most"
                )

    def observation(self, obs: Obs, instruction: str | None) -> dict[str, Any]:
        """Convert an observation to the other system's; its arrays may be views of those of
        `obs`.
        """
        theirs: dict[str, Any] = {}
        for name, camera in self.mapping.cameras.items():
            for key, image in _matching(name, camera.key, obs.cameras, self.mapping.cameras):
                self._put(
                    theirs, key, image.transpose(2, 0, 1) if camera.layout == "chw" else image
                )
            if "*" not in name and name not in obs.cameras and not camera.optional:
                raise MissingCamera(name, have=obs.cameras)
        for key, vector in self._vectors(obs).items():
            self._put(theirs, key, vector)
        if self.mapping.instruction is not None and instruction is not None:
            self._put(
                theirs, _first(self.mapping.instruction).replace("*", self.text_key), instruction
            )
        for name, key in self.mapping.info.items():
            if (value := obs.info.get(name)) is not None:
                self._put(theirs, key, value)
        return theirs

    def rows(self, theirs: np.ndarray | Mapping[str, np.ndarray]) -> np.ndarray:
        """Convert their actions, (D,) or (H, D), or several such by name, to one (D,) or (H, D)
        float32.
        """
        if not isinstance(theirs, Mapping):
            return _numbers("action", theirs)
        named = {name: _numbers(name, value) for name, value in theirs.items()}
        if not (ranges := self.mapping.action):
            if len(named) == 1:
                return next(iter(named.values()))
            raise InvalidAction(
                f"action: got {sorted(named)[:16]}, want one array; say in mapping.action which "
                "columns each is"
            )
        if absent := [name for name in ranges if name not in named]:
            raise InvalidAction(
                f"action: got {sorted(named)[:16]}, which lacks {absent}; change mapping.action"
            )
        if len({named[name].shape[:-1] for name in ranges}) != 1:
            shapes = {name: named[name].shape for name in ranges}
            raise InvalidAction(f"action: got {shapes}, want the same number of rows in all")
        taken = {name: (one.start or 0, named[name]) for name, one in ranges.items()}
        for name, (start, part) in taken.items():
            if (stop := ranges[name].stop) is not None and part.shape[-1] != stop - start:
                raise InvalidAction(
                    f"action {name!r}: got {part.shape[-1]} columns, mapping.action says "
                    f"{stop - start}, {start} to {stop}; change it"
                )
        return _joined("action", list(taken.values()), InvalidAction)

    def contract(self) -> Contract:
        """Return the contract that follows from the mapping: the policy's inputs and the
        commands of its gripper.
        """
        mapping = self.mapping
        grippers = {(one.open, one.closed) for one in mapping.action_gripper}
        opened, closed = grippers.pop() if len(grippers) == 1 else (None, None)
        stops = [one.stop for one in mapping.action.values()]
        return Contract(
            cameras={
                name: CameraSpec()
                for name, one in mapping.cameras.items()
                if "*" not in name and not one.optional
            },
            state={
                name: StateSpec(dim=_width(parts))
                for name, parts in mapping.state.items()
                if "*" not in name and not all(part.optional for part in parts)
            },
            gripper=(
                self._own_gripper() and mapping.gripper is not None and not mapping.gripper.optional
            )
            or None,
            instruction=True if mapping.instruction is not None else None,
            action=ActionSpec(
                dim=max((stop for stop in stops if stop is not None), default=None)
                if None not in stops
                else None,
                gripper_open=opened,
                gripper_closed=closed,
            ),
        )

    def _own_gripper(self) -> bool:
        """Return whether the gripper has its own number; if not, the number is part of a state,
        which then sets it.
        """
        gripper = self.mapping.gripper
        return gripper is not None and not any(
            _first(part.key) == _first(gripper.key)
            and (part.start or 0) <= gripper.index
            and (part.stop is None or gripper.index < part.stop)
            for parts in self.mapping.state.values()
            for part in parts
        )

    def _vectors(self, obs: Obs) -> dict[str, np.ndarray]:
        pieces: dict[str, list[tuple[int, np.ndarray]]] = {}
        for name, parts in self.mapping.state.items():
            for matched, vector in _matching(name, name, obs.state, self.mapping.state):
                keys = [
                    (_first(part.key).replace("*", _rest(matched, name)), part) for part in parts
                ]
                for key, part, values in _split(matched, vector, keys):
                    pieces.setdefault(key, []).append((part.start or 0, values))
            if (
                "*" not in name
                and name not in obs.state
                and not all(part.optional for part in parts)
            ):
                raise MissingState(name, have=obs.state)
        gripper = self.mapping.gripper
        if gripper is not None and self._own_gripper():
            if obs.gripper is not None:
                reading = gripper.closed + obs.gripper * (gripper.open - gripper.closed)
                pieces.setdefault(_first(gripper.key), []).append(
                    (gripper.index, np.array([reading], np.float32))
                )
            elif not gripper.optional:
                raise MissingState("gripper", have=obs.state)
        return {
            key: found[0][1]
            if len(found) == 1 and found[0][0] == 0
            else _joined(key, found, InvalidObservation)
            for key, found in pieces.items()
        }

    def _put(self, theirs: dict[str, Any], key: str, value: Any) -> None:
        key, into = _first(key), theirs
        if self.is_nested(key):
            *folders, key = key.split("/")
            for folder in folders:
                into = into.setdefault(folder, {})
        into[key] = value


def _first(key: str) -> str:
    return key.partition("|")[0]


def _rest(name: str, pattern: str) -> str:
    return name.removeprefix(pattern.partition("*")[0])


def _matching(
    name: str, key: str, values: Mapping[str, np.ndarray], entries: Mapping[str, Any]
) -> list[tuple[str, np.ndarray]]:
    """Return the keys and values of one entry: of its name, or of all matches of its `*` without
    an entry.
    """
    if "*" not in name:
        return [(key, values[name])] if name in values else []
    return [
        (key.replace("*", _rest(one, name)), value)
        for one, value in values.items()
        if one not in entries and one.startswith(name[:-1])
    ]


def _width(parts: tuple[StateKey, ...]) -> int | None:
    """Return the length of a state; None if the mapping does not state it."""
    widths = [None if part.stop is None else part.stop - (part.start or 0) for part in parts]
    known = [width for width in widths if width is not None]
    return sum(known) if len(known) == len(widths) else None


def _split(
    name: str, vector: np.ndarray, keys: list[tuple[str, StateKey]]
) -> list[tuple[str, StateKey, np.ndarray]]:
    """Split a state's vector into its parts; the part without `stop` receives the rest."""
    widths = [_width((part,)) for _, part in keys]
    known = sum(width for width in widths if width is not None)
    if (vector.size < known) if None in widths else (vector.size != known):
        raise InvalidObservation(
            f"state {name!r}: got {vector.size} numbers, the mapping says {known}; change one of "
            "them"
        )
    found, at = [], 0
    for (key, part), width in zip(keys, widths, strict=True):
        end = at + (vector.size - known if width is None else width)
        found.append((key, part, vector[at:end]))
        at = end
    return found


def _joined(
    key: str, pieces: list[tuple[int, np.ndarray]], error: type[InvalidObservation | InvalidAction]
) -> np.ndarray:
    """Join vectors or columns at their positions along the last axis, which they must fill
    without gaps.
    """
    end = max(start + piece.shape[-1] for start, piece in pieces)
    if min(start for start, _ in pieces) < 0 or end > _MOST:
        raise ConfigError(
            f"mapping: {key!r}: got places up to {end}, want 0 to {_MOST}, counted from the front"
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
    if (
        not isinstance(value, np.ndarray)
        or value.dtype.kind not in "fiu"
        or not 0 < value.ndim <= 2
    ):
        raise InvalidAction(f"{name!r}: got {described(value)}, want (D,) or (H, D) numbers")
    return value.astype(np.float32)
