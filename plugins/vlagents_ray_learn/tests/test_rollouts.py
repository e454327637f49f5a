from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from eval_fakes import EVERY, LINE, OTHER_LINE, Line, SevenLine, ToZero, wait_for
from in_process_evaluation import flat_config
from in_process_replicas import Replicas

from vlagents_ray.envs.base import BatchEnv, SequentialBatch
from vlagents_ray.errors import ConfigError, ConnectionLost, EnvFailed, PolicyFailed, UnknownEnv
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.workers import rollout
from vlagents_ray.evaluate.workers.in_process import InProcessWorkers
from vlagents_ray.evaluate.workers.rollout import Report
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray_learn import RolloutPlan, Rollouts, arrays
from vlagents_ray_learn import rollouts as rollouts_module


class Workers(InProcessWorkers):
    """As many as there are to be, of which the last one is the first to answer."""

    dying = 0  # this many answers are those of workers that died
    played: list[str] = []  # noqa: RUF012 - the keys, in the order of the answers; each test has its own

    def free_slot(self) -> bool:
        return len(self._workers) < self._plan.workers

    def wait(self, _timeout_s: float) -> Iterator[tuple[Job, Report]]:
        for worker in self._workers:
            worker.starting = None
        busy = [worker for worker in reversed(self._workers) if worker.jobs]
        for worker in busy[:1]:  # the others play on
            jobs, worker.jobs = worker.jobs, ()
            reports = self._rollout.run(jobs)
            if type(self).dying > 0:
                type(self).dying -= 1
                self._workers.remove(worker)
                reports = [
                    Report(failure=Failure("worker", EnvFailed.code, "the worker died"))
                ] * len(jobs)
            else:
                self.played.extend(str(job.key) for job in jobs)
            yield from zip(jobs, reports, strict=True)


@pytest.fixture(autouse=True)
def pool(monkeypatch: pytest.MonkeyPatch) -> type[Workers]:
    """Workers in this process."""
    monkeypatch.setattr(Workers, "dying", 0)
    monkeypatch.setattr(Workers, "played", [])
    monkeypatch.setattr(rollout, "FIRST_WAIT_S", 0.001)

    def workers_class(plan: ResolvedPlan, _stack: object) -> type[InProcessWorkers]:
        # Without workers the real class runs, as this one would wait for a worker that it does not
        # start.
        return Workers if plan.workers else InProcessWorkers

    monkeypatch.setattr(rollouts_module, "workers_class", workers_class)
    return Workers


class Versioned(ToZero):
    """Its weights are changed by setting `version`."""

    version = 0

    def act(self, obs: Obs) -> Act:
        act = super().act(obs)
        act.info["policy"] = {"version": type(self).version}
        return act


@pytest.fixture
def versioned(monkeypatch: pytest.MonkeyPatch) -> type[Versioned]:
    monkeypatch.setattr(Versioned, "version", 0)
    return Versioned


def keys(batches: Any) -> list[str]:
    return [str(batch.column("key")[0]) for batch in batches]


def planned(episodes: int, env: str = LINE) -> list[str]:
    """The keys of an evaluation."""
    config = flat_config(envs=[env], episodes=episodes, out="out", seed=0)
    return [str(job.key) for job in plan_jobs(plan_cases(config))]


def test_episodes_are_those_of_an_evaluation_in_their_order_whoever_plays_them(
    pool: type[Workers],
) -> None:
    with Rollouts(RolloutPlan(LINE, ToZero, workers=3)) as several:
        batches = list(itertools.islice(several, 8))
    assert keys(batches) == planned(8)
    assert pool.played[:8] != planned(8), "or the test shows nothing"
    with Rollouts(RolloutPlan(LINE, ToZero)) as single:
        alone = list(itertools.islice(single, 8))
    assert all(first.equals(second) for first, second in zip(batches, alone, strict=True))
    assert (several.stats.episodes, several.stats.transitions, several.position) == (8, 80, 8)


def test_collect_plays_so_many_and_no_others(pool: type[Workers]) -> None:
    with Rollouts(RolloutPlan(LINE, ToZero, workers=3)) as rollouts:
        table = rollouts.collect(5)
        assert sorted(pool.played) == sorted(planned(5))
        assert table.num_rows == 50
        assert arrays(table)["state.position"].shape == (50, 1)
        assert list(dict.fromkeys(arrays(rollouts.collect(2))["key"])) == planned(7)[5:]


PLAY = """
import sys
import threading
for name in ("ray", "torch"):
    sys.modules[name] = None  # as if it were not installed
from eval_fakes import LINE, ToZero
from vlagents_ray_learn import RolloutPlan, Rollouts
with Rollouts(RolloutPlan(LINE, ToZero, workers=0)) as rollouts:
    print(rollouts.collect(2).num_rows)
"""


def test_without_workers_they_need_no_ray() -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-W", "error", "-c", PLAY]
    told = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=60, env=environment
    )
    assert told.returncode == 0, told.stderr
    assert told.stdout.strip() == "20"


class Replayed(ToZero):
    """States tokens to compute its log-probabilities again from."""

    def act(self, obs: Obs) -> Act:
        act = super().act(obs)
        if obs.info.get("want") == ["replay"]:
            act.info["behaviour"] = {
                "replay": {"tokens": np.rint(100 * act.rows()).astype(np.int64)}
            }
        return act


def test_the_replay_is_a_column() -> None:
    with Rollouts(RolloutPlan(LINE, Replayed, workers=2, want=["replay"])) as rollouts:
        columns = arrays(rollouts.collect(4))
    tokens = columns["replay.tokens"]
    assert tokens.shape == (40, 1, 1)
    np.testing.assert_array_equal(tokens[:, 0], np.rint(100 * columns["action"]))


@pytest.mark.parametrize("workers", [0, 2])
def test_groups_of_several_envs_share_no_number_and_no_two_episodes_of_an_env_share_a_policy_seed(
    workers: int,
) -> None:
    envs = [LINE, "eval_fakes:OtherLine"]
    with Rollouts(RolloutPlan(envs, ToZero, groups=3, workers=workers, seed=10)) as rollouts:
        episodes = [arrays(batch) for batch in itertools.islice(rollouts, 24)]

    groups: dict[int, list[str]] = {}
    seeds: dict[str, list[int]] = {}
    for columns in episodes:
        key = str(columns["key"][0]).partition("~")[0]
        start, _, seeds_and_more = key.partition("@")
        seed, _, policy_seed = seeds_and_more.partition(":")[0].partition("/")
        groups.setdefault(int(columns["episode"][0]), []).append(start)
        seeds.setdefault(start.partition("#")[0], []).append(int(policy_seed or seed))
    assert sorted(groups) == list(range(8))
    assert all(len(starts) == 3 and len(set(starts)) == 1 for starts in groups.values())
    assert all(len(set(of_env)) == len(of_env) == 12 for of_env in seeds.values())


def test_a_group_begins_in_one_state_and_differs_in_the_seed_of_the_policy() -> None:
    with Rollouts(RolloutPlan(LINE, ToZero, groups=3, workers=2, seed=10)) as rollouts:
        episodes = [arrays(batch) for batch in itertools.islice(rollouts, 6)]
    starts = [float(columns["state.position"][0, 0]) for columns in episodes]
    assert starts[0] == starts[1] == starts[2] != starts[3] == starts[4] == starts[5]
    assert [columns["episode"][0] for columns in episodes] == [0, 0, 0, 1, 1, 1]
    assert len({columns["action"].tobytes() for columns in episodes}) == 6
    assert len({columns["key"][0] for columns in episodes}) == 6
    with pytest.raises(ConfigError, match="expected a multiple of groups, 3, got 4 episodes"):
        rollouts.collect(4)


@pytest.mark.parametrize("collected", [True, False])
def test_workers_that_die_cost_neither_an_episode_nor_a_second_one(
    pool: type[Workers], collected: bool
) -> None:
    pool.dying = 2
    with Rollouts(RolloutPlan(LINE, ToZero, workers=3)) as rollouts:
        batches = (
            rollouts.collect(8).to_batches() if collected else list(itertools.islice(rollouts, 8))
        )
    assert keys(batches) == planned(8)
    assert (rollouts.stats.retries, rollouts.stats.lost) == (2, 0)


def test_an_episode_that_no_attempt_ends_is_left_out_and_counted() -> None:
    broken = {"trouble": {"raise": [2]}}
    with Rollouts(
        RolloutPlan(LINE, ToZero, env_options=broken, settings={"retries": 1})
    ) as rollouts:
        batches = list(itertools.islice(rollouts, 4))
    assert [int(batch.column("episode")[0].as_py()) for batch in batches] == [0, 1, 3, 4]
    assert (rollouts.stats.retries, rollouts.stats.lost, rollouts.position) == (1, 1, 5)


def test_too_many_lost_in_a_row_end_it_with_their_error() -> None:
    def lost() -> Agent:
        return ToZero(lost_on=EVERY)

    with (
        Rollouts(RolloutPlan(LINE, lost, settings={"retries": 0, "abort_after": 3})) as rollouts,
        pytest.raises(ConnectionLost, match=r"3 episodes in a row lost .*first=rollouts.position"),
    ):
        rollouts.collect(4)


def test_an_error_of_the_policy_loses_the_episode_and_ends_it_if_it_stays() -> None:
    class Nan(ToZero):
        def act(self, obs: Obs) -> Act:
            return Act(np.full(1, np.nan, np.float32))

    with (
        Rollouts(RolloutPlan(LINE, Nan, settings={"abort_after": 2})) as rollouts,
        pytest.raises(PolicyFailed, match="2 episodes in"),
    ):
        next(rollouts)
    assert (rollouts.stats.lost, rollouts.stats.retries) == (2, 0)


def test_on_policy_by_default_older_episodes_are_played_again(versioned: type[Versioned]) -> None:
    with Rollouts(RolloutPlan(LINE, versioned, workers=3)) as rollouts:
        first = next(rollouts)
        versioned.version = rollouts.version = 1
        later = list(itertools.islice(rollouts, 5))
    assert keys([first, *later]) == planned(6)
    versions = [set(batch.column("version").to_pylist()) for batch in [first, *later]]
    assert versions == [{0}, {1}, {1}, {1}, {1}, {1}]
    assert rollouts.stats.stale > 0


def test_a_version_that_no_act_names_is_an_error_and_not_an_endless_repetition() -> None:
    with Rollouts(RolloutPlan(LINE, ToZero)) as rollouts:
        next(rollouts)
        rollouts.version += 1
        with pytest.raises(
            ConfigError, match=r"set to 1, but its acts name 0; set it to what a push returned"
        ):
            rollouts.collect(4)


def test_the_version_rises_with_that_of_the_acts(versioned: type[Versioned]) -> None:
    with Rollouts(RolloutPlan(LINE, versioned)) as rollouts:
        versioned.version = 4
        next(rollouts)
        assert rollouts.version == 4


@pytest.mark.parametrize(("lag", "stale"), [(1, 0), (None, 0), (0, 1)])
def test_a_lag_may_be_allowed(versioned: type[Versioned], lag: int | None, stale: int) -> None:
    class Pushed(versioned):  # type: ignore[valid-type, misc]
        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            # After the first act, in the middle of the first episode.
            type(self).version = versioned.version = 1
            return act

    with Rollouts(RolloutPlan(LINE, Pushed, max_lag=lag)) as rollouts:
        table = rollouts.collect(2)
    assert rollouts.stats.stale == stale
    assert (0 in table.column("version").to_pylist()) is (stale == 0)


class Together(SequentialBatch):
    """Environments that one simulator steps and resets together, as ManiSkill's on a GPU."""

    restarts = False


def test_a_simulator_of_many_environments_is_one_worker_with_one_question_a_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[BatchEnv] = []

    def together(num_envs: int, **options: Any) -> BatchEnv:
        made.append(Together([Line(**options) for _ in range(num_envs)]))
        return made[-1]

    monkeypatch.setattr(Line, "batched", together)
    served = Replicas([ToZero()])
    try:
        with Rollouts(RolloutPlan(LINE, served.agent, num_envs=4, groups=2)) as rollouts:
            table = rollouts.collect(8)
    finally:
        served.close()
    assert [env.num_envs for env in made] == [4]
    assert served.frames[:22] == [4] * 22, (
        "a reset and 10 acts, twice; sessions are closed one by one"
    )
    with Rollouts(RolloutPlan(LINE, ToZero, groups=2)) as alone:
        assert table.drop_columns("key").equals(alone.collect(8).drop_columns("key"))


def test_they_go_on_where_a_learner_that_died_was() -> None:
    with Rollouts(RolloutPlan(LINE, ToZero, groups=2)) as rollouts:
        rollouts.collect(4)
        batches = list(itertools.islice(rollouts, 3))
    with Rollouts(RolloutPlan(LINE, ToZero, groups=2, first=4)) as continued:
        continued_batches = list(itertools.islice(continued, 3))
    assert len(continued_batches) == 3
    for batch, continued_batch in zip(batches, continued_batches, strict=True):
        assert batch.equals(continued_batch)


def test_closed_and_asked_for_more_they_begin_again_what_was_not_delivered() -> None:
    rollouts = Rollouts(RolloutPlan(LINE, ToZero, workers=3))
    first = next(rollouts)
    rollouts.close()
    rollouts.close()
    assert keys([first, *itertools.islice(rollouts, 4)]) == planned(5)
    rollouts.close()


def test_several_envs_take_turns() -> None:
    with Rollouts(RolloutPlan([LINE, OTHER_LINE], ToZero)) as rollouts:
        delivered = keys(itertools.islice(rollouts, 4))
    line, other_line = planned(2), planned(2, OTHER_LINE)
    assert delivered == [line[0], other_line[0], line[1], other_line[1]]


def test_envs_of_different_columns_do_not_fit_into_one_table(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Seven(ToZero):
        @property
        def contract(self) -> None:
            return None

        def act(self, obs: Obs) -> Act:
            return Act(np.zeros(7 if self._seven else 1, np.float32))

        def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
            self._seven = kwargs["env"].endswith(SevenLine.__name__)
            return super().reset(obs, instruction, **kwargs)

    with (
        Rollouts(RolloutPlan([LINE, "eval_fakes:SevenLine"], Seven)) as rollouts,
        pytest.raises(ConfigError, match="iterate"),
    ):
        rollouts.collect(2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"groups": 0}, "groups: expected at least 1, got 0"),
        ({"want": ["logits"]}, r"want: expected only .*, got \['logits'\]"),
        ({"first": -1}, "first: expected at least 0, got -1"),
    ],
)
def test_wrong_settings_are_errors_before_any_worker_starts(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        Rollouts(RolloutPlan(LINE, ToZero, **settings))


def test_an_env_that_nobody_knows_is_an_error_at_once() -> None:
    with pytest.raises(UnknownEnv):
        Rollouts(RolloutPlan("nowhere", ToZero))
    with pytest.raises(ValueError, match="wrkers"):
        Rollouts(RolloutPlan(LINE, ToZero, settings={"wrkers": 3}))


def test_workers_play_on_while_the_learner_learns_and_no_further_than_allowed(
    pool: type[Workers],
) -> None:
    with Rollouts(RolloutPlan(LINE, ToZero, workers=2)) as rollouts:
        next(rollouts)
        wait_for(lambda: len(pool.played) == 5)  # without a further call: two for each of the two
        table = rollouts.collect(2)
        assert list(dict.fromkeys(arrays(table)["key"])) == planned(3)[1:]
        assert sorted(pool.played) == sorted(planned(5))
    assert not [thread for thread in threading.enumerate() if thread.name == "rollouts"]


@pytest.mark.parametrize("lag", [0, 1, 4])
@pytest.mark.parametrize("step", [1, 8])
def test_at_a_steady_pace_no_episode_is_played_twice(
    pool: type[Workers], versioned: type[Versioned], lag: int, step: int
) -> None:
    before = 0
    with Rollouts(RolloutPlan(LINE, versioned, workers=2, max_lag=lag)) as rollouts:
        for number in range(8):
            lags = [
                rollouts.version - next(rollouts).column("version")[0].as_py() for _ in range(2)
            ]
            stale = rollouts.stats.stale
            if number > 3:
                assert stale == before, "the pace is known"
                assert max(lags) == (min(lag, 2) if step == 1 else 0)
            before = stale
            wait_for(
                lambda: (
                    rollouts._player is None or not (rollouts._driver.queue or rollouts._pool.busy)
                )
            )  # type: ignore[union-attr]
            versioned.version = rollouts.version = versioned.version + step
    assert len(pool.played) == len(set(pool.played)) + rollouts.stats.stale


def test_an_error_while_the_learner_learns_is_raised_by_its_next_calls(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Breaks(ToZero):
        broken = False

        def act(self, obs: Obs) -> Act:
            return Act(np.full(1, np.nan, np.float32)) if type(self).broken else super().act(obs)

    with Rollouts(RolloutPlan(LINE, Breaks, settings={"abort_after": 1})) as rollouts:
        first = next(rollouts)
        monkeypatch.setattr(Breaks, "broken", True)
        with pytest.raises(PolicyFailed, match="1 episodes in a row"):
            list(itertools.islice(rollouts, 5))
        monkeypatch.setattr(Breaks, "broken", False)
        assert rollouts.collect(1).num_rows == first.num_rows, "it goes on"
