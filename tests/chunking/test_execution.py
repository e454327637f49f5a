"""What a chunk player states of what it executed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.chunking.execution import PLAYED, WATCHED
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.errors import DeadlineExceeded
from vlagents_ray.interface import SAFE, Act, Agent, Obs

OBS = Obs(state={"joints": np.zeros(2, np.float32)})


class Counting(Agent):
    """Chunks of four rows that say which request they answer; keeps what the requests stated."""

    def __init__(self, watched: bool = True) -> None:
        self.watched = watched
        self.stated: list[dict[str, Any]] = []
        self.failing: Exception | None = None

    def act(self, obs: Obs) -> Act:
        if PLAYED in obs.info:
            self.stated.append(obs.info[PLAYED])
        if self.failing is not None:
            raise self.failing
        info = {WATCHED: True} if self.watched else {}
        return Act(np.arange(8, dtype=np.float32).reshape(4, 2) + 100 * len(self.stated), info=info)


def test_each_request_states_what_was_executed_since_the_one_before() -> None:
    policy = Counting()
    player = ChunkPlayer(policy, PlayerSettings(execute=3))
    player.reset(OBS)
    acts = [player.act(OBS).action for _ in range(7)]
    second, third = policy.stated  # the first request was before the first answer, which says that somebody watches
    assert (second["step"], second["steps"].tolist()) == (3, [0, 1, 2])
    assert (third["step"], third["steps"].tolist()) == (6, [3, 4, 5])
    np.testing.assert_array_equal(np.concatenate([second["rows"], third["rows"]]), np.stack(acts[:6]))
    assert third["age_ms"] >= 0
    assert (third["safe"], third["safe_ticks"], third["safe_spells"], third["late"]) == ("", 0, 0, 0)


def test_nothing_is_stated_while_nobody_watches() -> None:
    policy = Counting(watched=False)
    player = ChunkPlayer(policy, PlayerSettings(execute=1))
    player.reset(OBS)
    acts = [player.act(OBS) for _ in range(5)]
    assert policy.stated == []
    policy.watched = True
    acts += [player.act(OBS) for _ in range(2)]
    assert [one["steps"].tolist() for one in policy.stated] == [[0, 1, 2, 3, 4, 5]]
    assert not any(WATCHED in act.info for act in acts)


def test_safe_actions_are_stated_with_their_reason_and_not_as_executed_rows() -> None:
    policy = Counting()
    player = ChunkPlayer(policy, PlayerSettings(execute=4, deadline_s=5.0, safe="hold"))
    player.reset(OBS)
    for _ in range(4):
        player.act(OBS)
    policy.failing = DeadlineExceeded("too late")
    for _ in range(2):
        assert "too late" in player.act(OBS).info[SAFE]
    policy.failing = None
    player.act(OBS)
    assert [one["steps"].tolist() for one in policy.stated] == [[0, 1, 2, 3], [], []]
    stated = policy.stated[-1]
    assert "too late" in stated["safe"]
    assert (stated["safe_ticks"], stated["safe_spells"], stated["late"]) == (2, 1, 2)
    player.close()


def test_an_action_that_the_stopped_robot_did_not_execute_is_not_stated() -> None:
    policy = Counting()
    player = ChunkPlayer(policy, PlayerSettings(execute=4))
    player.reset(OBS)
    player.act(OBS)
    player.act(OBS)
    player.interrupt()
    player.act(OBS)
    stated = policy.stated[-1]
    assert stated["steps"].tolist() == [0]
    assert "stopped" in stated["safe"]


def test_nothing_of_the_episode_before_is_stated() -> None:
    policy = Counting()
    player = ChunkPlayer(policy, PlayerSettings(execute=1))
    for _ in range(2):
        player.reset(OBS)
        for _ in range(3):
            player.act(OBS)
    steps = [one["steps"].tolist() for one in policy.stated]
    assert steps == [[0], [1], [3], [4]], "the last one of the first episode is left out"


@pytest.mark.parametrize("rows", [0, 100])
def test_a_request_states_a_bounded_number_of_rows(rows: int) -> None:
    policy = Counting()
    policy_rows = np.zeros((rows + 1, 2), np.float32)
    policy.act = lambda obs: policy.stated.append(obs.info.get(PLAYED)) or Act(policy_rows, info={WATCHED: True})  # type: ignore[method-assign]
    player = ChunkPlayer(policy)
    player.reset(OBS)
    for _ in range(rows + 2):
        player.act(OBS)
    assert len(policy.stated[-1]["rows"]) == min(rows + 1, 64)
