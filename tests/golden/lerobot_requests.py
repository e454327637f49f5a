"""Requests of a client of LeRobot, in the bytes that the traces have: pickles of protocol 4, by hand."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot_messages import FEATURES, HELPERS, field_of, parts_of


def instructions() -> bytes:
    """The message with the policy instructions of a robot with `FEATURES`."""
    image = {"dtype": "image", "shape": (None, None, 3), "names": ["height", "width", "channels"]}
    return field_of(
        1,
        _record(
            "RemotePolicyConfig",
            {
                "policy_type": "act",
                "pretrained_name_or_path": "me/act",
                "lerobot_features": FEATURES | {"observation.images.front": image},
                "actions_per_chunk": 10,
                "device": "cpu",
                "rename_map": {},
            },
        ),
    )


def observation(state: np.ndarray, image: np.ndarray, task: str, step: int) -> list[bytes]:
    """The messages of an observation of that robot."""
    values = {"shoulder.pos": float(state[0]), "gripper.pos": float(state[1]), "front": image, "task": task}
    fields = {"timestamp": 1000.0 + step, "timestep": step, "observation": values, "must_go": True}
    return list(parts_of(_record("TimedObservation", fields)))


def _record(name: str, fields: Mapping[str, Any]) -> bytes:
    return b"".join((b"\x80\4", _named(HELPERS, name), b")\x81", _written(fields), b"b."))


def _written(value: Any) -> bytes:
    if isinstance(value, str):
        data = value.encode()
        return b"X" + struct.pack("<I", len(data)) + data
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Mapping):
        return b"}(" + b"".join(_written(key) + _written(one) for key, one in value.items()) + b"u"
    if isinstance(value, tuple):
        return b"(" + b"".join(map(_written, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(_written, value)) + b"e"
    if value is None or isinstance(value, bool):
        return {None: b"N", True: b"\x88", False: b"\x89"}[value]
    return b"J" + struct.pack("<i", value)


def _named(module: str, name: str) -> bytes:
    return _written(module) + _written(name) + b"\x93"


def _array(value: np.ndarray) -> bytes:
    """The calls by which numpy's own pickles, from version 1.26 on, state an array."""
    order, kind, data = value.dtype.str[0], value.dtype.str[1:], value.tobytes()
    made = _named("numpy._core.multiarray", "_reconstruct") + _named("numpy", "ndarray") + _written((0,))
    dtype = _named("numpy", "dtype") + _written((kind, False, True)) + b"R"
    dtype += _written((3, order, None, None, None, -1, -1, 0)) + b"b"
    head = _written(1) + _written(value.shape) + dtype + _written(False)
    return b"".join((made, b"C\1b\x87R(", head, b"B", struct.pack("<I", len(data)), data, b"tb"))
