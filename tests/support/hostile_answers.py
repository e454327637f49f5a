"""Answers of a server that is after the memory of a robot's computer: a few bytes that name much."""

from __future__ import annotations

from typing import Any

from vlagents_ray.protocol.frame_layout import pack

ADDED_MB = 400  # most memory that reading one of them may take: three times what a client copies at most


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
