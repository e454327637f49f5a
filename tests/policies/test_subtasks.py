"""The wrapper that resets a policy's session with each new subtask of a planner."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import SUBTASK
from vlagents_ray.policies.subtasks import Subtasks
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.testing import check_agent


class Obedient(Agent):
    """A policy that returns the instruction of its last reset, and the number of acts since."""

    contract = Contract(action=ActionSpec(dim=1))

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if instruction == "fly":
            raise InvalidObservation("instruction: expected something on the ground, got 'fly'")
        self.instruction, self.seed, self.acts = instruction, kwargs.get("seed"), 0
        return {"began": instruction}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        info = {"obeys": self.instruction, "seed": self.seed}
        return Act(np.full(1, self.acts, np.float32), info=info)


def obs(subtask: object = None) -> Obs:
    return Obs(info={} if subtask is None else {SUBTASK: subtask})


def test_keeps_the_contract() -> None:
    check_agent(Subtasks(Obedient()), obs=[obs(), obs("lift"), obs("lift")])


def test_each_new_subtask_resets_its_session_with_the_options_of_the_episode() -> None:
    session = AgentCopies(build_agent(f"{__name__}:Obedient", {}, ["subtasks"])).make()
    assert session.reset(obs(), "tidy up", seed=3) == {"began": "tidy up"}
    answers = [session.act(obs(subtask)) for subtask in (None, "lift", "lift", None, "put")]
    assert [act.info["obeys"] for act in answers] == ["tidy up", "lift", "lift", "lift", "put"]
    assert [act.action.tolist() for act in answers] == [[1], [1], [2], [3], [1]]
    assert {act.info["seed"] for act in answers} == {3}
    assert session.reset(obs("lift"), "tidy up") == {"began": "lift"}
    assert session.act(obs()).info["seed"] is None


def test_a_subtask_that_is_refused_fails_its_own_session_until_there_is_another_one() -> None:
    agent = Subtasks(Obedient())
    copies = AgentCopies(agent)
    sessions = [copies.make(), copies.make(), copies.make()]
    for session in sessions:
        session.reset(obs(), "tidy up")
    batch = [obs("fly"), obs("lift"), obs(7)]
    refused, good, wrong = agent.act_batch(batch, sessions)
    assert isinstance(refused, InvalidObservation)
    assert isinstance(good, Act)
    assert good.info["obeys"] == "lift"
    assert str(wrong).startswith("info['subtask']: expected a text, got 7")

    [again] = agent.act_batch([obs("fly")], [sessions[0]])
    assert isinstance(again, InvalidObservation)
    [other] = agent.act_batch([obs("put")], [sessions[0]])
    assert isinstance(other, Act)
    assert other.info["obeys"] == "put"
