"""The trials of an evaluation on a robot: the order of the trials, and the execution of one
trial.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import itertools
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.commands import Command, CommandInbox
from vlagents_ray.errors import (
    EnvFailed,
    InvalidAction,
    PolicyFailed,
    PolicyUnavailable,
)
from vlagents_ray.evaluate.episode.episode import EpisodeStats, transport_of
from vlagents_ray.evaluate.episode.failures import env_side, policy_side
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.evaluate.robot.operator import Operator
from vlagents_ray.evaluate.workers.rollout import AgentFactory
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.naming import plain
from vlagents_ray.robot import Guard, LoopOptions, LoopReport, run_loop
from vlagents_ray.robot.fit import Trained
from vlagents_ray.robot.guard import measured_state
from vlagents_ray.robot.limits import MotionLimits
from vlagents_ray.robot.loop import fit_of, robot_watchdog
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.wrapper import RobotWrapper

_STOPPED = "stopped by the operator"


@dataclass(frozen=True, slots=True)
class Trial:
    """A trial. The operator must not see its policy, `job.case.policy`."""

    number: int  # number of the trial, from 1, in the order in which the trials run
    scene: int  # number of the scene, from 1; each policy has one trial in each scene of a task
    job: Job

    @property
    def task(self) -> tuple[str, str]:
        """(suite, env)."""
        return self.job.case.suite.name, self.job.case.env

    @property
    def scene_name(self) -> str:
        """The name of the scene in the names of files."""
        return plain("-".join((*filter(None, self.task), f"scene{self.scene}")))


def schedule(cases: Iterable[EvalCase], key: bytes) -> list[Trial]:
    """Draw the order of all trials: task by task, scene by scene, and in each scene every policy
    once.

    With k policies, each group of k consecutive scenes of a task has the rows of a k x k Latin
    square. The order of the rows and the order of the policies in the columns are random. In each
    task, fewer than k scenes may remain. The remaining scenes of all tasks share one more square:
    each uses a row that earlier remaining scenes used least often, chosen at random among equals.
    So each policy is first, second, and so on equally often: the counts differ by at most one in
    each task, and in the whole plan. A group may span several seeds. The order depends on the key
    and on the names of policies, suites and environments, through HMAC-SHA256.

    Args:
        cases: The cases of the plan, which all run on a robot.
        key: The plan's key, with which the policy of each trial can be computed.

    Returns:
        The trials in the order in which they run.
    """
    tasks: dict[tuple[str, str], dict[str, EvalCase]] = {}
    for case in cases:
        tasks.setdefault((case.suite.name, case.env), {})[case.policy_id] = case

    trials: list[Trial] = []
    rows_used: Counter[int] = Counter()
    for task, case_of_policy in tasks.items():
        suite = next(iter(case_of_policy.values())).suite
        scenes = list(itertools.product(suite.seeds, range(suite.episodes)))
        orders = _orders(key, task, case_of_policy, len(scenes), rows_used)
        for i, (scene, order) in enumerate(zip(scenes, orders, strict=True)):
            seed, episode = scene
            for name in order:
                case = case_of_policy[name]
                key_of_episode = EpisodeKey(case.env, episode, seed + episode, case.fingerprint)
                job = Job(key_of_episode, case)
                trials.append(Trial(number=len(trials) + 1, scene=i + 1, job=job))
    return trials


def _orders(
    key: bytes, task: tuple[str, str], names: Collection[str], scenes: int, rows_used: Counter[int]
) -> Iterator[list[str]]:
    """Yield the order of the policies in each scene of a task.

    Args:
        rows_used: How often the remaining scenes of earlier tasks used each row of the shared
            square; this function updates the counts.
    """
    size = len(names)
    for first in range(0, scenes, size):
        remaining = scenes - first
        square: list[str | int] = [*task, first // size]
        is_whole = remaining >= size
        columns = _drawn(key, [*square, "policy"] if is_whole else ["policy"], names)
        rows = [int(row) for row in _drawn(key, [*square, "row"], map(str, range(size)))]
        if not is_whole:
            rows = sorted(rows, key=rows_used.__getitem__)[:remaining]
            rows_used.update(rows)

        for row in rows:
            yield columns[row:] + columns[:row]


def _drawn(key: bytes, purpose: list[str | int], names: Iterable[str]) -> list[str]:
    """Return the names in the order of their authentication codes, which is independent of the
    order in the plan. Each `purpose` gives another order.
    """

    def code(name: str) -> bytes:
        return hmac.digest(key, canonical([*purpose, name]).encode(), hashlib.sha256)

    return sorted(names, key=code)


@dataclass(frozen=True, slots=True)
class PlayedTrial:
    """A trial that has ended, but has no verdict yet."""

    result: EpisodeResult  # the result, whose success is not set yet
    metadata: dict[str, Any]  # the metadata of the policy's server
    ending: str  # how the trial ended, in words that do not depend on the policy


class WatchedRobot(RobotWrapper):
    """A wrapper that converts the errors of a robot to `EnvFailed`, and counts the steps."""

    stats: EpisodeStats | None = None  # the statistics of the running trial
    # Whether the player has returned the next action; motions to the rest pose do not count as
    # steps.
    step_due: bool = False

    def observe(self) -> Obs:
        with env_side("robot, observe"):
            return super().observe()

    def apply(self, action: np.ndarray) -> None:
        """Command an action, and count it if it is a step of the running trial."""
        with env_side("robot, apply"):
            super().apply(action)
        if self.stats is not None and self.step_due:
            self.step_due = False
            self.stats.steps += 1
            self.stats.actions.update(action.astype("<f4", copy=False).tobytes())

    def stop(self) -> None:
        with env_side("robot, stop"):
            super().stop()


class _OperatorStop(CommandInbox):
    """The operator's stop button. The control loop reads it before each motion, including the
    motions to the rest pose.
    """

    def __init__(self, operator: Operator) -> None:
        super().__init__()
        self._operator = operator

    def apply(self, control: RobotControl) -> list[Command]:
        """Set the stop if the operator stops the trial."""
        if self._operator.stops() and not control.stopped:
            control.stop(_STOPPED)
        return super().apply(control)


class _CountingPlayer(ChunkPlayer):
    """A chunk player that records the metadata of the policy's answers."""

    def __init__(
        self,
        agent: Agent,
        stats: EpisodeStats,
        robot: WatchedRobot,
        operator: Operator,
        settings: PlayerSettings,
        check: Guard,
    ) -> None:
        super().__init__(agent, settings, check=check)
        self._stats = stats
        self._robot = robot
        self._operator = operator
        self._chunk = -1

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        """Reset the policy, and record the metadata of its answer."""
        with policy_side("reset"):
            info = super().reset(obs, instruction, **kwargs)
        self._stats.began(info)
        return info

    def act(self, obs: Obs) -> Act:
        """Show the observation to the operator, and return the next action."""
        self._operator.watch(obs)
        with policy_side("act"):
            act = super().act(obs)
        self._robot.step_due = True

        chunk = act.info.get("chunk", self._chunk)
        if chunk != self._chunk:
            self._chunk = chunk
            round_trip_ms = act.info.get("timing", {}).get("round_trip_ms", 0.0)
            self._stats.acted(act, round_trip_ms / 1e3, None)
        return act


def play(
    trial: Trial,
    robot: WatchedRobot,
    factory: AgentFactory,
    operator: Operator,
    recording: Path | None,
) -> PlayedTrial:
    """Run one attempt at a trial, and always stop the robot at the end.

    Args:
        trial: The trial.
        robot: The robot.
        factory: Creates the agent of the trial's policy.
        operator: The operator, who may stop the trial.
        recording: The folder for a recording; None for no recording.

    Returns:
        The ended trial; its status is "policy_error" if the policy failed.

    Raises:
        EnvFailed: The robot failed.
        PolicyUnavailable: The policy's server was silent or could not be reached.
    """
    case = trial.job.case
    settings, task = case.on_robot
    stats = robot.stats = EpisodeStats(trial.job.key, instructions=[task.instruction])
    stopped = False

    def until() -> bool:
        nonlocal stopped
        stopped = stopped or _STOPPED in watchdog.control.stops
        return watchdog.control.stopped

    with contextlib.ExitStack() as stack:
        stack.callback(setattr, robot, "stats", None)
        agent, player = stack.enter_context(_player(case, factory, stats, robot, operator))
        hangs_s = max(0.2, 5 / settings.hz) + (player.settings.deadline_s or 0.0)
        watchdog = robot_watchdog(
            robot, lambda _: robot.stop(), {"server": settings.silent_s, "loop": hangs_s}
        )
        recorder = None
        if recording is not None:
            recorder = stack.enter_context(Recorder(recording, settings.hz))

        failed = None
        report = LoopReport(settings.hz)
        try:
            options = LoopOptions(
                restart="manual",
                commands=_OperatorStop(operator),
                # The rehearsal has already compared the numbers with the training data; in a trial,
                # the policy's behaviour must become the result.
                fit=fit_of(player, robot, trained=Trained()),
                reset_options={**case.policy.options, "env": case.env, "seed": trial.job.key.seed},
                report=report,
            )
            run_loop(
                robot,
                player,
                hz=settings.hz,
                seconds=task.max_steps / settings.hz,
                until=until,
                instruction=task.instruction,
                watchdog=watchdog,
                recorder=recorder,
                options=options,
            )
        except PolicyFailed as error:
            failed = error

        if failed is None:
            _require_infrastructure(report)
        if report.done:
            stats.ending = "policy_done"
        else:
            stats.ending = "terminated" if stopped else "truncated"
        stats.timeliness = report.timeliness
        result = replace(stats.result(transport_of(agent), failed), env_seconds=None)

        # The text does not mention whether the policy reported the task as finished, since only
        # some policies ever do.
        if failed is not None:
            ending = "the policy failed"
        else:
            ending = _STOPPED if stopped else "the trial is over"
        return PlayedTrial(result, dict(getattr(agent, "metadata", {})), ending)


def _require_infrastructure(report: LoopReport) -> None:
    """Raise an error if infrastructure failed, which does not count as a failure of the policy."""
    for bark in report.barks:
        if bark == _STOPPED:
            continue
        if bark.startswith("server"):
            raise PolicyUnavailable(f"the policy's server was silent: {bark}")
        raise EnvFailed(f"robot: the control loop was blocked: {bark}")
    if 2 * report.safe.get("lost", 0) > report.jitter.get("ticks", 0):
        raise PolicyUnavailable(
            f"the policy's server could not be reached: {report.reasons['lost']}"
        )


def rehearse(
    case: EvalCase, robot: WatchedRobot, factory: AgentFactory, operator: Operator, obs: Obs
) -> None:
    """Run a policy once, without moving the robot.

    The rehearsal detects mistakes in the settings, and policies that do not fit the robot, before
    the first trial. It also performs the slow work of a first call, such as compilation, which
    would reveal the policy if it slowed the first trial.
    """
    settings, task = case.on_robot
    unused = EpisodeStats(EpisodeKey(case.env, 0, 0, case.fingerprint))
    with _player(case, factory, unused, robot, operator) as (agent, player):
        player.initialize()
        limits = None if settings.limits is None else MotionLimits.read(settings.limits)
        fit = fit_of(agent, robot, limits, accept=settings.ignore_mismatch)
        fit.require(obs, None)

        if fit.trained.action is not None:
            with contextlib.suppress(InvalidAction):
                agent.reset(obs, task.instruction, **case.policy.options)
                fit.require(None, agent.act(obs).rows())

        # In a trial, this error counts as the policy's failure.
        with contextlib.suppress(InvalidAction):
            player.reset(obs, task.instruction, **case.policy.options)
            player.act(obs)


@contextlib.contextmanager
def _player(
    case: EvalCase,
    factory: AgentFactory,
    stats: EpisodeStats,
    robot: WatchedRobot,
    operator: Operator,
) -> Iterator[tuple[Agent, ChunkPlayer]]:
    """Return a context manager that yields a policy's agent and its chunk player with the plan's
    settings, and closes both.
    """
    settings, _ = case.on_robot
    agent = factory(case)
    with contextlib.ExitStack() as unplayed:
        unplayed.callback(agent.close)
        agent.initialize()

        choice = choose_for(
            agent,
            mode=settings.mode,
            hz=settings.hz,
            execute=case.policy.execute,
            deadline_s=settings.deadline_s,
            max_age_s=settings.max_age_s,
            safe=settings.safe,
        )
        guard = Guard(
            agent.contract,
            max_step=settings.max_step,
            measure=measured_state(*settings.measure),
            limits=settings.limits,
            hz=settings.hz,
            soft_start_s=0.0,  # all trials of all policies then have the same limits
        )
        player = _CountingPlayer(agent, stats, robot, operator, choice.settings, check=guard)
        unplayed.pop_all()  # closing the player closes the agent

    with player:
        yield agent, player
