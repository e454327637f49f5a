"""examples/learn: students, teacher and learners in one process, and the whole loop at a small
size.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import yaml
from colours import named_colour
from eval_fakes import wait_for
from grpo import GRPOLearner, group_advantages
from learner import RPDLearner, advantages, advice, inputs_of
from ray_processes import end, processes, ray_folder
from student import Student
from tabletop_runs import ended, start_run, table
from teacher import Teacher
from token_student import TOKENS, TokenStudent, actions_of, tokens_of
from train import ENV_OPTIONS, LearnPlan, Method, RunCheckpoints

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.cli.options import read_run_file
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera
from vlagents_ray.interface import BEHAVIOUR, WANT
from vlagents_ray.testing import check_agent

pytestmark = pytest.mark.torch


class ServedTeacher(Teacher):
    """A teacher with the batches of `RemoteAgent`."""

    def sessions(self, number: int) -> list[ServedTeacher]:
        return [ServedTeacher() for _ in range(number)]

    def reset_batch(self, obs: list[Obs], texts: list[str], sessions: list[Teacher]) -> list[Any]:
        return [
            one.reset(first, text) for one, first, text in zip(sessions, obs, texts, strict=True)
        ]

    def close(self) -> None:
        """Nothing is held."""


def played(
    seed: int, chosen: Callable[[Obs], Act], agent: Agent
) -> tuple[bool, list[Obs], list[np.ndarray], str]:
    """An episode: whether it was solved, its observations and actions, and the instruction."""
    env = Tabletop("lift", **ENV_OPTIONS)
    obs, _ = env.reset(seed=seed)
    agent.reset(obs, env.instruction)
    seen, actions, solved, truncated = [], [], False, False
    while not truncated:
        act = chosen(obs)
        seen.append(obs)
        actions.append(act.action)
        obs, _, _, truncated, info = env.step(act)
        solved = solved or info["success"]
    return solved, seen, actions, env.instruction


def columns(episodes: list[tuple[bool, list[Obs], list[np.ndarray], str]]) -> dict[str, Any]:
    """The transitions of episodes."""
    seen = [obs for episode in episodes for obs in episode[1]]
    return {
        "cameras.front": np.stack([obs.cameras["front"] for obs in seen]),
        "gripper": np.array([obs.gripper for obs in seen], np.float32),
        "state.xyzrpy": np.stack([obs.state["xyzrpy"] for obs in seen]),
        "instruction": np.array([one[3] for one in episodes for _ in one[1]], object),
        "t": np.array([t for one in episodes for t in range(len(one[1]))], np.int32),
        "action": np.stack([action for one in episodes for action in one[2]]),
    }


def test_an_instruction_without_a_puck_is_refused() -> None:
    with pytest.raises(InvalidObservation, match="lift the COLOUR puck"):
        named_colour("fold the towel")
    teacher = Teacher()
    teacher.reset(Obs(), "lift the red puck")
    with pytest.raises(MissingCamera, match="front"):
        teacher.act(Obs())


def test_the_teacher_lifts_the_puck_and_gives_the_same_advice_to_others() -> None:
    teacher = Teacher()
    episodes = [played(seed, teacher.act, teacher) for seed in range(20)]
    assert sum(solved for solved, *_ in episodes) >= 19

    found = columns(episodes[:3])
    np.testing.assert_array_equal(advice(ServedTeacher(), found), found["action"])  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [Student, TokenStudent])
def test_a_student_keeps_what_an_agent_promises_and_neighbours_change_no_bit(
    kind: type[Student | TokenStudent],
) -> None:
    check_agent(
        kind(), instructions=["lift the red puck", "lift the blue puck", "lift the green puck"]
    )
    first, _ = Tabletop("lift", **ENV_OPTIONS).reset(seed=1)
    others = [kind(), kind()]
    others[0].initialize()
    for one in others:
        one.network = others[0].network
        one.reset(first, "lift the red puck", seed=3)
    offered = others[0].contract.behaviour
    wanted = Obs(first.cameras, first.gripper, first.state, {WANT: list(offered)})
    alone = others[0].act(wanted)
    others[0].reset(first, "lift the blue puck", seed=4)
    _, together = others[0].act_batch([Obs(first.cameras, 0.5, first.state), wanted], others)
    assert isinstance(together, Act)
    np.testing.assert_array_equal(alone.action, together.action)
    said, also = alone.info[BEHAVIOUR], together.info[BEHAVIOUR]
    assert set(said) == set(offered)
    np.testing.assert_equal(said, also)


def test_a_log_probability_is_that_of_the_normal_distribution_that_was_drawn_from() -> None:
    import torch

    student = Student()
    student.initialize()
    obs, _ = Tabletop("lift", **ENV_OPTIONS).reset(seed=1)
    student.reset(obs, "lift the red puck", seed=3)
    mean = student.act(obs).action
    drawn = student.act(Obs(obs.cameras, obs.gripper, obs.state, {WANT: ["logprob"]}))
    normal = torch.distributions.Normal(
        torch.from_numpy(mean), student.network.log_std.detach().exp()
    )
    expected = normal.log_prob(torch.from_numpy(drawn.action)).numpy()
    assert (drawn.action != mean).all()
    np.testing.assert_allclose(drawn.info[BEHAVIOUR]["logprob"][0], expected, rtol=1e-3, atol=1e-3)


def test_advantages_are_those_of_the_formula() -> None:
    found = {
        "value": [0.5, 0.25, 9.0, 0.75, 0.5],
        "t": [0, 1, 2, 0, 1],
        "success": [False, True, True, False, False],
    }
    gain, targets = advantages({name: np.array(values) for name, values in found.items()})
    last, limit = 1 - 0.25, 0.98 * 0.5 - 0.5
    first = 0.98 * 0.25 - 0.5 + 0.98 * 0.95 * last
    expected = [first, last, 0, 0.98 * 0.5 - 0.75 + 0.98 * 0.95 * limit, limit]
    np.testing.assert_allclose(gain, expected, rtol=1e-6)
    np.testing.assert_allclose(targets, gain + np.array([0.5, 0.25, 0, 0.75, 0.5]), rtol=1e-6)


def test_the_learner_imitates_and_the_advised_one_stays_near_the_advice() -> None:
    learner, rows = taught()
    before, after = learner.imitate(1), learner.imitate(300)
    assert after < before / 5
    assert learner.steps == 301
    unchanged = learner.checkpoint()["network"]["policy.0.weight"].clone()
    learner.improve(rows, 50)
    assert learner.imitate(1) < before / 5
    assert learner.state()["policy.0.weight"].ne(unchanged).any()


def test_a_learner_goes_on_from_a_checkpoint_to_the_same_bit(tmp_path: Path) -> None:
    import torch

    learner, rows = taught()
    learner.imitate(20)
    torch.save(learner.checkpoint(), tmp_path / "state")
    state = torch.load(tmp_path / "state", weights_only=True)
    others = [RPDLearner(seed=0) for _ in range(2)]
    for one in others:  # of which the second begins where the first did
        one.restore(state)
        one.improve(rows, 20)
        one.imitate(5)
    learner.improve(rows, 20)
    learner.imitate(5)
    for name, value in learner.state().items():
        assert torch.equal(value, others[0].state()[name]), name
        assert torch.equal(value, others[1].state()[name]), name


def taught() -> tuple[RPDLearner, dict[str, Any]]:
    """A learner with the demonstrations of eight episodes, and transitions as if they were the
    student's own.
    """
    teacher = Teacher()
    found = columns([played(seed, teacher.act, teacher) for seed in range(8)])
    learner = RPDLearner()
    learner.add_advice(inputs_of(found), found["action"])
    rows = np.arange(len(found["t"]))
    own = {"value": rows % 3, "logprob": -1 - rows % 2}
    found["success"] = rows % 50 == 0
    return learner, found | {name: values.astype(np.float32) for name, values in own.items()}


@pytest.mark.parametrize(
    ("second", "wrong"),
    [({}, "already has a run"), ({"resume": True, "steps": 7}, r'other settings: .*"steps":7')],
)
def test_a_folder_takes_one_run(tmp_path: Path, second: dict[str, Any], wrong: str) -> None:
    RunCheckpoints(LearnPlan(out=tmp_path))
    RunCheckpoints(LearnPlan(out=tmp_path, resume=True, iterations=20))  # it may go on for longer
    with pytest.raises(ConfigError, match=wrong):
        RunCheckpoints(LearnPlan(out=tmp_path, **second))


EXAMPLES = sorted((Path(__file__).parents[3] / "examples" / "learn").glob("*.yaml"))


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_is_a_plan_and_ends_with_its_method(file: Path) -> None:
    plan = LearnPlan.model_validate(read_run_file(file, "file of settings", "`methods`"))
    assert plan.methods[-1] == file.stem
    assert (
        f"examples/learn/{file.name}"
        in (Path(__file__).parents[3] / "docs/tutorials/learn.md").read_text()
    )


def test_there_is_an_example_of_each_method() -> None:
    assert {file.stem for file in EXAMPLES} == set(get_args(Method))


SMALL = {
    "methods": ["bc", "rpd"],  # a learner of groups goes through it at the end of this file
    "demonstrations": 4,
    "clone_steps": 100,
    "iterations": 2,
    "episodes": 4,
    "steps": 20,
    "evaluate_every": 2,
    "held_out": 2,
    "workers": 1,
    "num_envs": 4,
}


@pytest.mark.server
@pytest.mark.slow
def test_a_small_run_ends_with_a_table_of_each_method(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with ray_folder() as folder:
        (folder / "plan.yaml").write_text(json.dumps(SMALL))
        with start_run(folder, out) as run:
            printed = ended(run, folder)
    assert "demonstrations: 4 of 4 episodes solved" in printed
    assert (out / "report.html").is_file()
    assert list(table(out)) == ["bc@100", "rpd@140"]


STEPS = 6  # steps of an episode


def wanting(obs: Obs) -> Obs:
    return Obs(obs.cameras, obs.gripper, obs.state, {WANT: ["logprob", "entropy", "replay"]})


def ready(text: str = "lift the red puck", **kwargs: Any) -> tuple[TokenStudent, Obs]:
    """A student at the beginning of an episode."""
    student = TokenStudent()
    student.initialize()
    obs, _ = Tabletop("lift", **ENV_OPTIONS).reset(seed=1)
    student.reset(obs, text, **kwargs)
    return student, obs


def transitions(
    students: list[TokenStudent], starts: list[int], solved: list[bool]
) -> dict[str, np.ndarray]:
    """The columns of an episode of each student, of which some are called solved at their last
    step.
    """
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
    outcomes = [
        [0, 0, 1],
        [0, 0, 0],
        [0, 1, 0],
        [0, 0, 0],
        [1, 1, 1],
        [0, 0, 1],
        [0, 0, 0],
        [0, 0, 0],
    ]
    columns = {
        "episode": np.repeat([5, 5, 5, 5, 2, 2, 3, 3], 3),
        "t": np.tile([0, 1, 2], 8),
        "success": np.array(outcomes, bool).ravel(),
    }
    better = 0.5 / (0.5 + 1e-6)  # two of four were solved
    expected = [[better] * 3, [-better] * 3, [better, better, 0], [-better] * 3, *[[0] * 3] * 4]
    np.testing.assert_allclose(group_advantages(columns).reshape(8, 3), expected, rtol=1e-6)


def test_a_log_probability_is_that_of_the_softmax_which_the_tokens_are_drawn_from() -> None:
    import torch

    student, obs = ready(seed=3)
    learner = GRPOLearner()  # with the network of the same seed
    seen = {"cameras.front": obs.cameras["front"][None], "state.xyzrpy": obs.state["xyzrpy"][None]}
    seen |= {
        "gripper": np.array([obs.gripper]),
        "instruction": np.array(["lift the red puck"], object),
    }
    with torch.no_grad():
        logits = learner.network.policy(learner.network.features(torch.from_numpy(inputs_of(seen))))
    softmax = torch.distributions.Categorical(logits=logits.reshape(4, TOKENS))
    acts = [student.act(wanting(obs)) for _ in range(1000)]
    tokens = np.stack([act.info[BEHAVIOUR]["replay"]["tokens"][0] for act in acts])
    for act, drawn in zip(acts[:20], tokens, strict=False):
        said = act.info[BEHAVIOUR]
        np.testing.assert_array_equal(act.action, actions_of(drawn))
        np.testing.assert_allclose(
            said["logprob"][0], softmax.log_prob(torch.from_numpy(drawn)), rtol=1e-4
        )
        assert said["entropy"] == pytest.approx(float(softmax.entropy().sum()), rel=1e-4)
    shares = np.stack([np.bincount(column, minlength=TOKENS) / len(acts) for column in tokens.T])
    # 4 standard deviations of a share of 0.1.
    np.testing.assert_allclose(shares, softmax.probs.numpy(), atol=0.04)
    np.testing.assert_array_equal(
        student.act(obs).action, actions_of(softmax.probs.argmax(-1).numpy())
    )


def test_the_learner_imitates_the_tokens_of_actions() -> None:
    teacher, env = Teacher(), Tabletop("lift", **ENV_OPTIONS)
    obs, _ = env.reset(seed=0)
    teacher.reset(obs, env.instruction)
    action = teacher.act(obs).action
    columns = {
        "cameras.front": obs.cameras["front"][None],
        "state.xyzrpy": obs.state["xyzrpy"][None],
    }
    columns |= {
        "gripper": np.array([obs.gripper]),
        "instruction": np.array([env.instruction], object),
    }
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
        found = learner._logprob(
            torch.from_numpy(inputs_of(columns)), columns["replay.tokens"][:, 0]
        )
        return np.asarray(found.detach().numpy().sum(-1).reshape(6, STEPS).sum(-1))

    before = logprobs()
    np.testing.assert_allclose(before, columns["logprob"].reshape(6, STEPS).sum(-1), rtol=1e-4)
    learner.improve(columns, 5)
    gained = logprobs() - before
    assert min(gained[0], gained[3]) > 0 > max(gained[1], gained[2])


# A run that waits when the replica holds the weights of its second iteration, before episodes are
# run.
HELD = """
import pathlib, time
from train import LearnRun

collect, pushed, killed = LearnRun._collect, pathlib.Path({pushed!r}), pathlib.Path({killed!r})

def held(self, rollouts, version):
    if version == 420:
        pushed.touch()
        while not killed.exists():
            time.sleep(0.1)
    return collect(self, rollouts, version)

LearnRun._collect = held
"""


@pytest.mark.server
@pytest.mark.slow
@pytest.mark.integration
def test_runs_of_the_example_end_with_one_table_whatever_is_killed(tmp_path: Path) -> None:
    """Of one, the replica and the workers in the second iteration; the other one itself after
    the first.
    """
    example = yaml.safe_load((Path(__file__).parents[3] / "examples/learn/grpo.yaml").read_text())
    # With the example's clone.
    small = {"iterations": 2, "episodes": 32, "evaluate_every": 1, "held_out": 8}
    whole, resumed, pushed, killed = (
        tmp_path / name for name in ("whole", "resumed", "pushed", "killed")
    )
    with ray_folder() as folder:
        (folder / "plan.yaml").write_text(json.dumps(example | small))
        with start_run(
            folder, whole, before=HELD.format(pushed=str(pushed), killed=str(killed))
        ) as run:
            wait_for(lambda: pushed.exists() or run.poll() is not None, timeout_s=400)
            for pid in [
                *processes(folder, "ray::ServeReplica:grpo"),
                *processes(folder, "ray::Rollout"),
            ]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            killed.touch()
            assert "once more, as the policy was restarted" in ended(run, folder)
        with start_run(folder, resumed) as run:
            first = resumed / "checkpoints" / "grpo.pt"
            wait_for(lambda: first.exists() or run.poll() is not None, timeout_s=400)
            run.kill()
        end(folder)
        with start_run(folder, resumed, "--resume") as run:
            assert "demonstrations:" not in ended(run, folder)
    # Each iteration took its steps, pushed them, and was evaluated with other weights than the one
    # before.
    found = table(whole)
    assert list(found) == ["grpo@400", "grpo@420", "grpo@440"]
    assert len({weights for weights, _ in found.values()}) == 3
    assert table(resumed) == found
