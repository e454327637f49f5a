"""A replica that is frozen and continues: requests that clients abandoned in the meantime are not
executed, over any transport.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Iterator

import pytest
from dialect_server import image
from eval_fakes import wait_for
from leaving_clients import (
    ACTED,
    BOUND_S,
    CLIENTS,
    GATEWAYS,
    HELD,
    LIMITS,
    OTHERS,
    GatedPolicy,
    LeavingClient,
    StoppableServer,
)

from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.pauses import PauseDetector
from vlagents_ray.serve.replica.replica import answer_frame

# A gateway is a client of the replica. The replica does not know the gateway's own clients.
REPLICA_CLIENTS = [name for name in CLIENTS if name not in GATEWAYS]
BRIGHTNESS = 3  # brightness of the picture in the abandoned act
SENT_S = 0.1  # time after which a client on another thread has sent its act
READ_S = 0.5  # time after which a replica that continues has read the act


@pytest.fixture
def server() -> Iterator[StoppableServer]:
    with contextlib.ExitStack() as stack:
        server = StoppableServer(stack)
        stack.callback(server.policy.gate.set)
        yield server


def acts_of_others(server: StoppableServer) -> None:
    """Let the policy execute all waiting requests, and then an act of another client."""
    for op in ("reset", "act"):
        server.ask(OTHERS[1], op)


@pytest.mark.slow
@pytest.mark.parametrize("name", REPLICA_CLIENTS)
def test_an_act_that_was_abandoned_while_the_replica_was_frozen_is_not_executed(
    server: StoppableServer, name: str
) -> None:
    client: LeavingClient = CLIENTS[name](server)
    queued = len(server.queued)
    continues = server.freeze()
    client.send(BRIGHTNESS)
    time.sleep(SENT_S)
    client.leave()
    continues.set()

    # The replica may also read first that the client has left.
    with contextlib.suppress(AssertionError, TimeoutError):
        wait_for(lambda: len(server.queued) > queued, READ_S)
    acts_of_others(server)
    assert BRIGHTNESS not in server.policy.acted


@pytest.mark.slow
@pytest.mark.parametrize("name", REPLICA_CLIENTS)
def test_an_act_whose_client_waits_is_executed_when_the_replica_continues(
    server: StoppableServer, name: str
) -> None:
    client: LeavingClient = CLIENTS[name](server)
    continues = server.freeze()
    client.send(BRIGHTNESS)
    time.sleep(SENT_S)
    continues.set()
    assert client.answer() == ACTED
    assert server.policy.acted.count(BRIGHTNESS) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", REPLICA_CLIENTS)
def test_an_act_that_was_abandoned_in_the_queue_is_not_executed(
    server: StoppableServer, name: str
) -> None:
    """The replica had read the act before it was frozen."""
    client: LeavingClient = CLIENTS[name](server)
    server.hold_policy()
    queued = len(server.queued)
    client.send(BRIGHTNESS)
    wait_for(lambda: len(server.queued) > queued, BOUND_S)
    continues = server.freeze()
    client.leave()
    server.policy.gate.set()
    continues.set()
    acts_of_others(server)
    assert BRIGHTNESS not in server.policy.acted


@pytest.mark.parametrize("name", [name for name in REPLICA_CLIENTS if name.startswith("POST")])
def test_a_session_over_http_outlives_the_connection_of_its_earlier_requests(
    server: StoppableServer, name: str
) -> None:
    """Whether a client has left is judged by the connection of the request itself."""
    CLIENTS[name](server).leave()
    client = CLIENTS[name](server)
    client.send(BRIGHTNESS)
    assert client.answer() == ACTED


class Handle:
    """An engine whose clients call it over a Serve handle, with a simulated clock for its
    pauses.
    """

    def __init__(self) -> None:
        self.now = 100.0
        self.policy = GatedPolicy()
        self.policy.gate.set()
        self.engine = Engine(self.policy)
        self.engine.start()
        self.engine.pauses.stop()
        self.engine.pauses = PauseDetector(lambda: self.now)
        self.engine.pauses.check()

    def call(self, op: str, brightness: int, pause: float = 0.0) -> str | float:
        """Return "acted", the code of an error, or the number of a pause."""
        frame = encode_requests([Request(op, Obs({"front": image(brightness)}))])  # type: ignore[arg-type]
        answer = asyncio.run(answer_frame(self.engine, LIMITS, "robot", frame, pause))
        if isinstance(answer, float):
            return answer
        error = decode_replies(answer)[0].error
        return ACTED if error is None else error.code

    def pass_time(self, seconds: float, *, checked: bool = True) -> None:
        """Let time pass. More than 0.3 s without a check count as a pause of the process."""
        self.now += seconds
        if checked:
            self.engine.pauses.check()


@pytest.fixture
def handle() -> Iterator[Handle]:
    handle = Handle()
    yield handle
    handle.policy.gate.set()
    handle.engine.close()


@pytest.mark.parametrize("is_recorded", [False, True], ids=["at once", "later"])
def test_over_a_handle_a_call_after_a_pause_is_executed_if_it_names_the_pause(
    handle: Handle, is_recorded: bool
) -> None:
    """A call that does not name the pause may belong to a client that has left."""
    assert handle.call("reset", 1) == ACTED
    handle.pass_time(7.0, checked=is_recorded)
    pause = handle.call("act", BRIGHTNESS)
    assert isinstance(pause, float)
    assert handle.policy.acted == []
    handle.pass_time(0.1)
    assert handle.call("act", BRIGHTNESS, pause) == ACTED
    assert handle.policy.acted == [BRIGHTNESS]


def test_over_a_handle_a_call_that_names_an_earlier_pause_may_have_waited_in_the_next_one(
    handle: Handle,
) -> None:
    assert handle.call("reset", 1) == ACTED
    handle.pass_time(7.0)
    first = handle.call("act", BRIGHTNESS)
    handle.pass_time(7.0)
    second = handle.call("act", BRIGHTNESS, first)  # type: ignore[arg-type]
    assert isinstance(second, float)
    assert second != first
    assert handle.policy.acted == []
    assert handle.call("act", BRIGHTNESS, second) == ACTED


def test_over_a_handle_calls_need_no_number_long_after_a_pause(handle: Handle) -> None:
    assert handle.call("reset", 1) == ACTED
    handle.pass_time(7.0)
    for _ in range(60):
        handle.pass_time(0.1)
    assert handle.call("act", BRIGHTNESS) == ACTED


def test_over_a_handle_an_act_that_was_abandoned_in_the_queue_is_not_executed(
    handle: Handle,
) -> None:
    assert handle.call("reset", 1) == ACTED
    handle.policy.gate.clear()
    answers: dict[int, str | float] = {}

    def act(brightness: int) -> None:
        answers[brightness] = handle.call("act", brightness)

    acting = [threading.Thread(target=act, args=(number,)) for number in (HELD, BRIGHTNESS)]
    acting[0].start()
    assert handle.policy.entered.wait(BOUND_S)
    acting[1].start()
    wait_for(lambda: handle.engine.queue.depth() == 1, BOUND_S)
    handle.pass_time(7.0, checked=False)
    handle.policy.gate.set()
    for thread in acting:
        thread.join()
    assert answers[HELD] == ACTED
    assert isinstance(answers[BRIGHTNESS], float)
    assert handle.policy.acted == [HELD]
