"""The code of a worker process: an environment or a batch of them, an agent, and one episode after
another.

`Rollout` is plain Python; `vlagents_ray.evaluate.workers.pool` makes a Ray actor of it. It returns
the failures of an episode instead of raising them, so that no exception must be pickled.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from vlagents_ray.client import RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.serve_handle import this_node
from vlagents_ray.contract import require_match
from vlagents_ray.envs import make_env
from vlagents_ray.envs.base import BatchEnv, SequentialBatch, make_batch
from vlagents_ray.envs.graphics import require_own
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import Artifacts, RecorderFactory
from vlagents_ray.evaluate.episode import episode
from vlagents_ray.evaluate.episode.failures import (
    Failure,
    env_side,
    explain,
    explain_batch,
    policy_side,
)
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult, WorkerInfo
from vlagents_ray.evaluate.plan.cases import EvalCase, env_program
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, TimeLimits
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.accelerator import free_memory
from vlagents_ray.policies.base.checkpoint import CHECKPOINT_STEP, used_checkpoints
from vlagents_ray.policies.base.checkpoint_files import identify_weights
from vlagents_ray.policies.base.factory_values import factory_program
from vlagents_ray.policies.base.program import Program, loaded_code
from vlagents_ray.policies.wrapper import unwrapped
from vlagents_ray.protocol.json_messages import plain_values
from vlagents_ray.protocol.messages import PriorityName
from vlagents_ray.ray_tools.git_state import code_of
from vlagents_ray.registry import env_class
from vlagents_ray.validation import check_reset

log = logging.getLogger(__name__)

AgentFactory = Callable[[EvalCase], Agent]  # creates the agent of a case's policy
# Functions that create agents. That of a policy with `steps` is called with `checkpoint_step`.
OwnAgents = Callable[..., Agent] | Mapping[str, Callable[..., Agent]] | None
# Thread settings that are set before any import in a worker, since several workers share a machine.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "LP_NUM_THREADS",  # for llvmpipe and lavapipe, Mesa's software renderers
)
FIRST_WAIT_S = 0.5  # s, pause before the next attempt to reach a policy, doubled each time
LONGEST_WAIT_S = 10.0
LONG_S = 1.0  # s, duration of a phase after which a query also reports the stack


@dataclass(frozen=True, slots=True)
class Report:
    """A worker's answer to a job: a result or a failure."""

    result: EpisodeResult | None = None
    failure: Failure | None = None
    artifacts: Artifacts = field(default_factory=Artifacts)
    env: EnvInfo | None = None  # set if an environment was created for the job
    # Metadata of the policy ({} for a local policy); set if the connection is new.
    policy: dict[str, Any] | None = None
    worker: WorkerInfo | None = None  # set if the environment or the policy is new


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A worker's current phase, and the duration of the phase so far."""

    phase: episode.Phase
    age_s: float
    steps: int
    stack: str = ""  # the stack, if the phase has lasted for a long time


class Rollout:
    """Runs jobs. Keeps the agent and the environment until a job needs different ones."""

    def __init__(self, agent_factory: AgentFactory, recorders: RecorderFactory) -> None:
        self._agent_factory = agent_factory
        self._recorders = recorders
        self._agent: Agent | None = None
        # The policy of the agent, and its training step in a sweep over checkpoints.
        self._policy: tuple[str, int | None] | None = None
        # Metadata of an agent without a server: its weights.
        self._local_metadata: dict[str, Any] = {}
        self._broken_agents = 0  # number of consecutive broken agents
        self._sessions: list[Agent] = []  # further sessions of the agent, for parallel episodes
        self._env: BatchEnv | None = None
        self._env_place: str | None = None  # `EvalCase.place` of the environment
        self._thread = 0  # id of the thread that runs episodes
        self._current_phase: tuple[episode.Phase, float, int] = ("idle", monotonic(), 0)

    def ready(self, credentials: Credentials) -> dict[str, Any]:
        """Return the host, the id and the log files of the process, as soon as the process runs.

        This call, which Ray sends directly to the process, passes the driver's API key. The key
        must not be in the arguments of the actor's constructor, which the cluster's head stores, or
        in the runtime environment, which the head logs.
        """
        credentials.become_default()
        return {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "node": this_node(),
            "logs": own_logs(),
        }

    def progress(self) -> Heartbeat:
        """Return the current phase; called from another thread during `run`."""
        phase, since, steps = self._current_phase
        age_s = monotonic() - since
        frame = sys._current_frames().get(self._thread) if age_s > LONG_S else None
        stack = "".join(traceback.format_stack(frame)) if frame else ""
        return Heartbeat(phase, age_s, steps, stack)

    def run(self, jobs: tuple[Job, ...]) -> list[Report]:
        """Run the episodes of one case, in parallel if there are several, and return a report for
        each.
        """
        self._thread = threading.get_ident()
        new_fields: dict[str, Any] = {}  # fields of the first report, for any outcome
        try:
            reports = self._play(jobs, new_fields)
        except VLAgentsError as error:
            reports = [Report(failure=explain_batch(error, len(jobs)))] * len(jobs)
        finally:
            self._set_phase("idle", 0)

        failures = [report.failure for report in reports if report.failure is not None]
        if any(failure.cause == "policy" for failure in failures):
            self._broken_agents += 1
            self._drop_agent()
        elif any(report.result is not None for report in reports):
            self._broken_agents = 0
        return [replace(reports[0], **new_fields), *reports[1:]]

    def close(self) -> None:
        """Close the agent and the environment."""
        self._drop_agent()
        self._drop_env()

    def _play(self, jobs: tuple[Job, ...], new_fields: dict[str, Any]) -> list[Report]:
        """Run the episodes. Fields of the first report that describe a new agent or environment are
        added to `new_fields`, even if an error is raised later.
        """
        case = jobs[0].case
        if self._agent is None or self._policy != (case.policy.name, case.checkpoint_step):
            self._agent = self._connect(case)
            new_fields["policy"] = self._local_metadata or _metadata(self._agent)
        if self._env is None or self._env_place != case.place:
            self._env = self._make_env(case)
            # Convert the description to plain values, since the driver's version of numpy may not
            # be able to read this version's pickles.
            new_fields["env"] = EnvInfo(
                plain_values(self._env.describe()),
                self._env.contract.to_json(),
                code_of(f"{env_class(case.env).__module__}:"),
                env_program(case, loaded_code),
                socket.gethostname(),
            )

        agent, env = self._agent, self._env
        if new_fields:
            require_match(agent.contract, env.contract, f"{case.policy.name!r} in {case.env!r}: ")
            renderer = env.renderer()
            if renderer is not None:
                require_own(renderer)
            new_fields["worker"] = WorkerInfo(
                socket.gethostname(),
                this_node(),
                os.getpid(),
                case.policy.name,
                episode.transport_of(agent),
                None if renderer is None else renderer.name,
            )

        with contextlib.ExitStack() as stack:
            recordings = []
            for _ in jobs:
                recorder = self._recorders(env.contract.control_hz)
                recordings.append(stack.enter_context(contextlib.closing(recorder)))

            outcomes = episode.run_episodes(
                env,
                agent,
                self._sessions_of(agent, env, len(jobs)),
                [job.key for job in jobs],
                execute=case.policy.execute,
                clock=case.suite.clock,
                reset_options=case.suite.reset_options,
                policy_options=case.policy.options,
                # An agent without metadata need not name its checkpoint.
                checkpoint=case.checkpoint if hasattr(agent, "metadata") else None,
                observers=recordings,
                watch=self._set_phase,
                images="all" if recordings[0].needs_images else "requested",
            )

            reports = []
            for outcome, recording in zip(outcomes, recordings, strict=True):
                if isinstance(outcome, EpisodeResult):
                    report = Report(result=outcome, artifacts=recording.finish(outcome))
                elif isinstance(outcome, episode.Diverged):
                    failure = replace(explain(outcome.error), diverged=outcome.result)
                    report = Report(failure=failure)
                else:
                    report = Report(failure=explain(outcome))
                reports.append(report)
            return reports

    def _sessions_of(self, agent: Agent, env: BatchEnv, number: int) -> list[Agent]:
        """Return an agent for each of `number` parallel episodes."""
        if env.num_envs == 1:
            return [agent]

        sessions = getattr(agent, "sessions", None)
        if sessions is None:
            raise ConfigError(
                "num_envs: expected 1 for a policy in the worker's own process, got more; serve "
                "the policy and set its `url`"
            )
        if number > len(self._sessions):
            self._sessions += sessions(number - len(self._sessions))
        return self._sessions[:number]

    def _set_phase(self, phase: episode.Phase, steps: int) -> None:
        self._current_phase = (phase, monotonic(), steps)

    def _connect(self, case: EvalCase) -> Agent:
        """Return a new agent for the policy of a case, and close the present agent, so that this
        process never has two checkpoints in memory.
        """
        self._set_phase("connect", 0)
        self._drop_agent()
        if case.checkpoint_step is not None:
            free_memory()  # an agent with the previous checkpoint may be garbage by now
        if self._broken_agents:  # the server may be restarting or full
            sleep(min(FIRST_WAIT_S * 2 ** (self._broken_agents - 1), LONGEST_WAIT_S))

        with policy_side("start"):
            agent = self._agent_factory(case)
        try:
            check_reset(unwrapped(agent))
            with policy_side("initialize"), used_checkpoints() as checkpoints:
                agent.initialize()
                # Fetch the metadata, to check that the server runs and has the policy.
                _metadata(agent)
        except VLAgentsError:
            agent.close()
            raise

        weights = identify_weights(agent, checkpoints)
        is_local = not hasattr(agent, "metadata")
        self._local_metadata = {"weights": weights} if weights and is_local else {}
        self._policy = (case.policy.name, case.checkpoint_step)
        return agent

    def _make_env(self, case: EvalCase) -> BatchEnv:
        """Return the environment of the case, and close the present environment."""
        self._set_phase("make", 0)
        self._drop_env()  # close first, so that a worker never has two simulators
        try:
            with env_side(f"{case.env!r}: make"):
                options = case.suite.env_options
                number = case.suite.num_envs
                if number == 1:  # True even if the suite has a simulator for many environments
                    env: BatchEnv = SequentialBatch([make_env(case.env, **options)])
                else:
                    env = make_batch(case.env, number, **options)
        except EnvFailed as error:
            reason = env_class(case.env).missing()
            if reason is None:
                raise
            raise MissingDependency(f"env {case.env!r} cannot run here: {reason}") from error

        self._env_place = case.place
        return env

    def _drop_agent(self) -> None:
        agents_to_close = list(self._sessions)
        if self._agent is not None:
            agents_to_close.append(self._agent)
        self._agent = None
        self._sessions = []

        for agent in agents_to_close:
            try:
                agent.close()
            except VLAgentsError as error:  # the connection is broken, so there is nothing to close
                log.warning("closing the agent: %s", error)

    def _drop_env(self) -> None:
        env = self._env
        self._env = None
        self._env_place = None
        if env is not None:
            with env_side("close"):
                env.close()


def _metadata(agent: Agent) -> dict[str, Any]:
    return dict(getattr(agent, "metadata", {}))


def own_logs() -> list[str]:
    """Return the files of this process's standard output and error; in a Ray worker, Ray's log
    files.
    """
    paths = []
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):  # no /proc
            paths.append(os.readlink(f"/proc/self/fd/{descriptor}"))
    return [path for path in dict.fromkeys(paths) if Path(path).is_file()]


def agents(
    plan: ResolvedPlan, own: OwnAgents = None, priority: PriorityName = "simulation"
) -> AgentFactory:
    """Return the function with which a worker creates an agent for a case.

    Args:
        plan: The policies, and the time limits of a connection.
        own: A function that creates the agent of every policy, or a mapping from policy names to
            such functions. The agents of all other policies are `RemoteAgent`s.
        priority: The priority of the `RemoteAgent`s.

    Raises:
        ConfigError: A policy has neither a URL nor a factory in `own`.
    """
    if callable(own):
        return functools.partial(_own_agent, own)

    factories = own or {}
    for policy in plan.policies:
        if policy.url is None and policy.name not in factories:
            raise ConfigError(
                f"policy {policy.name!r}: expected the `url` of its server, as "
                "http://localhost:8000, got none; add it"
            )
    return functools.partial(_agent, plan.limits, factories, priority)


def _own_agent(make: Callable[..., Agent], case: EvalCase) -> Agent:
    step = case.checkpoint_step
    return make() if step is None else make(**{CHECKPOINT_STEP: step})


def _agent(
    limits: TimeLimits,
    factories: Mapping[str, Callable[..., Agent]],
    priority: PriorityName,
    case: EvalCase,
) -> Agent:
    policy = case.policy
    if policy.name in factories:
        return _own_agent(factories[policy.name], case)
    return RemoteAgent(
        str(policy.url),  # `agents` has checked that there is a URL
        transport=policy.transport,
        timeout_s=limits.policy_s,
        connect_timeout_s=limits.connect_s,
        codec=policy.codec,
        priority=priority,
        # An interrupted episode must run again, so that its result depends only on its key.
        resume=False,
    )


def factory_programs(plan: ResolvedPlan, own: OwnAgents) -> dict[str, Program]:
    """Return the programs of the agents that the workers create, by policy; for served policies,
    the metadata contain the program.

    A policy with pushed weights has none: its version and fingerprint identify it, and are checked
    at each episode.
    """
    unpushed = [policy.name for policy in plan.policies if policy.pushed_weights is None]
    if callable(own):
        program = factory_program(own)
        return dict.fromkeys(unpushed, program)
    factories = own or {}
    return {name: factory_program(factories[name]) for name in unpushed if name in factories}
