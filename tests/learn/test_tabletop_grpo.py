"""GRPO on the tabletop: the student of tokens and its learner, in one process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from eval_fakes import wait_for
from grpo import GRPOLearner, group_advantages
from learner import inputs_of
from ray_processes import end, ray_folder
from tabletop_runs import ended, start_run, table
from teacher import Teacher
from token_student import TOKENS, TokenStudent, actions_of, tokens_of
from train import ENV_OPTIONS

from vlagents_ray import Act, Obs
from vlagents_ray.envs.tabletop.env import Tabletop
from vlagents_ray.interface import BEHAVIOUR, WANT
from vlagents_ray.testing.agents import check_agent

pytestmark = pytest.mark.torch

STEPS = 6  # of an episode


def wanting(obs: Obs) -> Obs:
    return Obs(obs.cameras, obs.gripper, obs.state, {WANT: ["logprob", "entropy", "replay"]})


def ready(text: str = "lift the red puck", **kwargs: Any) -> tuple[TokenStudent, Obs]:
    """A student at the beginning of an episode."""
    student = TokenStudent()
    student.initialize()
    obs, _ = Tabletop("lift", **ENV_OPTIONS).reset(seed=1)
    student.reset(obs, text, **kwargs)
    return student, obs


def transitions(students: list[TokenStudent], starts: list[int], solved: list[bool]) -> dict[str, np.ndarray]:
    """The columns of an episode of each student, of which some are called solved at their last step."""
    rows: dict[str, list[Any]] = {}
    for number, (student, start) in enumerate(zip(students, starts, strict=True)):
        env = Tabletop("lift", **ENV_OPTIONS)
        obs, _ = env.reset(seed=start)
        student.reset(obs, env.instruction, seed=number)
        for t in range(STEPS):
            act = student.act(wanting(obs))
            said = act.info[BEHAVIOUR]
            row = {
                "episode": start,
                "t": t,
                "cameras.front": obs.cameras["front"],
                "state.xyzrpy": obs.state["xyzrpy"],
                "gripper": obs.gripper,
                "instruction": env.instruction,
                "action": act.action,
                "success": solved[number] and t == STEPS - 1,
                "logprob": said["logprob"].sum(),
                "replay.tokens": said["replay"]["tokens"],
            }
            for name, value in row.items():
                rows.setdefault(name, []).append(value)
            obs, *_ = env.step(act)
    return {name: np.array(values) for name, values in rows.items()}


def test_a_token_is_the_nearest_bin_of_a_number() -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 4))
    assert np.abs(actions_of(tokens_of(actions)) - actions).max() <= 1 / (TOKENS - 1) + 1e-6
    np.testing.assert_array_equal(actions_of(np.array([0, TOKENS // 2, TOKENS - 1])), [-1, 0, 1])
    np.testing.assert_array_equal(tokens_of(np.array([-3.0, 3.0])), [0, TOKENS - 1])


def test_advantages_are_those_of_the_formula_and_groups_of_one_outcome_have_none() -> None:
    outcomes = [[0, 0, 1], [0, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 1], [0, 0, 1], [0, 0, 0], [0, 0, 0]]
    columns = {
        "episode": np.repeat([5, 5, 5, 5, 2, 2, 3, 3], 3),
        "t": np.tile([0, 1, 2], 8),
        "success": np.array(outcomes, bool).ravel(),
    }
    better = 0.5 / (0.5 + 1e-6)  # two of four were solved
    expected = [[better] * 3, [-better] * 3, [better, better, 0], [-better] * 3, *[[0] * 3] * 4]
    np.testing.assert_allclose(group_advantages(columns).reshape(8, 3), expected, rtol=1e-6)


def test_the_student_keeps_what_an_agent_promises_and_neighbours_change_no_bit() -> None:
    check_agent(TokenStudent(), instructions=["lift the red puck", "lift the blue puck", "lift the green puck"])
    (student, obs), (other, _) = ready(seed=3), ready("lift the blue puck", seed=4)
    alone = student.act(wanting(obs))
    student.reset(obs, "lift the red puck", seed=3)
    _, together = other.act_batch([Obs(obs.cameras, 0.5, obs.state), wanting(obs)], [other, student])
    assert isinstance(together, Act)
    np.testing.assert_array_equal(alone.action, together.action)
    said, also = alone.info[BEHAVIOUR], together.info[BEHAVIOUR]
    np.testing.assert_array_equal(said["logprob"], also["logprob"])
    np.testing.assert_array_equal(said["replay"]["tokens"], also["replay"]["tokens"])
    assert said["entropy"] == also["entropy"]
    assert set(said) == set(student.contract.behaviour)


def test_a_log_probability_is_that_of_the_softmax_which_the_tokens_are_drawn_from() -> None:
    import torch

    student, obs = ready(seed=3)
    learner = GRPOLearner()  # with the network of the same seed
    seen = {"cameras.front": obs.cameras["front"][None], "state.xyzrpy": obs.state["xyzrpy"][None]}
    seen |= {"gripper": np.array([obs.gripper]), "instruction": np.array(["lift the red puck"], object)}
    with torch.no_grad():
        logits = learner.network.policy(learner.network.features(torch.from_numpy(inputs_of(seen))))
    softmax = torch.distributions.Categorical(logits=logits.reshape(4, TOKENS))
    acts = [student.act(wanting(obs)) for _ in range(1000)]
    tokens = np.stack([act.info[BEHAVIOUR]["replay"]["tokens"][0] for act in acts])
    for act, drawn in zip(acts[:20], tokens, strict=False):
        said = act.info[BEHAVIOUR]
        np.testing.assert_array_equal(act.action, actions_of(drawn))
        np.testing.assert_allclose(said["logprob"][0], softmax.log_prob(torch.from_numpy(drawn)), rtol=1e-4)
        assert said["entropy"] == pytest.approx(float(softmax.entropy().sum()), rel=1e-4)
    shares = np.stack([np.bincount(column, minlength=TOKENS) / len(acts) for column in tokens.T])
    np.testing.assert_allclose(shares, softmax.probs.numpy(), atol=0.04)  # 4 standard deviations of a share of 0.1
    np.testing.assert_array_equal(student.act(obs).action, actions_of(softmax.probs.argmax(-1).numpy()))


def test_the_learner_imitates_the_tokens_of_actions() -> None:
    teacher, env = Teacher(), Tabletop("lift", **ENV_OPTIONS)
    obs, _ = env.reset(seed=0)
    teacher.reset(obs, env.instruction)
    action = teacher.act(obs).action
    columns = {"cameras.front": obs.cameras["front"][None], "state.xyzrpy": obs.state["xyzrpy"][None]}
    columns |= {"gripper": np.array([obs.gripper]), "instruction": np.array([env.instruction], object)}
    learner, student = GRPOLearner(), TokenStudent()
    learner.add_advice(inputs_of(columns), action[None])
    before = learner.imitate(1)
    assert learner.imitate(100) < before / 5
    student.network = learner.network
    student.reset(obs, env.instruction)
    np.testing.assert_array_equal(student.act(obs).action, actions_of(tokens_of(action)))


def test_the_tokens_of_the_better_episodes_of_a_group_become_likelier() -> None:
    import torch

    student, _ = ready()
    solved = [True, False, False, True, True, True]
    columns = transitions([student] * 6, [10, 10, 11, 11, 12, 12], solved)
    learner = GRPOLearner()

    def logprobs() -> np.ndarray:
        """Of each episode's tokens."""
        found = learner._logprob(torch.from_numpy(inputs_of(columns)), columns["replay.tokens"][:, 0])
        return np.asarray(found.detach().numpy().sum(-1).reshape(6, STEPS).sum(-1))

    before = logprobs()
    np.testing.assert_allclose(before, columns["logprob"].reshape(6, STEPS).sum(-1), rtol=1e-4)
    learner.improve(columns, 5)
    gained = logprobs() - before
    assert min(gained[0], gained[3]) > 0 > max(gained[1], gained[2])


@pytest.mark.server
@pytest.mark.slow
@pytest.mark.integration
def test_the_example_killed_after_an_iteration_goes_on_to_the_table_of_a_whole_run(tmp_path: Path) -> None:
    example = yaml.safe_load((Path(__file__).parents[2] / "examples/learn/grpo.yaml").read_text())
    small = {"iterations": 2, "episodes": 32, "evaluate_every": 1, "held_out": 8}  # with the example's clone
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    with ray_folder() as folder:
        (folder / "plan.yaml").write_text(json.dumps(example | small))
        with start_run(folder, whole) as run:
            ended(run, folder)
        with start_run(folder, killed) as run:
            first = killed / "checkpoints" / "grpo.pt"
            wait_for(lambda: first.exists() or run.poll() is not None, timeout_s=400)
            run.kill()
        end(folder)
        with start_run(folder, killed, "--resume") as run:
            assert "demonstrations:" not in ended(run, folder)
    # Each iteration took its steps, pushed them, and was evaluated with other weights than the one before.
    found = table(whole)
    assert list(found) == ["grpo@400", "grpo@420", "grpo@440"]
    assert len({weights for weights, _ in found.values()}) == 3
    assert table(killed) == found
