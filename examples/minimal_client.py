"""A minimal client.

Copy minimal_client.py into a robot's program; it needs numpy, simplejpeg and websockets.

    with Policy("ws://gpu-box:8000/v1/stream") as policy:
        policy.reset({"front": image}, {"joints": joints}, instruction="stack the cups")
        answer = policy.act({"front": image}, {"joints": joints})
        answer["action"]  # (D,) float32, or (H, D) for a chunk; also "done" and "info"

docs/protocol.md specifies the messages. `vlagents_ray.RemoteAgent` also reconnects and resumes its
episode.
"""

import json
import struct
import time
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
import simplejpeg
from websockets.sync.client import connect

Arrays = dict[str, np.ndarray]  # arrays by camera, or by part of the state
_PREFIX = struct.Struct("<3sBI")  # b"VLA", protocol version, bytes of the header


class PolicyError(Exception):
    """An error of the server: `code, text = error.args`, such as "not_reset"; the connection can
    still be used.
    """


class Policy(ExitStack):
    """A session, open until `close`.

    `jpeg` is the quality of images, up to 100; None sends raw pixels.
    """

    def __init__(
        self, url: str, timeout_s: float = 5.0, jpeg: int | None = 85, api_key: str = ""
    ) -> None:
        super().__init__()
        key = {"authorization": f"Bearer {api_key}"} if api_key else {}
        self._socket = self.enter_context(
            connect(url, compression=None, max_size=2**26, additional_headers=key)
        )
        self._timeout_s, self._jpeg, self._requests = timeout_s, jpeg, 0

    def reset(
        self, cameras: Arrays, state: Arrays, gripper: float | None = None, **task: Any
    ) -> dict[str, Any]:
        """Begin an episode with its first observation.

        `task` may contain an `instruction` and `kwargs` of the policy.
        """
        return dict(self._call("reset", cameras, state, gripper, **task)["info"])

    def act(self, cameras: Arrays, state: Arrays, gripper: float | None = None) -> dict[str, Any]:
        """Return the action for (H, W, 3) uint8 RGB images, (D,) numbers, and a gripper from 0,
        closed, to 1, open.
        """
        return dict(self._call("act", cameras, state, gripper)["act"])

    def _call(
        self, op: str, cameras: Arrays, state: Arrays, gripper: float | None, **task: Any
    ) -> dict[str, Any]:
        end = time.monotonic() + self._timeout_s
        self._requests += 1
        header = {
            "op": op,
            "request_id": str(self._requests),
            "deadline_ms": 900 * self._timeout_s,
            **task,
        }
        images = {name: np.ascontiguousarray(image) for name, image in cameras.items()}
        form = {
            n: ["img", i] if self._jpeg else ["nd", i, "|u1", images[n].shape]
            for i, n in enumerate(images)
        }
        blobs = [
            simplejpeg.encode_jpeg(x, self._jpeg) if self._jpeg else x.tobytes()
            for x in images.values()
        ]
        parts = {n: np.asarray(part).tolist() for n, part in state.items()}
        obs = {"cameras": {n: {"$": form[n]} for n in form}, "gripper": gripper, "state": parts}
        text = json.dumps(header | {"obs": obs, "blobs": [len(blob) for blob in blobs]}).encode()
        frame = _PREFIX.pack(b"VLA", 1, len(text)) + text
        for blob in blobs:
            frame += bytes(-len(frame) % 8) + blob  # each blob begins at a multiple of 8
        self._socket.send(frame)
        while True:  # until the answer to this request, skipping late answers to abandoned requests
            data = self._socket.recv(max(0.0, end - time.monotonic()), decode=False)
            at = _PREFIX.size + _PREFIX.unpack_from(data)[2]
            text, blobs = data[_PREFIX.size : at], []
            for size in json.loads(text)["blobs"]:
                at += -at % 8 + size
                blobs.append(data[at - size : at])
            reply: dict[str, Any] = json.loads(text, object_hook=partial(_value, blobs))
            if "error" in reply and reply["request_id"] in ("", header["request_id"]):
                raise PolicyError(reply["error"]["code"], reply["error"]["detail"])
            if reply["request_id"] == header["request_id"]:
                return reply


def _value(blobs: list[bytes], node: dict[str, Any]) -> Any:
    """Decode one object of a reply: an array, bytes or a number if it is a reference."""
    kind, i, *form = node.get("$", ("object", 0))
    if kind == "nd":
        return np.frombuffer(blobs[i], form[0]).reshape(form[1])
    return node if kind == "object" else blobs[i] if kind == "bin" else float(i)
