"""What LeRobot's server reads of us, and what we read of it: as data, whatever the pickle says."""

from __future__ import annotations

import base64
import gc
import os
import random
import resource
import struct
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hostile_pickles import WATCH, mutations, named, short
from lerobot_messages import RemotePolicyConfig, Tensor, TimedAction, TimedObservation, pickled, robot_saw, unpickled
from many import many

from vlagents_ray.errors import InvalidInput, MessageTooLarge
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.wire import lerobot
from vlagents_ray.wire.lerobot import PolicyInstructions

MUTATED = int(os.environ.get("VLAGENTS_RAY_FUZZ", many(5000)))
GROWTH = 64 * 2**20  # bytes, whatever the number of pickles
LIMITS = Limits(body_bytes=2**20)
ROWS = np.arange(1, 7, dtype=np.float32).reshape(2, 3) / 4

# What LeRobot 0.4.4's TimedAction and torch 2.13's tensors pickle to, with Python 3.11; the storage has the name that
# our look-alikes give it.
CHUNKS = {
    "float32": (
        "gASVVAMAAAAAAABdlCiMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjAtUaW1lZEFjdGlvbpSTlCmBlH2UKIwJdGltZXN0YW1wlE"
        "dB2VT8QBAAAIwIdGltZXN0ZXCUSweMBmFjdGlvbpSMDHRvcmNoLl91dGlsc5SMEl9yZWJ1aWxkX3RlbnNvcl92MpSTlCiMDXRvcmNoLnN0b3Jh"
        "Z2WUjBBfbG9hZF9mcm9tX2J5dGVzlJOUQhMBAACAAooKbPycRvkgaqhQGS6AAk3pAy6AAn1xAChYEAAAAHByb3RvY29sX3ZlcnNpb25xAU3pA1"
        "gNAAAAbGl0dGxlX2VuZGlhbnECiFgKAAAAdHlwZV9zaXplc3EDfXEEKFgFAAAAc2hvcnRxBUsCWAMAAABpbnRxBksEWAQAAABsb25ncQdLBHV1"
        "LoACKFgHAAAAc3RvcmFnZXEAY3RvcmNoCkZsb2F0U3RvcmFnZQpxAVgOAAAAOTQxNDg1NjY1MzkyMDBxAlgDAAAAY3B1cQNLBk50cQRRLoACXX"
        "EAWA4AAAA5NDE0ODU2NjUzOTIwMHEBYS4GAAAAAAAAAAAAgD4AAAA/AABAPwAAgD8AAKA/AADAP5SFlFKUSwBLA4WUSwGFlImMC2NvbGxlY3Rp"
        "b25zlIwLT3JkZXJlZERpY3SUk5QpUpR0lFKUdWJoAymBlH2UKGgGR0HZVPxAIAAAaAdLCGgIaAsoaA5CEwEAAIACigps/JxG+SBqqFAZLoACTe"
        "kDLoACfXEAKFgQAAAAcHJvdG9jb2xfdmVyc2lvbnEBTekDWA0AAABsaXR0bGVfZW5kaWFucQKIWAoAAAB0eXBlX3NpemVzcQN9cQQoWAUAAABz"
        "aG9ydHEFSwJYAwAAAGludHEGSwRYBAAAAGxvbmdxB0sEdXUugAIoWAcAAABzdG9yYWdlcQBjdG9yY2gKRmxvYXRTdG9yYWdlCnEBWA4AAAA5ND"
        "E0ODU2NjUzOTIwMHECWAMAAABjcHVxA0sGTnRxBFEugAJdcQBYDgAAADk0MTQ4NTY2NTM5MjAwcQFhLgYAAAAAAAAAAACAPgAAAD8AAEA/AACA"
        "PwAAoD8AAMA/lIWUUpRLA0sDhZRLAYWUiWgWKVKUdJRSlHViZS4="
    ),
    "bfloat16": (
        "gASVQgMAAAAAAABdlCiMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjAtUaW1lZEFjdGlvbpSTlCmBlH2UKIwJdGltZXN0YW1wlE"
        "dB2VT8QBAAAIwIdGltZXN0ZXCUSweMBmFjdGlvbpSMDHRvcmNoLl91dGlsc5SMEl9yZWJ1aWxkX3RlbnNvcl92MpSTlCiMDXRvcmNoLnN0b3Jh"
        "Z2WUjBBfbG9hZF9mcm9tX2J5dGVzlJOUQgoBAACAAooKbPycRvkgaqhQGS6AAk3pAy6AAn1xAChYEAAAAHByb3RvY29sX3ZlcnNpb25xAU3pA1"
        "gNAAAAbGl0dGxlX2VuZGlhbnECiFgKAAAAdHlwZV9zaXplc3EDfXEEKFgFAAAAc2hvcnRxBUsCWAMAAABpbnRxBksEWAQAAABsb25ncQdLBHV1"
        "LoACKFgHAAAAc3RvcmFnZXEAY3RvcmNoCkJGbG9hdDE2U3RvcmFnZQpxAVgOAAAAOTQxNDg1NjY1MzkyMDBxAlgDAAAAY3B1cQNLBk50cQRRLo"
        "ACXXEAWA4AAAA5NDE0ODU2NjUzOTIwMHEBYS4GAAAAAAAAAIA+AD9AP4A/oD/AP5SFlFKUSwBLA4WUSwGFlImMC2NvbGxlY3Rpb25zlIwLT3Jk"
        "ZXJlZERpY3SUk5QpUpR0lFKUdWJoAymBlH2UKGgGR0HZVPxAIAAAaAdLCGgIaAsoaA5CCgEAAIACigps/JxG+SBqqFAZLoACTekDLoACfXEAKF"
        "gQAAAAcHJvdG9jb2xfdmVyc2lvbnEBTekDWA0AAABsaXR0bGVfZW5kaWFucQKIWAoAAAB0eXBlX3NpemVzcQN9cQQoWAUAAABzaG9ydHEFSwJY"
        "AwAAAGludHEGSwRYBAAAAGxvbmdxB0sEdXUugAIoWAcAAABzdG9yYWdlcQBjdG9yY2gKQkZsb2F0MTZTdG9yYWdlCnEBWA4AAAA5NDE0ODU2Nj"
        "UzOTIwMHECWAMAAABjcHVxA0sGTnRxBFEugAJdcQBYDgAAADk0MTQ4NTY2NTM5MjAwcQFhLgYAAAAAAAAAgD4AP0A/gD+gP8A/lIWUUpRLA0sD"
        "hZRLAYWUiWgWKVKUdJRSlHViZS4="
    ),
}


def chunk(rows: np.ndarray = ROWS, timestamp: float = 1700000000.25, timestep: int = 7) -> list[TimedAction]:
    return [TimedAction(timestamp + i / 4, timestep + i, Tensor(rows, i)) for i in range(len(rows))]


@pytest.mark.parametrize("kind", CHUNKS)
def test_a_chunk_of_lerobots_own_server_is_read(kind: str) -> None:
    found = lerobot.read_chunk(base64.b64decode(CHUNKS[kind]))
    assert (found.timestamp, found.timestep) == (1700000000.25, 7)
    np.testing.assert_array_equal(found.rows, ROWS)


def test_our_look_alikes_pickle_to_the_bytes_of_lerobots_and_torchs_classes() -> None:
    assert pickled(chunk(), 4) == base64.b64decode(CHUNKS["float32"])


@pytest.mark.parametrize("dtype", ["float32", "float64", "float16"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (50, 14), (600, 2)])
@pytest.mark.parametrize("protocol", [4, 5])
def test_rows_keep_their_bits(dtype: str, shape: tuple[int, int], protocol: int) -> None:
    rows = np.random.default_rng(0).standard_normal(shape).astype(dtype)
    found = lerobot.read_chunk(pickled(chunk(rows), protocol)).rows
    assert found.dtype == dtype
    assert found.tobytes() == rows.tobytes()


INSTRUCTIONS = PolicyInstructions("act", "me/act", ("a", "b"), ("front", "wrist"), 10, "cuda:0")
IMAGES = np.random.default_rng(0).integers(0, 256, (2, 16, 8, 3), np.uint8)
SEEN: dict[str, Any] = {
    "observation.state": np.array([0.1, -2], np.float32),
    "observation.images.front": IMAGES[0],
    "observation.images.wrist": IMAGES[1, ::-1],  # a view, as of a camera that is mounted upside down
    "task": "légère",
}


def test_lerobots_server_reads_our_instructions() -> None:
    found = unpickled(lerobot.write_instructions(INSTRUCTIONS))
    image = {"dtype": "image", "shape": (None, None, 3), "names": ["height", "width", "channels"]}
    assert found == RemotePolicyConfig(
        "act",
        "me/act",
        {
            "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
            "observation.images.front": image,
            "observation.images.wrist": image,
        },
        10,
        "cuda:0",
        {},
    )


def test_lerobots_server_reads_our_observations() -> None:
    found = unpickled(lerobot.write_observation(SEEN, INSTRUCTIONS, 1700000000.25, 2**30))
    assert isinstance(found, TimedObservation)
    assert (found.timestamp, found.timestep, found.must_go) == (1700000000.25, 2**30, True)
    values = found.observation
    assert np.array([values["a"], values["b"]], np.float32).tobytes() == SEEN["observation.state"].tobytes()
    assert np.array_equal(values["front"], IMAGES[0])
    assert np.array_equal(values["wrist"], IMAGES[1, ::-1])
    assert values["task"] == "légère"
    assert list(values) == ["a", "b", "front", "wrist", "task"]


def test_a_state_of_another_length_is_refused_before_it_is_sent() -> None:
    with pytest.raises(InvalidInput, match="got 3 numbers, the mapping says 2"):
        lerobot.write_observation(SEEN | {"observation.state": np.zeros(3, np.float32)}, INSTRUCTIONS, 0.0, 0)


@pytest.mark.parametrize("name", ["observation.state", "observation.images.wrist"])
def test_an_observation_without_what_the_server_wants_is_refused_before_it_is_sent(name: str) -> None:
    with pytest.raises(InvalidInput, match=rf"got no \['{name}'\]"):
        lerobot.write_observation({key: value for key, value in SEEN.items() if key != name}, INSTRUCTIONS, 0.0, 0)


def test_an_observation_in_parts_is_that_observation() -> None:
    data = np.random.default_rng(0).bytes(5 * 2**20 + 1)
    parts = [lerobot.read_observation_part(message) for message in lerobot.write_observation_parts(data)]
    assert [part.state for part in parts] == [1, 2, 3]
    assert b"".join(part.data for part in parts) == data
    [only] = lerobot.write_observation_parts(b"short")
    assert lerobot.read_observation_part(only).state is lerobot.TransferState.END


ACTION = named("lerobot.async_inference.helpers", "TimedAction") + b")\x81"
REBUILD, LOAD = named("torch._utils", "_rebuild_tensor_v2"), named("torch.storage", "_load_from_bytes")
HOOKS = named("collections", "OrderedDict")
GOOD = pickled(chunk(), 4)
FILE = GOOD[GOOD.index(b"\x80\x02") : GOOD.index(b"\x94\x85\x94R")]


def storage(file: bytes) -> bytes:
    return LOAD + b"B" + struct.pack("<I", len(file)) + file + b"\x85R"


def tensor(start: int = 0, size: int = 3, stride: int = 1, hooks: bytes = HOOKS + b")R") -> bytes:
    numbers = b"".join(
        b"J" + struct.pack("<i", number) + b"\x85"[: i > 0] for i, number in enumerate((start, size, stride))
    )
    return REBUILD + b"(" + storage(FILE) + numbers + b"\x89" + hooks + b"tR"


def action(made: bytes) -> bytes:
    fields = short("timestamp") + b"K\1" + short("timestep") + b"K\1" + short("action") + made
    return b"]" + ACTION + b"}(" + fields + b"uba"


def test_the_tensor_of_the_tests_below_is_read() -> None:
    np.testing.assert_array_equal(lerobot.read_chunk(b"\x80\4" + action(tensor(1, 4)) + b".").rows, [ROWS.ravel()[1:5]])


@pytest.mark.parametrize(
    ("program", "says"),
    [
        (action(named("os", "system") + short("exit 3") + b"\x85R"), "names 'os' 'system'"),
        (action(named("torch", "load") + short("x") + b"\x85R"), "names 'torch' 'load'"),
        (action(named("torch._utils", "_rebuild_device_tensor_from_numpy") + b")R"), "which is not read here"),
        (action(storage(b"")), "want a storage"),
        (action(storage(b"cos\nsystem\n(S'exit 3'\ntR.")), "want a storage"),
        (action(storage(FILE.replace(b"ctorch\nFloatStorage", b"cos\nsystem"))), "want a storage"),
        (action(storage(FILE.replace(b"FloatStorage", b"LongStorage"))), "want a storage"),
        (action(storage(FILE.replace(b"cpu", b"gpu"))), "want a storage"),
        (action(storage(FILE[:-4])), "bytes, want"),
        (action(storage(FILE + b"more")), "bytes, want"),
        (action(tensor(-1)), "want a tensor of one dimension"),
        (action(tensor(4, 3)), "want a tensor of one dimension"),
        (action(tensor(0, 2**30, 0)), "want a tensor of one dimension"),
        (action(tensor(0, 3, 2)), "want a tensor of one dimension"),
        (action(tensor(hooks=HOOKS + b"]\x85R")), "want a tensor without hooks"),
        (action(tensor(hooks=b"}" + short("a") + b"K\1s")), "want a tensor of one dimension"),
        (action(b"K\1"), "want tensors"),
        (action(b"]"), "want tensors"),
        (action(tensor()).replace(b"timestepK\1", b"timestepN"), "an integer as timestep"),
        (action(tensor()).replace(b"timestampK\1", b"timestampN"), "a number as timestamp"),
        (b"]", "want a list of TimedAction"),
        (b"N", "got NoneType, want a list"),
        (b"]K\1a", "got int, want a TimedAction"),
        (b"]" + ACTION + b"a", "got TimedAction, want a TimedAction with its fields"),
    ],
)
def test_what_no_server_of_lerobots_answers_is_refused(program: bytes, says: str) -> None:
    with pytest.raises(InvalidInput, match=says), WATCH.watching():
        lerobot.read_chunk(b"\x80\4" + program + b".")
    assert WATCH.seen == []


def test_rows_of_different_length_are_refused() -> None:
    both = [*chunk(ROWS), *chunk(ROWS[:, :2])]
    with pytest.raises(InvalidInput, match="of the same length and type"):
        lerobot.read_chunk(pickled(both, 4))


def test_rows_that_share_their_bytes_are_counted_each() -> None:
    """A few bytes for each row, all of which name one tensor, would otherwise be as many copies of it."""
    big = chunk(np.zeros((1, 2**17), np.float32))[0].action
    data = pickled([TimedAction(0.0, i, big) for i in range(40)], 4)
    assert len(data) < 2**20
    with pytest.raises(MessageTooLarge, match=f"more than {DEFAULT_LIMITS.reply_bytes} bytes"):
        lerobot.read_chunk(data)


def attempt(data: bytes) -> str:
    try:
        with WATCH.watching():
            lerobot.read_chunk(data, LIMITS)
    except InvalidInput as error:
        return error.code
    finally:
        assert WATCH.seen == []
    return "read"


def test_mutated_chunks_execute_nothing_and_cost_little() -> None:
    seeds = [base64.b64decode(text) for text in CHUNKS.values()]
    seeds += [pickled(chunk(ROWS.astype(dtype)), 5) for dtype in ("float64", "float16")]
    draw, choose = mutations([*seeds, pickled(robot_saw(3))]), random.Random(0)
    said: Counter[str] = Counter(attempt(draw(choose)) for _ in range(MUTATED // 10))  # what is loaded once
    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    said += Counter(attempt(draw(choose)) for _ in range(MUTATED - MUTATED // 10))
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"\n{MUTATED} pickles, {grown / 2**20:.1f} MiB more: {dict(said)}")
    assert said["read"] > 0
    assert said["malformed"] > MUTATED // 4
    assert grown < GROWTH


def test_a_chunk_of_more_values_than_a_message_of_a_client_may_have_is_read() -> None:
    rows = np.zeros((1000, 2), np.float32)
    assert lerobot.read_chunk(pickled(chunk(rows), 4), replace(LIMITS, body_bytes=2**24)).rows.shape == (1000, 2)
