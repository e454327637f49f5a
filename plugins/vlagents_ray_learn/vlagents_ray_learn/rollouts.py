"""Endless transitions from the workers of an evaluation."""

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
from vlagents_ray.evaluate.episode.second_pass import SecondPass
from vlagents_ray.evaluate.plan.config import EpisodeChoice, EvalConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.workers.base import Workers
from vlagents_ray.evaluate.workers.in_process import workers_class
from vlagents_ray.evaluate.workers.rollout import Report, agents
from vlagents_ray.interface import BEHAVIOUR, WANT, Act, Agent, Obs
from vlagents_ray_learn.columns import FINAL, REPLAY, at_rows, tensors
from vlagents_ray_learn.optional import optional

WANTED = ("logprob", "value", "entropy", REPLAY)  # columns that a policy fills

_FIRST_ROWS = 128  # allocated; unwritten memory costs nothing
_OTHER_MEMBERS = 2**31  # added to the policy seeds of a group's further members


class TransitionRecorder(EpisodeRecorder):
    """Keeps the transitions of one episode, as `vlagents_ray_learn.columns` describes them."""

    def __init__(self, _hz: float | None, *, want: Sequence[str] = (), images: bool = True) -> None:
        self._pa: Any = optional("pyarrow")
        self._want = tuple(want)
        self._images = images
        self.request_info: Mapping[str, Any] = {WANT: list(want)} if want else {}
        self._observed: dict[str, _Rows] = {}  # the columns of the observations
        # action, reward, success, act, version ….
        self._rows: list[tuple[np.ndarray, float, bool, int, int, str]] = []
        self._wanted: dict[str, list[float]] = {name: [] for name in self._want if name != REPLAY}
        self._acts = 0
        self._version, self._source = 0, "policy"
        self._next: dict[str, list[float]] = {}  # requested values, for the next rows of the act
        self._replay: dict[str, _Rows] = {}  # a row for each act with executed rows
        self._next_replay: dict[str, np.ndarray] = {}  # until the first row of the act is executed

    @property
    def wants_images(self) -> EpisodeChoice:
        return "all" if self._images else "none"

    def add_observation(self, obs: Obs) -> None:
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
        got = {name: value.shape for name, value in values.items()}
        if got != expected:
            raise EnvFailed(f"env step: expected {expected} as after reset, got {got}")
        for name, value in values.items():
            self._observed[name].add(value)

    def add_act(self, act: Act, ticks_waited: int = 0) -> None:
        self._acts += 1
        self._version = version_of(act) or 0
        self._source = str(act.info.get("source", "policy"))
        behaviour = act.info.get(BEHAVIOUR, {})
        missing = [name for name in self._want if name not in behaviour]
        if missing:
            raise ConfigError(
                f"want: got no {' and no '.join(missing)} in act.info[{BEHAVIOUR!r}], which has "
                f"{sorted(behaviour)}; "
                f"take a policy that returns it, or leave it out of `want`"
            )
        rows = len(act.rows())
        self._next = {name: _by_row(behaviour[name], rows, name) for name in self._wanted}
        if REPLAY in self._want:
            self._next_replay = self._checked_replay(behaviour[REPLAY])

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
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
        """Return an act's replay by name; its shapes must be those of the first act."""
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
        got = {name: f"{value.dtype} {value.shape}" for name, value in values.items()}
        if got != expected:
            raise ConfigError(f"{field}: expected {expected} as in the first act, got {got}")
        return values

    def finish(self, result: EpisodeResult, second_pass: SecondPass) -> Artifacts:
        """Return the transitions of a whole episode; none of one that an error of the policy
        ended.
        """
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
        zeros = pa.array(np.zeros(rows, np.int32))  # the same text in each row
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
    """Arrays of one shape, each copied once into a growing array."""

    def __init__(self, first: np.ndarray, dtype: Any) -> None:
        self.shape, self.dtype = first.shape, dtype
        self._rows = np.empty((_FIRST_ROWS, *first.shape), dtype)
        self._number = 0

    def add(self, row: np.ndarray) -> None:
        if self._number == len(self._rows):
            full, self._rows = self._rows, np.empty((2 * self._number, *self.shape), self.dtype)
            self._rows[: self._number] = full
        self._rows[self._number] = row
        self._number += 1

    def all(self) -> np.ndarray:
        return self._rows[: self._number]


def _by_row(value: Any, rows: int, name: str) -> list[float]:
    """Return a number for each row of an act: its own sum, or the act's total in the first and NaN
    in the others.

    `value` is a number; or (H,) or (H, D) numbers, H rows; or numbers of any other shape, such as
    one for each token, which are summed.
    """
    values = np.asarray(value, np.float64)
    if values.ndim and len(values) == rows:
        return [float(value) for value in values.reshape(rows, -1).sum(axis=1)]
    if name != "logprob" and values.size != 1:
        raise ConfigError(
            f"act.info[{BEHAVIOUR!r}][{name!r}]: expected a number, or shape ({rows},), got shape "
            f"{values.shape}"
        )
    return [float(values.sum()), *[float("nan")] * (rows - 1)]


POLL_S = 0.25  # longest wait for a report before missing workers are started


@dataclass(slots=True)
class RolloutStats:
    """The episodes of rollouts so far."""

    episodes: int = 0  # delivered
    transitions: int = 0  # delivered
    retries: int = 0  # attempts repeated after an infrastructure failure
    stale: int = 0  # episodes played again, as the weights had changed too much
    lost: int = 0  # episodes that no attempt finished, or that an error of the policy ended


@dataclass(slots=True)
class _PlannedEpisode:
    """An episode that is planned and not yet delivered."""

    job: Job  # its first attempt
    number: int
    over: bool = False
    held: bool = False  # it was too old, and waits until it may begin again
    transitions: Any = None  # if it is over; None if it is lost
    oldest: int = 0  # oldest version of the weights among its actions
    pushed: int = 0  # the learner's version when the last attempt began


@dataclass(frozen=True, slots=True)
class RolloutPlan:
    """The settings of `Rollouts`.

    Raises:
        ConfigError: A setting is wrong.
    """

    env: str | Sequence[str]  # the name, as for an evaluation; several envs take turns
    # URL of a server, or a factory that each worker calls to create its own agent.
    policy: str | Callable[[], Agent]
    # 0: in this process and on this thread, without Ray: the quickest for one env and a small
    # policy.
    workers: int = 1
    # Environments that one worker steps together, with one request to the policy for all.
    num_envs: int = 1
    # Episodes from one start state, one after another, that differ in the seed of the policy (GRPO)
    groups: int = 1
    # What the policy returns for each act: "logprob", "value", "entropy", "replay".
    want: Sequence[str] = ()
    # Largest age, in versions, of the weights of any act of a delivered episode; others are played
    # again. 0 is on-policy; None delivers all.
    max_lag: int | None = 0
    seed: int = 0  # of the first start state; state n has `seed` + n
    first: int = 0  # number of the first episode; to continue earlier rollouts, their `position`
    images: bool = True  # whether there are columns for the cameras
    env_options: Mapping[str, Any] = field(default_factory=dict)  # of the env's constructor
    reset_options: Mapping[str, Any] = field(default_factory=dict)  # of each reset of the env
    policy_options: Mapping[str, Any] = field(default_factory=dict)  # of each reset of the policy
    execute: int | None = None  # rows of each action chunk that are executed; None: all
    # Further settings of an evaluation, such as `worker`, `retries` and `env_timeout_s`.
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, least in (("groups", 1), ("first", 0), ("seed", 0)):
            value = getattr(self, name)
            if value < least:
                raise ConfigError(f"{name}: expected at least {least}, got {value}")
        unknown = sorted(set(self.want) - set(WANTED))
        if unknown:
            raise ConfigError(f"want: expected some of {list(WANTED)}, got {unknown}")

    def config(self) -> EvalConfig:
        """Return the settings of an evaluation of these episodes; nothing is written."""
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
    """Plays episodes in the workers of an evaluation, and returns their transitions for a learner.

        with Rollouts(RolloutPlan("tabletop/lift", "http://localhost:8000", workers=4)) as rollouts:
            for _ in range(100):
                columns = arrays(rollouts.collect(64))
                ...  # learn from them, and push the new weights

    Episodes are numbered from 0 and delivered in this order, each exactly once, whatever the number
    of workers and even if some die: a broken attempt is repeated, and has no transitions. So the
    same seeds and weights give the same transitions. The keys are those of an evaluation of these
    settings.

    A record batch is one whole episode with the columns of `vlagents_ray_learn.columns`. Workers on
    this node write it into Ray's object store once, and numpy maps it from there; keeping it keeps
    its memory in the store.
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
        self._ahead = self._block * max(
            2, math.ceil(2 * plan.workers * plan.num_envs / self._block)
        )
        self._position = self._planned = plan.first
        self._episodes: dict[EpisodeKey, _PlannedEpisode] = {}  # from number `position` on
        self._driver = Driver(self._plan, [], _Consumer(self))
        self._resources = ExitStack()
        self._pool: Workers | None = None
        # Held by whoever plays or asks, but not during a wait for reports.
        self._state = threading.Condition()
        self._player: threading.Thread | None = None  # plays on while the learner learns
        self._stopping = False
        self._error: BaseException | None = None  # which ended the player
        self._version = self._pushed = 0
        self._allowed = plan.first  # number of the first episode that is not to begin yet
        self._since = plan.first  # the position when the version changed
        # Episodes delivered between the last two changes, and their distance in versions.
        self._pace = 0, 0
        self.stats = RolloutStats()  # the numbers of episodes so far

    @property
    def version(self) -> int:
        """The newest version of the weights, from which the lag is counted.

        It follows the versions of acts. A learner that iterates may set it to the result of a push,
        so that no episode of older weights is delivered from then on.
        """
        return self._version

    @version.setter
    def version(self, pushed: int) -> None:
        with self._state:
            self._pushed = pushed
            self._saw(pushed)

    @property
    def position(self) -> int:
        """The number of the next episode: keep it in the learner's checkpoint, to continue with
        `first`.
        """
        return self._position

    def __next__(self) -> Any:
        """Return the transitions of the next episode, a `pyarrow.RecordBatch`.

        A thread hands later episodes to the workers meanwhile, also until the next call: two for
        each environment.
        """
        delivered: list[Any] = []
        while not delivered:  # an episode may be lost
            delivered = self._deliver(self._position + 1, self._limit())
        return delivered[0]

    def collect(self, episodes: int) -> Any:
        """Run the next episodes without prefetching, so none uses outdated weights.

        Args:
            episodes: Their number; whole groups, if there are groups.

        Returns:
            Their transitions in order, a `pyarrow.Table` with a chunk for each episode. Lost
            episodes are left out; if all are lost, the result has as many of the next ones.

        Raises:
            ConfigError: The number does not make whole groups, or the envs have different columns.
            WeightsLost: The policy acts with older weights than `version`, after a restart: push
                them, and call again.
            VLAgentsError: The last infrastructure error, after `abort_after` lost episodes in a
                row.
        """
        if episodes < 1 or episodes % self._settings.groups:
            raise ConfigError(
                f"collect: expected a multiple of groups, {self._settings.groups}, got {episodes} "
                "episodes"
            )
        batches: list[Any] = []
        while not batches:  # all may be lost
            batches = self._deliver(self._position + episodes)
        try:
            return self._pa.Table.from_batches(batches)
        except (self._pa.ArrowInvalid, ValueError) as error:
            raise ConfigError(
                f"collect: the episodes do not fit into one table, iterate over them: {error}"
            ) from error

    def close(self) -> None:
        """End the workers, and the Ray cluster if it was started for them; safe to call twice.

        Delivered transitions are in Ray's memory: copy those that are needed after the end of Ray.
        A later request starts workers again, which repeat the episodes that were not delivered.
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
        self._stop_player()
        for episode in self._episodes.values():
            episode.over = episode.held = False
            episode.transitions = None  # in the memory of a Ray that may end
        self._pool = self._error = None
        self._resources.__exit__(*exc)

    def _limit(self) -> int:
        """Return the number of the first episode that is not to begin yet.

        At the pace of the last push, an episode with a higher number would be too old when it is
        its turn. Without this limit, learners that once were slow would for ever get episodes that
        are played twice.
        """
        limit = (self._position + 1) // self._block * self._block + self._ahead
        episodes, versions = self._pace
        # Slower than at the last push.
        if self._settings.max_lag is None or self._position >= self._since + episodes:
            return limit
        return min(limit, self._since + episodes * (1 + self._settings.max_lag // versions))

    def _saw(self, version: int) -> None:
        """Note the version of an act or of a push."""
        if version <= self._version:
            return
        delivered = self._position - self._since
        if delivered:
            self._pace = delivered, version - self._version
            self._since = self._position
        self._version = version

    def _deliver(self, end: int, limit: int | None = None) -> list[Any]:
        """Play until the episodes before number `end` are over; those before `limit` may also
        begin, and go on.
        """
        try:
            ahead = limit is not None and self._settings.workers > 0
            if ahead:
                self._start_player()
            else:
                self._stop_player()
            with self._state:
                self._plan_until(limit or end)
                wanted = list(itertools.islice(self._episodes.items(), end - self._position))
                self._replay_stale()
                self._state.notify_all()
                while not all(episode.over for _, episode in wanted):
                    if self._error is not None:
                        raise self._error
                    if ahead:
                        self._state.wait()
                    else:
                        self._play_on()
                for key, _ in wanted:
                    del self._episodes[key]
                self._position = end
        except BaseException:
            self._end(*sys.exc_info())
            raise
        batches = [episode.transitions for _, episode in wanted if episode.transitions is not None]
        self.stats.episodes += len(batches)
        self.stats.transitions += sum(batch.num_rows for batch in batches)
        return batches

    def _start_player(self) -> None:
        if self._player is None:
            self._stopping = False
            # On this thread, as Ray may be started for it, with handlers of signals.
            self._running_pool()
            self._player = threading.Thread(target=self._play_ahead, name="rollouts", daemon=True)
            self._player.start()

    def _stop_player(self) -> None:
        if self._player is not None:
            with self._state:
                self._stopping = True
                self._state.notify_all()
            self._player.join()
            self._player = None

    def _play_ahead(self) -> None:
        """Play what is planned until `_stopping`, or until an error."""
        pool = self._running_pool()
        try:
            while True:
                with self._state:
                    while not (self._stopping or len(self._driver.queue) or pool.busy):
                        self._state.wait()
                    if self._stopping:
                        return
                self._play_on()
        except BaseException as error:  # noqa: BLE001 - the next call raises it
            with self._state:
                self._error = error
                self._state.notify_all()

    def _plan_until(self, limit: int) -> None:
        """Queue the episodes up to number `limit`."""
        for number in range(self._planned, limit):
            state, member = divmod(number, self._settings.groups)
            episode, turn = divmod(state, len(self._plan.cases))
            case = self._plan.cases[turn]
            # The first of a group is the episode of an evaluation. The policy seeds of the others
            # are above all of those, so that no two episodes of an environment share their noise.
            policy_seed = self._settings.seed + _OTHER_MEMBERS + number if member else None
            job = Job(
                EpisodeKey(
                    case.env, episode, self._settings.seed + episode, case.fingerprint, policy_seed
                ),
                case,
            )
            self._episodes[job.key] = _PlannedEpisode(job, number)
            self._driver.queue.put(job)
        self._planned, self._allowed = max(self._planned, limit), limit

    def _play_on(self) -> None:
        """Hand out jobs, and take the reports that arrive."""
        pool = self._running_pool()
        with self._state:
            self._driver.hand_out(pool)
        for job, report in pool.wait(POLL_S):
            with self._state:
                self._driver.take(job, report)
                self._replay_stale()
                self._state.notify_all()

    def _with_start_state(self, transitions: Any, start_state: int) -> Any:
        """Return transitions that are numbered by their start state among those of all
        environments.

        A worker numbers the states of one environment; episodes of one number would be a group of
        several tasks.
        """
        column = tensors(self._pa, np.full(transitions.num_rows, start_state, np.int64))
        return transitions.set_column(
            transitions.schema.get_field_index("episode"), "episode", column
        )

    def _running_pool(self) -> Workers:
        if self._pool is None:
            pool_of = workers_class(self._plan, self._resources)
            self._pool = self._resources.enter_context(
                pool_of(self._plan, self._factory, self._recorders)
            )
            jobs = [episode.job for episode in self._episodes.values()]
            self._driver = Driver(self._plan, jobs, _Consumer(self))
        return self._pool

    def _begin(self, jobs: tuple[Job, ...]) -> None:
        for job in jobs:
            self._episodes[job.key].pushed = self._pushed

    def _finish(self, job: Job, transitions: Any) -> None:
        """Keep the transitions of an episode until it is its turn; None if it is lost."""
        episode = self._episodes[job.key]
        episode.over = True
        if transitions is None:
            episode.transitions = None
            self.stats.lost += 1
            return

        transitions = self._with_start_state(transitions, episode.number // self._settings.groups)
        episode.transitions = transitions
        versions = transitions.column("version").to_numpy()
        episode.oldest = int(versions.min())
        self._saw(int(versions.max()))
        max_lag = self._settings.max_lag
        # It would always be too old.
        if max_lag is not None and episode.pushed - episode.oldest > max_lag:
            raise WeightsLost(
                f"version: {job.key} began when rollouts.version had been set to {episode.pushed}, "
                "but its acts name "
                f"{episode.oldest}; set it to what a push returned, after it has (a policy that "
                "names none has 0), and "
                f"push again if a replica was restarted since then"
            )

    def _replay_stale(self) -> None:
        """Queue episodes again whose acts have outdated weights, or hold them until they may
        begin.
        """
        for episode in reversed(self._episodes.values()):
            lag = self._version - episode.oldest if episode.transitions is not None else 0
            if self._settings.max_lag is not None and lag > self._settings.max_lag:
                episode.over = False
                episode.held = True
                episode.transitions = None
                self.stats.stale += 1
            if episode.held and episode.number < self._allowed:
                episode.held = False
                self._driver.queue.put_back(episode.job)


class _Consumer(Consumer):
    """Passes the episodes of the driver to the rollouts."""

    policy_cure = loss_cure = "mend this, and go on with `first=rollouts.position`"

    def __init__(self, rollouts: Rollouts) -> None:
        self._rollouts = rollouts

    def began(self, jobs: tuple[Job, ...]) -> None:
        self._rollouts._begin(jobs)

    def described(self, job: Job, report: Report) -> None:
        pass  # the results of a rollout do not describe who played it

    def attempt_failed(self, job: Job, failure: Failure, *, repeated: bool) -> None:
        self._rollouts.stats.retries += repeated

    def finished(self, job: Job, result: EpisodeResult, artifacts: Artifacts) -> None:
        self._rollouts._finish(job, artifacts.transitions)
