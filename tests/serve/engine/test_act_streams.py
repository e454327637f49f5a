"""Acts that the engine answers in parts."""

from __future__ import annotations

import queue
from collections.abc import Callable, Generator, Iterator
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from streaming_agents import ROWS, InParts, InPartsAtOnce

from vlagents_ray.errors import InvalidAction, NotReset, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.engine.dispatch import Dispatcher
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.responses import ReplyCollector
from vlagents_ray.serve.models import padding


class Caller:
    """A sender with a session, and what it was answered, parts included."""

    def __init__(self, engine: Engine) -> None:
        self.replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        self.dispatcher = Dispatcher(engine, "test", caller=NoKey.OPEN)
        assert self.ask(Request("reset", Obs())).error is None

    def send(self, *requests: Request, takes_parts: bool = True) -> Any:
        return self.dispatcher.send(
            requests,
            lambda replies: [self.replies.put(reply) for reply in replies],
            part=self.replies.put if takes_parts else None,
        )

    def ask(self, request: Request) -> Reply:
        self.send(request)
        return self.next()

    def next(self) -> Reply:
        return self.replies.get(timeout=60)

    def act(self, *, parts: bool = True, takes_parts: bool = True, **info: Any) -> list[Reply]:
        """The replies to an act, up to the last."""
        self.send(Request("act", Obs(info=info), parts=parts), takes_parts=takes_parts)
        replies = [self.next()]
        while replies[-1].act is not None and replies[-1].act.more:
            replies.append(self.next())
        assert self.replies.empty()
        return replies


def rows(replies: list[Reply]) -> list[list[float]]:
    return np.concatenate([reply.act.rows() for reply in replies if reply.act is not None]).tolist()


@pytest.fixture
def serving() -> Iterator[Callable[..., Engine]]:
    engines: list[Engine] = []

    def serve(agent: Agent, **options: Any) -> Engine:
        engines.append(Engine(agent, **options))
        engines[-1].start()
        return engines[-1]

    yield serve
    for engine in engines:
        engine.close()


@pytest.fixture(params=[InParts, InPartsAtOnce])
def policy(request: pytest.FixtureRequest) -> Agent:
    agent: Agent = request.param()
    return agent


def test_the_parts_of_an_act_are_one_step_whose_last_reply_says_the_rest(
    policy: Agent, serving: Callable[..., Engine]
) -> None:
    caller = Caller(serving(policy))
    first, second = caller.act(value=1.0, done=True), caller.act(value=2.0)
    assert rows(first) == [[1.0, row] for row in range(ROWS)]
    assert rows(second) == [[2.0, row] for row in range(ROWS)]
    assert [reply.act.more for reply in first if reply.act] == [True, True, True, False]
    assert [reply.act.done for reply in first if reply.act] == [False, False, False, True]
    assert {reply.step for reply in first} == {second[0].step - 1}  # type: ignore[operator]
    waits = [reply.timing["inference_ms"] for reply in first]
    assert waits == sorted(waits)
    assert all(reply.timing["batch_size"] == 1 for reply in first)
    assert second[-1].act is not None
    assert second[-1].act.info["policy"]["version"] == 0


def test_a_part_is_sent_before_the_next_one_is_computed(serving: Callable[..., Engine]) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    caller = Caller(serving(policy))
    caller.send(Request("act", Obs(), parts=True))
    for row in range(ROWS):
        policy.gate.release()
        assert rows([caller.next()]) == [[0.0, row]]
        assert len(policy.record.computed) == row + 1


@pytest.mark.parametrize(
    "asked",
    [{"parts": False}, {"takes_parts": False}, {"policy": None}],
    ids=["the client does not ask", "the endpoint sends whole chunks", "the policy has no parts"],
)
def test_otherwise_the_chunk_comes_whole(asked: dict[str, Any], serving: Callable[..., Engine]) -> None:
    policy = InParts()
    if "policy" in asked:
        policy.act_parts = asked.pop("policy")
    [reply] = Caller(serving(policy)).act(value=1.0, **asked)
    assert rows([reply]) == [[1.0, row] for row in range(ROWS)]
    assert reply.act is not None
    assert not reply.act.more


def test_a_message_of_several_acts_gets_whole_chunks(serving: Callable[..., Engine]) -> None:
    engine = serving(InParts())
    caller = Caller(engine)
    reset = [Request("reset", Obs(), session=name) for name in "ab"]
    caller.send(*reset)
    assert [caller.next().error for _ in reset] == [None, None]
    caller.send(*(Request("act", Obs(), session=name, parts=True) for name in "ab"))
    assert [len(rows([caller.next()])) for _ in reset] == [ROWS, ROWS]


def test_sessions_of_one_batch_get_their_own_parts(serving: Callable[..., Engine]) -> None:
    policy = InPartsAtOnce(gated=True)
    assert policy.gate is not None
    engine = serving(policy)
    callers = [Caller(engine) for _ in range(3)]
    callers[0].send(Request("act", Obs(info={"value": -1.0}), parts=True))
    wait_for(lambda: engine.queue.depth() == 0)  # it keeps the policy while the others queue
    for value, caller in enumerate(callers[1:]):
        caller.send(Request("act", Obs(info={"value": float(value)}), parts=True))
    wait_for(lambda: engine.queue.depth() == 2)
    policy.gate.release(3 * ROWS)
    for value, caller in enumerate(callers[1:]):
        found = [caller.next() for _ in range(ROWS)]
        assert rows(found) == [[value, row] for row in range(ROWS)]
        assert {reply.timing["batch_size"] for reply in found} == {2}


@pytest.mark.parametrize(
    ("info", "error", "given"),
    [
        ({"fail_at": 2}, PolicyFailed, 2),
        ({"fail_at": 0}, PolicyFailed, 0),
        ({"broken_at": 2}, InvalidAction, 2),
        ({"ends_at": 2}, PolicyFailed, 2),
    ],
    ids=["fails", "fails at once", "NaN", "ends without a last part"],
)
def test_an_error_after_some_parts_ends_the_act_which_does_not_count(
    info: dict[str, Any], error: type[Exception], given: int, policy: Agent, serving: Callable[..., Engine]
) -> None:
    caller = Caller(serving(policy))
    before = caller.act()[-1].step
    replies = caller.act(**info)
    assert len(replies) == given + 1
    assert isinstance(replies[-1].error, error)
    assert "secret" not in str(replies[-1].error)
    assert caller.act()[-1].step == before + 1  # type: ignore[operator]


def test_rows_beyond_the_limit_of_a_reply_are_refused_in_all_parts_together(serving: Callable[..., Engine]) -> None:
    row_bytes = np.zeros(2, np.float32).nbytes
    assert len(Caller(serving(InParts(), reply_bytes=ROWS * row_bytes)).act()) == ROWS
    replies = Caller(serving(InParts(), reply_bytes=2 * row_bytes)).act()
    assert len(replies) == 3
    assert "limits.reply_bytes" in str(replies[-1].error)


def test_the_policy_stops_when_no_caller_is_left(serving: Callable[..., Engine]) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    engine = serving(policy)
    caller = Caller(engine)
    collector = caller.send(Request("act", Obs(), parts=True))
    policy.gate.release()
    caller.next()
    collector.cancel()
    policy.gate.release()
    wait_for(lambda: policy.record.closed != [])
    assert policy.record.computed == [0, 1]
    policy.gate.release(ROWS)
    assert len(Caller(engine).act()) == ROWS  # the thread goes on


def test_a_closed_session_stops_its_act(serving: Callable[..., Engine]) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    engine = serving(policy)
    caller = Caller(engine)
    caller.send(Request("act", Obs(), parts=True))
    policy.gate.release()
    caller.next()
    caller.dispatcher.release()
    policy.gate.release()
    assert rows([caller.next()]) == [[0.0, 1.0]]
    assert isinstance(caller.next().error, NotReset)  # and no failure of the policy, for the metrics
    assert policy.record.computed == [0, 1]
    assert policy.record.closed == [1]


def test_a_part_that_comes_after_the_answer_is_not_sent() -> None:
    """As after the deadline, or once the policy counts as hung, on another thread."""
    request = Request("act", Obs(), parts=True)
    sent: list[Reply] = []
    collector = ReplyCollector([request], sent.extend, lambda: False, lambda *_: None)
    collector.part = sent.append
    first, answer, late = Reply(step=1), Reply(step=2), Reply(step=3)
    collector.put_part(first)
    collector.put(0, answer)
    collector.put_part(late)
    assert sent == [first, answer]


def test_with_padded_batches_only_the_sessions_get_parts(serving: Callable[..., Engine]) -> None:
    caller = Caller(serving(InPartsAtOnce(), batch_sizes=[4], max_batch_size=4))
    assert rows(caller.act(value=3.0)) == [[3.0, row] for row in range(ROWS)]


class Padded(InPartsAtOnce):
    """Counts its resets; a session that is not of a caller may fail."""

    shared = (*InPartsAtOnce.shared, "resets", "fails")

    def __init__(self, *, fails: bool) -> None:
        super().__init__()
        self.resets, self.fails = [0], fails

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.resets[0] += 1
        return super().reset(obs, instruction, **kwargs)

    def act_batch_stream(self, obs: Any, sessions: Any) -> Generator[list[Act | Exception | None], None, None]:
        padding = [RuntimeError("broken")] * (len(obs) - 1) if self.fails else [None] * (len(obs) - 1)
        for part in InParts.act_stream(sessions[0], obs[0]):
            yield [part, *padding]


@pytest.mark.parametrize(("fails", "life"), [(True, 1000), (False, 2)])
def test_sessions_of_the_padding_are_replaced_as_without_parts(
    fails: bool, life: int, serving: Callable[..., Engine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A broken one would stay so, and one that lives long would keep every observation."""
    monkeypatch.setattr(padding, "_LIFE", life)
    policy = Padded(fails=fails)
    caller = Caller(serving(policy, batch_sizes=[2], max_batch_size=2))
    caller.act()
    before = policy.resets[0]
    for _ in range(2):
        caller.act()
    assert policy.resets[0] == before + (2 if fails else 1)


def test_an_agent_without_parts_of_its_own_gives_one() -> None:
    class Whole(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(np.zeros((2, 3), np.float32), done=True)

    [part] = Whole().act_stream(Obs())
    assert part.action.shape == (2, 3)
    assert part.done
    assert not part.more
