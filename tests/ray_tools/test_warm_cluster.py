"""Which warm cluster a command finds, under which conditions it uses it, and who owns what runs there."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fake_raylet import raylet

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools import session
from vlagents_ray.ray_tools import warm_cluster as module
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.ray_tools.warm_cluster import (
    abandoned_apps,
    announce_warm,
    join_warm,
    kept,
    locked,
    only_keeper,
    owned_apps,
    warm_cluster,
)

ADDRESS = "127.0.0.1:1"
HOLD = "import sys; from pathlib import Path; from vlagents_ray.ray_tools.warm_cluster import locked\n"
HOLD += "with locked(Path(sys.argv[1])) as mine: print(mine, flush=True); sys.stdin.read()"


@contextlib.contextmanager
def held(file: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has locked a file."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "True\n"
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a warm cluster that is announced; no other one of this machine is found."""
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    monkeypatch.setenv(MARK, str(tmp_path))
    monkeypatch.setattr(module, "enter", lambda name, *_: pytest.fail(f"joined {name}"))
    announce_warm("http://127.0.0.1:8000", ADDRESS)
    return tmp_path


def test_it_is_found_as_long_as_its_ray_runs(folder: Path) -> None:
    assert warm_cluster() is None
    with raylet(folder, ADDRESS):
        found = warm_cluster()
        assert found is not None
        assert (found.url, found.ray_address, found.keeper) == ("http://127.0.0.1:8000", ADDRESS, os.getpid())
    assert warm_cluster() is None
    with pytest.raises(ConfigError, match="start one with `vlagents-ray up`"):
        join_warm()


def test_one_of_another_user_is_not_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root could read its files."""
    with raylet(folder, ADDRESS):
        assert warm_cluster() is not None
        me = os.getuid()
        monkeypatch.setattr(os, "getuid", lambda: me + 1)
        assert warm_cluster() is None


def test_one_with_temporary_files_elsewhere_is_not_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of two jobs of a scheduler on one node."""
    with raylet(folder, ADDRESS):
        monkeypatch.setenv("RAY_TMPDIR", "/elsewhere")
        assert warm_cluster() is None


def test_one_without_keeper_is_refused(folder: Path) -> None:
    with (
        raylet(folder, ADDRESS),
        pytest.raises(ConfigError, match=r"kept the warm cluster .* has ended; `vlagents-ray down`"),
    ):
        join_warm()


def test_it_is_used_under_the_conditions_of_its_start_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    with raylet(folder, ADDRESS), held(folder / "keeper.lock"):
        with pytest.raises(pytest.fail.Exception, match="joined the warm cluster"):
            join_warm()
        with monkeypatch.context() as patch:
            elsewhere = tmp_path_factory.mktemp("elsewhere")
            patch.chdir(elsewhere)
            with pytest.raises(ConfigError, match=rf"working directory: .*started with .*got {elsewhere} here; `vlag"):
                join_warm()
        with monkeypatch.context() as patch:
            patch.setattr(sys, "prefix", "/another")
            with pytest.raises(ConfigError, match=r"Python: .*got .* in /another here; .*`vlagents-ray up`"):
                join_warm()
        with monkeypatch.context() as patch:
            patch.setenv("VLAGENTS_RAY_KEYS", "a secret")
            with pytest.raises(ConfigError, match="VLAGENTS_RAY_KEYS is not what it was") as refused:
                join_warm()
            assert "a secret" not in str(refused.value)


def test_what_another_version_announced_is_refused(folder: Path) -> None:
    (folder / "warm.json").write_text(
        json.dumps({"ray_address": ADDRESS, "temporary_files": str(folder), "what": "another version writes"})
    )
    with (
        raylet(folder, ADDRESS),
        held(folder / "keeper.lock"),
        pytest.raises(ConfigError, match="was started with None, got"),
    ):
        join_warm()


def test_an_application_is_owned_by_one_process_until_it_ends(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LOCK_S", 0.0)
    with raylet(folder, ADDRESS):
        cluster = warm_cluster()
    assert cluster is not None
    with held(folder / "app-noop") as owner:
        with abandoned_apps(folder) as names:
            assert names == []
        with pytest.raises(ConfigError, match="another command serves 'noop'"), owned_apps(cluster, ["noop"]):
            pytest.fail("owned it")
        owner.kill()
        owner.wait()
        with abandoned_apps(folder) as names:
            assert names == ["noop"]
    with owned_apps(cluster, ["noop"]), abandoned_apps(folder) as names:
        assert names == []
    assert not (folder / "app-noop").exists()


def test_a_keeper_is_known_by_its_lock(folder: Path) -> None:
    with raylet(folder, ADDRESS):
        cluster = warm_cluster()
    assert cluster is not None
    assert not cluster.is_kept
    with kept():
        assert cluster.is_kept


def test_several_processes_may_look_at_once_whether_it_is_kept(folder: Path) -> None:
    with raylet(folder, ADDRESS):
        cluster = warm_cluster()
    assert cluster is not None
    with kept():
        pass
    with (folder / "keeper.lock").open() as another:
        fcntl.flock(another, fcntl.LOCK_SH)
        assert not cluster.is_kept


def test_a_cluster_that_has_ended_with_its_folder_is_not_kept(folder: Path) -> None:
    with raylet(folder, ADDRESS):
        cluster = warm_cluster()
    assert cluster is not None
    assert not replace(cluster, folder=folder / "removed").is_kept


def test_two_are_not_started_at_once(folder: Path) -> None:
    """Else both might listen at one port, and commands would find either."""
    lock = folder / f"vlagents-ray-up-{os.getuid()}.lock"
    with held(lock), pytest.raises(ConfigError, match="another `vlagents-ray up` starts or keeps"), only_keeper():
        pytest.fail("started another one")
    with only_keeper():
        assert lock.exists()
    assert not lock.exists()


def test_an_application_is_owned_again_only_when_the_old_one_is_removed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long that takes."""
    monkeypatch.setattr(module, "_LOCK_S", 0.0)
    with raylet(folder, ADDRESS):
        cluster = warm_cluster()
    assert cluster is not None
    (folder / "app-noop").touch()  # of a command that was killed
    looked, events = threading.Event(), list[str]()
    exists = Path.exists

    def look(path: Path, **options: Any) -> bool:
        there = exists(path, **options)
        if there and path.name == "removed-noop":
            looked.set()
        return there

    monkeypatch.setattr(Path, "exists", look)

    def own() -> None:
        with owned_apps(cluster, ["noop"]):
            events.append("owned")

    owner = threading.Thread(target=own)
    with abandoned_apps(folder) as names:
        assert names == ["noop"]
        owner.start()
        assert looked.wait(60)
        events.append("removed")
    owner.join(60)
    assert events == ["removed", "owned"]


def test_only_what_the_cluster_set_is_undone_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SET_BY_JOIN", "CHANGED_BY_JOIN", "SET_BY_USER"):
        monkeypatch.setenv(name, "before")
        if name != "CHANGED_BY_JOIN":
            monkeypatch.delenv(name)
    monkeypatch.setattr(session, "warm_cluster", lambda: "a cluster")
    monkeypatch.setattr(session, "join_warm", lambda **_: os.environ.update(SET_BY_JOIN="1", CHANGED_BY_JOIN="1"))
    with session.joined("auto"):
        assert os.environ["SET_BY_JOIN"] == "1"
        os.environ["SET_BY_USER"] = "1"
    assert "SET_BY_JOIN" not in os.environ
    assert os.environ["CHANGED_BY_JOIN"] == "before"
    assert os.environ["SET_BY_USER"] == "1"


def test_the_lock_of_a_removed_file_is_none(tmp_path: Path) -> None:
    """Else two processes would each have locked a file of that name."""
    file = tmp_path / "lock"
    with locked(file) as mine:
        assert mine
        file.unlink()
        with locked(file) as again:
            assert again
    with locked(tmp_path / "no" / "folder") as mine:
        assert not mine
