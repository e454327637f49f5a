"""When a session begins whose client's protocol has no reset, on either side of the gateway."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import pytest
from dialect_server import body, serving
from in_process_replicas import Replicas
from served_agents import Mirror, Witness

from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import ImplicitEpisode
from vlagents_ray.serve.dialects.gateway_sessions import GatewaySessions
from vlagents_ray.serve.dialects.openvla import OpenVLADialect
from vlagents_ray.wire import openvla


def test_an_episode_begins_with_the_first_observation_and_with_each_new_instruction() -> None:
    episode = ImplicitEpisode()
    assert episode.begins(None)
    assert episode.opening("lift", None) == "lift"
    episode.began("lift")
    assert [episode.begins(text) for text in ("lift", None, "push")] == [False, False, True]
    episode.end()
    assert episode.begins(None)
    assert episode.opening(None, None) == "lift"  # goes on under the one before


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
    sessions = GatewaySessions(lambda _key, _rank: replicas.agent(), Contract(instruction=True))
    sessions.show(NoKey.OPEN, None)
    obs = Obs({"front": np.zeros((8, 8, 3), np.uint8)})

    def acted(*texts: str | None) -> list[tuple[int, int]]:
        """The length of each session's instruction, and which act of its episode it was."""
        acts = sessions.act_batch([obs] * len(texts), texts)
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


class WithReset(OpenVLADialect):
    """A protocol over HTTP that has a reset."""

    paths: ClassVar[Mapping[str, str]] = {**OpenVLADialect.paths, "POST /reset": "end_episode"}


def test_a_reset_over_http_begins_an_episode_of_the_session_that_it_names() -> None:
    with serving(Mirror(), {f"{__name__}:WithReset": {}}) as (client, _):

        def count(session: str) -> float:
            answer = client.post("/act", json=body(5), headers={"x-session-id": session})
            return float(openvla.decode(b'{"action": %s}' % answer.content)[0]["action"][2])

        assert client.post("/reset", headers={"x-session-id": "a"}).status_code == 200
        assert [count("a"), count("a"), count("b")] == [1, 2, 1]
        answer = client.post("/reset", headers={"x-session-id": "a"})
        assert (answer.status_code, answer.json()) == (200, {})
        assert [count("a"), count("b")] == [1, 2]
        assert client.post("/reset").json()["code"] == "malformed"
