"""Pickles that no client or server of LeRobot sends, and a watch for what a reader of them does."""

from __future__ import annotations

import os
import pickletools
import random
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lerobot_messages import HELPERS, pickled


class Watch:
    """Notes what Python's interpreter says of calls, imports, files and the like, while it is on."""

    def __init__(self) -> None:
        self.on = False
        self.seen: list[str] = []
        sys.addaudithook(self._note)

    def _note(self, event: str, _args: object) -> None:
        if self.on and event != "sys._getframe":
            self.seen.append(event)

    @contextmanager
    def watching(self) -> Iterator[None]:
        self.on = True
        try:
            yield
        finally:
            self.on = False


WATCH = Watch()  # a hook cannot be removed


class Command:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("exit 3",)


def short(text: str) -> bytes:
    return b"\x8c" + bytes([len(text)]) + text.encode()


def named(module: str, name: str) -> bytes:
    return short(module) + short(name) + b"\x93"


OBJECT = named(HELPERS, "TimedObservation") + b")\x81"
ARRAY = named("numpy._core.multiarray", "_reconstruct")
SCALAR = named("numpy._core.multiarray", "scalar")
TUPLES = b")" + b"\x85" * 9


def mutations(seeds: Sequence[bytes]) -> Callable[[random.Random], bytes]:
    """Draw a pickle that was changed in a few places, with parts of other programs among its own."""
    seeds = [*seeds, pickled({"x": [Command(), (1, 2.0), {"y": None}]})]
    opcodes = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
    words = [
        named("os", "system") + short("exit 3") + b"\x85R", named("builtins", "exec"), b"cos\nsystem\n", OBJECT, ARRAY,
        SCALAR, TUPLES, b"\x94", b"h\0", b"h\5", b"X\xff\xff\xff\xff", b"B\xff\xff\xff\x7f", b"(",
    ]  # fmt: skip
    ends = [_places(seed) for seed in seeds]

    def draw(choose: random.Random) -> bytes:
        number = choose.randrange(len(seeds))
        data, places = bytearray(seeds[number]), ends[number]
        for _ in range(choose.choice((1, 1, 2, 4, 16))):
            at = choose.choice(places) if choose.random() < 0.7 else choose.randrange(len(data) + 1)
            kind = choose.randrange(7)
            other = choose.randrange(len(seeds))
            cut = sorted(choose.sample(ends[other], 2))
            part = (
                bytes([choose.randrange(256)]), choose.choice(opcodes), choose.choice(words), b"",
                choose.randbytes(choose.randrange(9)), seeds[other][cut[0] : cut[1]], bytes(data[at : at + 9]) * 2,
            )[kind]  # fmt: skip
            data[at : at + choose.choice((0, 0, len(part), choose.randrange(9)))] = part
        return bytes(data)

    return draw


def _places(data: bytes) -> list[int]:
    """Where the opcodes begin."""
    return [at for _, _, at in pickletools.genops(data) if at is not None]
