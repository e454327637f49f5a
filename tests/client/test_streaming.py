"""`RemoteAgent.act_stream`, over each transport that can be served without Ray."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from streaming_agents import ROWS, InParts

from vlagents_ray import Act, Agent, ConnectionLost, DeadlineExceeded, Obs, PolicyFailed, RemoteAgent
from vlagents_ray.chunking.background import parts_of
from vlagents_ray.client import connection as connection_module
from vlagents_ray.errors import MalformedMessage, NotReset
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, Limits, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.endpoints.websocket import WebSocketServer
from vlagents_ray.serve.engine.engine import Engine

WAYS = ("shm", "websocket", "proxied", "http")
IN_PARTS = WAYS[:3]
Serve = Callable[..., RemoteAgent]


@pytest.fixture
def serving() -> Iterator[Serve]:
    """Serves a policy and returns a client that reaches it in one of `WAYS`."""
    with contextlib.ExitStack() as stack:

        def serve(policy: Agent, way: str, **options: Any) -> RemoteAgent:
            engine = Engine(policy)
            local = ShmServer(engine, Limits(), NoKey.OPEN)
            port = WebSocketServer(engine, Limits(), "127.0.0.1", None, NoKey.OPEN)
            for endpoint in (local, port):
                endpoint.open()
                stack.callback(endpoint.close)

            def metadata() -> dict[str, Any]:
                found: dict[str, Any] = {"protocol": PROTOCOL_VERSION, "act_parts": engine.models.act_parts}
                found["continues_plans"] = engine.models.continues_plans
                found["contract"] = None if engine.contract is None else engine.contract.to_json()
                found["local"] = asdict(local.address) if way == "shm" else None
                found["stream"] = asdict(port.address) if way == "websocket" else None
                return found

            engine.start()
            stack.callback(engine.close)
            app = AccessMiddleware(build_http_app(engine, metadata, Limits()), None, "app")
            url = f"http://127.0.0.1:{stack.enter_context(served(app))}"
            transport = "websocket" if way == "proxied" else way
            agent = RemoteAgent(url, transport=transport, codec="raw", **options)  # type: ignore[arg-type]
            stack.callback(agent.close)
            agent.reset(Obs(info={"value": 0.0}), "task")
            return agent

        yield serve


def rows(parts: list[Act]) -> list[list[float]]:
    return np.concatenate([part.rows() for part in parts]).tolist()


@pytest.mark.parametrize("way", IN_PARTS)
def test_the_rows_come_one_by_one(way: str, serving: Serve) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    stream = None
    agent = serving(policy, way)
    assert (agent.act_parts, agent.continues_plans) == ("exact", True)
    stream = agent.act_stream(Obs(info={"value": 5.0, "done": True}))
    for row in range(ROWS):
        policy.gate.release()
        part = next(stream)
        assert part.rows().tolist() == [[5.0, row]]
        assert part.more == (row < ROWS - 1)
        assert len(policy.record.computed) == row + 1
    assert part.done
    assert part.info["timing"].keys() >= {"inference_ms", "total_ms", "round_trip_ms", "wire_ms"}
    with pytest.raises(StopIteration):
        next(stream)


@pytest.mark.parametrize("way", WAYS)
def test_acts_in_parts_and_whole_ones_are_one_session(way: str, serving: Serve) -> None:
    agent = serving(InParts(), way)
    for number in range(1, 4):
        parts = list(agent.act_stream(Obs({"front": np.zeros((32, 32, 3), np.uint8)}, info={"value": number})))
        assert len(parts) == (ROWS if way in IN_PARTS else 1)
        assert rows(parts) == [[number, row] for row in range(ROWS)]
        whole = agent.act(Obs(info={"value": number}))
        assert rows([whole]) == rows(parts)
        assert whole.info["acts"] == 2 * number
        assert "resumed" not in whole.info


@pytest.mark.parametrize("way", IN_PARTS)
def test_a_policy_without_parts_gives_the_whole_chunk(way: str, serving: Serve) -> None:
    policy = InParts()
    policy.act_parts = None
    agent = serving(policy, way)
    assert agent.act_parts is None
    [part] = agent.act_stream(Obs())
    assert len(part.rows()) == ROWS


@pytest.mark.parametrize("way", IN_PARTS)
def test_an_error_in_the_middle_is_raised_after_the_rows_before_it(way: str, serving: Serve) -> None:
    agent = serving(InParts(), way)
    stream = agent.act_stream(Obs(info={"fail_at": 2}))
    assert rows([next(stream), next(stream)]) == [[0.0, 0.0], [0.0, 1.0]]
    with pytest.raises(PolicyFailed):
        next(stream)
    assert len(list(agent.act_stream(Obs()))) == ROWS  # the session goes on


@pytest.mark.parametrize("way", IN_PARTS)
def test_a_caller_that_stops_early_can_act_again(way: str, serving: Serve) -> None:
    agent = serving(InParts(), way)
    stream = agent.act_stream(Obs(info={"value": 1.0}))
    next(stream)
    stream.close()
    again = agent.act(Obs(info={"value": 2.0}))
    assert rows([again]) == [[2.0, row] for row in range(ROWS)]
    assert "resumed" not in again.info


@pytest.mark.parametrize("way", IN_PARTS)
def test_the_deadline_of_an_act_covers_all_its_parts(way: str, serving: Serve) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    agent = serving(policy, way)
    policy.gate.release()
    stream = agent.act_stream(Obs(info={"deadline_ms": 2000.0}))
    with contextlib.suppress(DeadlineExceeded):  # a process that was paused may get no part at all
        assert next(stream).more
        with pytest.raises(DeadlineExceeded):
            next(stream)
    policy.gate.release(10 * ROWS)
    agent._connection.timeout_s = 60.0
    assert rows([agent.act(Obs(info={"value": 3.0}))]) == [[3.0, row] for row in range(ROWS)]


@pytest.mark.parametrize("way", ["shm", "websocket"])
def test_a_connection_that_breaks_between_two_parts_is_an_error(way: str, serving: Serve) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    agent = serving(policy, way)
    policy.gate.release()
    stream = agent.act_stream(Obs())
    next(stream)
    agent._connection.transport.close()
    policy.gate.release(10 * ROWS)
    with pytest.raises(ConnectionLost):
        next(stream)
    wait_for(lambda: policy.record.closed != [])
    assert len(list(agent.act_stream(Obs()))) == ROWS  # at another connection, where the session began again


def test_parts_wait_for_a_caller_that_is_busy_with_the_first_ones(serving: Serve) -> None:
    policy = InParts(gated=True)
    assert policy.gate is not None
    agent = serving(policy, "websocket")
    policy.gate.release(ROWS)
    stream = agent.act_stream(Obs())
    taken: queue.SimpleQueue[Act] = queue.SimpleQueue()
    taken.put(next(stream))
    wait_for(lambda: len(policy.record.closed) == 1)  # all parts are on their way
    assert rows([taken.get(), *stream]) == [[0.0, row] for row in range(ROWS)]


@pytest.mark.parametrize("parts", ["exact", None])
def test_in_an_episode_connecting_again_takes_no_longer_than_an_act_may(
    parts: Any, serving: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in `act`; else a control loop would stand still for `connect_timeout_s`."""
    policy = InParts()
    policy.act_parts = parts
    agent = serving(policy, "shm", timeout_s=60.0, connect_timeout_s=1e6)
    connection, limits = agent._connection, list[float | None]()
    connect = connection.open

    def limited(timeout_s: float | None = None) -> None:
        limits.append(timeout_s)
        connect(timeout_s)

    monkeypatch.setattr(connection, "open", limited)
    for ask in (agent.act_stream, partial(parts_of, agent)):
        connection._must_reconnect = True
        assert sum(len(part.rows()) for part in ask(Obs())) == ROWS
    assert len(limits) == 2
    assert all(limit is not None and limit <= 60.0 for limit in limits)


def test_a_replica_that_stops_between_two_parts_is_left_like_one_that_answers_nothing(
    serving: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_module, "SILENT_S", 0.0)
    agent = serving(InParts(), "shm")
    stream = agent.act_stream(Obs())
    next(stream)

    def silent(request: Request, timeout_s: float) -> Reply:
        raise DeadlineExceeded("no answer")

    monkeypatch.setattr(agent._connection.transport, "call_on", silent)
    with pytest.raises(DeadlineExceeded):
        next(stream)
    silent_one = agent._connection.transport
    assert len(list(agent.act_stream(Obs()))) == ROWS
    assert agent._connection.transport is not silent_one


def test_a_server_that_sends_a_part_unasked_is_refused(serving: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rest of the chunk would be missing."""
    agent = serving(InParts(), "shm")
    call = agent._connection.transport.call

    def one_part(requests: Any, timeout_s: float) -> list[Reply]:
        replies = call(requests, timeout_s)
        for reply in replies:
            assert reply.act is not None
            reply.act.more = True
        return replies

    monkeypatch.setattr(agent._connection.transport, "call", one_part)
    with pytest.raises(MalformedMessage, match="want a whole one"):
        agent.act(Obs())


@pytest.mark.parametrize(("resume", "error"), [(True, DeadlineExceeded), (False, NotReset)])
def test_a_session_that_ends_between_two_parts_is_resumed_by_the_next_act(
    resume: bool, error: type[Exception], serving: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that ends before an act: a control loop takes safe actions meanwhile, and goes on."""
    agent = serving(InParts(), "shm", resume=resume)
    stream = agent.act_stream(Obs())
    next(stream)
    ended = Reply(error=NotReset("was closed during its act"))
    monkeypatch.setattr(agent._connection.transport, "call_on", lambda *_: ended)
    with pytest.raises(error):
        next(stream)
