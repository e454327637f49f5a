"""Settings, cases and jobs: the planned episodes, their keys, and the order in which workers take
them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, OTHER_LINE
from in_process_evaluation import flat_config
from pydantic import ValidationError

from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.evaluate import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.plan.cases import expand, plan_cases
from vlagents_ray.evaluate.plan.config import ClockConfig, SuiteConfig, canonical, fingerprint
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, JobQueue, plan_jobs

Config = Callable[..., EvalConfig]


def jobs_of(env: str, count: int, **settings: Any) -> list[Job]:
    return plan_jobs(plan_cases(flat_config(envs=[env], episodes=count, out="out", **settings)))


def keys(config: EvalConfig) -> list[EpisodeKey]:
    return [job.key for job in plan_jobs(plan_cases(config))]


def test_a_plan_numbers_and_seeds_every_episode_of_every_env(config: Config) -> None:
    found = keys(config(envs=[LINE, OTHER_LINE], episodes=2, seeds=[7, 100]))
    assert [(key.env, key.episode, key.seed) for key in found] == [
        (env, episode, seed + episode)
        for env in (LINE, OTHER_LINE)
        for seed in (7, 100)
        for episode in (0, 1)
    ]
    assert len(set(map(str, found))) == 8


def test_pushed_weights_are_a_checkpoint_and_part_of_the_key(config: Config) -> None:
    usual = config(episodes=2)

    def pushed(fingerprint: str) -> EvalConfig:
        given = usual.policies[0].model_dump() | {
            "pushed_weights": {"version": 3, "fingerprint": fingerprint}
        }
        return usual.model_copy(update={"policies": [PolicyConfig.model_validate(given)]})

    [case] = plan_cases(pushed("a"))
    assert (case.policy_id, case.checkpoint_step) == ("policy@3", None), (
        "no checkpoint is requested from the policy"
    )
    assert len({str(key) for one in (usual, pushed("a"), pushed("b")) for key in keys(one)}) == 6
    with pytest.raises(ValueError, match="expected steps or pushed_weights, got both"):
        PolicyConfig.model_validate(
            {"steps": [1], "pushed_weights": {"version": 1, "fingerprint": "a"}}
        )


def test_a_sweep_plays_checkpoint_by_checkpoint(config: Config) -> None:
    jobs = plan_jobs(plan_cases(config(envs=[LINE, OTHER_LINE], episodes=1, steps=[10, 20])))
    assert [(job.case.policy_id, job.key.env) for job in jobs] == [
        ("policy@10", LINE),
        ("policy@10", OTHER_LINE),
        ("policy@20", LINE),
        ("policy@20", OTHER_LINE),
    ]
    assert [job.case.checkpoint_step for job in jobs[::2]] == [10, 20]
    assert len({str(job.key) for job in jobs}) == 4
    assert jobs[0].case.place == jobs[2].case.place, "checkpoints share the environment of a worker"


@pytest.mark.parametrize(
    "change",
    [
        {"policy": "other"},
        {"policy_config": {"speed": 2}},
        {"policy_options": {"temperature": 2}},
        {"checkpoint": "step-100"},
        {"env_options": {"width": 128}},
        {"reset_options": {"layout": 1}},
        {"execute": 4},
        {"codec": "jpeg"},
    ],
)
def test_what_changes_the_outcome_changes_the_key(config: Config, change: dict[str, Any]) -> None:
    assert not set(map(str, keys(config()))) & set(map(str, keys(config(**change))))


@pytest.mark.parametrize(
    "change",
    [
        {"workers": 9},
        {"video": "all"},
        {"policy_url": "http://there:1"},
        {"retries": 0},
        {"threads": 4},
        {"resume": True},
        {"codec": "raw"},
        {"codec": "lossless"},
    ],
)
def test_what_does_not_change_the_outcome_keeps_the_key(
    config: Config, change: dict[str, Any]
) -> None:
    assert keys(config()) == keys(config(**change))


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (
            {"envs": [LINE], "env_options": {"width": 8}},
            "expected each case once in suites of one name",
        ),
        (
            {"name": "all", "envs": [LINE, OTHER_LINE], "seeds": [100]},
            "expected each episode once, got .* in two suites with the same settings",
        ),
    ],
)
def test_an_env_in_two_suites_of_one_name_or_that_do_not_differ_is_refused(
    second: dict[str, Any], said: str
) -> None:
    suites = [SuiteConfig(envs=[LINE]), SuiteConfig.model_validate(second)]
    with pytest.raises(ConfigError, match=said):
        plan_cases(EvalConfig(policies=[PolicyConfig()], suites=suites, out=Path("out")))


def test_policies_whose_episodes_would_share_their_files_are_refused(config: Config) -> None:
    [policy] = config().policies
    policies = [policy.model_copy(update={"name": name}) for name in ("pi0/fast", "pi0_fast")]
    with pytest.raises(ConfigError, match="expected names whose files differ"):
        plan_cases(config().model_copy(update={"policies": policies}))


def test_a_pattern_stands_for_the_tasks_that_match() -> None:
    assert expand("tabletop/*") == [f"tabletop/{task}" for task in Tabletop.tasks()]
    assert expand("tabletop") == ["tabletop"]
    with pytest.raises(UnknownEnv, match=r"expected tasks of 'tabletop', .*, which matches none"):
        expand("tabletop/x*")


def test_a_worker_stays_with_the_env_it_has_made() -> None:
    first, other = jobs_of(LINE, 2), jobs_of(OTHER_LINE, 5)
    queue = JobQueue(first + other)
    kind, made = first[0].case.kind, first[0].case.place
    taken = [queue.take(kind, made, Counter()) for _ in range(3)]
    assert [job.key.env for [job] in taken] == [LINE, LINE, OTHER_LINE]


def test_workers_without_an_env_spread_over_the_envs() -> None:
    jobs = jobs_of(LINE, 4) + jobs_of(OTHER_LINE, 4)
    queue = JobQueue(jobs)
    working: Counter[str] = Counter()
    for _ in range(4):
        [job] = queue.take(jobs[0].case.kind, None, working)
        working[job.case.place] += 1
    assert sorted(working.values()) == [2, 2]


def test_no_worker_idles_while_any_episode_of_its_kind_waits() -> None:
    [only] = jobs_of(LINE, 1)
    queue = JobQueue([only])
    assert queue.take("another kind", None, Counter()) == ()
    assert queue.take(only.case.kind, "elsewhere", Counter({only.case.place: 5})) == (only,)
    assert queue.take(only.case.kind, only.case.place, Counter()) == ()
    assert len(queue) == 0


def test_a_further_attempt_comes_before_new_episodes() -> None:
    jobs = jobs_of(LINE, 3)
    queue = JobQueue(jobs)
    kind, made = jobs[0].case.kind, jobs[0].case.place
    [first] = queue.take(kind, made, Counter())
    queue.put_back(first.again())
    assert queue.take(kind, made, Counter()) == (first.again(),)
    assert first.again().attempt == 2


def test_workers_are_wanted_where_most_wait_for_each() -> None:
    many, few = jobs_of(LINE, 6), jobs_of(OTHER_LINE, 2, cpus_per_worker=2.0)
    queue = JobQueue(many + few)
    kinds: Counter[str] = Counter()
    while (case := queue.needs_worker(kinds, kinds)) is not None:
        kinds[case.kind] += 1
    assert kinds == {many[0].case.kind: 6, few[0].case.kind: 2}, "no more workers than episodes"
    assert queue.needs_worker({many[0].case.kind: 6}, {}) == few[0].case


def test_a_case_that_is_dropped_leaves_the_others() -> None:
    jobs = jobs_of(LINE, 6, steps=[1, 2])
    queue = JobQueue(jobs)
    assert queue.drop(jobs[0].case.fingerprint) == 6
    assert len(queue) == 6
    [job] = queue.take(jobs[0].case.kind, None, Counter())
    assert job.case.step == 2


def test_episodes_side_by_side_are_of_one_case() -> None:
    jobs = jobs_of(LINE, 5, steps=[1, 2], num_envs=3)
    queue = JobQueue(jobs)
    kind = jobs[0].case.kind
    assert queue.needs_worker({}, {kind: 3}) is not None, (
        "ten episodes, three at a time, need four workers"
    )
    assert queue.needs_worker({}, {kind: 4}) is None
    taken = [queue.take(kind, None, Counter()) for _ in range(4)]
    assert [[job.case.step for job in some] for some in taken] == [
        [1, 1, 1],
        [1, 1],
        [2, 2, 2],
        [2, 2],
    ]


def test_a_range_of_steps_includes_the_last(config: Config) -> None:
    [policy] = config(steps={"first": 1000, "last": 3000, "every": 1000}).policies
    assert policy.steps == [1000, 2000, 3000]


def test_seeds_that_would_play_an_episode_twice_are_refused(config: Config) -> None:
    assert config(episodes=5, seeds=[10, 0, 5]).suites[0].seeds == [10, 0, 5]
    with pytest.raises(ValidationError, match="expected seeds at least 5 apart"):
        config(episodes=5, seeds=[0, 4])


def test_a_fingerprint_ignores_order_and_nothing_else() -> None:
    assert fingerprint({"a": 1, "b": [1, 2]}) == fingerprint({"b": [1, 2], "a": 1})
    assert fingerprint({"a": 1, "b": [1, 2]}) != fingerprint({"a": 1, "b": [2, 1]})


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_json_lacks_are_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="Out of range"):
        canonical({"a": value})


def test_a_batch_has_no_latency_to_measure() -> None:
    assert SuiteConfig(envs=["line"], num_envs=2, clock=ClockConfig(latency=0.1)).clock is not None
    with pytest.raises(ValidationError, match="as a batch has only one latency, got"):
        SuiteConfig(envs=["line"], num_envs=2, clock=ClockConfig())


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"wokers": 3}, "wokers"),
        ({"envs": ["a", "b", "a"]}, "expected each env once, got .*'a'.* twice"),
        (
            {"policies": [{"name": "a", "url": "http://x"}, {"name": "a", "url": "http://y"}]},
            "policies: expected different names",
        ),
        (
            {"policy_options": {"seed": 3, "temperature": 2}},
            r"expected no options that the evaluation sets for each episode, got \['seed'\]",
        ),
    ],
)
def test_settings_that_cannot_be_are_refused(
    config: Config, wrong: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValidationError, match=said):
        config(**wrong)
