"""Messages that are nearly right."""

from __future__ import annotations

import random

_LENGTHS = b"\x00\x7f\x80\x90\xc1\xc4\xc6\xc7\xd9\xdb\xdc\xdd\xde\xdf\xff"  # msgpack's own, and extremes


def mutated(choose: random.Random, frame: bytes) -> bytes:
    """`frame` with one to four faults: flipped, cut, repeated, swapped or inserted bytes."""
    data = bytearray(frame)
    for _ in range(choose.randint(1, 4)):
        if not data:
            return bytes(choose.randbytes(choose.randint(0, 40)))
        # Faults in the beginning and among the keys do more harm than those in pixels.
        at = choose.randrange(min(len(data), 160)) if choose.random() < 0.5 else choose.randrange(len(data))
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
