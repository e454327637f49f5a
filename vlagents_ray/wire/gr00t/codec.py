"""The messages of GR00T's `PolicyClient` and `PolicyServer` over ZMQ, each of which is one msgpack map.

The facts come from Isaac-GR00T's `gr00t/eval/service.py` (N1.5) and `gr00t/policy/server_client.py` (N1.6 and newer). A
request is `{"endpoint", "data"?, "api_token"?}`. An array is `{"__ndarray_class__": True, "as_npy": <.npy file>}` or,
in newer clients, has the format of `msgpack_numpy`: `{b"nd": True, b"type", b"kind", b"shape", b"data"}`; the reply has
the format of the request.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.messages import Limits
from vlagents_ray.registry import require
from vlagents_ray.wire import msgpack, msgpack_numpy
from vlagents_ray.wire.gr00t import npy

ENDPOINTS = ("get_action", "reset", "ping", "get_modality_config")
TEXT_KEY = "task"  # our key in "language", in place of the client's
_FLAT_TEXT_KEY = "annotation.human.task_description"  # the key of most of N1.5's robots
_MODALITIES = ("video", "state", "language")
_BATCH = 256  # maximum number of observations in one message


@dataclass(frozen=True, slots=True)
class GR00TRequest:
    """A decoded request."""

    endpoint: str
    data: dict[str, Any] = field(default_factory=dict)
    api_token: str | None = None
    packed: bool = False  # whether its arrays have the format of msgpack_numpy


@dataclass(frozen=True, slots=True)
class Observations:
    """The observations of one `get_action`, one for each session."""

    each: tuple[dict[str, Any], ...]  # {"video": {name: (T, H, W, 3)}, "state": {name: (T, D)}, "language": {...}}
    batched: bool  # whether the arrays had a batch dimension
    flat: bool  # whether keys are like "video.front" instead of {"video": {"front": ...}}
    paired: bool  # whether the reply is [action, info], as in N1.6 and newer, or the action alone, as in N1.5


def read_token(payload: bytes | memoryview, limits: Limits) -> str | None:
    """Return the API key in a message, whose other fields are skipped without decoding; None if it has none."""
    if len(payload) > limits.body_bytes:
        raise MessageTooLarge(f"gr00t: a message of {len(payload)} bytes, the limit is {limits.body_bytes}")
    package = require("msgpack")
    reader = package.Unpacker(max_buffer_size=limits.body_bytes, max_array_len=0, max_map_len=limits.items)
    try:
        reader.feed(payload)
        for _ in range(reader.read_map_header()):
            if reader.unpack() != "api_token":
                reader.skip()
                continue
            token = reader.unpack()
            if token is not None and not isinstance(token, str):
                raise MalformedMessage(f"gr00t: api_token: got {type(token).__name__}, want text")
            return token
    except (package.exceptions.UnpackException, ValueError, TypeError) as error:
        if isinstance(error, MalformedMessage):
            raise
        raise MalformedMessage(f"gr00t: no msgpack map ({type(error).__name__}: {str(error)[:100]})") from error
    return None


def read_request(payload: bytes | memoryview, limits: Limits) -> GR00TRequest:
    """Return the request in a message; raise `MalformedMessage` or `MessageTooLarge` if it is invalid."""
    packed = False

    def array(node: dict[Any, Any]) -> Any:
        nonlocal packed
        if "__ndarray_class__" in node:
            return npy.read_npy(node.get("as_npy"), limits)
        if msgpack_numpy.is_packed(node):
            packed = True
            return msgpack_numpy.read_packed(node)
        return node

    document = msgpack.unpack(payload, limits, array, text=limits.text)
    if not isinstance(document, dict):
        raise MalformedMessage(f"gr00t: got {type(document).__name__}, want a map")
    endpoint, data, token = document.get("endpoint", "get_action"), document.get("data"), document.get("api_token")
    if not isinstance(endpoint, str) or endpoint not in ENDPOINTS:
        raise MalformedMessage(f"gr00t: unknown endpoint {shown(endpoint)}, want one of {list(ENDPOINTS)}")
    if data is not None and not isinstance(data, dict):
        raise MalformedMessage(f"gr00t: data: got {type(data).__name__}, want a map")
    if token is not None and not isinstance(token, str):
        raise MalformedMessage(f"gr00t: api_token: got {type(token).__name__}, want text")
    return GR00TRequest(endpoint, data or {}, token, packed)


def read_observations(data: Mapping[str, Any]) -> Observations:
    """Return the observations in the data of a `get_action`; raise `InvalidObservation` for wrong shapes."""
    paired = isinstance(data.get("observation"), dict)
    observation = data["observation"] if paired else data
    flat = is_flat(observation)
    named = nested(observation) if flat else observation
    video = _arrays(named.get("video"), "video")
    state = _arrays(named.get("state"), "state")
    axes = {array.ndim - usual for group, usual in ((video, 4), (state, 2)) for array in group.values()}
    if not axes or not axes <= {0, 1} or len(axes) != 1:
        shapes = {name: array.shape for name, array in list((video | state).items())[:8]}
        raise InvalidObservation(f"observation: got {shapes}, want videos (B, T, H, W, 3) and states (B, T, D)")
    batched = axes == {1}
    sizes = {array.shape[0] for group in (video, state) for array in group.values()} if batched else {1}
    if len(sizes) != 1 or not 0 < min(sizes) <= _BATCH:
        raise InvalidObservation(f"observation: got batches of {sorted(sizes)}, want the same, 1 to {_BATCH}, in all")
    number = sizes.pop()
    texts = _texts(named.get("language"), number)
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


def is_flat(observation: Mapping[str, Any]) -> bool:
    """Return whether keys are like "video.front", and not "front" in a map "video"."""
    return not any(isinstance(observation.get(kind), dict) for kind in _MODALITIES)


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"video": {"front": …}} for {"video.front": …}; keys other than video and state belong to the language."""
    found: dict[str, Any] = {kind: {} for kind in _MODALITIES}
    for key, value in flat.items():
        kind, _, name = key.partition(".") if isinstance(key, str) else ("", "", "")
        if kind in ("video", "state"):
            found[kind][name] = value
        else:
            found["language"][key] = value
    return found


def newest(observation: Mapping[str, Any]) -> dict[str, Any]:
    """Return an observation's last time step: {"video": {name: (H, W, 3)}, "state": {name: (D,)}, "language": ...}."""
    return {kind: {name: array[-1] for name, array in observation[kind].items()} for kind in ("video", "state")} | {
        "language": observation["language"]
    }


def write_actions(actions: Sequence[Mapping[str, np.ndarray]], asked: Observations, info: Mapping[str, Any]) -> Any:
    """Return the reply to `get_action`: the actions of B sessions by name, each (H, D), become (B, H, D) by name."""
    shapes = {name: {one[name].shape for one in actions} for name in actions[0]}
    if any(len(found) > 1 for found in shapes.values()):
        raise InvalidObservation(f"the batch's actions differ in length ({shapes}); send its observations one by one")
    joined = {name: np.stack([one[name] for one in actions]).astype(np.float32) for name in actions[0]}
    if not asked.batched:
        joined = {name: array[0] for name, array in joined.items()}
    if asked.flat:
        joined = {_flat("action", name): array for name, array in joined.items()}
    return [joined, dict(info)] if asked.paired else joined


def modality_config(
    modalities: Mapping[str, tuple[Sequence[str], Sequence[int]]], *, flat: bool = False
) -> dict[str, Any]:
    """Return the reply to `get_modality_config`: keys and time steps by modality; modalities without keys are left out.

    Args:
        modalities: The keys and time steps of each modality.
        flat: Whether to use the format of N1.5, in which keys contain their modality and a config is a JSON text. The
            clients of N1.6 and newer read a map, and the newest refuses a modality without keys.
    """
    answer: dict[str, Any] = {}
    for name, (keys, steps) in modalities.items():
        if not keys:
            continue
        named = [_FLAT_TEXT_KEY if name == "language" else _flat(name, key) for key in keys] if flat else list(keys)
        config = {"delta_indices": list(steps), "modality_keys": named}
        answer[name] = {"__ModalityConfig_class__": True, "as_json": json.dumps(config) if flat else config}
    return answer


def _flat(modality: str, key: str) -> str:
    """Return N1.5's name of a key, "modality.key"; the key of an action without named parts is "action" alone."""
    return key if key == modality else f"{modality}.{key}"


def pack(value: Any, *, packed: bool = False) -> bytes:
    """Return a message with `value`; `packed` writes arrays in the format of `msgpack_numpy`."""
    return msgpack.pack(value, msgpack_numpy.write_packed if packed else npy.write_npy)


def _arrays(group: Any, kind: str) -> dict[str, np.ndarray]:
    if group is None:
        return {}
    if not isinstance(group, dict):
        raise InvalidObservation(f"{kind}: got {type(group).__name__}, want a map of arrays")
    for name, array in group.items():
        if not isinstance(name, str) or not isinstance(array, np.ndarray):
            raise InvalidObservation(f"{kind}.{shown(name)}: got {type(array).__name__}, want an array")
    return group


def _texts(language: Any, number: int) -> list[str | None]:
    """Return the instruction of each of `number` observations; `language` has one key, with text or lists of it."""
    if not isinstance(language, dict) or not language:
        return [None] * number
    if len(language) > 1:
        raise InvalidObservation(f"language: got {shown(list(language))}, want one instruction")
    [(key, value)] = language.items()
    texts = [value] * number if isinstance(value, str) else value
    if isinstance(texts, list) and len(texts) == 1:
        texts = texts * number
    if not isinstance(texts, list) or len(texts) != number:
        raise InvalidObservation(f"{shown(key)}: want {number} instructions, one for each observation")
    return [_text(key, one) for one in texts]


def _text(key: Any, value: Any) -> str:
    while isinstance(value, list) and value:  # of a list by time, the newest text counts
        value = value[-1]
    if not isinstance(value, str):
        raise InvalidObservation(f"{shown(key)}: got {type(value).__name__}, want text")
    return value
