"""What other clients of the port of LeRobot's remote inference can do: to a robot, whose messages
they neither see nor send, and to the server's memory and threads.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import psutil
import pytest
from dialect_fixtures import LIMITS
from eval_fakes import wait_for
from in_process_replicas import Replicas
from served_agents import Witness

from vlagents_ray import Act, Obs
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.ports import free_port, reserve
from vlagents_ray_dialects import lerobot_remote
from vlagents_ray_dialects.lerobot_remote import LeRobotRemoteDialect, LeRobotRemoteDialectConfig
from vlagents_ray_dialects.messages import lerobot_remote as messages
from vlagents_ray_dialects.messages.lerobot_remote import Envelope

pytest.importorskip("zenoh")
import zenoh
from remote_robot import SETTINGS, RemoteRobot
from zenoh_session import open_zenoh

IN_FLIGHT = 32 * 2**20
SLACK = 24 * 2**20  # bytes of buffers, of the interpreter and of its allocator
SMALL = 4096  # bytes of small messages
BLOCK = {"congestion_control": zenoh.CongestionControl.BLOCK}
ROOT = "lerobot/inference/v1/deployments"


class Gate(Witness):
    """A policy that waits until the gate opens."""

    opened = threading.Event()

    def act(self, obs: Obs) -> Act:
        assert self.opened.wait(60)
        return super().act(obs)


class Port:
    """The dialect at a port, over an engine in this process."""

    def __init__(self, replicas: Replicas, sessions: int = 8) -> None:
        self.replicas = replicas
        self.admission = Admission(IN_FLIGHT)
        config = LeRobotRemoteDialectConfig(port=free_port(), **SETTINGS)
        context = GatewayContext(
            "noop",
            lambda _key, priority: replicas.agent(priority=priority or "robot"),
            LIMITS,
            sessions,
            30.0,
            contract=None,
            check=NoKey.OPEN,
            admission=self.admission,
        )
        self.dialect = LeRobotRemoteDialect("lerobot_remote", config, context)
        self.dialect.serve(reserve("lerobot_remote", "127.0.0.1", config.port))
        self.number = config.port

    def session_of(self, robot: RemoteRobot) -> Any:
        return self.dialect.robots.get(robot.session_id)


@pytest.fixture(name="port")
def open_gate() -> Iterator[Port]:
    Gate.opened.set()
    replicas = Replicas([Gate()])
    port = Port(replicas)
    yield port
    Gate.opened.set()
    port.dialect.close()
    replicas.close()


def ask(session: Any, key: str, request: Envelope, timeout_s: float = 0.5) -> list[Envelope]:
    """Send a query, which may have wildcards, and return all replies."""
    replies = session.get(
        key,
        payload=messages.encode(request),
        timeout=timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    answers = []
    for one in replies:
        data = (one.ok or one.err).payload.to_bytes()
        if data != b"Timeout":
            answers.append(messages.decode(data))
    return answers


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_another_client_sees_and_moves_nothing_of_a_robot(port: Port, mode: str) -> None:
    with RemoteRobot(port.number).begin() as robot:
        assert robot.act(1).message_type == "action"
        stranger = open_zenoh(port.number, mode)
        instance, session = robot.instance_id, robot.session_id
        expressions = [
            robot.session_key,
            f"{robot.instance_key}/sessions/*",
            f"{robot.instance_key}/sessions/{session[:1]}$*",
            f"{ROOT}/**",
            "**",
        ]
        seen: list[str] = []
        tokens: list[str] = []
        declared = []
        remote = zenoh.Locality.REMOTE  # not the stranger's own messages
        for expression in expressions:
            suffixes = [""] if expression.endswith("**") else ["/obs", "/act", "/language/result"]
            for suffix in suffixes:
                handler = zenoh.handlers.Callback(
                    lambda sample: seen.append(str(sample.key_expr)), indirect=False
                )
                key = f"{expression}{suffix}"
                declared.append(stranger.declare_subscriber(key, handler, allowed_origin=remote))
            # The stranger also pretends to be the server.
            key = expression if expression.endswith("**") else f"{expression}/control"
            pretends = zenoh.handlers.Callback(lambda _query: seen.append("query"), indirect=False)
            declared.append(
                stranger.declare_queryable(key, pretends, complete=True, allowed_origin=remote)
            )
            for reply in stranger.liveliness().get(expression, timeout=0.2):
                tokens.append(str(reply.ok.key_expr))
        assert all("/sessions/" not in token for token in tokens), "a robot's token is visible"

        forged = Envelope("action", instance, session, 0, "r2", {"canonical_actions": [[9.0]]})
        for step in range(3):
            stranger.put(f"{robot.session_key}/act", messages.encode(forged))
            answer = robot.act(10 + step)
            assert answer.body["canonical_actions"][0][0] == 10 + step
            assert answer.body["canonical_actions"][0][4] == 2 + step

        for number, operation in enumerate(("status", "reset", "invalidate", "close")):
            request = Envelope(
                "control", instance, session, 2**40, f"q{number}", {"operation": operation}
            )
            for expression in expressions:
                key = expression if expression.endswith("**") else f"{expression}/control"
                for reply in ask(stranger, key, request):
                    assert reply.message_type == "error"
                    assert instance not in str(reply)
                    assert session not in str(reply)
        observation = Envelope("observation", instance, session, 0, "r9", {"sequence": 2**40})
        stranger.put(f"{robot.session_key}/obs", messages.encode(observation))
        stranger.delete(f"{robot.session_key}/obs")
        token = stranger.liveliness().declare_token(f"{robot.session_key}/alive")
        token.undeclare()
        # A second robot with the names of the first gets its own session, and ends only that.
        with RemoteRobot(port.number) as other:
            opened = other.open("q-1")
            assert opened.session_id not in (session, "")
        answer = robot.act(20)
        assert answer.body["canonical_actions"][0].tolist()[:1] == [20]
        assert answer.body["canonical_actions"][0][4] == 5
        assert robot.answers.empty()
        assert seen == []
        stranger.close()


def test_two_robots_with_equal_names_have_their_own_sessions(port: Port) -> None:
    with RemoteRobot(port.number) as red, RemoteRobot(port.number) as blue:
        accepted = [robot.open("1") for robot in (red, blue)]
        assert accepted[0].session_id != accepted[1].session_id
        red.begin(), blue.begin()
        for step in range(3):
            for robot, pixel in ((red, 10), (blue, 20)):
                row = robot.act(pixel + step).body["canonical_actions"][0]
                assert (row[0], row[4]) == (pixel + step, step + 1)
        empty = Envelope("open", red.instance_id, request_id="", body={})
        answer = red.query(f"{red.instance_key}/open", empty)
        assert (answer.message_type, answer.body["code"]) == ("error", "malformed")


ENDS: dict[str, Callable[[RemoteRobot], object]] = {
    "close": lambda robot: robot.control("close"),
    "its connection": lambda robot: robot.leave(),
    "another opening": lambda robot: robot.open("q-2"),
}


@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_an_opening_after_the_end_of_a_session_is_a_session_that_acts(
    port: Port, end: Callable[[RemoteRobot], object]
) -> None:
    with RemoteRobot(port.number).begin(request_id="q-1") as robot:
        assert robot.act(1).message_type == "action"
        first = robot.session_id
        end(robot)
        wait_for(lambda: port.dialect.robots.get(first) is None)
        wait_for(lambda: not port.replicas.engines[0].sessions.ids())
        with RemoteRobot(port.number).begin(request_id="q-1") as again:
            assert again.session_id != first
            assert again.act(2).body["canonical_actions"][0][4] == 1


VALUES: dict[str, Any] = {
    "array": np.zeros(2),
    "number in an array": np.zeros(1),
    "map": {"a": np.zeros(2)},
    "list": [np.zeros(2)],
    "number": 2.5,
    "text": "x",
    "nothing": None,
}
# The fields of messages whose value the server repeats, or that any value may have.
_ANY_VALUE = ("observation_id", "capture_time", "task_version", "observation_cursor", "cursor")


def test_a_wrong_type_in_any_field_is_an_error_of_the_client(
    port: Port, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(lerobot_remote, "_OPENS_AT_ONCE", 10_000)
    played = 0
    with RemoteRobot(port.number).begin() as robot:
        opening = robot.open_body()
        observation = robot.observation(1)
        control = Envelope(
            "control", robot.instance_id, robot.session_id, 0, "c", {"operation": "status"}
        )
        requests: list[tuple[str, Envelope]] = [
            ("obs", observation),
            ("control", control),
            ("open", Envelope("open", robot.instance_id, request_id="q", body=opening)),
            ("describe", Envelope("describe", request_id="q")),
        ]
        for kind, request in requests:
            for place, name in fields_of(request):
                for value_name, value in VALUES.items():
                    data = changed(request, place, name, value)
                    answer = robot.answer_to(kind, data)
                    what = (kind, place, name, value_name)
                    played += 1
                    if answer.message_type != "error":
                        allowed = place == "body" and (name in _ANY_VALUE or value is None)
                        same = name in ("task", "request_id", "session_id", "instance_id")
                        assert allowed or same or kind == "describe", what
                        continue
                    assert answer.body["code"] != "execution", what
    assert "failed" not in caplog.text
    assert played > 200


def fields_of(request: Envelope) -> list[tuple[str, str]]:
    names = ("version", "message_type", "instance_id", "session_id", "generation", "request_id")
    fields = [("envelope", name) for name in (*names, "body")]
    return fields + [("body", name) for name in request.body]


def changed(request: Envelope, place: str, name: str, value: Any) -> bytes:
    """Return a message with another value of one field."""
    import msgpack

    raw = msgpack.unpackb(messages.encode(request))
    (raw if place == "envelope" else raw["body"])[name] = value
    packed: bytes = msgpack.packb(raw, default=messages._plain)
    return packed


# Memory and threads


def python_threads() -> int:
    """Return the number of Python's threads, without Zenoh's threads that have logged a line."""
    return sum(not isinstance(thread, threading._DummyThread) for thread in threading.enumerate())


def rss() -> int:
    memory: int = psutil.Process().memory_info().rss
    return memory


@pytest.mark.parametrize("number", [6, 60])
def test_observations_that_wait_are_counted_and_need_no_threads(port: Port, number: int) -> None:
    with RemoteRobot(port.number).begin() as robot:
        Gate.opened.clear()
        robot.send(1)
        session = port.session_of(robot)
        wait_for(lambda: session._asked is not None)
        threads, before, held = python_threads(), rss(), port.admission.held
        data = bytes(LIMITS.body_bytes)
        for _ in range(number):
            robot.publish("obs", data, **BLOCK)
        wait_for(lambda: len(session._inbox) >= min(number, 6))
        status = partial(robot.control, "status")
        controls = [threading.Thread(target=status) for _ in range(4)]
        for control in controls:
            control.start()
        wait_for(lambda: sum(item.kind == "control" for item in session._inbox) == 4)
        time.sleep(0.2)
        # A thread of an earlier test may still end.
        wait_for(lambda: python_threads() - threads <= len(controls))
        assert port.admission.held - held >= len(data) * 6
        assert port.admission.held <= IN_FLIGHT
        assert rss() - before <= port.admission.held - held + SLACK
        Gate.opened.set()
        for control in controls:
            control.join()  # none of them was dropped
        wait_for(lambda: port.admission.held == 0)


def test_the_oldest_observation_is_dropped_without_room(port: Port) -> None:
    size = 400_000
    with RemoteRobot(port.number).begin() as robot:
        Gate.opened.clear()
        robot.send(1)
        session = port.session_of(robot)
        wait_for(lambda: session._asked is not None)
        # A sender without a key may use half of the bytes that are free.
        port.admission.hold(IN_FLIGHT - port.admission.held - 2 * 5 * size, True, 0)
        for number in range(8):
            robot.publish("obs", bytes([number]) * size, **BLOCK)
        wait_for(lambda: session._inbox and session._inbox[-1].data[0] == 7)
        waiting = [item.data[0] for item in session._inbox]
        assert waiting == list(range(8 - len(waiting), 8))
        assert 1 <= len(waiting) <= 5
        Gate.opened.set()


def test_questions_need_no_threads_and_have_a_rate(port: Port) -> None:
    with RemoteRobot(port.number) as robot, RemoteRobot(port.number) as other:
        busy = threading.Event()
        for _ in range(2):
            port.dialect.questions.submit(busy.wait, 20)
        threads, before = python_threads(), rss()
        body = {"x": bytes(200_000)}
        request = Envelope("open", robot.instance_id, request_id="q", body=body)
        codes: list[str] = []

        def note(reply: Any) -> None:
            codes.append(messages.decode(reply.ok.payload.to_bytes()).body["code"])

        for _ in range(150):
            robot._zenoh.get(
                f"{robot.instance_key}/open",
                zenoh.handlers.Callback(note, indirect=False),
                payload=messages.encode(request),
                timeout=10.0,
            )
        wait_for(lambda: len(codes) >= 142)
        assert set(codes) == {"busy"}
        assert python_threads() == threads
        assert port.admission.held >= 8 * 200_000
        assert rss() - before <= port.admission.held + SLACK
        busy.set()
        assert other.open().message_type == "accepted"
        wait_for(lambda: port.admission.held == 0)


def test_a_message_above_the_limit_is_not_kept_but_counted(port: Port) -> None:
    size = LIMITS.body_bytes + 2**20
    with RemoteRobot(port.number).begin() as robot:
        before = rss()
        for _ in range(3):
            robot.publish("obs", bytes(size), **BLOCK)
        assert robot.act(1).message_type == "action"
        assert size <= port.admission.held <= 3 * size + SMALL
        assert rss() - before < SLACK
    wait_for(lambda: port.admission.held == 0)


def test_a_connection_that_fills_the_memory_ends_and_harms_no_other(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_remote, "_NO_ROOM_S", 0.5)
    with RemoteRobot(port.number).begin() as robot, RemoteRobot(port.number).begin() as hostile:
        first = hostile.session_id
        hostile.publish("obs", bytes(64 * 2**20))
        wait_for(lambda: port.dialect.robots.get(first) is None)
        assert robot.act(1).message_type == "action"
        wait_for(lambda: port.admission.held <= SMALL)


def test_a_client_keeps_the_priorities_of_zenoh(port: Port) -> None:
    # Without them, a client of Zenoh 1.10 that has dropped one message under load drops all later
    # ones.
    with RemoteRobot(port.number) as robot:
        assert [transport.is_qos for transport in robot._zenoh.info.transports()] == [True]


def test_an_incomplete_message_is_counted(port: Port) -> None:
    with RemoteRobot(port.number) as robot:
        robot.begin()
        [connection] = port.dialect._connections
        with connection._counting:
            assert connection._incomplete < 4096
        assert connection.admit(bytes(IN_FLIGHT // 8))
        assert port.admission.held >= IN_FLIGHT // 8
        for step in range(20):
            robot.act(step)
    wait_for(lambda: port.admission.held == 0)


@pytest.mark.parametrize("first", [b"GET / HTTP/1.1\r\n", b"\x05\x00\x81", b""])
def test_a_connection_of_another_protocol_opens_no_network(port: Port, first: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port.number)) as stranger:
        stranger.sendall(first)
        if first[2:3] != b"\x81" and first:
            assert stranger.recv(1) == b""
            return
        wait_for(lambda: len(port.dialect._connections) == 1)
    wait_for(lambda: not port.dialect._connections)


def test_the_oldest_connections_without_a_session_end(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_remote, "_STRANGERS", 3)
    with RemoteRobot(port.number).begin() as robot:
        strangers = []
        for _ in range(8):
            stranger = socket.create_connection(("127.0.0.1", port.number))
            stranger.sendall(struct.pack("<HB", 40, 0x81))
            strangers.append(stranger)
        for stranger in strangers[:5]:
            stranger.settimeout(10)
            assert stranger.recv(1) == b""
        assert robot.act(1).message_type == "action"
        for stranger in strangers:
            stranger.close()
