"""examples/learn: student, teacher and learner in one process, and the whole loop at a small size."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from colours import named_colour
from eval_fakes import wait_for
from learner import RPDLearner, advantages, advice, inputs_of
from ray_processes import end, processes, ray_folder
from student import Student
from tabletop_runs import ended, start_run, table
from teacher import Teacher
from train import ENV_OPTIONS, LearnPlan, Method, RunCheckpoints

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.cli.options import read_run_file
from vlagents_ray.envs.tabletop.env import Tabletop
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera
from vlagents_ray.interface import BEHAVIOUR, WANT
from vlagents_ray.testing.agents import check_agent

pytestmark = pytest.mark.torch


class ServedTeacher(Teacher):
    """A teacher with the batches of `RemoteAgent`."""

    def sessions(self, number: int) -> list[ServedTeacher]:
        return [ServedTeacher() for _ in range(number)]

    def reset_batch(self, obs: list[Obs], texts: list[str], sessions: list[Teacher]) -> list[Any]:
        return [one.reset(first, text) for one, first, text in zip(sessions, obs, texts, strict=True)]

    def close(self) -> None:
        """Nothing is held."""


def played(seed: int, chosen: Callable[[Obs], Act], agent: Agent) -> tuple[bool, list[Obs], list[np.ndarray], str]:
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


def test_the_student_keeps_what_an_agent_promises_and_neighbours_change_no_bit() -> None:
    student = Student()
    student.initialize()
    check_agent(student, instructions=["lift the red puck", "lift the blue puck", "lift the green puck"])
    env = Tabletop("lift", **ENV_OPTIONS)
    first, _ = env.reset(seed=1)
    others = [Student(), Student()]
    for one in others:
        one.network = student.network
        one.reset(first, "lift the red puck", seed=3)
    first.info[WANT] = ["logprob", "value"]
    alone = others[0].act(first)
    _, together = student.act_batch([Obs(first.cameras, 0.5, first.state), first], others)
    assert isinstance(together, Act)
    np.testing.assert_array_equal(alone.action, together.action)
    said, also = alone.info[BEHAVIOUR], together.info[BEHAVIOUR]
    np.testing.assert_array_equal(said["logprob"], also["logprob"])
    assert said["value"] == also["value"]


def test_a_log_probability_is_that_of_the_normal_distribution_that_was_drawn_from() -> None:
    import torch

    student = Student()
    student.initialize()
    obs, _ = Tabletop("lift", **ENV_OPTIONS).reset(seed=1)
    student.reset(obs, "lift the red puck", seed=3)
    mean = student.act(obs).action
    drawn = student.act(Obs(obs.cameras, obs.gripper, obs.state, {WANT: ["logprob"]}))
    normal = torch.distributions.Normal(torch.from_numpy(mean), student.network.log_std.detach().exp())
    expected = normal.log_prob(torch.from_numpy(drawn.action)).numpy()
    assert (drawn.action != mean).all()
    np.testing.assert_allclose(drawn.info[BEHAVIOUR]["logprob"][0], expected, rtol=1e-3, atol=1e-3)


def test_advantages_are_those_of_the_formula() -> None:
    found = {"value": [0.5, 0.25, 9.0, 0.75, 0.5], "t": [0, 1, 2, 0, 1], "success": [False, True, True, False, False]}
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
    """A learner with the demonstrations of eight episodes, and transitions as if they were the student's own."""
    teacher = Teacher()
    found = columns([played(seed, teacher.act, teacher) for seed in range(8)])
    learner = RPDLearner()
    learner.add_advice(inputs_of(found), found["action"])
    rows = np.arange(len(found["t"]))
    own = {"value": rows % 3, "logprob": -1 - rows % 2}
    found["success"] = rows % 50 == 0
    return learner, found | {name: values.astype(np.float32) for name, values in own.items()}


@pytest.mark.parametrize(
    ("second", "wrong"), [({}, "already has a run"), ({"resume": True, "steps": 7}, r'other settings: .*"steps":7')]
)
def test_a_folder_takes_one_run(tmp_path: Path, second: dict[str, Any], wrong: str) -> None:
    RunCheckpoints(LearnPlan(out=tmp_path))
    RunCheckpoints(LearnPlan(out=tmp_path, resume=True, iterations=20))  # it may go on for longer
    with pytest.raises(ConfigError, match=wrong):
        RunCheckpoints(LearnPlan(out=tmp_path, **second))


EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "learn").glob("*.yaml"))


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_is_a_plan_and_ends_with_its_method(file: Path) -> None:
    plan = LearnPlan.model_validate(read_run_file(file, "file of settings", "`methods`"))
    assert plan.methods[-1] == file.stem
    assert f"examples/learn/{file.name}" in (Path(__file__).parents[2] / "docs/tutorials/learn.md").read_text()


def test_there_is_an_example_of_each_method() -> None:
    assert {file.stem for file in EXAMPLES} == set(get_args(Method))


SMALL = {
    "methods": ["bc", "rpd"],  # what a learner of groups goes through is in test_tabletop_grpo.py
    "demonstrations": 8,
    "clone_steps": 300,
    "iterations": 2,
    "episodes": 8,
    "steps": 50,
    "evaluate_every": 2,
    "held_out": 6,
    "num_envs": 4,
}


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A folder with the plan, and of the Ray of each run."""
    with ray_folder() as folder:
        (folder / "plan.yaml").write_text(json.dumps(SMALL))
        yield folder


@pytest.fixture(scope="module")
def undisturbed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The table of a run in which nothing was killed."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    with start_run(folder, out) as run:
        printed = ended(run, folder)
    assert "demonstrations: 8 of 8 episodes solved" in printed
    assert (out / "report.html").is_file()
    found = table(out)
    assert list(found) == ["bc@300", "rpd@400"]
    return found


@pytest.mark.server
@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_table(folder: Path, undisturbed: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "run"
    with start_run(folder, out) as run:
        wait_until_rpd_learns(run, out)
        run.kill()
    end(folder)
    with start_run(folder, out, "--resume") as run:
        assert "demonstrations:" not in ended(run, folder)
    assert table(out) == undisturbed


@pytest.mark.server
@pytest.mark.slow
@pytest.mark.integration
def test_killed_replicas_and_workers_change_nothing(folder: Path, undisturbed: dict[str, Any], tmp_path: Path) -> None:
    out, pushed, killed = tmp_path / "run", tmp_path / "pushed", tmp_path / "killed"
    with start_run(folder, out, before=HELD.format(pushed=str(pushed), killed=str(killed))) as run:
        wait_for(lambda: pushed.exists() or run.poll() is not None, timeout_s=400)
        for pid in [*processes(folder, "ray::ServeReplica:rpd"), *processes(folder, "ray::Rollout")]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        killed.touch()
        assert "once more, as the policy was restarted" in ended(run, folder)
    assert table(out) == undisturbed


# A run that waits when the replica of `rpd` holds the weights of its second iteration, before episodes are played.
HELD = """
import pathlib, time
from train import LearnRun

collect, pushed, killed = LearnRun._collect, pathlib.Path({pushed!r}), pathlib.Path({killed!r})

def held(self, rollouts, version):
    if version == 350:
        pushed.touch()
        while not killed.exists():
            time.sleep(0.1)
    return collect(self, rollouts, version)

LearnRun._collect = held
"""


def wait_until_rpd_learns(run: subprocess.Popen[str], out: Path) -> None:
    """Until the first of its iterations is over."""
    wait_for(lambda: (out / "checkpoints" / "rpd.pt").exists() or run.poll() is not None, timeout_s=400)
