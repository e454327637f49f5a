"""A policy is evaluated while it is trained."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from eval_fakes import LINE, Clock, ToZero
from in_process_evaluation import flat_config
from in_process_replicas import Replicas
from served_agents import Proportional

from vlagents_ray.errors import ConfigError, NotTrainable, UnknownEnv
from vlagents_ray.evaluate import EvalConfig, Results, compare, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import PushedWeights
from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.weights.trainable import fingerprint
from vlagents_ray_learn import Publisher, TrainingEvaluation, training_evaluation


@pytest.fixture
def plan(tmp_path: Path) -> EvalConfig:
    return plan_in(tmp_path / "out")


def plan_in(out: Path, **changes: Any) -> EvalConfig:
    return flat_config(
        **{"envs": [LINE], "episodes": 4, "video": "none", "policy": "reach", "out": out} | changes
    )


@pytest.fixture
def agent() -> Proportional:
    """The agent of a trainer, which changes its gain."""
    made = Proportional()
    made.initialize()
    return made


@pytest.fixture
def served() -> Iterator[Replicas]:
    """The same agent in a replica."""
    found = Replicas([Proportional()])
    yield found
    found.close()


def episodes(out: Path, policy_id: str) -> list[EpisodeResult]:
    return [one.result for case in Results.load(out).of(policy_id) for one in case.episodes]


def test_each_version_is_a_checkpoint_of_the_results(plan: EvalConfig, agent: Proportional) -> None:
    evaluation = TrainingEvaluation(agent, plan)
    for version, gain in ((1, 0.1), (20, 1.0)):
        agent.tree["gain"][:] = gain
        summary = evaluation.play(version)
    assert summary.results.policy_ids == ["reach@1", "reach@20"]
    assert [group.success_once.successes for group in summary.totals] == [0, 4]
    assert {one.policy_version for one in episodes(plan.out, "reach@20")} == {20}
    written = json.loads((plan.out / "summary.json").read_text())
    assert [case["pushed_weights"] for case in written["cases"]] == [
        f"version 1 ({fingerprint({'gain': np.full(1, 0.1, np.float32)})})",
        f"version 20 ({fingerprint({'gain': np.ones(1, np.float32)})})",
    ]
    assert "version of the weights" in (plan.out / "report.html").read_text()
    assert [(one.key.episode, one.key.seed) for one in episodes(plan.out, "reach@1")] == [
        (i, i) for i in range(4)
    ]


def test_versions_are_compared_on_the_same_episodes(plan: EvalConfig, agent: Proportional) -> None:
    evaluation = TrainingEvaluation(agent, plan)
    evaluation.play(1)
    agent.tree["gain"][:] = 0.5
    results = evaluation.play(2).results
    first, second = episodes(plan.out, "reach@1"), episodes(plan.out, "reach@2")
    assert [one.instruction for one in first] == [one.instruction for one in second]
    assert len({one.instruction for one in first}) == 4
    assert [one.actions_sha256 for one in first] != [one.actions_sha256 for one in second]
    assert compare(results, "reach@2", "reach@1").total.pairs.total == 4


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_evaluations_keep_to_their_share_of_the_time(
    plan: EvalConfig, agent: Proportional, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    clock, spent, parts = Clock(), 0.0, []
    monkeypatch.setattr(training_evaluation, "monotonic", clock)
    evaluation = TrainingEvaluation(agent, plan, share=share)

    def takes_40_s(*_: Any, **__: Any) -> None:
        clock.now += 40

    monkeypatch.setattr(training_evaluation, "evaluate", takes_40_s)
    for version in range(1000):
        clock.now += 7  # of training
        begun = clock.now
        evaluation.play_if_due(version)
        if clock.now > begun:
            spent += 40
            parts.append(spent / clock.now)
    assert parts[0] > share, "the first is due at once"
    assert all(part <= share for part in parts[1:])
    assert parts[-1] > 0.9 * share, "and they use it"


def test_an_evaluation_that_fails_has_taken_its_time(
    plan: EvalConfig, agent: Proportional, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(training_evaluation, "monotonic", clock)
    evaluation = TrainingEvaluation(agent, plan, share=0.5)

    def breaks(*_: Any, **__: Any) -> None:
        clock.now += 40
        raise ConfigError("as a simulator that is not installed")

    monkeypatch.setattr(training_evaluation, "evaluate", breaks)
    with pytest.raises(ConfigError):
        evaluation.play_if_due(1)
    assert evaluation.play_if_due(2) is None


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 3])
def test_an_agent_of_this_process_has_the_results_of_a_served_one(
    tmp_path: Path, agent: Proportional, served: Replicas, num_envs: int
) -> None:
    with Publisher(served.engines[0]) as weights:
        for number, gain in enumerate((0.3, 0.9)):
            agent.tree["gain"][:] = gain
            version = weights.push(agent.parameters())
            usual = plan_in(tmp_path / f"served {number}", num_envs=num_envs, workers=0)
            evaluate(usual, agent_factory=partial(served.agent, priority="simulation"))
            TrainingEvaluation(agent, plan_in(tmp_path / f"here {number}", num_envs=num_envs)).play(
                version
            )
            one, other = (
                episodes(usual.out, "reach"),
                episodes(tmp_path / f"here {number}", f"reach@{version}"),
            )
            assert [alike(result) for result in one] == [alike(result) for result in other]
            assert {result.policy_version for result in one} == {version}
            assert len({result.actions_sha256 for result in one}) == 4


def alike(result: EpisodeResult) -> dict[str, Any]:
    """What two runs of an episode have in common, and the weights that acted."""
    return {name: value for name, value in result.outcome.items() if name != "key"} | {
        "weights": (result.first_policy_version, result.policy_version, result.policy_fingerprint)
    }


def test_the_trainers_own_episode_goes_on_as_without_an_evaluation(
    plan: EvalConfig, agent: Proportional
) -> None:
    obs = Obs(state={"position": np.ones(1, np.float32)})
    untouched = Proportional()
    untouched.initialize()
    for one in (agent, untouched):
        one.reset(obs, None, seed=7)
    TrainingEvaluation(agent, plan).play(1)
    assert agent.act(obs).action == untouched.act(obs).action
    assert agent.tree["gain"].flags.writeable


def test_no_results_are_made_again_and_none_are_taken_for_those_of_other_weights(
    plan: EvalConfig, agent: Proportional
) -> None:
    TrainingEvaluation(agent, plan).play(1)
    before = Results.load(plan.out).cases
    with pytest.raises(ConfigError, match="already has results; set resume=True"):
        TrainingEvaluation(agent, plan)
    again = TrainingEvaluation(agent, plan.model_copy(update={"resume": True}))
    again.play(1)
    assert Results.load(plan.out).cases == before
    agent.tree["gain"][:] = 2.0
    with pytest.raises(
        ConfigError, match=r"pushed_weights: the results have {.*'version': 1}, now"
    ):
        again.play(1)
    assert again.play(2).results.policy_ids == ["reach@1", "reach@2"]


def test_an_evaluation_that_was_cut_short_goes_on(plan: EvalConfig, agent: Proportional) -> None:
    class Broken(Proportional):
        def act(self, obs: Obs) -> Act:
            if self._seed == 2:
                raise KeyboardInterrupt
            return super().act(obs)

    broken = Broken()
    broken.initialize()
    with pytest.raises(KeyboardInterrupt):
        TrainingEvaluation(broken, plan).play(1)
    assert len(episodes(plan.out, "reach@1")) == 2
    TrainingEvaluation(agent, plan.model_copy(update={"resume": True})).play(1)
    assert [one.key.episode for one in episodes(plan.out, "reach@1")] == list(range(4))


def test_an_episode_of_other_weights_is_refused(plan: EvalConfig, served: Replicas) -> None:
    wanted = PushedWeights(version=3, fingerprint=fingerprint({"gain": np.ones(1, np.float32)}))
    [policy] = plan.policies
    config = plan.model_copy(
        update={"policies": [policy.model_copy(update={"pushed_weights": wanted})], "workers": 0}
    )
    with pytest.raises(
        ConfigError, match=r"expected version 3 of the weights \(\w+\) in .*, got 0 to 0 \(\w+\)"
    ):
        evaluate(config, agent_factory=served.agent)
    assert episodes(plan.out, "reach@3") == []


def test_weights_that_nobody_names_are_refused(plan: EvalConfig) -> None:
    with pytest.raises(NotTrainable):
        TrainingEvaluation(ToZero(), plan).play(1)


def test_an_agent_that_is_not_initialized_and_a_model_without_one_are_refused(
    plan: EvalConfig,
) -> None:
    with pytest.raises(
        NotTrainable, match=r"trainable: 'Proportional' object has no .*; call initialize\(\) first"
    ):
        TrainingEvaluation(Proportional(), plan).play(1)
    with pytest.raises(
        ConfigError, match="policy: expected an Agent, or the URL of its server, got dict"
    ):
        TrainingEvaluation({}, plan)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "share", "error"),
    [
        ({}, 0.0, "share: expected a part .* got 0.0"),
        ({}, 1.5, "share: expected a part .* got 1.5"),
        ({"steps": [1, 2]}, 0.1, "expected one policy without steps"),
        ({"envs": ["nowhere"]}, 0.1, "nowhere"),
    ],
)
def test_mistakes_are_refused_before_the_training_begins(
    tmp_path: Path, agent: Proportional, changes: dict[str, Any], share: float, error: str
) -> None:
    with pytest.raises((ConfigError, UnknownEnv), match=error):
        TrainingEvaluation(agent, plan_in(tmp_path / "out", **changes), share=share)


@pytest.mark.torch
def test_a_module_is_evaluated_without_dropout_and_trained_on_with_it(plan: EvalConfig) -> None:
    torch = pytest.importorskip("torch")

    class Module(TrainableAgent):
        trainable: ClassVar[str | None] = "module"

        def initialize(self) -> None:
            self.module = torch.nn.Sequential(
                torch.nn.Linear(1, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 1)
            )

        def act(self, obs: Obs) -> Act:
            with torch.no_grad():
                return Act(self.module(torch.from_numpy(obs.state["position"])).numpy().copy())

    trained = Module()
    trained.initialize()
    trained.module.train()
    trained.module[0].eval()  # as a frozen part
    TrainingEvaluation(trained, plan).play(1)
    assert [part.training for part in trained.module] == [False, True, True]
    [first, *_] = episodes(plan.out, "reach@1")
    trained.module.eval()
    other = plan_in(plan.out.with_name("again"))
    TrainingEvaluation(trained, other).play(1)
    assert episodes(other.out, "reach@1")[0].actions_sha256 == first.actions_sha256
