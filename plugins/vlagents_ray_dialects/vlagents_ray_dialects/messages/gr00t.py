"""The messages of GR00T's `PolicyClient` and `PolicyServer` over ZMQ, each of which is one msgpack
map.

Sources: Isaac-GR00T's `gr00t/eval/service.py` (N1.5) and `gr00t/policy/server_client.py` (N1.6 and
newer). A request is `{"endpoint", "data"?, "api_token"?}`. An array is `{"__ndarray_class__": True,
"as_npy": <.npy file>}` or, in newer clients, has the format of `msgpack_numpy`: `{b"nd": True,
b"type", b"kind", b"shape", b"data"}`. The arrays of a reply have the format of the request's.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.frame_layout import read_array
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, MessageLimits
from vlagents_ray.registry import require
from vlagents_ray.validation import described
from vlagents_ray_dialects.messages import msgpack

ENDPOINTS = ("get_action", "reset", "ping", "get_modality_config")
TEXT_KEY = "task"  # our key of the instruction in the map "language"; it replaces the client's key
_FLAT_TEXT_KEY = "annotation.human.task_description"  # the key of most of N1.5's robots
_ARRAY_MODALITIES = ("video", "state")
_MODALITIES = (*_ARRAY_MODALITIES, "language")
_BATCH = 256  # maximum number of observations in one message


@dataclass(frozen=True, slots=True)
class GR00TRequest:
    """The request in a message of a client."""

    endpoint: str  # one of ENDPOINTS
    data: dict[str, Any]
    packed: bool  # whether the arrays of the request have the format of msgpack_numpy


@dataclass(frozen=True, slots=True)
class Observations:
    """The observations of one `get_action`, one for each session."""

    # {"video": {name: (T, H, W, 3)}, "state": {name: (T, D)}, "language": {...}}.
    each: tuple[dict[str, Any], ...]
    batched: bool  # whether the arrays had a batch dimension
    flat: bool  # whether keys are like "video.front" instead of {"video": {"front": ...}}
    # Whether the reply is [action, info], as in N1.6 and newer, or only the action, as in N1.5.
    paired: bool


_TOKEN_BYTES = 4096  # maximum size of an API key, and of the names of the fields before it
# The number of fields among which the API key must be. GR00T's clients send at most three, and
# skipping 10,000 fields takes 2 ms, before it is known whether the sender has a key.
_TOKEN_FIELDS = 16


# The beginning of a request of GR00T N1, which is a file of `torch.save`, and the answer that its
# client raises as an error of the server.
TORCH_FILE, TORCH_ERROR = b"PK\x03\x04", b"ERROR"


def read_token(payload: bytes | memoryview, limits: MessageLimits) -> str | None:
    """Return the API key in a message, without decoding the other fields.

    Args:
        payload: The message.
        limits: The limits of its size.

    Returns:
        The key; None if the message has none among its first fields.

    Raises:
        MalformedMessage: The message is not a map, or the key is not a text.
        MessageTooLarge: The message is too long.
    """
    if len(payload) > limits.body_bytes:
        raise MessageTooLarge(
            f"gr00t: expected a message of at most {limits.body_bytes} bytes, got {len(payload)}"
        )

    package = require("msgpack")
    reader = package.Unpacker(
        max_buffer_size=limits.body_bytes,
        max_array_len=0,
        max_map_len=0,  # of a field's name; fields of any size are skipped
        max_str_len=_TOKEN_BYTES,
    )
    try:
        reader.feed(payload)
        for _ in range(min(_TOKEN_FIELDS, reader.read_map_header())):
            if reader.unpack() != "api_token":
                reader.skip()
                continue
            token = reader.unpack()
            if token is not None and not isinstance(token, str):
                raise MalformedMessage(
                    f"gr00t: api_token: expected text, got {type(token).__name__}"
                )
            return token
    except (package.exceptions.UnpackException, ValueError, TypeError) as error:
        if isinstance(error, MalformedMessage):
            raise
        raise MalformedMessage(
            f"gr00t: no msgpack map ({type(error).__name__}: {str(error)[:100]})"
        ) from error
    return None


def read_request(payload: bytes | memoryview, limits: MessageLimits) -> GR00TRequest:
    """Decode a request.

    Args:
        payload: The message.
        limits: The limits of its size and content.

    Raises:
        MalformedMessage: The message is not a request.
        MessageTooLarge: The message exceeds a limit.
    """
    packed = False

    def array(node: dict[Any, Any]) -> Any:
        """Return the array in a map, and record whether it has the format of msgpack_numpy."""
        nonlocal packed
        packed = packed or msgpack.is_packed(node)
        return _array(node, limits)

    document = msgpack.unpack(payload, limits, array, text=limits.text)
    if not isinstance(document, dict):
        raise MalformedMessage(f"gr00t: expected a map, got {type(document).__name__}")

    endpoint = document.get("endpoint", "get_action")
    data = document.get("data")
    token = document.get("api_token")
    if not isinstance(endpoint, str) or endpoint not in ENDPOINTS:
        raise MalformedMessage(
            f"gr00t: endpoint: expected one of {list(ENDPOINTS)}, got {shown(endpoint)}"
        )
    if data is not None and not isinstance(data, dict):
        raise MalformedMessage(f"gr00t: data: expected a map, got {type(data).__name__}")
    if token is not None and not isinstance(token, str):
        raise MalformedMessage(f"gr00t: api_token: expected text, got {type(token).__name__}")
    return GR00TRequest(endpoint, data or {}, packed)


def read_observations(data: Mapping[str, Any]) -> Observations:
    """Read the observations of a request `get_action`.

    Args:
        data: The data of the request.

    Raises:
        InvalidObservation: A shape is wrong, or the arrays have different batch sizes.
    """
    paired = isinstance(data.get("observation"), dict)
    observation = data["observation"] if paired else data
    flat = is_flat(observation)
    by_modality = nested(observation) if flat else observation
    groups = {
        modality: _arrays(by_modality.get(modality), modality) for modality in _ARRAY_MODALITIES
    }

    batch_axes = {array.ndim - 4 for array in groups["video"].values()}
    batch_axes |= {array.ndim - 2 for array in groups["state"].values()}
    if batch_axes not in ({0}, {1}):
        first_arrays = list((groups["video"] | groups["state"]).items())[:8]
        shapes = {name: array.shape for name, array in first_arrays}
        raise InvalidObservation(
            f"observation: expected videos (B, T, H, W, 3) and states (B, T, D), got {shapes}"
        )
    batched = batch_axes == {1}
    if not batched:
        for modality, group in groups.items():
            groups[modality] = {name: array[None] for name, array in group.items()}

    arrays = [*groups["video"].values(), *groups["state"].values()]
    sizes = {array.shape[0] for array in arrays}
    if len(sizes) != 1 or not 0 < min(sizes) <= _BATCH:
        raise InvalidObservation(
            f"observation: expected batches of one size, 1 to {_BATCH}, got {sorted(sizes)}"
        )

    number = sizes.pop()
    texts = _texts(by_modality.get("language"), number)
    # Earlier moments are not dropped silently: a policy would act on less than its client believes.
    moments = {array.shape[1] for array in arrays}
    if moments != {1}:
        raise InvalidObservation(
            "observation: expected one time step (T = 1), as the modalities say, got "
            f"T = {sorted(moments)}; send the newest frame and state"
        )

    each = []
    for i in range(number):
        single: dict[str, Any] = {}
        for modality, group in groups.items():
            single[modality] = {name: array[i] for name, array in group.items()}
        single["language"] = {} if texts[i] is None else {TEXT_KEY: texts[i]}
        each.append(single)
    return Observations(tuple(each), batched, flat, paired)


def is_flat(observation: Mapping[str, Any]) -> bool:
    """Return whether keys have the form "video.front" instead of "front" in a map "video"."""
    return not any(isinstance(observation.get(modality), dict) for modality in _MODALITIES)


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"video": {"front": …}} for {"video.front": …}; keys other than video and state
    become language.
    """
    by_modality: dict[str, Any] = {modality: {} for modality in _MODALITIES}
    for key, value in flat.items():
        modality, _, name = key.partition(".") if isinstance(key, str) else ("", "", "")
        if modality in _ARRAY_MODALITIES:
            by_modality[modality][name] = value
        else:
            by_modality["language"][key] = value
    return by_modality


def at_its_time_step(observation: Mapping[str, Any]) -> dict[str, Any]:
    """Return an observation at its only time step: {"video": {name: (H, W, 3)}, "state": {name:
    (D,)}, "language": ...}.
    """
    time_step: dict[str, Any] = {}
    for modality in _ARRAY_MODALITIES:
        time_step[modality] = {name: array[0] for name, array in observation[modality].items()}
    time_step["language"] = observation["language"]
    return time_step


def write_actions(
    actions: Sequence[Mapping[str, np.ndarray]],
    observations: Observations,
    info: Mapping[str, Any],
) -> Any:
    """Return the reply to `get_action`.

    Args:
        actions: The actions of the B sessions by name, (H, D) each.
        observations: The observations of the request; the reply has a batch dimension if they have
            one.
        info: Further values, which are only sent to N1.6 and newer.

    Returns:
        The actions by name, (B, H, D), or (H, D) without a batch dimension; for N1.6 and newer a
        list of these and `info`.

    Raises:
        InvalidObservation: The actions of the sessions have different lengths.
    """
    arrays_by_name: dict[str, list[np.ndarray]] = {}
    shapes: dict[str, set[tuple[int, ...]]] = {}
    for name in actions[0]:
        arrays = [action[name] for action in actions]
        arrays_by_name[name] = arrays
        shapes[name] = {array.shape for array in arrays}
    if any(len(shapes_of_name) > 1 for shapes_of_name in shapes.values()):
        raise InvalidObservation(
            f"the batch's actions differ in length ({shapes}); send its observations one by one"
        )

    joined = {name: np.stack(arrays).astype(np.float32) for name, arrays in arrays_by_name.items()}
    if not observations.batched:
        joined = {name: array[0] for name, array in joined.items()}
    if observations.flat:
        joined = {_flat("action", name): array for name, array in joined.items()}
    return [joined, dict(info)] if observations.paired else joined


def modality_config(
    modalities: Mapping[str, tuple[Sequence[str], Sequence[int]]], *, flat: bool = False
) -> dict[str, Any]:
    """Return the reply to `get_modality_config`.

    Args:
        modalities: The keys and time steps of each modality. A modality without keys is omitted, as
            the newest clients reject it.
        flat: Whether the reply has the format of N1.5, in which keys contain their modality and a
            config is a JSON text. The clients of N1.6 and newer read a map.
    """
    answer: dict[str, Any] = {}
    for name, (keys, steps) in modalities.items():
        if not keys:
            continue

        if not flat:
            client_keys = list(keys)
        elif name == "language":
            client_keys = [_FLAT_TEXT_KEY] * len(keys)
        else:
            client_keys = [_flat(name, key) for key in keys]

        config = {"delta_indices": list(steps), "modality_keys": client_keys}
        answer[name] = {
            "__ModalityConfig_class__": True,
            "as_json": json.dumps(config) if flat else config,
        }
    return answer


def _flat(modality: str, key: str) -> str:
    """Return N1.5's name of a key, "modality.key"; an action without named columns is "action"."""
    return key if key == modality else f"{modality}.{key}"


def pack(value: Any, *, packed: bool = False) -> bytes:
    """Return the message for a value.

    Args:
        value: The value: plain values and arrays.
        packed: Whether arrays have the format of `msgpack_numpy`; otherwise they are .npy files.
    """
    return msgpack.pack(value, msgpack.write_packed if packed else write_npy)


def _arrays(group: Any, modality: str) -> dict[str, np.ndarray]:
    """Return the arrays of a modality by name."""
    if group is None:
        return {}
    if not isinstance(group, dict):
        raise InvalidObservation(
            f"{modality}: expected a map of arrays, got {type(group).__name__}"
        )
    for name, array in group.items():
        if not isinstance(name, str) or not isinstance(array, np.ndarray):
            raise InvalidObservation(
                f"{modality}.{shown(name)}: expected an array, got {type(array).__name__}"
            )
    return group


def _texts(language: Any, number: int) -> list[str | None]:
    """Return the instruction of each observation.

    Args:
        language: The map "language" with one key, whose value is a text or lists of texts.
        number: The number of observations.
    """
    if not isinstance(language, dict) or not language:
        return [None] * number
    if len(language) > 1:
        raise InvalidObservation(f"language: expected one instruction, got {shown(list(language))}")

    [(key, value)] = language.items()
    texts = [value] * number if isinstance(value, str) else value
    if isinstance(texts, list) and len(texts) == 1:
        texts = texts * number
    if not isinstance(texts, list) or len(texts) != number:
        raise InvalidObservation(
            f"{shown(key)}: expected {number} instructions, one for each observation, got "
            f"{shown(texts)}"
        )
    return [_text(key, text) for text in texts]


def _text(key: Any, value: Any) -> str:
    """Return an instruction, which may be in lists of one text."""
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, list):
        raise InvalidObservation(f"{shown(key)}: expected one instruction, got {len(value)}")
    if not isinstance(value, str):
        raise InvalidObservation(f"{shown(key)}: expected text, got {type(value).__name__}")
    return value


# Arrays in the format of most of GR00T's clients: .npy files. The header of a file is matched, not
# evaluated, and its shape must agree with the size of the content before memory is allocated.
# Arrays of text become lists; arrays of objects and structures are rejected.

_NPY = b"\x93NUMPY"
# The header that numpy writes for every plain array; other headers (structures, objects) are
# rejected. Each text has only one match, so that matching is fast.
_HEADER = re.compile(
    rb"\{'descr': '([<|]?[a-zA-Z]\d{1,5})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,15}, ?)*(?:\d{1,15})?)\), \}\s*"
)
_TEXT_DTYPE = re.compile(r"<U\d{1,5}")


def read_npy(data: Any, limits: MessageLimits) -> Any:
    """Read an .npy file.

    Args:
        data: The bytes of the file.
        limits: The limits of texts.

    Returns:
        The array as a read-only view; an array of text as a list.

    Raises:
        MalformedMessage: The data are not an .npy file of numbers or text.
        MessageTooLarge: The array has too much text.
    """
    if not isinstance(data, bytes) or not data.startswith(_NPY) or len(data) < 12:
        raise MalformedMessage("gr00t: as_npy: not an .npy file")

    # The length of the header has two bytes in version 1 of the format, four in later versions.
    start = 12 if data[6] > 1 else 10
    length = int.from_bytes(data[8:start], "little")
    header = _HEADER.fullmatch(data[start : start + length]) if length < 1000 else None
    if header is None:
        raise MalformedMessage(
            "gr00t: as_npy: expected a plain array of numbers or text, got another"
        )

    dtype, by_columns = header[1].decode(), header[2] == b"True"
    shape = [int(size) for size in header[3].replace(b" ", b"").split(b",") if size]
    content = memoryview(data)[start + length :]

    if _TEXT_DTYPE.fullmatch(dtype):
        count = len(content) // max(1, 4 * int(dtype[2:]))
        if count > limits.items or len(content) > 4 * limits.text or len(shape) > 2:
            raise MessageTooLarge("gr00t: an array of more text than an instruction may have")
        try:
            return np.frombuffer(content, dtype).reshape(shape).tolist()
        except (ValueError, SystemError) as error:
            raise MalformedMessage("gr00t: an array of text that is none") from error

    if by_columns:
        return read_array(content, dtype, shape[::-1]).T
    return read_array(content, dtype, shape)


def _array(node: dict[Any, Any], limits: MessageLimits) -> Any:
    """Return the array in a map of either format; any other map is returned unchanged."""
    if "__ndarray_class__" in node:
        return read_npy(node.get("as_npy"), limits)
    return msgpack.read_packed(node) if msgpack.is_packed(node) else node


def write_npy(value: Any) -> dict[str, Any]:
    """Return the map with an array as an .npy file, for msgpack."""
    if isinstance(value, (np.ndarray, np.generic)):
        file = io.BytesIO()
        np.save(file, np.asarray(value), allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": file.getvalue()}
    raise TypeError(f"gr00t: cannot send {type(value).__name__}")


# Mappings for GR00T's clients. The names of an action's columns depend on the robot, so that a
# deployment adds `action`.

PRESETS: dict[str, dict[str, Any]] = {
    # N1.6 and newer: {"video": {k: (1, T, H, W, 3)}, "state": {k: (1, T, D)}, "language": {"task":
    # [[text]]}}
    "gr00t": {"cameras": {"*": "video/*"}, "state": {"*": "state/*"}, "instruction": "language/*"},
    # N1.5 sends the same content under flat keys.
    "gr00t-n1.5": {
        "cameras": {"*": "video.*"},
        "state": {"*": "state.*"},
        "instruction": "annotation.human.*",
    },
}


# The client's side of GR00T's protocol: writing requests, and reading replies within limits. N1.5's
# clients send flat keys and receive only the action; clients of N1.6 and newer send
# `{"observation": {...}, "options": None}` and receive `[action, info]`. The observation is nested,
# or flat for servers that run with `--use-sim-policy-wrapper`. A server that marks its modalities
# with `__ModalityConfig__` accepts arrays in the format of `msgpack_numpy`.

_KEYS_AT_MOST = 64
_PACKED = "__ModalityConfig__"  # older servers write `__ModalityConfig_class__`


def batch(observations: Sequence[Mapping[str, Any]], text_key: str) -> dict[str, Any]:
    """Stack observations, each of one time step, into a batch.

    Args:
        observations: For each, {"video": {name: (H, W, 3)}, "state": {name: (D,)}, "language":
            {"task": text}}.
        text_key: The server's name of the instruction.

    Returns:
        {"video": {name: (B, 1, H, W, 3)}, "state": {name: (B, 1, D)}, "language": {text_key: B
        lists of one text}}.

    Raises:
        ValueError: The observations have different keys or shapes, and cannot be one batch.
    """
    first = observations[0]
    names_by_modality = {modality: list(first.get(modality, {})) for modality in _ARRAY_MODALITIES}
    for observation in observations:
        for modality, names in names_by_modality.items():
            if list(observation.get(modality, {})) != names:
                raise ValueError("the observations have different keys")

    joined: dict[str, Any] = {}
    for modality, names in names_by_modality.items():
        joined[modality] = {}
        for name in names:
            arrays = [observation[modality][name] for observation in observations]
            joined[modality][name] = np.stack(arrays)[:, None]

    texts = []
    for observation in observations:
        language = observation.get("language", {})
        texts.append([next(iter(language.values()), "")])
    joined["language"] = {text_key: texts}
    return joined


def flat(batched: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a batch to flat keys: `video.NAME`, `state.NAME`, and the key of the instruction
    with B texts.
    """
    flat_batch: dict[str, Any] = {}
    for modality in _ARRAY_MODALITIES:
        for name, array in batched[modality].items():
            flat_batch[f"{modality}.{name}"] = array

    for key, texts in batched["language"].items():
        flat_batch[key] = [text for [text] in texts]
    return flat_batch


def write(endpoint: str, data: Any, api_token: str | None, *, packed: bool = False) -> bytes:
    """Return the message of a request.

    Args:
        endpoint: One of ENDPOINTS.
        data: The data of the request; None omits them.
        api_token: The API key; None or "" omits it.
        packed: Whether arrays have the format of `msgpack_numpy`, see `reads_packed`.
    """
    message: dict[str, Any] = {"endpoint": endpoint}
    if data is not None:
        message["data"] = data
    if api_token:
        message["api_token"] = api_token
    return pack(message, packed=packed)


def read(payload: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> Any:
    """Decode a reply.

    Raises:
        MalformedMessage: The reply is not msgpack, or has an invalid array.
        MessageTooLarge: The reply exceeds a limit.
    """
    return msgpack.unpack(payload, limits, partial(_array, limits=limits))


def read_actions(reply: Any, number: int) -> list[dict[str, np.ndarray]]:
    """Read the actions in a reply to `get_action`.

    Args:
        reply: The reply.
        number: The number of observations in the request.

    Returns:
        For each observation, the actions by name, (H, D) each.

    Raises:
        MalformedMessage: The reply is not a map of arrays, or its number of actions differs from
            `number`.
    """
    actions = reply[0] if isinstance(reply, list) and len(reply) == 2 else reply
    if not isinstance(actions, dict) or not actions:
        raise MalformedMessage(
            f"gr00t: action: expected a map of arrays, got {type(actions).__name__}"
        )
    for name, array in actions.items():
        is_array = isinstance(name, str) and isinstance(array, np.ndarray)
        if not is_array or array.ndim not in (2, 3) or len(array) != number:
            raise MalformedMessage(
                f"gr00t: action {shown(name)}: expected ({number}, H, D), got {described(array)}"
            )

    split: list[dict[str, np.ndarray]] = []
    for i in range(number):
        action: dict[str, np.ndarray] = {}
        for name, array in actions.items():
            rows = array[i] if array.ndim == 3 else array[i][:, np.newaxis]
            action[name.removeprefix("action.")] = rows
        split.append(action)
    return split


def reads_packed(reply: Any) -> bool:
    """Return whether the reply to `get_modality_config` is from a server that accepts arrays in the
    format of `msgpack_numpy`.
    """
    if not isinstance(reply, dict):
        return False
    return any(isinstance(config, dict) and _PACKED in config for config in reply.values())


def read_modalities(reply: Any) -> dict[str, dict[str, list[Any]]]:
    """Read the reply to `get_modality_config`.

    Returns:
        For each modality, its "keys", without a prefix such as `video.`, and its time "steps".

    Raises:
        MalformedMessage: The reply is not a map of configurations.
    """
    if not isinstance(reply, dict):
        raise MalformedMessage(f"gr00t: modalities: expected a map, got {type(reply).__name__}")

    first_modalities = list(reply.items())[:_KEYS_AT_MOST]
    return {str(name): _modality(str(name), value) for name, value in first_modalities}


def _modality(name: str, value: Any) -> dict[str, list[Any]]:
    """Return the keys and the time steps of a modality."""
    config = value.get("as_json", value) if isinstance(value, dict) else None
    if isinstance(config, str):
        try:
            config = json.loads(config)
        except (ValueError, RecursionError) as error:
            raise MalformedMessage(f"gr00t: modality {name[:40]!r}: no JSON ({error})") from error

    keys = config.get("modality_keys") if isinstance(config, dict) else None
    steps = config.get("delta_indices") if isinstance(config, dict) else None
    if not isinstance(keys, list) or not isinstance(steps, list):
        raise MalformedMessage(
            f"gr00t: modality {name[:40]!r}: expected lists modality_keys and delta_indices, got "
            f"{shown(config)}"
        )

    are_texts = all(isinstance(key, str) for key in keys)
    are_integers = all(type(step) is int for step in steps)
    if not are_texts or not are_integers:
        raise MalformedMessage(
            f"gr00t: modality {name[:40]!r}: expected texts and whole numbers in its lists, got "
            f"{shown(config)}"
        )

    if name != "language":
        keys = [key.removeprefix(f"{name}.") for key in keys]
    return {"keys": keys[:_KEYS_AT_MOST], "steps": steps}
