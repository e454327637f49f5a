"""The client's side of LeRobot's asynchronous inference: instructions and observations are written, chunks are read.

The facts come from LeRobot 0.4.4's `async_inference/policy_server.py` and `helpers.py`; those of 0.6.1 are the same.
The server unpickles what a client sends. It answers a pickled list of `TimedAction`, whose tensors are read as data,
see `pickles`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidObservation, MalformedMessage, MessageTooLarge
from vlagents_ray.protocol.arrays import Buffer
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.protocol.observations import is_number
from vlagents_ray.wire.lerobot.codec import HELPERS, OBSERVATION, SETUP, PolicyInstructions
from vlagents_ray.wire.lerobot.presets import IMAGES, STATE, TASK
from vlagents_ray.wire.mapping.mapping import KeyMapping
from vlagents_ray.wire.pickles.reader import Name, fields_of, read_pickle
from vlagents_ray.wire.pickles.tensors import CALLS
from vlagents_ray.wire.pickles.writer import write_record

_ACTION = Name(HELPERS, "TimedAction")
_RECORDS = {_ACTION: ("timestamp", "timestep", "action")}
_ITEMS = 100_000  # opcodes of a chunk: a row has about fifty


@dataclass(frozen=True, slots=True)
class TimedChunk:
    """The actions that a server answers."""

    timestamp: float  # that of the observation, s since 1970
    timestep: int  # that of the observation
    rows: np.ndarray  # (H, D) of the type that the server computed


def features_of(mapping: KeyMapping) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the state's numbers and of the cameras, which the server wants before the first observation.

    Raises:
        ConfigError: The mapping does not name them all, or has keys that LeRobot's server does not read.
    """
    cameras = tuple(one.key.removeprefix(IMAGES) for one in mapping.cameras.values())
    for name, one in mapping.cameras.items():
        if "*" in name or not one.key.startswith(IMAGES):
            raise ConfigError(
                f"mapping.cameras: got {name}: {one.key}, want each camera by its name, e.g. "
                f"{{front: {IMAGES}front}}: LeRobot's server wants all names before the first observation"
            )
    ends = [part.stop for parts in mapping.state.values() for part in parts]
    keys = {part.key for parts in mapping.state.values() for part in parts}
    if mapping.gripper is not None:
        keys.add(mapping.gripper.key)
        ends.append(mapping.gripper.index + 1)
    known = [end for end in ends if end is not None]
    if keys != {STATE} or len(known) < len(ends):
        raise ConfigError(
            f"mapping.state: got the keys {sorted(keys)}, want {STATE} alone, and `stop` in each part, e.g. "
            f"{{joints: {{key: {STATE}, stop: 6}}}}: LeRobot's server wants the number of numbers first"
        )
    if mapping.instruction not in (TASK, None) or mapping.info:
        raise ConfigError(f"mapping: LeRobot's server reads images, {STATE} and {TASK}; remove other keys")
    return tuple(f"{STATE}.{i}" for i in range(max(known))), cameras


def write_instructions(instructions: PolicyInstructions) -> bytes:
    """Return the pickle of policy instructions."""
    state: dict[str, Any] = {
        STATE: {"dtype": "float32", "shape": (len(instructions.state),), "names": list(instructions.state)}
    }
    # The server reads an image in its own size, and resizes it to the policy's.
    image = {"dtype": "image", "shape": (None, None, 3), "names": ["height", "width", "channels"]}
    return write_record(
        SETUP,
        {
            "policy_type": instructions.policy_type,
            "pretrained_name_or_path": instructions.checkpoint,
            "lerobot_features": state | {IMAGES + name: image for name in instructions.cameras},
            "actions_per_chunk": instructions.actions_per_chunk,
            "device": instructions.device,
            "rename_map": {},
        },
    )


def write_observation(
    theirs: Mapping[str, Any], instructions: PolicyInstructions, timestamp: float, timestep: int
) -> bytes:
    """Return the pickle of an observation, which the server computes in any case (`must_go`).

    Args:
        theirs: By LeRobot's names: `observation.state`, (D,) float32; `observation.images.NAME`, (H, W, 3) uint8; and
            `task`, a text.
        instructions: Those that the server got: they name the numbers and the cameras.
        timestamp: Of the observation, s since 1970; the server's answer repeats it.
        timestep: The server's answer repeats it.

    Raises:
        InvalidObservation: It lacks a camera or the state, or that has another length than the instructions say.
    """
    wanted = (STATE, *(IMAGES + name for name in instructions.cameras))
    if missing := [name for name in wanted if name not in theirs]:  # which the mapping calls optional
        raise InvalidObservation(f"lerobot: got no {missing}; the server wants all that the mapping names")
    state = theirs[STATE]
    if len(state) != len(instructions.state):
        raise InvalidObservation(f"{STATE!r}: got {len(state)} numbers, the mapping says {len(instructions.state)}")
    values: dict[str, Any] = dict(zip(instructions.state, map(float, state), strict=True))
    values |= {name: theirs[IMAGES + name] for name in instructions.cameras}
    if TASK in theirs:
        values[TASK] = theirs[TASK]
    fields = {"timestamp": timestamp, "timestep": timestep, "observation": values, "must_go": True}
    return write_record(OBSERVATION, fields)


def read_chunk(data: Buffer, limits: Limits = DEFAULT_LIMITS) -> TimedChunk:
    """Return the chunk in a pickle.

    Raises:
        MalformedMessage: The pickle has anything but a chunk, see `pickles`.
        MessageTooLarge: It exceeds a limit.
    """
    actions = read_pickle(data, replace(limits, items=max(limits.items, _ITEMS)), _RECORDS, CALLS)
    if not isinstance(actions, list) or not actions:
        raise MalformedMessage(f"actions: got {type(actions).__name__}, want a list of TimedAction")
    fields = [fields_of(action, _ACTION) for action in actions]
    rows = [one["action"] for one in fields]
    if not all(isinstance(row, np.ndarray) for row in rows) or len({(row.shape, row.dtype) for row in rows}) != 1:
        raise MalformedMessage("actions: want tensors of the same length and type")
    if sum(row.nbytes for row in rows) > limits.reply_bytes:  # rows may share their bytes
        raise MessageTooLarge(f"actions: more than {limits.reply_bytes} bytes")
    timestamp, timestep = fields[0]["timestamp"], fields[0]["timestep"]
    if not is_number(timestamp) or not math.isfinite(timestamp) or type(timestep) is not int:
        raise MalformedMessage("actions: want a number as timestamp, and an integer as timestep")
    return TimedChunk(float(timestamp), timestep, np.stack(rows))
