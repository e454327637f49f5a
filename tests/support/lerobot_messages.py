"""The messages of LeRobot's asynchronous inference: copies of its classes whose pickles are equal
to LeRobot's.
"""

from __future__ import annotations

import io
import pickle
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import grpc
import numpy as np

HELPERS = "lerobot.async_inference.helpers"
FEATURES: dict[str, Any] = {
    "observation.state": {
        "dtype": "float32",
        "shape": (2,),
        "names": ["shoulder.pos", "gripper.pos"],
    },
    "observation.images.front": {
        "dtype": "image",
        "shape": (8, 8, 3),
        "names": ["height", "width", "channels"],
    },
}


@dataclass
class TimedAction:
    timestamp: float
    timestep: int
    action: Any


@dataclass
class TimedObservation:
    timestamp: float
    timestep: int
    observation: dict[str, Any]
    must_go: bool = False


@dataclass
class RemotePolicyConfig:
    policy_type: str
    pretrained_name_or_path: str
    lerobot_features: dict[str, Any]
    actions_per_chunk: int
    device: str = "cpu"
    rename_map: dict[str, str] = field(default_factory=dict)


MESSAGES = (TimedAction, TimedObservation, RemotePolicyConfig)
for _one in MESSAGES:
    _one.__module__ = HELPERS


@contextmanager
def _importable() -> Iterator[None]:
    """Let Python's pickler find the classes under LeRobot's names, even if LeRobot is not
    installed.
    """
    folders = HELPERS.split(".")
    names = [".".join(folders[: n + 1]) for n in range(len(folders))]
    before = {name: sys.modules.get(name) for name in names}
    made = {name: types.ModuleType(name) for name in names}
    vars(made[HELPERS]).update({one.__name__: one for one in MESSAGES})
    sys.modules.update(made)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def pickled(message: Any, protocol: int = pickle.DEFAULT_PROTOCOL) -> bytes:
    """Pickle a message as LeRobot's client and server do."""
    with _importable():
        return pickle.dumps(message, protocol)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        known = {(HELPERS, "TimedAction"): TimedAction, ("torch", "tensor"): _tensor}
        return known[module, name]


def _tensor(numbers: list[float]) -> np.ndarray:
    assert type(numbers) is list
    return np.array(numbers, np.float32)


def actions_of(data: bytes) -> list[TimedAction]:
    """Return the actions that LeRobot's client would read, with arrays in place of tensors."""
    return _Unpickler(io.BytesIO(data)).load()


def setup(**changes: Any) -> RemotePolicyConfig:
    stated: dict[str, Any] = {"lerobot_features": FEATURES, "actions_per_chunk": 10, **changes}
    return RemotePolicyConfig(
        stated.pop("policy_type", "act"), stated.pop("checkpoint", "me/act"), **stated
    )


def robot_saw(
    timestep: int, pixel: int = 0, task: str = "abc", must_go: bool = False, **more: Any
) -> TimedObservation:
    """Return an observation of a robot with `FEATURES`."""
    values = {
        "shoulder.pos": 0.5,
        "gripper.pos": 0.25,
        "front": np.full((8, 8, 3), pixel, np.uint8),
        "task": task,
    }
    return TimedObservation(1000.0 + timestep, timestep, values | more, must_go)


def field_of(number: int, value: int | bytes) -> bytes:
    """Return a field of a protobuf message with a number below 128, or with bytes."""
    if isinstance(value, int):
        return bytes([number << 3, value])
    size, length = [], len(value)
    while length > 127:
        size.append(length & 127 | 128)
        length >>= 7
    return bytes([number << 3 | 2, *size, length]) + value


BEGIN, MIDDLE, END = 1, 2, 3


def parts_of(data: bytes, size: int = 2 * 2**20) -> Iterator[bytes]:
    """Return the messages of an observation, in the parts that LeRobot's client sends."""
    for at in range(0, len(data), size):
        state = END if at + size >= len(data) else BEGIN if at == 0 else MIDDLE
        yield field_of(1, state) + field_of(2, data[at : at + size])


class AsyncClient:
    """A client of LeRobot's service over gRPC, without its threads and its robot."""

    def __init__(self, port: int, **options: Any) -> None:
        # Each client has a separate channel, since gRPC shares the connections of channels with the
        # same options.
        self.channel = grpc.insecure_channel(
            f"127.0.0.1:{port}", [("grpc.use_local_subchannel_pool", 1)], **options
        )
        unary, stream = self.channel.unary_unary, self.channel.stream_unary
        self.ready, self.instruct, self.get = (
            unary(f"/transport.AsyncInference/{name}")
            for name in ("Ready", "SendPolicyInstructions", "GetActions")
        )
        self.send_parts = stream("/transport.AsyncInference/SendObservations")

    def begin(self, **changes: Any) -> AsyncClient:
        self.ready(b"", timeout=20)
        self.instruct(field_of(1, pickled(setup(**changes))), timeout=20)
        return self

    def send(self, observation: TimedObservation) -> None:
        self.send_parts(parts_of(pickled(observation)), timeout=20)

    def actions(self) -> list[TimedAction]:
        """Return the actions for the latest observation; empty if the server has none."""
        answer = self.get(b"", timeout=20)
        return actions_of(answer[answer.index(b"\x80") :]) if answer else []

    def act(self, observation: TimedObservation) -> list[TimedAction]:
        self.send(observation)
        return self.actions()

    def __enter__(self) -> AsyncClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.channel.close()
