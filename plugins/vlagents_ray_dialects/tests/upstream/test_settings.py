"""Tests of settings, of contracts that are compared with an upstream's metadata, and of invalid
answers.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from upstream_servers import pack_openpi, unpack_openpi, upstream
from websockets.sync.server import serve

from vlagents_ray.chunking.choice import choose, choose_for
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import (
    ConfigError,
    ContractMismatch,
    PolicyUnavailable,
    Unauthorized,
    VLAgentsError,
)
from vlagents_ray.interface import Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port
from vlagents_ray_dialects.upstream import Upstream

MAPPING = {"state": {"position": "observation/state"}, "instruction": "prompt"}
OPENPI: dict[str, Any] = {"protocol": "openpi", "urls": ["ws://127.0.0.1:9"], "mapping": MAPPING}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"protocol": "grpc"}, "'openpi', 'openpi-batch'"),
        ({"urls": []}, "at least 1"),
        ({"urls": ["http://box:1"]}, "expected ws://HOST:PORT or wss://HOST:PORT for openpi"),
        ({"urls": ["ws://me:secret@box:1"]}, "name it in key_env"),
        ({"mapping": None}, "openpi has no default; give an object, or a preset"),
        ({"mapping": "openpi-libera"}, "openpi-libero"),
        ({"mapping": {"camera": {}}}, r"got \['camera'\]"),
        ({"contract": {"chunks": 3}}, r"got \['chunks'\]"),
        (
            {"protocol": "vlagents", "urls": ["rpyc://box:1"], "key_env": "KEY"},
            "no place for a key",
        ),
        ({"speed": 3}, "speed"),
    ],
)
def test_a_wrong_setting_is_refused_with_what_is_right(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        Upstream.from_config({**OPENPI, **changes})
    assert "secret" not in str(error.value)


def test_the_deployment_states_what_the_mapping_does_not_say() -> None:
    contract = {"action": {"dim": 7, "space": "joint"}, "chunk": 10}
    agent = Upstream.from_config(OPENPI | {"mapping": "openpi-droid", "contract": contract})
    assert agent.contract.action.dim == 7
    assert agent.contract.action.gripper_open == 0  # from the mapping
    assert agent.contract.chunk == 10
    assert set(agent.contract.cameras or {}) == {"front", "wrist"}


# No protocol says whether actions are relative, except where the settings declare it.
PROTOCOLS: dict[str, dict[str, Any]] = {
    "openpi": OPENPI,
    "openpi, a preset": OPENPI | {"mapping": "openpi-libero"},
    "roboarena": {"protocol": "roboarena", "urls": ["ws://127.0.0.1:9"]},
    "openvla": {"protocol": "openvla", "urls": ["http://127.0.0.1:9"]},
    "vla_eval": {"protocol": "vla_eval", "urls": ["ws://127.0.0.1:9"]},
    "gr00t": {
        "protocol": "gr00t",
        "urls": ["tcp://127.0.0.1:9"],
        "mapping": {"preset": "gr00t", "action": {"arm": {"stop": 7}}},
    },
}


@pytest.mark.parametrize("delta", [True, False])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_foreign_policy_gets_the_mode_of_its_declared_contract(
    protocol: str, delta: bool
) -> None:
    contract = {"action": {"dim": 7}, "chunk": 10}
    undeclared = Upstream.from_config(PROTOCOLS[protocol] | {"contract": contract})
    choice = choose_for(undeclared, hz=10.0, delay_s=0.3)
    assert (choice.mode, choice.settings.execute) == ("open_loop", 5)
    assert "does not declare" in choice.line

    contract["action"] = {"dim": 7, "delta": delta}
    declared = Upstream.from_config(PROTOCOLS[protocol] | {"contract": contract})
    ours = choose(Contract(action=ActionSpec(dim=7, delta=delta), chunk=10), hz=10.0, delay_s=0.3)
    assert ours.mode == "async"
    assert choose_for(declared, hz=10.0, delay_s=0.3) == ours


@pytest.fixture(scope="module")
def gr00t() -> Iterator[str]:
    port = free_port()
    with upstream("gr00t", port):
        yield f"tcp://127.0.0.1:{port}"


GR00T: dict[str, Any] = {
    "cameras": {"front": "video/ego", "wrist": "video/wrist"},
    "state": {"joints": "state/arm"},
    "instruction": "language/*",
    "action": {"arm": {"stop": 6}, "gripper": {"start": 6}},
}


@pytest.mark.parametrize(
    ("mapping", "contract", "said"),
    [
        (
            {"cameras": {"front": "video/ego"}},
            {},
            r"video: expected \['wrist'\], which the upstream needs",
        ),
        ({"state": {}}, {}, r"state: expected \['arm'\], which the upstream needs"),
        ({"action": {"leg": {}}}, {}, r"mapping.action reads \['leg'\]"),
        ({"action": {}}, {}, "say in mapping.action which columns of ours each is"),
        ({}, {"chunk": 3}, "chunk: the upstream gives 4 rows, contract.chunk says 3"),
    ],
)
def test_a_mapping_that_is_not_what_the_upstream_needs_does_not_start(
    gr00t: str, mapping: dict[str, Any], contract: dict[str, Any], said: str
) -> None:
    config = {
        "protocol": "gr00t",
        "urls": [gr00t],
        "mapping": GR00T | mapping,
        "contract": contract,
    }
    with (
        pytest.raises(ContractMismatch, match=said),
        closing(Upstream.from_config(config)) as agent,
    ):
        agent.initialize()


def test_the_length_of_a_chunk_is_the_upstreams(gr00t: str) -> None:
    with Upstream.from_config({"protocol": "gr00t", "urls": [gr00t], "mapping": GR00T}) as agent:
        assert agent.contract.chunk is None
        agent.initialize()
        assert agent.contract.chunk == 4


def test_no_upstream_in_time_is_an_error() -> None:
    config = {**OPENPI, "urls": [f"ws://127.0.0.1:{free_port()}"], "connect_timeout_s": 0.2}
    with pytest.raises(PolicyUnavailable, match="is it running"):
        Upstream.from_config(config).initialize()


def test_a_key_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("UPSTREAM_KEY", raising=False)
    with pytest.raises(ConfigError, match="'UPSTREAM_KEY' is not set"):
        Upstream.from_config({**OPENPI, "key_env": "UPSTREAM_KEY"}).initialize()


Serving = Callable[..., str]


@pytest.fixture
def serving() -> Iterator[Serving]:
    """Yield a function that starts a server in this process with a handler, and returns its
    address.
    """
    with ExitStack() as stack:

        def serve_with(handler: Callable[[Any], None], **options: Any) -> str:
            server = stack.enter_context(
                serve(handler, "127.0.0.1", 0, compression=None, max_size=None, **options)
            )
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            stack.callback(thread.join)
            stack.callback(server.shutdown)
            return f"ws://127.0.0.1:{server.socket.getsockname()[1]}"

        yield serve_with


def test_the_key_is_sent_and_a_refused_one_is_an_error(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check(connection: Any, request: Any) -> Any:
        right = request.headers.get("Authorization") == "Api-Key right"
        return None if right else connection.respond(401, "no\n")

    url = serving(lambda connection: connection.send(pack_openpi({})), process_request=check)
    monkeypatch.setenv("UPSTREAM_KEY", "right")
    with Upstream.from_config({**OPENPI, "urls": [url], "key_env": "UPSTREAM_KEY"}) as agent:
        agent.initialize()
    monkeypatch.setenv("UPSTREAM_KEY", "wrong")
    with pytest.raises(Unauthorized, match="key_env"):
        Upstream.from_config({**OPENPI, "urls": [url], "key_env": "UPSTREAM_KEY"}).initialize()


ANSWERS: dict[str, bytes] = {
    "nothing": b"",
    "a pickle": b"\x80\x04\x95\x10cos\nsystem\n",
    "an extension type": b"\xc7\x01\x05\x00",
    "no map": pack_openpi([1, 2]),
    "no actions": pack_openpi({"action": 1}),
    "text": pack_openpi({"actions": "left"}),
    "four dimensions": pack_openpi({"actions": np.ones((1, 2, 3, 4))}),
    "objects": pack_openpi(
        {"actions": {b"__ndarray__": True, b"data": b"12345678", b"dtype": "|O", b"shape": (1,)}}
    ),
    "too short": pack_openpi(
        {"actions": {b"__ndarray__": True, b"data": b"1234", b"dtype": "<f8", b"shape": (9,)}}
    ),
    "deep": b"\x91" * 5000 + b"\x90",
}


@pytest.mark.parametrize("kind", sorted(ANSWERS))
def test_an_answer_that_is_none_is_an_error_of_ours(serving: Serving, kind: str) -> None:
    def answer(connection: Any) -> None:
        connection.send(pack_openpi({}))
        for message in connection:
            good = unpack_openpi(message)["prompt"] == "good"
            connection.send(pack_openpi({"actions": np.ones((2, 3))}) if good else ANSWERS[kind])

    config = {**OPENPI, "urls": [serving(answer)], "retry_s": 30}
    with Upstream.from_config(config) as agent:
        agent.initialize()
        copies = AgentCopies(agent)
        bad, good = copies.make(), copies.make()
        seen = Obs(state={"position": np.ones(1, np.float32)})
        bad.reset(seen, "bad"), good.reset(seen, "good")
        error, act = agent.act_batch([seen, seen], [bad, good])
        assert isinstance(error, VLAgentsError)
        assert act.action.shape == (2, 3)


def test_connections_share_a_batch(serving: Serving) -> None:
    # Each connection waits for the two others, so connections that are served in turn would wait
    # forever.
    together = threading.Barrier(3, timeout=60)

    def answer(connection: Any) -> None:
        connection.send(pack_openpi({}))
        for _ in connection:
            together.wait()
            connection.send(pack_openpi({"actions": np.ones((2, 3))}))

    with Upstream.from_config({**OPENPI, "urls": [serving(answer)], "connections": 3}) as agent:
        agent.initialize()
        wait_for(lambda: len(agent._lanes._ready) == 3)
        copies = AgentCopies(agent)
        sessions = [copies.make() for _ in range(3)]
        seen = Obs(state={"position": np.ones(1, np.float32)})
        assert all(act.action.shape == (2, 3) for act in agent.act_batch([seen] * 3, sessions))
