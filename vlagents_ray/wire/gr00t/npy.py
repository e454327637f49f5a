"""Arrays in the format of most of GR00T's clients: .npy files.

A file's header is matched, not evaluated, and must agree with the size of the content, so that no memory is allocated
for a false shape. Arrays of text become lists; objects and structures are refused.
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.protocol.arrays import read_array
from vlagents_ray.protocol.messages import Limits

_NPY = b"\x93NUMPY"
# The header that numpy writes for every plain array; anything else (structures, objects) is refused. Each text matches
# in one way only, so that matching is fast.
_HEADER = re.compile(
    rb"\{'descr': '([<|]?[a-zA-Z]\d{1,5})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,15}, ?)*(?:\d{1,15})?)\), \}\s*"
)
_TEXT_DTYPE = re.compile(r"<U\d{1,5}")


def read_npy(data: Any, limits: Limits) -> Any:
    """Return the array in the bytes of an .npy file as a read-only view; an array of text as a list."""
    if not isinstance(data, bytes) or not data.startswith(_NPY) or len(data) < 12:
        raise MalformedMessage("gr00t: as_npy: not an .npy file")
    long = data[6] > 1
    start = 12 if long else 10
    length = int.from_bytes(data[8:start], "little")
    header = _HEADER.fullmatch(data[start : start + length]) if length < 1000 else None
    if header is None:
        raise MalformedMessage("gr00t: as_npy: want a plain array of numbers or text")
    dtype, by_columns = header[1].decode(), header[2] == b"True"
    shape = [int(n) for n in header[3].replace(b" ", b"").split(b",") if n]
    content = memoryview(data)[start + length :]
    if _TEXT_DTYPE.fullmatch(dtype):
        return _read_texts(content, dtype, shape, limits)
    return read_array(content, dtype, shape[::-1]).T if by_columns else read_array(content, dtype, shape)


def _read_texts(content: memoryview, dtype: str, shape: list[int], limits: Limits) -> Any:
    count = len(content) // max(1, 4 * int(dtype[2:]))
    if count > limits.items or len(content) > 4 * limits.text or len(shape) > 2:
        raise MessageTooLarge("gr00t: an array of more text than an instruction may have")
    try:
        return np.frombuffer(content, dtype).reshape(shape).tolist()
    except (ValueError, SystemError) as error:
        raise MalformedMessage("gr00t: an array of text that is none") from error


def write_npy(value: Any) -> dict[str, Any]:
    """Return the map with an array as an .npy file, for msgpack."""
    if isinstance(value, (np.ndarray, np.generic)):
        file = io.BytesIO()
        np.save(file, np.asarray(value), allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": file.getvalue()}
    raise TypeError(f"gr00t: cannot send {type(value).__name__}")
