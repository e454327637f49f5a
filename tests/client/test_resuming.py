"""A session over the loss of its replica, and many sessions over one connection; no Ray, no sockets."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from in_process import Replicas

from vlagents_ray import (
    Act,
    Agent,
    ConfigError,
    ConnectionLost,
    InvalidObservation,
    NotReset,
    Obs,
    PolicyFailed,
    PolicyUnavailable,
)
from vlagents_ray.contract import Contract


class Window(Agent):
    """Acts on the last three values that it saw, and counts its acts."""

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
    made: list[Replicas] = []

    def make(n: int) -> Replicas:
        made.append(Replicas([Window() for _ in range(n)]))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_a_session_of_a_replica_that_stops_moves_with_all_it_has(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(2)
    expected = [np.random.default_rng(3).random(6)]
    agent = served.agent()
    agent.reset(obs(1), "stack", seed=3)
    drawn = [agent.act(obs(value)).info["random"] for value in (2, 3)]
    served.engines[0].draining = True
    for value in (4, 5, 6, 7):
        act = agent.act(obs(value))
        assert "resumed" not in act.info
        drawn.append(act.info["random"])
    assert drawn == expected[0].tolist()
    assert act.info["acts"] == 6
    assert len(served.engines[1].sessions) == 1
    assert len(served.engines[0].sessions) == 0
    agent.close()


def test_a_session_of_a_dead_replica_begins_again_and_sees_its_history(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(2)
    agent = served.agent()
    frame = obs(1)
    agent.reset(frame, "stack", seed=3)
    for value in (2, 3, 4):
        frame.cameras["front"][:] = value  # an env that renders into the same memory each time
        agent.act(frame)
    served.dead.add(0)
    act = agent.act(obs(5))
    assert act.info["resumed"]
    assert act.action.tolist() == [3, 4, 5]
    assert act.info["instruction"] == "stack"
    assert "resumed" not in agent.act(obs(6)).info
    agent.close()


def test_an_answer_that_was_lost_is_not_acted_on_twice(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(1)
    agent = served.agent()
    agent.reset(obs(1), "stack")
    agent.act(obs(2))
    served.lose_reply = True
    act = agent.act(obs(3))
    assert act.info["resumed"]
    assert act.action.tolist() == [1, 2, 3]
    agent.close()


def test_without_resuming_the_loss_is_raised_and_a_reset_is_needed(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(2)
    agent = served.agent(resume=False)
    agent.reset(obs(1), "stack")
    served.dead.add(0)
    with pytest.raises(ConnectionLost):
        agent.act(obs(2))
    with pytest.raises(NotReset):
        agent.act(obs(2))
    agent.reset(obs(1), "stack")
    assert agent.act(obs(2)).info["acts"] == 1
    agent.close()


def test_when_nobody_lives_the_loss_is_raised_in_time_and_a_later_act_goes_on(
    replicas: Callable[[int], Replicas],
) -> None:
    served = replicas(1)
    agent = served.agent()
    agent._connection.timeout_s = 0.3
    agent.reset(obs(1), "stack")
    agent.act(obs(2))
    served.dead.add(0)
    with pytest.raises((ConnectionLost, PolicyUnavailable)):
        agent.act(obs(3))
    served.dead.clear()
    act = agent.act(obs(4))
    assert act.action.tolist() == [1, 2, 4]
    agent.close()


def test_a_server_that_stops_and_starts_again_is_waited_for(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(1)
    agent = served.agent()
    agent.reset(obs(1), "stack")
    agent.act(obs(2))
    agent._connection.timeout_s = 0.3
    served.dead.add(0)
    served.stopping = True
    with pytest.raises(PolicyUnavailable, match="gone"):
        agent.act(obs(3))
    served.dead.clear()
    threading.Timer(0.1, lambda: setattr(served, "stopping", False)).start()
    agent._connection.timeout_s = 30.0
    assert agent.act(obs(4)).action.tolist() == [1, 2, 4]
    agent.close()


def test_an_observation_may_allow_less_time(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(1)
    agent = served.agent(timeout_s=30.0)
    agent.reset(obs(1), "stack")
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


def test_one_session_that_fails_leaves_its_neighbours_alone(replicas: Callable[[int], Replicas]) -> None:
    served = replicas(1)
    agent = served.agent()
    envs = agent.sessions(3)
    agent.reset_batch([obs(i) for i in range(3)], [None] * 3, envs)
    bad = Obs({"front": np.zeros((4, 4, 3), np.float32)})
    acts = agent.act_batch([obs(1), bad, obs(2)], envs)
    assert isinstance(acts[0], Act)
    assert isinstance(acts[1], Exception)
    assert "want (H, W, 3) uint8" in str(acts[1])
    assert isinstance(acts[2], Act)
    infos = agent.reset_batch([obs(0)], [None], [envs[0]], fail=True)
    assert isinstance(infos[0], PolicyFailed)
    with pytest.raises(NotReset):
        envs[0].act(obs(0))
    with pytest.raises(ConfigError, match="observations for"):
        agent.act_batch([obs(0)], envs)
    stranger = served.agent()
    with pytest.raises(ConfigError, match="share its connection"):
        agent.act_batch([obs(0)], [stranger])
    for env in envs:
        env.close()
