"""Valid messages with small mutations, and answers of a server that attacks the memory of a robot's
computer.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from vlagents_ray.protocol.frame_layout import pack

_JUNK: list[Any] = [
    *(
        None,
        True,
        -1,
        2**63 - 1,
        1e308,
        float("nan"),
        float("inf"),
        "",
        "x" * 1000,
        "task",
        "reset",
        "\ud7ff",
    ),
    *([], {}, [[[]]], [None], {"a": {"a": {}}}, ["0"] * 8, [0.5] * 8, [1] * 5000),
    *(
        np.zeros(0),
        np.zeros(8),
        np.full(8, np.nan),
        np.full(14, np.inf),
        np.zeros((1, 1, 1, 8)),
        np.float32(3),
    ),
    *(
        np.zeros((4, 4, 3), np.uint8),
        np.zeros((3, 4, 4), np.uint8),
        np.zeros((1, 0, 4, 4, 3), np.uint8),
    ),
    *(
        np.zeros((2, 4, 4, 3), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 3)),
        np.zeros((0, 0, 3), np.uint8),
    ),
]
_NAMES = ["", "x", "endpoint", "encoded", "__ndarray__", "__image__", "__numpy__"]
# Type bytes of msgpack, and extreme values.
_LENGTHS = b"\x00\x7f\x80\x90\xc1\xc4\xc6\xc7\xd9\xdb\xdc\xdd\xde\xdf\xff"


def mutated(choose: random.Random, frame: bytes) -> bytes:
    """Return `frame` with one to four faults: flipped, cut, repeated, swapped or inserted bytes."""
    data = bytearray(frame)
    for _ in range(choose.randint(1, 4)):
        if not data:
            return bytes(choose.randbytes(choose.randint(0, 40)))
        # Faults near the beginning and among the keys break more than faults in pixels.
        at = (
            choose.randrange(min(len(data), 160))
            if choose.random() < 0.5
            else choose.randrange(len(data))
        )
        kind = choose.randrange(7)
        if kind == 0:
            data[at] ^= 1 << choose.randrange(8)
        elif kind == 1:
            data[at] = choose.choice(_LENGTHS)
        elif kind == 2:
            del data[at:]
        elif kind == 3:
            del data[at : at + choose.randint(1, 16)]
        elif kind == 4:
            data[at:at] = choose.randbytes(choose.randint(1, 16))
        elif kind == 5:
            end = at + choose.randint(1, 64)
            data[at:at] = data[at:end] * choose.randint(1, 4)
        else:
            other = choose.randrange(len(data))
            data[at], data[other] = data[other], data[at]
    return bytes(data)


def changed(choose: random.Random, tree: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of `tree` in which one or two values are changed, removed, renamed or moved to
    a wrong place.
    """
    copy = _copy(tree)
    for _ in range(choose.randint(1, 2)):
        node = copy
        while (
            node
            and choose.random() < 0.6
            and (inside := [v for v in node.values() if isinstance(v, dict) and v])
        ):
            node = choose.choice(inside)
        if not node:
            continue
        key = choose.choice(sorted(node))
        kind = choose.randrange(5)
        if kind < 3:
            node[key] = choose.choice(_JUNK)
        elif kind == 3:
            del node[key]
        else:
            node[
                choose.choice(
                    ["", "x", "endpoint", "__ndarray__", "__image__", "__numpy__", key + "/"]
                )
            ] = node.pop(key)
    return copy


def _copy(value: Any) -> Any:
    return {key: _copy(item) for key, item in value.items()} if isinstance(value, dict) else value


# Short messages that announce large contents. Reading one of them may take at most this much
# memory, three times the largest copy that a client makes.
ADDED_MB = 400


def _act(info: dict[str, Any], blobs: list[bytes], shape: tuple[int, ...] = (1,)) -> bytes:
    action = {"$": ["nd", 0, "<f4", list(shape)]}
    header = {"request_id": "1", "act": {"action": action, "done": False, "info": info}}
    return b"".join(pack(header, [bytes(4) if shape == (1,) else b"", *blobs]))


def _named(times: int, reference: list[Any]) -> dict[str, Any]:
    return {str(number): {"$": reference} for number in range(times)}


_DEEP = b'{"request_id":"1","blobs":[],"info":' + b"[" * 50_000 + b"]" * 50_000 + b"}"
ANSWERS = {
    "rows without numbers": _act({}, [], (30_000_000, 0)),
    "no rows": _act({}, [], (0, 30_000_000)),
    "many axes": _act(_named(8, ["nd", 1, "|u1", [65_536, *[1] * 31]]), [bytes(65_536)]),
    "more axes than numpy has": _act({"a": {"$": ["nd", 1, "|u1", [1] * 40]}}, [bytes(1)]),
    "an array named often": _act(_named(600, ["nd", 1, "<f4", [250_000]]), [bytes(1_000_000)]),
    "a file named often": _act(_named(600, ["img", 1]), [bytes(1_000_000)]),
    "bytes named often": _act(_named(600, ["bin", 1]), [bytes(1_000_000)]),
    "deep lists": b"VLA\x01" + len(_DEEP).to_bytes(4, "little") + _DEEP,
    "many values": _act({"a": [0] * 900_000}, []),
}
