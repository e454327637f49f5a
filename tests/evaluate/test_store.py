from __future__ import annotations

import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from subprocess import PIPE, Popen

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import EpisodeKey, Job, plan
from vlagents_ray.evaluate.rollout import Failure, Made
from vlagents_ray.evaluate.store import Store

FAILURE = Failure("worker", "env_failed", "it hung", "Traceback ...")
Config = Callable[..., EvalConfig]


def done(key: EpisodeKey, success: bool = True) -> EpisodeResult:
    return EpisodeResult(key, "done", success, success, steps=4, ending="truncated", seconds=1.0)


def test_recorded_episodes_are_finished_and_lost_ones_are_not(config: Config) -> None:
    keys = plan(config())
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.record(done(keys[0]), attempts=1)
        store.record(EpisodeResult(keys[1], "policy_error", False, False, error="NaN"), attempts=1)
        store.record(EpisodeResult(keys[2], "infra_failed", error="hung"), attempts=4)
        assert store.finished() == {str(keys[0]), str(keys[1])}


def test_an_episode_is_recorded_once(config: Config) -> None:
    key = plan(config())[0]
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.record(done(key), attempts=1)
        with pytest.raises(sqlite3.IntegrityError):
            store.record(done(key, success=False), attempts=1)
        assert [row["success_once"] for row in store.rows("episodes")] == [1]


def test_a_lost_episode_gives_way_to_its_repetition(config: Config) -> None:
    key = plan(config())[0]
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.record(EpisodeResult(key, "infra_failed", error="hung"), attempts=4)
        assert store.rows("episodes")[0]["success_once"] is None
        store.record(done(key), attempts=1)
        assert [(row["status"], row["success_once"]) for row in store.rows("episodes")] == [("done", 1)]


def test_what_is_recorded_is_there_for_another_process_at_once(config: Config) -> None:
    settings = config()
    with Store(settings) as store:
        store.begin_run(settings, {})
        store.record(done(plan(settings)[0]), attempts=2, videos=["videos/a.mp4"])
        with closing(sqlite3.connect(settings.out / "results.db")) as db:
            assert db.execute("PRAGMA journal_mode").fetchone() == ("wal",)
            assert db.execute("SELECT steps, attempts, videos FROM episodes").fetchall() == [(4, 2, '["videos/a.mp4"]')]


def test_every_failed_attempt_is_kept_with_its_error(config: Config) -> None:
    key = plan(config())[0]
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.record_attempt(Job(key), FAILURE, retried=True)
        store.record_attempt(Job(key, 2), FAILURE, retried=False)
        rows = store.rows("attempts")
    assert [(row["attempt"], row["retried"], row["error"]) for row in rows] == [(1, 1, "it hung"), (2, 0, "it hung")]


def test_results_are_not_touched_without_resume(config: Config) -> None:
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.record(done(plan(config())[0]), attempts=1)
    with pytest.raises(ConfigError, match=r"already has results \(1 episodes\).*--resume"):
        Store(config())
    with Store(config(resume=True)) as store:
        assert len(store.finished()) == 1


def test_a_folder_that_was_opened_and_not_used_needs_no_resume(config: Config) -> None:
    Store(config()).close()
    Store(config(seed=5)).close()


@pytest.mark.parametrize("change", [{"policy": "other"}, {"seed": 100}, {"checkpoint": "b"}, {"execute": 2}])
def test_results_of_other_settings_are_not_resumed(config: Config, change: dict[str, object]) -> None:
    with Store(config()) as store:
        store.begin_run(config(), {})
    (name,) = change
    with pytest.raises(ConfigError, match=f"{name}: the results have .*, now it is"):
        Store(config(resume=True, **change))


@pytest.mark.parametrize(
    "change", [{"episodes": 50}, {"workers": 7}, {"video": "all"}, {"envs": ["eval_fakes:OtherLine"]}]
)
def test_more_of_the_same_is_resumed(config: Config, change: dict[str, object]) -> None:
    with Store(config()) as store:
        store.begin_run(config(), {})
    Store(config(resume=True, **change)).close()


def test_two_evaluations_do_not_write_to_one_folder(config: Config) -> None:
    with Store(config()), pytest.raises(ConfigError, match="another evaluation is writing there"):
        Store(config(resume=True))
    Store(config()).close()


def test_another_checkpoint_on_the_server_is_noticed(config: Config) -> None:
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.note_policy({"policy": "act", "checkpoint": "a", "uptime_s": 3})
        store.note_policy({"policy": "act", "checkpoint": "a", "uptime_s": 9})
        with pytest.raises(ConfigError, match=r"checkpoint 'b'.*are of 'a'"):
            store.note_policy({"policy": "act", "checkpoint": "b"})
        assert store.policy() == {"policy": "act", "checkpoint": "a", "uptime_s": 9}


def test_what_is_known_of_an_env_survives_a_resume(config: Config) -> None:
    (env,) = config().envs
    with Store(config()) as store:
        store.begin_run(config(), {})
        store.note_env(Made(env, {"simulator": "line"}, {}))
    with Store(config(resume=True)) as store:
        assert store.rows("envs")[0]["described"] == '{"simulator": "line"}'


def test_a_results_file_of_another_version_is_refused(config: Config) -> None:
    Store(config()).close()
    with closing(sqlite3.connect(config().out / "results.db")) as db:
        db.execute("PRAGMA user_version = 99")
    with pytest.raises(ConfigError, match="got version 99"):
        Store(config(resume=True))


WRITER = """
import sys
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import plan
from vlagents_ray.evaluate.store import Store

config = EvalConfig.model_validate_json(sys.argv[1])
with Store(config) as store:
    store.begin_run(config, {})
    for key in plan(config):
        store.record(EpisodeResult(key, "done", True, True), 1)
        print(key, flush=True)
"""


def test_a_killed_writer_loses_nothing_that_it_recorded(config: Config) -> None:
    settings = config(episodes=1_000_000)
    with Popen([sys.executable, "-c", WRITER, settings.model_dump_json()], stdout=PIPE, text=True) as writer:
        assert writer.stdout is not None
        told = [writer.stdout.readline().strip() for _ in range(200)]
        writer.kill()
        told += [line.strip() for line in writer.stdout if line.endswith("\n")]
    with Store(config(episodes=1_000_000, resume=True)) as store:
        finished = store.finished()
    assert set(told) <= finished
    assert len(finished) <= len(told) + 1


def test_an_episode_of_another_checkpoint_is_not_added(config: Config) -> None:
    first, second, third = plan(config(episodes=3))
    with Store(config(episodes=3)) as store:
        store.begin_run(config(episodes=3), {})
        store.record(replace(done(first), checkpoint="runs/1"), attempts=1)
        store.record(replace(done(second), checkpoint="runs/1"), attempts=1)
        with pytest.raises(ConfigError, match=r"played by checkpoint 'runs/2'.* are of 'runs/1'"):
            store.record(replace(done(third), checkpoint="runs/2"), attempts=1)
        assert [row["checkpoint"] for row in store.rows("episodes")] == ["runs/1", "runs/1"]
