"""A deployment's policy that runs in this process gives the same results as a replica."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE
from in_process_evaluation import flat_config
from in_process_replicas import Replicas

from vlagents_ray.abilities import BeginsWithPlan, HasSuccess, ability
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ContractMismatch
from vlagents_ray.evaluate import Summary, evaluate
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy, policy_metadata
from vlagents_ray.success import Solved, SuccessCurve, write_curves

THIS = f"{__name__}:Trembling"


class Trembling(Agent):
    """A policy that steps to zero with noisy steps. It fails in some third acts, so its count of
    acts must belong to one episode.
    """

    def __init__(self, length: float = 1.0) -> None:
        self.length, self.acts = length, 0

    @property
    def contract(self) -> Contract:
        return Contract(state={"position": StateSpec(1)}, action=ActionSpec(dim=1))

    def reset(
        self, obs: Obs, instruction: str | None, *, seed: int | None = None, **kwargs: Any
    ) -> dict[str, Any]:
        self.noise = np.random.default_rng(seed)
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        if self.acts == 3 and self.noise.random() < 0.3:
            raise ValueError("a third act that fails at times")
        return Act(-np.sign(obs.state["position"]) * self.length * self.noise.uniform(0.5, 1.0, 1))


class Beginning(Trembling):
    """A policy whose chunks begin with rows of the plan."""

    continues_plans = True
    longest_prefix = 3


@pytest.fixture
def replica() -> Iterator[Replicas]:
    replicas = Replicas([Trembling(0.8)])
    yield replicas
    replicas.close()


def outcomes(summary: Summary) -> list[dict[str, Any]]:
    """Return the results that are equal in all runs. The message of an error contains the id of its
    request.
    """
    found = [one.result.outcome for case in summary.results.cases for one in case.episodes]
    return [one | {"error": (one["error"] or "").partition(";")[0]} for one in found]


@pytest.mark.parametrize("num_envs", [1, 3])
def test_its_episodes_are_those_of_a_replica(
    num_envs: int, replica: Replicas, tmp_path: Path
) -> None:
    args = ServerArgs(policy=THIS)
    found = []
    for name, make in {
        "here": partial(LocalPolicy, args, {"length": 0.8}),
        "there": partial(replica.agent, priority="simulation", resume=False),
    }.items():
        plan = flat_config(
            envs=[LINE],
            episodes=12,
            num_envs=num_envs,
            workers=0,
            video="none",
            out=tmp_path / name,
        )
        found.append(evaluate(plan, agent_factory=make))
    here, there = map(outcomes, found)
    assert here == there
    assert {one["status"] for one in here} == {"done", "policy_error"}
    described = found[0].results.policies["policy"]
    assert (described["policy"], described["config"]) == (THIS, {"length": 0.8})


def test_it_has_the_abilities_that_the_choice_of_a_mode_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    curve = SuccessCurve("line", 10.0, "async", {}, {0: Solved(9, 10, 25.0)})
    write_curves(tmp_path, [curve])
    (tmp_path / "weights.pt").write_bytes(b"1")
    monkeypatch.setattr(
        Beginning, "initialize", lambda _: find_checkpoint(str(tmp_path / "weights.pt"))
    )
    agent = LocalPolicy(ServerArgs(policy=f"{__name__}:Beginning"), {})
    agent.initialize()
    try:
        prefixes, success = ability(agent, BeginsWithPlan), ability(agent, HasSuccess)
        assert prefixes is not None
        assert prefixes.longest_prefix == 3
        assert success is not None
        assert [*success.success_curves] == [curve]
    finally:
        agent.close()


def test_the_contract_of_the_environment_is_compared_first() -> None:
    agent = LocalPolicy(ServerArgs(policy=THIS), {})
    agent.initialize()
    other = Contract(state={"position": StateSpec(2)}, action=ActionSpec(dim=1)).to_json()
    with pytest.raises(ContractMismatch, match="position"):
        agent.reset(Obs(state={"position": np.ones(2, np.float32)}), "go", contract=other)
    agent.close()


def test_ctrl_c_in_a_call_is_no_error_of_the_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> Act:
        raise KeyboardInterrupt

    agent = LocalPolicy(ServerArgs(policy=THIS), {})
    agent.initialize()
    obs = Obs(state={"position": np.ones(1, np.float32)})
    agent.reset(obs, "go", seed=1)
    monkeypatch.setattr(Trembling, "act", interrupted)
    with pytest.raises(KeyboardInterrupt):
        agent.act(obs)
    agent.close()


@pytest.mark.parametrize(("agent", "stated"), [(Beginning(), (True, 3)), (Trembling(), (False, 0))])
def test_the_metadata_say_how_chunks_continue_plans(agent: Agent, stated: tuple[bool, int]) -> None:
    replicas = Replicas([agent])
    try:
        # After the policy has loaded.
        replicas.agent().reset(Obs(state={"position": np.zeros(1)}), None)
        metadata = policy_metadata(ServerArgs(policy=THIS), replicas.engines[0], None, {})
        assert (metadata["continues_plans"], metadata["longest_prefix"]) == stated
    finally:
        replicas.close()
