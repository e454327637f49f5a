"""The messages of LeRobot's asynchronous inference: look-alikes of its classes and torch's, with the same pickles."""

from __future__ import annotations

import io
import pickle
import struct
import sys
import types
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import grpc
import numpy as np

HELPERS = "lerobot.async_inference.helpers"
FEATURES: dict[str, Any] = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["shoulder.pos", "gripper.pos"]},
    "observation.images.front": {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
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


class Tensor:
    """A row of a chunk, which pickles as a view of a tensor of torch's does: with the storage of the whole chunk."""

    def __init__(self, chunk: np.ndarray, row: int) -> None:
        self.chunk, self.row = chunk, row

    def __reduce_ex__(self, _protocol: object) -> tuple[Any, ...]:
        size = self.chunk.shape[1]
        stride = tuple([1])  # a new one each time, as torch's  # noqa: C409
        return _rebuild_tensor_v2, (_Storage(self.chunk), self.row * size, (size,), stride, False, OrderedDict())


class _Storage:
    KINDS: ClassVar = {"float32": "FloatStorage", "float64": "DoubleStorage", "float16": "HalfStorage"}

    def __init__(self, array: np.ndarray) -> None:
        self.array = np.ascontiguousarray(array)

    def __reduce_ex__(self, _protocol: object) -> tuple[Any, ...]:
        """As torch.storage.TypedStorage: a file in the form of torch.save before version 1.6."""
        file, key = io.BytesIO(), "94148566539200"
        sizes = {"short": 2, "int": 4, "long": 4}
        about = {"protocol_version": 1001, "little_endian": True, "type_sizes": sizes}
        for value in (0x1950A86A20F9469CFC6C, 1001, about):
            pickle.dump(value, file, 2)
        kind = type(self.KINDS[self.array.dtype.name], (), {"__module__": "torch"})
        sys.modules["torch"].__dict__[kind.__name__] = kind
        _Persistent(file, 2, ("storage", kind, key, "cpu", self.array.size, None)).dump(self)
        pickle.dump([key], file, 2)
        file.write(struct.pack("<q", self.array.size) + self.array.tobytes())
        return _load_from_bytes, (file.getvalue(),)


class _Persistent(pickle.Pickler):
    def __init__(self, file: io.BytesIO, protocol: int, found: tuple[Any, ...]) -> None:
        super().__init__(file, protocol)
        self._found = found

    def persistent_id(self, one: Any) -> Any:
        return self._found if isinstance(one, _Storage) else None


def _rebuild_tensor_v2(*_: Any) -> None: ...
def _load_from_bytes(*_: Any) -> None: ...


_TORCH = {"torch": (), "torch._utils": (_rebuild_tensor_v2,), "torch.storage": (_load_from_bytes,)}
for _module, _functions in _TORCH.items():
    for _function in _functions:
        _function.__module__ = _module

MESSAGES = (TimedAction, TimedObservation, RemotePolicyConfig)
for _one in MESSAGES:
    _one.__module__ = HELPERS


@contextmanager
def _importable() -> Iterator[None]:
    """Let Python's pickler find the classes under LeRobot's and torch's names, whether these are installed or not."""
    folders = HELPERS.split(".")
    names = [*(".".join(folders[: n + 1]) for n in range(len(folders))), *_TORCH]
    before = {name: sys.modules.get(name) for name in names}
    made = {name: types.ModuleType(name) for name in names}
    for module, ones in {HELPERS: MESSAGES, **_TORCH}.items():
        vars(made[module]).update({one.__name__: one for one in ones})
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
    """What LeRobot's client and server send."""
    with _importable():
        return pickle.dumps(message, protocol)


def unpickled(data: bytes) -> Any:
    """What LeRobot's server reads."""
    with _importable():
        return pickle.loads(data)  # noqa: S301 - a test's own


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        known = {(HELPERS, "TimedAction"): TimedAction, ("torch", "tensor"): _tensor}
        return known[module, name]


def _tensor(numbers: list[float]) -> np.ndarray:
    assert type(numbers) is list
    return np.array(numbers, np.float32)


def actions_of(data: bytes) -> list[TimedAction]:
    """What LeRobot's client reads, with arrays for tensors."""
    return _Unpickler(io.BytesIO(data)).load()


def setup(**changes: Any) -> RemotePolicyConfig:
    stated: dict[str, Any] = {"lerobot_features": FEATURES, "actions_per_chunk": 10, **changes}
    return RemotePolicyConfig(stated.pop("policy_type", "act"), stated.pop("checkpoint", "me/act"), **stated)


def robot_saw(timestep: int, pixel: int = 0, task: str = "abc", must_go: bool = False, **more: Any) -> TimedObservation:
    """An observation of a robot with `FEATURES`."""
    values = {"shoulder.pos": 0.5, "gripper.pos": 0.25, "front": np.full((8, 8, 3), pixel, np.uint8), "task": task}
    return TimedObservation(1000.0 + timestep, timestep, values | more, must_go)


def field_of(number: int, value: int | bytes) -> bytes:
    """A field of a protobuf message: a number below 128, or bytes."""
    if isinstance(value, int):
        return bytes([number << 3, value])
    size, length = [], len(value)
    while length > 127:
        size.append(length & 127 | 128)
        length >>= 7
    return bytes([number << 3 | 2, *size, length]) + value


def fields_in(message: bytes) -> Iterator[tuple[int, Any]]:
    """The fields of a message, as `field_of` writes them."""
    at = 0
    while at < len(message):
        number, kind, at = message[at] >> 3, message[at] & 7, at + 1
        value = shift = 0
        while True:
            value, shift, at = value | (message[at] & 127) << shift, shift + 7, at + 1
            if message[at - 1] < 128:
                break
        if kind == 2:
            value, at = message[at : at + value], at + value
        yield number, value


BEGIN, MIDDLE, END = 1, 2, 3


def parts_of(data: bytes, size: int = 2 * 2**20) -> Iterator[bytes]:
    """The messages of an observation, in parts as LeRobot's client sends them."""
    for at in range(0, len(data), size):
        state = END if at + size >= len(data) else BEGIN if at == 0 else MIDDLE
        yield field_of(1, state) + field_of(2, data[at : at + size])


class AsyncClient:
    """A client of LeRobot's service over gRPC, without its threads and its robot."""

    def __init__(self, port: int, **options: Any) -> None:
        # A channel of its own for each: gRPC shares the connections of channels with the same options.
        self.channel = grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.use_local_subchannel_pool", 1)], **options)
        unary, stream = self.channel.unary_unary, self.channel.stream_unary
        self.ready, self.instruct, self.get = (
            unary(f"/transport.AsyncInference/{name}") for name in ("Ready", "SendPolicyInstructions", "GetActions")
        )
        self.send_parts = stream("/transport.AsyncInference/SendObservations")

    def begin(self, **changes: Any) -> AsyncClient:
        self.ready(b"", timeout=20)
        self.instruct(field_of(1, pickled(setup(**changes))), timeout=20)
        return self

    def send(self, observation: TimedObservation) -> None:
        self.send_parts(parts_of(pickled(observation)), timeout=20)

    def actions(self) -> list[TimedAction]:
        """The actions for what was sent last; none if the server has no observation."""
        answer = self.get(b"", timeout=20)
        return actions_of(answer[answer.index(b"\x80") :]) if answer else []

    def act(self, observation: TimedObservation) -> list[TimedAction]:
        self.send(observation)
        return self.actions()

    def __enter__(self) -> AsyncClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.channel.close()
