"""Tests of the gateway as Ray Serve uses it, of its clients' sessions, and of the policy `upstream`
in front of it.
"""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gr00t_client import PolicyClient
from in_process_replicas import Replicas
from rpyc_client import Client, document
from served_agents import Witness

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, InvalidObservation, PolicyFailed, PolicyUnavailable
from vlagents_ray.interface import Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects import gateway as module
from vlagents_ray.serve.dialects.base import ImplicitEpisode
from vlagents_ray.serve.dialects.gateway import Gateway, ServedPolicy
from vlagents_ray.serve.ports import free_port
from vlagents_ray_dialects.gateway_sessions import GatewaySessions
from vlagents_ray_dialects.upstream import Upstream


@pytest.mark.parametrize("dialect", ["vlagents", "lerobot"])
def test_with_keys_on_a_protocol_without_them_must_accept_whoever_reaches_it(
    open_dialect: Any, dialect: str
) -> None:
    """tests/serve/test_access_matrix.py tests that clients are served after this is accepted."""
    with pytest.raises(ConfigError, match="without_key: true"):
        open_dialect(dialect, check=lambda _: NoKey.OPEN)
    open_dialect(dialect, check=lambda _: NoKey.OPEN, without_key=True)


def test_a_gateway_serves_each_dialect_on_its_port_and_is_healthy_while_all_are(
    replicas: Replicas, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        module.serve, "get_replica_context", lambda: SimpleNamespace(app_name="noop")
    )
    policy = ServedPolicy(contract=None, continues_plans=False, longest_prefix=0)
    monkeypatch.setattr(module, "wait_for_policy", lambda _app: policy)
    monkeypatch.setattr(module, "_connect", lambda *_: replicas.agent())
    ports = {"vlagents": free_port(), "gr00t": free_port()}
    stated = {name: {"port": port} for name, port in ports.items()} | {"openvla": {}}
    args = ServerArgs(policy="noop", dialects=stated)
    made = SimpleNamespace(_dialects=[])
    Gateway._open(made, args)
    try:
        Gateway.check_health(made)
        with Client(ports["vlagents"]) as client:
            assert client.act(document(7))[0] == 7
        video, state = np.full((1, 1, 8, 8, 3), 9, np.uint8), np.full((1, 1, 2), 0.5, np.float32)
        with PolicyClient(ports["gr00t"]) as robot:
            actions, _ = robot.get_action(
                {"video": {"front": video}, "state": {"arm": state}, "language": {}}
            )
        assert actions["action"][0, 0, :2].tolist() == [9, 0.5]
        made._dialects[-1].close()
        with pytest.raises(PolicyUnavailable, match=rf"\['{made._dialects[-1].name}'\]"):
            Gateway.check_health(made)
    finally:
        asyncio.run(Gateway.__del__(made))
    assert not any(dialect.alive() for dialect in made._dialects)


def test_an_episode_begins_with_the_first_observation_and_with_each_new_instruction() -> None:
    episode = ImplicitEpisode()
    assert episode.begins(None)
    assert episode.opening("lift", None) == "lift"
    episode.began("lift")
    assert [episode.begins(text) for text in ("lift", None, "push")] == [False, False, True]
    episode.end()
    assert episode.begins(None)
    # Without an instruction, the episode continues with the previous one.
    assert episode.opening(None, None) == "lift"


def test_a_policy_that_needs_an_instruction_gets_one() -> None:
    episode, needs = ImplicitEpisode(), Contract(instruction=True)
    with pytest.raises(InvalidObservation, match="send it with the observation"):
        episode.opening(None, needs)
    assert episode.opening("lift", needs) == "lift"


def test_a_session_that_was_reset_without_an_instruction_begins_with_the_next_one() -> None:
    episode = ImplicitEpisode()
    episode.began("lift")
    episode.began(None)
    assert not episode.begins(None)
    assert episode.begins("lift")


def test_a_client_of_the_gateway_keeps_its_instruction_and_each_session_its_own() -> None:
    replicas = Replicas([Witness()])
    sessions = GatewaySessions(lambda _key, _priority: replicas.agent(), Contract(instruction=True))
    sessions.show(NoKey.OPEN, None)
    obs = Obs({"front": np.zeros((8, 8, 3), np.uint8)})

    def acted(*texts: str | None) -> list[tuple[int, int]]:
        """Return the length of each session's instruction, and the number of the act in its
        episode.
        """
        acts = sessions.act_batch(sessions.account.charge(), [obs] * len(texts), texts)
        return [(int(act.action[0][3]), int(act.action[0][4])) for act in acts]

    try:
        assert acted("a", "ab") == [(1, 1), (2, 1)]
        assert acted(None, "abc") == [(1, 2), (3, 1)]
        sessions.restart()
        assert acted(None, None) == [(1, 1), (3, 1)]
        with pytest.raises(InvalidObservation):
            acted(None, None, None)
        assert acted(None, None, "abcd") == [(1, 2), (3, 2), (4, 1)]
    finally:
        sessions.close()
        replicas.close()


VLAGENTS: dict[str, Any] = {
    "cameras": {"front": "arm/cameras/front"},
    "state": {"joints": "arm/joints"},
    "gripper": "arm/gripper",
    "instruction": "language_instruction",
}


def seen(pixel: int, gripper: float = 0.25) -> Obs:
    joints = np.full(7, 0.5, np.float32)
    return Obs({"front": np.full((16, 16, 3), pixel, np.uint8)}, gripper, {"joints": joints})


@pytest.mark.parametrize(
    ("protocol", "scheme", "mapping", "gripper"),
    [("vlagents", "rpyc", VLAGENTS, 0.25), ("gr00t", "tcp", "gr00t", -1.0)],
)
def test_each_session_is_one_of_the_upstreams(
    open_dialect: Any, protocol: str, scheme: str, mapping: Any, gripper: float
) -> None:
    url = f"{scheme}://127.0.0.1:{open_dialect(protocol)}"
    config = {"protocol": protocol, "urls": [url], "mapping": mapping, "sessions": "connection"}
    with Upstream.from_config(config) as agent:
        agent.initialize()
        copies = AgentCopies(agent)
        red, blue = copies.make(), copies.make()
        red.reset(seen(10), "abc"), blue.reset(seen(20), "abcdef")
        for step in (1, 2):
            acts = agent.act_batch([seen(10 + step), seen(20 + step)], [red, blue])
            rows = [act.rows()[0].tolist() for act in acts]
            assert rows == [[10 + step, 0.5, gripper, 3, step], [20 + step, 0.5, gripper, 6, step]]


def test_an_error_of_vlagents_is_one_of_the_upstream(open_dialect: Any) -> None:
    mapping = {"cameras": {"cam": "cameras/front"}}
    url = f"rpyc://127.0.0.1:{open_dialect('vlagents', mapping=mapping)}"
    config = {"protocol": "vlagents", "urls": [url], "mapping": {"state": {"joints": "arm/joints"}}}
    with Upstream.from_config(config) as agent:
        agent.initialize()
        session = AgentCopies(agent).make()
        session.reset(seen(1), "abc")
        [error] = agent.act_batch([seen(1)], [session])
        assert isinstance(error, PolicyFailed)
        assert "missing" not in str(error)
