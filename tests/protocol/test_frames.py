"""Frames: decoding restores the encoded values, and rejects everything else."""

from __future__ import annotations

import json
import random
import struct
import tracemalloc

import golden
import numpy as np
import pytest
from hostile_messages import mutated
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from in_flight import read_requests
from many import many

from vlagents_ray.errors import (
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    MissingCamera,
    VLAgentsError,
)
from vlagents_ray.images.codecs import JPEG, RAW, ImageCodec
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.frame_layout import Buffer, pack
from vlagents_ray.protocol.frames import decode_replies, encode_replies, encode_requests
from vlagents_ray.protocol.json_messages import request_from_parts
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    INNER_OPS,
    OPS,
    Budget,
    MessageLimits,
    Reply,
    Request,
)


def decode_request(frame: Buffer, limits: MessageLimits = DEFAULT_LIMITS) -> Request:
    """Return the only request of a frame, or raise the reason of its rejection."""
    [request] = read_requests(frame, Budget(limits))
    if isinstance(request, Reply):
        assert request.error is not None
        raise request.error
    return request


names = st.text(min_size=1, max_size=8).filter(lambda name: name != "$" and name.isprintable())
arrays = hnp.arrays(
    dtype=st.sampled_from([np.dtype(t) for t in ("?", "u1", "i2", "i4", "i8", "f2", "f4", "f8")]),
    shape=hnp.array_shapes(min_dims=0, max_dims=3, max_side=5),
)
leaves = (
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats() | st.text(max_size=10)
)
infos = st.dictionaries(
    names,
    st.recursive(
        leaves | st.binary(max_size=20) | arrays,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
        max_leaves=10,
    ),
    max_size=4,
)
observations = st.builds(
    Obs,
    cameras=st.dictionaries(
        names,
        hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))),
        max_size=3,
    ),
    gripper=st.none() | st.floats(0, 1),
    state=st.dictionaries(names, hnp.arrays(np.float32, st.integers(0, 9)), max_size=3),
    info=infos,
)


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        if not (isinstance(a, np.ndarray) and isinstance(b, np.ndarray)):
            return False
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return isinstance(b, (list, tuple)) and len(a) == len(b) and all(map(same, a, b))
    # NaN, which is not equal to itself
    return type(a) is type(b) and (a == b or repr(a) == repr(b) == "nan")


# Names of the method's own parameters are not accepted as options of a reset.
reset_options = infos.filter(lambda options: not {"self", "obs", "instruction"} & options.keys())


@given(observations, st.none() | st.text(max_size=20), reset_options)
def test_a_request_comes_back_as_it_was(obs: Obs, instruction: str | None, kwargs: dict) -> None:
    sent = Request("reset", obs, instruction, kwargs, request_id="r1", deadline_ms=20.0)
    got = decode_request(encode_requests([sent], RAW))
    assert (got.op, got.instruction, got.request_id, got.deadline_ms) == (
        "reset",
        instruction,
        "r1",
        20.0,
    )
    assert got.obs is not None
    for part in ("cameras", "gripper", "state", "info"):
        assert same(getattr(obs, part), getattr(got.obs, part)), part
    assert same(kwargs, got.kwargs)


@given(hnp.arrays(np.float32, hnp.array_shapes(min_dims=1, max_dims=2)), st.booleans(), infos)
def test_a_reply_comes_back_as_it_was(action: np.ndarray, done: bool, info: dict) -> None:
    got = decode_replies(
        encode_replies([Reply("r1", Act(action, done, info), timing={"queue_ms": 0.5})])
    )[0]
    assert same(action, got.act.action)
    assert (got.request_id, got.act.done, got.timing) == ("r1", done, {"queue_ms": 0.5})
    assert same(info, got.act.info)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf"), np.float32("nan")])
def test_the_header_is_json_for_every_parser_though_a_policy_says_nan(value: float) -> None:
    frame = encode_replies([Reply("r1", Act(np.zeros(2, np.float32), info={"loss": [value]}))])
    header = frame[8 : 8 + struct.unpack("<I", frame[4:8])[0]]
    json.loads(header, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    got = decode_replies(frame)[0].act
    assert same(got.info["loss"], [float(value)])


def test_a_step_is_text_since_some_parsers_round_it() -> None:
    step = 2**61 + 1
    for frame in (
        encode_requests([Request("act", Obs(), step=step)]),
        encode_replies([Reply("r1", info={}, step=step)]),
    ):
        assert json.loads(frame[8 : 8 + struct.unpack("<I", frame[4:8])[0]])["step"] == str(step)
        assert (
            decode_request(frame) if b'"op"' in frame else decode_replies(frame)[0]
        ).step == step
    assert decode_request(b"".join(pack({"op": "act", "obs": {}, "step": "3"}, []))).step == 3
    for wrong in (3, "x", "-1", "1.5", "\u00b2", "1" * 99, 2.0, -1, True, []):
        with pytest.raises(MalformedMessage, match="step"):
            decode_request(b"".join(pack({"op": "act", "obs": {}, "step": wrong}, [])))


def test_a_number_that_is_none_of_three_is_malformed() -> None:
    for name in ("NaN", "1.5", "infinity", 3):
        header = {"op": "act", "obs": {"info": {"x": {"$": ["float", name]}}}}
        with pytest.raises(MalformedMessage, match="reference"):
            decode_request(b"".join(pack(header, [])))


def test_half_of_a_surrogate_pair_is_malformed() -> None:
    whole = {"op": "reset", "obs": {}, "instruction": "\U0001f916"}
    assert decode_request(b"".join(pack(whole, []))).instruction == "\U0001f916"
    with pytest.raises(MalformedMessage, match="surrogates"):
        decode_request(b"".join(pack(whole | {"instruction": "\ud83e"}, [])))


def test_an_error_comes_back_as_its_own_class() -> None:
    got = decode_replies(
        encode_replies([Reply("r1", error=MissingCamera("wrist", have=["front"]))])
    )[0]
    assert type(got.error) is MissingCamera
    assert "wrist" in str(got.error)


def test_encoding_leaves_the_observation_alone() -> None:
    image = np.zeros((8, 8, 3), np.uint8)
    obs = Obs({"front": image}, state={"joints": np.zeros(3)})
    encode_requests([Request("act", obs)], JPEG)
    assert obs.cameras["front"] is image
    assert obs.state["joints"].dtype == np.float64


def test_jpeg_is_close_and_smaller() -> None:
    y, x = np.mgrid[0:64, 0:64]
    image = np.stack([x * 4, y * 4, (x + y) * 2], axis=-1).astype(np.uint8)
    request = Request("act", Obs({"front": image}))
    frame = encode_requests([request], ImageCodec("jpeg", quality=90))
    got = decode_request(frame).obs
    assert len(frame) < len(encode_requests([request], RAW)) / 2
    assert np.abs(got.cameras["front"].astype(int) - image).mean() < 3


@settings(max_examples=many(300))
@given(st.binary(max_size=200))
@example(b"VLA\x01\x00\x00\x00\x00")
def test_garbage_is_refused_by_name(data: bytes) -> None:
    with pytest.raises(InvalidInput):
        decode_request(data)
    with pytest.raises(InvalidInput):
        decode_request(b"VLA\x01" + data)


def test_a_damaged_frame_is_refused_or_harmless_and_a_truncated_one_malformed() -> None:
    frames = [frame.data for frame in golden.frames() if frame.kind == "requests"]
    for frame in frames:
        for end in range(len(frame)):
            with pytest.raises(MalformedMessage):
                read_requests(frame[:end], Budget(DEFAULT_LIMITS))
    choose, refused, sent = random.Random(0), 0, many(5000)
    for _ in range(sent):
        try:
            [answer, *_] = read_requests(
                mutated(choose, choose.choice(frames)), Budget(DEFAULT_LIMITS)
            )
        except VLAgentsError:
            refused += 1  # rejected with a named error; any other error fails the test
            continue
        refused += isinstance(answer, Reply)
    assert sent / 3 < refused < sent


def _frame(header: dict, *blobs: bytes) -> bytes:
    head = json.dumps({**header, "blobs": [len(b) for b in blobs]}).encode()
    frame = struct.pack("<3sBI", b"VLA", 1, len(head)) + head
    for blob in blobs:
        frame += b"\0" * (-len(frame) % 8) + blob
    return frame


@pytest.mark.parametrize(
    ("header", "blobs", "error"),
    [
        ({"op": "act"}, (), MalformedMessage),  # without an observation
        ({"op": "fly", "obs": {}}, (), MalformedMessage),
        ({"op": "act", "obs": {}, "extra": 1}, (), MalformedMessage),
        ({"op": "act", "obs": {"camera": {}}}, (), MalformedMessage),
        (
            {"op": "act", "obs": {"cameras": {"a": {"$": ["nd", 0, "|O", [1]]}}}},
            (b"x",),
            MalformedMessage,
        ),
        (
            {"op": "act", "obs": {"cameras": {"a": {"$": ["nd", 0, "|u1", [2, 2, 3]]}}}},
            (b"x" * 11,),
            MalformedMessage,
        ),
        (
            {"op": "act", "obs": {"cameras": {"a": {"$": ["nd", 0, "|u1", [3, 4]]}}}},
            (b"x" * 12,),
            InvalidObservation,
        ),
        (
            {"op": "act", "obs": {"cameras": {"a": {"$": ["nd", 7, "|u1", [1]]}}}},
            (b"x",),
            MalformedMessage,
        ),
        (
            {"op": "act", "obs": {"cameras": {"a": {"$": ["img", 0]}}}},
            (b"not an image",),
            MalformedMessage,
        ),
        ({"op": "act", "obs": {"state": {"joints": ["a"]}}}, (), InvalidObservation),
        ({"op": "act", "obs": {"state": {"joints": [[1.0]]}}}, (), InvalidObservation),
        ({"op": "act", "obs": {"state": {"joints": 1}}}, (), InvalidObservation),
        ({"op": "act", "obs": {"gripper": "open"}}, (), InvalidObservation),
        ({"op": "act", "obs": {}, "deadline_ms": -1}, (), MalformedMessage),
        ({"op": "act", "obs": {}, "instruction": 3}, (), MalformedMessage),
        ({"op": "act", "obs": {"cameras": {str(i): 0 for i in range(99)}}}, (), MessageTooLarge),
        ({"op": "act", "obs": {"state": {"joints": [0.0] * 5000}}}, (), MessageTooLarge),
        ({"op": "act", "obs": {"info": {"a": [[[[[[[[[[1]]]]]]]]]]}}}, (), MessageTooLarge),
        ({"op": "act", "obs": {"info": {"a": [0] * 20_000}}}, (), MessageTooLarge),
        ({"op": "reset", "obs": {}, "instruction": "x" * 100_000}, (), MessageTooLarge),
    ],
)
def test_each_fault_has_its_error(
    header: dict, blobs: tuple[bytes, ...], error: type[Exception]
) -> None:
    with pytest.raises(error):
        decode_request(_frame(header, *blobs))


@pytest.mark.parametrize(
    "act", [3, {}, {"action": {"$": ["nd", 0, "<f4", [1]]}}, {"action": 1, "done": 1, "info": {}}]
)
def test_a_broken_reply_is_malformed(act: object) -> None:
    with pytest.raises(MalformedMessage):
        decode_replies(_frame({"act": act}, b"1234"))[0]


@pytest.mark.parametrize("field", ["request_id", "info", "step", "draining", "timing"])
@pytest.mark.parametrize("kind", ["info", "error", "act"])
def test_a_field_that_a_reply_leaves_out_has_its_default(kind: str, field: str) -> None:
    act = {"action": {"$": ["nd", 0, "<f4", [1]]}, "done": False, "info": {}}
    of_kind: dict[str, object] = {"error": {"code": "not_reset", "detail": "reset it"}, "act": act}
    whole = {
        "request_id": "r",
        "info": {"a": 1},
        "step": "3",
        "draining": True,
        "timing": {"queue_ms": 1.0},
    }
    if kind in of_kind:
        whole[kind] = of_kind[kind]
    part = {name: value for name, value in whole.items() if name != field}

    (expected,) = decode_replies(_frame(whole, b"1234"))
    (reply,) = decode_replies(_frame({"replies": [part]}, b"1234"))

    default = Reply("", info=expected.info if kind != "info" else {})
    for name in ("request_id", "info", "step", "draining", "timing"):
        wanted = default if name == field else expected
        assert getattr(reply, name) == getattr(wanted, name), name
    assert type(reply.error) is type(expected.error)
    assert (reply.act is None) is (expected.act is None)


def test_pixels_are_limited_before_memory_is_taken() -> None:
    jpeg = bytearray(
        encode_requests([Request("act", Obs({"a": np.zeros((8, 8, 3), np.uint8)}))], JPEG)
    )
    at = jpeg.index(b"\xff\xc0")  # start of frame: length, precision, height, width
    jpeg[at + 5 : at + 9] = struct.pack(">HH", 60_000, 60_000)
    with pytest.raises(MessageTooLarge, match="60000x60000"):
        decode_request(bytes(jpeg))


IMAGE_NODE, BYTES_NODE = {"$": ["img", 0]}, {"$": ["bin", 1]}


@pytest.mark.parametrize(
    "requests",
    [
        [{"op": "act", "obs": {"cameras": {"a": IMAGE_NODE}}}] * 400,
        [{"op": "act", "obs": {"info": {"a": [IMAGE_NODE] * 400}}}],
        [{"op": "act", "obs": {"info": {"a": [BYTES_NODE] * 1500}}}],
    ],
)
def test_a_small_file_that_is_named_again_and_again_does_not_become_much_memory(
    requests: list[dict],
) -> None:
    limits = MessageLimits(
        body_bytes=100_000, pixels=256 * 256, cameras=2, decoded_bytes=10_000_000
    )
    file = encode_jpeg(np.zeros((256, 256, 3), np.uint8))
    frame = b"".join(pack({"requests": requests}, [file, bytes(50_000)]))
    tracemalloc.start()
    answers = read_requests(frame, Budget(limits))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    if len(requests) == 1:
        assert isinstance(answers[-1], Reply)
        assert isinstance(answers[-1].error, MessageTooLarge)
    assert peak < 50 * limits.body_bytes  # 750 without a limit


def test_images_of_as_many_requests_as_a_frame_may_hold_are_decoded() -> None:
    seen = [Obs({"front": np.zeros((224, 224, 3), np.uint8)})] * DEFAULT_LIMITS.requests
    answers = read_requests(
        encode_requests([Request("act", obs) for obs in seen], JPEG), Budget(DEFAULT_LIMITS)
    )
    assert all(isinstance(answer, Request) for answer in answers)


@pytest.mark.parametrize(("values", "reason"), [(300_000, "values"), (1_000_000, "bytes of JSON")])
def test_a_long_header_is_refused_unread(values: int, reason: str) -> None:
    header = b'{"op":"act","blobs":[],"obs":{"info":{"a":[' + b"[]," * values + b"1]}}}"
    tracemalloc.start()
    with pytest.raises(MessageTooLarge, match=reason):
        read_requests(b"VLA\x01" + struct.pack("<I", len(header)) + header, Budget(DEFAULT_LIMITS))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5 * len(header)


def test_a_body_over_the_limit_is_too_large() -> None:
    frame = encode_requests([Request("act", Obs({"a": np.zeros((64, 64, 3), np.uint8)}))])
    with pytest.raises(MessageTooLarge, match="expected at most 4096 bytes"):
        decode_request(frame, MessageLimits(body_bytes=4096))


@pytest.mark.parametrize("value", [object(), {1: 2}, {"$": 1}, np.array(["text"]), np.array([1j])])
def test_what_the_wire_cannot_carry_is_named_by_the_sender(value: object) -> None:
    with pytest.raises(InvalidInput):
        encode_requests([Request("act", Obs(info={"x": value}))])


@settings(max_examples=many(30))
@given(st.lists(observations, min_size=1, max_size=4))
def test_requests_that_share_a_frame_come_back_in_order(seen: list[Obs]) -> None:
    sent = [
        Request("act", obs, session=f"s{i}", priority="simulation", step=i, request_id=f"r{i}")
        for i, obs in enumerate(seen)
    ]
    got = read_requests(encode_requests(sent), Budget(DEFAULT_LIMITS))
    assert len(got) == len(sent)
    for i, (one, obs) in enumerate(zip(got, seen, strict=True)):
        assert isinstance(one, Request)
        assert (one.session, one.priority, one.step, one.request_id) == (
            f"s{i}",
            "simulation",
            i,
            f"r{i}",
        )
        assert same(obs.cameras, one.obs.cameras)
        assert same(obs.info, one.obs.info)


def test_a_wrong_request_in_a_frame_is_answered_alone() -> None:
    good, bad = Request("act", Obs(), request_id="a"), Request("act", None, request_id="b")
    got = read_requests(encode_requests([good, bad, good]), Budget(DEFAULT_LIMITS))
    assert [type(one) for one in got] == [Request, Reply, Request]
    assert isinstance(got[1], Reply)
    assert (got[1].request_id, type(got[1].error)) == ("b", MalformedMessage)


def test_replies_that_share_a_frame_come_back_in_order() -> None:
    sent = [
        Reply("a", Act(np.ones(3)), step=4),
        Reply("b", error=MissingCamera("wrist", have=[])),
        Reply("c", info={}),
    ]
    sent[0].draining = True
    got = decode_replies(encode_replies(sent))
    assert [reply.request_id for reply in got] == ["a", "b", "c"]
    assert (got[0].step, got[0].draining, got[1].draining) == (4, True, False)
    assert type(got[1].error) is MissingCamera


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"priority": "king"}, MalformedMessage),
        ({"step": -1}, MalformedMessage),
        ({"step": True}, MalformedMessage),
        ({"session": "x" * 200}, MessageTooLarge),
        ({"session": 7}, MalformedMessage),
        ({"history": {"a": 1}}, MalformedMessage),
        ({"prepared": 1}, MalformedMessage),  # only a replica may name a stored observation
        ({"history": [{}] * 300}, MessageTooLarge),
        *(
            ({"op": of_a_replica}, MalformedMessage)
            for of_a_replica in sorted({*INNER_OPS} - {*OPS})
        ),  # two of the files contain pickles
    ],
)
def test_fields_of_a_request_are_checked(change: dict, error: type[VLAgentsError]) -> None:
    frame = b"".join(pack({"op": "act", "obs": {}, **change}, []))
    with pytest.raises(error):
        decode_request(frame)


@pytest.mark.parametrize("requests", [{}, [], [1], None])
def test_a_frame_of_requests_is_a_list(requests: object) -> None:
    with pytest.raises(MalformedMessage):
        read_requests(b"".join(pack({"requests": requests}, [])), Budget(DEFAULT_LIMITS))
    with pytest.raises(MessageTooLarge):
        read_requests(b"".join(pack({"requests": [{}] * 5}, [])), Budget(MessageLimits(requests=4)))


@pytest.mark.parametrize(
    "name", ["a b", "a\nERROR forged", "a\x1b[2K", "é", "a\u2028b", "\x7f", "\0"]
)
@pytest.mark.parametrize("field", ["request_id", "session"])
def test_names_forge_no_line_in_a_log(field: str, name: str) -> None:
    [reply] = read_requests(
        encode_requests([Request("close", **{field: name})]), Budget(DEFAULT_LIMITS)
    )
    assert isinstance(reply, Reply)
    assert isinstance(reply.error, MalformedMessage)
    assert reply.request_id == ""
    with pytest.raises(MalformedMessage):
        request_from_parts("close", json.dumps({field: name}).encode(), {}, Budget(DEFAULT_LIMITS))
