"""Full or read-only disks: the error is one sentence with the cure, and no recorded result is lost.
Also the copy of the program next to the results.
"""

from __future__ import annotations

import errno
import os
import re
import sqlite3
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from eval_fakes import ToZero
from faulty_disks import FULL, READ_ONLY, python_on

from vlagents_ray.errors import ConfigError, ConnectionLost, DeadlineExceeded, StorageFailed
from vlagents_ray.evaluate import EvalConfig, evaluate, run
from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.artifacts.storage import policy_code, save_diffs, storing, whole
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.ray_tools.git_state import GitState

Config = Callable[..., EvalConfig]
COMMANDS = """
import sys
from pathlib import Path
from eval_fakes import ToZero
from vlagents_ray.cli.console import errors
from vlagents_ray.evaluate import EvalConfig, evaluate
config = EvalConfig.model_validate_json(sys.argv[2])
def play(**changes):
    return evaluate(config.model_copy(update={"workers": 0, **changes}), agent_factory=ToZero)
"""
UNTIL_FULL = (
    COMMANDS
    + """
import subprocess, typer
try:
    with errors(): play()
except typer.Exit as ended:
    assert ended.exit_code == 1, ended
else:
    raise AssertionError("it was written")
subprocess.run(["mount", "-o", "remount,size=64m", sys.argv[1]], check=True)
summary = play(resume=True)
videos = [path for case in summary.results.cases for one in case.episodes for path in one.videos]
assert len(set(videos)) == summary.total.episodes, (len(set(videos)), summary.total)
assert all((config.out / path).stat().st_size for path in videos)
assert not list(config.out.rglob("*.part"))
print("runs", len({one.run for case in summary.results.cases for one in case.episodes}))
print("episodes", summary.total.episodes, (config.out / "report.html").is_file())
"""
)
WRITE = """
import sys
from typer.testing import CliRunner
from vlagents_ray.cli.main import app
done = CliRunner().invoke(app, sys.argv[2:])
print(done.exit_code, repr(done.exception), done.output)
"""


def test_a_disk_is_full_for_sqlite_too(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "x.db")) as db:
        db.executescript("CREATE TABLE t (x); PRAGMA max_page_count = 3;")
        with (
            pytest.raises(
                StorageFailed,
                match=r"the disk is full \(database or disk is full\); make room; .*--resume",
            ),
            storing(tmp_path),
        ):
            db.execute("INSERT INTO t VALUES (?)", ("x" * 100_000,))
        with pytest.raises(sqlite3.OperationalError, match="no such table"), storing(tmp_path):
            db.execute("SELECT * FROM nobody")


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, "the disk is full .* make room"),
        (errno.EDQUOT, "your quota"),
        (errno.EROFS, "read-only file system .* choose another folder"),
        (errno.EACCES, "may not write there"),
        (errno.EIO, "the disk reports an error"),
    ],
)
def test_what_a_disk_refuses_says_what_to_do(number: int, said: str, tmp_path: Path) -> None:
    with (
        pytest.raises(StorageFailed, match=f"^{re.escape(str(tmp_path))}: .*{said}"),
        storing(tmp_path),
    ):
        raise OSError(number, os.strerror(number), str(tmp_path / "video.mp4"))


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError(errno.ENOENT, "gone"),
        DeadlineExceeded("late"),
        ConnectionLost("lost"),
        TypeError("?"),
    ],
)
def test_what_is_no_fault_of_the_disk_passes(error: Exception, tmp_path: Path) -> None:
    with pytest.raises(type(error)) as told, storing(tmp_path):
        raise error
    assert told.value is error


def test_what_was_half_written_gives_its_room_back(tmp_path: Path) -> None:
    def fill_up() -> None:
        with whole(tmp_path / "a.mp4") as part:
            part.write_text("half")
            raise OSError(errno.ENOSPC, "full")

    with pytest.raises(OSError, match="full"):
        fill_up()
    assert list(tmp_path.iterdir()) == []


def test_the_first_failure_is_the_one_that_is_told(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "while a video was written")

    def full_too(*_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(run, "save", full)
    monkeypatch.setattr(Store, "end_run", full_too)
    with pytest.raises(StorageFailed, match="while a video was written"):
        evaluate(config(workers=0), agent_factory=ToZero)


def test_a_disk_that_fills_up_at_the_very_end_is_told(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as broken:
        broken.setattr(run, "write_summary", full)
        with pytest.raises(StorageFailed, match="the disk is full"):
            evaluate(config(workers=0), agent_factory=ToZero)
    summary = evaluate(config(workers=0, resume=True), agent_factory=ToZero)
    assert {one.run for case in summary.results.cases for one in case.episodes} == {1}


def test_a_folder_that_is_a_file_is_one_sentence(config: Config, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(StorageFailed, match="choose another folder"):
            Store(resolve(config(out=out)))


def test_a_file_system_without_locks_is_named(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.raises(ConfigError, match=r"expected a file system with locks, .*--out .*-o flock"):
        Store(resolve(config()))


def one_sentence(done: subprocess.CompletedProcess[str]) -> str:
    assert "Traceback" not in done.stderr + done.stdout, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("Error: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


@pytest.mark.hosts
# No episode fits; some episodes fit; most episodes fit.
@pytest.mark.parametrize("size", ["64k", "300k", "600k"])
def test_a_full_disk_costs_nothing_that_was_recorded(
    size: str, config: Config, tmp_path: Path
) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    settings = config(
        out=folder / "out", episodes=150, video="all", env_options={"camera": [32, 32]}
    )
    done = python_on(FULL, folder, UNTIL_FULL, settings.model_dump_json(), size=size)
    assert re.search(
        r"StorageFailed: .*the disk is full .*; make room; .*--resume", one_sentence(done)
    )
    assert "episodes 150 True" in done.stdout, done.stderr
    assert ("runs 2" in done.stdout) == (size != "64k")


@pytest.mark.hosts
def test_reports_merges_and_exports_tell_a_read_only_folder_alike(
    config: Config, tmp_path: Path
) -> None:
    evaluate(config(workers=0), agent_factory=ToZero)
    out, target = str(config().out), tmp_path / "target"
    target.mkdir()
    for words in (
        ["report", out, "--out", f"{target}/x.html"],
        ["merge", out, "--out", f"{target}/new"],
        ["export", out, "--out", f"{target}/x.csv", "--to", "csv"],
    ):
        done = python_on(READ_ONLY, target, WRITE, *words)
        assert done.stdout.startswith("1 SystemExit(1)"), done.stdout + done.stderr
        assert "is on a read-only file system" in " ".join(done.stdout.split())


DIRTY = GitState("c" * 40, "d" * 64, b"-a\n+b\n")
CLEAN = GitState("c" * 40, None, b"")


def test_each_difference_is_stored_once_under_its_digest(tmp_path: Path) -> None:
    save_diffs(tmp_path, [DIRTY, None, CLEAN, DIRTY])
    save_diffs(tmp_path, [DIRTY])
    [path] = (tmp_path / "provenance").iterdir()
    assert (path.name, path.read_bytes()) == (f"{'d' * 64}.diff", DIRTY.diff)


def test_the_difference_of_a_policy_is_known_only_if_its_server_has_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(storage, "code_of", lambda _target: DIRTY)
    assert policy_code({"policy": "noop", "code": DIRTY.to_json()}) is DIRTY
    assert policy_code({"policy": "noop", "code": CLEAN.to_json()}) is None
    assert policy_code({"policy": "noop"}) is None
    assert policy_code({}) is None
