"""The client's side of GR00T's protocol: requests that are written, and replies that are read within bounds.

The facts are those of `codec`: N1.5's clients send flat keys and get the action alone; those of N1.6 and newer send
`{"observation": {...}, "options": None}` and get `[action, info]`. The observation is nested, or flat for servers that
run with `--use-sim-policy-wrapper`. A server that marks its modalities with `__ModalityConfig__` reads arrays of
`msgpack_numpy`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.wire import msgpack, msgpack_numpy
from vlagents_ray.wire.gr00t import npy

_KEYS_AT_MOST = 64
_ARRAYS = ("video", "state")
_PACKED = "__ModalityConfig__"  # older servers write `__ModalityConfig_class__`


@dataclass(frozen=True, slots=True)
class Modality:
    """What a server says about one modality: its keys, and the time steps of each."""

    keys: tuple[str, ...]
    steps: tuple[int, ...]


def batch(observations: Sequence[Mapping[str, Any]], text_key: str) -> dict[str, Any]:
    """Return observations of one moment each as one batch.

    Args:
        observations: {"video": {name: (H, W, 3)}, "state": {name: (D,)}, "language": {"task": text}} of each.
        text_key: The server's name of the instruction.

    Returns:
        {"video": {name: (B, 1, H, W, 3)}, "state": {name: (B, 1, D)}, "language": {text_key: B lists of one text}}.

    Raises:
        ValueError: The observations have different keys or shapes, and cannot be one batch.
    """
    first = observations[0]
    kinds = {kind: list(first.get(kind, {})) for kind in _ARRAYS}
    if any(list(one.get(kind, {})) != names for one in observations for kind, names in kinds.items()):
        raise ValueError("the observations have different keys")
    joined: dict[str, Any] = {
        kind: {name: np.stack([one[kind][name] for one in observations])[:, None] for name in names}
        for kind, names in kinds.items()
    }
    texts = [next(iter(one.get("language", {}).values()), "") for one in observations]
    return joined | {"language": {text_key: [[text] for text in texts]}}


def flat(batched: Mapping[str, Any]) -> dict[str, Any]:
    """Return a batch with flat keys: `video.NAME`, `state.NAME`, and the instruction's own key with B texts."""
    named = {f"{kind}.{name}": array for kind in _ARRAYS for name, array in batched[kind].items()}
    return named | {key: [text for [text] in texts] for key, texts in batched["language"].items()}


def write(endpoint: str, data: Any, api_token: str | None, *, packed: bool = False) -> bytes:
    """Return the message of a request; `data` is left out if it is None; `packed` is that of `reads_packed`."""
    array = msgpack_numpy.write_packed if packed else npy.write_npy
    message = {"endpoint": endpoint} | ({} if data is None else {"data": data})
    return msgpack.pack(message | ({"api_token": api_token} if api_token else {}), array)


def read(payload: bytes, limits: Limits = DEFAULT_LIMITS) -> Any:
    """Return the value of a reply; raise `MalformedMessage` or `MessageTooLarge` if it is invalid."""

    def array(node: dict[Any, Any]) -> Any:
        if "__ndarray_class__" in node:
            return npy.read_npy(node.get("as_npy"), limits)
        return msgpack_numpy.read_packed(node) if msgpack_numpy.is_packed(node) else node

    return msgpack.unpack(payload, limits, array)


def read_actions(reply: Any, number: int) -> list[dict[str, np.ndarray]]:
    """Return the actions of each of `number` observations by name, (H, D), in a reply to `get_action`."""
    actions = reply[0] if isinstance(reply, list) and len(reply) == 2 else reply
    if not isinstance(actions, dict) or not actions:
        raise MalformedMessage(f"gr00t: got {type(actions).__name__} for an action, want a map of arrays")
    for name, array in actions.items():
        if not isinstance(name, str) or not isinstance(array, np.ndarray) or array.ndim not in (2, 3):
            got = f"{array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            raise MalformedMessage(f"gr00t: action {shown(name)}: got {got}, want ({number}, H, D)")
        if array.shape[0] != number:
            raise MalformedMessage(f"gr00t: action {name[:40]!r}: got {array.shape}, want ({number}, H, D)")
    return [
        {
            name.removeprefix("action."): array[i] if array.ndim == 3 else array[i][:, np.newaxis]
            for name, array in actions.items()
        }
        for i in range(number)
    ]


def reads_packed(reply: Any) -> bool:
    """Return whether what `get_modality_config` answered is of a server that reads arrays of `msgpack_numpy`."""
    return isinstance(reply, dict) and any(isinstance(one, dict) and _PACKED in one for one in reply.values())


def read_modalities(reply: Any) -> dict[str, Modality]:
    """Return what `get_modality_config` answered, by modality; keys have no prefix such as `video.`."""
    if not isinstance(reply, dict):
        raise MalformedMessage(f"gr00t: got {type(reply).__name__} for modalities, want a map")
    return {str(name): _modality(str(name), value) for name, value in list(reply.items())[:_KEYS_AT_MOST]}


def _modality(name: str, value: Any) -> Modality:
    config = value.get("as_json", value) if isinstance(value, dict) else None
    if isinstance(config, str):
        try:
            config = json.loads(config)
        except (ValueError, RecursionError) as error:
            raise MalformedMessage(f"gr00t: modality {name[:40]!r}: no JSON ({error})") from error
    keys = config.get("modality_keys") if isinstance(config, dict) else None
    steps = config.get("delta_indices") if isinstance(config, dict) else None
    if not isinstance(keys, list) or not isinstance(steps, list):
        raise MalformedMessage(f"gr00t: modality {name[:40]!r}: want lists modality_keys and delta_indices")
    if not all(isinstance(key, str) for key in keys) or not all(type(step) is int for step in steps):
        raise MalformedMessage(f"gr00t: modality {name[:40]!r}: want texts and whole numbers in its lists")
    shown = keys if name == "language" else [key.removeprefix(f"{name}.") for key in keys]
    return Modality(tuple(shown[:_KEYS_AT_MOST]), tuple(steps))
