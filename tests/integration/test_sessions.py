"""Sessions over all transports, on one replica and on several."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest

from tests.integration.conftest import serving
from vlagents_ray import NotReset, Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.errors import MessageTooLarge
from vlagents_ray.images.codecs import JPEG
from vlagents_ray.serve.launch.server import Server

TRANSPORTS: list[TransportName] = ["shm", "plasma", "websocket", "http", "handle"]


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    """Serve one replica of a policy that is written as in the paper."""
    with serving("served_agents:Reacher", config={"scale": 2.0}, batch={"max_size": 8}) as server:
        yield server


def url(server: Server, transport: TransportName) -> str:
    return "serve://Reacher" if transport in ("handle", "plasma") else server.url


def obs(pixel: int, value: int = 0) -> Obs:
    return Obs(
        {"front": np.full((8, 8, 3), pixel, np.uint8)},
        0.5,
        {"joints": np.zeros(2, np.float32)},
        {"value": value},
    )


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_two_sessions_interleaved_never_mix(server: Server, transport: TransportName) -> None:
    choose = random.Random(7)
    with (
        RemoteAgent(url(server, transport), transport=transport) as red,
        RemoteAgent(url(server, transport), transport=transport) as blue,
    ):
        agents = {"red": red, "blue": blue}
        pixels = {"red": 10, "blue": 200}
        for name, agent in agents.items():
            assert (
                agent.reset(obs(pixels[name]), f"the {name} cube", seed=1)["instruction"]
                == f"the {name} cube"
            )
            assert agent.transport == transport
        counts, sums = dict.fromkeys(agents, 0), dict.fromkeys(agents, 0)
        for _ in range(300):
            name = choose.choice(sorted(agents))
            value = choose.randrange(100)
            counts[name] += 1
            sums[name] += value
            act = agents[name].act(obs(0, value))
            assert act.info["instruction"] == f"the {name} cube"
            assert act.info["value"] == value
            assert act.action.tolist() == [counts[name], 2.0 * sums[name], pixels[name]]


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_episode_begins_from_scratch_and_a_closed_session_has_to_be_reset(
    server: Server, transport: TransportName
) -> None:
    agent = RemoteAgent(url(server, transport), transport=transport)
    for _ in range(3):
        agent.reset(obs(1), "x")
        act = agent.act(obs(1, 5))
        assert act.action.tolist() == [1, 10.0, 1]
        timing = act.info["timing"]
        stages = [timing[f"{stage}_ms"] for stage in ("decode", "queue", "inference", "encode")]
        assert min(stages) > 0
        assert sum(stages) <= timing["total_ms"] < timing["round_trip_ms"]
        assert timing["wire_ms"] == timing["round_trip_ms"] - timing["total_ms"]
    agent.close()
    with pytest.raises(NotReset):
        agent.act(obs(1))
    agent.reset(obs(1), "y")
    assert agent.act(obs(1)).info["instruction"] == "y"
    agent.close()


def test_jpeg_reaches_the_policy_as_pixels(server: Server) -> None:
    with RemoteAgent(server.url, codec=JPEG, transport="websocket") as agent:
        agent.reset(obs(128), "x")
        assert abs(agent.act(obs(0)).action[2] - 128) <= 2


def test_a_message_over_the_websockets_limit_says_what_to_do(server: Server) -> None:
    huge = Obs({"front": np.zeros((2500, 2500, 3), np.uint8)}, info={"value": 0})
    with (
        RemoteAgent(server.url, codec="raw", transport="websocket") as agent,
        pytest.raises(MessageTooLarge, match="JPEG"),
    ):
        agent.reset(huge)
    with RemoteAgent(server.url, codec="raw", transport="http") as agent:
        agent.reset(huge)


@pytest.mark.parametrize("inside", [False, True])
def test_shared_memory_is_chosen_on_one_machine(server: Server, inside: bool) -> None:
    with RemoteAgent("serve://Reacher" if inside else server.url) as agent:
        assert agent.transport == "auto"
        agent.reset(obs(1), "x")
        assert agent.transport == "shm"
