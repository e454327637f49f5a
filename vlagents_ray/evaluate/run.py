"""Runs an evaluation: dispatches episodes, repeats failed attempts, records results, and stops
cleanly.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping

from vlagents_ray.errors import ConfigError, StorageFailed, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import Artifacts, save
from vlagents_ray.evaluate.artifacts.storage import (
    driver_code,
    policy_code,
    save_diffs,
    storing,
    versions,
)
from vlagents_ray.evaluate.driver import CheckpointSwaps, Consumer, Driver
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, resolve
from vlagents_ray.evaluate.report.terminal import Progress
from vlagents_ray.evaluate.results.early_stopping import EarlyStopping
from vlagents_ray.evaluate.results.reader import Results, rate_of
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import Summary, summarize, write_summary
from vlagents_ray.evaluate.trackers import TrackerFeed
from vlagents_ray.evaluate.workers.base import SIGNAL_S, Workers
from vlagents_ray.evaluate.workers.in_process import workers_class
from vlagents_ray.evaluate.workers.rollout import (
    AgentFactory,
    OwnAgents,
    Report,
    agents,
    factory_programs,
)
from vlagents_ray.policies.base.program import Program
from vlagents_ray.signals import StopRequest, stop_signals

log = logging.getLogger(__name__)
POLL_S = 0.25  # maximum time until a signal is handled, s
MARGIN = 1.25  # the next episode may take this many times as long as the longest finished episode
CLOSING_S = 10.0  # time reserved for closing the workers' simulators and writing the report, s


class EvaluationInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM ended the evaluation. Finished episodes are kept, and `resume` continues
    with the remaining episodes.

    Attributes:
        summary: The summary of the finished episodes.
    """

    why = "interrupted"

    def __init__(self, summary: Summary) -> None:
        done, planned = summary.total.episodes, summary.total.planned
        super().__init__(
            f"{self.why} after {done} of {planned} episodes; continue with --resume --out "
            f"{summary.out}"
        )
        self.summary = summary


class OutOfTime(EvaluationInterrupted):
    """No further episode would have ended before `end_at`. As after an interruption, `resume`
    continues the evaluation.
    """

    why = "out of time"


def evaluate(
    config: EvalConfig,
    *,
    agent_factory: OwnAgents = None,
    swaps: CheckpointSwaps | None = None,
    progress: Progress | None = None,
    only: tuple[int, int] | None = None,
    end_at: float | None = None,
) -> Summary:
    """Run every episode of `config` that has no result yet, and write the results to `config.out`.

    Episodes run in Ray actors: in the cluster of this process, otherwise in the cluster at
    `RAY_ADDRESS`, otherwise in a local cluster that ends with the run. If `config.workers` is 0,
    the episodes run in this process, on this thread, without time limits; this is the default for a
    short evaluation (see `chosen_workers`). The results are the same. Each worker uses the policy
    at the policy's `url`, or an agent that it creates with `agent_factory`. Even if an exception is
    raised, recorded episodes are kept, and summary.json and report.html are written if the disk has
    space.

    Args:
        config: The policies, the envs, and the folder of results.
        agent_factory: A function that each worker calls to create its agent, or a mapping from
            policy names to such functions; by default, an agent is a connection to the policy's
            `url`. For a policy with `steps`, the function is called with `checkpoint_step`.
        swaps: The servers of policies with `steps`, which load one checkpoint after another.
        progress: Shows the progress (see `progress_for`); by default, no progress is shown.
        only: (number, seed) of the only episode that runs in each env; by default, all episodes
            run.
        end_at: A time in seconds since 1970. An episode does not begin if, judging from the
            durations of earlier episodes, it would probably end later.

    Returns:
        The summary of all results in `config.out`, including those of earlier runs.

    Raises:
        ConfigError: The settings are invalid, or contradict the results in `config.out`.
        ContractMismatch: A policy and an env do not fit together.
        StorageFailed: The disk is full, or cannot be written to.
        EvaluationInterrupted: Ctrl-C or SIGTERM ended the evaluation; its subclass `OutOfTime` if
            `end_at` did.
        VLAgentsError: `config.abort_after` episodes in a row were lost to infrastructure; the
            exception is the last of these errors. It is `PolicyFailed` if as many episodes in a row
            ended with an error of a policy.
    """
    return evaluate_plan(
        resolve(config),
        agent_factory=agent_factory,
        swaps=swaps,
        progress=progress,
        only=only,
        end_at=end_at,
    )


def evaluate_plan(
    plan: ResolvedPlan,
    *,
    agent_factory: OwnAgents = None,
    swaps: CheckpointSwaps | None = None,
    progress: Progress | None = None,
    only: tuple[int, int] | None = None,
    end_at: float | None = None,
) -> Summary:
    """Evaluate like `evaluate`, with a plan that is already resolved."""
    if plan.settings.real_robot is not None:
        raise ConfigError(
            "robot.arm: expected a plan in simulation, got a plan on a real robot; see "
            "vlagents_ray.evaluate.robot"
        )
    factory = agents(plan, agent_factory)
    if swaps is None:
        _require_own_agents(plan, agent_factory)
    tracking = TrackerFeed(plan)

    with Store(plan) as store:
        with storing(plan.out):
            store.begin_run(versions())
            save_diffs(plan.out, driver_code().values())
        try:
            with tracking:
                local = factory_programs(plan, agent_factory)
                run = _Run(
                    plan, store, progress or Progress(), tracking, only, end_at, local, swaps
                )
                state, summary = run.play(factory)
        except BaseException:
            # A second disk error probably has the same cause; the first error is reported.
            with contextlib.suppress(StorageFailed):
                conclude(store, "stopped")
            raise

    for stopped in (EvaluationInterrupted, OutOfTime):
        if state == stopped.why:
            raise stopped(summary)
    return summary


def _require_own_agents(plan: ResolvedPlan, own: OwnAgents) -> None:
    """Raise `ConfigError` if a policy has steps but is at the URL of a running server, which has
    one checkpoint.
    """
    for policy in plan.policies:
        if policy.steps and not callable(own) and policy.name not in (own or {}):
            raise ConfigError(
                f"policy {policy.name!r}: expected no `steps` with the `url` of a running server, "
                f"which has one checkpoint, got {policy.steps}; give its `source`, so that the "
                "evaluation serves one checkpoint after another, or one policy with a `url` for "
                "each checkpoint"
            )


def conclude(store: Store, state: str) -> Summary:
    """Record the end of the run, and write the summary and the report."""
    # Import this late, so that an evaluation begins sooner.
    from vlagents_ray.evaluate.report.page import FILE, write_report

    with storing(store.out):
        store.end_run(state)
        summary = summarize(Results.load(store.out))
        write_summary(summary)
        write_report(summary.results, store.out / FILE)
    return summary


def check(config: EvalConfig) -> None:
    """Check the settings like `evaluate`. This is called before policies are served for an
    evaluation.

    Raises:
        ConfigError: An env or a tracker is not registered or not installed, or the settings
            contradict the results in `config.out`.
    """
    check_results(resolve(config))


def check_results(plan: ResolvedPlan) -> None:
    """Raise `ConfigError` if a plan contradicts the results in its folder."""
    # On a robot, the results are written when all trials are judged.
    if plan.settings.real_robot is None:
        Store(plan).close()


class _Run(Consumer):
    """Writes the results of one run, and shows the progress."""

    policy_cure = "correct the policy and evaluate it with a new --out, or raise abort_after"
    loss_cure = "resume when the problem is solved (--resume)"

    def __init__(
        self,
        plan: ResolvedPlan,
        store: Store,
        progress: Progress,
        tracking: TrackerFeed,
        only: tuple[int, int] | None,
        end_at: float | None,
        local_programs: Mapping[str, Program],
        swaps: CheckpointSwaps | None,
    ) -> None:
        """Queue the episodes without a result.

        Args:
            plan: The plan.
            store: The results, in which the run has begun.
            progress: Shows the progress.
            tracking: The plan's trackers.
            only: As in `evaluate`.
            end_at: As in `evaluate`.
            local_programs: The programs of agents that the workers create, by policy.
            swaps: As in `evaluate`.
        """
        self._plan = plan
        self._store = store
        self._progress = progress
        self._tracking = tracking
        self._local_programs = local_programs
        self._checked_gpus = not plan.workers  # whether the use of GPUs was checked, once

        results = Results.load(plan.out)
        self._recorded = {case.case_id: rate_of([case], "success_once") for case in results.cases}
        self._stopping = EarlyStopping(plan)
        for episode in results.episodes:
            self._stopping.add(episode.result)

        finished = store.finished()
        pending = []
        for job in plan_jobs(plan.cases):
            is_selected = only in (None, (job.key.episode, job.key.seed))
            if is_selected and str(job.key) not in finished and self.is_needed(job):
                pending.append(job)
        self._driver = Driver(plan, pending, self, swaps)
        # Number of remaining episodes by case.
        self._left = Counter(job.key.settings for job in pending)
        self._deadline = Deadline(end_at, (episode.result.seconds for episode in results.episodes))

    def play(self, factory: AgentFactory) -> tuple[str, Summary]:
        """Run all queued episodes, until a signal or the deadline ends the run.

        The summary is written before the process disconnects from Ray: when Slurm cancels a job,
        Ray stops responding immediately, and the job is killed seconds later.

        Returns:
            The state of the run, and its summary.
        """
        driver = self._driver
        if not driver.waiting:
            return "complete", conclude(self._store, "complete")

        with contextlib.ExitStack() as stack:
            pool_of = workers_class(self._plan, stack)
            stop = stack.enter_context(stop_signals())
            self._progress.begin(self._plan.cases, self._recorded, driver.waiting)
            try:
                with pool_of(self._plan, factory) as pool:
                    try:
                        while not stop.is_set() and not self._deadline.is_over:
                            may_begin = driver.waiting and self._deadline.leaves_room
                            if not pool.busy and not may_begin:
                                break
                            self._poll_pool(pool, stop)
                        if not stop.is_set():
                            pool.close()
                    except KeyboardInterrupt:  # a signal arrived during a call in this process
                        if not stop.is_set():
                            raise
                    except VLAgentsError as error:
                        if isinstance(error, StorageFailed) or not stop.wait(SIGNAL_S):
                            raise
                        log.info(
                            "an error that the signal probably caused: %s",
                            error,
                        )

                    state = OutOfTime.why if driver.waiting or pool.busy else "complete"
                    if stop.is_set():
                        state = EvaluationInterrupted.why
                    return state, conclude(self._store, state)
            finally:
                self._progress.end()

    def _poll_pool(self, pool: Workers, stop: StopRequest) -> None:
        if self._deadline.leaves_room:
            self._driver.hand_out(pool)
            if not pool.busy and not len(self._driver.queue):  # a server loads a checkpoint
                stop.wait(POLL_S)
        late_s = SIGNAL_S
        for job, report in pool.wait(POLL_S):
            self._deadline.end(job)
            if report.failure is not None:
                # A terminal or a service manager also sends the signal to workers and policies.
                # Their failures do not count as attempts.
                if stop.wait(late_s):
                    continue
                # One wait suffices for all failures of a poll; a lost policy causes many failures.
                late_s = 0.0
            with storing(self._plan.out):
                self._driver.take(job, report)

    def began(self, jobs: tuple[Job, ...]) -> None:
        self._deadline.begin(jobs)

    def described(self, job: Job, report: Report) -> None:
        """Record the policy, the environment and the worker that a report describes."""
        if report.policy is not None:
            name = job.case.policy.name
            local = {}
            if name in self._local_programs:
                local["program"] = self._local_programs[name]
            self._store.note_policy(name, local | report.policy)
            save_diffs(self._plan.out, [policy_code(report.policy)])

        if report.env is not None:
            self._store.note_env(job.case.place, report.env)
            save_diffs(self._plan.out, [report.env.code])

        if report.worker is not None:
            self._store.note_worker(report.worker)
            if report.worker.renderer is not None and not self._checked_gpus:
                from vlagents_ray.evaluate.workers.cluster import unused_gpus

                self._checked_gpus = True
                hint = unused_gpus(job.case, report.worker)
                if hint is not None:
                    log.warning(hint)

    def is_needed(self, job: Job) -> bool:
        return not self._stopping.has_stopped(job.key.settings)

    def attempt_failed(self, job: Job, failure: Failure, *, repeated: bool) -> None:
        self._store.record_attempt(job, failure, retried=repeated)
        if repeated:
            self._progress.retry(job, failure)

    def finished(self, job: Job, result: EpisodeResult, artifacts: Artifacts) -> None:
        """Write the files and the result of an episode, and stop the case if its outcomes
        suffice.
        """
        # Write the files before the result. After a crash in between, the episode is repeated and
        # overwrites the files.
        videos, trajectory = save(self._plan.out, job.case, result, artifacts)
        self._store.record(result, job.attempt, videos, trajectory)
        self._progress.episode(job.case, result)

        case_id = job.key.settings
        self._left[case_id] -= 1
        stopped_at = self._stopping.add(result)
        # The outcomes suffice; running episodes of the case are finished.
        if stopped_at is not None:
            dropped = self._driver.queue.drop(case_id)
            self._left[case_id] -= dropped
            self._progress.stopped(job.case, stopped_at, dropped)
        if not self._left[case_id]:
            self._tracking.update()


class Deadline:
    """Decides whether there is time for another episode.

    The driver measures the durations of episodes, so they include the start of a simulator and the
    wait for a policy.
    """

    def __init__(
        self,
        end_at: float | None,
        known_s: Iterable[float] = (),
        now: Callable[[], float] = time.time,
    ) -> None:
        """Create a deadline without running episodes.

        Args:
            end_at: The deadline in seconds since 1970; None for no deadline.
            known_s: The durations of earlier episodes, s.
            now: The clock.
        """
        self._end_at = end_at
        self._longest_s = max(known_s, default=0.0)
        self._now = now
        self._starts: dict[EpisodeKey, float] = {}  # start times of the running episodes

    def begin(self, jobs: Iterable[Job]) -> None:
        """Record that a worker begins these episodes."""
        self._starts |= dict.fromkeys((job.key for job in jobs), self._now())

    def end(self, job: Job) -> None:
        """Record that an attempt at this episode has ended, successfully or not."""
        start = self._starts.pop(job.key, None)
        if start is not None:
            self._longest_s = max(self._longest_s, self._now() - start)

    @property
    def leaves_room(self) -> bool:
        """Whether one more episode would probably end in time."""
        return self._left_s() > self._longest_s * MARGIN

    @property
    def is_over(self) -> bool:
        """Whether the deadline has passed, so that running episodes must be abandoned."""
        return self._left_s() <= 0

    def _left_s(self) -> float:
        return float("inf") if self._end_at is None else self._end_at - CLOSING_S - self._now()
