"""An endless sequence of transitions from the workers of an evaluation."""

from __future__ import annotations

import functools
import itertools
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, EnvFailed, WeightsLost
from vlagents_ray.evaluate.artifacts.recorder import Artifacts, EpisodeRecorder
from vlagents_ray.evaluate.driver import Consumer, Driver
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult, version_of
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.workers.base import Workers
from vlagents_ray.evaluate.workers.in_process import workers_class
from vlagents_ray.evaluate.workers.rollout import Report, agents
from vlagents_ray.interface import BEHAVIOUR, WANT, Act, Agent, Obs
from vlagents_ray_learn.columns import FINAL, REPLAY, at_rows, tensors
from vlagents_ray_learn.optional import optional

WANTED = ("logprob", "value", "entropy", REPLAY)  # columns whose values the policy returns

# The number of rows that are allocated initially. The system provides the memory only when it is
# written.
_FIRST_ROWS = 128
_OTHER_MEMBERS = 2**31  # added to the policy seeds of the other members of a group


class TransitionRecorder(EpisodeRecorder):
    """Records the transitions of one episode in the columns of `vlagents_ray_learn.columns`."""

    def __init__(self, _hz: float | None, *, want: Sequence[str] = (), images: bool = True) -> None:
        self._pa: Any = optional("pyarrow")
        self._want = tuple(want)
        self._images = images
        self.request_info: Mapping[str, Any] = {WANT: list(want)} if want else {}
        self._observed: dict[str, _Rows] = {}  # the columns of the observations
        # The action, reward, success, number of the answer, version and source of each step.
        self._rows: list[tuple[np.ndarray, float, bool, int, int, str]] = []
        # The requested columns with a number for each step.
        self._wanted: dict[str, list[float]] = {name: [] for name in self._want if name != REPLAY}
        self._replay: dict[str, _Rows] = {}  # a row for each answer of which a row was executed

        # The current answer of the policy.
        self._acts = 0  # number of answers so far, including the current one
        self._version, self._source = 0, "policy"
        self._next: dict[str, list[float]] = {}  # requested numbers of the answer's remaining rows
        # Replay values of the answer until its first row is executed.
        self._next_replay: dict[str, np.ndarray] = {}

    @property
    def needs_images(self) -> bool:
        return self._images

    def add_observation(self, obs: Obs) -> None:
        """Add the observation before an action, or after the last action.

        Raises:
            EnvFailed: The names or shapes differ from the first observation.
        """
        values: dict[str, Any] = {}
        if self._images:
            values |= {f"cameras.{name}": image for name, image in sorted(obs.cameras.items())}
        values |= {f"state.{name}": array for name, array in sorted(obs.state.items())}
        if obs.gripper is not None:
            values["gripper"] = np.float32(obs.gripper)

        if not self._observed:
            for name, value in values.items():
                dtype = np.uint8 if value.ndim == 3 else np.float32
                self._observed[name] = _Rows(value, dtype)
        expected = {name: rows.shape for name, rows in self._observed.items()}
        shapes = {name: value.shape for name, value in values.items()}
        if shapes != expected:
            raise EnvFailed(f"env step: expected {expected} as after reset, got {shapes}")
        for name, value in values.items():
            self._observed[name].add(value)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        """Add an answer of the policy before its rows are executed.

        Raises:
            ConfigError: A requested value is missing or has a wrong shape.
        """
        self._acts += 1
        self._version = version_of(act) or 0
        self._source = str(act.info.get("source", "policy"))
        behaviour = act.info.get(BEHAVIOUR, {})
        missing = [name for name in self._want if name not in behaviour]
        if missing:
            raise ConfigError(
                f"want: expected {' and '.join(missing)} in act.info[{BEHAVIOUR!r}], got "
                f"{sorted(behaviour)}; use a policy that returns these values, or remove them from "
                "`want`"
            )

        rows = len(act.rows())
        self._next = {name: _by_row(behaviour[name], rows, name) for name in self._wanted}
        if REPLAY in self._want:
            self._next_replay = self._checked_replay(behaviour[REPLAY])

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Add a step: the executed row of the current answer, (D,), and its outcome."""
        row = (
            np.array(action, np.float32),
            reward,
            success,
            self._acts - 1,
            self._version,
            self._source,
        )
        self._rows.append(row)
        for name, values in self._wanted.items():
            values.append(self._next[name].pop(0))
        for name, value in self._next_replay.items():
            self._replay[name].add(value)
        self._next_replay = {}

    def _checked_replay(self, replay: Any) -> dict[str, np.ndarray]:
        """Return the replay values of an answer by name.

        Raises:
            ConfigError: The values are not numbers or arrays of numbers, or their shapes or dtypes
                differ from the first answer.
        """
        field = f"act.info[{BEHAVIOUR!r}][{REPLAY!r}]"
        by_name = sorted(replay.items()) if isinstance(replay, Mapping) else []
        values = {name: np.asarray(value) for name, value in by_name}
        if not values or any(value.dtype.kind not in "iuf" for value in values.values()):
            raise ConfigError(
                f"{field}: expected numbers and arrays of numbers by name, got {replay!r}"
            )

        if not self._replay:
            self._replay = {name: _Rows(value, value.dtype) for name, value in values.items()}
        expected = {name: f"{rows.dtype} {rows.shape}" for name, rows in self._replay.items()}
        shapes = {name: f"{value.dtype} {value.shape}" for name, value in values.items()}
        if shapes != expected:
            raise ConfigError(f"{field}: expected {expected} as in the first act, got {shapes}")
        return values

    def finish(self, result: EpisodeResult) -> Artifacts:
        """Return the transitions of the episode; None if an error of the policy ended it."""
        if result.status != "done":
            return Artifacts()

        pa = self._pa
        rows = len(self._rows)
        actions, rewards, success, acts, versions, sources = zip(*self._rows, strict=True)
        last = np.arange(rows) == rows - 1
        observed = {name: column.all() for name, column in self._observed.items()}  # (T + 1, ...)
        numbers: dict[str, np.ndarray] = {
            "episode": np.full(rows, result.key.episode, np.int64),
            "t": np.arange(rows, dtype=np.int32),
            "act": np.array(acts, np.int32),
            **{name: values[:-1] for name, values in observed.items()},
            "action": np.stack(actions),
            "reward": np.array(rewards, np.float32),
            "terminated": last & (result.ending == "terminated"),
            "truncated": last & (result.ending != "terminated"),
            "success": np.array(success, np.bool_),
            **{name: np.array(values, np.float32) for name, values in self._wanted.items()},
            "version": np.array(versions, np.int64),
        }

        columns: dict[str, Any] = {}
        # Dictionary indices, since each row has the same text.
        zeros = pa.array(np.zeros(rows, np.int32))
        for name, text in (("key", str(result.key)), ("instruction", result.instruction)):
            columns[name] = pa.DictionaryArray.from_arrays(zeros, pa.array([text]))
        for name, values in numbers.items():
            columns[name] = tensors(pa, values)
        for name, values in observed.items():
            columns[FINAL + name] = at_rows(pa, values[-1:], last)
        first_of_act = np.diff(acts, prepend=-1) != 0
        for name, replayed in self._replay.items():
            columns[f"{REPLAY}.{name}"] = at_rows(pa, replayed.all(), first_of_act)
        columns["source"] = pa.array(list(sources), pa.string()).dictionary_encode()
        return Artifacts(transitions=pa.RecordBatch.from_pydict(columns))


class _Rows:
    """A growing array, into which arrays of the same shape are copied as rows."""

    def __init__(self, first: np.ndarray, dtype: Any) -> None:
        """Begin without rows. The shape of a row is the shape of `first`, which is not added."""
        self.shape, self.dtype = first.shape, dtype
        self._rows = np.empty((_FIRST_ROWS, *first.shape), dtype)
        self._number = 0

    def add(self, row: np.ndarray) -> None:
        if self._number == len(self._rows):
            larger = np.empty((2 * self._number, *self.shape), self.dtype)
            larger[: self._number] = self._rows
            self._rows = larger
        self._rows[self._number] = row
        self._number += 1

    def all(self) -> np.ndarray:
        return self._rows[: self._number]


def _by_row(value: Any, rows: int, name: str) -> list[float]:
    """Return a number for each row of an answer, from the policy's value for the answer.

    Args:
        value: A number; or (H,) or (H, D) numbers, if there are H rows; or, for log-probabilities,
            numbers of any other shape, such as one for each token.
        rows: The number of rows, H.
        name: The name of the value.

    Returns:
        H numbers. If the value has H rows, each number is the sum of a row. Otherwise the first
        number is the sum of the whole value, and the others are NaN.

    Raises:
        ConfigError: The value has another shape.
    """
    values = np.asarray(value, np.float64)
    if values.ndim and len(values) == rows:
        row_sums: list[float] = values.reshape(rows, -1).sum(axis=1).tolist()
        return row_sums
    if name != "logprob" and values.size != 1:
        raise ConfigError(
            f"act.info[{BEHAVIOUR!r}][{name!r}]: expected a number, or shape ({rows},), got shape "
            f"{values.shape}"
        )
    return [float(values.sum()), *[float("nan")] * (rows - 1)]


POLL_S = 0.25  # longest wait for a report, after which missing workers are started


@dataclass(slots=True)
class RolloutStats:
    """The numbers of episodes and transitions of rollouts so far."""

    episodes: int = 0  # delivered episodes
    transitions: int = 0  # steps of the delivered episodes
    retries: int = 0  # attempts that were repeated after an infrastructure failure
    stale: int = 0  # episodes that were run again, as the weights had changed too much
    lost: int = 0  # episodes that no attempt finished, or that an error of the policy ended


@dataclass(slots=True)
class _PlannedEpisode:
    """An episode that is planned and not yet delivered."""

    job: Job  # the first attempt
    number: int
    is_over: bool = False
    # Whether the weights of the episode were too old, so that it waits until it may begin again.
    waits_for_restart: bool = False
    transitions: Any = None  # transitions, once the episode is over; None if it is lost
    oldest: int = 0  # oldest version of the weights among its actions
    pushed: int = 0  # the learner's version when the last attempt began


@dataclass(frozen=True, slots=True)
class RolloutPlan:
    """The settings of `Rollouts`.

    Raises:
        ConfigError: A setting is wrong.
    """

    env: str | Sequence[str]  # name of the env, as for an evaluation; several envs alternate
    # The URL of a server, or a factory that each worker calls to create its own agent.
    policy: str | Callable[[], Agent]
    # The number of workers. 0 runs the episodes in this process and on this thread, without Ray,
    # which is the fastest for one env and a small policy.
    workers: int = 1
    # The number of environments that one worker steps together, with one request to the policy for
    # all of them.
    num_envs: int = 1
    # The number of consecutive episodes from the same start state. They differ in the seed of the
    # policy (GRPO).
    groups: int = 1
    # The values that the policy returns with each answer: "logprob", "value", "entropy", "replay".
    want: Sequence[str] = ()
    # The largest age, in versions, of the weights of any answer in a delivered episode. Older
    # episodes are run again. 0 is on-policy; None delivers all episodes.
    max_lag: int | None = 0
    seed: int = 0  # seed of the first start state; state n has `seed` + n
    first: int = 0  # number of the first episode; the `position` of earlier rollouts continues them
    images: bool = True  # whether there are columns for the cameras
    env_options: Mapping[str, Any] = field(default_factory=dict)  # options of the env's constructor
    # Options of each reset of the env.
    reset_options: Mapping[str, Any] = field(default_factory=dict)
    # Options of each reset of the policy.
    policy_options: Mapping[str, Any] = field(default_factory=dict)
    execute: int | None = None  # executed rows of each action chunk; None executes all
    # Further settings of an evaluation, such as `worker`, `retries` and `env_timeout_s`.
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least in (("groups", 1), ("first", 0), ("seed", 0)):
            value = getattr(self, name)
            if value < least:
                raise ConfigError(f"{name}: expected at least {least}, got {value}")
        unknown = sorted(set(self.want) - set(WANTED))
        if unknown:
            raise ConfigError(f"want: expected only {list(WANTED)}, got {unknown}")

    def config(self) -> EvalConfig:
        """Return the settings of an evaluation of these episodes, which writes no results."""
        url = self.policy if isinstance(self.policy, str) else None
        policy = {"url": url, "options": self.policy_options, "execute": self.execute}
        suite = {
            "envs": [self.env] if isinstance(self.env, str) else list(self.env),
            "env_options": self.env_options,
            "reset_options": self.reset_options,
            "num_envs": self.num_envs,
        }
        document = {
            "policies": [policy],
            "suites": [suite],
            "workers": self.workers,
            "out": os.devnull,
        }
        return EvalConfig.model_validate({**document, **self.settings})


class Rollouts(AbstractContextManager["Rollouts"], Iterator[Any]):
    """Runs episodes in the workers of an evaluation, and returns their transitions for a learner.

        with Rollouts(RolloutPlan("tabletop/lift", "http://localhost:8000", workers=4)) as rollouts:
            for _ in range(100):
                columns = arrays(rollouts.collect(64))
                ...  # learn from them, and push the new weights

    Episodes are numbered from 0, and each is delivered exactly once, in this order. That does not
    depend on the number of workers, and holds even if workers die: a broken attempt is repeated,
    and has no transitions. Therefore, the same seeds and weights give the same transitions. The
    keys of the episodes are the same as in an evaluation with these settings.

    A record batch is one whole episode, with the columns of `vlagents_ray_learn.columns`. Workers
    on this node write the batch into Ray's object store once, and numpy maps it from there. A batch
    occupies memory of the store as long as it is referenced.
    """

    def __init__(self, plan: RolloutPlan) -> None:
        """Check the plan. Workers start with the first episode.

        Raises:
            ConfigError: A setting is wrong.
            MissingDependency: pyarrow is not installed.
            UnknownEnv: There is no such env.
        """
        self._pa: Any = optional("pyarrow")
        self._settings = plan
        config = plan.config()
        self._plan = resolve(config, config.workers)
        own_agents = None if isinstance(plan.policy, str) else plan.policy
        self._factory = agents(self._plan, own_agents)
        self._recorders = functools.partial(
            TransitionRecorder, want=tuple(plan.want), images=plan.images
        )

        self._block = math.lcm(plan.groups, plan.num_envs)  # episodes that are queued together
        # Episodes that are queued ahead of the learner: whole blocks, two for each environment.
        environments = plan.workers * plan.num_envs
        self._ahead = self._block * max(2, math.ceil(2 * environments / self._block))

        self._position = self._planned = plan.first
        # Episodes with numbers of at least `position`.
        self._episodes: dict[EpisodeKey, _PlannedEpisode] = {}
        self._driver = Driver(self._plan, [], _Consumer(self))
        self._resources = ExitStack()
        self._pool: Workers | None = None

        # Guards all of this object's state. No thread holds it while it waits for reports.
        self._state = threading.Condition()
        # The thread that runs further episodes while the learner learns.
        self._player: threading.Thread | None = None
        self._stopping = False
        self._error: BaseException | None = None  # error that ended the thread

        self._version = 0  # newest version among answers and pushes
        self._pushed = 0  # version that the learner has set
        self._allowed = plan.first  # number of the first episode that may not begin yet
        self._changed_at = plan.first  # position at the last change of the version
        # The number of episodes that were delivered between the last two changes of the version,
        # and the difference between these versions.
        self._pace = 0, 0
        self.stats = RolloutStats()  # numbers of episodes so far

    @property
    def version(self) -> int:
        """The newest version of the weights, from which the lag is counted.

        It follows the versions in the policy's answers. A learner that iterates over the rollouts
        may set it to the result of a push. After that, no episode with older weights is delivered.
        """
        return self._version

    @version.setter
    def version(self, pushed: int) -> None:
        with self._state:
            self._pushed = pushed
            self._note_version(pushed)

    @property
    def position(self) -> int:
        """The number of the next episode.

        A learner stores it in its checkpoint, and passes it as `first` to continue.
        """
        return self._position

    def __next__(self) -> Any:
        """Return the transitions of the next episode, a `pyarrow.RecordBatch`.

        Until the next call, a thread passes later episodes to the workers, two for each
        environment.
        """
        delivered: list[Any] = []
        while not delivered:  # repeated, since an episode may be lost
            delivered = self._deliver(self._position + 1, self._limit())
        return delivered[0]

    def collect(self, episodes: int) -> Any:
        """Run the next episodes without prefetching, so that no episode uses outdated weights.

        Args:
            episodes: The number of episodes, a multiple of `groups`.

        Returns:
            Their transitions in order, a `pyarrow.Table` with a chunk for each episode. Lost
            episodes are omitted. If all of them are lost, the same number of following episodes is
            run.

        Raises:
            ConfigError: The number is not a multiple of `groups`, or the envs have different
                columns.
            WeightsLost: The policy uses weights older than `version`, after a restart. Push the
                weights, and call again.
            VLAgentsError: The last infrastructure error, after `abort_after` consecutive lost
                episodes.
        """
        if episodes < 1 or episodes % self._settings.groups:
            raise ConfigError(
                f"collect: expected a multiple of groups, {self._settings.groups}, got {episodes} "
                "episodes"
            )
        batches: list[Any] = []
        while not batches:  # repeated, since all episodes may be lost
            batches = self._deliver(self._position + episodes)
        try:
            return self._pa.Table.from_batches(batches)
        except (self._pa.ArrowInvalid, ValueError) as error:
            raise ConfigError(
                f"collect: the episodes do not fit into one table, iterate over them: {error}"
            ) from error

    def close(self) -> None:
        """End the workers, and the Ray cluster if it was started for them.

        Calling this twice is safe.

        Delivered transitions are in Ray's memory. Copy the transitions that are needed after Ray
        has ended. A later call starts workers again, which repeat the episodes that were not
        delivered.
        """
        self._stop_player()
        if self._pool is not None:
            self._pool.close()
        self._end(None, None, None)

    def __exit__(self, *exc: Any) -> None:
        if exc[0] is None:
            self.close()
        else:
            self._end(*exc)

    def _end(self, *exc: Any) -> None:
        """End the workers, and plan the episodes that were not delivered again."""
        self._stop_player()
        for episode in self._episodes.values():
            episode.is_over = episode.waits_for_restart = False
            episode.transitions = None  # dropped, since Ray, whose memory contains it, may end
        self._pool = self._error = None
        self._resources.__exit__(*exc)

    def _limit(self) -> int:
        """Return the number of the first episode that may not begin yet.

        If the learner pushes at the pace of its last push, an episode with a higher number would be
        too old when it is delivered. Without this limit, after one slow step of the learner, every
        later episode would have to be run twice.
        """
        limit = (self._position + 1) // self._block * self._block + self._ahead
        episodes, versions = self._pace
        # Slower than before the last push.
        is_slower = self._position >= self._changed_at + episodes
        if self._settings.max_lag is None or is_slower:
            return limit
        fresh_episodes = episodes * (1 + self._settings.max_lag // versions)
        return min(limit, self._changed_at + fresh_episodes)

    def _note_version(self, version: int) -> None:
        """Update the newest version, and the pace of pushes, after an answer or a push."""
        if version <= self._version:
            return
        delivered = self._position - self._changed_at
        if delivered:
            self._pace = delivered, version - self._version
            self._changed_at = self._position
        self._version = version

    def _deliver(self, end: int, limit: int | None = None) -> list[Any]:
        """Run the episodes before number `end`, and return the transitions of all episodes that are
        not lost.

        Args:
            end: The number of the first episode that is not delivered.
            limit: The number of the first episode that may not begin; None selects `end`. Episodes
                between `end` and `limit` continue after this method returns.
        """
        try:
            prefetches = limit is not None and self._settings.workers > 0
            if prefetches:
                self._start_player()
            else:
                self._stop_player()
            with self._state:
                self._plan_until(limit or end)
                next_episodes = dict(itertools.islice(self._episodes.items(), end - self._position))
                self._replay_stale()
                self._state.notify_all()
                while not all(episode.is_over for episode in next_episodes.values()):
                    if self._error is not None:
                        raise self._error
                    if prefetches:
                        self._state.wait()
                    else:
                        self._run_queued()
                for key in next_episodes:
                    del self._episodes[key]
                self._position = end
        except BaseException:
            self._end(*sys.exc_info())
            raise

        results = [episode.transitions for episode in next_episodes.values()]
        batches = [transitions for transitions in results if transitions is not None]
        self.stats.episodes += len(batches)
        self.stats.transitions += sum(batch.num_rows for batch in batches)
        return batches

    def _start_player(self) -> None:
        if self._player is None:
            self._stopping = False
            # The workers are started on this thread, since Ray, which may be started for them, sets
            # signal handlers.
            self._running_pool()
            self._player = threading.Thread(target=self._run_ahead, name="rollouts", daemon=True)
            self._player.start()

    def _stop_player(self) -> None:
        if self._player is not None:
            with self._state:
                self._stopping = True
                self._state.notify_all()
            self._player.join()
            self._player = None

    def _run_ahead(self) -> None:
        """Run planned episodes until `_stopping`, or until an error."""
        pool = self._running_pool()
        try:
            while True:
                with self._state:
                    while not (self._stopping or len(self._driver.queue) or pool.busy):
                        self._state.wait()
                    if self._stopping:
                        return
                self._run_queued()
        except BaseException as error:  # noqa: BLE001 - raised by the next call
            with self._state:
                self._error = error
                self._state.notify_all()

    def _plan_until(self, limit: int) -> None:
        """Queue the episodes before number `limit`."""
        seed = self._settings.seed
        for number in range(self._planned, limit):
            start_state, member = divmod(number, self._settings.groups)
            episode, case_index = divmod(start_state, len(self._plan.cases))
            case = self._plan.cases[case_index]
            # The first member of a group is identical to the episode of an evaluation. The policy
            # seeds of the other members are larger than all seeds of evaluations, so that no two
            # episodes of an environment have the same noise.
            policy_seed = seed + _OTHER_MEMBERS + number if member else None
            key = EpisodeKey(case.env, episode, seed + episode, case.fingerprint, policy_seed)
            job = Job(key, case)
            self._episodes[key] = _PlannedEpisode(job, number)
            self._driver.queue.put(job)
        self._planned, self._allowed = max(self._planned, limit), limit

    def _run_queued(self) -> None:
        """Pass jobs to idle workers, and handle the reports that arrive within `POLL_S`."""
        pool = self._running_pool()
        with self._state:
            self._driver.hand_out(pool)
        for job, report in pool.wait(POLL_S):
            with self._state:
                self._driver.take(job, report)
                self._replay_stale()
                self._state.notify_all()

    def _with_start_state(self, transitions: Any, start_state: int) -> Any:
        """Return transitions whose column `episode` is the number of the start state.

        The number counts the start states of all environments. A worker numbers the states of one
        environment, so that episodes of several tasks would have the same number, and be a group.
        """
        column = tensors(self._pa, np.full(transitions.num_rows, start_state, np.int64))
        index = transitions.schema.get_field_index("episode")
        return transitions.set_column(index, "episode", column)

    def _running_pool(self) -> Workers:
        """Return the workers, which the first call starts, with all planned episodes queued."""
        if self._pool is None:
            workers = workers_class(self._plan, self._resources)
            self._pool = self._resources.enter_context(
                workers(self._plan, self._factory, self._recorders)
            )
            jobs = [episode.job for episode in self._episodes.values()]
            self._driver = Driver(self._plan, jobs, _Consumer(self))
        return self._pool

    def _note_begin(self, jobs: tuple[Job, ...]) -> None:
        """Note the learner's version when attempts begin."""
        for job in jobs:
            self._episodes[job.key].pushed = self._pushed

    def _finish(self, job: Job, transitions: Any) -> None:
        """Store the transitions of an episode until they are delivered.

        They are None if the episode is lost.

        Raises:
            WeightsLost: The policy has older weights than the learner has pushed.
        """
        episode = self._episodes[job.key]
        episode.is_over = True
        if transitions is None:
            episode.transitions = None
            self.stats.lost += 1
            return

        start_state = episode.number // self._settings.groups
        episode.transitions = self._with_start_state(transitions, start_state)
        versions = transitions.column("version").to_numpy()
        episode.oldest = int(versions.min())
        self._note_version(int(versions.max()))

        # Without this error, an attempt that began after the push but has older weights would be
        # repeated for ever.
        max_lag = self._settings.max_lag
        if max_lag is not None and episode.pushed - episode.oldest > max_lag:
            raise WeightsLost(
                f"version: {job.key} began when rollouts.version had been set to {episode.pushed}, "
                f"but its acts name {episode.oldest}; set it to what a push returned, after it has "
                "(a policy that names none has 0), and push again if a replica was restarted "
                "since then"
            )

    def _replay_stale(self) -> None:
        """Run episodes with outdated weights again, once they may begin.

        The episodes are put back at the front of the queue in reverse order, so that their order is
        kept.
        """
        max_lag = self._settings.max_lag
        for episode in reversed(self._episodes.values()):
            lag = self._version - episode.oldest if episode.transitions is not None else 0
            if max_lag is not None and lag > max_lag:
                episode.is_over = False
                episode.waits_for_restart = True
                episode.transitions = None
                self.stats.stale += 1
            if episode.waits_for_restart and episode.number < self._allowed:
                episode.waits_for_restart = False
                self._driver.queue.put_back(episode.job)


class _Consumer(Consumer):
    """A consumer that passes the episodes of the driver to the rollouts."""

    policy_cure = loss_cure = "mend this, and go on with `first=rollouts.position`"

    def __init__(self, rollouts: Rollouts) -> None:
        self._rollouts = rollouts

    def began(self, jobs: tuple[Job, ...]) -> None:
        self._rollouts._note_begin(jobs)

    def described(self, job: Job, report: Report) -> None:
        pass  # the results of a rollout do not describe the worker

    def attempt_failed(self, job: Job, failure: Failure, *, repeated: bool) -> None:
        self._rollouts.stats.retries += repeated

    def finished(self, job: Job, result: EpisodeResult, artifacts: Artifacts) -> None:
        self._rollouts._finish(job, artifacts.transitions)
