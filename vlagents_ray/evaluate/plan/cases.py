"""The cases of an evaluation; each case is one policy at one checkpoint in one environment."""

from __future__ import annotations

import fnmatch
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from vlagents_ray.envs.base import env_arguments
from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.evaluate.plan.config import (
    EvalConfig,
    PolicyConfig,
    RobotConfig,
    RobotTask,
    SuiteConfig,
    WorkerConfig,
    fingerprint,
)
from vlagents_ray.naming import plain
from vlagents_ray.policies.base.checkpoint import (
    CHECKPOINT,
    CHECKPOINT_STEP,
    checkpoint_name,
)
from vlagents_ray.policies.base.program import (
    Program,
    code_of_class,
    files_named,
    software,
    with_defaults,
)
from vlagents_ray.registry import env_class, env_suite, env_task


@dataclass(frozen=True)
class EvalCase:
    """One policy, at one checkpoint, in one environment of a suite. A case has one success rate."""

    policy: PolicyConfig
    step: int | None  # training step, in a sweep over checkpoints; or the version of pushed weights
    suite: SuiteConfig
    env: str  # full name
    worker: WorkerConfig
    robot: RobotConfig | None = None  # the real robot; None if `env` is simulated

    @property
    def on_robot(self) -> tuple[RobotConfig, RobotTask]:
        """The real robot and its task; raises an error for a simulated case."""
        if self.robot is None:
            raise TypeError(f"{self.env}: this case is simulated")
        return self.robot, self.robot.tasks[self.env]

    @property
    def policy_id(self) -> str:
        """The policy id with its checkpoint: "pi0", or "pi0@20000" in a sweep."""
        return policy_id(self.policy.name, self.step)

    @property
    def name(self) -> tuple[str, str, str]:
        """(policy_id, suite, env), which is unique among the cases of one evaluation."""
        return self.policy_id, self.suite.name, self.env

    @property
    def checkpoint_step(self) -> int | None:
        """The training step with which the policy is loaded; None unless this is a sweep over
        checkpoints.
        """
        return self.step if self.policy.steps else None

    @property
    def checkpoint(self) -> str | None:
        """The name of the checkpoint with which the policy is loaded, which its server reports at
        each reset; None unless this is a sweep over checkpoints.
        """
        if self.checkpoint_step is None:
            return None
        settings = {CHECKPOINT: self.policy.checkpoint, CHECKPOINT_STEP: self.checkpoint_step}
        return checkpoint_name(settings)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings on which an episode depends, apart from its number and seed."""
        pushed = self.policy.pushed_weights
        swept = {} if self.checkpoint_step is None else {CHECKPOINT_STEP: self.checkpoint_step}
        robot = {}
        if self.robot is not None:
            config, task = self.on_robot
            settings = config.model_dump(exclude={"tasks", "key", "ignore_mismatch"})
            robot = {"robot": settings | {"task": task.model_dump()}}
        return (
            robot
            | swept
            | {
                "pushed_weights": None if pushed is None else pushed.model_dump(),
                "env": self.env,
                "env_options": self.suite.env_options,
                "reset_options": self.suite.reset_options,
                "policy": self.policy.name,
                "policy_config": self.policy.config,
                "policy_options": self.policy.options,
                "checkpoint": self.policy.checkpoint,
                "execute": self.policy.execute,
                "codec": "jpeg" if self.policy.codec == "jpeg" else "exact",
                "num_envs": self.suite.num_envs,
                "clock": self.suite.clock.model_dump() if self.suite.clock else None,
            }
        )

    @cached_property
    def fingerprint(self) -> str:
        """Fingerprint of `settings`, in the keys of episodes."""
        return fingerprint(self.settings)

    @cached_property
    def kind(self) -> str:
        """Fingerprint of the worker settings; cases with the same value can share a worker
        process.
        """
        return fingerprint(self.worker.model_dump())

    @cached_property
    def place(self) -> str:
        """Fingerprint of the environment; a worker runs all cases with the same value in the same
        environment.
        """
        return fingerprint([self.env, self.suite.env_options, self.suite.num_envs, self.kind])

    @cached_property
    def program(self) -> Program:
        """The software that runs the episodes, and the present files of the environment: its code,
        and the files that its settings name.
        """
        return env_program(self)

    @property
    def planned(self) -> int:
        """The number of episodes of the case, for all seeds together."""
        return self.suite.episodes * len(self.suite.seeds)


def env_program(case: EvalCase, code: Callable[[str], Program] = code_of_class) -> Program:
    """Return the software that runs the episodes of a case, and the files of its environment or
    robot; `code` returns the files of a class.
    """
    if case.robot is not None:
        return software() | code(case.on_robot[0].arm or "")
    files = files_of_env(case.env, case.suite.env_options, case.suite.reset_options, code)
    return software() | files


def files_of_env(
    env: str,
    env_options: Mapping[str, Any],
    reset_options: Mapping[str, Any],
    code: Callable[[str], Program] = code_of_class,
) -> Program:
    """Return the files of an environment, and the files that its settings name.

    Raises:
        UnknownEnv: The environment is not registered. `MissingDependency` is also raised.
    """
    cls = env_class(env)
    program = dict(code(f"{cls.__module__}:{cls.__name__}"))

    # For an environment of Gymnasium, add the module that registers its id.
    task = env_task(env) or ""
    namespace = task.rpartition(":")[0] or task.rpartition("/")[0]
    module = env_options.get("module") or namespace
    if isinstance(module, str):
        program |= code(module)

    settings = with_defaults(cls, env_options) | {"reset_options": reset_options}
    return program | files_named(settings, folders=False)


def policy_id(policy: str, step: int | None) -> str:
    """Return the policy id of a policy at a step: "pi0", or "pi0@20000" in a sweep."""
    return policy if step is None else f"{policy}@{step}"


def plan_cases(config: EvalConfig) -> list[EvalCase]:
    """Return all cases of `config`, ordered by checkpoint, then by suite and env.

    Raises `UnknownEnv` for an unknown env. Raises `ConfigError` if an env is listed twice under one
    name or in two equal suites, since its episodes would have the same keys. Also raises it if
    names differ only in characters that file names cannot contain, since their episodes would have
    the same files.
    """
    robot = config.real_robot
    envs: list[tuple[SuiteConfig, str]] = []
    for suite in config.suites:
        for pattern in suite.envs:
            names = expand(pattern) if robot is None else _tasks_of_robot(robot, pattern)
            envs += [(suite, name) for name in names]

    cases = []
    for policy in config.policies:
        steps: list[int | None] = [*policy.steps]
        if not steps:
            pushed = policy.pushed_weights
            steps = [None if pushed is None else pushed.version]
        for step in steps:
            for suite, env in envs:
                worker = suite.worker or config.worker
                cases.append(EvalCase(policy, step, suite, env, worker, robot))

    _require_distinct(cases)
    return cases


def _tasks_of_robot(robot: RobotConfig, pattern: str) -> list[str]:
    """Return the robot's tasks that match a pattern; raises `UnknownEnv` if no task matches."""
    tasks = fnmatch.filter(robot.tasks, pattern)
    if not tasks:
        raise UnknownEnv(
            f"expected tasks of the plan's `robot.tasks`, {sorted(robot.tasks)}, got {pattern!r}, "
            "which matches none"
        )
    return tasks


def _require_distinct(cases: list[EvalCase]) -> None:
    """Raise `ConfigError` if two cases have the same name, the same files, or the same episodes."""
    names = Counter(case.name for case in cases)
    repeated = sorted({env for (_, _, env), number in names.items() if number > 1})
    if repeated:
        raise ConfigError(
            f"suites: expected each case once in suites of one name, got {repeated} twice; give "
            f"each suite a different `name`"
        )

    names_by_path: dict[tuple[str, ...], tuple[str, ...]] = {}
    for name in names:
        path = tuple(plain(word) for word in name)
        other = names_by_path.setdefault(path, name)
        if other != name:
            raise ConfigError(
                f"expected names whose files differ, got {' '.join(name)!r} and "
                f"{' '.join(other)!r}; rename one"
            )

    fingerprints = Counter(case.fingerprint for case in cases)
    repeated = sorted({case.env for case in cases if fingerprints[case.fingerprint] > 1})
    if repeated:
        raise ConfigError(
            f"suites: expected each episode once, got {repeated} in two suites with the same "
            f"settings; remove these envs from one of the suites"
        )


def most_cpus(cases: Iterable[EvalCase]) -> float:
    """Return the largest number of CPUs that a worker of any case requests; it may be a
    fraction.
    """
    return max(case.worker.cpus for case in cases)


def most_gpus(cases: Iterable[EvalCase]) -> float:
    """Return the largest number of GPUs that a worker of any case requests; it may be a
    fraction.
    """
    return max(case.worker.gpus for case in cases)


def require_envs(cases: Iterable[EvalCase]) -> None:
    """Raise `UnknownEnv` for an unknown task, `ConfigError` for options that its env rejects."""
    for case in cases:
        if case.robot is None:
            env_arguments(case.env, case.suite.env_options)


def expand(pattern: str) -> list[str]:
    """Return the envs that a name stands for: the env of this name or, if the name contains `*`,
    the simulator's matching tasks.

    Raises `UnknownEnv` for a simulator that is not registered, or if no task matches.
    """
    cls = env_class(pattern)
    if "*" not in pattern:
        return [pattern]

    suite = env_suite(pattern)
    envs = [f"{suite}/{task}" for task in cls.tasks()]
    matching = fnmatch.filter(envs, pattern)
    if not matching:
        raise UnknownEnv(
            f"expected tasks of {suite!r}, {envs}, got {pattern!r}, which matches none"
        )
    return matching
