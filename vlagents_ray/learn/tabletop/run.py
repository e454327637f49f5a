"""The loop of `vlagents-ray learn tabletop`."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.client import RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, SuiteConfig
from vlagents_ray.evaluate.results.summary import Summary
from vlagents_ray.learn.columns import arrays
from vlagents_ray.learn.publisher import Publisher
from vlagents_ray.learn.rollouts import Rollouts
from vlagents_ray.learn.tabletop.learner import Learner, advice, inputs_of
from vlagents_ray.learn.training_evaluation import TrainingEvaluation
from vlagents_ray.registry import require
from vlagents_ray.serve.launch.deployment_file import deployment, together
from vlagents_ray.serve.launch.server import running_server

ENV = "tabletop/lift"
ENV_OPTIONS: dict[str, Any] = {"width": 96, "height": 96, "max_steps": 30}
_STUDENT, _TEACHER = "serve://student", "serve://teacher"
_HELD_OUT, _TRAINING = 10_000_000, 20_000_000  # first seeds: no episode is both played for training and evaluated

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LearnPlan:
    """How much is learned, and where the results go."""

    out: Path  # folder of the results
    seed: int = 0  # of the network, and of the training's episodes
    demonstrations: int = 48  # episodes of the teacher
    clone_steps: int = 2000  # of the optimizer, for behaviour cloning
    iterations: int = 10  # of RPD, and of PPO
    episodes: int = 32  # of the student in each iteration
    steps: int = 500  # of the optimizer in each iteration
    held_out: int = 200  # episodes of an evaluation, the same for each version
    workers: int = 2
    num_envs: int = 16  # environments of a worker


def learn_tabletop(plan: LearnPlan, say: Callable[[str], None] = logger.info) -> Summary:
    """Record demonstrations, clone them, improve the clone with and without a teacher, and compare all of it.

    Args:
        plan: How much is learned.
        say: Takes a line about each step of it.

    Returns:
        The summary of all versions: "bc@1", "rpd@N" and "ppo@N".

    Raises:
        ConfigError: The folder has results already.
        MissingDependency: torch or the extra "learn" is not installed.
    """
    if (plan.out / "results.db").exists():
        raise ConfigError(f"{plan.out} already has results: choose another folder")
    require("torch").set_num_threads(1)  # its networks are small
    policies = {
        name: deployment(f"vlagents_ray.learn.tabletop.{name}:{name.title()}", batch={"max_size": 64})
        for name in ("student", "teacher")
    }
    with running_server(together(policies), ingress=False):
        return _Course(plan, say).take()


class _Course:
    """One course of learning, against the servers of student and teacher."""

    def __init__(self, plan: LearnPlan, say: Callable[[str], None]) -> None:
        self._plan, self._say = plan, say
        self._weights = Publisher(_STUDENT)

    def take(self) -> Summary:
        plan = self._plan
        seen, advised = self._demonstrations()
        clone = Learner(plan.seed)
        error = clone.imitate(seen, advised, plan.clone_steps)
        self._say(f"bc: {plan.clone_steps} steps, mean squared error {error:.4f}")
        summary = self._evaluate("bc", self._weights.push(clone.state()))
        for method in ("rpd", "ppo"):
            summary = self._improve(method, clone, seen, advised)
        return summary

    def _rollouts(self, policy: str, want: tuple[str, ...] = ()) -> Rollouts:
        return Rollouts(
            ENV,
            policy,
            workers=self._plan.workers,
            num_envs=self._plan.num_envs,
            want=want,
            seed=_TRAINING * (1 + self._plan.seed),
            env_options=ENV_OPTIONS,
        )

    def _demonstrations(self) -> tuple[np.ndarray, np.ndarray]:
        with self._rollouts(_TEACHER) as rollouts:
            columns = arrays(rollouts.collect(self._plan.demonstrations))
            self._say(f"demonstrations: {_solved(columns)} of {self._plan.demonstrations} episodes solved")
            return inputs_of(columns), columns["action"].copy()

    def _improve(self, method: str, clone: Learner, seen: np.ndarray, advised: np.ndarray) -> Summary:
        plan, learner = self._plan, clone.copy()
        with self._rollouts(_STUDENT, ("logprob", "value")) as rollouts, RemoteAgent(_TEACHER) as teacher:
            version = self._weights.push(learner.state())
            for iteration in range(1, plan.iterations + 1):
                rollouts.version = version
                columns = arrays(rollouts.collect(plan.episodes))
                if method == "rpd":
                    seen = np.concatenate([seen, inputs_of(columns)])
                    advised = np.concatenate([advised, advice(teacher, columns)])
                    learner.improve(columns, plan.steps, (seen, advised))
                else:
                    learner.improve(columns, plan.steps)
                version = self._weights.push(learner.state())
                rate = _solved(columns) / plan.episodes
                self._say(
                    f"{method} {iteration} of {plan.iterations}: {rate:.0%} of its {plan.episodes} episodes solved"
                )
                if 2 * iteration == plan.iterations:
                    self._evaluate(method, version)
        return self._evaluate(method, version)

    def _evaluate(self, method: str, version: int) -> Summary:
        suite = SuiteConfig(
            envs=[ENV],
            env_options=ENV_OPTIONS,
            seeds=[_HELD_OUT],
            episodes=self._plan.held_out,
            num_envs=self._plan.num_envs,
        )
        plan = EvalConfig(
            policies=[PolicyConfig(name=method)],
            suites=[suite],
            workers=self._plan.workers,
            out=self._plan.out,
            resume=True,
        )
        summary = TrainingEvaluation(_STUDENT, plan).play(version)
        newest = summary.totals[-1]
        rate = f"{newest.success_once.rate:.0%}"
        self._say(f"{newest.contender}: {rate} of the {self._plan.held_out} held-out episodes solved")
        return summary


def _solved(columns: dict[str, np.ndarray]) -> int:
    """Return the number of episodes in which the task was solved at some step."""
    return len(np.unique(columns["episode"][columns["success"]]))
