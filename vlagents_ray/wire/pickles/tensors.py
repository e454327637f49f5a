"""torch's tensors in a pickle: the calls by which torch states them, and the file of numbers within.

The facts come from the pickles of torch 2.13. A tensor is a view of a storage, whose bytes are a file of
`torch.save` in its form before version 1.6: four pickles of protocol 2 that are always the same but for the type, the
key and the number of elements, a fifth with the key, and the numbers. That text is compared, and not read as pickles.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.protocol.arrays import read_array
from vlagents_ray.wire.pickles.reader import Call, Name, Reduced

_DTYPES = {b"Float": "<f4", b"Double": "<f8", b"Half": "<f2", b"BFloat16": "<u2"}
_CONSTANT = (
    b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # torch's magic number
    b"\x80\x02M\xe9\x03."  # version 1001
    b"\x80\x02}q\0(X\x10\0\0\0protocol_versionq\1M\xe9\3X\r\0\0\0little_endianq\2\x88X\n\0\0\0type_sizesq\3}q\4("
    b"X\5\0\0\0shortq\5K\2X\3\0\0\0intq\6K\4X\4\0\0\0longq\7K\4uu."
)
_FILE = re.compile(
    re.escape(_CONSTANT) + rb"\x80\x02\(X\x07\0\0\0storageq\0ctorch\n(?P<kind>Float|Double|Half|BFloat16)Storage\nq\x01"
    rb"X.\0\0\0(?P<key>[0-9]{1,20})q\x02X\x03\0\0\0cpuq\x03(?:K.|M..|J....)Ntq\x04Q\."
    rb"\x80\x02\]q\0X.\0\0\0(?P=key)q\x01a\."
    rb"(?P<size>.{8})",
    re.DOTALL,
)


def _storage(arguments: tuple[Any, ...]) -> Reduced:
    """`_load_from_bytes`: (a file of torch.save,)."""
    match arguments:
        case (memoryview() as data,) if (file := _FILE.match(data)) is not None:
            numbers, size = data[file.end() :], int.from_bytes(file["size"], "little")
            found = read_array(numbers, _DTYPES[file["kind"]], (size,))
            if file["kind"] != b"BFloat16":
                return Reduced(value=found)
            wide = found.astype("<u4")  # the upper half of a float32
            wide <<= 16
            return Reduced(value=wide.view("<f4"), allocated=wide.nbytes)
    raise MalformedMessage("pickle: torch: want a storage of floating-point numbers on the CPU")


def _tensor(arguments: tuple[Any, ...]) -> Reduced:
    """`_rebuild_tensor_v2`: (storage, offset, size, stride, whether it has a gradient, no hooks)."""
    match arguments:
        case (np.ndarray() as storage, int(start), (int(size),), (int(stride),), bool(), dict() as hooks) if (
            not hooks and start >= 0 and size >= 0 and start + size <= storage.size and (stride == 1 or size < 2)
        ):
            return Reduced(value=storage[start : start + size])
    raise MalformedMessage("pickle: torch: want a tensor of one dimension, whose numbers lie side by side")


def _no_hooks(arguments: tuple[Any, ...]) -> Reduced:
    """`OrderedDict`: ()."""
    if arguments:
        raise MalformedMessage("pickle: torch: want a tensor without hooks")
    return Reduced(value={})


CALLS: dict[Name, Call | None] = {
    Name("torch._utils", "_rebuild_tensor_v2"): _tensor,
    Name("torch.storage", "_load_from_bytes"): _storage,
    Name("collections", "OrderedDict"): _no_hooks,
}
