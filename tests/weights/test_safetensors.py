"""Weights as bytes: decoded values, and headers that are rejected before any allocation."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import InvalidWeights, MalformedMessage
from vlagents_ray.weights.safetensors import (
    MESSAGE_BYTES,
    PART_BYTES,
    ValueSpec,
    ValuesReader,
    header_of,
    parts_of,
    read_header,
)

TYPES = ("bool", *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)))
VALUES: dict[str, np.ndarray] = {
    **{name: (np.arange(6).reshape(2, 3) % 2).astype(name) for name in TYPES},
    **{f"float{bits}": np.linspace(-1, 1, 5).astype(f"float{bits}") for bits in (16, 32, 64)},
    "bfloat16": np.arange(4, dtype=np.uint16).view("V2"),
    "one": np.full((), 7, np.float32),
    "none": np.zeros((0, 3), np.float32),
    "last of none": np.zeros(0, np.int64),
}


@pytest.mark.parametrize("length", [1, 7, PART_BYTES])
def test_values_come_back_as_they_were(length: int) -> None:
    specs = read_header(header_of(VALUES))
    assert set(specs) == set(VALUES)
    reader = ValuesReader(specs)
    for part in parts_of(VALUES, length):
        assert len(part) <= length
        reader.add(part)
    assert reader.received == reader.size == sum(value.nbytes for value in VALUES.values())
    found = reader.values()
    for name, value in VALUES.items():
        assert (found[name].dtype, found[name].shape) == (value.dtype, value.shape)
        assert found[name].tobytes() == value.tobytes()
        assert not found[name].flags.writeable


def test_a_file_of_the_safetensors_package_is_read() -> None:
    header = (
        b'{"__metadata__":{"format":"np"},"n":{"dtype":"I64","shape":[0,2],"data_offsets":[0,0]},'
        b'"w":{"dtype":"F32","shape":[1,3],"data_offsets":[0,12]},'
        b'"b":{"dtype":"BOOL","shape":[2],"data_offsets":[12,14]}} '
    )
    reader = ValuesReader(read_header(b"\xc8\0\0\0\0\0\0\0" + header))
    reader.add(b"\0\0\x80?\0\0\0@\0\0@@\1\0")
    found = reader.values()
    assert {name: value.tolist() for name, value in found.items()} == {
        "n": [],
        "w": [[1, 2, 3]],
        "b": [True, False],
    }


def test_a_value_without_a_type_of_the_format_is_named() -> None:
    with pytest.raises(
        InvalidWeights, match=r"'z': expected a dtype of BF16, BOOL.*, got complex64"
    ):
        header_of({"z": np.zeros(2, np.complex64)})


def header(document: Any) -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    return struct.pack("<Q", len(text)) + text


def entry(**changed: Any) -> dict[str, Any]:
    return {"w": {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24], **changed}}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "got 0 bytes"),
        (header({})[:-1], "got 9 bytes that announce a header of 2"),
        (struct.pack("<Q", 2**63) + b"{}", "announce a header of 9223372036854775808"),
        (header(b" " * MESSAGE_BYTES), "at most 4194304 together"),
        (header(b"\x80"), "expected a JSON document"),
        (header(b"[" * 100_000), "expected a JSON document"),
        (header(b'{"w": 1' + b"0" * 5000 + b"}"), "a number of 5001 digits"),
        (header(b'{"w": {}, "w": {}}'), "the key 'w' occurs twice"),
        (header([]), "expected an object with a value for each name, got list"),
        (header({"w": 1}), "'w': expected 'dtype'"),
        (header({"w" * 513: entry()["w"]}), "got one of 513"),
        (header({"w": {**entry()["w"], "code": "pickle"}}), "'w': expected 'dtype'"),
        (header(entry(dtype="PICKLE")), "expected a type of BOOL.*, got 'PICKLE'"),
        (header(entry(dtype=["F32"])), "expected a type of"),
        (header(entry(shape=[2, -3])), "shape: expected"),
        (header(entry(shape=[2, 3.0])), "shape: expected"),
        (header(entry(shape=[True, 6])), "shape: expected"),
        (header(entry(shape="23")), "shape: expected"),
        (header(entry(shape=[1] * 33)), "shape: expected at most 32"),
        (header(entry(data_offsets=[0])), "data_offsets: expected two"),
        (
            header(entry(data_offsets=[0, 20])),
            "expected the bytes 0 to 24 for F32 of shape .*, got 0 to 20",
        ),
        (header(entry(data_offsets=[8, 32])), "expected the bytes 0 to 24 .*, got 8 to 32"),
        (header(entry(data_offsets=[24, 0])), "expected the bytes 0 to 24 .*, got 24 to 0"),
        (header(entry() | {"v": entry()["w"]}), "expected the bytes 24 to 48 .*, got 0 to 24"),
        (
            header(entry() | {"v": entry(data_offsets=[32, 56])["w"]}),
            "expected the bytes 24 to 48 .*, got 32 to 56",
        ),
        (header(entry(shape=[10**14] * 30)), "expected the bytes .*, got 0 to 24"),
    ],
)
def test_what_is_no_header_is_refused(data: bytes, says: str) -> None:
    with pytest.raises(MalformedMessage, match=says):
        read_header(data)


def test_memory_is_allocated_when_its_first_byte_arrives() -> None:
    huge = ValueSpec(np.dtype(np.float32), (10**12,))  # 4 TB
    reader = ValuesReader({"small": ValueSpec(np.dtype(np.uint8), (4,)), "huge": huge})
    reader.add(b"1234")
    assert reader.received < reader.size


def test_more_bytes_than_announced_and_other_truth_values_are_refused() -> None:
    reader = ValuesReader({"b": ValueSpec(np.dtype(np.bool_), (2,))})
    with pytest.raises(
        MalformedMessage, match="expected 2 bytes of values, as the header announced, got 3"
    ):
        reader.add(b"\0\1\0")
    reader.add(b"\1\2")
    with pytest.raises(MalformedMessage, match="'b': expected bytes of 0 and 1"):
        reader.values()
