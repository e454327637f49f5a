"""Tests of an upstream that is lost, returns, or does not answer: it is handled like a lost
replica.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deaf_server import deaf_server
from eval_fakes import wait_for
from in_process_evaluation import play
from in_process_replicas import Replicas
from upstream_servers import CLOSED, SLOW, answer, upstream
from websockets.exceptions import ConnectionClosedError

from vlagents_ray.abilities import ChecksHealth, ability
from vlagents_ray.errors import ConnectionLost, NoReplica, PolicyUnavailable, UnknownSession
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.interface import Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port
from vlagents_ray_dialects.messages import openpi, vla_eval
from vlagents_ray_dialects.upstream import Upstream, websocket
from vlagents_ray_dialects.upstream.client import ClientOptions
from vlagents_ray_dialects.upstream.policy import PROTOCOLS

PLAIN = {"state": {"position": "observation/state"}, "instruction": "prompt"}
CAMERA = {"front": "observation/image"}
SCHEMES = {"gr00t": "tcp", "openvla": "http"}


def settings(*ports: int, protocol: str = "openpi", **more: Any) -> dict[str, Any]:
    urls = [f"{SCHEMES.get(protocol, 'ws')}://127.0.0.1:{port}" for port in ports]
    mapping = {} if protocol in ("vla_eval", "roboarena") else {"mapping": PLAIN}
    return {"protocol": protocol, "urls": urls, "connect_timeout_s": 60, **mapping, **more}


def seen(number: int) -> Obs:
    return Obs(state={"position": np.array([number], np.float32)})


def expected(number: int, text: str = "task") -> np.ndarray:
    return answer({"observation/state": seen(number).state["position"], "prompt": text}).astype(
        np.float32
    )


Open = Callable[..., Upstream]


@pytest.fixture
def opened() -> Iterator[Open]:
    with ExitStack() as stack:

        def open_upstream(*ports: int, **more: Any) -> Upstream:
            agent = stack.enter_context(Upstream.from_config(settings(*ports, **more)))
            agent.initialize()
            return agent

        yield open_upstream


@pytest.fixture
def start() -> Iterator[Callable[..., Any]]:
    with ExitStack() as stack:
        yield lambda port, protocol="openpi": stack.enter_context(upstream(protocol, port))


def sessions(agent: Upstream, count: int, text: str = "task") -> list[Any]:
    copies = AgentCopies(agent)
    found = [copies.make() for _ in range(count)]
    for session in found:
        session.reset(seen(0), text)
    return found


def require_right(agent: Upstream, of: list[Any]) -> None:
    for i, act in enumerate(agent.act_batch([seen(i) for i in range(len(of))], of)):
        assert not isinstance(act, Exception), act
        np.testing.assert_array_equal(act.action, expected(i))


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["openpi", "openpi-batch"])
def test_the_rows_of_a_lost_lane_are_asked_over_the_others(
    opened: Open, start: Any, protocol: str
) -> None:
    ports = [free_port(), free_port()]
    servers = [start(port, protocol) for port in ports]
    agent = opened(*ports, protocol=protocol)
    wait_for(lambda: len(agent._lanes._ready) == 2)
    acting = sessions(agent, 8)
    require_right(agent, acting)
    servers[0].kill()
    servers[0].wait()
    require_right(agent, acting)
    start(ports[0], protocol)
    wait_for(lambda: len(agent._lanes._ready) == 2)
    require_right(agent, acting)


PIXELS = {
    "openpi": {"cameras": CAMERA, **PLAIN},
    "openvla": "openvla",
    "gr00t": {
        "cameras": {"front": "video/ego", "wrist": "video/wrist"},
        "state": {"position": "state/arm"},
        "action": {"arm": {"stop": 6}, "gripper": {"start": 6}},
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("protocol", sorted(PIXELS))
def test_connections_that_ended_while_nobody_acted_cost_a_row_nothing(
    opened: Open, start: Any, protocol: str
) -> None:
    port = free_port()
    server = start(port, protocol)
    agent = opened(port, protocol=protocol, mapping=PIXELS[protocol], connections=5, retry_s=60)
    wait_for(lambda: len(agent._lanes._ready) == 5)
    image = np.zeros((8, 8, 3), np.uint8)
    obs = Obs({"front": image, "wrist": image}, state={"position": np.ones(1, np.float32)})
    [session] = sessions(agent, 1)
    [first] = agent.act_batch([obs], [session])
    server.kill()
    server.wait()
    wait_for(lambda: not any(client.is_open for client in agent._lanes._clients))
    start(port, protocol)
    [again] = agent.act_batch([obs], [session])
    np.testing.assert_array_equal(again.action, first.action)


def test_a_connection_that_ends_in_its_handshake_is_tried_again(
    opened: Open, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, refused = free_port(), []
    start(port)
    real = websocket.connect

    def connect(*args: Any, **options: Any) -> Any:
        if len(refused) < 2:
            refused.append(port)
            # This is the error if the upstream is killed while the client connects.
            raise ConnectionClosedError(None, None)
        return real(*args, **options)

    monkeypatch.setattr(websocket, "connect", connect)
    agent = opened(port)
    assert len(refused) == 2
    require_right(agent, sessions(agent, 1))


def test_without_any_upstream_a_request_is_answered_as_for_a_lost_replica(
    opened: Open, start: Any
) -> None:
    port = free_port()
    server = start(port)
    agent = opened(port, retry_s=0.1)
    acting = sessions(agent, 2)
    server.kill()
    server.wait()
    for error in agent.act_batch([seen(0), seen(1)], acting):
        assert isinstance(error, NoReplica)
        assert f"ws://127.0.0.1:{port}" in str(error)
    assert ability(agent, ChecksHealth) is None  # restarting the replica would not help


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "why"), [(SLOW, "no answer within 0.5 s"), (CLOSED, "received 1000")]
)
def test_a_row_on_which_the_upstream_is_lost_fails_alone_and_in_time(
    opened: Open, start: Any, text: str, why: str
) -> None:
    port = free_port()
    start(port)
    agent = opened(port, timeout_s=0.5, retry_s=30)
    [bad], [fine] = sessions(agent, 1, text), sessions(agent, 1)
    lost, right = agent.act_batch([seen(0), seen(1)], [bad, fine])
    assert isinstance(lost, PolicyUnavailable)
    assert why in str(lost)
    np.testing.assert_array_equal(right.action, expected(1))


def test_a_session_of_a_lost_upstream_begins_again(opened: Open, start: Any) -> None:
    port = free_port()
    server = start(port, "vla_eval")
    agent = opened(port, protocol="vla_eval", retry_s=60)
    [session] = sessions(agent, 1)
    first = agent.act_batch([seen(0)], [session])[0]
    server.kill()
    server.wait()
    start(port, "vla_eval")
    error = agent.act_batch([seen(1)], [session])[0]
    assert isinstance(error, UnknownSession)
    [again] = sessions(agent, 1)
    np.testing.assert_array_equal(agent.act_batch([seen(0)], [again])[0].action, first.action)


def test_the_connection_of_an_ended_session_is_closed(opened: Open, start: Any) -> None:
    port = free_port()
    start(port, "vla_eval")
    agent = opened(port, protocol="vla_eval")
    acting = sessions(agent, 3)
    assert len(agent._sessions._clients) == 3
    del acting
    wait_for(lambda: not agent._sessions._clients)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["openpi", "vla_eval"])
def test_an_upstream_that_is_killed_and_restarted_fails_no_episode(
    protocol: str, start: Any, tmp_path: Path
) -> None:
    port = free_port()
    servers = [start(port, protocol)]
    mapping = {"mapping": {"cameras": CAMERA, **PLAIN}} if protocol == "openpi" else {}
    replicas = Replicas([Upstream.from_config(settings(port, protocol=protocol) | mapping)])
    over = threading.Event()

    def kill() -> None:
        """Kill and restart the server twice, each time after some more answers."""
        while len(servers) < 3 and not over.is_set():
            enough = len(replicas.frames) + 10
            wait_for(
                lambda enough=enough: over.is_set() or len(replicas.frames) > enough, every_s=0.002
            )
            servers[-1].kill()
            servers[-1].wait()
            servers.append(start(port, protocol))

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        config = EvalConfig.model_validate(
            {
                "policies": [{"name": "upstream", "source": "upstream"}],
                "suites": [
                    {
                        "envs": ["eval_fakes:SevenLine"],
                        "env_options": {"camera": [8, 8]},
                        "episodes": 20,
                    }
                ],
                "out": tmp_path,
            }
        )
        results = play(config, lambda: replicas.agent(timeout_s=60.0))
    finally:
        over.set()
        killer.join()
        replicas.close()
    assert len(servers) == 3
    [case] = results.cases
    assert [(one.result.status, one.attempts) for one in case.episodes] == [("done", 1)] * 20


LARGE = np.zeros((2304, 3000, 3), np.uint8)
# The first message of a server of each protocol, and the observation that it does not read; None
# for a protocol without WebSockets.
DEAF: dict[str, tuple[bytes | None, dict[str, Any]]] = {
    "openpi": (openpi.encode({}), {"observation/image": LARGE, "prompt": "x"}),
    "openpi-batch": (openpi.encode({}), {"observation/image": LARGE, "prompt": "x"}),
    "roboarena": (openpi.encode({}), {"observation/image": LARGE, "prompt": "x"}),
    "vla_eval": (
        vla_eval.encode(
            vla_eval.VlaEvalMessage("hello", {"protocol_version": vla_eval.PROTOCOL_VERSION}, 1)
        ),
        {"images": {"front": LARGE}, "task_description": "x"},
    ),
    "openvla": (None, {"image": LARGE, "instruction": "x"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("read_bytes", [0, 4096], ids=["takes nothing", "takes little"])
@pytest.mark.parametrize("protocol", DEAF)
def test_an_upstream_that_hardly_reads_keeps_no_act_beyond_its_time(
    protocol: str, read_bytes: int
) -> None:
    """The upstream hangs with its sockets open. The policy's thread waits for it, and so do all
    robots.
    """
    greeting, observation = DEAF[protocol]
    with deaf_server(read_bytes, greeting=greeting) as port:
        url = f"{SCHEMES.get(protocol, 'ws')}://127.0.0.1:{port}"
        client = PROTOCOLS[protocol](ClientOptions(url, timeout_s=0.5))
        client.connect(5.0)
        begun = time.monotonic()
        with pytest.raises(ConnectionLost):
            client.ask([observation])
        client.close()
        assert time.monotonic() - begun < 5  # it would take at least 250 s without a limit
