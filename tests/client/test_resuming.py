"""A session that survives the loss of its replica, and many sessions over one connection, without
Ray or sockets.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from eval_fakes import SimulatedTime
from in_flight import pending
from in_process_replicas import InProcess, Replicas

from vlagents_ray import (
    Act,
    Agent,
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    InvalidObservation,
    NotReset,
    Obs,
    PolicyFailed,
    PolicyUnavailable,
    RemoteAgent,
    UnknownSession,
)
from vlagents_ray.client import connection, recovery
from vlagents_ray.client.transports.base import ReplicaSilent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import NoReplica, UnknownApp, VLAgentsError
from vlagents_ray.serve.scaling import session_migration


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimulatedTime:
    """Simulate the client's clock."""
    clock = SimulatedTime()
    for module in (connection, recovery):
        monkeypatch.setattr(module, "time", clock)
    return clock


class Window(Agent):
    """A policy that acts on the last three observed values, and counts its acts."""

    contract = Contract(history=3)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if kwargs.get("fail"):
            raise RuntimeError("no")
        self.instruction, self.acts = instruction, 0
        self.seen = deque([int(obs.cameras["front"][0, 0, 0])], maxlen=3)
        self.rng = np.random.default_rng(kwargs.get("seed"))
        return {"instruction": instruction}

    def observe(self, obs: Obs) -> None:
        self.seen.append(int(obs.cameras["front"][0, 0, 0]))

    def act(self, obs: Obs) -> Act:
        self.observe(obs)
        self.acts += 1
        info = {"instruction": self.instruction, "acts": self.acts, "random": self.rng.random()}
        return Act(np.array(self.seen, np.float32), info=info)


def obs(value: int) -> Obs:
    return Obs({"front": np.full((4, 4, 3), value, np.uint8)})


@pytest.fixture
def replicas() -> Iterator[Callable[[int], Replicas]]:
    with contextlib.ExitStack() as made:

        def make(n: int) -> Replicas:
            return made.enter_context(contextlib.closing(Replicas([Window() for _ in range(n)])))

        yield make


Begun = Callable[..., tuple[Replicas, RemoteAgent]]


@pytest.fixture
def begun(replicas: Callable[[int], Replicas]) -> Iterator[Begun]:
    """Return a function that starts replicas and a session at the first of them, with frame 1 and
    the instruction "stack".
    """
    with contextlib.ExitStack() as made:

        def begin(n: int, seed: int | None = None, **options: Any) -> tuple[Replicas, RemoteAgent]:
            served = replicas(n)
            agent = made.enter_context(served.agent(**options))
            agent.reset(obs(1), "stack", **({} if seed is None else {"seed": seed}))
            return served, agent

        yield begin


def test_a_session_of_a_replica_that_stops_moves_with_all_it_has(begun: Begun) -> None:
    served, agent = begun(2, seed=3)
    drawn = [agent.act(obs(value)).info["random"] for value in (2, 3)]
    served.engines[0].drain_list.drain()
    drawn += act_until_moved(agent, served)
    assert drawn == np.random.default_rng(3).random(len(drawn)).tolist()
    assert len(served.engines[1].sessions) == 1
    assert len(served.engines[0].sessions) == 0


def act_until_moved(agent: RemoteAgent, served: Replicas) -> list[float]:
    """Act until the session has moved to the second replica and continues there; return the drawn
    numbers.
    """
    drawn = []
    while not len(served.engines[1].sessions):
        act = agent.act(obs(len(drawn) % 200))
        assert "resumed" not in act.info
        drawn.append(act.info["random"])
    return drawn


@pytest.mark.parametrize("look_up", ["is refused", "finds no application", "hangs"])
def test_a_session_stays_where_it_is_until_another_replica_has_answered(
    look_up: str, begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A replica that sends the session away still answers, even if the load balancer is
    unavailable.
    """
    served, agent = begun(2, timeout_s=5.0, seed=3)
    connect, tried, back = InProcess.connect, threading.Semaphore(0), threading.Event()

    def fail(self: InProcess, timeout_s: float) -> Any:
        tried.release()
        if look_up == "hangs":
            assert back.wait(20)
        if back.is_set():
            return connect(self, timeout_s)
        raise (
            PolicyUnavailable("refused")
            if look_up == "is refused"
            else UnknownApp("no application")
        )

    monkeypatch.setattr(InProcess, "connect", fail)
    monkeypatch.setattr(connection, "_LOOK_UP_PAUSE_S", 0.0)
    served.engines[0].drain_list.drain()
    drawn = [agent.act(obs(2)).info["random"]]
    for _ in range(1 if look_up == "hangs" else 3):
        while not tried.acquire(blocking=False):
            drawn.append(agent.act(obs(2)).info["random"])
        drawn += [agent.act(obs(3)).info["random"] for _ in range(3)]
    assert agent.reconnects == 0
    back.set()
    drawn += act_until_moved(agent, served)
    # No act was lost or repeated.
    assert drawn == np.random.default_rng(3).random(len(drawn)).tolist()


@pytest.mark.parametrize("status", ["ended", "broken"])
def test_a_look_up_for_a_session_that_no_longer_needs_it_leaves_no_connection(
    status: str, begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    served, agent = begun(2)
    connect, looked, back = InProcess.connect, threading.Event(), threading.Event()
    found: list[InProcess] = []

    def later(self: InProcess, timeout_s: float) -> Any:
        if threading.current_thread() is not threading.main_thread():
            found.append(self)
            looked.set()
            assert back.wait(20)
        return connect(self, timeout_s)

    monkeypatch.setattr(InProcess, "connect", later)
    served.engines[0].drain_list.drain()
    agent.act(obs(2))
    assert looked.wait(20)
    if status == "broken":
        served.dead.add(0)
        assert agent.act(obs(3)).info["resumed"]
    else:
        agent.close()
    closed = threading.Event()
    monkeypatch.setattr(InProcess, "close", lambda self: closed.set() if self in found else None)
    back.set()
    assert closed.wait(20)


def test_a_session_of_a_dead_replica_begins_again_and_sees_its_history(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(2)
    agent = served.agent()
    frame = obs(1)
    agent.reset(frame, "stack", seed=3)
    for value in (2, 3, 4):
        # Like an environment that always renders into the same memory.
        frame.cameras["front"][:] = value
        agent.act(frame)
    served.dead.add(0)
    act = agent.act(obs(5))
    assert act.info["resumed"]
    assert act.action.tolist() == [3, 4, 5]
    assert act.info["instruction"] == "stack"
    assert "resumed" not in agent.act(obs(6)).info
    agent.close()


def test_the_first_action_since_says_that_the_session_began_again_though_its_own_act_got_none(
    begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    served, agent = begun(2)
    served.dead.add(0)
    call, broken = InProcess.call, True

    def too_late(self: InProcess, requests: Any, timeout_s: float) -> Any:
        replies = call(self, requests, timeout_s)
        if broken and requests[0].op == "act" and replies[0].act is not None:
            raise DeadlineExceeded("no answer in time")
        return replies

    monkeypatch.setattr(InProcess, "call", too_late)
    with pytest.raises(DeadlineExceeded):
        agent.act(obs(2))
    broken = False
    assert agent.act(obs(3)).info["resumed"]
    assert "resumed" not in agent.act(obs(4)).info


@pytest.mark.parametrize("executed", [False, True])
def test_a_session_that_did_not_begin_again_in_time_says_so_with_the_next_act(
    executed: bool, begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under load the reset's deadline passes, and the next act arrives while the reset is in the
    queue, or after it.
    """
    served, agent = begun(2)
    served.dead.add(0)
    call, late = InProcess.call, [True]

    def too_late(self: InProcess, requests: Any, timeout_s: float) -> Any:
        if requests[0].op == "reset" and late and late.pop():
            if executed:
                call(self, requests, timeout_s)
            else:
                waiting = pending(requests[0].session, requests[0])
                served.engines[1].sessions.reserve(waiting, {}, follows=True)
            raise DeadlineExceeded("no answer in time")
        return call(self, requests, timeout_s)

    monkeypatch.setattr(InProcess, "call", too_late)
    with pytest.raises(DeadlineExceeded):
        agent.act(obs(2))
    assert not late, "the session was not reset"
    act = agent.act(obs(3))
    assert (act.info["resumed"], act.info["instruction"], act.info["acts"]) == (True, "stack", 1)


def test_an_act_without_time_to_begin_again_exceeds_its_deadline_and_asks_for_no_reset(
    begun: Begun, monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    """Another replica searches for the session until the deadline, and then reports that it is
    unknown.
    """
    served, agent = begun(2)
    served.dead.add(0)
    call, late = InProcess.call, [True]

    def unknown(self: InProcess, requests: Any, timeout_s: float) -> Any:
        replies = call(self, requests, timeout_s)
        if late and isinstance(replies[0].error, UnknownSession):
            late.pop()
            clock.now += timeout_s
        return replies

    monkeypatch.setattr(InProcess, "call", unknown)
    agent._connection.timeout_s = 30.0
    with pytest.raises(DeadlineExceeded, match="the next call of act resumes it"):
        agent.act(obs(2))
    assert not late
    assert agent.act(obs(3)).info["resumed"]


def test_an_act_for_which_little_time_is_left_is_not_sent_again(
    begun: Begun, monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    """The act would be executed after its caller has given up."""
    served, agent = begun(2)
    served.dead.add(0)
    call, sent = InProcess.call, []

    def slow_reset(self: InProcess, requests: Any, timeout_s: float) -> Any:
        sent.append(requests[0].op)
        replies = call(self, requests, timeout_s)
        if requests[0].op == "reset" and len(sent) < 4:
            clock.now += 0.99 * timeout_s
        return replies

    monkeypatch.setattr(InProcess, "call", slow_reset)
    agent._connection.timeout_s = 30.0
    with pytest.raises(DeadlineExceeded, match="was not resumed within"):
        agent.act(obs(2))
    assert sent == ["act", "act", "reset"]
    act = agent.act(obs(3))
    assert (act.info["resumed"], act.info["instruction"], act.info["acts"]) == (True, "stack", 1)


def test_a_reset_waits_for_a_replica_while_none_runs_but_not_for_room_at_a_full_one(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch
) -> None:
    not_found = UnknownApp("Path '/v1/reset' not found")  # HAProxy's answer while it restarts
    refusals: list[VLAgentsError] = [PolicyUnavailable("full"), NoReplica("none runs"), not_found]
    call = InProcess.call

    def refuse(self: InProcess, requests: Any, timeout_s: float) -> Any:
        if refusals:
            raise refusals.pop()
        return call(self, requests, timeout_s)

    agent = replicas(1).agent()
    monkeypatch.setattr(InProcess, "call", refuse)
    with pytest.raises(PolicyUnavailable, match="full"):
        agent.reset(obs(1), "stack")
    refusals.append(NoReplica("none runs"))
    assert agent.reset(obs(1), "stack")["instruction"] == "stack"
    agent.close()


def test_an_answer_that_was_lost_is_not_acted_on_twice(begun: Begun) -> None:
    served, agent = begun(1)
    agent.act(obs(2))
    served.lose_reply = True
    act = agent.act(obs(3))
    assert act.info["resumed"]
    assert act.action.tolist() == [1, 2, 3]


def test_without_resuming_the_loss_is_raised_and_a_reset_is_needed(begun: Begun) -> None:
    served, agent = begun(2, resume=False)
    served.dead.add(0)
    with pytest.raises(ConnectionLost):
        agent.act(obs(2))
    with pytest.raises(NotReset):
        agent.act(obs(2))
    agent.reset(obs(1), "stack")
    assert agent.act(obs(2)).info["acts"] == 1


def test_when_nobody_lives_the_loss_is_raised_in_time_and_a_later_act_goes_on(
    begun: Begun,
) -> None:
    served, agent = begun(1)
    agent.act(obs(2))
    served.dead.add(0)
    agent._connection.timeout_s = 0.3
    with pytest.raises((ConnectionLost, PolicyUnavailable)):
        agent.act(obs(3))
    served.dead.clear()
    agent._connection.timeout_s = 30.0
    act = agent.act(obs(4))
    assert act.action.tolist() == [1, 2, 4]


def test_a_server_that_stops_and_starts_again_is_waited_for(
    begun: Begun, monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    served, agent = begun(1)
    agent.act(obs(2))
    agent._connection.timeout_s = 0.3
    served.dead.add(0)
    served.stopping = True
    with pytest.raises(PolicyUnavailable, match="gone"):
        agent.act(obs(3))
    served.dead.clear()

    def sleep(seconds: float) -> None:
        clock.now += seconds
        served.stopping = clock.now < 2.0

    monkeypatch.setattr(clock, "sleep", sleep)
    agent._connection.timeout_s = 30.0
    assert agent.act(obs(4)).action.tolist() == [1, 2, 4]


def test_an_observation_may_allow_less_time(begun: Begun) -> None:
    served, agent = begun(1, timeout_s=30.0)
    served.dead.add(0)
    begun = time.monotonic()
    hasty = obs(2)
    hasty.info["deadline_ms"] = 100
    with pytest.raises((ConnectionLost, PolicyUnavailable)):
        agent.act(hasty)
    assert time.monotonic() - begun < 15
    hasty.info["deadline_ms"] = -1
    with pytest.raises(InvalidObservation, match="deadline_ms"):
        agent.act(hasty)


@pytest.mark.parametrize(("timeout_s", "way_s"), [(0.1, 0.01), (2.0, 0.2), (30.0, 0.2)])
def test_the_server_gives_a_call_up_before_its_caller_does(
    timeout_s: float,
    way_s: float,
    replicas: Callable[[int], Replicas],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Over a handle and over HTTP, the travel time of a request is unknown, so it could be executed
    after its deadline.
    """
    agent = replicas(1).agent()
    agent.reset(obs(1), "stack")
    call, told = InProcess.call, []

    def note(self: InProcess, requests: Any, limit_s: float) -> Any:
        told.append((requests[0].deadline_ms / 1e3, limit_s))
        return call(self, requests, 30.0)

    monkeypatch.setattr(InProcess, "call", note)
    agent._connection.call([agent._session.act(obs(2))], timeout_s)
    [(at_the_server_s, here_s)] = told
    assert here_s - at_the_server_s == pytest.approx(way_s)
    agent.close()


def test_a_vector_of_sessions_travels_in_one_frame(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(2)
    agent = served.agent()
    envs = agent.sessions(5)
    infos = agent.reset_batch([obs(i) for i in range(5)], [f"task {i}" for i in range(5)], envs)
    assert infos == [{"instruction": f"task {i}"} for i in range(5)]
    acts = agent.act_batch([obs(10 + i) for i in range(5)], envs)
    assert served.frames == [5, 5]
    for i, act in enumerate(acts):
        assert isinstance(act, Act)
        assert act.action.tolist() == [i, 10 + i]
        assert act.info["timing"]["batch_size"] == 5
    served.dead.add(0)
    for i, act in enumerate(agent.act_batch([obs(20 + i) for i in range(5)], envs)):
        assert isinstance(act, Act)
        assert (act.action.tolist(), act.info["resumed"]) == ([i, 10 + i, 20 + i], True)
    for env in envs:
        env.close()
    assert len(served.engines[1].sessions) == 0


def test_one_session_that_fails_leaves_its_neighbours_alone(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(1)
    agent = served.agent()
    envs = agent.sessions(3)
    agent.reset_batch([obs(i) for i in range(3)], [None] * 3, envs)
    bad = Obs({"front": np.zeros((4, 4, 3), np.float32)})
    acts = agent.act_batch([obs(1), bad, obs(2)], envs)
    assert isinstance(acts[0], Act)
    assert isinstance(acts[1], Exception)
    assert "expected (H, W, 3) uint8" in str(acts[1])
    assert isinstance(acts[2], Act)
    infos = agent.reset_batch([obs(0)], [None], [envs[0]], fail=True)
    assert isinstance(infos[0], PolicyFailed)
    with pytest.raises(NotReset):
        envs[0].act(obs(0))
    with pytest.raises(ConfigError, match="observations, one for each session"):
        agent.act_batch([obs(0)], envs)
    stranger = served.agent()
    with pytest.raises(ConfigError, match="share its connection"):
        agent.act_batch([obs(0)], [stranger])
    for env in envs:
        env.close()


def test_a_replica_that_has_fallen_silent_is_left(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    monkeypatch.setattr(session_migration, "_ANSWER_S", 0.2)
    served = replicas(2)
    call = InProcess.call

    def silent(self: InProcess, requests: Any, timeout_s: float) -> Any:
        if self._number not in served.frozen:
            return call(self, requests, 30.0)
        clock.now += timeout_s
        raise DeadlineExceeded("no answer")

    monkeypatch.setattr(InProcess, "call", silent)
    agent = served.agent()
    agent.reset(obs(1), "stack")
    agent.act(obs(2))
    served.frozen.add(0)
    agent._connection.timeout_s = 0.4 * connection.SILENT_S
    failed = 0
    for _ in range(50):
        try:
            act = agent.act(obs(3))
            break
        except DeadlineExceeded:
            failed += 1
    assert failed == 3  # one late answer proves nothing yet
    assert act.info["resumed"]
    assert act.action.tolist() == [1, 2, 3]
    assert "resumed" not in agent.act(obs(4)).info
    agent.close()


def test_a_session_that_has_left_a_silent_replica_begins_again_without_a_search(
    begun: Begun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recovery comes too late for the call itself, whose error says so. The next call begins
    with a reset.
    """
    served, agent = begun(2)
    agent.act(obs(2))
    call, ops = InProcess.call, []

    def silent(self: InProcess, requests: Any, timeout_s: float) -> Any:
        ops.append((self._number, requests[0].op))
        if self._number == 0:
            self.close()
            raise ReplicaSilent("no answer to a ping")
        return call(self, requests, timeout_s)

    monkeypatch.setattr(InProcess, "call", silent)
    with monkeypatch.context() as patch:
        patch.setattr(recovery, "_RESERVE_SHARE", 1.0)  # no time is left for a second attempt
        patch.setattr(recovery, "_RESERVE_S", 60.0)
        with pytest.raises(ReplicaSilent):
            agent.act(obs(3))
    served.dead.add(0)
    act = agent.act(obs(4))
    assert ops == [(0, "act"), (1, "reset"), (1, "act")]
    assert act.info["resumed"]
    assert act.action.tolist() == [1, 2, 4]
    assert "resumed" not in agent.act(obs(5)).info


def test_a_call_that_connects_again_too_late_sends_nothing_and_the_next_one_has_the_connection(
    begun: Begun, monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    served, agent = begun(2, timeout_s=2.0)
    connect, connected = InProcess.connect, []

    def slowly(self: InProcess, timeout_s: float) -> Any:
        clock.now += 3.0
        connected.append(timeout_s)
        return connect(self, timeout_s)

    monkeypatch.setattr(InProcess, "connect", slowly)
    served.dead.add(0)
    agent._connection.timeout_s = 2.0
    agent._connection._must_reconnect = True
    sent = len(served.frames)
    with pytest.raises(DeadlineExceeded, match="too late"):
        agent.act(obs(2))
    assert len(served.frames) == sent
    assert agent.act(obs(3)).info["resumed"]
    assert len(connected) == 1


@pytest.mark.parametrize("waits", [False, True])
def test_a_server_that_has_just_answered_is_not_left_for_the_silence_before_that(
    waits: bool, begun: Begun, monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    """An earlier version left the server: the first late answer on a new connection, which is slow
    at first, overrode the recent answer.
    """
    _, agent = begun(1, timeout_s=2.0)
    late, lost = DeadlineExceeded("no answer"), ConnectionLost("gone")
    errors: list[Exception] = [late, late, lost, late] if waits else [late, lost, late]
    call = InProcess.call

    def failing(self: InProcess, requests: Any, timeout_s: float) -> Any:
        if not errors:
            return call(self, requests, 30.0)
        clock.now += 2.0
        raise errors.pop(0)

    monkeypatch.setattr(InProcess, "call", failing)
    agent._connection.timeout_s = 2.0
    for _ in range(len(errors)):
        with pytest.raises((DeadlineExceeded, ConnectionLost)):
            agent.act(obs(2))
    assert agent.act(obs(3)).action[-1] == 3
    assert agent.reconnects == 1


def test_a_replica_that_is_only_slow_keeps_the_session_or_gives_it_on(
    replicas: Callable[[int], Replicas], monkeypatch: pytest.MonkeyPatch, clock: SimulatedTime
) -> None:
    call, slow = InProcess.call, False

    def too_late(self: InProcess, requests: Any, timeout_s: float) -> Any:
        if not slow:
            return call(self, requests, timeout_s)
        clock.now += connection.SILENT_S
        return call(self, requests, 0.1)  # less than the 30 s in which the replica may act

    monkeypatch.setattr(InProcess, "call", too_late)
    # The client connects to the same replica again, or to another one.
    for number, prefer in ((1, 0), (2, 1)):
        served = replicas(number)
        agent = served.agent()
        agent.reset(obs(1), "stack")
        served.prefer = prefer
        agent._connection.timeout_s = 30.0
        model = served.engines[0].model.loaded
        slow = True
        with model.busy, pytest.raises(DeadlineExceeded):
            agent.act(obs(2))  # this act is executed later
        slow = False
        act = agent.act(obs(3))
        assert "resumed" not in act.info
        assert act.info["acts"] == 2
        agent.close()
