"""Tests that the pickles in LeRobot's messages are read as data, that all others are rejected, and
that nothing is executed.
"""

from __future__ import annotations

import base64
import gc
import os
import pickle
import pickletools
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot_messages import FEATURES, HELPERS, TimedObservation, pickled, robot_saw, setup
from many import many

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge
from vlagents_ray.protocol.messages import Budget, MessageLimits
from vlagents_ray.serve.config.dialects import read_mapping
from vlagents_ray_dialects.messages import lerobot


class Watch:
    """Records the audit events of Python's interpreter (calls, imports, files and others) while it
    is on.
    """

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


WATCH = Watch()  # one object for all tests, as an audit hook cannot be removed


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
    """Return a function that draws a pickle with a few random changes, some of which insert parts
    of other pickles.
    """
    seeds = [*seeds, pickled({"x": [Command(), (1, 2.0), {"y": None}]})]
    opcodes = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
    words = [
        named("os", "system") + short("exit 3") + b"\x85R",
        named("builtins", "exec"),
        b"cos\nsystem\n",
        OBJECT,
        ARRAY,
        SCALAR,
        TUPLES,
        b"\x94",
        b"h\0",
        b"h\5",
        b"X\xff\xff\xff\xff",
        b"B\xff\xff\xff\x7f",
        b"(",
    ]
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
                bytes([choose.randrange(256)]),
                choose.choice(opcodes),
                choose.choice(words),
                b"",
                choose.randbytes(choose.randrange(9)),
                seeds[other][cut[0] : cut[1]],
                bytes(data[at : at + 9]) * 2,
            )[kind]
            data[at : at + choose.choice((0, 0, len(part), choose.randrange(9)))] = part
        return bytes(data)

    return draw


def _places(data: bytes) -> list[int]:
    """Return the offsets of the opcodes."""
    return [at for _, _, at in pickletools.genops(data) if at is not None]


LIMITS = MessageLimits(body_bytes=2**20)
MUTATED = int(os.environ.get("VLAGENTS_RAY_FUZZ", many(5000)))
GROWTH = 64 * 2**20  # allowed growth of the memory, bytes, for any number of pickles

# Pickles of LeRobot 0.4.4's own classes, written with Python 3.11, by the version of numpy and the
# protocol.
SETUP = (
    "gASVqwEAAAAAAACMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjBJSZW1vdGVQb2xpY3lDb25maWeUk5QpgZR9lCiMC3BvbGljeV"
    "90eXBllIwDYWN0lIwXcHJldHJhaW5lZF9uYW1lX29yX3BhdGiUjAZtZS9hY3SUjBBsZXJvYm90X2ZlYXR1cmVzlH2UKIwRb2JzZXJ2YXRpb24u"
    "c3RhdGWUfZQojAVkdHlwZZSMB2Zsb2F0MzKUjAVzaGFwZZRLAoWUjAVuYW1lc5RdlCiMDHNob3VsZGVyLnBvc5SMC2dyaXBwZXIucG9zlGV1jB"
    "hvYnNlcnZhdGlvbi5pbWFnZXMuZnJvbnSUfZQoaA2MBWltYWdllGgPSwJLAksDh5RoEV2UKIwGaGVpZ2h0lIwFd2lkdGiUjAhjaGFubmVsc5Rl"
    "dYwYb2JzZXJ2YXRpb24uaW1hZ2VzLndyaXN0lH2UKGgNaBdoD2gYaBFdlChoGmgbaBxldXWMEWFjdGlvbnNfcGVyX2NodW5rlEsKjAZkZXZpY2"
    "WUjANjcHWUjApyZW5hbWVfbWFwlH2UdWIu"
)
OBSERVATIONS = {
    "numpy 2.4, protocol 4": (
        "gASVxwEAAAAAAACMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjBBUaW1lZE9ic2VydmF0aW9ulJOUKYGUfZQojAl0aW1lc3RhbX"
        "CUR0HZVPxAEAAAjAh0aW1lc3RlcJRLB4wLb2JzZXJ2YXRpb26UfZQojAxzaG91bGRlci5wb3OURz/gAAAAAAAAjAtncmlwcGVyLnBvc5SMFm51"
        "bXB5Ll9jb3JlLm11bHRpYXJyYXmUjAZzY2FsYXKUk5SMBW51bXB5lIwFZHR5cGWUk5SMAmY0lImIh5RSlChLA4wBPJROTk5K/////0r/////Sw"
        "B0lGJDBAAAAMCUhpRSlIwFZnJvbnSUaAuMDF9yZWNvbnN0cnVjdJSTlGgOjAduZGFycmF5lJOUSwCFlEMBYpSHlFKUKEsBSwJLAksDh5RoEIwC"
        "dTGUiYiHlFKUKEsDjAF8lE5OTkr/////Sv////9LAHSUYolDDAABAgMEBQYHCAkKC5R0lGKMBXdyaXN0lGgbaB1LAIWUaB+HlFKUKEsBSwJLAk"
        "sDh5RoJYlDDAYHCAkKCwABAgMEBZR0lGKMBHRhc2uUjARsaWZ0lHWMB211c3RfZ2+UiHViLg=="
    ),
    "numpy 2.4, protocol 5": (
        "gAWV6AEAAAAAAACMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjBBUaW1lZE9ic2VydmF0aW9ulJOUKYGUfZQojAl0aW1lc3RhbX"
        "CUR0HZVPxAEAAAjAh0aW1lc3RlcJRLB4wLb2JzZXJ2YXRpb26UfZQojAxzaG91bGRlci5wb3OURz/gAAAAAAAAjAtncmlwcGVyLnBvc5SMFm51"
        "bXB5Ll9jb3JlLm11bHRpYXJyYXmUjAZzY2FsYXKUk5SMBW51bXB5lIwFZHR5cGWUk5SMAmY0lImIh5RSlChLA4wBPJROTk5K/////0r/////Sw"
        "B0lGJDBAAAAMCUhpRSlIwFZnJvbnSUjBNudW1weS5fY29yZS5udW1lcmljlIwLX2Zyb21idWZmZXKUk5QolgwAAAAAAAAAAAECAwQFBgcICQoL"
        "lGgQjAJ1MZSJiIeUUpQoSwOMAXyUTk5OSv////9K/////0sAdJRiSwJLAksDh5SMAUOUdJRSlIwFd3Jpc3SUaAuMDF9yZWNvbnN0cnVjdJSTlG"
        "gOjAduZGFycmF5lJOUSwCFlEMBYpSHlFKUKEsBSwJLAksDh5RoIIlDDAYHCAkKCwABAgMEBZR0lGKMBHRhc2uUjARsaWZ0lHWMB211c3RfZ2+U"
        "iHViLg=="
    ),
    "numpy 1.26, protocol 4": (
        "gASVxgEAAAAAAACMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjBBUaW1lZE9ic2VydmF0aW9ulJOUKYGUfZQojAl0aW1lc3RhbX"
        "CUR0HZVPxAEAAAjAh0aW1lc3RlcJRLB4wLb2JzZXJ2YXRpb26UfZQojAxzaG91bGRlci5wb3OURz/gAAAAAAAAjAtncmlwcGVyLnBvc5SMFW51"
        "bXB5LmNvcmUubXVsdGlhcnJheZSMBnNjYWxhcpSTlIwFbnVtcHmUjAVkdHlwZZSTlIwCZjSUiYiHlFKUKEsDjAE8lE5OTkr/////Sv////9LAH"
        "SUYkMEAAAAwJSGlFKUjAVmcm9udJRoC4wMX3JlY29uc3RydWN0lJOUaA6MB25kYXJyYXmUk5RLAIWUQwFilIeUUpQoSwFLAksCSwOHlGgQjAJ1"
        "MZSJiIeUUpQoSwOMAXyUTk5OSv////9K/////0sAdJRiiUMMAAECAwQFBgcICQoLlHSUYowFd3Jpc3SUaBtoHUsAhZRoH4eUUpQoSwFLAksCSw"
        "OHlGgliUMMBgcICQoLAAECAwQFlHSUYowEdGFza5SMBGxpZnSUdYwHbXVzdF9nb5SIdWIu"
    ),
    "numpy 1.26, protocol 5": (
        "gAWV5gEAAAAAAACMH2xlcm9ib3QuYXN5bmNfaW5mZXJlbmNlLmhlbHBlcnOUjBBUaW1lZE9ic2VydmF0aW9ulJOUKYGUfZQojAl0aW1lc3RhbX"
        "CUR0HZVPxAEAAAjAh0aW1lc3RlcJRLB4wLb2JzZXJ2YXRpb26UfZQojAxzaG91bGRlci5wb3OURz/gAAAAAAAAjAtncmlwcGVyLnBvc5SMFW51"
        "bXB5LmNvcmUubXVsdGlhcnJheZSMBnNjYWxhcpSTlIwFbnVtcHmUjAVkdHlwZZSTlIwCZjSUiYiHlFKUKEsDjAE8lE5OTkr/////Sv////9LAH"
        "SUYkMEAAAAwJSGlFKUjAVmcm9udJSMEm51bXB5LmNvcmUubnVtZXJpY5SMC19mcm9tYnVmZmVylJOUKJYMAAAAAAAAAAABAgMEBQYHCAkKC5Ro"
        "EIwCdTGUiYiHlFKUKEsDjAF8lE5OTkr/////Sv////9LAHSUYksCSwJLA4eUjAFDlHSUUpSMBXdyaXN0lGgLjAxfcmVjb25zdHJ1Y3SUk5RoDo"
        "wHbmRhcnJheZSTlEsAhZRDAWKUh5RSlChLAUsCSwJLA4eUaCCJQwwGBwgJCgsAAQIDBAWUdJRijAR0YXNrlIwEbGlmdJR1jAdtdXN0X2dvlIh1"
        "Yi4="
    ),
}
IMAGE = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)


def read(data: bytes, limits: MessageLimits = LIMITS) -> lerobot.RobotObservation:
    return lerobot.read_observation(data, Budget(limits))


def value_of(value: Any, protocol: int = 4) -> Any:
    """Return the value `x` that is read from an observation with no other values."""
    return read(pickled(TimedObservation(0.0, 0, {"x": value}), protocol)).values["x"]


MAPPING = read_mapping("lerobot")


def attempt(data: bytes) -> str:
    """Read a pickle as each of the two messages, as the dialect does; return the error's code, or
    "read".
    """
    said = []
    for reader in (read, lambda data: lerobot.read_instructions(data, LIMITS)):
        try:
            with WATCH.watching():
                found = reader(data)
                if isinstance(found, lerobot.RobotObservation):
                    MAPPING.obs(lerobot.frame(found, ROBOT), LIMITS)
            said.append("read")
        except InvalidInput as error:
            said.append(error.code)
    assert WATCH.seen == []
    return min(said, key=lambda code: code != "read")


ROBOT = lerobot.read_instructions(pickled(setup()), LIMITS)


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_an_observation_of_lerobots_own_client_is_read(name: str) -> None:
    found = read(base64.b64decode(OBSERVATIONS[name]))
    assert (found.timestamp, found.timestep, found.must_go) == (1700000000.25, 7, True)
    assert np.array_equal(found.values["front"], IMAGE)
    assert np.array_equal(found.values["wrist"], IMAGE[::-1])
    assert {**found.values, "front": None, "wrist": None} == {
        "shoulder.pos": 0.5, "gripper.pos": -2.0, "front": None, "wrist": None, "task": "lift",
    }  # fmt: skip


def test_policy_instructions_of_lerobots_own_client_are_read() -> None:
    found = lerobot.read_instructions(base64.b64decode(SETUP), LIMITS)
    want = lerobot.PolicyInstructions(
        "act", "me/act", ("shoulder.pos", "gripper.pos"), ("front", "wrist"), 10
    )
    assert found == want


def test_our_look_alikes_pickle_to_the_bytes_of_lerobots_classes() -> None:
    values = {
        "shoulder.pos": 0.5,
        "gripper.pos": np.float32(-2.0),
        "front": IMAGE,
        "wrist": IMAGE[::-1],
        "task": "lift",
    }
    ours = pickled(TimedObservation(1700000000.25, 7, values, True), 4)
    name = f"numpy {'1.26' if np.__version__.startswith('1.') else '2.4'}, protocol 4"
    assert ours == base64.b64decode(OBSERVATIONS[name])


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize(
    "value",
    [0, 1, 255, 256, 65536, -1, 2**31, -(2**40), 2**62, 0.5, float("inf"), True, "", "é" * 300,
     np.float64(1.5), np.int16(-3), np.uint8(7), np.array(2.5), np.zeros((0, 3), np.uint8),
     np.arange(6, dtype=np.float32).reshape(2, 3), np.asfortranarray(np.arange(6).reshape(2, 3)),
     np.arange(12, dtype=np.uint8).reshape(2, 2, 3)[:, ::-1, ::-1], np.array([True, False])],
    ids=repr,
)  # fmt: skip
def test_numbers_texts_and_arrays_keep_their_values(value: Any, protocol: int) -> None:
    found = value_of(value, protocol)
    assert np.array_equal(found, value)
    if isinstance(value, np.ndarray):
        assert (found.dtype, found.shape) == (value.dtype, value.shape)
        assert not found.flags.writeable


@settings(max_examples=many(30))
@given(
    st.dictionaries(
        st.text(max_size=40),
        st.text(max_size=300) | st.floats(allow_nan=False) | st.integers(-(2**63), 2**63 - 1),
    )
)
def test_any_observation_of_plain_values_is_read_as_pickle_reads_it(values: dict[str, Any]) -> None:
    for protocol in (4, 5):
        assert read(pickled(TimedObservation(1.0, 2, values), protocol)).values == values


def test_an_array_under_two_names_is_read_twice_and_counted_twice() -> None:
    image = np.zeros((100, 100, 3), np.uint8)
    data = pickled(TimedObservation(0.0, 0, {"a": image, "b": image}))
    assert len(data) < 2 * image.nbytes
    assert read(data).values["b"].shape == image.shape
    with pytest.raises(MessageTooLarge, match="each counts as often as the request refers to it"):
        read(data, replace(LIMITS, decoded_bytes=image.nbytes + 1))


def test_arrays_view_the_message() -> None:
    data = pickled(TimedObservation(0.0, 0, {"a": np.zeros((100, 100, 3), np.uint8)}))
    found = read(data).values["a"]
    assert np.may_share_memory(found, np.frombuffer(data, np.uint8))


class Text(str):
    pass


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (Command(), "names 'posix' 'system'"),
        (len, "names 'builtins' 'len'"),
        (np.load, "names 'numpy' 'load'"),
        (np.array(["text"]), "little-endian"),
        (np.array([None], object), "expected the type of plain numbers"),
        (np.array([1], ">f4"), "little-endian"),
        (np.array(["2020"], "M8[D]"), "expected the type of plain numbers"),
        (np.zeros(1, [("x", "f4")]), "expected the type of plain numbers"),
        (np.ma.array([1]), "names 'numpy.ma"),
        (2**80, "expected an integer of at most .*, got 11"),
        (2j, "names 'builtins' 'complex'"),
        ({1, 2}, "opcode 0x8f"),
        (None, "expected a number, text or numpy array, got NoneType"),
        ([1], "expected a number, text or numpy array, got list"),
        ((1, 2), "expected a number, text or numpy array, got tuple"),
        (b"bytes", "expected a number, text or numpy array, got memoryview"),
        ({1: 2}, "texts as keys"),
        (TimedObservation(0.0, 0, {}), "expected a number, text or numpy array, got Record"),
    ],
)
def test_what_is_no_number_text_or_array_of_numbers_is_refused(value: Any, says: str) -> None:
    with pytest.raises(InvalidInput, match=says), WATCH.watching():
        value_of(value)


ODD = [
    None,
    True,
    -1,
    1.5,
    float("nan"),
    "text",
    b"bytes",
    (),
    (1, "a"),
    [],
    ["a"] * 9,
    {},
    {"a": 1},
    np.zeros((2, 3)),
    np.zeros(1),
    np.float32(1),
    np.ndarray,
    np.dtype("f4"),
    robot_saw(0),
]


@pytest.mark.parametrize("odd", ODD, ids=lambda odd: type(odd).__name__)
def test_any_value_at_any_place_is_read_or_refused(odd: Any) -> None:
    """The reader must not compare an unexpected array or class, or use it as a truth value: both
    would raise other errors.
    """
    for field in vars(setup()):
        attempt(
            pickled(setup(**{"checkpoint" if field == "pretrained_name_or_path" else field: odd}))
        )
    for name, feature in FEATURES.items():
        attempt(pickled(setup(lerobot_features={**FEATURES, name: odd})))
        for key in feature:
            attempt(pickled(setup(lerobot_features={**FEATURES, name: {**feature, key: odd}})))
    for field in vars(robot_saw(0)):
        attempt(pickled(TimedObservation(**vars(robot_saw(0)) | {field: odd})))
    for name in ("front", "shoulder.pos", "task"):
        attempt(pickled(robot_saw(0, **{name: odd})))


def test_a_class_of_a_listed_module_is_not_listed() -> None:
    with pytest.raises(
        MalformedMessage, match=r"names 'lerobot\.async_inference\.helpers' 'FPSTracker'"
    ):
        read(pickled(robot_saw(1)).replace(b"\x10TimedObservation", b"\x0aFPSTracker"))
    with pytest.raises(
        MalformedMessage,
        match="expected a TimedObservation with its fields, got RemotePolicyConfig",
    ):
        read(pickled(setup()))


@pytest.mark.parametrize(
    ("program", "says"),
    [
        (b"cos\nsystem\n(S'exit 3'\ntR", "opcode 0x63"),  # GLOBAL, of protocol 0
        (b"(S'exit 3'\nios\nsystem\n", "opcode 0x53"),
        (b"\x82\x01", "opcode 0x82"),  # an extension code of copyreg
        (b"Pname\n", "opcode 0x50"),  # persistent ids
        (b"\x97", "opcode 0x97"),  # a buffer out of band
        (named("os", "system") + short("exit 3") + b"\x85R", "names 'os' 'system'"),
        (named("builtins", "eval") + short("1") + b"\x85R", "names 'builtins' 'eval'"),
        (named(HELPERS, "TimedObservation") + b")R", "got a call of lerobot"),
        (named("numpy", "ndarray") + b")R", "got a call of numpy.ndarray"),
        (named("numpy", "dtype") + b")\x81", "got an object of numpy.dtype"),
        (
            named("numpy", "dtype") + short("O8") + b"\x89\x88\x87R}b",
            "expected the type of plain numbers",
        ),
        (named("numpy", "dtype") + short("f4") + b"\x85R", "expected the type of plain numbers"),
        (ARRAY + named("numpy", "dtype") + b"K\0\x85C\x01b\x87R", "expected a plain array"),
        # A text is not a type.
        (SCALAR + short("<f8") + b"C\x08" + bytes(8) + b"\x86R", "expected a plain number"),
        (OBJECT + b"}b}b", "got the fields"),
        (OBJECT + OBJECT, "more than one object"),
        (OBJECT + b"N", "more than one object"),
        (OBJECT, "expected .*, got TimedObservation"),  # without fields
        (b"K\x01", "expected .*, got int"),
        (b"K\x01K\x02b", "the state of int, which has none"),
        (b"", "without its value"),
        (b"t", "without its mark"),
        (b"\x87", "without its value"),
        (b"(", "without its value"),
        (b"]K\x01(e", "expected a list"),
        (b"}K\x01K\x02s", "texts as keys"),
        (b"}(" + short("a") + b"u", "texts as keys"),
        (b"K\x01K\x02\x93", "a name that is no text"),
        (b"h\x00", "a reference to nothing"),
        (b"j\xff\xff\xff\xff", "a reference to nothing"),
        (b"]\x94h\x00a", "a second reference to list"),  # a list that contains itself
        (b"}\x94" + short("a") + b"h\x00s", "a second reference to dict"),
        (OBJECT + b"\x94h\x00b", "a second reference to TimedObservation"),
        (b"X\xff\xff\xff\x7f", "expected a text of at most .*, got 2147483647"),
        (b"\x8c\x02\xff\xff", "not UTF-8"),
        (b"B\xff\xff\xff\x7f", "ends too early"),
        (b"\x96" + b"\xff" * 8, "ends too early"),
        (b"\x8a\xff", "expected an integer of at most .*, got 255"),
        (TUPLES, "more than 8 levels"),
        (b"]" * 9 + b"a" * 9, "more than 8 levels"),
        (b"N0" * 5, "opcode 0x30"),
        (b"N" * 20_000, "more than 10000 values"),
        (b"(" * 20_000, "more than 10000 values"),
        # a tuple of two, twice in the next, and so on: 2**40 values in 200 bytes
        (
            b"NN\x86\x94" + b"".join(b"h%c" % i * 2 + b"\x86\x94" for i in range(40)),
            "values in a message|levels",
        ),
    ],
)
def test_programs_that_no_client_sends_are_refused(program: bytes, says: str) -> None:
    with pytest.raises(InvalidInput, match=says), WATCH.watching():
        read(b"\x80\x04" + program + b".")
    assert WATCH.seen == []


@pytest.mark.parametrize("head", [b"", b"\x80", b"\x80\x02", b"\x80\x03", b"\x80\x06", b"(dp0\n"])
def test_other_protocols_are_refused(head: bytes) -> None:
    with pytest.raises(MalformedMessage, match=r"protocol 4 or 5|ends too early"):
        read(head + pickled(robot_saw(1))[2:] * bool(head[1:2]))


def test_the_watch_sees_what_pickle_would_do() -> None:
    """The other tests depend on this: the watch must record the events of a pickle that is
    executed.
    """
    data = pickle.dumps(Command())
    with WATCH.watching():
        assert pickle.loads(data) != 0  # noqa: S301 - our own pickle
    assert {"pickle.find_class", "os.system"} <= set(WATCH.seen)
    WATCH.seen.clear()


def test_mutated_pickles_execute_nothing_and_cost_little() -> None:
    seeds = [base64.b64decode(text) for text in (SETUP, *OBSERVATIONS.values())]
    seeds += [
        pickled(message, protocol) for message in (robot_saw(3), setup()) for protocol in (4, 5)
    ]
    draw, choose = mutations(seeds), random.Random(0)
    # The first pickles load what is loaded only once, such as modules.
    said: Counter[str] = Counter(attempt(draw(choose)) for _ in range(MUTATED // 10))
    gc.collect()
    before, slowest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0.0
    begun = time.process_time()
    for _ in range(MUTATED - MUTATED // 10):
        data = draw(choose)
        start = time.process_time()
        said[attempt(data)] += 1
        slowest = max(slowest, time.process_time() - start)
    took_s = time.process_time() - begun
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"\n{MUTATED} pickles, the last nine tenths in {took_s:.1f} s, the slowest in "
          f"{1e3 * slowest:.1f} ms, "
          f"{grown / 2**20:.1f} MiB grown: {dict(said)}")  # fmt: skip
    assert said["read"] > 0
    assert said["malformed"] > MUTATED // 4
    assert grown < GROWTH


@given(st.binary(max_size=200), st.integers(0, 10**6))
def test_garbage_is_refused(garbage: bytes, place: int) -> None:
    data = pickled(robot_saw(3))
    at = place % len(data)
    for changed in (
        garbage,
        b"\x80\x04" + garbage,
        data[:at] + garbage,
        data[:at] + garbage + data[at:],
    ):
        attempt(changed)


def test_the_error_for_an_older_lerobot_names_the_oldest_version() -> None:
    module = "lerobot.scripts.server.helpers"
    for message, read in (
        (setup(), lambda data: lerobot.read_instructions(data, MessageLimits())),
        (robot_saw(0), lambda data: lerobot.read_observation(data, Budget(MessageLimits()))),
    ):
        data = pickled(message, protocol=2).replace(HELPERS.encode(), module.encode())
        with pytest.raises(MalformedMessage, match=r"version 0\.4\.0 or newer"):
            read(data)
