"""Training of a small policy that lifts pucks on the tabletop from images and words, in minutes on
two cores.

    python examples/learn/train.py
    python examples/learn/train.py examples/learn/rpd.yaml --seed 1 --out runs/rpd-1

A teacher records demonstrations, and a student clones them (BC). The clone then continues to learn
with the teacher's advice (RPD), or without it (PPO, GRPO). Each version is evaluated on the same
seeds. docs/tutorials/learn.md explains it. It needs torch and the extra 'learn'.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch
import typer
from grpo import GRPOLearner
from learner import NetworkLearner, PPOLearner, RPDLearner, advice, episodes, inputs_of
from pydantic import BaseModel, ConfigDict, Field

from vlagents_ray.cli.console import errors, out
from vlagents_ray.cli.options import ConfigDir, SetInFile, parse_list, read_run_file
from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.client import RemoteAgent
from vlagents_ray.errors import ConfigError, PolicyUnavailable, WeightsLost
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig, Summary, print_summary
from vlagents_ray.evaluate.plan.config import Count, Seed
from vlagents_ray.overrides import find_file, parse_overrides, with_overrides
from vlagents_ray.serve.launch.deployment_file import deployment, together
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray_learn import Publisher, RolloutPlan, Rollouts, TrainingEvaluation, arrays

HERE = str(Path(__file__).parent.absolute())
ENV = "tabletop/lift"
ENV_OPTIONS: dict[str, Any] = {"width": 96, "height": 96, "max_steps": 30}
TEACHER = "teacher"
FAILURES = 10  # number of failures of the policy's server in one iteration after which the run ends
# First seeds of evaluations and of training, so that no episode is used for both.
HELD_OUT, TRAINING = 10_000_000, 20_000_000


Method = Literal["bc", "rpd", "ppo", "grpo"]


class LearnPlan(BaseModel):
    """The amount of training, and the folder of results. Each method except "bc" improves the
    clone that "bc" makes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    methods: list[Method] = Field(default=["bc", "rpd", "ppo"], min_length=1)
    out: Path = Path("runs/learn")
    resume: bool = False  # continue an interrupted or killed run
    seed: Seed = 0  # seed of the networks, and of the training's episodes
    demonstrations: Count = 48  # number of the teacher's episodes
    clone_steps: Count = 2000  # optimizer steps of cloning
    iterations: Count = 10  # number of iterations of each method
    episodes: Count = 32  # number of the student's episodes in each iteration
    groups: Count = 8  # episodes from one start state, in "grpo"
    # Steps of the optimizer in each iteration; default: rpd 500, ppo 40, grpo 20.
    steps: Count | None = None
    evaluate_every: Count = 5  # number of iterations between evaluations
    held_out: Count = 200  # episodes of an evaluation, the same for each version
    workers: Count = 2
    num_envs: Count = 16  # number of environments of a worker
    # Experiment trackers that also show the success rates, against the optimizer's steps.
    track: list[str] = []


class MethodParts(NamedTuple):
    """The student and the learner of a method."""

    student: str  # class of the policy
    learner: type[NetworkLearner]
    learns: bool = True  # whether the method continues after cloning
    advised: bool = False  # whether the teacher gives advice for each transition
    grouped: bool = False  # whether several episodes begin in the same state


METHODS: dict[Method, MethodParts] = {
    "bc": MethodParts("student:Student", PPOLearner, learns=False),
    "rpd": MethodParts("student:Student", RPDLearner, advised=True),
    "ppo": MethodParts("student:Student", PPOLearner),
    "grpo": MethodParts("token_student:TokenStudent", GRPOLearner, grouped=True),
}
Played = TypeVar("Played")


def learn(plan: LearnPlan) -> Summary:
    """Record demonstrations, clone them, improve the clone with each method, and compare all
    versions.

    Args:
        plan: The settings of the run.

    Returns:
        The summary of all versions, whose numbers are the optimizer's steps: "bc@2000", "rpd@4500",
        …

    Raises:
        ConfigError: The folder contains another run, or it contains this run and `resume` is off.
    """
    torch.set_num_threads(1)  # the networks are small
    # Ray starts the replicas with these variables, and they import the policies from this folder.
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [HERE, os.environ.get("PYTHONPATH")]))
    checkpoints = RunCheckpoints(plan)
    sources = {TEACHER: "teacher:Teacher"} | {
        method: METHODS[method].student for method in plan.methods
    }
    policies = {app: deployment(source, batch={"max_size": 64}) for app, source in sources.items()}
    with running_server(together(policies), ingress=False):
        return LearnRun(plan, checkpoints).summary()


class RunCheckpoints:
    """The state of each method after its last iteration, in atomically written files in
    `out`/checkpoints.
    """

    def __init__(self, plan: LearnPlan) -> None:
        """Begin a run, or continue a run with the same settings; raises `ConfigError` as `learn`
        does.
        """
        self._folder = plan.out / "checkpoints"
        file = self._folder / "plan.json"
        mine = plan.model_dump_json(exclude={"methods", "out", "resume", "iterations", "track"})
        if not file.is_file():
            self._folder.mkdir(parents=True, exist_ok=True)
            file.write_text(mine)
        elif not plan.resume:
            raise ConfigError(
                f"{plan.out} already has a run: continue it (resume), or choose another folder"
            )
        elif (its := file.read_text()) != mine:
            raise ConfigError(
                f"{plan.out} has a run with other settings: expected {its}, got {mine}; use its "
                "settings, or choose another folder"
            )

    def save(self, name: str, state: Mapping[str, Any]) -> None:
        """Write the state of a method. If writing fails, the previous state is kept."""
        part = self._folder / f"{name}.part"
        torch.save(dict(state), part)
        part.replace(self._folder / f"{name}.pt")

    def load(self, name: str) -> dict[str, Any] | None:
        """Read the state of a method; None if no state is saved yet."""
        file = self._folder / f"{name}.pt"
        if not file.is_file():
            return None
        state: dict[str, Any] = torch.load(file, weights_only=True)
        return state


class LearnRun:
    """A run with the servers of the students and of the teacher."""

    def __init__(self, plan: LearnPlan, checkpoints: RunCheckpoints) -> None:
        self._plan, self._checkpoints = plan, checkpoints
        # Checkpoints of learners, by the student that a learner trains.
        self._clones: dict[str, dict[str, Any]] = {}

    def summary(self) -> Summary:
        """Run all methods, and return the summary of all versions."""
        demonstrations = self._checkpoints.load("demonstrations") or self._demonstrations()
        for method in self._plan.methods:
            state = self._checkpoints.load(method) or self._cloned(method, demonstrations)
            summary = self._learn(method, state)
        return summary

    def _demonstrations(self) -> dict[str, Any]:
        with self._rollouts(TEACHER) as rollouts:
            columns = arrays(rollouts.collect(self._plan.demonstrations))
            print(
                f"demonstrations: {_solved(columns)} of {self._plan.demonstrations} episodes solved"
            )
            arrived = {"seen": inputs_of(columns), "actions": columns["action"].copy()}
        found = {name: torch.from_numpy(values) for name, values in arrived.items()}
        self._checkpoints.save("demonstrations", found)
        return found

    def _cloned(self, method: Method, demonstrations: Mapping[str, Any]) -> dict[str, Any]:
        parts = METHODS[method]
        if parts.student not in self._clones:
            learner = parts.learner(self._plan.seed)
            learner.add_advice(demonstrations["seen"].numpy(), demonstrations["actions"].numpy())
            error = learner.imitate(self._plan.clone_steps)
            print(f"clone: {learner.steps} steps, error {error:.4f}")
            self._clones[parts.student] = learner.checkpoint()
        return {"iteration": 0, "position": 0, "learner": self._clones[parts.student]}

    def _learn(self, method: Method, state: Mapping[str, Any]) -> Summary:
        """Run one method from its state."""
        plan, parts = self._plan, METHODS[method]
        learner = parts.learner(plan.seed)
        learner.restore(state["learner"])
        last = plan.iterations if parts.learns else 0
        clone_is_bc = (
            parts.learns and "bc" in plan.methods and parts.student == METHODS["bc"].student
        )
        evaluated = {
            *range(plan.evaluate_every if clone_is_bc else 0, last, plan.evaluate_every),
            last,
        }
        with (
            Publisher(_url(method)) as weights,
            self._rollouts(
                method,
                want=learner.want,
                first=state["position"],
                groups=plan.groups if parts.grouped else 1,
            ) as rollouts,
            RemoteAgent(_url(TEACHER)) as teacher,
        ):
            for iteration in range(min(state["iteration"], last), last + 1):
                if iteration in evaluated:
                    summary = self._played(
                        weights, learner, lambda: self._evaluate(method, learner.steps)
                    )
                if iteration == last:
                    break
                columns = arrays(
                    self._played(weights, learner, lambda: self._collect(rollouts, learner.steps))
                )
                print(
                    f"{method}@{learner.steps}: {_solved(columns)} of {plan.episodes} episodes of "
                    "the training solved"
                )
                if parts.advised:
                    learner.add_advice(inputs_of(columns), advice(teacher, columns))
                learner.improve(columns, plan.steps or learner.steps_at_once)
                progress = {"iteration": iteration + 1, "position": rollouts.position}
                self._checkpoints.save(method, progress | {"learner": learner.checkpoint()})
        return summary

    def _played(
        self, weights: Publisher, learner: NetworkLearner, play: Callable[[], Played]
    ) -> Played:
        """Run episodes with the learner's weights.

        The weights are pushed again if the replica was restarted.
        """
        failures = 0
        while True:
            try:
                if not weights.acknowledged(learner.steps):
                    weights.push(learner.state(), version=learner.steps)
                return play()
            except (WeightsLost, PolicyUnavailable) as error:
                failures += 1
                if failures > FAILURES:
                    raise
                print(f"once more, as the policy was restarted: {str(error).partition(chr(10))[0]}")

    def _collect(self, rollouts: Rollouts, version: int) -> Any:
        rollouts.version = version
        return rollouts.collect(self._plan.episodes)

    def _rollouts(
        self, policy: str, want: Sequence[str] = (), first: int = 0, groups: int = 1
    ) -> Rollouts:
        return Rollouts(
            RolloutPlan(
                ENV,
                _url(policy),
                workers=self._plan.workers,
                num_envs=self._plan.num_envs,
                want=want,
                seed=TRAINING * (1 + self._plan.seed),
                first=first,
                groups=groups,
                env_options=ENV_OPTIONS,
            )
        )

    def _evaluate(self, method: Method, version: int) -> Summary:
        mine = self._plan
        suite = SuiteConfig(
            envs=[ENV],
            env_options=ENV_OPTIONS,
            seeds=[HELD_OUT],
            episodes=mine.held_out,
            num_envs=mine.num_envs,
        )
        plan = EvalConfig(
            policies=[PolicyConfig(name=method)],
            suites=[suite],
            workers=mine.workers,
            out=mine.out,
            resume=True,
            track=mine.track,
        )
        summary = TrainingEvaluation(_url(method), plan).play(version)
        [newest] = [total for total in summary.totals if total.policy_id == f"{method}@{version}"]
        print(
            f"{newest.policy_id}: {newest.success_once.rate:.1%} of {mine.held_out} held-out "
            "episodes solved"
        )
        return summary


def _url(app: str) -> str:
    return f"serve://{app}"


def _solved(columns: Mapping[str, np.ndarray]) -> int:
    """Return the number of episodes in which the task was solved at some step."""
    return int(np.logical_or.reduceat(columns["success"], episodes(columns)[0]).sum())


def main(
    file: Annotated[
        Path | None, typer.Argument(help="Settings (.yaml), such as examples/learn/rpd.yaml.")
    ] = None,
    out_dir: Annotated[Path | None, typer.Option("--out", help="Folder of the results.")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the networks and of the training episodes.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run in --out.")] = False,
    track: Annotated[
        str, typer.Option(help="Show success rates in: wandb, trackio, tensorboard.")
    ] = "",
    changes: SetInFile = [],  # noqa: B006
    config_dir: ConfigDir = None,
) -> None:
    """Train a small policy to lift pucks: from demonstrations, with a teacher's advice, and without
    advice.
    """
    given = {
        "out": out_dir,
        "seed": seed,
        "resume": resume or None,
        "track": parse_list(track) or None,
    }
    with errors(LearnPlan):
        overrides = parse_overrides(changes, "--set")
        if file is None:
            settings = with_overrides({}, overrides)
        else:
            path = find_file(str(file), config_dir)
            settings = read_run_file(path, "file of settings", "`methods`", overrides)
        settings |= {name: value for name, value in given.items() if value is not None}
        with quiet_ray(None):
            summary = learn(LearnPlan.model_validate(settings))
        print_summary(out, summary)


if __name__ == "__main__":
    typer.run(main)
