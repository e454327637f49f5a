"""The loop of `vlagents-ray learn tabletop`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from vlagents_ray.client import RemoteAgent
from vlagents_ray.errors import ConfigError, PolicyUnavailable, WeightsLost
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Progress, SuiteConfig
from vlagents_ray.evaluate.artifacts.storage import whole
from vlagents_ray.evaluate.results.summary import Summary
from vlagents_ray.learn.columns import EXTRA, arrays
from vlagents_ray.learn.publisher import Publisher
from vlagents_ray.learn.rollouts import Rollouts
from vlagents_ray.learn.tabletop.grpo import GRPOLearner
from vlagents_ray.learn.tabletop.learner import NetworkLearner, PPOLearner, RPDLearner, advice, episodes, inputs_of
from vlagents_ray.learn.tabletop.plan import LearnPlan, Method
from vlagents_ray.learn.tabletop.progress import LearnBar
from vlagents_ray.learn.training_evaluation import TrainingEvaluation
from vlagents_ray.registry import require
from vlagents_ray.serve.launch.deployment_file import deployment, together
from vlagents_ray.serve.launch.server import running_server

ENV = "tabletop/lift"
ENV_OPTIONS: dict[str, Any] = {"width": 96, "height": 96, "max_steps": 30}
_TEACHER = "teacher"
_FAILURES = 10  # of the policy's server, in one iteration, after which the run ends
_HELD_OUT, _TRAINING = 10_000_000, 20_000_000  # first seeds: no episode is both played for training and evaluated


class _MethodParts(NamedTuple):
    """What a method trains, and how."""

    student: str  # class of the policy, below this package
    learner: type[NetworkLearner]
    learns: bool = True  # whether it goes on after the clone
    advised: bool = False  # whether it asks the teacher about each transition
    grouped: bool = False  # whether several episodes begin in one state


_METHODS: dict[Method, _MethodParts] = {
    "bc": _MethodParts("student:Student", PPOLearner, learns=False),
    "rpd": _MethodParts("student:Student", RPDLearner, advised=True),
    "ppo": _MethodParts("student:Student", PPOLearner),
    "grpo": _MethodParts("token_student:TokenStudent", GRPOLearner, grouped=True),
}
Played = TypeVar("Played")
WatchedBy = Callable[[Collection[str]], contextlib.AbstractContextManager[Progress]]


def learn_tabletop(plan: LearnPlan, progress: LearnBar, watched: WatchedBy | None = None) -> Summary:
    """Record demonstrations, clone them, improve the clone by each method, and compare all of it.

    Args:
        plan: How much is learned.
        progress: Shows what was done.
        watched: Makes what shows the evaluations, and the servers at these URLs; by default nothing does.

    Returns:
        The summary of all versions, whose numbers are the optimizer's steps: "bc@2000", "rpd@4500", …

    Raises:
        ConfigError: The folder has another run, or has one and `resume` is off.
        MissingDependency: torch or the extra "learn" is not installed.
    """
    require("pyarrow", extra=EXTRA)
    require("torch").set_num_threads(1)  # its networks are small
    checkpoints = RunCheckpoints(plan)
    sources = {_TEACHER: "teacher:Teacher"} | {method: _METHODS[method].student for method in plan.methods}
    policies = {
        app: deployment(f"vlagents_ray.learn.tabletop.{source}", batch={"max_size": 64})
        for app, source in sources.items()
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(running_server(together(policies), ingress=False))
        shown = None if watched is None else stack.enter_context(watched([_url(app) for app in policies]))
        return _LearnRun(plan, checkpoints, progress, shown).summary()


class RunCheckpoints:
    """The state of each method after its last iteration, in `out`/checkpoints; each file is whole, or is not there."""

    def __init__(self, plan: LearnPlan) -> None:
        """Begin a run, or go on with one of the same settings; raises `ConfigError` as `learn_tabletop` does."""
        self._folder = plan.out / "checkpoints"
        file = self._folder / "plan.json"
        mine = plan.model_dump_json(exclude={"methods", "out", "resume", "iterations", "track", "tracking"})
        if not file.is_file():
            with whole(file) as part:
                part.write_text(mine)
        elif not plan.resume:
            raise ConfigError(f"{plan.out} already has a run: go on with it (resume), or choose another folder")
        elif (its := file.read_text()) != mine:
            raise ConfigError(f"{plan.out} has a run with other settings: got {mine}, want {its}, or another folder")

    def save(self, name: str, state: Mapping[str, Any]) -> None:
        """Write the state of a method; if that fails, the one before stays."""
        with whole(self._folder / f"{name}.pt") as part:
            require("torch").save(dict(state), part)

    def load(self, name: str) -> dict[str, Any] | None:
        """Read the state of a method; None if there is none yet."""
        file = self._folder / f"{name}.pt"
        if not file.is_file():
            return None
        state: dict[str, Any] = require("torch").load(file, weights_only=True)
        return state


class _LearnRun:
    """A run, against the servers of the students and of their teacher."""

    def __init__(
        self, plan: LearnPlan, checkpoints: RunCheckpoints, progress: LearnBar, shown: Progress | None
    ) -> None:
        self._plan, self._checkpoints, self._progress, self._shown = plan, checkpoints, progress, shown
        self._clones: dict[str, dict[str, Any]] = {}  # checkpoints of learners, by the student that they train

    def summary(self) -> Summary:
        demonstrations = self._checkpoints.load("demonstrations") or self._demonstrations()
        for number, method in enumerate(self._plan.methods):
            state = self._checkpoints.load(method) or self._cloned(method, demonstrations)
            summary = self._learn(method, state, number * self._plan.iterations)
        return summary

    def _demonstrations(self) -> dict[str, Any]:
        with self._rollouts(_TEACHER) as rollouts:
            columns = arrays(rollouts.collect(self._plan.demonstrations))
            self._progress.say(f"demonstrations: {_solved(columns)} of {self._plan.demonstrations} episodes solved")
            arrived = {"seen": inputs_of(columns), "actions": columns["action"].copy()}
        found = {name: require("torch").from_numpy(values) for name, values in arrived.items()}
        self._checkpoints.save("demonstrations", found)
        return found

    def _cloned(self, method: Method, demonstrations: Mapping[str, Any]) -> dict[str, Any]:
        parts = _METHODS[method]
        if parts.student not in self._clones:
            learner = parts.learner(self._plan.seed)
            learner.add_advice(demonstrations["seen"].numpy(), demonstrations["actions"].numpy())
            error = learner.imitate(self._plan.clone_steps)
            self._progress.say(f"clone: {learner.steps} steps, error {error:.4f}")
            self._clones[parts.student] = learner.checkpoint()
        return {"iteration": 0, "position": 0, "learner": self._clones[parts.student]}

    def _learn(self, method: Method, state: Mapping[str, Any], done: int) -> Summary:
        """Learn by one method, from where it had got to; `done` iterations were of the methods before."""
        plan, parts = self._plan, _METHODS[method]
        learner = parts.learner(plan.seed)
        learner.restore(state["learner"])
        last = plan.iterations if parts.learns else 0
        clone_is_bc = parts.learns and "bc" in plan.methods and parts.student == _METHODS["bc"].student
        evaluated = {*range(plan.evaluate_every if clone_is_bc else 0, last, plan.evaluate_every), last}
        with (
            Publisher(_url(method)) as weights,
            self._rollouts(
                method, want=learner.want, first=state["position"], groups=plan.groups if parts.grouped else 1
            ) as rollouts,
            RemoteAgent(_url(_TEACHER)) as teacher,
        ):
            for iteration in range(min(state["iteration"], last), last + 1):
                self._progress.at(done + iteration, len(plan.methods) * plan.iterations)
                if iteration in evaluated:
                    summary = self._played(weights, learner, lambda: self._evaluate(method, learner.steps))
                if iteration == last:
                    break
                columns = arrays(self._played(weights, learner, lambda: self._collect(rollouts, learner.steps)))
                self._progress.say(
                    f"{method}@{learner.steps}: {_solved(columns)} of {plan.episodes} episodes of the training solved"
                )
                if parts.advised:
                    learner.add_advice(inputs_of(columns), advice(teacher, columns))
                learner.improve(columns, plan.steps or learner.steps_at_once)
                progress = {"iteration": iteration + 1, "position": rollouts.position}
                self._checkpoints.save(method, progress | {"learner": learner.checkpoint()})
        return summary

    def _played(self, weights: Publisher, learner: NetworkLearner, play: Callable[[], Played]) -> Played:
        """Play with the learner's weights; they are pushed again if the replica that had them was restarted."""
        failures = 0
        while True:
            try:
                if not weights.acknowledged(learner.steps):
                    weights.push(learner.state(), version=learner.steps)
                return play()
            except (WeightsLost, PolicyUnavailable) as error:
                failures += 1
                if failures > _FAILURES:
                    raise
                self._progress.say(f"once more, as the policy was restarted: {str(error).partition(chr(10))[0]}")

    def _collect(self, rollouts: Rollouts, version: int) -> Any:
        rollouts.version = version
        return rollouts.collect(self._plan.episodes)

    def _rollouts(self, policy: str, want: Sequence[str] = (), first: int = 0, groups: int = 1) -> Rollouts:
        return Rollouts(
            ENV,
            _url(policy),
            workers=self._plan.workers,
            num_envs=self._plan.num_envs,
            want=want,
            seed=_TRAINING * (1 + self._plan.seed),
            first=first,
            groups=groups,
            env_options=ENV_OPTIONS,
        )

    def _evaluate(self, method: Method, version: int) -> Summary:
        mine = self._plan
        suite = SuiteConfig(
            envs=[ENV], env_options=ENV_OPTIONS, seeds=[_HELD_OUT], episodes=mine.held_out, num_envs=mine.num_envs
        )
        plan = EvalConfig(
            policies=[PolicyConfig(name=method)],
            suites=[suite],
            workers=mine.workers,
            out=mine.out,
            resume=True,
            track=mine.track,
            tracking=mine.tracking,
        )
        summary = TrainingEvaluation(_url(method), plan, progress=self._shown).play(version)
        [newest] = [total for total in summary.totals if total.contender == f"{method}@{version}"]
        self._progress.say(
            f"{newest.contender}: {newest.success_once.rate:.1%} of {mine.held_out} held-out episodes solved"
        )
        return summary


def _url(app: str) -> str:
    return f"serve://{app}"


def _solved(columns: Mapping[str, np.ndarray]) -> int:
    """Return the number of episodes in which the task was solved at some step."""
    return int(np.logical_or.reduceat(columns["success"], episodes(columns)[0]).sum())
