"""Acts without headers: decoding restores the encoded values, and rejects everything else."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test
from many import many

from vlagents_ray.errors import InvalidInput, MalformedMessage, PolicyFailed
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol import compact
from vlagents_ray.protocol.compact import (
    ANSWER,
    COUNT,
    ITEM,
    CompactReader,
    CompactWriter,
    Written,
    read_answers,
    write_answers,
)
from vlagents_ray.protocol.messages import MessageLimits, Reply, Request

images = hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)))
states = hnp.arrays(np.float32, st.integers(0, 9), elements=st.floats(-1e6, 1e6, width=32))
names = st.text(st.characters(codec="utf-8"), min_size=1, max_size=8).filter(str.isprintable)
observations = st.builds(
    Obs,
    cameras=st.dictionaries(names, images, max_size=3),
    gripper=st.none() | st.floats(0, 1),
    state=st.dictionaries(names, states, max_size=3),
)


def placed(written: Written) -> np.ndarray:
    memory = np.zeros(written.size, np.uint8)
    for at, array in written.arrays:
        np.ndarray(array.shape, array.dtype, memory.data, at)[...] = array
    memory.flags.writeable = False
    return memory


@given(st.lists(observations, min_size=1, max_size=4), st.none() | st.integers(0, 2**40))
def test_acts_come_back_as_they_were_also_when_their_layout_is_known(
    seen: list[Obs], step: int | None
) -> None:
    sent = [
        Request(
            "act",
            obs,
            session=f"s{i}",
            priority="simulation",
            step=step,
            request_id=f"r{i}",
            deadline_ms=5.0 + i,
        )
        for i, obs in enumerate(seen)
    ]
    writer, reader = CompactWriter(), CompactReader(MessageLimits())
    sizes = []
    for _ in range(2):
        written = writer.write(sent)
        sizes.append(len(written.message))
        for i, (one, obs) in enumerate(
            zip(
                reader.read(memoryview(written.message), placed(written)).requests,
                seen,
                strict=True,
            )
        ):
            assert (one.op, one.session, one.priority, one.step) == (
                "act",
                f"s{i}",
                "simulation",
                step,
            )
            assert (one.request_id, one.deadline_ms) == (f"r{i}", 5.0 + i)
            assert one.obs.gripper == obs.gripper
            for mine, theirs in ((obs.cameras, one.obs.cameras), (obs.state, one.obs.state)):
                assert list(mine) == list(theirs)
                for name, array in mine.items():
                    np.testing.assert_array_equal(array, theirs[name])
                    assert theirs[name].dtype == array.dtype
                    assert not theirs[name].flags.writeable
    assert sizes[1] == COUNT.size + len(seen) * ITEM.size < sizes[0]


def seeing(side: int, session: str = "s") -> Request:
    return Request("act", Obs({"front": np.full((side, side, 3), side, np.uint8)}), session=session)


def test_a_session_may_change_what_it_sees_even_within_a_message() -> None:
    writer, reader = CompactWriter(), CompactReader(MessageLimits())
    for sides in ((4,), (5,), (4,), (4, 5, 4), (6, 6), (4, 4)):
        written = writer.write([seeing(side) for side in sides])
        read = reader.read(memoryview(written.message), placed(written)).requests
        assert [one.obs.cameras["front"].shape[0] for one in read if one.obs] == list(sides)
        assert [one.obs.cameras["front"][0, 0, 0] for one in read if one.obs] == list(sides)


@pytest.mark.parametrize(
    "change",
    [
        {"priority": "simulation"},
        {"session": "other"},
        {"obs": Obs({"hand": np.zeros((4, 4, 3), np.uint8)})},
        {"obs": Obs({"front": np.zeros((4, 4, 3), np.uint8)}, state={"joints": np.zeros(7)})},
        {"obs": Obs()},
    ],
    ids=["priority", "session", "name", "more", "less"],
)
def test_what_is_not_like_the_last_act_has_a_layout_of_its_own(change: dict[str, Any]) -> None:
    writer, reader = CompactWriter(), CompactReader(MessageLimits())
    for request in (seeing(4), replace(seeing(4), **change)):
        written = writer.write([request])
        assert len(written.message) > COUNT.size + ITEM.size
        [read] = reader.read(memoryview(written.message), placed(written)).requests
        assert (read.session, read.priority) == (request.session, request.priority)
        assert (list(read.obs.cameras), list(read.obs.state)) == (
            list(request.obs.cameras),
            list(request.obs.state),
        )


def test_nothing_of_a_message_that_travels_as_a_frame_is_taken_for_known() -> None:
    writer = CompactWriter()
    assert writer.write([seeing(4), Request("reset", Obs())]) is None
    written = writer.write([seeing(4)])
    assert (
        len(
            CompactReader(MessageLimits())
            .read(memoryview(written.message), placed(written))
            .requests
        )
        == 1
    )


@pytest.mark.parametrize(
    "request_",
    [
        Request("reset", Obs()),
        Request("act", Obs(info={"value": 1})),
        Request("act", Obs(gripper=float("nan"))),
        Request("act", Obs({"front": np.zeros((4, 4, 3), np.float32)})),
        Request("act", Obs({"front": np.zeros((4, 4), np.uint8)})),
        Request("act", Obs({"front": [[1]]})),  # type: ignore[dict-item]
        Request("act", Obs(state={"joints": np.zeros(3, complex)})),
        Request("act", Obs(), request_id="x" * 41),
    ],
)
def test_what_does_not_fit_travels_as_a_frame(request_: Request) -> None:
    assert CompactWriter().write([Request("act", Obs()), request_]) is None


@given(st.binary(max_size=300))
@example(COUNT.pack(0))
@example(COUNT.pack(2**31) + bytes(ITEM.size))
@example(COUNT.pack(1) + ITEM.pack(0, 2**31, 0, 0.0, 0.0, b"r"))
def test_garbage_is_refused_by_name(data: bytes) -> None:
    with pytest.raises(InvalidInput):
        CompactReader(MessageLimits()).read(memoryview(data), np.zeros(64, np.uint8))


@pytest.mark.parametrize(
    "layout",
    [
        ["s", "king", [], []],
        ["s" * 200, "robot", [], []],
        [1, "robot", [], []],
        ["s", "robot", {}, []],
        ["s", "robot", [["a", [4, 4]]], []],
        ["s", "robot", [["a", [4, 4, 4]]], []],
        ["s", "robot", [["a", [4, -4, 3]]], []],
        ["s", "robot", [["a", [2**20, 2**20, 3]]], []],
        ["s", "robot", [["a", [400, 400, 3]]], []],  # more than the memory contains
        ["s", "robot", [["a", [4, 4, 3]]] * 17, []],
        ["s", "robot", [], [["a", [10_000]]]],
        ["s", "robot", [], [[["a"], [3]]]],
        ["s", "robot", [[1, 2, 3]], []],
        "robot",
        7,
    ],
)
def test_layouts_are_checked(layout: object) -> None:
    text = json.dumps(layout).encode()
    message = COUNT.pack(1) + ITEM.pack(0, len(text), -1, 1.0, 0.5, b"r") + text
    with pytest.raises(InvalidInput):
        CompactReader(MessageLimits()).read(memoryview(message), np.zeros(4096, np.uint8))


@given(
    st.lists(
        st.tuples(
            hnp.arrays(np.float32, hnp.array_shapes(min_dims=1, max_dims=2)),
            st.booleans(),
            st.booleans(),
        ),
        min_size=1,
        max_size=3,
    )
)
def test_answers_come_back_as_they_were(given_: list[tuple[np.ndarray, bool, bool]]) -> None:
    timing = {"queue_ms": 0.1, "inference_ms": 2.0, "decode_ms": 0.3, "batch_size": 3}
    replies = [
        Reply(f"r{i}", Act(action, done), step=i, timing=dict(timing))
        for i, (action, done, _) in enumerate(given_)
    ]
    for reply, (_, _, draining) in zip(replies, given_, strict=True):
        reply.draining = draining
    data = write_answers(replies, arrived=0.0)
    for i, (got, (action, done, draining)) in enumerate(
        zip(read_answers(memoryview(data)), given_, strict=True)
    ):
        assert got.act.action.tobytes() == action.tobytes()
        assert got.act.action.shape == action.shape
        assert (got.request_id, got.act.done, got.draining, got.step) == (
            f"r{i}",
            done,
            draining,
            i,
        )
        assert got.timing == replies[i].timing
        assert got.timing.keys() >= {"encode_ms", "total_ms"}


def test_an_answer_names_the_weights_that_computed_it_without_a_frame() -> None:
    timing = {"queue_ms": 0.1, "inference_ms": 2.0, "decode_ms": 0.3, "batch_size": 3}
    named = [{"policy": {"version": 2**40, "fingerprint": "0123456789abcdef"}}]
    named += [{"policy": {"version": 0, "fingerprint": ""}}]
    replies = [
        Reply("r", Act(np.zeros(3, np.float32), info=info), step=1, timing=timing) for info in named
    ]
    data = write_answers(replies, arrived=0.0)
    assert [
        reply.act.info for reply in read_answers(memoryview(data)) if reply.act is not None
    ] == named


@pytest.mark.parametrize(
    "policy",
    ["act", {"version": 1}, {"version": 1, "name": "act"}, {"version": "1", "fingerprint": ""}]
    + [{"version": 1, "fingerprint": digest} for digest in (None, "0" * 17, "ü" * 9)]
    + [{"version": number, "fingerprint": ""} for number in (None, 2**63, [1])],
)
def test_what_a_policy_itself_names_so_travels_as_a_frame(policy: Any) -> None:
    timing = {"queue_ms": 0.1, "inference_ms": 2.0, "decode_ms": 0.3, "batch_size": 3}
    act = Act(np.zeros(3, np.float32), info={"policy": policy})
    assert write_answers([Reply("r", act, step=1, timing=timing)], arrived=0.0) is None


def test_answers_with_more_in_them_travel_as_a_frame() -> None:
    timing = {"queue_ms": 0.1, "inference_ms": 2.0, "decode_ms": 0.3, "batch_size": 3}
    good = Reply("r", Act(np.zeros(3, np.float32)), step=1, timing=timing)
    for bad in (
        Reply("r", error=PolicyFailed("no")),
        Reply("r", info={}),
        Reply("r", Act(np.zeros(3, np.float32), info={"a": 1}), timing=timing),
        Reply("r" * 41, Act(np.zeros(3, np.float32)), timing=timing),
    ):
        assert write_answers([good, bad], arrived=0.0) is None
    assert write_answers([good], arrived=0.0) is not None
    with pytest.raises((struct.error, ValueError)):
        read_answers(memoryview(COUNT.pack(1) + bytes(ANSWER.size - 1)))


def test_names_forge_no_line_in_a_log() -> None:
    for names in ({"request_id": "a\nb"}, {"session": "a\nb"}):
        written = CompactWriter().write([Request("act", Obs(), **names)])
        with pytest.raises(MalformedMessage):
            CompactReader(MessageLimits()).read(memoryview(written.message), placed(written))


class WritersAndReaders(RuleBasedStateMachine):
    """One connection with four layouts at most, whose messages may be lost or rejected on either
    side.

    As in `ShmTransport`, a client begins its layouts again if its message was not sent, or was
    rejected before it was read. The server remembers the layouts that it has read.
    """

    def __init__(self) -> None:
        super().__init__()
        self.reconnect()

    @rule()
    def reconnect(self) -> None:
        self.writer, self.reader = CompactWriter(), CompactReader(MessageLimits(requests=8))

    def written(
        self, sides: list[int], sessions: list[int]
    ) -> tuple[list[Request], Written | None]:
        requests = [
            seeing(side, f"s{session}") for side, session in zip(sides, sessions, strict=False)
        ]
        return requests, self.writer.write(requests)

    @rule(
        sides=st.lists(st.integers(1, 3), min_size=1, max_size=3),
        sessions=st.lists(st.integers(0, 4), min_size=3),
    )
    def act(self, sides: list[int], sessions: list[int]) -> None:
        requests, written = self.written(sides, sessions)
        if written is None:
            return  # sent as a frame
        read = self.reader.read(memoryview(written.message), placed(written)).requests
        assert [request.session for request in read] == [request.session for request in requests]
        for sent, got in zip(requests, read, strict=True):
            np.testing.assert_array_equal(got.obs.cameras["front"], sent.obs.cameras["front"])
        assert len(self.reader._known) <= 4

    @rule(
        sides=st.lists(st.integers(1, 3), min_size=1, max_size=3),
        sessions=st.lists(st.integers(0, 4), min_size=3),
    )
    def send_in_vain(self, sides: list[int], sessions: list[int]) -> None:
        """Write a message that is over the rate, or that is not sent in time."""
        self.written(sides, sessions)
        self.writer = CompactWriter()

    @rule(side=st.integers(1, 3), session=st.integers(0, 4))
    def be_refused_behind_the_layout(self, side: int, session: int) -> None:
        """Write a message whose second act is wrong: the server has read the layout of the first
        act, and the client starts over.
        """
        _, written = self.written([side], [session])
        if written is None:
            return
        count, rest = COUNT.pack(2), written.message[COUNT.size :]
        wrong = ITEM.pack(9, 0, -1, float("nan"), float("nan"), b"")
        message = count + rest[: ITEM.size] + wrong + rest[ITEM.size :]
        with pytest.raises(InvalidInput):
            self.reader.read(memoryview(message), placed(written))
        self.writer = CompactWriter()


@pytest.fixture(autouse=True)
def few_layouts(request: pytest.FixtureRequest) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if "layout" in request.node.name:
            patch.setattr(compact, "_MAX_LAYOUTS", 4)
        yield


def test_a_writer_and_a_reader_agree_on_layouts_whatever_was_lost_or_refused() -> None:
    run_state_machine_as_test(
        WritersAndReaders, settings=settings(max_examples=many(60), deadline=None)
    )


def test_a_reader_takes_no_layout_beyond_the_limit_and_no_message_of_too_many_acts() -> None:
    reader = CompactReader(MessageLimits(requests=2))
    text = json.dumps(["s", "robot", [], []]).encode()
    item = ITEM.pack(4, len(text), -1, float("nan"), float("nan"), b"")
    with pytest.raises(InvalidInput, match="below 4"):
        reader.read(memoryview(COUNT.pack(1) + item + text), np.zeros(64, np.uint8))
    with pytest.raises(InvalidInput, match="at most 2 acts in one message, got 3"):
        reader.read(memoryview(COUNT.pack(3) + item * 3 + text), np.zeros(64, np.uint8))


@pytest.mark.parametrize("name", ["", "x" * 129, "a\nb", "x" * 100_000])
def test_names_have_the_limits_of_a_frame_in_layouts_also(name: str) -> None:
    """1,024 layouts with names as long as a message would take 256 MB."""
    text = json.dumps(["s", "robot", [], [[name, [1]]]]).encode()
    item = ITEM.pack(0, len(text), -1, float("nan"), float("nan"), b"")
    with pytest.raises(InvalidInput, match="named"):
        CompactReader(MessageLimits()).read(
            memoryview(COUNT.pack(1) + item + text), np.zeros(64, np.uint8)
        )
