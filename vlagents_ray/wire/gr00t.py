"""What GR00T's `PolicyClient` and `PolicyServer` say to each other over ZMQ: one msgpack map a message.

Facts from Isaac-GR00T's `gr00t/eval/service.py` (N1.5) and `gr00t/policy/server_client.py` (N1.6 and newer). A
request is `{"endpoint", "data"?, "api_token"?}`. An array is `{"__ndarray_class__": True, "as_npy": <.npy file>}`,
or as `msgpack_numpy` writes it, which newer clients do: `{b"nd": True, b"type", b"kind", b"shape", b"data"}`; the
answer is written like the request.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge
from vlagents_ray.registry import require
from vlagents_ray.wire import npy
from vlagents_ray.wire.messages import Limits

ENDPOINTS = ("get_action", "reset", "ping", "get_modality_config")
TEXT_KEY = "task"  # in "language", whatever the client calls it there
_MODALITIES = ("video", "state", "language")
_BATCH = 256  # clients whose observations may come in one message


@dataclass(frozen=True, slots=True)
class Request:
    """A readable request."""

    endpoint: str
    data: dict[str, Any] = field(default_factory=dict)
    api_token: str | None = None
    packed: bool = False  # were its arrays written by msgpack_numpy?


@dataclass(frozen=True, slots=True)
class Observations:
    """The observations of one `get_action`, one for each client that it stands for."""

    each: tuple[dict[str, Any], ...]  # {"video": {name: (T, H, W, 3)}, "state": {name: (T, D)}, "language": {...}}
    batched: bool  # did the arrays have a batch dimension?
    flat: bool  # keys like "video.front" instead of {"video": {"front": ...}}
    paired: bool  # N1.6 and newer want [action, info], N1.5 the action alone


def read_request(payload: bytes | memoryview, limits: Limits) -> Request:
    """`MalformedMessage` or `MessageTooLarge` for anything that is no request."""
    if len(payload) > limits.body_bytes:
        raise MessageTooLarge(f"gr00t: a message of {len(payload)} bytes, the limit is {limits.body_bytes}")
    reader = _Reader(limits)
    document = reader.read(payload)
    if not isinstance(document, dict):
        raise MalformedMessage(f"gr00t: got {type(document).__name__}, want a map")
    endpoint, data, token = document.get("endpoint", "get_action"), document.get("data"), document.get("api_token")
    if not isinstance(endpoint, str) or endpoint not in ENDPOINTS:
        raise MalformedMessage(f"gr00t: unknown endpoint {str(endpoint)[:40]!r}, want one of {list(ENDPOINTS)}")
    if data is not None and not isinstance(data, dict):
        raise MalformedMessage(f"gr00t: data: got {type(data).__name__}, want a map")
    if token is not None and not isinstance(token, str):
        raise MalformedMessage(f"gr00t: api_token: got {type(token).__name__}, want text")
    return Request(endpoint, data or {}, token, reader.packed)


def read_observations(data: Mapping[str, Any]) -> Observations:
    """The observations in the data of a `get_action`."""
    paired = isinstance(data.get("observation"), dict)
    observation = data["observation"] if paired else data
    flat = not any(isinstance(observation.get(kind), dict) for kind in _MODALITIES)
    nested = _nested(observation) if flat else observation
    video = _arrays(nested.get("video"), "video")
    state = _arrays(nested.get("state"), "state")
    axes = {array.ndim - usual for group, usual in ((video, 4), (state, 2)) for array in group.values()}
    if not axes or not axes <= {0, 1} or len(axes) != 1:
        shapes = {name: array.shape for name, array in list((video | state).items())[:8]}
        raise InvalidObservation(f"observation: got {shapes}, want videos (B, T, H, W, 3) and states (B, T, D)")
    batched = axes == {1}
    sizes = {array.shape[0] for group in (video, state) for array in group.values()} if batched else {1}
    if len(sizes) != 1 or not 0 < min(sizes) <= _BATCH:
        raise InvalidObservation(f"observation: got batches of {sorted(sizes)}, want the same, 1 to {_BATCH}, in all")
    number = sizes.pop()
    texts = _texts(nested.get("language"), number)
    if not batched:
        video = {name: array[None] for name, array in video.items()}
        state = {name: array[None] for name, array in state.items()}
    if any(array.shape[1] == 0 for group in (video, state) for array in group.values()):
        raise InvalidObservation("observation: got no moment (T = 0), want one at least")
    each = tuple(
        {
            "video": {name: array[i] for name, array in video.items()},
            "state": {name: array[i] for name, array in state.items()},
            "language": {} if texts[i] is None else {TEXT_KEY: texts[i]},
        }
        for i in range(number)
    )
    return Observations(each, batched, flat, paired)


def newest(observation: Mapping[str, Any]) -> dict[str, Any]:
    """One observation's last moment: {"video": {name: (H, W, 3)}, "state": {name: (D,)}, "language": ...}."""
    return {kind: {name: array[-1] for name, array in observation[kind].items()} for kind in ("video", "state")} | {
        "language": observation["language"]
    }


def write_actions(actions: Sequence[Mapping[str, np.ndarray]], asked: Observations, info: Mapping[str, Any]) -> Any:
    """The answer to `get_action`: each client's actions by name, (H, D), become (B, H, D) under their names."""
    shapes = {name: {one[name].shape for one in actions} for name in actions[0]}
    if any(len(found) > 1 for found in shapes.values()):
        raise InvalidObservation(f"the batch's actions differ in length ({shapes}); send its observations one by one")
    joined = {name: np.stack([one[name] for one in actions]).astype(np.float32) for name in actions[0]}
    if not asked.batched:
        joined = {name: array[0] for name, array in joined.items()}
    if asked.flat:
        joined = {name if name == "action" else f"action.{name}": array for name, array in joined.items()}
    return [joined, dict(info)] if asked.paired else joined


def modality_config(modalities: Mapping[str, tuple[Sequence[str], Sequence[int]]]) -> dict[str, Any]:
    """The answer to `get_modality_config`: keys and time steps by modality."""
    return {
        name: {
            "__ModalityConfig_class__": True,
            "as_json": {"delta_indices": list(steps), "modality_keys": list(keys)},
        }
        for name, (keys, steps) in modalities.items()
    }


def pack(value: Any, *, packed: bool = False) -> bytes:
    """A message; `packed` writes arrays as `msgpack_numpy` does."""
    message: bytes = require("msgpack").packb(value, default=npy.write_packed if packed else npy.write_npy)
    return message


class _Reader:
    """msgpack into values, arrays included."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._items = 0
        self.packed = False

    def read(self, payload: bytes | memoryview) -> Any:
        msgpack = require("msgpack")
        limits = self._limits
        try:
            value = msgpack.unpackb(
                payload,
                raw=False,
                strict_map_key=True,
                object_hook=self._map,
                list_hook=self._list,
                max_str_len=limits.text,
                max_array_len=limits.items,
                max_map_len=limits.items,
                max_ext_len=0,
            )
        except (MalformedMessage, MessageTooLarge):
            raise
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
            raise MalformedMessage(f"gr00t: not msgpack as its client writes it ({str(error)[:120]})") from error
        return value

    def _count(self, values: int) -> None:
        self._items += 1 + values
        if self._items > self._limits.items:
            raise MessageTooLarge(f"gr00t: more than {self._limits.items} values in a message")

    def _list(self, node: list[Any]) -> list[Any]:
        self._count(len(node))
        return node

    def _map(self, node: dict[Any, Any]) -> Any:
        self._count(len(node))
        if "__ndarray_class__" in node:
            value = npy.read_npy(node.get("as_npy"), self._limits)
            if isinstance(value, list):  # texts
                self._count(sum(len(row) if isinstance(row, list) else 1 for row in value))
            return value
        if b"nd" in node or "nd" in node:
            self.packed = True
            return npy.read_packed(node)
        return node


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """{"video": {"front": …}} of {"video.front": …}; every other key is of the language."""
    nested: dict[str, Any] = {kind: {} for kind in _MODALITIES}
    for key, value in flat.items():
        kind, _, name = key.partition(".") if isinstance(key, str) else ("", "", "")
        if kind in ("video", "state"):
            nested[kind][name] = value
        else:
            nested["language"][key] = value
    return nested


def _arrays(group: Any, kind: str) -> dict[str, np.ndarray]:
    if group is None:
        return {}
    if not isinstance(group, dict):
        raise InvalidObservation(f"{kind}: got {type(group).__name__}, want a map of arrays")
    for name, array in group.items():
        if not isinstance(name, str) or not isinstance(array, np.ndarray):
            raise InvalidObservation(f"{kind}.{str(name)[:40]}: got {type(array).__name__}, want an array")
    return group


def _texts(language: Any, number: int) -> list[str | None]:
    """The instruction of each of `number` observations: text, or lists of it by batch and time, under any one key."""
    if not isinstance(language, dict) or not language:
        return [None] * number
    if len(language) > 1:
        raise InvalidObservation(f"language: got {sorted(map(str, language))[:8]}, want one instruction")
    [(key, value)] = language.items()
    texts = [value] * number if isinstance(value, str) else value
    if isinstance(texts, list) and len(texts) == 1:
        texts = texts * number
    if not isinstance(texts, list) or len(texts) != number:
        raise InvalidObservation(f"{str(key)[:40]}: want {number} instructions, one for each observation")
    return [_text(key, one) for one in texts]


def _text(key: Any, value: Any) -> str:
    while isinstance(value, list) and value:  # by time: the newest
        value = value[-1]
    if not isinstance(value, str):
        raise InvalidObservation(f"{str(key)[:40]}: got {type(value).__name__}, want text")
    return value
