"""A client that behaves like GR00T's own `PolicyClient` (gr00t/policy/server_client.py), with a REQ
socket, msgpack and .npy files.

GR00T is not on PyPI, so this module follows its code. numpy's own reader decodes the arrays in the
answers.
"""

from __future__ import annotations

import io
import json
from typing import Any

import msgpack
import numpy as np
import zmq


def encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        file = io.BytesIO()
        np.save(file, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": file.getvalue()}
    return value


def encode_packed(value: Any) -> Any:
    """Encode an array as msgpack_numpy does, which GR00T's newest client uses."""
    if isinstance(value, np.ndarray):
        return {
            b"nd": True,
            b"type": value.dtype.str,
            b"kind": b"",
            b"shape": value.shape,
            b"data": value.tobytes(),
        }
    return value


def decode_n15(value: Any) -> Any:
    """Decode an answer of a server of GR00T N1.5, in which modality configs are JSON texts."""
    if "__ModalityConfig_class__" in value:
        return modality_config(**json.loads(value["as_json"]))
    return decode(value)


def modality_config(delta_indices: list[int], modality_keys: list[str]) -> dict[str, list[Any]]:
    """Return the fields of a modality config. As in the newest client, a modality without keys is
    an error.
    """
    if not modality_keys:
        raise ValueError("modality_keys must not be empty")
    return {"delta_indices": delta_indices, "modality_keys": modality_keys}


def decode(value: Any) -> Any:
    if "__ModalityConfig_class__" in value:
        return modality_config(**value["as_json"])
    if "__ndarray_class__" in value:
        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    if b"nd" in value:
        return np.ndarray(buffer=value[b"data"], dtype=value[b"type"], shape=value[b"shape"])
    return value


class PolicyClient:
    """A client with the methods `get_action`, `reset`, `ping` and `get_modality_config`."""

    def __init__(
        self,
        port: int,
        api_token: str | None = None,
        timeout_ms: int = 30_000,
        *,
        packed: bool = False,
        n15: bool = False,
    ) -> None:
        self.context = zmq.Context()
        self.api_token = api_token
        self.encode = encode_packed if packed else encode
        self.decode = decode_n15 if n15 else decode
        self.socket = self.context.socket(zmq.REQ)
        self.socket.setsockopt(zmq.RCVTIMEO, timeout_ms)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"tcp://127.0.0.1:{port}")

    def call_endpoint(self, endpoint: str, data: Any = None, requires_input: bool = True) -> Any:
        request: dict[str, Any] = {"endpoint": endpoint}
        if requires_input:
            request["data"] = data
        if self.api_token:
            request["api_token"] = self.api_token
        self.socket.send(msgpack.packb(request, default=self.encode))
        response = msgpack.unpackb(self.socket.recv(), object_hook=self.decode)
        if isinstance(response, dict) and "error" in response:
            raise RuntimeError(f"Server error: {response['error']}")
        return response

    def ping(self) -> Any:
        return self.call_endpoint("ping", requires_input=False)

    def get_action(self, observation: dict, options: dict | None = None) -> tuple[dict, dict]:
        """Return the actions of a server of GR00T N1.6 or newer."""
        return tuple(
            self.call_endpoint("get_action", {"observation": observation, "options": options})
        )

    def get_action_n15(self, observation: dict) -> dict:
        """Return the actions of a server of GR00T N1.5."""
        return self.call_endpoint("get_action", observation)

    def reset(self, options: dict | None = None) -> dict:
        return self.call_endpoint("reset", {"options": options})

    def get_modality_config(self) -> dict:
        return self.call_endpoint("get_modality_config", requires_input=False)

    def close(self) -> None:
        self.socket.close()
        self.context.term()

    def __enter__(self) -> PolicyClient:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
