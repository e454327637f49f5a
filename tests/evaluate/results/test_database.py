"""results.db: writing, reading by other programs, and errors of storage."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from eval_fakes import PYTHONPATH
from faulty_disks import READ_ONLY, python_on

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results import database
from vlagents_ray.evaluate.results.store import Store

Config = Callable[..., EvalConfig]
COUNT = """
import sys
from pathlib import Path
from vlagents_ray.evaluate import Results
print(sum(len(case.episodes) for case in Results.load(Path(sys.argv[1])).cases))
"""
KILLED = """
import os, sys
from pathlib import Path
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results.store import Store
config = EvalConfig.model_validate_json(sys.argv[1])
store = Store(resolve(config))
store.begin_run({})
store.record(EpisodeResult(plan_jobs(store.cases)[0].key, "done", True, True), 1)
os._exit(9)
"""


@pytest.fixture(scope="module", autouse=True)
def commits_reach_the_disk() -> None:
    """Restore the sync of commits, which the other tests disable."""


def begun(config: EvalConfig) -> Store:
    """Return a store with an episode in it."""
    store = Store(resolve(config))
    store.begin_run({})
    store.record(EpisodeResult(plan_jobs(plan_cases(config))[0].key, "done", True, True), 1)
    return store


def kill_in(config: EvalConfig) -> None:
    """Let a process record an episode and die."""
    command = [sys.executable, "-c", KILLED, config.model_dump_json()]
    assert (
        subprocess.run(command, check=False, env=os.environ | {"PYTHONPATH": PYTHONPATH}).returncode
        == 9
    )


def episodes(results: Results) -> int:
    return sum(len(case.episodes) for case in results.cases)


def test_another_process_reads_meanwhile_and_commits_reach_the_disk(config: Config) -> None:
    with begun(config()) as store:
        [[synchronous]] = store._db.execute("PRAGMA synchronous")
        assert synchronous == 2
        done = subprocess.run(
            [sys.executable, "-c", COUNT, config().out], capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == ["1"]


def test_a_reader_cannot_write_and_results_at_rest_are_one_file(config: Config) -> None:
    with (
        begun(config()),
        closing(database.read_only(config().out)) as db,
        pytest.raises(sqlite3.OperationalError, match="readonly"),
    ):
        db.execute("DELETE FROM episodes")
    assert sorted(path.name for path in config().out.iterdir()) == ["results.db", "results.lock"]


def test_what_a_killed_evaluation_left_is_read_and_only_the_run_that_holds_the_lock_is_running(
    config: Config,
) -> None:
    kill_in(config())
    assert episodes(Results.load(config().out)) == 1

    def states() -> list[str]:
        return [run.state for run in Results.load(config().out).runs]

    assert states() == ["killed"]
    with Store(resolve(config(resume=True))) as store:
        store.begin_run({})
        assert states() == ["killed", "running"]
        store.end_run("complete")
    assert states() == ["killed", "complete"]


@pytest.mark.slow
def test_readers_that_look_at_the_lock_stop_no_evaluation(config: Config) -> None:
    begun(config()).close()
    looked = threading.Event()
    over = threading.Event()

    def look() -> None:
        while not over.is_set():
            database.is_locked(config().out)
            looked.set()

    readers = [threading.Thread(target=look) for _ in range(4)]
    for reader in readers:
        reader.start()
    assert looked.wait(10)
    try:
        for _ in range(20):
            Store(resolve(config(resume=True))).close()
    finally:
        over.set()
        for reader in readers:
            reader.join()


@pytest.mark.parametrize("damage", [b"not a database", b"SQLite format 3\0" + bytes(4000)])
def test_a_file_that_is_no_results_is_one_sentence(tmp_path: Path, damage: bytes) -> None:
    (tmp_path / "results.db").write_bytes(damage)
    with pytest.raises(ConfigError, match=r"results.db: "):
        Results.load(tmp_path)


@pytest.mark.hosts
def test_a_folder_that_cannot_be_written_to_is_read(config: Config) -> None:
    kill_in(config())
    done = python_on(READ_ONLY, config().out, COUNT)
    assert done.stdout.split() == ["1"], done.stderr


FOREIGN = 'x") VALUES (1); DROP TABLE episodes; --'


@pytest.mark.parametrize(
    ("table", "kind"),
    [
        (table, "")
        for table in ("runs", "policies", "cases", "episodes", "attempts", "workers", "tracked")
    ]
    + [("episodes", " AS (1)")],  # a generated column
)
def test_a_column_of_somebody_else_is_refused_by_all_that_open_the_file(
    config: Config, table: str, kind: str
) -> None:
    begun(config()).close()
    name = '"' + FOREIGN.replace('"', '""') + '"'
    with closing(sqlite3.connect(config().out / "results.db")) as db, db:
        db.execute(f"ALTER TABLE {table} ADD COLUMN {name}{kind}")
        before = list(db.iterdump())
    opened: list[Callable[[], object]] = [
        lambda: Results.load(config().out),
        lambda: Store(resolve(config(resume=True))),
    ]
    for read in opened:
        with pytest.raises(
            ConfigError, match=r"got the unknown columns .*DROP TABLE.* read it with the version"
        ):
            read()
    with closing(sqlite3.connect(config().out / "results.db")) as db:
        assert list(db.iterdump()) == before


@pytest.mark.parametrize(
    ("table", "column"), [("episodes", "status"), ("cases", "stop"), ("runs", "config")]
)
def test_a_column_that_is_missing_is_named(config: Config, table: str, column: str) -> None:
    begun(config()).close()
    with closing(sqlite3.connect(config().out / "results.db")) as db, db:
        db.execute(f"ALTER TABLE {table} RENAME COLUMN {column} TO odd")
        db.execute(f"ALTER TABLE {table} DROP COLUMN odd")
    with pytest.raises(
        ConfigError,
        match=rf"expected the table '{table}' .*, got none of the columns \['{column}'\]",
    ):
        Results.load(config().out)
