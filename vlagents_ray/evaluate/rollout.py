"""What runs in a worker process: one env or a batch of them, one agent, one episode after another.

`Rollout` is plain Python; `vlagents_ray.evaluate.pool` makes a Ray actor of it. It never raises for
what an episode may run into: it reports it, so that no exception has to survive pickling.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from time import monotonic, sleep
from typing import Any

from vlagents_ray.client import RemoteAgent
from vlagents_ray.client.plasma import this_node
from vlagents_ray.code import Code, code_of
from vlagents_ray.contract import require_match
from vlagents_ray.envs import EvalEnv, make_env
from vlagents_ray.envs.batch import BatchEnv, make_batch
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, VLAgentsError
from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.config import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.episode import EpisodeResult, Phase, run_episode
from vlagents_ray.evaluate.failures import Failure, explain
from vlagents_ray.evaluate.jobs import Job
from vlagents_ray.evaluate.logs import own_logs
from vlagents_ray.evaluate.recording import Kept, Recording
from vlagents_ray.evaluate.side_by_side import Outcome, run_episodes
from vlagents_ray.evaluate.sides import env_side, policy_side
from vlagents_ray.evaluate.whereabouts import Whereabouts, here
from vlagents_ray.interface import Agent
from vlagents_ray.registry import env_class
from vlagents_ray.wire.plain import plain_values

log = logging.getLogger(__name__)

AgentFactory = Callable[[PolicyConfig], Agent]

FIRST_WAIT_S = 0.5  # before trying again to reach a policy, doubled each time
LONGEST_WAIT_S = 10.0
LONG_S = 1.0  # in one phase, before a look at it asks where


@dataclass(frozen=True, slots=True)
class Made:
    """What a worker found out when it made an env."""

    described: dict[str, Any]  # `EvalEnv.describe()`
    contract: dict[str, Any]
    code: Code | None = None  # of the env, if git tracks it


@dataclass(frozen=True, slots=True)
class Report:
    """A worker's answer to a job: a result or a failure."""

    result: EpisodeResult | None = None
    failure: Failure | None = None
    kept: Kept = field(default_factory=Kept)
    made: Made | None = None  # if an env was made for it
    policy: dict[str, Any] | None = None  # metadata of the policy ({} of a local one), if newly connected
    where: Whereabouts | None = None  # if one of these two is new


@dataclass(slots=True)
class _Found:
    """What a worker found out on the way to an episode, whatever comes of that."""

    made: Made | None = None
    policy: dict[str, Any] | None = None
    where: Whereabouts | None = None


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a worker is doing, for how long."""

    phase: Phase
    age_s: float
    steps: int
    stack: str = ""  # where it is, once it has been there for long


class Rollout:
    """Plays jobs. Keeps its agent and its env until a job needs another."""

    def __init__(self, config: EvalConfig, agent_factory: AgentFactory) -> None:
        self._config = config
        self._agent_factory = agent_factory
        self._agent: Agent | None = None
        self._policy: str | None = None  # whose agent it is
        self._broken_agents = 0  # in a row
        self._sessions: list[Agent] = []  # further ones of the agent, for episodes side by side
        self._env: EvalEnv | BatchEnv | None = None
        self._place: str | None = None  # of the env
        self._thread = 0  # the one that plays
        self._now: tuple[Phase, float, int] = ("idle", monotonic(), 0)

    def ready(self) -> dict[str, Any]:
        """Answered as soon as the process runs: which it is, and the files that it writes to."""
        return {"pid": os.getpid(), "host": socket.gethostname(), "node": this_node(), "logs": own_logs()}

    def progress(self) -> Pulse:
        """Called from another thread while `run` is under way."""
        phase, since, steps = self._now
        age_s = monotonic() - since
        frame = sys._current_frames().get(self._thread) if age_s > LONG_S else None
        return Pulse(phase, age_s, steps, "".join(traceback.format_stack(frame)) if frame else "")

    def run(self, jobs: tuple[Job, ...]) -> list[Report]:
        """Play the episodes of one cell, side by side if there are several; a report for each."""
        self._thread = threading.get_ident()
        found = _Found()
        try:
            reports = self._played(jobs, found)
        except VLAgentsError as error:
            reports = [Report(failure=explain(error))] * len(jobs)
        finally:
            self._watch("idle", 0)
        if any(report.failure is not None and report.failure.cause == "policy" for report in reports):
            self._broken_agents += 1
            self._drop_agent()
        elif any(report.result is not None for report in reports):
            self._broken_agents = 0
        return [replace(reports[0], made=found.made, policy=found.policy, where=found.where), *reports[1:]]

    def close(self) -> None:
        """Free the simulator and the connection."""
        self._drop_agent()
        self._drop_env()

    def _played(self, jobs: tuple[Job, ...], found: _Found) -> list[Report]:
        cell = jobs[0].cell
        if self._agent is None or self._policy != cell.policy.name:
            self._agent = self._connect(cell.policy)
            found.policy = _metadata(self._agent)
        if self._env is None or self._place != cell.place:
            self._env = self._make_env(cell)
            # The driver may have another numpy, which cannot read this one's pickles.
            found.made = Made(plain_values(self._env.describe()), self._env.contract.to_json(), _code(cell))
        agent, env = self._agent, self._env
        if found.made is not None or found.policy is not None:
            require_match(agent.contract, env.contract)
            found.where = here(cell.policy.name, agent, env)
        with contextlib.ExitStack() as stack:
            recordings = [stack.enter_context(Recording(self._config, env.contract.control_hz)) for _ in jobs]
            return [
                Report(result=one, kept=recording.finish(one))
                if isinstance(one, EpisodeResult)
                else Report(failure=explain(one))
                for one, recording in zip(self._play(agent, env, jobs, recordings), recordings, strict=True)
            ]

    def _play(
        self, agent: Agent, env: EvalEnv | BatchEnv, jobs: tuple[Job, ...], recordings: list[Recording]
    ) -> list[Outcome]:
        cell = jobs[0].cell
        if isinstance(env, BatchEnv):
            return run_episodes(
                env,
                agent,
                self._sessions_of(agent, len(jobs)),
                [job.key for job in jobs],
                execute=cell.policy.execute,
                reset_options=cell.suite.reset_options,
                policy_options=cell.policy_options,
                watch=self._watch,
                record=lambda i, obs: recordings[i].see(obs),
                executed=lambda i, *done: recordings[i].do(*done),
            )
        [job], [recording] = jobs, recordings
        result = run_episode(
            env,
            agent,
            job.key,
            execute=cell.policy.execute,
            clock=cell.suite.clock,
            reset_options=cell.suite.reset_options,
            policy_options=cell.policy_options,
            watch=self._watch,
            record=recording.see,
            images=recording.wants_images,
            executed=recording.do,
        )
        return [result]

    def _sessions_of(self, agent: Agent, number: int) -> list[Agent]:
        if not isinstance(agent, RemoteAgent):
            raise ConfigError("num_envs: got more than 1 for a policy in the worker's own process; give it a `url`")
        if number > len(self._sessions):
            self._sessions += agent.sessions(number - len(self._sessions))
        return self._sessions[:number]

    def _watch(self, phase: Phase, steps: int) -> None:
        self._now = (phase, monotonic(), steps)

    def _connect(self, policy: PolicyConfig) -> Agent:
        self._watch("connect", 0)
        self._drop_agent()
        if self._broken_agents:  # the server may be restarting, or full
            sleep(min(FIRST_WAIT_S * 2 ** (self._broken_agents - 1), LONGEST_WAIT_S))
        with policy_side("start"):
            agent = self._agent_factory(policy)
        try:
            with policy_side("initialize"):
                agent.initialize()
                _metadata(agent)  # fetches it: is the server there, and does it know the policy?
        except VLAgentsError:
            agent.close()
            raise
        self._policy = policy.name
        return agent

    def _make_env(self, cell: Cell) -> EvalEnv | BatchEnv:
        self._watch("make", 0)
        self._drop_env()  # first, so that a worker never holds two simulators
        try:
            with env_side(f"{cell.env!r}: make"):
                options, number = cell.suite.env_options, cell.suite.num_envs
                env = make_env(cell.env, **options) if number == 1 else make_batch(cell.env, number, **options)
        except EnvFailed as error:
            reason = env_class(cell.env).missing()
            if reason is None:
                raise
            raise MissingDependency(f"env {cell.env!r} cannot run here: {reason}") from error
        self._place = cell.place
        return env

    def _drop_agent(self) -> None:
        agents = [*self._sessions, *([] if self._agent is None else [self._agent])]
        self._agent, self._sessions = None, []
        for agent in agents:
            try:
                agent.close()
            except VLAgentsError as error:  # the way to it is broken: nothing is left to close
                log.warning("closing the agent: %s", error)

    def _drop_env(self) -> None:
        env, self._env, self._place = self._env, None, None
        if env is not None:
            with env_side("close"):
                env.close()


def _code(cell: Cell) -> Code | None:
    return code_of(env_class(cell.env).__module__)


def _metadata(agent: Agent) -> dict[str, Any]:
    return dict(getattr(agent, "metadata", {}))
