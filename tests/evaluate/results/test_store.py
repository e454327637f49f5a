from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

import pytest
from eval_fakes import LINE, OTHER_LINE

from vlagents_ray.errors import ConfigError, WeightsLost
from vlagents_ray.evaluate import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult, WorkerInfo
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.reader import Results, is_sequential
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize


def planned(config: EvalConfig) -> list[Job]:
    return plan_jobs(plan_cases(config))


FAILURE = Failure("worker", "env_failed", "it hung", "Traceback ...")
Config = Callable[..., EvalConfig]


def recorded(config: EvalConfig) -> list[EpisodeResult]:
    return [one.result for case in Results.load(config.out).cases for one in case.episodes]


def done(key: EpisodeKey, success: bool = True) -> EpisodeResult:
    return EpisodeResult(key, "done", success, success, steps=4, ending="truncated", seconds=1.0)


def test_recorded_episodes_are_finished_and_lost_ones_are_not(config: Config) -> None:
    keys = [job.key for job in planned(config())]
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.record(done(keys[0]), attempts=1)
        store.record(EpisodeResult(keys[1], "policy_error", False, False, error="NaN"), attempts=1)
        store.record(EpisodeResult(keys[2], "infra_failed", error="hung"), attempts=4)
        assert store.finished() == {str(keys[0]), str(keys[1])}


def test_an_episode_is_recorded_once(config: Config) -> None:
    key = planned(config())[0].key
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.record(done(key), attempts=1)
        with pytest.raises(sqlite3.IntegrityError):
            store.record(done(key, success=False), attempts=1)
        assert [one.success_once for one in recorded(config())] == [True]


def test_a_lost_episode_gives_way_to_its_repetition(config: Config) -> None:
    key = planned(config())[0].key
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.record(EpisodeResult(key, "infra_failed", error="hung"), attempts=4)
        assert [one.success_once for one in recorded(config())] == [None]
        store.record(done(key), attempts=1)
        assert [(one.status, one.success_once) for one in recorded(config())] == [("done", True)]


def test_every_failed_attempt_is_kept_with_its_error(config: Config) -> None:
    job = planned(config())[0]
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.record_attempt(job, FAILURE, retried=True)
        store.record_attempt(job.again(), FAILURE, retried=False)
        [case] = Results.load(config().out).cases
    assert [(one.attempt, one.retried, one.error) for one in case.attempts] == [
        (1, True, "it hung"),
        (2, False, "it hung"),
    ]


def test_results_are_not_touched_without_resume(config: Config) -> None:
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.record(done(planned(config())[0].key), attempts=1)
    with pytest.raises(ConfigError, match=r"already has results \(1 episodes\).*--resume"):
        Store(resolve(config()))
    with Store(resolve(config(resume=True))) as store:
        assert len(store.finished()) == 1


@pytest.mark.parametrize("begun", [False, True])
def test_a_run_without_an_episode_leaves_nothing_to_resume(config: Config, begun: bool) -> None:
    with Store(resolve(config())) as store:
        if begun:  # and a wrong setting ended the run
            store.begin_run({})
            store.record_attempt(
                planned(config())[0], Failure("user", "unknown_env", "no such task"), retried=False
            )
    with Store(resolve(config(seed=5))) as store:
        store.begin_run({})
        found = Results.load(config().out)
    assert [run.config["suites"][0]["seeds"] for run in found.runs] == [[5]]
    assert [(case.case_id, case.attempts) for case in found.cases] == [
        (one.fingerprint, ()) for one in store.cases
    ]


@pytest.mark.parametrize(
    ("change", "differing"),
    [
        ({"seed": 100}, "seeds"),
        ({"checkpoint": "b"}, "checkpoint"),
        ({"env_options": {"camera": [8, 8]}}, "env_options"),
    ],
)
def test_results_of_other_settings_are_not_resumed(
    config: Config, change: dict[str, object], differing: str
) -> None:
    with Store(resolve(config())) as store:
        store.begin_run({})
    with pytest.raises(ConfigError, match=f"{differing}: the results have .*, now it is"):
        Store(resolve(config(resume=True, **change)))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"episodes": 4}, "episodes was 6, is 4"),
        ({"seeds": [0]}, r"seeds was \[0, 100\], is \[0\]"),
        ({"envs": [LINE]}, "OtherLine was in it"),
        ({"stop": {"target": 0.5}}, "early stopping was None, is .*target"),
    ],
)
def test_a_plan_that_becomes_smaller_or_may_stop_early_is_a_change(
    config: Config, changes: dict[str, object], told: str
) -> None:
    planned_first = {"envs": [LINE, OTHER_LINE], "seeds": [0, 100]}
    with Store(resolve(config(**planned_first))) as store:
        store.begin_run({})
        for job in plan_jobs(store.cases):
            store.record(done(job.key), attempts=1)
    with pytest.raises(ConfigError, match=f"plan: .*{told}"):
        Store(resolve(config(**planned_first | changes, resume=True)))
    accepted = config(**planned_first | changes, resume=True, accept_changes=True)
    with Store(resolve(accepted)) as store:
        store.begin_run({})
        found = Results.load(accepted.out)
    assert {change.subject for change in found.accepted_changes} == {"plan"}


def test_resuming_a_folder_without_results_says_so(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    Store(resolve(config(resume=True))).close()
    assert "has no results to resume" in caplog.text
    assert "did you mean" not in caplog.text
    mistyped = config(resume=True).out.with_name("ouut")
    Store(resolve(config(resume=True, out=mistyped))).close()
    assert "did you mean 'out'?" in caplog.text


@pytest.mark.parametrize(
    "change",
    [{"episodes": 50}, {"seeds": [0, 100]}, {"video": "all"}, {"envs": [LINE, OTHER_LINE]}],
)
def test_more_of_the_same_is_resumed(config: Config, change: dict[str, object]) -> None:
    with Store(resolve(config())) as store:
        store.begin_run({})
    with Store(resolve(config(resume=True, **change))) as store:
        store.begin_run({})
    known = {case.case_id for case in Results.load(config().out).cases}
    assert known >= {
        case.fingerprint for one in (config(), config(**change)) for case in plan_cases(one)
    }


@pytest.mark.parametrize(
    ("change", "recorded"),
    [
        ({"episodes": 8}, "eval_fakes:Line: episodes was 6, is 8"),
        ({"seeds": [0, 100]}, "eval_fakes:Line: seeds was [0], is [0, 100]"),
        ({"envs": [LINE, OTHER_LINE]}, "eval_fakes:OtherLine was not there, is in it"),
        ({"video": "all"}, None),
        ({}, None),
    ],
)
@pytest.mark.parametrize("number", [0, 2, 6])
def test_a_plan_that_grows_after_a_result_says_so(
    config: Config, change: dict[str, object], recorded: str | None, number: int
) -> None:
    with Store(resolve(config())) as store:
        store.begin_run({})
        for job in planned(config())[:number]:
            store.record(done(job.key), attempts=1)
    grown = config(resume=True, **change)
    Store(resolve(grown)).close()  # as the check before policies are served
    for _ in range(2):  # an unchanged plan does not take the change back
        with Store(resolve(grown)) as store:
            store.begin_run({})
            for job in planned(grown):
                if str(job.key) not in store.finished():
                    store.record(done(job.key), attempts=1)
    results = Results.load(grown.out)
    changes = [str(change) for change in results.accepted_changes]
    assert len(changes) == (recorded is not None and number > 0)
    assert is_sequential(results.cases) == bool(changes)
    assert all(recorded in change for change in changes if recorded)
    summary = summarize(results).to_json()
    assert bool(summary["confidence_sequences"]) == bool(changes)
    page = write_report(results, results.out / "report.html").read_text()
    assert ("Changes of the plan" in page) == bool(changes)
    assert ("the plan changed after the first results" in page) == bool(changes)


def test_two_evaluations_do_not_write_to_one_folder(config: Config) -> None:
    with (
        Store(resolve(config())),
        pytest.raises(ConfigError, match="another evaluation is writing there"),
    ):
        Store(resolve(config(resume=True)))
    Store(resolve(config())).close()


def test_another_checkpoint_on_the_server_is_noticed(config: Config) -> None:
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.note_policy("policy", {"policy": "act", "checkpoint": "a", "uptime_s": 3})
        store.note_policy("policy", {"policy": "act", "checkpoint": "a", "uptime_s": 9})
        with pytest.raises(ConfigError, match=r"expected checkpoint 'a', .*, got 'b'"):
            store.note_policy("policy", {"policy": "act", "checkpoint": "b"})
        assert Results.load(config().out).policies == {
            "policy": {"policy": "act", "checkpoint": "a", "uptime_s": 9}
        }


def test_where_workers_ran_is_kept(config: Config) -> None:
    near = WorkerInfo("gpu1", "ab12", 7, "pi0", "shm", "llvmpipe")
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.note_worker(near)
        store.note_worker(replace(near, host="cpu1", transport="handle", renderer=None))
    found = Results.load(config().out).workers
    assert [
        (one.run, one.host, one.node, one.pid, one.policy, one.transport, one.renderer)
        for one in found
    ] == [
        (1, "gpu1", "ab12", 7, "pi0", "shm", "llvmpipe"),
        (1, "cpu1", "ab12", 7, "pi0", "handle", None),
    ]


def test_a_results_file_of_another_version_is_refused(config: Config) -> None:
    Store(resolve(config())).close()
    with closing(sqlite3.connect(config().out / "results.db")) as db:
        db.execute("PRAGMA user_version = 99")
    with pytest.raises(ConfigError, match=r"expected version .*, got 99"):
        Store(resolve(config(resume=True)))


def test_an_env_that_has_changed_between_runs_is_noticed(config: Config) -> None:
    [case] = plan_cases(config())
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.note_env(case.place, EnvInfo({"simulator": "line", "version": 1}, {}))
        store.note_env(case.place, EnvInfo({"simulator": "line", "version": 1, "node": "b"}, {}))
        store.record(done(planned(config())[0].key), attempts=1)
    with Store(resolve(config(resume=True))) as store:
        assert store.cases == (case,)
        with pytest.raises(
            ConfigError, match=r"its description 'version' was 1, is 2\n.*--accept-changes"
        ):
            store.note_env(case.place, EnvInfo({"simulator": "line", "version": 2}, {}))
    assert [one.described for one in Results.load(config().out).cases] == [
        {"simulator": "line", "version": 1, "node": "b"}
    ]


def test_what_is_not_planned_any_more_is_kept_and_not_counted(config: Config) -> None:
    with Store(resolve(config())) as store:
        store.begin_run({})
        for job in planned(config())[::2]:  # every second job finished first
            store.record(done(job.key), attempts=1)
    with pytest.raises(ConfigError, match=r"plan: .*episodes was 6, is 3"):
        Store(resolve(config(episodes=3, resume=True)))
    with Store(resolve(config(episodes=3, resume=True, accept_changes=True))) as store:
        store.begin_run({})
        [case] = Results.load(config().out).cases
        assert [(one.result.key.episode, one.counts) for one in case.episodes] == [
            (0, True),
            (2, True),
            (4, False),
        ]
        [group] = summarize(Results.load(config().out)).cases
        assert (group.episodes, group.planned) == (2, 3)
    with Store(resolve(config(resume=True))) as store:
        store.begin_run({})
        assert [one.counts for one in Results.load(config().out).cases[0].episodes] == [True] * 3


@pytest.mark.parametrize(
    ("known", "other", "said"),
    [
        (
            {"checkpoint": "runs/1"},
            {"checkpoint": "runs/2"},
            r"expected the checkpoint 'runs/1' .*, got 'runs/2'",
        ),
        (
            {"checkpoint": "runs/1", "weights": "a"},
            {"checkpoint": "runs/1", "weights": "b"},
            r"(?s)other weights .*runs/1 was a, is b\n.*--out.*--accept-changes",
        ),
    ],
)
def test_an_episode_of_another_checkpoint_or_of_other_weights_is_not_added(
    config: Config, known: dict[str, str], other: dict[str, str], said: str
) -> None:
    first, second, third = (job.key for job in planned(config())[:3])
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.record(replace(done(first), **known), attempts=1)
        store.record(replace(done(second), **known), attempts=1)
    with Store(resolve(config(resume=True))) as store:
        store.begin_run({})
        with pytest.raises(ConfigError, match=said):
            store.record(replace(done(third), **other), attempts=1)
        store.record(done(third), attempts=1)  # from a server that reports no weights
    assert [one.weights for one in recorded(config())] == [known.get("weights")] * 2 + [None]


@pytest.mark.parametrize(
    ("first", "last", "fingerprint"),
    [(2, 3, "a"), (3, 4, "a"), (4, 4, "a"), (3, 3, "b"), (None, 3, "a")],
)
def test_an_episode_of_other_weights_than_the_pushed_ones_of_its_case_is_not_added(
    config: Config, first: int | None, last: int, fingerprint: str
) -> None:
    settings = config()
    policy = settings.policies[0].model_dump() | {
        "pushed_weights": {"version": 3, "fingerprint": "a"}
    }
    settings = settings.model_copy(update={"policies": [PolicyConfig.model_validate(policy)]})
    job, other = planned(settings)[:2]
    acted = {"first_policy_version": 3, "policy_version": 3, "policy_fingerprint": "a"}
    mixed = {
        "first_policy_version": first,
        "policy_version": last,
        "policy_fingerprint": fingerprint,
    }
    with Store(resolve(settings)) as store:
        store.begin_run({})
        store.record(replace(done(job.key), **acted), attempts=1)
        expected = rf"expected version 3 .* \(a\) .*, got {first} to {last} \({fingerprint}\)"
        with pytest.raises(WeightsLost, match=expected):
            store.record(replace(done(other.key), **mixed), attempts=1)
    assert [episode.key for episode in recorded(settings)] == [job.key]


def test_a_checkpoint_has_the_same_weights_in_all_tasks(config: Config) -> None:
    """The server may have been replaced between two tasks."""
    settings = config(envs=[LINE, OTHER_LINE], episodes=1)
    first, second = (job.key for job in planned(settings))
    other = replace(done(second), checkpoint="runs/last", weights="b")
    for again in (settings, settings.model_copy(update={"resume": True})):
        with Store(resolve(again)) as store:
            store.begin_run({})
            if not store.finished():
                store.record(replace(done(first), checkpoint="runs/last", weights="a"), attempts=1)
            with pytest.raises(ConfigError, match=r"runs/last was a, is b"):
                store.record(other, attempts=1)
    with Store(resolve(again)) as store:
        store.begin_run({})
        # A checkpoint that the task selects.
        store.record(replace(other, checkpoint="runs/other"), attempts=1)


def test_a_server_with_other_weights_is_noticed_before_anything_is_played(config: Config) -> None:
    said = {"policy": "act", "checkpoint": "a"}
    with Store(resolve(config())) as store:
        store.begin_run({})
        store.note_policy("policy", said)  # a server that reports no weights
        store.note_policy("policy", said | {"weights": {"digest": "x", "revision": None}})
        store.note_policy("policy", said | {"weights": {"digest": "x", "revision": "c0ffee"}})
        with pytest.raises(
            ConfigError, match=r"(?s)policy policy: weights was x, is y\n.*--accept-changes"
        ):
            store.note_policy("policy", said | {"weights": {"digest": "y", "revision": None}})
